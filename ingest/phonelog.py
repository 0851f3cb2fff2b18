"""What the importers of phone logs share: a stream of rows becomes channels in one convention.

Whatever an app calls its axes, a recording has Android's: x to the right of the screen, y to its top, z out of
it; the accelerometer with gravity (+1 g on z at rest with the screen up), SI units, angles in rad, fixes with
standard deviations. What was converted stands in the metadata record ``device``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from ..recording.errors import MarchaError
from ..recording.rotations import QUAT
from .checks import SensorCheck, check_plausible
from .contract import ChannelSpec, ReportBuilder, SourceAttachment
from .fixes import finished_fixes, velocities, velocity_spec
from .inertial import ACC, GYR, IMU, MAG, Plateau, SourceColumn
from .inertial import FIELD as FIELD
from .radio import without_stale
from .timestamps import TimestampRepair, nanoseconds

FIX = "sensor_msgs/msg/NavSatFix"
PRESSURE = "sensor_msgs/msg/FluidPressure"
QUATERNION = "geometry_msgs/msg/QuaternionStamped"
VALUES = "marcha_msgs/msg/NamedValues"
RADIO = "marcha_msgs/msg/RadioSignal"
POINT = "geometry_msgs/msg/PointStamped"
STEP = "marcha_msgs/msg/Step"

AXES = (
    "Android: x right, y to the top of the phone, z out of the screen; accelerometer with gravity, +1 g on z "
    "at rest with the screen up"
)
MICROTESLA, HECTOPASCAL = 1e-6, 100.0
NO_GRAVITY = 4.0
"""A median norm (m/s²) below this has no gravity in it."""
Make = Callable[[pl.DataFrame], Mapping[str, Any]]


@dataclass(frozen=True)
class StreamChannel:
    """One channel of a stream.

    Attributes
    ----------
    topic, schema : str
        Of the channel.
    columns : mapping of str to Source, or callable
        Where each column of the schema comes from, or what makes the columns of a frame of cells.
    names : tuple of str
        Columns, where ``columns`` is a callable or the schema's columns are named by the data.
    held : bool
        Whether a reading stands on every row until there is a new one.
    fixes : bool
        Whether the columns are ``lat, lon, alt, accuracy, vertical`` of fixes (the last three where given), and
        ``speed`` (m/s) and ``course`` (degrees clockwise from true north) of the receiver's own velocity.
    metadata : mapping of str to str
        Of the channel.
    """

    topic: str
    schema: str
    columns: Mapping[str, SourceColumn] | Make
    names: tuple[str, ...] = ()
    held: bool = False
    fixes: bool = False
    frame_id: str = "phone"
    metadata: Mapping[str, str] = field(default_factory=dict)

    def spec(self) -> ChannelSpec:
        """Return the channel as an import declares it."""
        return ChannelSpec(
            self.topic,
            self.schema,
            self.frame_id,
            self.names if self.schema == VALUES else (),
            metadata=dict(self.metadata),
        )


def xyz(columns: Sequence[str], names: Sequence[str], factor: float = 1.0) -> dict[str, SourceColumn]:
    """Return the sources of three axes."""
    return {c: SourceColumn(n, factor) for c, n in zip(columns, names, strict=True)}


def imu_part(topic: str, columns: Mapping[str, SourceColumn], **metadata: str) -> StreamChannel:
    """Return the channel of an accelerometer, a gyroscope or both."""
    return StreamChannel(topic, IMU, columns, metadata=metadata)


def fix_part(
    columns: Mapping[str, str], topic: str = "/phone/gnss", speed_factor: float = 1.0, **metadata: str
) -> StreamChannel:
    """Return the channel of fixes: from the columns of :class:`StreamChannel` to the names of their cells.

    With ``speed`` and ``course`` there is a second channel, ``<topic>_velocity``.
    """
    return StreamChannel(
        topic,
        FIX,
        {k: SourceColumn(v, speed_factor if k == "speed" else 1.0) for k, v in columns.items()},
        held=True,
        fixes=True,
        frame_id="wgs84",
        metadata=metadata,
    )


def quaternion_of(azimuth: np.ndarray, pitch: np.ndarray, roll: np.ndarray) -> dict[str, np.ndarray]:
    """Return ``rot_nb`` of Android's orientation angles (rad), n = east, magnetic north, up.

    Android's ``getOrientation``: azimuth clockwise from north, pitch positive top down, roll positive left
    side up; the rotation is Rz(-azimuth) Rx(-pitch) Ry(roll). A recording with the gravity vector agrees.
    """
    a, p, r = -azimuth / 2, -pitch / 2, roll / 2
    ca, sa, cp, sp, cr, sr = np.cos(a), np.sin(a), np.cos(p), np.sin(p), np.cos(r), np.sin(r)
    values = (
        ca * cp * cr - sa * sp * sr,
        ca * sp * cr - sa * cp * sr,
        ca * cp * sr + sa * sp * cr,
        ca * sp * sr + sa * cp * cr,
    )
    return dict(zip(QUAT, values, strict=True))


def rotation_vector(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> dict[str, np.ndarray]:
    """Return the quaternion of Android's rotation vector: its vector part, the real part not negative."""
    w = np.sqrt(np.maximum(0.0, 1.0 - x * x - y * y - z * z))
    norm = np.sqrt(w * w + x * x + y * y + z * z)
    return {c: v / norm for c, v in zip(QUAT, (w, x, y, z), strict=True)}


