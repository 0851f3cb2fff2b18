"""Tables of Sensor Logger as its exports hold them: CSV files of a folder, one JSON file, one SQLite database.

All are read in pieces and never held; JSON once for each sensor.
"""

from __future__ import annotations

import contextlib
import csv
import io
import re
import sqlite3
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import chain, islice
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import polars as pl

from ..recording.errors import MarchaError
from ..recording.files import read_small
from .cells import NoRowError
from .columns import careful_block, float_blocks, require_header
from .contract import ReportBuilder
from .text import BLOCK_BYTES, start_of

WANTED = "time,seconds_elapsed,z,y,x"
_WANTED_TEXT = "time,seconds_elapsed,text,millisecond_press_duration"
READ = (
    "Accelerometer", "TotalAcceleration", "Gravity", "AccelerometerUncalibrated", "Gyroscope",
    "GyroscopeUncalibrated", "Magnetometer", "MagnetometerUncalibrated", "Location", "LocationGps", "Barometer",
    "Pedometer", "Orientation", "Annotation",
)  # fmt: skip
TRIPLES = READ[:8]
"""Tables of three axes."""
ANNOTATION = "Annotation"
"""Table of what the user wrote while the app recorded."""
PRESS = "millisecond_press_duration"
_TEXTS = ("text", PRESS)
"""Columns that stay text."""
_NUMBERS = {
    "time", "seconds_elapsed", "x", "y", "z", "latitude", "longitude", "altitude", "horizontalAccuracy",
    "verticalAccuracy", "speed", "bearing", "pressure", "steps", "qw", "qx", "qy", "qz",
}  # fmt: skip
"""Columns that are read; others may be text, as the times for people that the app writes if told to."""
_READ_COLUMNS = {*_NUMBERS, *_TEXTS}
HEAD_BLOCKS = 2
"""Pieces of a table that are read to find out how it is turned: 10 minutes and more at 100 Hz."""


PIECE_ROWS = 32_768
"""Rows of a piece of JSON or of a database."""
_BETWEEN_OBJECTS = re.compile(rb"\}\s*,\s*(?=\{)")
END_BYTES, TRIES = 65_536, 3
"""Where in a piece of JSON its last object is looked for, and how many of its candidates are tried."""


class SensorTable(NamedTuple):
    """The rows of one sensor: ``t`` (ns), ``line``, numbers, and what people wrote.

    Attributes
    ----------
    head : polars.DataFrame
        The first of them.
    frames : callable
        Reads all of them in pieces, and tells a report what is found.
    whole : bool
        Whether there are no others than in ``head``.
    """

    head: pl.DataFrame
    frames: Callable[[ReportBuilder], Iterator[pl.DataFrame]]
    whole: bool

    def each(self, change: Callable[[pl.DataFrame], pl.DataFrame]) -> SensorTable:
        """Return the table with every piece changed."""
        return SensorTable(change(self.head), lambda report: map(change, self.frames(report)), self.whole)


Tables = dict[str, SensorTable]


def files_of(folder: Path) -> list[Path]:
    """Return the CSV files of an export, not deeper than an archive's top folder."""
    return sorted(p for p in (*folder.glob("*.csv"), *folder.glob("*/*.csv")) if p.is_file())


def is_header(cells: Sequence[str]) -> bool:
    """Whether the cells of a line are the header of one of its tables."""
    return "time" in cells and "seconds_elapsed" in cells


def read_tables(path: Path, report: ReportBuilder) -> tuple[Tables, dict[str, str]]:
    """Return what is read: a table a sensor, and the metadata."""
    if path.is_dir():
        about: dict[str, str] = {}
        tables: dict[str, SensorTable | None] = {}
        unread: list[str] = []
        for file in files_of(path):
            if file.stem.lower() == "metadata":
                about = _first_row(file)
            elif file.stem == ANNOTATION:
                tables[ANNOTATION] = _annotations(file, report)
            elif file.stem in READ:
                tables[file.stem] = _csv(file, report)
            else:
                unread.append(file.name)
        note_unread(unread, report)
        return {k: v for k, v in tables.items() if v is not None}, about
    head = start_of(path)
    if head.startswith(b"SQLite format 3\x00"):
        return _sqlite(path, report)
    if head.lstrip().startswith(b"["):
        return _json(path, report)
    table = _csv(path, report)
    name = path.stem if path.stem in READ else ""
    if not name:
        raise MarchaError(f"{path}: its name says no sensor; one of {', '.join(READ)}.csv")
    return ({name: table} if table is not None else {}), {}


