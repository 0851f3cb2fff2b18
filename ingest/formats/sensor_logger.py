"""Sensor Logger: a zip or folder of CSV files, one JSON file, or one SQLite database.

``Accelerometer`` has no gravity: with it is ``TotalAcceleration`` (Android) or the sum with ``Gravity``. On iOS
acceleration and gravity have the opposite sign unless "Standardise Units & Frames" was on; ``Metadata`` says both.
"""

from __future__ import annotations

import contextlib
import math
import sqlite3
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import msgspec
import numpy as np
import polars as pl

from ...recording.errors import MarchaError
from ..checks import STANDARD_GRAVITY
from ..columns import find_header, float_blocks, require_header
from ..contract import CommonOptions, Import, ReportBuilder, SourceAttachment
from ..phonelog import (
    ACC,
    AXES,
    FIELD,
    GYR,
    HECTOPASCAL,
    MAG,
    MICROTESLA,
    PRESSURE,
    QUAT,
    QUATERNION,
    VALUES,
    SourceColumn,
    Stream,
    StreamChannel,
    declared,
    fix_part,
    imu_part,
    require_rows,
    xyz,
)
from ..text import start_of

WANTED = "time,seconds_elapsed,z,y,x"
READ = (
    "Accelerometer", "TotalAcceleration", "Gravity", "AccelerometerUncalibrated", "Gyroscope",
    "GyroscopeUncalibrated", "Magnetometer", "MagnetometerUncalibrated", "Location", "LocationGps", "Barometer",
    "Pedometer", "Orientation",
)  # fmt: skip
_TRIPLES = READ[:8]
"""Tables of three axes."""
_TEXT = ("sensor", "name", "text", "standardisation")
_NUMBERS = {
    "time", "seconds_elapsed", "x", "y", "z", "latitude", "longitude", "altitude", "horizontalAccuracy",
    "verticalAccuracy", "speed", "bearing", "pressure", "steps", "qw", "qx", "qy", "qz",
}  # fmt: skip
"""Columns that are read; others may be text, as the times for people that the app writes if told to."""
_Q = ("qw", "qx", "qy", "qz")
_AGREES, _CLEARER = np.radians(20.0), np.radians(60.0)
"""An orientation is believed whose vertical lies as near to the measured force, in the median; and the other
platform's north where it is so much nearer to the field, which iron in the phone turns."""
_NEAR_DIP = np.radians(30.0)
"""So near must the measured dip of the field be to the one that the place has, and so far that of the other sign."""


class SensorLoggerOptions(CommonOptions, frozen=True, kw_only=True):
    """What the export does not say where its metadata are missing.

    Attributes
    ----------
    platform : str or None
        ``android`` or ``ios``.
    standardised : bool or None
        Whether "Standardise Units & Frames" was on.
    """

    platform: Annotated[
        Literal["android", "ios"] | None, msgspec.Meta(description="platform, where no metadata say it")
    ] = None
    standardised: Annotated[
        bool | None, msgspec.Meta(description="Standardise Units & Frames was on, where no metadata say it")
    ] = None


class SensorLogger:
    """Importer ``sensor-logger``: ``/phone/acc``, ``/phone/gyr``, ``/phone/mag``, ``/phone/gnss`` …"""

    name: ClassVar[str] = "sensor-logger"
    title: ClassVar[str] = "Sensor Logger: zip or folder of CSV, JSON, SQLite; Android and iOS"
    Options = SensorLoggerOptions

    def sniff(self, head: bytes, path: Path) -> float:
        """Its columns, keys or tables."""
        if path.is_dir():
            folders = {p.parent for p in _files(path) if find_header(start_of(p), _is_header)}
            return 0.92 if len(folders) == 1 else 0.0  # several folders are several recordings
        if head.startswith(b"SQLite format 3\x00"):
            return 0.9 if b"seconds_elapsed" in head else 0.0
        if head.lstrip().startswith(b"["):
            return 0.9 if b'"seconds_elapsed"' in head and b'"sensor"' in head else 0.0
        return 0.9 if find_header(head, _is_header) else 0.0

    def chief(self, path: Path) -> Path:
        """Return the folder of a table: a recording is all of its tables."""
        return path.parent if path.suffix.lower() == ".csv" else path

    def read(self, paths: Sequence[Path], options: SensorLoggerOptions) -> Import:
        """Read a folder or a file."""
        path = paths[0]
        report = ReportBuilder()
        attachments: list[SourceAttachment] = []
        tables, about = _tables(path, report)
        platform = options.platform or about.get("platform", "").lower()
        stated = about.get("standardisation", "").lower()
        standard = (
            options.standardised if options.standardised is not None else stated in ("true", "1", "yes")
        )
        turned = platform == "ios" and not standard
        if platform not in ("android", "ios"):
            seen = _turned_by_field(tables)
            turned = bool(seen)
            platform = "ios" if turned else "android"
            report.note(
                "assumed_platform",
                "no metadata say whether this is Android or iOS, whose signs differ: "
                + (
                    f"{'Android' if platform == 'android' else 'iOS'} is taken; set platform=ios and standardised"
                    if seen is None
                    else f"the magnetic field there and gravity have {'iOS' if turned else 'Android'}'s signs"
                ),
            )
        streams = list(_streams(path, tables, turned, platform, report, attachments))
        return Import(
            channels=declared(s for s, _ in streams),
            blocks=_blocks(path, streams),
            report=report,
            attachments=attachments,
            metadata={
                "device": {
                    "clock": "utc",
                    "time": "nanoseconds since 1970",
                    "name": "Sensor Logger",
                    "platform": platform,
                    "frames": AXES,
                    "converted": ("sign of acceleration and gravity turned (iOS); " if turned else "")
                    + "gravity added to the accelerometer where the app took it out; field from µT, pressure from hPa",
                    **{
                        k: about[v]
                        for k, v in (("phone", "device name"), ("app_version", "appVersion"))
                        if v in about
                    },
                }
            },
        )


