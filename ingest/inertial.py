"""What the importers of headed inertial CSV share: units of the header, the stream from cells to channels."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import msgspec
import numpy as np
import polars as pl

from ..recording.errors import MarchaError, UsageError
from .checks import STANDARD_GRAVITY, SensorCheck
from .contract import ChannelSpec, ReportBuilder
from .leg import plain_name, renamed
from .timestamps import TimestampRepair
from .units import conversion

IMU = "sensor_msgs/msg/Imu"
MAG = "sensor_msgs/msg/MagneticField"
ACC = ("acc_x", "acc_y", "acc_z")
GYR = ("gyr_x", "gyr_y", "gyr_z")
FIELD = ("mag_x", "mag_y", "mag_z")

SI = {"acc": "m/s²", "gyr": "rad/s", "mag": "T", "t": "ns"}
"""Unit of the recording for each quantity of a header."""
FULL_SCALES = {
    "acc": ("g", STANDARD_GRAVITY, (2.0, 4.0, 5.0, 8.0, 10.0, 16.0, 24.0, 32.0)),
    "gyr": ("°/s", math.pi / 180, (125.0, 250.0, 500.0, 1000.0, 2000.0, 4000.0)),
}
"""Usual full scales of inertial sensors: unit, its SI value, the scales."""
PLATEAU_ROWS = 3
"""So many equal readings at the extreme are clipping, where it is near a full scale."""
PLATEAU_TOLERANCE = 0.03
"""How near: calibration moves the clipped value."""

_QUANTITIES = {"accelerometer": "acc", "gyroscope": "gyr", "magnetometer": "mag"}
_CELL = re.compile(r"(?P<what>[A-Za-z]+)(?: (?P<axis>[XYZ]))?(?: \((?P<unit>[^)]*)\))?")


Mirror = Annotated[
    Literal["x", "y", "none"],
    msgspec.Meta(description="axis of the reference that is negated to make its frame right-handed, z up"),
]
MIRRORS = {"x": (-1.0, 1.0, 1.0), "y": (1.0, -1.0, 1.0), "none": (1.0, 1.0, 1.0)}
"""Factors of a reference's x, y, z."""


class SourceColumn(NamedTuple):
    """Where a column comes from: the name in the header and the factor to SI."""

    name: str
    factor: float


def x_io_columns(path: Path, names: Sequence[str], line: int) -> dict[str, SourceColumn]:
    """Return the columns that x-io's headers name (``Gyroscope X (deg/s)``), and ``t`` of ``Time (s)``.

    A magnetometer in arbitrary units is none.

    Raises
    ------
    MarchaError
        The unit of an acceleration, angular rate or time is unknown.
    """
    columns: dict[str, SourceColumn] = {}
    for name in names:
        match = _CELL.fullmatch(name)
        if match is None:
            continue
        what = match["what"].lower()
        if what in ("time", "timestamp") and match["axis"] is None:
            quantity, column = "t", "t"
        elif what in _QUANTITIES and match["axis"]:
            quantity = _QUANTITIES[what]
            column = f"{quantity}_{match['axis'].lower()}"
        else:
            continue
        try:
            scale, _ = conversion(match["unit"] or "", SI[quantity])
        except UsageError as error:
            if quantity == "mag":  # arbitrary units (x-IMU3): no field strength, so it is left out
                continue
            raise MarchaError(
                f"{path}, line {line}: column {name!r}: {error}; or import it with --map"
            ) from None
        columns[column] = SourceColumn(name, scale)
    return columns


@dataclass(frozen=True)
class ChannelColumns:
    """Channels of a headed CSV: topic and schema, and the sources of the schema's columns."""

    topic: str
    schema: str
    columns: Mapping[str, SourceColumn]
    frame_id: str = "imu"
    metadata: Mapping[str, str] | None = None
    held: bool = False
    """Whether the device repeats an older reading until a new one comes: repeats are no measurements."""

    def spec(self) -> ChannelSpec:
        """Return the channel as an import declares it."""
        return ChannelSpec(self.topic, self.schema, self.frame_id, metadata=dict(self.metadata or {}))


