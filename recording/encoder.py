"""Tables to messages: a channel's columns bound to the byte layout of its message records."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import polars as pl
from numpy.typing import NDArray

from .cdr import (
    Bytes,
    Layout,
    encode,
    layout_of_lengths,
    split_index,
)
from .codec import PREFIX, SECOND, Binding, check_times
from .definitions import Library, load, short_name
from .errors import MarchaError
from .schemas import TECHNOLOGIES, ColumnGroup, Schema


class RecordTemplate(NamedTuple):
    """A record whose texts are known.

    Attributes
    ----------
    dtype : numpy.dtype
        Structured type of the record.
    blank : ndarray of uint8
        The record with every number 0.
    fields : list of (str, numpy.dtype, int)
        Column, type of its field, and where in the record that lies.
    times : list of (str, int)
        Column of nanoseconds, and where in the record its seconds lie, four bytes, the nanoseconds behind
        them; the column "" is the publish time.
    """

    dtype: np.dtype[Any]
    blank: Bytes
    fields: list[tuple[str, np.dtype[Any], int]]
    times: list[tuple[str, int]]


_TOGETHER = 1024
"""Records that are filled together, field by field: they stay in the processor's second cache meanwhile."""


class Chunk:
    """A chunk of one channel being filled: records of one size and their index.

    Parameters
    ----------
    template : RecordTemplate
        The record; what is constant in it is written once and stays when the chunk is used again.
    most : int
        Records that it holds.
    """

    def __init__(self, template: RecordTemplate, most: int) -> None:
        self.size = template.blank.size
        self.most = most
        self.rows = 0
        self._data = np.tile(template.blank, most)
        self._index = np.zeros((most, 2), np.int64)
        self._index[:, 1] = np.arange(most) * self.size
        prefix: Any = PREFIX.fields
        self._sequence, self._log, self._publish = (
            self._field(*prefix[name][:2]) for name in ("sequence", "log", "publish")
        )
        self._fields = [(column, self._field(of, offset)) for column, of, offset in template.fields]
        four = np.dtype("<i4")
        self._times = [
            (c, self._field(four, offset), self._field(four, offset + 4)) for c, offset in template.times
        ]

    def _field(self, of: np.dtype[Any], offset: int) -> NDArray[Any]:
        """Return a field of all records as one array."""
        return np.ndarray((self.most,), of, self._data, offset, (self.size,))  # type: ignore[arg-type]

    @property
    def data(self) -> Bytes:
        """The records that are there."""
        return self._data[: self.rows * self.size]

    @property
    def index(self) -> NDArray[np.int64]:
        """Log time of each, and where it starts in ``data``."""
        return self._index[: self.rows]

    def encode_into(
        self,
        columns: Mapping[str, NDArray[Any]],
        t_ns: NDArray[np.int64],
        t_log_ns: NDArray[np.int64],
        sequence: int,
    ) -> None:
        """Encode rows behind what is there.

        Parameters
        ----------
        columns : mapping of str to ndarray
            As :meth:`Encoder.arrays` returns them.
        t_ns, t_log_ns : ndarray of int64, shape (n,)
            Time that the message speaks of, and when it was known; no more than the chunk has left.
        sequence : int
            Sequence number of the first.
        """
        for begin in range(0, len(t_ns), _TOGETHER):
            rows = slice(begin, begin + _TOGETHER)
            times = t_ns[rows]
            there = slice(self.rows, self.rows + len(times))
            self._index[there, 0] = t_log_ns[rows]
            self._sequence[there] = np.arange(sequence + begin, sequence + begin + len(times))
            self._log[there] = t_log_ns[rows]
            self._publish[there] = times
            for column, seconds, nanoseconds in self._times:
                values = columns[column][rows] if column else times
                seconds[there], nanoseconds[there] = np.divmod(values, SECOND)
            with np.errstate(over="ignore"):  # beyond a float32: infinite, as in any cast
                for column, field in self._fields:
                    field[there] = columns[column][rows]
            self.rows += len(times)


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
    present = set(columns)
    names = _names_of(schema, columns) if schema.names else ()
    if schema.names and not names:
        raise MarchaError(f"{topic}: {schema.name} needs one column a name, got none")
    groups: list[ColumnGroup] = []
    taken: set[str] = set()
    for group in schema.groups:
        wanted = (
            [n + c.name for c in group.columns for n in names]
            if schema.names
            else [c.name for c in group.columns]
        )
        here = present.intersection(wanted)
        taken.update(wanted)
        if not here and group.optional:
            continue
        missing = [w for w in wanted if w not in present]
        if missing:
            raise MarchaError(
                f"{topic}: {schema.name} lacks the column {', '.join(missing)}; give it, or NaN in it"
            )
        groups.append(group)
    unknown = [c for c in columns if c not in taken]
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
        self.record_size = self._template(tuple(b"" for _ in self._text_bindings)).blank.size

    def _template(self, texts: tuple[bytes, ...]) -> RecordTemplate:
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
            field, offset = _field(dtype, path)
            record[offset : offset + field.itemsize].view(field.base)[:] = value
        template = self._cache[texts] = RecordTemplate(
            dtype, record, *_fields(dtype, self._root + self.schema.stamp, self.bindings)
        )
        return template

    def blank(self) -> bytes:
        """Return a message of this channel with every number 0."""
        return self._template(tuple(b"" for _ in self._text_bindings)).blank[PREFIX.itemsize :].tobytes()

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
            return Chunk(self._template(()), max(1, size // self.record_size))
        chunk.rows = 0
        return chunk

    def release(self, chunk: Chunk) -> None:
        """Take back a chunk that nobody reads any more."""
        self._free.append(chunk)

    def records(
        self,
        columns: Mapping[str, NDArray[Any]],
        t_ns: NDArray[np.int64],
        t_log_ns: NDArray[np.int64],
        sequence: int,
    ) -> list[bytes]:
        """Return the record of each row, where texts make their sizes differ; see :meth:`Chunk.encode_into`."""
        texts = list(zip(*(columns[b.column] for b in self._text_bindings), strict=True))
        records: list[bytes] = [b""] * len(t_ns)
        rows_of: dict[tuple[bytes, ...], list[int]] = {}
        for i, text in enumerate(texts):
            rows_of.setdefault(text, []).append(i)
        for text, numbers in rows_of.items():
            template = self._template(text)
            part = {b.column: columns[b.column][numbers] for b in self.bindings if b.kind != "text"}
            chunk = Chunk(template, len(numbers))
            chunk.encode_into(part, t_ns[numbers], t_log_ns[numbers], 0)
            data = chunk.data.reshape(len(numbers), -1)
            data.view(template.dtype)["@sequence"][:, 0] = np.array(numbers) + sequence
            for number, record in zip(numbers, data, strict=True):
                records[number] = record.tobytes()
        return records

    def arrays(self, table: Mapping[str, pl.Series | NDArray[Any]]) -> dict[str, NDArray[Any]]:
        """Check and convert columns to what :meth:`Chunk.encode_into` and :meth:`records` take.

        Raises
        ------
        MarchaError
            A column is of the wrong type, has nulls where there is no NaN, or is out of the field's range.
        """
        dtype = self._template(tuple(b"" for _ in self._text_bindings)).dtype
        return {b.column: self._array(table[b.column], b, dtype) for b in self.bindings}

    def _array(
        self, source: pl.Series | NDArray[Any], binding: Binding, dtype: np.dtype[Any]
    ) -> NDArray[Any]:
        where = f"{self.topic}: column {binding.column!r}"
        kind = binding.kind
        if isinstance(source, np.ndarray):  # a series would be a copy
            if source.dtype == np.float64 and kind == "number" and _field(dtype, binding.path)[0].kind == "f":
                return source
            if source.dtype == np.bool_ and kind == "flag":
                return source
        series = source if isinstance(source, pl.Series) else pl.Series(source)
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
    of, offset = fields[base][:2]
    return of.base, offset + (index or 0) * of.base.itemsize


def _fields(
    dtype: np.dtype[Any], stamp: str, bindings: Sequence[Binding]
) -> tuple[list[tuple[str, np.dtype[Any], int]], list[tuple[str, int]]]:
    """Return :attr:`RecordTemplate.fields` and :attr:`RecordTemplate.times`."""
    parts: Any = dtype.fields
    times = [("", stamp), *((b.column, b.path) for b in bindings if b.kind == "time")]
    numbers = [b for b in bindings if b.kind not in ("time", "text")]
    return (
        [(b.column, *_field(dtype, b.path)) for b in numbers],
        [(column, parts[f"{path}.sec"][1]) for column, path in times],
    )


def message_record(schema: str, channel_id: int, t_ns: int, value: Mapping[str, Any]) -> bytes:
    """Return the record of a message of any type that has a text; see :meth:`Writer.add_message`."""
    library = load(schema)
    message = encode(value, library[short_name(schema)], library)
    prefix = np.array([(5, PREFIX.itemsize - 9 + len(message), channel_id, 0, t_ns, t_ns)], PREFIX)
    return prefix.tobytes() + message