def note_unread(names: Sequence[str], report: ReportBuilder) -> None:
    """Say which tables of an export no channel takes."""
    report.note("unused_file", f"{', '.join(names)}: not imported", count=len(names), subject=" ".join(names))


def _first_row(file: Path) -> dict[str, str]:
    try:
        rows = pl.read_csv(file, infer_schema=False, n_rows=1)
    except (OSError, pl.exceptions.PolarsError) as error:
        raise MarchaError(f"{file}: cannot be read: {str(error).splitlines()[0]}") from None
    return {k: v for k, v in rows.row(0, named=True).items() if v} if rows.height else {}


def _annotations(file: Path, report: ReportBuilder) -> SensorTable | None:
    """Read what people wrote: a text in quotes may go over several lines, which no table of numbers may."""
    header = require_header(file, is_header, _WANTED_TEXT)
    text = io.StringIO(read_small(file).decode("utf-8-sig", "replace"), newline="")
    reader = csv.reader(text, delimiter=header.separator)
    rows, lines = [], []
    try:
        for row in reader:
            if len(row) == len(header.names) and reader.line_num > header.line:
                rows.append(row)
                lines.append(reader.line_num)
            elif row and reader.line_num > header.line:
                detail = f"{file.name}: {len(row)} of {len(header.names)} columns; row dropped"
                report.drop("bad_row", detail, line=reader.line_num, subject=file.name)
    except csv.Error as error:
        raise MarchaError(f"{file}, line {reader.line_num}: {error}; repair the line") from None
    if not rows:
        return None
    kinds = {n: pl.Int64 if n == "time" else pl.String for n in header.names if n}
    cells = {n: [row[k] for row in rows] for k, n in enumerate(header.names) if n}
    frame = careful_block(
        pl.DataFrame({"line": lines, **cells}), {n: n for n in kinds}, kinds, "time", report
    )
    frame = frame.rename({"time": "t"})
    return SensorTable(frame, lambda report: iter([frame]), whole=True)


def _csv(file: Path, report: ReportBuilder) -> SensorTable | None:
    header = require_header(file, is_header, WANTED)
    texts = [n for n in header.names if n not in _NUMBERS]

    def frames(report: ReportBuilder) -> Iterator[pl.DataFrame]:
        with contextlib.suppress(NoRowError):  # said below
            for block in float_blocks(file, header, "time", report, integers=("time",), texts=texts):
                yield block.rename({"time": "t"})

    table = _opened(frames, report)
    if table is None:
        report.note("header_only", f"{file.name}: has a header and no row: no channel", subject=file.name)
    return table


def _opened(
    frames: Callable[[ReportBuilder], Iterator[pl.DataFrame]], report: ReportBuilder
) -> SensorTable | None:
    """Return a table with its first rows; None where it has none."""
    # What is found is said when all of it is read; a table without a row is read here.
    first = list(islice(frames(ReportBuilder()), HEAD_BLOCKS)) or list(frames(report))
    return SensorTable(pl.concat(first), frames, whole=len(first) < HEAD_BLOCKS) if first else None


def _numbers(
    rows: Sequence[Sequence[Any]], columns: Sequence[str], line: int, report: ReportBuilder
) -> pl.DataFrame:
    """Return cells of any type as numbers, what people wrote as text, ``time`` as ``t``; ``line``: the first."""
    kinds = {c: _kind(c) for c in columns if c in _READ_COLUMNS}
    frame = pl.DataFrame([_text(c, [row[k] for row in rows]) for k, c in enumerate(columns) if c in kinds])
    frame = frame.with_columns(line=pl.int_range(line, line + len(rows), dtype=pl.Int64))
    return careful_block(frame, {c: c for c in kinds}, kinds, "time", report).rename({"time": "t"})


def _kind(column: str) -> type[pl.DataType]:
    return pl.Int64 if column == "time" else pl.String if column in _TEXTS else pl.Float64


def _text(name: str, values: list[Any]) -> pl.Series:
    try:
        return pl.Series(name, values).cast(pl.String)
    except (TypeError, OverflowError, pl.exceptions.PolarsError):  # of several types
        return pl.Series(name, [None if v is None else str(v) for v in values], pl.String)