def complete(columns: Mapping[str, SourceColumn], axes: Sequence[str]) -> dict[str, SourceColumn]:
    """Return the three axes of one sensor; empty where one is missing."""
    return {a: columns[a] for a in axes} if all(a in columns for a in axes) else {}


def note_unused(names: Sequence[str], used: Iterable[str], report: ReportBuilder, line: int) -> None:
    """Report the header's columns that become nothing."""
    taken = set(used)
    left = [n for n in names if n not in taken]
    if left:
        report.note("unused_column", f"{', '.join(left)}: not imported", count=len(left), line=line)


def note_mirror(mirror: Mirror, what: str, rows: int, report: ReportBuilder) -> None:
    """Report that an axis of the reference ``what`` was negated."""
    if mirror != "none":
        report.note(
            "mirrored_reference",
            f"{what} is mirrored against a right-handed z-up frame: {mirror} is negated in every row; "
            "mirror=none keeps it",
            count=rows,
            line=1,
        )


def one_file(paths: Sequence[Path], name: str) -> Path:
    """Return the only path.

    Raises
    ------
    UsageError
        There are several, or it is a folder.
    """
    if len(paths) != 1:
        raise UsageError(f"format {name} reads one file at a time, not {len(paths)}; convert them one by one")
    if paths[0].is_dir():
        raise UsageError(f"{paths[0]}: is a folder; format {name} reads one file")
    return paths[0]


def segments_of(paths: Sequence[Path], segments: str | None, report: ReportBuilder) -> list[str]:
    """Return the segment of each sensor's file: its name, or what ``segments`` says (:func:`.leg.renamed`).

    Several files are taken to be of one clock, which is reported (``one_clock``).
    """
    own = [plain_name(p.stem) for p in paths]
    if len(set(own)) < len(own):
        own = [plain_name(f"{p.parent.name}_{p.stem}") for p in paths]
    names = renamed(own, segments, paths[0])
    if len(paths) > 1:
        report.note(
            "one_clock",
            f"times of {', '.join(p.name for p in paths)} are taken to be of one clock; where each logger "
            "has its own, put them on one before",
        )
    return [names[name] for name in own]


def tables(
    path: Path,
    frames: Iterable[pl.DataFrame],
    plans: Sequence[ChannelColumns],
    clock: TimestampRepair,
    report: ReportBuilder,
    *,
    limits: Mapping[str, tuple[float, float, str]] | None = None,
) -> Iterator[tuple[str, pl.DataFrame]]:
    """Turn frames of cells into the tables of all plans, with every check on the way.

    Parameters
    ----------
    path : Path
        The source, for messages.
    frames : iterable of polars.DataFrame
        ``t`` (Int64, ticks of ``clock``), ``line``, and the cells under the header's names (Float64).
    plans : sequence of ChannelColumns
        Channels to make; the Imu is the first.
    clock : TimestampRepair
        Repairs and stamps.
    report : ReportBuilder
        Takes what is found.
    limits : mapping, optional
        Full scales in SI units, see :class:`SensorCheck`.
    """
    imu = plans[0]
    if not imu.columns:
        raise MarchaError(
            f"{path}: neither an accelerometer nor a gyroscope with its three axes in the header"
        )
    axes = [a for a in (*ACC, *GYR) if a in imu.columns]
    check = SensorCheck(report, imu.topic, axes, limits=limits)
    plateau = None if limits else Plateau(report, imu.topic, axes)
    last: dict[str, pl.DataFrame] = {}
    empty: pl.DataFrame | None = None
    for frame, final in _with_end(frames):
        if frame is None:
            if empty is None:
                break
            frame = empty
        empty = frame.clear()
        frame = clock.feed(frame, final=final)
        if not frame.height:
            continue
        lines = frame["line"].to_numpy()
        _missing(frame, plans, report)
        si = {a: frame[imu.columns[a].name].to_numpy() * imu.columns[a].factor for a in axes}
        check.feed([si[a] for a in axes], lines)
        check.feed_si([si[a] for a in ACC if a in si], [si[a] for a in GYR if a in si], lines)
        if plateau is not None:
            plateau.feed([si[a] for a in axes], lines)
        for plan in plans:
            table = frame.select(
                "t_ns", *(pl.col(s.name).mul(s.factor).alias(c) for c, s in plan.columns.items())
            )
            if plan.held:
                table = _fresh(table, last, plan, report, lines)
            if table.height:
                yield plan.topic, table
    if not report.kept:
        raise MarchaError(f"{path}: no row of numbers behind its header; nothing to convert")
    check.finish()
    if plateau is not None:
        plateau.finish()


