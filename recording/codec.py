"""Tables to messages and back: the schema's columns bound to the byte layout of a channel's messages."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import polars as pl
from numpy.typing import NDArray

from .cdr import (
    Bytes,
    CdrError,
    Layout,
    decode_text,
    layout_of_lengths,
    layout_of_message,
    split_index,
)
from .definitions import Library, load
from .errors import MarchaError, UsageError
from .schemas import TECHNOLOGIES, ColumnGroup, Schema

PREFIX = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log", "<u8"),
        ("publish", "<u8"),
    ]
)
"""What stands before the message in an MCAP message record: 31 bytes."""

SECOND = 1_000_000_000
MAX_TIME_NS = 2**31 * SECOND - 1
"""The last moment that ``builtin_interfaces/Time`` can hold."""

WORD, NARROWED, HALF, TIME, OCTET = range(5)
"""How a number gets from its column into its field: eight bytes as they are, a double into a float, four
bytes, nanoseconds (int64) into seconds and nanoseconds, one byte."""

_EXPAND = 64
"""Longest fixed array of a foreign message that becomes one column an element."""


class Binding(NamedTuple):
    """One column and the message field behind it."""

    column: str
    kind: str
    path: str


class RecordTemplate(NamedTuple):
    """A record whose texts are known.

    Attributes
    ----------
    dtype : numpy.dtype
        Structured type of the record.
    template : ndarray of uint8
        The record with every number 0.
    fields : list of (int, str, int, int)
        Kind, column, where in a value of it (byte), and where in the record the field lies; sorted by kind
        (:data:`WORD` …); the column "" is the publish time.
    """

    dtype: np.dtype[Any]
    template: Bytes
    fields: list[tuple[int, str, int, int]]


class Chunk:
    """A chunk of one channel being filled: records of one size and their index.

    Parameters
    ----------
    size : int
        Bytes of a record.
    most : int
        Records that it holds.
    """

    def __init__(self, size: int, most: int) -> None:
        self.size = size
        self.most = most
        self.rows = 0
        self._data = np.empty(size * most, np.uint8)
        self._index = np.empty((most, 2), np.int64)

    @property
    def data(self) -> Bytes:
        """The records that are there."""
        return self._data[: self.rows * self.size]

    @property
    def index(self) -> NDArray[np.int64]:
        """Log time of each, and where it starts in ``data``."""
        return self._index[: self.rows]

    def append(self, rows: RowAddresses, first: int, n: int, sequence: int) -> None:
        """Encode ``n`` rows from the ``first`` on behind what is there."""
        from .compiled import encode_into  # numba takes a third of a second to import

        index = self._index[self.rows :]
        index[0, 1] = self.rows * self.size
        fields = rows.fields.copy()
        fields[:, 0] += first * fields[:, 1]
        encode_into(
            self._data,
            index,
            rows.template,
            sequence,
            rows.times + 8 * first,
            fields,
            rows.ends,
            self.size,
            n,
        )
        self.rows += n


class RowAddresses:
    """Rows of a channel as :meth:`Chunk.append` takes them: where in memory their numbers are.

    Parameters
    ----------
    form : RecordTemplate
        The record.
    columns : mapping of str to ndarray
        As :meth:`Encoder.arrays` returns them.
    t_ns, t_log_ns : ndarray of int64, shape (n,)
        Time that the message speaks of, and when it was known.
    """

    def __init__(
        self,
        form: RecordTemplate,
        columns: Mapping[str, NDArray[Any]],
        t_ns: NDArray[np.int64],
        t_log_ns: NDArray[np.int64],
    ) -> None:
        times = np.ascontiguousarray(t_log_ns), np.ascontiguousarray(t_ns)
        self.template = form.template
        self.times = np.array([_address(t) for t in times])
        given = {"": times[1], **columns}
        places = {name: (_address(values), values.strides[0]) for name, values in given.items()}
        self.fields = np.array(
            [(places[c][0] + inside, places[c][1], at) for _, c, inside, at in form.fields], np.int64
        ).reshape(-1, 3)
        self.ends = np.searchsorted([kind for kind, *_ in form.fields], np.arange(5), side="right")
        self._alive = times, columns


def _address(values: NDArray[Any]) -> int:
    return values.__array_interface__["data"][0]


# ---------------------------------------------------------------------------------------- tables to messages


def resolve_columns(
    schema: Schema, columns: Sequence[str], topic: str
) -> tuple[tuple[str, ...], list[ColumnGroup]]:
    """Check the columns of a table against a schema.

    Returns
    -------
    names : tuple of str
        Joint (value, marker) names of a named schema, else empty.
    groups : list of ColumnGroup
        Groups that are there.

    Raises
    ------
    MarchaError
        A column is unknown, or one that must be there is not.
    """
    given = set(columns)
    names = _names_of(schema, columns) if schema.names else ()
    if schema.names and not names:
        raise MarchaError(f"{topic}: {schema.name} needs one column a name, got none")
    groups: list[ColumnGroup] = []
    known: set[str] = set()
    for group in schema.groups:
        wanted = (
            [n + c.name for c in group.columns for n in names]
            if schema.names
            else [c.name for c in group.columns]
        )
        here = given.intersection(wanted)
        known.update(wanted)
        if not here and group.optional:
            continue
        missing = [w for w in wanted if w not in given]
        if missing:
            raise MarchaError(
                f"{topic}: {schema.name} lacks the column {', '.join(missing)}; give it, or NaN in it"
            )
        groups.append(group)
    unknown = [c for c in columns if c not in known]
    if unknown:
        raise MarchaError(
            f"{topic}: {schema.name} has no column {', '.join(map(repr, unknown))}; it has "
            + ", ".join(c.name or "<name>" for c in schema.columns)
        )
    if not groups:
        raise MarchaError(f"{topic}: {schema.name} without any of its columns")
    return names, groups


def _names_of(schema: Schema, columns: Sequence[str]) -> tuple[str, ...]:
    suffixes = [c.name for c in schema.columns]
    first = suffixes[0]
    if first:
        return tuple(c[: -len(first)] for c in columns if c.endswith(first))
    here = set(columns)
    return tuple(
        c for c in columns if not any(s and c.endswith(s) and c[: -len(s)] in here for s in suffixes)
    )


class Encoder:
    """Encodes tables of one channel as MCAP message records.

    Parameters
    ----------
    schema : Schema
        Message type.
    columns : sequence of str
        Columns of the channel's tables (without ``t_ns`` and ``t_log_ns``).
    frame_id : str
        Constant frame id.
    topic : str
        For error messages.
    channel_id : int
        Id that goes into the records.
    """

    def __init__(
        self, schema: Schema, columns: Sequence[str], frame_id: str, topic: str, channel_id: int
    ) -> None:
        self.schema = schema
        self.topic = topic
        self.channel_id = channel_id
        self.frame_id = frame_id
        names, groups = resolve_columns(schema, columns, topic)
        self.library: Library = load(schema.name)
        self.definition = next(iter(self.library.values()))
        self._root = f"{schema.explode}[0]." if schema.explode else ""
        self.bindings = [
            Binding(n + c.name, c.kind, self._root + c.field.replace("[i]", f"[{i}]"))
            for g in groups
            for c in g.columns
            for i, n in (enumerate(names) if schema.names else [(0, "")])
        ]
        by_name = {b.column: b for b in self.bindings}
        self.bindings = [by_name[c] for c in columns]
        self._counts = {schema.explode: 1} if schema.explode else {}
        self._texts: dict[str, bytes] = {}
        if schema.frame:
            self._texts[schema.frame] = _text(frame_id, f"{topic}: frame_id")
        if schema.names:
            sequences = {c.field.split("[")[0] for g in groups for c in g.columns}
            self._counts |= dict.fromkeys([schema.names, *sequences], len(names))
            self._texts |= {f"{schema.names}[{i}]": _text(n, f"{topic}: column") for i, n in enumerate(names)}
        self._constants: dict[str, float] = {}
        for group in schema.groups:
            constants = group.present if group in groups else group.absent
            self._constants |= {self._root + k: v for k, v in constants.items()}
        self._text_bindings = [b for b in self.bindings if b.kind == "text"]
        self._free: list[Chunk] = []
        self._cache: dict[tuple[bytes, ...], RecordTemplate] = {}
        self.record_size = self._plan(tuple(b"" for _ in self._text_bindings)).template.size

    def _plan(self, texts: tuple[bytes, ...]) -> RecordTemplate:
        """Return the record for given values of the text columns."""
        if texts in self._cache:
            return self._cache[texts]
        strings = self._texts | {b.path: t for b, t in zip(self._text_bindings, texts, strict=True)}
        lengths = {k: len(v) for k, v in strings.items()} | self._counts
        layout = layout_of_lengths(self.definition, self.library, lengths)
        dtype = record_dtype(layout)
        record = np.zeros((), dtype)
        message = layout.template()
        for path, value in strings.items():
            message[path] = value
        record = np.concatenate([np.zeros(PREFIX.itemsize, "u1"), np.frombuffer(message.tobytes(), "u1")])
        view = record.view(dtype)
        view["@opcode"] = 5
        view["@length"] = record.size - 9
        view["@channel"] = self.channel_id
        for path, value in self._constants.items():
            field, at = _field(dtype, path)
            record[at : at + field.itemsize].view(field.base)[:] = value
        form = self._cache[texts] = RecordTemplate(
            dtype, record, _fields(dtype, self._root + self.schema.stamp, self.bindings)
        )
        return form

    def blank(self) -> bytes:
        """Return a message of this channel with every number 0."""
        return self._plan(tuple(b"" for _ in self._text_bindings)).template[PREFIX.itemsize :].tobytes()

    @property
    def even(self) -> bool:
        """Whether all records are of one size."""
        return not self._text_bindings

    def chunk(self, size: int) -> Chunk:
        """Return an empty chunk for about ``size`` bytes of records, which are :attr:`even`.

        :meth:`release` takes its memory back: fresh memory for every chunk would cost as much as filling it.
        """
        try:
            chunk = self._free.pop()
        except IndexError:
            return Chunk(self.record_size, max(1, size // self.record_size))
        chunk.rows = 0
        return chunk

    def release(self, chunk: Chunk) -> None:
        """Take back a chunk that nobody reads any more."""
        self._free.append(chunk)

    def rows(
        self, columns: Mapping[str, NDArray[Any]], t_ns: NDArray[np.int64], t_log_ns: NDArray[np.int64]
    ) -> RowAddresses:
        """Return rows for :meth:`Chunk.append`; ``columns`` are those that :meth:`arrays` returned."""
        return RowAddresses(self._plan(()), columns, t_ns, t_log_ns)

    def records(
        self,
        columns: Mapping[str, NDArray[Any]],
        t_ns: NDArray[np.int64],
        t_log_ns: NDArray[np.int64],
        sequence: int,
    ) -> list[bytes]:
        """Return the record of each row, where texts make their sizes differ; see :meth:`rows`."""
        texts = list(zip(*(columns[b.column] for b in self._text_bindings), strict=True))
        records: list[bytes] = [b""] * len(t_ns)
        rows_of: dict[tuple[bytes, ...], list[int]] = {}
        for i, text in enumerate(texts):
            rows_of.setdefault(text, []).append(i)
        for text, numbers in rows_of.items():
            form = self._plan(text)
            part = {b.column: columns[b.column][numbers] for b in self.bindings if b.kind != "text"}
            rows = RowAddresses(form, part, t_ns[numbers], t_log_ns[numbers])
            chunk = Chunk(form.template.size, len(numbers))
            chunk.append(rows, 0, len(numbers), 0)
            data = chunk.data.reshape(len(numbers), -1)
            data.view(form.dtype)["@sequence"][:, 0] = np.array(numbers) + sequence
            for number, record in zip(numbers, data, strict=True):
                records[number] = record.tobytes()
        return records

    def arrays(self, table: Mapping[str, pl.Series | NDArray[Any]]) -> dict[str, NDArray[Any]]:
        """Check and convert columns to what :meth:`rows` and :meth:`records` take.

        Raises
        ------
        MarchaError
            A column is of the wrong type, has nulls where there is no NaN, or is out of the field's range.
        """
        dtype = self._plan(tuple(b"" for _ in self._text_bindings)).dtype
        return {b.column: self._array(table[b.column], b, dtype) for b in self.bindings}

    def _array(self, given: pl.Series | NDArray[Any], binding: Binding, dtype: np.dtype[Any]) -> NDArray[Any]:
        where = f"{self.topic}: column {binding.column!r}"
        kind = binding.kind
        if isinstance(given, np.ndarray):  # a series would be a copy
            if given.dtype == np.float64 and kind == "number" and _field(dtype, binding.path)[0].kind == "f":
                return given
            if given.dtype == np.bool_ and kind == "flag":
                return given
        series = given if isinstance(given, pl.Series) else pl.Series(given)
        of = series.dtype
        if kind == "flag":
            _refuse(where, of, of == pl.Boolean or of.is_integer(), "Boolean")
        elif kind in ("mac", "technology", "text"):
            _refuse(where, of, of in (pl.String, pl.Categorical, pl.Enum), "String")
        elif kind == "time":
            _refuse(where, of, of == pl.Int64, "Int64 nanoseconds")
        else:
            _refuse(where, of, of.is_numeric(), "a number")
        if kind in ("number", "sigma"):
            field, _ = _field(dtype, binding.path)
            if field.kind == "f":
                values = series.cast(pl.Float64).to_numpy()
                return np.square(values) if kind == "sigma" else values
            _refuse(where, of, of.is_integer(), "an integer")
        if series.null_count():
            raise MarchaError(
                f"{where}: {series.null_count()} nulls, and {of} has no NaN; drop or fill these rows"
            )
        if kind == "number":
            return _integers(series.to_numpy(), _field(dtype, binding.path)[0], where)
        if kind == "flag":
            return _flags(series, where)
        if kind == "time":
            return check_times(series.to_numpy(), where)
        text = series.cast(pl.String)
        if kind == "text":
            return np.array([_text(v, where) for v in text.to_list()], object)
        unique = text.unique(maintain_order=True)
        index = pl.DataFrame({"v": text}).join(
            pl.DataFrame({"v": unique, "i": np.arange(len(unique))}),
            on="v",
            how="left",
            maintain_order="left",
        )["i"]
        convert = _parse_mac if kind == "mac" else _parse_technology
        codes = np.array([convert(v, where) for v in unique.to_list()], "u1")
        return codes[index.to_numpy()]


def _refuse(where: str, of: Any, good: bool, wanted: str) -> None:
    if not good:
        raise MarchaError(f"{where}: type {of}, must be {wanted}")


def _integers(values: NDArray[Any], field: np.dtype[Any], where: str) -> NDArray[Any]:
    info = np.iinfo(field)
    if len(values) and (values.min() < info.min or values.max() > info.max):
        raise MarchaError(
            f"{where}: values {values.min()} to {values.max()}, the field holds {info.min} to {info.max}"
        )
    return values.astype(field)


def _flags(series: pl.Series, where: str) -> NDArray[Any]:
    values = series.to_numpy()
    if series.dtype != pl.Boolean and not np.isin(values, (0, 1)).all():
        raise MarchaError(f"{where}: values other than 0 and 1")
    return values.astype(bool)


def _text(value: str, where: str) -> bytes:
    raw = value.encode()
    if b"\x00" in raw:
        raise MarchaError(f"{where}: {value!r} contains a NUL, which a message's string cannot hold")
    return raw


def _parse_mac(value: str, where: str) -> list[int]:
    parts = value.replace("-", ":").split(":")
    try:
        if len(parts) != 6 or any(len(p) != 2 for p in parts):
            raise ValueError
        return [int(p, 16) for p in parts]
    except ValueError:
        raise MarchaError(f"{where}: {value!r} is not a hardware address aa:bb:cc:dd:ee:ff") from None


def _parse_technology(value: str, where: str) -> int:
    if value not in TECHNOLOGIES:
        raise MarchaError(f"{where}: {value!r} is none of {', '.join(TECHNOLOGIES)}")
    return TECHNOLOGIES.index(value)


def check_times(values: NDArray[Any], where: str) -> NDArray[np.int64]:
    """Return times as int64, refusing what ``builtin_interfaces/Time`` cannot hold.

    Raises
    ------
    MarchaError
        A time is negative or beyond :data:`MAX_TIME_NS`.
    """
    # Without a sign, a negative time is a late one: one pass instead of two.
    if len(values) and values.astype(np.int64, copy=False).view(np.uint64).max() > MAX_TIME_NS:
        bad = int(np.argmax((values < 0) | (values > MAX_TIME_NS)))
        raise MarchaError(
            f"{where}: row {bad}: time {values[bad]} ns; it must lie between 0 and {MAX_TIME_NS}"
        )
    return values.astype(np.int64, copy=False)


def record_dtype(layout: Layout) -> np.dtype[Any]:
    """Return the structured type of a whole MCAP message record with this message layout."""
    fields = layout.dtype.fields or {}
    prefix = PREFIX.fields or {}
    return np.dtype(
        {
            "names": [
                *(f"@{name}" for name in prefix),
                *fields,
            ],  # @: a message may have a field "length" too
            "formats": [*(f[0] for f in prefix.values()), *(f[0] for f in fields.values())],
            "offsets": [*(f[1] for f in prefix.values()), *(f[1] + PREFIX.itemsize for f in fields.values())],
            "itemsize": PREFIX.itemsize + layout.dtype.itemsize,
        }
    )


def _field(dtype: np.dtype[Any], path: str) -> tuple[np.dtype[Any], int]:
    """Return the type of a field or of one element of it, and where it lies."""
    fields: Any = dtype.fields
    if path in fields:
        return fields[path][:2]
    base, index = split_index(path)
    of, at = fields[base][:2]
    return of.base, at + (index or 0) * of.base.itemsize


def index_of(log: NDArray[np.int64], sizes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the index of records of these sizes, one behind the other; see :attr:`Chunk.index`."""
    return np.column_stack((log, np.cumsum(sizes) - sizes))