def _turned_by_field(tables: dict[str, pl.DataFrame]) -> bool | None:
    """Return whether gravity has iOS's sign, by the dip of the field at the first fix; None if it cannot tell."""
    gravity = tables.get("Gravity", tables.get("TotalAcceleration"))
    fixes = tables.get("LocationGps", tables.get("Location"))
    if gravity is None or fixes is None or not {"latitude", "longitude"} <= set(fixes.columns):
        return None
    fixes = fixes.filter(pl.col("latitude").abs() <= 90, pl.col("longitude").abs() <= 180)
    field = _beside(tables.get("Magnetometer"), gravity)
    if field is None or not fixes.height or not set("xyz") <= set(gravity.columns):
        return None
    from ..simulate.phone_world import earth_field

    there = earth_field(fixes["latitude"][0], fixes["longitude"][0], 0.0, fixes["t"][0])
    expected = math.asin(there[2] / float(np.linalg.norm(there)))
    up = gravity.select("x", "y", "z").to_numpy()
    size = np.linalg.norm(up, axis=1) * np.linalg.norm(field, axis=1)
    good = np.isfinite(size) & (size > 0)
    if not good.any():
        return None
    dip = math.asin(float(np.median((up * field).sum(axis=1)[good] / size[good])))
    if abs(dip - expected) < _NEAR_DIP < abs(dip + expected):
        return False
    return True if abs(dip + expected) < _NEAR_DIP < abs(dip - expected) else None


def _files(folder: Path) -> list[Path]:
    return sorted(p for p in (*folder.glob("*.csv"), *folder.glob("*/*.csv")) if p.is_file())


def _is_header(cells: Sequence[str]) -> bool:
    return "time" in cells and "seconds_elapsed" in cells


def _tables(path: Path, report: ReportBuilder) -> tuple[dict[str, pl.DataFrame], dict[str, str]]:
    """Return what is read: a table a sensor (``t`` ns, ``line``, numbers), and the metadata."""
    if path.is_dir():
        files, about = _files(path), {}
        for file in files:
            if file.stem.lower() == "metadata":
                about = _first_row(file)
        tables = {f.stem: _csv(f, report) for f in files if f.stem in READ}
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


def _first_row(file: Path) -> dict[str, str]:
    try:
        rows = pl.read_csv(file, infer_schema=False, n_rows=1)
    except (OSError, pl.exceptions.PolarsError) as error:
        raise MarchaError(f"{file}: cannot be read: {str(error).splitlines()[0]}") from None
    return {k: v for k, v in rows.row(0, named=True).items() if v} if rows.height else {}


def _csv(file: Path, report: ReportBuilder) -> pl.DataFrame | None:
    header = require_header(file, _is_header, WANTED)
    try:
        texts = [n for n in header.names if n not in _NUMBERS]
        blocks = list(float_blocks(file, header, "time", report, integers=("time",), texts=texts))
    except MarchaError as error:
        if "ends before its first row" not in str(error):
            raise
        blocks = []
    if not blocks:
        report.note("header_only", f"{file.name}: has a header and no row: no channel", subject=file.name)
        return None
    return pl.concat(blocks).rename({"time": "t"})