def whole_ns(values: pl.Series, per_microsecond: float) -> pl.Series:
    """Return times as whole ns, exact to the µs: ``values`` times ``per_microsecond`` are microseconds."""
    return pl.Series(nanoseconds(values, per_microsecond, tick_ns=1000))


def _velocity(part: StreamChannel) -> list[ChannelSpec]:
    """Return the channel of the receiver's velocity, where fixes have one."""
    if not part.fixes or callable(part.columns) or not {"speed", "course"} <= set(part.columns):
        return []
    return [velocity_spec(part.topic)]


class Stream:
    """Rows of one clock on their way to channels: time repaired, readings checked, repeats left out.

    Parameters
    ----------
    parts : sequence of StreamChannel
        Channels that the rows give.
    report : ReportBuilder
        Takes what is found.
    subject : str
        Which rows, where a log has several kinds: stands before each detail about time.
    even : bool
        Whether the rows come at a fixed rate.
    events : bool
        Whether several rows may speak of one instant (signals of transmitters, surveyed points): they are
        put in order instead of being dropped where they come late.
    attachments : list of SourceAttachment, optional
        Of the import; takes positions without times.
    """

    def __init__(
        self,
        parts: Sequence[StreamChannel],
        report: ReportBuilder,
        *,
        subject: str = "",
        even: bool = True,
        events: bool = False,
        attachments: list[SourceAttachment] | None = None,
    ) -> None:
        self.attachments = attachments if attachments is not None else []
        self.parts = list(parts)
        self._report = report
        self._clock = TimestampRepair(report, tick_ns=1, subject=f"{subject}: " if subject else "", even=even)
        self._subject = subject
        self._events: list[pl.DataFrame] | None = [] if events else None
        self._checks = {p.topic: _Check(p, report) for p in self.parts if p.schema == IMU}
        self._last: dict[str, np.ndarray] = {}
        self._fixes: dict[str, list[pl.DataFrame]] = {p.topic: [] for p in self.parts if p.fixes}
        self._empty: pl.DataFrame | None = None
        self.rows = 0

    def pull(self, frames: Iterable[pl.DataFrame]) -> Iterator[tuple[str, pl.DataFrame]]:
        """Yield the tables of all frames, to the end."""
        for frame in frames:
            yield from self.push(frame)
        yield from self.finish()

    def push(self, frame: pl.DataFrame) -> Iterator[tuple[str, pl.DataFrame]]:
        """Yield what is settled after a frame: ``t`` (Int64 ns), ``line``, and the cells by name."""
        if not frame.height:
            return
        self._empty = frame.clear()
        if self._events is not None:
            self._events.append(frame)
            return
        yield from self._tables(self._clock.feed(frame))

    def finish(self) -> Iterator[tuple[str, pl.DataFrame]]:
        """Yield the rest, and report what only the whole stream can tell."""
        if self._events:
            yield from self._tables(self._in_order(pl.concat(self._events)))
        elif self._empty is not None and self._events is None:
            yield from self._tables(self._clock.feed(self._empty, final=True))
        for part in self.parts:
            if self._fixes.get(part.topic):
                table = finished_fixes(
                    part.topic, pl.concat(self._fixes[part.topic]), self._report, self.attachments
                )
                if table.height:
                    yield part.topic, table.drop("line")
                for spec in _velocity(part):
                    table = velocities(pl.concat(self._fixes[part.topic]))
                    if table.height:
                        yield spec.topic, table
        for check in self._checks.values():
            check.finish()

    def _in_order(self, frame: pl.DataFrame) -> pl.DataFrame:
        frame = frame.sort("line", maintain_order=True)
        t = frame["t"].to_numpy()
        back = np.flatnonzero(np.diff(t, prepend=t[:1]) < 0)
        if back.size:
            self._report.repair(
                "backwards_time",
                f"{self._subject}: rows stand behind later ones: put in order",
                count=back.size,
                rows=int((t < np.maximum.accumulate(t)).sum()),
                line=int(frame["line"][int(back[0])]),
                subject=self._subject,
            )
            frame = frame.sort("t", maintain_order=True)
        if self.parts[0].schema == RADIO:
            frame = without_stale(frame, self._subject, self._report)
        self._report.keep(frame.height)
        return frame.rename({"t": "t_ns"})

    def _tables(self, frame: pl.DataFrame) -> Iterator[tuple[str, pl.DataFrame]]:
        self.rows += frame.height
        if not frame.height:
            return
        for part in self.parts:
            table = self._table(part, frame)
            if table.height and part.fixes:
                self._fixes[part.topic].append(table)
            elif table.height:
                table.drop_in_place("line")
                yield part.topic, table

    def _table(self, part: StreamChannel, frame: pl.DataFrame) -> pl.DataFrame:
        if callable(part.columns):
            made = (pl.Series(k, v, strict=False) for k, v in part.columns(frame).items())
            table = pl.DataFrame([frame["t_ns"], frame["line"], *made])
        else:
            table = frame.select(
                "t_ns",
                "line",
                *(
                    (pl.col(s.name) if s.factor == 1.0 else pl.col(s.name) * s.factor).alias(c)
                    for c, s in part.columns.items()
                ),
            )
        table = self._present(part, table)
        if part.held and table.height:
            table = self._fresh(part, table)
        if part.topic in self._checks:
            self._checks[part.topic].feed(table)
        elif part.schema in (PRESSURE, MAG) and table.height:
            columns = {c: table[c].to_numpy() for c in table.columns[2:]}
            check_plausible(self._report, part.topic, columns, table["line"].to_numpy())
        return table

    def _present(self, part: StreamChannel, table: pl.DataFrame) -> pl.DataFrame:
        """Return the rows that hold a reading; report those that lack a part of one."""
        keys = ["lat", "lon"] if part.fixes else [c for c in table.columns[2:] if table[c].dtype.is_float()]
        if not keys or part.schema in (RADIO, STEP):
            return table
        gone = np.column_stack([np.isnan(table[c].to_numpy()) for c in keys])
        if not gone.any():
            return table
        empty = gone.all(axis=1)
        some = np.flatnonzero(gone.any(axis=1) & ~empty)
        if empty.any():
            self._report.note(
                "missing_cell",
                f"{part.topic}: no value in the row: no message",
                count=int(empty.sum()),
                line=int(table["line"][int(np.argmax(empty))]),
                subject=f"{part.topic} empty",
            )
        if some.size:
            self._report.loss(
                "missing_cell",
                f"{part.topic}: a value is missing in the row; NaN in its place",
                count=some.size,
                line=int(table["line"][int(some[0])]),
                subject=part.topic,
            )
        return table.filter(pl.Series(np.asarray(~empty))) if empty.any() else table

    def _fresh(self, part: StreamChannel, table: pl.DataFrame) -> pl.DataFrame:
        """Return the rows whose reading differs from the one before."""
        values = np.column_stack([table[c].to_numpy() for c in table.columns[2:]])
        before = self._last.get(part.topic)
        first = values[:1] + 1 if before is None else before
        readings = np.nan_to_num(values, nan=-9e9)
        same = (np.diff(readings, axis=0, prepend=np.nan_to_num(first, nan=-9e9)) == 0).all(axis=1)
        self._last[part.topic] = values[-1:]
        if same.any():
            what = "fix" if part.fixes else "reading"
            self._report.note(
                "stale_repeat",
                f"{part.topic}: the last {what} is repeated until there is a new one: only its first row is a "
                "message",
                count=int(same.sum()),
                line=int(table["line"][int(np.argmax(same))]),
                subject=part.topic,
            )
            table = table.filter(pl.Series(~same))
        return table