def _fields(dtype: np.dtype[Any], stamp: str, bindings: Sequence[Binding]) -> list[tuple[int, str, int, int]]:
    """Return :attr:`RecordTemplate.fields`."""
    fields: Any = dtype.fields
    out = [(TIME, "", 0, fields[f"{stamp}.sec"][1])]
    for binding in bindings:
        if binding.kind == "text":
            continue
        if binding.kind == "time":
            out.append((TIME, binding.column, 0, fields[f"{binding.path}.sec"][1]))
            continue
        field, at = _field(dtype, binding.path)
        if field == np.float32:
            out.append((NARROWED, binding.column, 0, at))
        elif field.itemsize in (4, 8) and not field.shape:
            out.append((WORD if field.itemsize == 8 else HALF, binding.column, 0, at))
        else:
            out += [(OCTET, binding.column, k, at + k) for k in range(field.itemsize)]
    return sorted(out)


# ---------------------------------------------------------------------------------------- messages to tables


Columns = dict[str, Any]
"""Column name to array or series, all of one length."""


class Messages(NamedTuple):
    """The messages of one channel within one chunk.

    Attributes
    ----------
    data : ndarray of uint8
        The decompressed chunk.
    offsets, sizes : ndarray of int64
        First byte and length of every message (behind the record's prefix).
    log, publish : ndarray of int64
        Log time and publish time (ns).
    """

    data: Bytes
    offsets: NDArray[np.int64]
    sizes: NDArray[np.int64]
    log: NDArray[np.int64]
    publish: NDArray[np.int64]

    def take(self, keep: NDArray[Any] | slice) -> Messages:
        """Return the messages that ``keep`` (mask, slice or indices) picks."""
        return Messages(self.data, self.offsets[keep], self.sizes[keep], self.log[keep], self.publish[keep])

    def message(self, i: int) -> memoryview:
        """Return the bytes of message ``i``."""
        start = int(self.offsets[i])
        return self.data.data[start : start + int(self.sizes[i])]


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
            self.rows.append(_flatten(layout, decoder))
            self.stamps.append("header.stamp" if "header.stamp.sec" in (layout.dtype.names or ()) else None)
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
                given = (layout.text(record, f"{schema.names}[{i}]") or "" for i in range(count))
                names = _distinct(["t_ns", "t_log_ns", *given])[2:]
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
        """Return whether all messages have this layout and the same frame id and names."""
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
    return [by_name[c] for c in columns if c in by_name]


def _flatten(layout: Layout, decoder: Decoder) -> list[Binding]:
    """Return one column a leaf of a message that marcha has no schema for."""
    fields = layout.dtype.fields or {}
    bindings: list[Binding] = []
    for path, (format_, *_) in fields.items():
        if path.endswith("#"):
            sequence = path[:-1]
            if sequence in layout.sequences and sequence not in fields and layout.sequences[sequence] == 0:
                bindings.append(Binding(sequence, "list", sequence))
            elif sequence in layout.counts and sequence not in layout.sequences and sequence not in fields:
                bindings.append(Binding(sequence, "text", sequence))
            continue
        if path in ("#", "header.stamp.sec", "header.stamp.nanosec", "header.frame_id"):
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
}

__all__ = ["CdrError", "Decoder", "Encoder", "Messages", "UsageError"]