def _json(path: Path, report: ReportBuilder) -> tuple[Tables, dict[str, str]]:
    columns: dict[str, dict[str, None]] = {}
    about: dict[str, str] = {}
    for rows in _objects(path, dict[str, Any]):
        for row in rows:
            sensor = str(row.get("sensor", ""))
            if not row.keys() <= columns.setdefault(sensor, {}).keys():
                columns[sensor] |= dict.fromkeys(row)
            if sensor == "Metadata":
                about = about or {k: str(v) for k, v in row.items()}

    def frames(sensor: str, report: ReportBuilder) -> Iterator[pl.DataFrame]:
        names = [c for c in columns[sensor] if c in _READ_COLUMNS]
        row_type = msgspec.defstruct("Row", [("sensor", Any, ""), *((c, Any, None) for c in names)], gc=False)
        cells, line, waiting = attrgetter("sensor", *names), 1, []
        for rows in chain(_objects(path, row_type), [None]):
            waiting += [cells(row) for row in rows or () if row.sensor == sensor]
            if len(waiting) >= PIECE_ROWS or (rows is None and waiting):
                yield _numbers(waiting, ("sensor", *names), line, report)
                line += len(waiting)
                waiting = []

    note_unread([s for s in columns if s not in (*READ, "Metadata")], report)
    opened = {s: _opened(partial(frames, s), report) for s in columns if s in READ and "time" in columns[s]}
    return {s: table for s, table in opened.items() if table is not None}, about


def _objects(path: Path, row_type: Any) -> Iterator[list[Any]]:
    """Yield the objects of a JSON array, some thousand at a time.

    A piece ends where one object does and the next begins; where that is within an object, it is no whole JSON up to
    there, and more is read.
    """
    decoder = msgspec.json.Decoder(list[row_type])  # type: ignore[valid-type]
    rest, size, start = b"", BLOCK_BYTES, 0
    try:
        with path.open("rb") as file:
            while data := file.read(size):
                rest += data
                size = len(rest)
                ends = list(_BETWEEN_OBJECTS.finditer(rest, max(0, len(rest) - END_BYTES)))
                for end in ends[: -TRIES - 1 : -1]:
                    with contextlib.suppress(msgspec.DecodeError):
                        yield decoder.decode(rest[: end.start() + 1] + b"]")
                        start += end.end() - 1
                        rest, size = b"[" + rest[end.end() :], BLOCK_BYTES
                        break
            yield decoder.decode(rest)
    except (OSError, msgspec.MsgspecError) as error:
        raise MarchaError(f"{path}: not a whole JSON of Sensor Logger behind byte {start}: {error}") from None


def _sqlite(path: Path, report: ReportBuilder) -> tuple[Tables, dict[str, str]]:
    def pieces(query: str) -> Iterator[tuple[list[str], list[Any]]]:
        uri = f"{path.resolve().as_uri()}?mode=ro"
        try:
            with contextlib.closing(sqlite3.connect(uri, uri=True, check_same_thread=False)) as base:
                cursor = base.execute(query)
                columns = [c[0] for c in cursor.description]
                while rows := cursor.fetchmany(PIECE_ROWS):
                    yield columns, rows
        except sqlite3.Error as error:
            raise MarchaError(f"{path}: the database cannot be read: {error}") from None

    def frames(name: str, report: ReportBuilder) -> Iterator[pl.DataFrame]:
        line = 1
        for columns, rows in pieces(f'select * from "{name}"'):  # a name of READ: no foreign text
            if "time" in columns:
                yield _numbers(rows, columns, line, report)
            line += len(rows)

    tables: Tables = {}
    about: dict[str, str] = {}
    unread: list[str] = []
    listing = "select name from sqlite_master where type = 'table' and name not like 'sqlite_%'"
    names = [name for _, rows in pieces(listing) for (name,) in rows]
    for name in names:
        if name.lower() == "metadata":
            columns, rows = next(pieces(f'select * from "{name}"'), ([], []))
            about = {c: str(v) for c, v in zip(columns, rows[0], strict=True) if v} if rows else {}
        elif name not in READ:
            unread.append(name)
        elif (table := _opened(partial(frames, name), report)) is not None:
            tables[name] = table
    note_unread(unread, report)
    return tables, about


def heads_of(*tables: SensorTable | None) -> list[pl.DataFrame | None]:
    """Return the first rows of tables, of the time that all of them cover."""
    ends = [int(t.head["t"].max()) for t in tables if t is not None and not t.whole]  # type: ignore[arg-type]
    return [
        None if t is None else t.head.filter(pl.col("t") <= min(ends)) if ends else t.head for t in tables
    ]
