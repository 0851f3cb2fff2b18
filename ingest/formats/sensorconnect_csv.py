"""CSV that MicroStrain's SensorConnect exports, with the footprints of the walk where they were measured.

Columns are ``Time`` (s) and ``<node>:<field>``: ``scaledAccelX`` (g), ``scaledGyroX`` (rad/s),
``scaledMagX`` (gauss), ``roll``, ``pitch``, ``yaw`` (rad, of the device's own filter); or, from its estimation
filter, ``estCompensatedAccelX`` (m/s², bias taken off), ``estAngularRateX`` (rad/s), ``estRoll`` …, each with a
column ``…:valid`` (0: the device says that the value is none). Where both are there, the scaled ones count.
The device's body axes are x forward, y right, z down (at rest the accelerometer reads −1 g on z) and are
kept. Its attitude is against north, east, down; here it is turned into ``rot_nb`` with n = north, west, up.

Footprints are a second table ``strideIndex,timestamp,gcpX,gcpY`` (index of the row, s, m, m), found beside
the log by its name (``<stem>_….csv``), or named by the option ``footprints``, or given as a second input.

They are given against the device's z-down frame: seen in a z-up frame they are mirrored, so y is negated
(on the authors' own walk an estimate then fits to 0.3 m, else to 1.3 m).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, ClassVar

import msgspec
import numpy as np
import polars as pl

from ...recording.errors import MarchaError, UsageError
from ...recording.provenance import hash_file
from ...recording.rotations import QUAT
from ..columns import (
    Header,
    find_header,
    float_blocks,
    require_header,
    with_ticks,
)
from ..contract import (
    ChannelSpec,
    CommonOptions,
    Import,
    ReportBuilder,
)
from ..inertial import (
    ACC,
    FIELD,
    GYR,
    IMU,
    MAG,
    MIRRORS,
    SI,
    ChannelColumns,
    Mirror,
    SourceColumn,
    complete,
    note_mirror,
    note_unused,
    tables,
)
from ..timestamps import TimestampRepair
from ..units import conversion

WANTED = "Time,<node>:scaledAccelX,…"
FOOTPRINTS = ("strideIndex", "timestamp", "gcpX", "gcpY")
REFERENCE = ChannelSpec(
    "/reference/footprints",
    "geometry_msgs/msg/PoseStamped",
    "floor",
    metadata={"frame": "surveyed floor: x, y measured, z = 0 by definition (flat floor), no orientation"},
)

_FIELDS = {
    "estCompensatedAccel": ("acc", "m/s2"),
    "estAngularRate": ("gyr", "rad/s"),
    "scaledAccel": ("acc", "g"),
    "scaledGyro": ("gyr", "rad/s"),
    "scaledMag": ("mag", "gauss"),
}
"""Quantity and unit of a field; of two for one quantity the later counts."""
_ACCELERATIONS = (":scaledAccelX", ":estCompensatedAccelX")
_ANGLES = (("roll", "pitch", "yaw"), ("estRoll", "estPitch", "estYaw"))
_VALID = ":valid"
#: A walk whose last footprint is so near to its first (share of its length) is closed.
CLOSED = 0.005


class SensorConnectOptions(CommonOptions, frozen=True, kw_only=True):
    """Which sensor of the export, and where the footprints are.

    Attributes
    ----------
    node : str, optional
        Which sensor, where the file has several (what stands before the colon).
    footprints : str, optional
        Path of the footprint table; default: the one beside the log, by name.
    mirror : str
        Axis of the footprints that is negated: ``x``, ``y`` or ``none``.
    """

    node: Annotated[str | None, msgspec.Meta(description="which sensor, of several in the file")] = None
    mirror: Mirror = "y"
    footprints: Annotated[
        str | None,
        msgspec.Meta(description="table of measured footprints; default: <stem>_….csv beside the log"),
    ] = None


class SensorConnectCsv:
    """Importer ``sensorconnect-csv``: ``/foot/imu``, ``/foot/mag`` and ``/reference/footprints``."""

    name: ClassVar[str] = "sensorconnect-csv"
    title: ClassVar[str] = "CSV of MicroStrain SensorConnect, with measured footprints"
    Options = SensorConnectOptions
    joins: ClassVar[bool] = True

    def sniff(self, head: bytes, path: Path) -> float:
        """A header with ``Time`` and ``<node>:scaledAccelX`` or ``<node>:estCompensatedAccelX``."""
        return 0.95 if find_header(head, _is_header) else 0.0

    def read(self, paths: Sequence[Path], options: SensorConnectOptions) -> Import:
        """Read one log; a second path is its table of footprints."""
        path, truth = _inputs(paths, options)
        header = require_header(path, _is_header, WANTED)
        node = _node(path, header, options.node)
        columns = _columns(header, node)
        report = ReportBuilder()
        angles = next((n for a in _ANGLES if set(n := [f"{node}:{x}" for x in a]) <= set(header.names)), [])
        imu = complete(columns, ACC) | complete(columns, GYR)
        if angles:
            imu |= {q: SourceColumn(q, 1.0) for q in QUAT}
        plans = [ChannelColumns("/foot/imu", IMU, imu, metadata={"node": node})]
        if field := complete(columns, FIELD):
            plans.append(ChannelColumns("/foot/mag", MAG, field, metadata={"node": node}))
        used = {s.name for p in plans for s in p.columns.values()} | {"Time", *angles}
        flags = {f"{n}{_VALID}" for n in used} & set(header.names)
        note_unused(header.names, used | flags, report, header.line)
        metadata = {
            "device": {
                "clock": "device",
                "time": "column 'Time'",
                "name": "MicroStrain inertial sensor, SensorConnect CSV",
                "frames": "imu: the device's axes, x forward, y right, z down; −1 g on z at rest; "
                "orientation against north, west, up",
            }
        }
        specs = [p.spec() for p in plans]
        footprints = None
        if truth is not None:
            footprints, metadata["truth"] = _footprints(truth, options.mirror)
            note_mirror(options.mirror, truth.name, footprints.height, report)
            specs.append(REFERENCE)
        clock = TimestampRepair(report, tick_ns=1)
        frames = _frames(path, header, angles, sorted(flags), report)
        return Import(
            channels=specs,
            blocks=_with_footprints(tables(path, frames, plans, clock, report), footprints, truth, report),
            report=report,
            metadata=metadata,
            also_read=[truth] if truth is not None else [],
        )


def _is_header(cells: Sequence[str]) -> bool:
    return cells[0] == "Time" and any(c.endswith(_ACCELERATIONS) for c in cells)


def _is_footprints(cells: Sequence[str]) -> bool:
    return tuple(cells[:4]) == FOOTPRINTS


def _has(path: Path, accept: Callable[[Sequence[str]], bool]) -> bool:
    try:
        with path.open("rb") as f:
            return find_header(f.read(1 << 16), accept) is not None
    except OSError:
        return False


def _inputs(paths: Sequence[Path], options: SensorConnectOptions) -> tuple[Path, Path | None]:
    """Return the log and the table of footprints."""
    tables_ = [p for p in paths if _has(p, _is_footprints)]
    logs = [p for p in paths if p not in tables_]
    if options.footprints is not None:
        tables_.append(Path(options.footprints))
    if len(logs) != 1 or len(tables_) > 1:
        raise UsageError(
            f"format sensorconnect-csv reads one log and at most one table of footprints, not {len(logs)} "
            "and "
            f"{len(tables_)}; convert them one by one"
        )
    log = logs[0]
    if not tables_:
        beside = sorted(log.parent.glob("*.csv"))
        tables_ = [p for p in beside if p.name.startswith(f"{log.stem}_") and _has(p, _is_footprints)]
        if len(tables_) > 1:
            raise UsageError(
                f"{log}: {len(tables_)} tables of footprints beside it; name one with footprints=…"
            )
    return log, tables_[0] if tables_ else None


def _node(path: Path, header: Header, wanted: str | None) -> str:
    nodes = list(dict.fromkeys(n.rpartition(":")[0] for n in header.names if n.endswith(_ACCELERATIONS)))
    if wanted is None and len(nodes) == 1:
        return nodes[0]
    if wanted in nodes:
        return wanted
    fault = f"has no node {wanted!r}" if wanted is not None else f"has {len(nodes)} nodes"
    raise UsageError(f"{path}: {fault}; choose one with node=: {', '.join(nodes)}")


def _columns(header: Header, node: str) -> dict[str, SourceColumn]:
    columns = {}
    for field, (quantity, unit) in _FIELDS.items():
        factor, _ = conversion(unit, SI[quantity])
        for axis in "XYZ":
            if (name := f"{node}:{field}{axis}") in header.names:
                columns[f"{quantity}_{axis.lower()}"] = SourceColumn(name, factor)
    return columns


def _frames(
    path: Path, header: Header, angles: Sequence[str], flags: Sequence[str], report: ReportBuilder
) -> Iterator[pl.DataFrame]:
    for frame in float_blocks(path, header, "Time", report):
        for flag in flags:
            invalid = frame[flag].fill_nan(0.0) == 0.0
            if invalid.any():
                report.note(
                    "invalid_value",
                    f"{path}: the device says by {flag} = 0 that the value is none; it is left empty",
                    count=int(invalid.sum()),
                    line=int(frame["line"].filter(invalid)[0]),
                    subject=flag,
                )
                value = flag.removesuffix(_VALID)
                frame = frame.with_columns(pl.when(invalid).then(None).otherwise(pl.col(value)).alias(value))
                frame = frame.with_columns(pl.col(value).fill_null(float("nan")))
        if angles:
            quat = _north_west_up(*(frame[a].to_numpy() for a in angles))
            frame = frame.with_columns(*(pl.Series(n, q) for n, q in zip(QUAT, quat, strict=True)))
        yield with_ticks(frame, "Time", 1e9, report).drop("Time")


def _north_west_up(roll: np.ndarray, pitch: np.ndarray, yaw: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return rot_nb (w, x, y, z), n = north, west, up, from z-y-x angles against north, east, down.

    The half turn about north, (0, 1, 0, 0), from the left.
    """
    cr, sr, cp, sp = np.cos(roll / 2), np.sin(roll / 2), np.cos(pitch / 2), np.sin(pitch / 2)
    cy, sy = np.cos(yaw / 2), np.sin(yaw / 2)
    w, x = cr * cp * cy + sr * sp * sy, sr * cp * cy - cr * sp * sy
    y, z = cr * sp * cy + sr * cp * sy, cr * cp * sy - sr * sp * cy
    return -x, w, -z, y