def _numbers(rows: pl.DataFrame) -> pl.DataFrame:
    """Return a table of text as numbers; ``time`` whole."""
    t = rows["time"].cast(pl.String).cast(pl.Int64, strict=False)
    others = [c for c in rows.columns if c not in ("time", *_TEXT)]
    table = rows.select(
        pl.col(c).cast(pl.String).cast(pl.Float64, strict=False).fill_null(np.nan) for c in others
    )
    line = pl.Series("line", np.arange(1, rows.height + 1))
    return table.with_columns(t=t, line=line).drop_nulls("t")


def _json(path: Path) -> tuple[dict[str, pl.DataFrame], dict[str, str]]:
    try:
        rows = msgspec.json.decode(path.read_bytes(), type=list[dict[str, Any]])
    except (OSError, msgspec.MsgspecError) as error:
        raise MarchaError(f"{path}: not a whole JSON of Sensor Logger: {error}") from None
    by_sensor: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        by_sensor.setdefault(str(row.get("sensor", "")), []).append(row)
    about = {k: str(v) for k, v in (by_sensor.get("Metadata") or [{}])[0].items()}
    tables = {k: pl.DataFrame(v, infer_schema_length=None) for k, v in by_sensor.items() if k in READ}
    return {k: _numbers(v) for k, v in tables.items() if "time" in v.columns}, about


def _sqlite(path: Path) -> tuple[dict[str, pl.DataFrame], dict[str, str]]:
    tables: dict[str, pl.DataFrame] = {}
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
                    tables[name] = _numbers(pl.DataFrame(data, schema=dict.fromkeys(columns, pl.String)))
    except sqlite3.Error as error:
        raise MarchaError(f"{path}: the database cannot be read: {error}") from None
    return tables, about


def _streams(
    path: Path,
    tables: dict[str, pl.DataFrame],
    turned: bool,
    platform: str,
    report: ReportBuilder,
    attachments: list[SourceAttachment],
) -> Iterator[tuple[Stream, pl.DataFrame]]:
    axes = ("x", "y", "z")
    sign = -1.0 if turned else 1.0
    for name in [n for n in _TRIPLES if n in tables and not set(axes) <= set(tables[n].columns)]:
        rows = tables.pop(name).height
        report.drop("missing_column", f"{name}: not all of the columns x, y, z; left out", count=rows)
    acc = _acceleration(tables, turned, report)
    if acc is not None:
        how, frame = acc
        yield (
            Stream([imu_part("/phone/acc", xyz(ACC, axes), gravity=how)], report, subject="acceleration"),
            frame,
        )
    elif "Accelerometer" in tables:
        report.loss(
            "gravity_free",
            "Accelerometer has no gravity and neither Gravity nor TotalAcceleration was recorded: no attitude from it",
        )
        part = StreamChannel(
            "/phone/linear_acc", VALUES, xyz(ACC, axes, sign), ACC, metadata={"gravity": "removed"}
        )
        yield Stream([part], report, subject="Accelerometer"), tables["Accelerometer"]
    for topic, names in (("/phone/gyr", "Gyroscope"), ("/phone/mag", "Magnetometer")):
        name = next((n for n in (names, f"{names}Uncalibrated") if n in tables), None)
        if name is not None and all(a in tables[name].columns for a in axes):
            part = (
                imu_part(topic, xyz(GYR, axes), source=name)
                if names == "Gyroscope"
                else StreamChannel(topic, MAG, xyz(FIELD, axes, MICROTESLA), metadata={"source": name})
            )
            yield Stream([part], report, subject=name), tables[name]
    name = next((n for n in ("LocationGps", "Location") if n in tables), None)
    if name is not None:
        wanted = {
            "lat": "latitude", "lon": "longitude", "alt": "altitude",
            "accuracy": "horizontalAccuracy", "vertical": "verticalAccuracy", "speed": "speed", "course": "bearing",
        }  # fmt: skip
        columns = {k: v for k, v in wanted.items() if v in tables[name].columns}
        if "lat" in columns and "lon" in columns:
            fixes = Stream([fix_part(columns)], report, subject=name, even=False, attachments=attachments)
            yield fixes, tables[name]
    if "Barometer" in tables and "pressure" in tables["Barometer"].columns:
        part = StreamChannel(
            "/phone/pressure", PRESSURE, {"pressure_pa": SourceColumn("pressure", HECTOPASCAL)}
        )
        yield Stream([part], report, subject="Barometer", even=False), tables["Barometer"]
    if "Pedometer" in tables and "steps" in tables["Pedometer"].columns:
        part = StreamChannel("/phone/steps", VALUES, {"steps": SourceColumn("steps", 1.0)}, ("steps",))
        yield Stream([part], report, subject="Pedometer", even=False), tables["Pedometer"]

    oriented = _orientation(tables, acc[1] if acc is not None else None, platform, report)
    if oriented is not None:
        north, frame = oriented
        part = StreamChannel(
            "/phone/orientation",
            QUATERNION,
            {q: SourceColumn(q, 1.0) for q in QUAT},
            metadata={"north": north},
        )
        yield Stream([part], report, subject="Orientation"), frame