class _Check:
    """Checks of an inertial channel: units, silence, clipping, gravity."""

    def __init__(self, part: StreamChannel, report: ReportBuilder) -> None:
        self._report, self._topic = report, part.topic
        columns = part.names if callable(part.columns) else tuple(part.columns)
        self._axes = [a for a in (*ACC, *GYR) if a in columns]
        self._sensor = SensorCheck(report, part.topic, self._axes)
        self._plateau = Plateau(report, part.topic, self._axes)
        self._judged = False

    def feed(self, table: pl.DataFrame) -> None:
        if not table.height:
            return
        lines = table["line"].to_numpy()
        values = {a: table[a].to_numpy() for a in self._axes}
        self._sensor.feed(list(values.values()), lines)
        acc = [values[a] for a in ACC if a in values]
        self._sensor.feed_si(acc, [values[a] for a in GYR if a in values], lines)
        self._plateau.feed(list(values.values()), lines)
        if len(acc) == 3 and not self._judged:
            self._judged = True
            norm = np.sqrt(acc[0] ** 2 + acc[1] ** 2 + acc[2] ** 2)
            middle = float(np.median(norm[~np.isnan(norm)])) if not np.isnan(norm).all() else math.nan
            if middle < NO_GRAVITY and not 0.9 < middle < 1.1:
                self._report.loss(
                    "gravity_free",
                    f"{self._topic}: the norm's median is {middle:.2g} m/s²: gravity is not in it, attitude "
                    "cannot be had from it",
                    line=int(lines[0]),
                    subject=self._topic,
                )

    def finish(self) -> None:
        self._sensor.finish()
        self._plateau.finish()


def require_rows(path: Path, streams: Sequence[Stream]) -> None:
    """Raise where nothing was read.

    Raises
    ------
    MarchaError
        No stream has a row.
    """
    if not any(s.rows for s in streams):
        raise MarchaError(f"{path}: no row of numbers behind its header; nothing to convert")


def declared(streams: Iterable[Stream]) -> list[ChannelSpec]:
    """Return the channels of all streams."""
    return [spec for s in streams for p in s.parts for spec in (p.spec(), *_velocity(p))]
