"""MATLAB files of foot-mounted walks in a motion capture room: ``imu``, ``gt`` and ``ts``.

``imu`` is (n, 6): specific force (m/s²), angular rate (rad/s); ``ts`` (n): time (s); ``gt`` (n, 3): position
(m) of the foot by Vicon, without orientation. ``gt`` is mirrored against a right-handed, z-up frame: no
rotation lays a trajectory that was computed from ``imu`` on it; with y negated one does. So y is negated
here, and the report says so. ``zv_vicon_opt`` (n), where present, is the stance by the optical speed and
becomes ``/reference/stance``.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import polars as pl

from ...recording.errors import MarchaError
from ..contract import (
    ChannelSpec,
    CommonOptions,
    Import,
    ReportBuilder,
)
from ..inertial import (
    ACC,
    GYR,
    IMU,
    MIRRORS,
    ChannelColumns,
    Mirror,
    SourceColumn,
    note_mirror,
    one_file,
    tables,
)
from ..matfile import MAGIC, Variable, read_mat
from ..timestamps import TimestampRepair, nanoseconds

POSE = ChannelSpec(
    "/reference/pose",
    "geometry_msgs/msg/PoseStamped",
    "vicon",
    metadata={"orientation": "none measured", "frame": "Vicon, z up"},
)
STANCE = ChannelSpec(
    "/reference/stance",
    "marcha_msgs/msg/Stance",
    metadata={"source": "zv_vicon_opt: threshold on the optical speed"},
)
POSITION = ("pos_x", "pos_y", "pos_z")


class ViconOptions(CommonOptions, frozen=True, kw_only=True):
    """How the optical frame is made right-handed.

    Attributes
    ----------
    mirror : str
        Axis of ``gt`` that is negated: ``x``, ``y`` or ``none``.
    """

    mirror: Mirror = "y"


class ViconMat:
    """Importer ``vicon-mat``: ``/foot/imu``, ``/reference/pose`` and ``/reference/stance``."""

    name: ClassVar[str] = "vicon-mat"
    title: ClassVar[str] = "MATLAB file of a foot-mounted walk with Vicon positions (imu, gt, ts)"
    Options = ViconOptions

    def sniff(self, head: bytes, path: Path) -> float:
        """A MATLAB file that holds ``imu``, ``gt`` and ``ts``."""
        if not head.startswith(MAGIC):
            return 0.0
        try:
            names = set(read_mat(path))
        except MarchaError:  # a damaged file: reading it will say what
            return 0.5
        return 0.95 if names >= {"imu", "gt", "ts"} else 0.0

    def read(self, paths: Sequence[Path], options: ViconOptions) -> Import:
        """Read one file."""
        path = one_file(paths, self.name)
        frame = _load(path, options.mirror)
        has_stance = "still" in frame.columns
        report = ReportBuilder()
        note_mirror(options.mirror, "gt", frame.height, report)
        imu = ChannelColumns("/foot/imu", IMU, {a: SourceColumn(a, 1.0) for a in (*ACC, *GYR)})
        plans = [imu, ChannelColumns(POSE.topic, POSE.schema, {a: SourceColumn(a, 1.0) for a in POSITION})]
        if has_stance:
            plans.append(ChannelColumns(STANCE.topic, STANCE.schema, {"still": SourceColumn("still", 1.0)}))
        clock = TimestampRepair(report, tick_ns=1)
        return Import(
            channels=[imu.spec(), POSE, *([STANCE] if has_stance else [])],
            blocks=_reference(tables(path, [frame], plans, clock, report), report),
            report=report,
            metadata={
                "device": {
                    "clock": "device",
                    "time": "variable ts",
                    "name": "foot-mounted sensor in a Vicon room, MATLAB file",
                    "frames": "imu: the device's axes as recorded; vicon: z up",
                }
            },
        )


def _load(path: Path, mirror: Mirror) -> pl.DataFrame:
    """Return all rows: ``t`` (ns), ``line`` (row, from 1), SI columns, ``still`` where the file has it."""
    file = read_mat(path, {"imu", "gt", "ts", "zv_vicon_opt"})
    ts = _variable(path, file, "ts").ravel()
    imu = _variable(path, file, "imu")
    gt = _variable(path, file, "gt")
    for name, value, width in (("imu", imu, 6), ("gt", gt, 3)):
        if value.shape != (ts.size, width):
            shape = " × ".join(map(str, value.shape))
            raise MarchaError(
                f"{path}: variable {name!r} is {shape}; it must be {ts.size} (as ts) × {width}; transpose "
                "or cut it"
            )
    if not ts.size:
        raise MarchaError(f"{path}: variable 'ts' is empty; nothing to convert")
    gt = gt * MIRRORS[mirror]
    lost = np.flatnonzero(~np.isfinite(ts))
    if lost.size:
        raise MarchaError(f"{path}: ts[{lost[0]}] is {ts[lost[0]]}; every row needs a time")
    columns: dict[str, Any] = {"t": nanoseconds(ts, 1e9), "line": np.arange(1, ts.size + 1)}
    columns |= dict(zip((*ACC, *GYR), imu.T, strict=True)) | dict(zip(POSITION, gt.T, strict=True))
    stance = file["zv_vicon_opt"].values if "zv_vicon_opt" in file else None
    if stance is not None and stance.size == ts.size:
        columns["still"] = stance.ravel()
    return pl.DataFrame(columns)


def _variable(path: Path, file: dict[str, Variable], name: str) -> np.ndarray:
    if name not in file:
        raise MarchaError(f"{path}: no variable {name!r}; the format needs imu, gt and ts")
    value = file[name].values
    if value is None or value.ndim != 2:
        raise MarchaError(f"{path}: variable {name!r} is no table of numbers")
    return value


def _reference(
    blocks: Iterator[tuple[str, pl.DataFrame]], report: ReportBuilder
) -> Iterator[tuple[str, pl.DataFrame]]:
    """Yield the blocks; reference rows without a position are left out, held ones are counted."""
    for topic, table in blocks:
        if topic == STANCE.topic:
            yield topic, table.with_columns(pl.col("still") > 0.5)
            continue
        if topic == POSE.topic:
            table = table.filter(~pl.any_horizontal(pl.col(POSITION).is_nan()))
            held = (np.diff(table.select(POSITION).to_numpy(), axis=0) == 0).all(axis=1)
            if held.any():
                report.note(
                    "stale_repeat",
                    f"{topic}: equal to the row before in every digit: the optical system held its last "
                    "value",
                    count=int(held.sum()),
                    line=int(np.argmax(held)) + 2,
                    subject=topic,
                )
        yield topic, table
