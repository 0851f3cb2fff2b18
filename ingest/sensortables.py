"""Tables of Sensor Logger as its exports hold them: CSV files of a folder, one JSON file, one SQLite database.

CSV is read in pieces and never held; JSON and SQLite are.
"""

from __future__ import annotations

import contextlib
import csv
import io
import sqlite3
from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
import polars as pl

from ..recording.errors import MarchaError
from ..recording.files import read_small
from .cells import NoRowError
from .columns import careful_block, float_blocks, require_header
from .contract import ReportBuilder
from .text import start_of

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
"""Columns that stay text, as it is written."""
_NO_NUMBERS = ("sensor", "name", "standardisation")
_NUMBERS = {
    "time", "seconds_elapsed", "x", "y", "z", "latitude", "longitude", "altitude", "horizontalAccuracy",
    "verticalAccuracy", "speed", "bearing", "pressure", "steps", "qw", "qx", "qy", "qz",
}  # fmt: skip
"""Columns that are read; others may be text, as the times for people that the app writes if told to."""
HEAD_BLOCKS = 2
"""Pieces of a table that are read to find out how it is turned: 10 minutes and more at 100 Hz."""


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
        return _sqlite(path)
    if head.lstrip().startswith(b"["):
        return _json(path)
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
    return _held(frame.rename({"time": "t"}))


def _csv(file: Path, report: ReportBuilder) -> SensorTable | None:
    header = require_header(file, is_header, WANTED)
    texts = [n for n in header.names if n not in _NUMBERS]

    def frames(report: ReportBuilder) -> Iterator[pl.DataFrame]:
        with contextlib.suppress(NoRowError):  # said below
            for block in float_blocks(file, header, "time", report, integers=("time",), texts=texts):
                yield block.rename({"time": "t"})

    # What is found is said when all of it is read; a table without a row is read here.
    first = list(islice(frames(ReportBuilder()), HEAD_BLOCKS)) or list(frames(report))
    if not first:
        report.note("header_only", f"{file.name}: has a header and no row: no channel", subject=file.name)
        return None
    return SensorTable(pl.concat(first), frames, whole=len(first) < HEAD_BLOCKS)


def _numbers(rows: pl.DataFrame) -> pl.DataFrame:
    """Return a table of text as numbers, but for what people wrote; ``time`` whole."""
    t = rows["time"].cast(pl.String).cast(pl.Int64, strict=False)
    others = [c for c in rows.columns if c not in ("time", *_NO_NUMBERS)]
    table = rows.select(
        pl.col(c).cast(pl.String)
        if c in _TEXTS
        else pl.col(c).cast(pl.String).cast(pl.Float64, strict=False).fill_null(np.nan)
        for c in others
    )
    line = pl.Series("line", np.arange(1, rows.height + 1))
    return table.with_columns(t=t, line=line)


def _json(path: Path) -> tuple[Tables, dict[str, str]]:
    try:
        rows = msgspec.json.decode(path.read_bytes(), type=list[dict[str, Any]])
    except (OSError, msgspec.MsgspecError) as error:
        raise MarchaError(f"{path}: not a whole JSON of Sensor Logger: {error}") from None
    by_sensor: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        by_sensor.setdefault(str(row.get("sensor", "")), []).append(row)
    about = {k: str(v) for k, v in (by_sensor.get("Metadata") or [{}])[0].items()}
    tables = {k: pl.DataFrame(v, infer_schema_length=None) for k, v in by_sensor.items() if k in READ}
    return {k: _held(_numbers(v)) for k, v in tables.items() if "time" in v.columns}, about


def _sqlite(path: Path) -> tuple[Tables, dict[str, str]]:
    tables: Tables = {}
    about: dict[str, str] = {}
    try:
        with contextlib.closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)) as base:
            names = [r[0] for r in base.execute("select name from sqlite_master where type = 'table'")]
            for name in names:
                if name not in READ and name.lower() != "metadata":
                    continue
                cursor = base.execute(f'select * from "{name}"')  # a name of READ: no foreign text
                columns = [c[0] for c in cursor.description]
                rows = [[None if v is None else str(v) for v in row] for row in cursor]
                if name.lower() == "metadata":
                    about = {c: v for c, v in zip(columns, rows[0], strict=True) if v} if rows else {}
                elif rows and "time" in columns:
                    data = dict(zip(columns, map(list, zip(*rows, strict=True)), strict=True))
                    texts = pl.DataFrame(data, schema=dict.fromkeys(columns, pl.String))
                    tables[name] = _held(_numbers(texts))
    except sqlite3.Error as error:
        raise MarchaError(f"{path}: the database cannot be read: {error}") from None
    return tables, about


def _held(frame: pl.DataFrame) -> SensorTable:
    rows = frame.drop_nulls("t")

    def frames(report: ReportBuilder) -> Iterator[pl.DataFrame]:
        if timeless := frame.height - rows.height:
            report.drop("bad_row", "time: not a number; row dropped", count=timeless, subject="time")
        yield rows

    return SensorTable(rows, frames, whole=True)


def heads_of(*tables: SensorTable | None) -> list[pl.DataFrame | None]:
    """Return the first rows of tables, of the time that all of them cover."""
    ends = [int(t.head["t"].max()) for t in tables if t is not None and not t.whole]  # type: ignore[arg-type]
    return [
        None if t is None else t.head.filter(pl.col("t") <= min(ends)) if ends else t.head for t in tables
    ]
