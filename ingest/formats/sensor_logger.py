"""Sensor Logger: a zip or folder of CSV files, one JSON file, or one SQLite database.

``Accelerometer`` has no gravity: with it is ``TotalAcceleration`` (Android) or the sum with ``Gravity``. On iOS
acceleration and gravity have the opposite sign unless "Standardise Units & Frames" was on; ``Metadata`` says both.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal, NamedTuple

import msgspec
import numpy as np
import polars as pl

from ...recording.codec import MAX_TIME_NS
from ..checks import STANDARD_GRAVITY
from ..columns import find_header
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
from ..sensortables import (
    ANNOTATION,
    PRESS,
    TRIPLES,
    SensorTable,
    Tables,
    files_of,
    heads_of,
    is_header,
    note_unread,
    read_tables,
)
from ..text import start_of

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

_XYZ = ("x", "y", "z")
_Q = ("qw", "qx", "qy", "qz")
_AGREES_RAD, _CLEARER_RAD = np.radians(20.0), np.radians(60.0)
"""An orientation is believed whose vertical lies as near to the measured force, in the median; and the other
platform's north where it is so much nearer to the field, which iron in the phone turns."""
_NEAR_DIP_RAD = np.radians(30.0)
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
            folders = {p.parent for p in files_of(path) if find_header(start_of(p), is_header)}
            return 0.92 if len(folders) == 1 else 0.0  # several folders are several recordings
        if head.startswith(b"SQLite format 3\x00"):
            return 0.9 if b"seconds_elapsed" in head else 0.0
        if head.lstrip().startswith(b"["):
            return 0.9 if b'"seconds_elapsed"' in head and b'"sensor"' in head else 0.0
        return 0.9 if find_header(head, is_header) else 0.0

    def chief(self, path: Path) -> Path:
        """Return the folder of a table: a recording is all of its tables."""
        return path.parent if path.suffix.lower() == ".csv" else path

    def read(self, paths: Sequence[Path], options: SensorLoggerOptions) -> Import:
        """Read a folder or a file."""
        path = paths[0]
        report = ReportBuilder()
        attachments: list[SourceAttachment] = []
        tables, about = read_tables(path, report)
        platform, turned = _platform(options, about, tables, report)
        marks = tables.pop(ANNOTATION, None)
        streams, others = _streams(tables, turned, platform, report, attachments)
        return Import(
            channels=declared(s for s, _ in streams),
            blocks=_blocks(path, streams, others, report),
            report=report,
            attachments=attachments,
            annotations=None if marks is None else _annotations(marks, report),
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


def _annotations(table: SensorTable, report: ReportBuilder) -> pl.DataFrame:
    """Return what the user wrote while the app recorded, each at its instant.

    How long the button was pressed is not how long the text holds: it stays a fact beside it.
    """
    rows = pl.concat(table.frames(report))
    possible = rows["t"].is_between(0, MAX_TIME_NS)
    if not possible.all():
        report.drop(
            "bad_row",
            f"{ANNOTATION}: time is not between 1970 and 2038; row dropped",
            count=int((~possible).sum()),
            line=rows.filter(~possible)["line"][0],
            subject=ANNOTATION,
        )
        rows = rows.filter(possible)
    report.keep(rows.height)
    return rows.select(
        tier=pl.lit("events"),
        start_ns="t",
        end_ns="t",
        label=pl.col("text").fill_null("") if "text" in rows.columns else pl.lit(""),
        source=pl.lit("human"),
        metadata=pl.struct(PRESS) if PRESS in rows.columns else pl.lit("{}"),
    )


def _platform(
    options: SensorLoggerOptions, about: dict[str, str], tables: Tables, report: ReportBuilder
) -> tuple[str, bool]:
    """Return the platform, and whether acceleration and gravity have iOS's sign."""
    platform = options.platform or about.get("platform", "").lower()
    standard = options.standardised
    if standard is None:
        standard = about.get("standardisation", "").lower() in ("true", "1", "yes")
    if platform in ("android", "ios"):
        return platform, platform == "ios" and not standard
    turned = _turned_by_field(tables)
    how = {
        None: "Android is taken; set platform=ios and standardised",
        False: "the magnetic field there and gravity have Android's signs",
        True: "the magnetic field there and gravity have iOS's signs",
    }[turned]
    report.note(
        "assumed_platform", f"no metadata say whether this is Android or iOS, whose signs differ: {how}"
    )
    return ("ios", True) if turned else ("android", False)


def _turned_by_field(tables: Tables) -> bool | None:
    """Return whether gravity has iOS's sign, by the dip of the field at the first fix; None if it cannot tell."""
    gravity = tables.get("Gravity", tables.get("TotalAcceleration"))
    fixes = tables.get("LocationGps", tables.get("Location"))
    if gravity is None or fixes is None or not {"latitude", "longitude"} <= set(fixes.head.columns):
        return None
    places = fixes.head.filter(pl.col("latitude").abs() <= 90, pl.col("longitude").abs() <= 180)
    forces, fields = heads_of(gravity, tables.get("Magnetometer"))
    assert forces is not None
    field = _beside(fields, forces)
    if field is None or not places.height or not set(_XYZ) <= set(forces.columns):
        return None
    from ..simulate.phone_world import earth_field

    there = earth_field(places["latitude"][0], places["longitude"][0], 0.0, places["t"][0])
    expected = math.asin(there[2] / float(np.linalg.norm(there)))
    up = forces.select(_XYZ).to_numpy()
    size = np.linalg.norm(up, axis=1) * np.linalg.norm(field, axis=1)
    good = np.isfinite(size) & (size > 0)
    if not good.any():
        return None
    dip = math.asin(float(np.median((up * field).sum(axis=1)[good] / size[good])))
    if abs(dip - expected) < _NEAR_DIP_RAD < abs(dip + expected):
        return False
    return True if abs(dip + expected) < _NEAR_DIP_RAD < abs(dip - expected) else None


def _streams(
    tables: Tables,
    turned: bool,
    platform: str,
    report: ReportBuilder,
    attachments: list[SourceAttachment],
) -> tuple[list[tuple[Stream, SensorTable]], Tables]:
    """Return the streams and what each is read from, and the tables of which none is made."""
    sign = -1.0 if turned else 1.0
    for name in [n for n in TRIPLES if n in tables and not set(_XYZ) <= set(tables[n].head.columns)]:
        rows = sum(frame.height for frame in tables.pop(name).frames(report))
        report.drop("missing_column", f"{name}: not all of the columns x, y, z; left out", count=rows)
    left = dict(tables)
    streams: list[tuple[Stream, SensorTable]] = []

    def add(part: StreamChannel, subject: str, table: SensorTable, *, even: bool = True) -> None:
        stream = Stream([part], report, subject=subject, even=even, attachments=attachments)
        streams.append((stream, table))

    how, acc = _acceleration(left, turned)
    if acc is not None:
        add(imu_part("/phone/acc", xyz(ACC, _XYZ), gravity=how), "acceleration", acc)
    elif "Accelerometer" in tables:
        report.loss(
            "gravity_free",
            "Accelerometer has no gravity and neither Gravity nor TotalAcceleration was recorded: no attitude from it",
        )
        part = StreamChannel(
            "/phone/linear_acc", VALUES, xyz(ACC, _XYZ, sign), ACC, metadata={"gravity": "removed"}
        )
        add(part, "Accelerometer", left.pop("Accelerometer"))
    for sensor in ("Gyroscope", "Magnetometer"):
        name = next((n for n in (sensor, f"{sensor}Uncalibrated") if n in tables), None)
        if name is not None:
            part = (
                imu_part("/phone/gyr", xyz(GYR, _XYZ), source=name)
                if sensor == "Gyroscope"
                else StreamChannel("/phone/mag", MAG, xyz(FIELD, _XYZ, MICROTESLA), metadata={"source": name})
            )
            add(part, name, left.pop(name))
    name = next((n for n in ("LocationGps", "Location") if n in tables), None)
    if name is not None:
        wanted = {
            "lat": "latitude", "lon": "longitude", "alt": "altitude",
            "accuracy": "horizontalAccuracy", "vertical": "verticalAccuracy", "speed": "speed", "course": "bearing",
        }  # fmt: skip
        columns = {k: v for k, v in wanted.items() if v in tables[name].head.columns}
        if "lat" in columns and "lon" in columns:
            add(fix_part(columns), name, left.pop(name), even=False)
    if "Barometer" in tables and "pressure" in tables["Barometer"].head.columns:
        part = StreamChannel(
            "/phone/pressure", PRESSURE, {"pressure_pa": SourceColumn("pressure", HECTOPASCAL)}
        )
        add(part, "Barometer", left.pop("Barometer"), even=False)
    if "Pedometer" in tables and "steps" in tables["Pedometer"].head.columns:
        part = StreamChannel("/phone/steps", VALUES, {"steps": SourceColumn("steps", 1.0)}, ("steps",))
        add(part, "Pedometer", left.pop("Pedometer"), even=False)
    judged, turn = _orientation(tables, acc, platform)
    if judged:
        table = left.pop("Orientation")
        if turn is None:
            report.loss(
                "odd_orientation",
                "Orientation: its vertical is not that of the acceleration, turned either way: left out",
                count=sum(len(_quaternions(frame)[1]) for frame in table.frames(report)),
            )
        else:
            north = "true" if platform == "ios" else "magnetic"
            part = StreamChannel(
                "/phone/orientation",
                QUATERNION,
                {q: SourceColumn(q, 1.0) for q in QUAT},
                metadata={"north": north},
            )
            add(part, "Orientation", table.each(turn.frame))
    return streams, left


class _Turn(NamedTuple):
    """What takes a quaternion of the app to ``rot_nb`` (n: east, north, up)."""

    inverse: bool
    north: bool
    """Whether its n has x north."""

    def apply(self, values: np.ndarray) -> Rotation:
        """Return rotations (n,) of quaternions x, y, z, w (n, 4)."""
        from scipy.spatial.transform import Rotation

        turn = Rotation.from_quat(values)
        turn = turn.inv() if self.inverse else turn
        return Rotation.from_euler("z", 90, degrees=True) * turn if self.north else turn

    def frame(self, rows: pl.DataFrame) -> pl.DataFrame:
        """Return ``t``, ``line`` and the quaternion of the rows that have one."""
        rows, values = _quaternions(rows)
        x, y, z, w = self.apply(values).as_quat(canonical=True).T if len(values) else np.empty((4, 0))
        made = dict(zip(QUAT, (w, x, y, z), strict=True))
        return rows.select("t", "line").with_columns(pl.Series(k, v) for k, v in made.items())


def _quaternions(rows: pl.DataFrame) -> tuple[pl.DataFrame, np.ndarray]:
    """Return the rows that have a quaternion, and those as x, y, z, w (n, 4)."""
    values = rows.select(_Q[1:] + _Q[:1]).to_numpy()
    good = np.isfinite(values).all(axis=1) & (np.linalg.norm(values, axis=1) > 0.1)
    return rows.filter(pl.Series(good)), values[good]


def _orientation(tables: Tables, acc: SensorTable | None, platform: str) -> tuple[bool, _Turn | None]:
    """Return whether the phone's own orientation can be judged, and how it is turned; None where it is wrong.

    The quaternion takes b to n or back, and its n has x east (Android) or north (iOS): of these the one is taken whose
    vertical is the measured force and whose north is the measured field; without a field, the platform's. The first
    rows are looked at.
    """
    table = tables.get("Orientation")
    if table is None or acc is None or any(q not in table.head.columns for q in _Q):
        return False, None
    rows, forces, fields = heads_of(table, acc, tables.get("Magnetometer"))
    assert rows is not None
    rows, values = _quaternions(rows)
    force, field = _beside(forces, rows), _beside(fields, rows)
    if not len(values) or force is None:
        return False, None
    best: tuple[float, _Turn] | None = None
    ios = platform == "ios"
    for inverse, north in ((False, ios), (True, ios), (False, not ios), (True, not ios)):
        turn = _Turn(inverse, north)
        rot = turn.apply(values)
        up = rot.apply(force)[:, 2] / np.linalg.norm(force, axis=1)
        tilt = float(np.nanmedian(np.arccos(np.clip(up, -1, 1))))
        aside = 0.0
        if field is not None:
            east, ahead = rot.apply(field)[:, :2].mean(axis=0)
            aside = abs(math.atan2(east, ahead))
        if tilt <= _AGREES_RAD and (best is None or aside < best[0] - _CLEARER_RAD):
            best = aside, turn
    return True, None if best is None else best[1]


def _beside(table: pl.DataFrame | None, times: pl.DataFrame) -> np.ndarray | None:
    """Return the three axes of ``table`` at the times of another one, shape (n, 3)."""
    if table is None or not table.height or not set(_XYZ) <= set(table.columns):
        return None
    table = table.sort("t")
    return np.column_stack(
        [np.interp(times["t"].to_numpy(), table["t"].to_numpy(), table[a].to_numpy()) for a in _XYZ]
    )


def _acceleration(left: Tables, turned: bool) -> tuple[str, SensorTable | None]:
    """Return how the acceleration with gravity came about and itself, in Android's sign; its tables leave ``left``."""
    sign = -1.0 if turned else 1.0
    if "TotalAcceleration" in left:
        return "included", _scaled(left.pop("TotalAcceleration"), sign)
    if "Accelerometer" in left and "Gravity" in left and left["Gravity"].head.height:
        acc, gravity = left.pop("Accelerometer"), left.pop("Gravity")
        head, more = heads_of(acc, gravity)
        assert head is not None
        assert more is not None
        summed = SensorTable(
            pl.concat(_with_gravity([head], [more], ReportBuilder())),
            lambda report: _with_gravity(acc.frames(report), gravity.frames(report), report),
            whole=acc.whole and gravity.whole,
        )
        return "Accelerometer + Gravity at the accelerometer's times", _scaled(summed, sign)
    if "AccelerometerUncalibrated" in left:
        factor = -STANDARD_GRAVITY if turned else 1.0
        return "included (uncalibrated)", _scaled(left.pop("AccelerometerUncalibrated"), factor)
    return "", None


def _with_gravity(
    acc: Iterable[pl.DataFrame], gravity: Iterable[pl.DataFrame], report: ReportBuilder
) -> Iterator[pl.DataFrame]:
    """Yield accelerations with gravity at their times, both read in pieces.

    A piece of gravity more than needed is held on either side: times may step back a little.
    """
    pieces, near = iter(gravity), list[pl.DataFrame]()

    def pull() -> bool:
        piece = next(pieces, None)
        if piece is not None:
            report.keep(piece.height)  # its rows are in the sums
            near.append(piece)
        return piece is not None

    for frame in acc:
        if not frame.height:
            yield frame.select("t", "line", *_XYZ)
            continue
        t = frame["t"].to_numpy()
        while (not near or near[-1]["t"].to_numpy().min() <= t.max()) and pull():
            pass
        while len(near) > 2 and near[1]["t"].to_numpy().max() < t.min():
            near.pop(0)
        beside = _beside(pl.concat(near), frame)
        assert beside is not None
        yield frame.select("t", "line", *(pl.col(a) + pl.Series(beside[:, k]) for k, a in enumerate(_XYZ)))
    while pull():
        near.pop()


def _scaled(table: SensorTable, factor: float) -> SensorTable:
    return table.each(lambda frame: frame.with_columns(pl.col(_XYZ) * factor))


def _blocks(
    path: Path,
    streams: Sequence[tuple[Stream, SensorTable]],
    others: Tables,
    report: ReportBuilder,
) -> Iterator[tuple[str, pl.DataFrame]]:
    for stream, table in streams:
        yield from stream.pull(table.frames(report))
    for table in others.values():  # for what is wrong with them
        for _ in table.frames(report):
            pass
    note_unread(list(others), report)
    require_rows(path, [s for s, _ in streams])