def _orientation(
    tables: dict[str, pl.DataFrame], acc: pl.DataFrame | None, platform: str, report: ReportBuilder
) -> tuple[str, pl.DataFrame] | None:
    """Return the phone's own orientation as ``rot_nb`` (n: east, north, up), and which north it has.

    The quaternion takes b to n or back, and its n has x east (Android) or north (iOS): of these the one is taken whose
    vertical is the measured force and whose north is the measured field; without a field, the platform's.
    """
    table = tables.get("Orientation")
    if table is None or not table.height or acc is None or not acc.height:
        return None
    if any(q not in table.columns for q in _Q):
        return None
    values = table.select(_Q[1:] + _Q[:1]).to_numpy()
    good = np.isfinite(values).all(axis=1) & (np.linalg.norm(values, axis=1) > 0.1)
    table, values = table.filter(pl.Series(good)), values[good]
    if not len(values):
        return None
    from scipy.spatial.transform import Rotation

    to_east = Rotation.from_euler("z", 90, degrees=True)
    force, field = _beside(acc, table), _beside(tables.get("Magnetometer"), table)
    if force is None:
        return None
    best: tuple[tuple[float, float], Any] | None = None
    ios = platform == "ios"
    for inverse, north in ((False, ios), (True, ios), (False, not ios), (True, not ios)):
        turn = Rotation.from_quat(values)
        turn = turn.inv() if inverse else turn
        turn = to_east * turn if north else turn
        up = turn.apply(force)[:, 2] / np.linalg.norm(force, axis=1)
        tilt = float(np.nanmedian(np.arccos(np.clip(up, -1, 1))))
        aside = 0.0
        if field is not None:
            east, ahead = turn.apply(field)[:, :2].mean(axis=0)
            aside = abs(math.atan2(east, ahead))
        if tilt <= _AGREES and (best is None or aside < best[0][1] - _CLEARER):
            best = (tilt, aside), turn
    if best is None:
        report.loss(
            "odd_orientation",
            "Orientation: its vertical is not that of the acceleration, turned either way: left out",
            count=len(values),
        )
        return None
    x, y, z, w = best[1].as_quat(canonical=True).T
    made = dict(zip(QUAT, (w, x, y, z), strict=True))
    frame = table.select("t", "line").with_columns(pl.Series(k, v) for k, v in made.items())
    return "true" if platform == "ios" else "magnetic", frame


def _beside(table: pl.DataFrame | None, times: pl.DataFrame) -> np.ndarray | None:
    """Return the three axes of ``table`` at the times of another one, shape (n, 3)."""
    if table is None or not table.height or any(a not in table.columns for a in "xyz"):
        return None
    table = table.sort("t")
    return np.column_stack(
        [np.interp(times["t"].to_numpy(), table["t"].to_numpy(), table[a].to_numpy()) for a in "xyz"]
    )


def _acceleration(
    tables: dict[str, pl.DataFrame], turned: bool, report: ReportBuilder
) -> tuple[str, pl.DataFrame] | None:
    """Return the acceleration with gravity in Android's sign, and how it came about."""
    sign = -1.0 if turned else 1.0
    if "TotalAcceleration" in tables:
        return "included", _scaled(tables["TotalAcceleration"], sign)
    if "Accelerometer" in tables and "Gravity" in tables and tables["Gravity"].height:
        acc, gravity = tables["Accelerometer"], tables["Gravity"].sort("t")
        summed = acc.select("t", "line").with_columns(
            pl.Series(
                a,
                acc[a].to_numpy()
                + np.interp(acc["t"].to_numpy(), gravity["t"].to_numpy(), gravity[a].to_numpy()),
            )
            for a in "xyz"
        )
        report.keep(gravity.height)  # its rows are in the sums
        return "Accelerometer + Gravity at the accelerometer's times", _scaled(summed, sign)
    if "AccelerometerUncalibrated" in tables:
        factor = -STANDARD_GRAVITY if turned else 1.0
        return "included (uncalibrated)", _scaled(tables["AccelerometerUncalibrated"], factor)
    return None


def _scaled(table: pl.DataFrame, factor: float) -> pl.DataFrame:
    return table.with_columns(pl.col(a) * factor for a in "xyz")


def _blocks(path: Path, streams: list[tuple[Stream, pl.DataFrame]]) -> Iterator[tuple[str, pl.DataFrame]]:
    for stream, frame in streams:
        yield from stream.pull([frame])
    require_rows(path, [s for s, _ in streams])
