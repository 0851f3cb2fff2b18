"""The TOML mapping of a table: what its columns mean. ``docs/table-mapping.md`` explains it."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Literal

import msgspec

from ..recording import SCHEMAS
from ..recording.errors import MarchaError, UsageError
from ..recording.files import read_toml
from ..recording.schemas import Column
from .timestamps import Rate
from .units import conversion

TICKS_NS = {"s": 1_000_000_000, "ms": 1_000_000, "us": 1_000, "µs": 1_000, "ns": 1}


class Strict(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Base of the mapping's tables: an unknown key is an error."""


class TextLayout(Strict, frozen=True, kw_only=True):
    """How the text is laid out.

    Attributes
    ----------
    separator : str
        One character, or ``blanks`` for runs of spaces and tabs.
    skip_rows : int
        Lines before the header (or before the first row where there is none).
    header : bool
        Whether a line of column names stands before the rows.
    skip_after_header : int
        Lines between header and first row, such as a line of units.
    decimal_comma : bool
        Whether 1,5 means one and a half.
    missing : tuple of str
        Cells that mean that there is no value; an empty cell always does.
    comment : str
        Lines that begin so are passed over.
    encoding : str
        Of the file.
    """

    separator: Annotated[str, msgspec.Meta(min_length=1, max_length=6)] = ","
    skip_rows: Annotated[int, msgspec.Meta(ge=0)] = 0
    header: bool = True
    skip_after_header: Annotated[int, msgspec.Meta(ge=0)] = 0
    decimal_comma: bool = False
    missing: tuple[str, ...] = ("NaN", "nan", "NA", "-")
    comment: str = ""
    encoding: str = "utf-8"


class Time(Strict, frozen=True, kw_only=True):
    """Where time comes from: a column, a rate, or both: a column that counts samples of that rate.

    Attributes
    ----------
    column : str or int
        Name in the header, or number from 1.
    unit : str
        ``s``, ``ms``, ``us``, ``ns``, or ``datetime`` for dates written out.
    format : str
        Of a ``datetime`` (chrono: ``%Y-%m-%d %H:%M:%S%.3f``); default ISO 8601.
    rate_hz : float
        Rows per second, instead of a column; beside one, what it counts per second.
    clock : str
        ``device``: its own zero; ``unix``: since 1970 UTC; ``utc``: dates in UTC.
    rollover : int
        Ticks after which a counter starts again, such as 4294967296.
    even : bool
        Whether the device samples at a fixed rate, so that gaps and jitter are reported.
    """

    column: str | int | None = None
    unit: Literal["s", "ms", "us", "µs", "ns", "datetime"] = "s"
    format: str | None = None
    rate_hz: Rate | None = None
    clock: Literal["device", "unix", "utc"] = "device"
    rollover: Annotated[int, msgspec.Meta(gt=0)] | None = None
    even: bool = True


class CellSource(Strict, frozen=True, kw_only=True):
    """Where a column of a channel comes from: a column of the table, or a constant.

    The value is ``(cell · unit) · scale + offset``; ``offset`` is in the recording's unit.

    Attributes
    ----------
    column : str or int
        Name in the header, or number from 1.
    constant : float, bool or str
        The same for every row, in the recording's unit.
    unit : str
        Unit of the cells; default the group's in ``units``, else the recording's.
    scale, offset : float
        A sign or a calibration.
    """

    column: str | int | None = None
    constant: float | bool | str | None = None
    unit: str | None = None
    scale: float = 1.0
    offset: float = 0.0


class Topic(Strict, frozen=True, kw_only=True):
    """One channel.

    Attributes
    ----------
    name : str
        ``/<device>/<sensor>``.
    schema : str
        Message type, also without ``/msg/``.
    columns : dict of str to Cell
        Columns of the channel; a bare name or number stands for ``{ column = … }``.
    units : dict of str to str
        Units of groups of columns, by the part of the name before ``_``: ``{ acc = "g", gyr = "deg/s" }``.
    frame : str
        Frame of the vectors.
    file : str
        Name (or pattern) of the file in a folder or archive; default: the only file.
    full_scale : dict of str to float
        Full scale of groups of columns in their unit, ``{ acc = 16, gyr = 2000 }``: values there are clipped.
    only_changes : bool
        Take a row only where a value differs from the row before (a fix that is repeated until the next).
    metadata : dict of str to str
        Anything to say about the channel.
    """

    name: Annotated[str, msgspec.Meta(pattern="^/[^ ]+$")]
    schema: str
    columns: dict[str, CellSource | str | int]
    units: dict[str, str] = {}
    frame: str = ""
    file: str | None = None
    full_scale: dict[str, float] = {}
    only_changes: bool = False
    metadata: dict[str, str] = {}


class Mapping(Strict, frozen=True, kw_only=True):
    """A whole mapping: layout, time, topics, and what to say about the device."""

    topic: Annotated[list[Topic], msgspec.Meta(min_length=1)]
    time: Time
    layout: TextLayout = TextLayout()
    device: dict[str, str] = {}