def _with_end(frames: Iterable[pl.DataFrame]) -> Iterator[tuple[pl.DataFrame | None, bool]]:
    for frame in frames:
        yield frame, False
    yield None, True


def _missing(frame: pl.DataFrame, plans: Sequence[ChannelColumns], report: ReportBuilder) -> None:
    for plan in plans:
        for source in plan.columns.values():
            gone = np.flatnonzero(np.isnan(frame[source.name].to_numpy()))
            if gone.size:
                report.loss(
                    "missing_cell",
                    f"{source.name}: no value; NaN in its place",
                    count=gone.size,
                    line=int(frame["line"][int(gone[0])]),
                    subject=source.name,
                )


def _fresh(
    table: pl.DataFrame,
    last: dict[str, pl.DataFrame],
    plan: ChannelColumns,
    report: ReportBuilder,
    lines: np.ndarray,
) -> pl.DataFrame:
    """Return the rows whose reading differs from the one before."""
    columns = list(plan.columns)
    before = last.get(plan.topic)
    values = table.select(columns).to_numpy()
    first = values[:1] + 1 if before is None else before.select(columns).to_numpy()
    same = (np.diff(values, axis=0, prepend=first) == 0).all(axis=1)
    last[plan.topic] = table[-1:]
    if same.any():
        report.note(
            "stale_repeat",
            f"{plan.topic}: the reading is repeated until the sensor has a new one: only its first row is "
            "a message",
            count=int(same.sum()),
            line=int(lines[np.argmax(same)]),
            subject=plan.topic,
        )
    return table.filter(pl.Series(~same))


class Plateau:
    """Finds clipping where the full scale is not known: an axis stands at an extreme near a usual full scale.

    Parameters
    ----------
    report : ReportBuilder
        Where findings go.
    subject : str
        Name of the sensor.
    axes : sequence of str
        ``acc_x`` … ``gyr_z``, in the order that is fed.
    """

    def __init__(self, report: ReportBuilder, subject: str, axes: Sequence[str]) -> None:
        self._report = report
        self._subject = subject
        self._axes = axes
        self._ends: dict[tuple[str, int], tuple[float, int, int]] = {}  # extreme, how often, first line

    def feed(self, values: Sequence[np.ndarray], lines: np.ndarray) -> None:
        """Look at a block in SI units: one array an axis, and each row's line."""
        for axis, v in zip(self._axes, values, strict=True):
            for sign in (1, -1):
                extreme = float(np.fmax.reduce(sign * v))
                before, count, line = self._ends.get((axis, sign), (-np.inf, 0, 0))
                if not extreme >= before:
                    continue
                extremes = np.flatnonzero(sign * v == extreme)
                count, line = (count, line) if extreme == before else (0, int(lines[extremes[0]]))
                self._ends[axis, sign] = (extreme, count + extremes.size, line)

    def finish(self) -> None:
        """Report ``clipped`` for every extreme that looks like a full scale."""
        for (axis, sign), (extreme, count, line) in self._ends.items():
            unit, one, scales = FULL_SCALES[axis[:3]]
            near = [s for s in scales if abs(extreme / one - s) <= PLATEAU_TOLERANCE * s]
            if count >= PLATEAU_ROWS and near:
                value = f"{sign * extreme / one:.4g} {unit}"
                self._report.loss(
                    "clipped",
                    f"{self._subject} {axis}: {count} readings stand at the extreme {value}, near a full "
                    f"scale of {near[0]:g} {unit}: the true value is beyond it",
                    count=count,
                    line=line,
                    subject=f"{self._subject} {axis} {sign}",
                )