def _footprints(path: Path, mirror: Mirror) -> tuple[pl.DataFrame, dict[str, str]]:
    """Return the channel ``/reference/footprints`` and what it says about the walk."""
    header = require_header(path, _is_footprints, ",".join(FOOTPRINTS))
    report = ReportBuilder()
    report.refuse_changes(path)
    frames = list(float_blocks(path, header, "timestamp", report))
    table = pl.concat(frames) if frames else pl.DataFrame()
    if table.height < 2 or table.select(pl.col(FOOTPRINTS[1:]).is_nan().any()).row(0) != (False,) * 3:
        raise MarchaError(f"{path}: a table of footprints has at least two rows and no empty cells")
    t = table["timestamp"]
    if not (t.diff().drop_nulls() > 0).all():
        line = int(table["line"].filter((t.diff() <= 0).fill_null(False))[0])
        raise MarchaError(f"{path}, line {line}: timestamp does not grow; repair the table")
    table = with_ticks(table, "timestamp", 1e9, report)
    xy = table.select("gcpX", "gcpY").to_numpy() * MIRRORS[mirror][:2]
    length = float(np.linalg.norm(np.diff(xy, axis=0), axis=1).sum())
    closed = bool(np.linalg.norm(xy[-1] - xy[0]) <= CLOSED * length)
    channel = table.select(
        t_ns=pl.col("t"),
        pos_x=pl.Series(xy[:, 0]),
        pos_y=pl.Series(xy[:, 1]),
        pos_z=pl.lit(0.0),
    )
    return channel, {
        "closed": str(closed).lower(),
        "length_m": f"{length:.6g}",
        "strides": str(table.height - 1),
        "source": path.name,
        "source_blake2b": hash_file(path),
    }


def _with_footprints(
    blocks: Iterator[tuple[str, pl.DataFrame]],
    footprints: pl.DataFrame | None,
    path: Path | None,
    report: ReportBuilder,
) -> Iterator[tuple[str, pl.DataFrame]]:
    """Yield the blocks and then the footprints; report those that lie outside of the log's time."""
    first = last = None
    for topic, table in blocks:
        first = table["t_ns"][0] if first is None else first
        last = table["t_ns"][-1]
        yield topic, table
    if footprints is None or first is None:
        return
    outside = footprints.filter(~pl.col("t_ns").is_between(first, last))
    if outside.height:
        report.note(
            "reference_outside",
            f"{path}: footprints before or after the log: is it the table of another walk?",
            count=outside.height,
        )
    yield REFERENCE.topic, footprints