class Target(msgspec.Struct, frozen=True):
    """One column of a channel, resolved: its source and what becomes of a cell.

    Attributes
    ----------
    name : str
        Column of the channel.
    column : str, int or None
        Column of the table; None for a constant.
    constant : float, bool, str or None
        The constant.
    kind : str
        ``number``, ``flag``, ``time`` or ``text``.
    factor, offset : float
        Of a number.
    full_scale : float or None
        Highest value that the sensor can say, in the recording's unit.
    """

    name: str
    column: str | int | None
    constant: float | bool | str | None
    kind: str
    factor: float
    offset: float
    full_scale: float | None = None


def read_mapping(path: Path) -> Mapping:
    """Read and check a mapping file.

    Raises
    ------
    MarchaError
        One line that names the file and the TOML key.
    """
    if not path.exists():
        raise MarchaError(f"{path}: no such mapping file")
    mapping: Mapping = read_toml(path, Mapping)
    time = mapping.time
    if time.column is None and time.rate_hz is None:
        raise MarchaError(f"{path}: time: give time.column, time.rate_hz, or both for a counter of samples")
    if isinstance(time.column, str) and not mapping.layout.header:
        raise MarchaError(f"{path}: time.column: {time.column!r} is a name, but layout.header is false")
    separator = mapping.layout.separator
    if separator != "blanks" and (len(separator) != 1 or not separator.isascii()):
        raise MarchaError(f"{path}: layout.separator: {separator!r} is neither one character nor 'blanks'")
    if mapping.layout.decimal_comma and separator == ",":
        raise MarchaError(f"{path}: layout.decimal_comma: the comma cannot be separator and decimal mark")
    names = [t.name for t in mapping.topic]
    if len(set(names)) < len(names):
        raise MarchaError(f"{path}: topic.name: two topics have the same name")
    for i, topic in enumerate(mapping.topic):
        targets(path, mapping, i, topic)
    return mapping


def mapping_format(path: Path) -> str:
    """Return the format that a mapping file speaks of: ``exo-csv`` where it names segments, else ``table``."""
    try:
        document = read_toml(path)
    except MarchaError:
        return "table"  # reading it will say what is wrong
    return "exo-csv" if "segment" in document and "topic" not in document else "table"


def schema_name(topic: Topic) -> str:
    """Return the full name of a topic's message type."""
    return topic.schema if topic.schema.count("/") != 1 else topic.schema.replace("/", "/msg/")


def targets(path: Path, mapping: Mapping, index: int, topic: Topic) -> list[Target]:
    """Resolve the columns of one topic.

    Raises
    ------
    MarchaError
        One line that names the file and the TOML key.
    """
    where = f"{path}: topic[{index}]"
    schema = SCHEMAS.get(schema_name(topic))
    if schema is None:
        raise MarchaError(
            f"{where}.schema: unknown message type {topic.schema!r}; one of {', '.join(SCHEMAS)}"
        )
    if not topic.columns:
        raise MarchaError(f"{where}.columns: at least one column is needed")
    result = []
    for name, entry in topic.columns.items():
        key = f"{where}.columns.{name}"
        cell = entry if isinstance(entry, CellSource) else CellSource(column=entry)
        column = _column(name, schema.columns, bool(schema.names))
        if column is None:
            columns = ", ".join(c.name or "<name>" for c in schema.columns)
            raise MarchaError(f"{key}: {schema.name} has no column {name!r}; it has {columns}")
        if (cell.column is None) == (cell.constant is None):
            raise MarchaError(f"{key}: give either column or constant")
        if isinstance(cell.column, str) and not mapping.layout.header:
            raise MarchaError(f"{key}: {cell.column!r} is a name, but layout.header is false: give a number")
        if isinstance(cell.column, int) and cell.column < 1:
            raise MarchaError(f"{key}: columns are numbered from 1, not {cell.column}")
        kind = {"flag": "flag", "time": "time", "text": "text", "mac": "text", "technology": "text"}.get(
            column.kind, "number"
        )
        group = re.split(r"[_.]", name)[0]
        unit = cell.unit or topic.units.get(group)
        try:
            factor, offset = conversion(unit, column.unit) if unit else (1.0, 0.0)
        except UsageError as error:
            raise MarchaError(f"{key}.unit: {error}") from None
        if kind == "number" and isinstance(cell.constant, str):
            raise MarchaError(f"{key}.constant: {cell.constant!r} is not a number")
        limit = abs(topic.full_scale[group] * factor) if group in topic.full_scale else None
        offset = offset * cell.scale + cell.offset
        result.append(Target(name, cell.column, cell.constant, kind, factor * cell.scale, offset, limit))
    groups = [g for g in schema.groups if not g.optional and not schema.names]
    for needed in (c.name for g in groups for c in g.columns):
        if needed not in topic.columns:
            raise MarchaError(f"{where}.columns: {needed} is missing; {schema.name} needs it")
    for group in schema.groups:
        have = [c.name for c in group.columns if c.name in topic.columns]
        if not schema.names and have and len(have) < len(group.columns):
            lacking = next(c.name for c in group.columns if c.name not in topic.columns)
            raise MarchaError(
                f"{where}.columns: {lacking} is missing beside {have[0]}; give a column or a constant"
            )
    return result


def _column(name: str, columns: tuple[Column, ...], named: bool) -> Column | None:
    if not named:
        return next((c for c in columns if c.name == name), None)
    fits = [c for c in columns if name.endswith(c.name) and len(name) > len(c.name)]
    return max(fits, key=lambda c: len(c.name), default=None)
