"""Messages to tables: the byte layout of a channel's messages bound to the schema's columns."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from .cdr import (
    Layout,
    decode_text,
    layout_of_message,
)
from .codec import SECOND, Binding, Columns, Messages
from .definitions import Library
from .schemas import TECHNOLOGIES, Schema

STAMP = frozenset({"header.stamp.sec", "header.stamp.nanosec"})
"""Fields of a foreign message that are its time, where both are there."""
_EXPAND = 64
"""Longest fixed array of a foreign message that becomes one column an element."""


class Decoder:
    """Decodes the messages of one channel into tables.

    Parameters
    ----------
    schema : Schema or None
        How marcha reads this type; None flattens the message as it is.
    library : Library
        Definitions from the recording, the channel's own first.
    columns : sequence of str or None
        Columns that the writer declared; None asks the messages (marks of absent values).
    """

    def __init__(self, schema: Schema | None, library: Library, columns: Sequence[str] | None = None) -> None:
        self.schema = schema
        self.library = library
        self.definition = next(iter(library.values()))
        self.columns = None if columns is None else tuple(columns)
        self._plan: BoundLayout | None = None

    def decode(self, messages: Messages) -> pl.DataFrame:
        """Return ``t_ns``, ``t_log_ns`` and the channel's columns, one row a message, in the order given.

        Raises
        ------
        CdrError
            A message does not fit the definition.
        """
        return pl.DataFrame(self.decode_columns(messages))

    def decode_columns(self, messages: Messages) -> Columns:
        """Return what :meth:`decode` returns as arrays, which are cheaper to join than frames."""
        plan = self._plan or self._make_plan(messages.message(0))
        block = self._fits(plan, messages)
        if block is not None and not plan.explode:
            self._plan = plan
            return _columns(plan, plan.bindings, block, messages)
        return self._ordinary(messages).to_dict()

    def frame_id(self, message: memoryview) -> str:
        """Return the frame id of a message."""
        return self._make_plan(message).frame_id

    def _make_plan(self, message: memoryview) -> BoundLayout:
        return BoundLayout(self, layout_of_message(message, self.definition, self.library), message)

    def _fits(self, plan: BoundLayout, messages: Messages) -> NDArray[Any] | None:
        """Return a structured view over all messages if each has the plan's layout, else None."""
        size = int(messages.sizes[0])
        if size < plan.layout.dtype.itemsize or (messages.sizes != size).any():
            return None
        block = _view(messages, plan.layout.dtype)
        return block if plan.fits(block) else None

    def _ordinary(self, messages: Messages) -> pl.DataFrame:
        """Decode messages of different lengths: those of one layout together, rows back in order."""
        plans: dict[Any, tuple[BoundLayout, list[int]]] = {}
        for i in range(len(messages.log)):
            message = messages.message(i)
            plan = self._make_plan(message)
            plans.setdefault((plan.key, len(message)), (plan, []))[1].append(i)
        frames: list[pl.DataFrame] = []
        for plan, rows in plans.values():
            part = messages.take(np.array(rows))
            block = _view(part, plan.layout.dtype)
            for k, bindings in enumerate(plan.rows):
                frame = pl.DataFrame(_columns(plan, bindings, block, part, k))
                frames.append(frame.with_columns(pl.Series("#", rows), pl.lit(k).alias("#k")))
        if not frames:
            return pl.DataFrame(schema={"t_ns": pl.Int64, "t_log_ns": pl.Int64})
        return pl.concat(frames, how="diagonal_relaxed").sort("#", "#k", maintain_order=True).drop("#", "#k")


class BoundLayout:
    """A layout with the columns bound to it."""

    def __init__(self, decoder: Decoder, layout: Layout, message: memoryview) -> None:
        self.layout = layout
        self.explode = bool(decoder.schema and decoder.schema.explode)
        record = np.frombuffer(message, layout.dtype, 1)
        schema = decoder.schema
        self.frame_id = layout.text(record, schema.frame if schema else "header.frame_id") or ""
        self.rows: list[list[Binding]] = []
        self.stamps: list[str | None] = []
        constants: list[str] = [schema.frame if schema else "header.frame_id"]
        if schema is None:
            self.rows.append(_flatten(layout))
            self.stamps.append("header.stamp" if set(layout.dtype.names or ()) >= STAMP else None)
        elif schema.explode:
            for k in range(layout.sequences[schema.explode]):
                root = f"{schema.explode}[{k}]."
                self.rows.append([Binding(c.name, c.kind, root + c.field) for c in schema.columns])
                self.stamps.append(root + schema.stamp)
        else:
            names = ()
            if schema.names:
                count = layout.sequences[schema.names]
                constants += [f"{schema.names}[{i}]" for i in range(count)]
                own = (layout.text(record, f"{schema.names}[{i}]") or "" for i in range(count))
                names = _distinct(["t_ns", "t_log_ns", *own])[2:]
            self.rows.append(_bind(schema, layout, record, names, decoder.columns))
            self.stamps.append(schema.stamp)
        fields = layout.dtype.fields or {}
        self._constants = [(p, record[p][0]) for p in constants if p in fields]

    @property
    def bindings(self) -> list[Binding]:
        """Columns of a message that is one row."""
        return self.rows[0]

    @property
    def key(self) -> Any:
        """What tells plans of one channel apart."""
        return (
            self.layout.key,
            tuple(self.rows[0]) if self.rows else (),
            tuple(bytes(v) for _, v in self._constants),
        )

    def fits(self, block: NDArray[Any]) -> bool:
        """Return whether all messages have this layout and the same frame id and names.

        Shape of ``block``: (n,).
        """
        return bool(self.layout.fits(block).all()) and all((block[p] == v).all() for p, v in self._constants)


def _columns(
    plan: BoundLayout, bindings: Sequence[Binding], block: NDArray[Any], messages: Messages, row: int = 0
) -> Columns:
    """Return the columns of messages of one layout; all are copies, since the chunk's bytes go away."""
    stamp = plan.stamps[row]
    out: Columns = {
        "t_ns": messages.publish if stamp is None else _get_time(block, stamp),
        "t_log_ns": messages.log,
    }
    for column, kind, path in bindings:
        out[column] = _READ[kind](plan.layout, block, path)
    return out


def _bind(
    schema: Schema,
    layout: Layout,
    record: NDArray[Any],
    names: tuple[str, ...],
    columns: tuple[str, ...] | None,
) -> list[Binding]:
    bindings: list[Binding] = []
    for group in schema.groups:
        if columns is None and group.mark is not None:
            path, value = group.mark
            if layout.leaf(record, path)[0] == value:
                continue
        if schema.names:
            sequence = group.columns[0].field.split("[")[0]
            if layout.sequences.get(sequence, 0) < len(names):
                continue
        bindings += [
            Binding(n + c.name, c.kind, c.field.replace("[i]", f"[{i}]"))
            for c in group.columns
            for i, n in (enumerate(names) if schema.names else [(0, "")])
        ]
    if columns is None:
        return bindings
    by_name = {b.column: b for b in bindings}
    if not schema.names:
        return [by_name[c] for c in columns if c in by_name]
    # What a message does not name has no value in it.
    return [by_name.get(c, Binding(c, "absent", "")) for c in columns]


def _flatten(layout: Layout) -> list[Binding]:
    """Return one column a leaf of a message that marcha has no schema for."""
    fields = layout.dtype.fields or {}
    bindings: list[Binding] = []
    own = {"#", "header.frame_id"} | (STAMP if fields.keys() >= STAMP else frozenset())
    for path, (format_, *_) in fields.items():
        if path.endswith("#"):
            sequence = path[:-1]
            if sequence in layout.sequences and sequence not in fields and layout.sequences[sequence] == 0:
                bindings.append(Binding(sequence, "list", sequence))
            elif sequence in layout.counts and sequence not in layout.sequences and sequence not in fields:
                bindings.append(Binding(sequence, "text", sequence))
            continue
        if path in own:
            continue
        if path.endswith(".nanosec") and path[:-8] + ".sec" in fields:
            continue
        if path.endswith(".sec") and path[:-4] + ".nanosec" in fields:
            bindings.append(Binding(path[:-4] + "_ns", "time", path[:-4]))
        elif format_.kind == "S":
            bindings.append(Binding(path, "text", path))
        elif format_.shape and (path in layout.sequences or format_.shape[0] > _EXPAND):
            bindings.append(Binding(path, "list", path))
        elif format_.shape:
            bindings += [Binding(f"{path}[{i}]", "number", f"{path}[{i}]") for i in range(format_.shape[0])]
        else:
            bindings.append(Binding(path, "number", path))
    bindings = [b for b in bindings if b.path != "header.frame_id"]
    columns = _distinct(["t_ns", "t_log_ns", *(b.column for b in bindings)])[2:]
    return [b._replace(column=c) for b, c in zip(bindings, columns, strict=True)]


def _distinct(names: Iterable[str]) -> tuple[str, ...]:
    """Return the names with a number behind those that are taken: no column may hide another."""
    seen: dict[str, int] = {}
    out: list[str] = []
    for name in names:
        seen[name] = seen.get(name, 0) + 1
        out.append(name if seen[name] == 1 else f"{name}#{seen[name]}")
    return tuple(out)


def _view(messages: Messages, dtype: np.dtype[Any]) -> NDArray[Any]:
    """Return a structured array of messages of one size: a view where they lie evenly, else a copy."""
    offsets = messages.offsets
    n = len(offsets)
    stride = int(offsets[1] - offsets[0]) if n > 1 else dtype.itemsize
    if n < 3 or (np.diff(offsets) == stride).all():
        return np.ndarray((n,), dtype, messages.data, int(offsets[0]), (stride,))  # type: ignore[arg-type]
    windows = np.lib.stride_tricks.sliding_window_view(messages.data, dtype.itemsize)
    return windows[offsets].view(dtype)[:, 0]


def _get_time(block: NDArray[Any], path: str) -> NDArray[np.int64]:
    return block[f"{path}.sec"].astype(np.int64) * SECOND + block[f"{path}.nanosec"]


def _number(layout: Layout, block: NDArray[Any], path: str) -> NDArray[Any]:
    values = layout.leaf(block, path)
    return values.astype(
        values.dtype.newbyteorder("="), order="C"
    )  # always a copy: the chunk's bytes go away


def _mac(layout: Layout, block: NDArray[Any], path: str) -> pl.Series:
    octets = layout.leaf(block, path).astype(np.uint64)
    code = octets @ (np.uint64(256) ** np.arange(5, -1, -1, dtype=np.uint64))
    unique, index = np.unique(code, return_inverse=True)
    texts = [int(u).to_bytes(6, "big").hex(":") for u in unique]
    return pl.Series(texts, dtype=pl.String).gather(index)


def _technology(layout: Layout, block: NDArray[Any], path: str) -> pl.Series:
    code = np.minimum(_number(layout, block, path), len(TECHNOLOGIES))
    return pl.Series([*TECHNOLOGIES, "unknown"], dtype=pl.String).gather(code.astype(np.int64))


def _texts(layout: Layout, block: NDArray[Any], path: str) -> pl.Series:
    if layout.counts.get(path, 0) == 0:
        return pl.Series([""] * len(block), dtype=pl.String)
    return pl.Series([decode_text(v) for v in block[path].tolist()], dtype=pl.String)


def _list(layout: Layout, block: NDArray[Any], path: str) -> pl.Series:
    if path not in (block.dtype.names or ()):
        return pl.Series([[]] * len(block), dtype=pl.List(pl.Null))
    return pl.Series(_number(layout, block, path)).cast(
        pl.List(pl.Series(_number(layout, block, path)[:1, 0]).dtype)
    )


_READ: dict[str, Any] = {
    "number": _number,
    "sigma": lambda layout, block, path: np.sqrt(_number(layout, block, path)),
    "flag": lambda layout, block, path: _number(layout, block, path).astype(bool),
    "time": lambda layout, block, path: _get_time(block, path),
    "mac": _mac,
    "technology": _technology,
    "text": _texts,
    "list": _list,
    "absent": lambda layout, block, path: np.full(len(block), np.nan),
}
