"""MATLAB files of two MPU-6050 on two links and the encoder between them: ``all_time``, ``all_encoder`` …

Rates in °/s, accelerations in g, the encoder in degrees, the DMP's quaternions. The text beside the published
files says milliseconds for the time; they hold seconds: the step between rows decides, and the report says so.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np
import polars as pl

from ...recording.errors import MarchaError
from ..checks import STANDARD_GRAVITY, SensorCheck
from ..contract import ChannelSpec, CommonOptions, Import, ReportBuilder
from ..leg import IMU, JOINTS, ORIENTATION, QUAT, Segments, renamed, rotations
from ..legchecks import unwrapped
from ..matfile import MAGIC, read_mat
from ..optical import blocks_of
from ..timestamps import nanoseconds

ENCODER = "/leg/encoder"
NEEDED = {"all_time", "all_encoder", "all_gyro_1_x", "all_accel_1_x", "all_gyro_2_x", "all_accel_2_x"}
SLOWEST_S = 0.5
"""A step between rows above this is no second: the column counts milliseconds."""


class MpuEncoderOptions(CommonOptions, frozen=True, kw_only=True):
    """Names of the two links.

    Attributes
    ----------
    segments : str or None
        New names.
    """

    segments: Segments = None


class MpuEncoderMat:
    """Importer ``mpu-encoder-mat``: ``/leg/imu1/imu``, ``/leg/imu2/imu``, their orientations and ``/leg/encoder``."""

    name: ClassVar[str] = "mpu-encoder-mat"
    title: ClassVar[str] = (
        "MATLAB file of two MPU-6050 and an encoder (all_time, all_encoder, all_gyro_1_x …)"
    )
    Options = MpuEncoderOptions

    def sniff(self, head: bytes, path: Path) -> float:
        """A MATLAB file with the variables."""
        if not head.startswith(MAGIC):
            return 0.0
        try:
            return 0.95 if set(read_mat(path)) >= NEEDED else 0.0
        except MarchaError:
            return 0.0

    def read(self, paths: Sequence[Path], options: MpuEncoderOptions) -> Import:
        """Read one file."""
        path = paths[0]
        names = renamed(["imu1", "imu2"], options.segments, path)
        inertial = {
            f"{kind}{k}{a}": f"all_{word}_{k}_{a}"
            for kind, word in (("acc", "accel"), ("gyr", "gyro"))
            for k in "12"
            for a in "xyz"
        }
        quats = {f"quat{k}{q}": f"all_imu{k}_q{q}" for k in "12" for q in range(1, 5)}
        wanted = {"all_time", "all_encoder", *inertial.values(), *quats.values()}
        variables = read_mat(path, wanted)
        values = {}
        for name in sorted(wanted - set(quats.values()) | (set(quats.values()) & set(variables))):
            variable = variables.get(name)
            if variable is None:
                raise MarchaError(f"{path}: no variable {name!r}; the format needs all_time, all_encoder …")
            if variable.values is None:
                raise MarchaError(f"{path}: variable {name!r} is no table of numbers")
            values[name] = variable.values.ravel()
        rows = values["all_time"].size
        for name, v in values.items():
            if v.size != rows:
                raise MarchaError(
                    f"{path}: variable {name!r} has {v.size} values, all_time {rows}; cut them alike"
                )
        if not rows:
            raise MarchaError(f"{path}: its variables are empty; nothing to convert")
        report = ReportBuilder()
        good = np.isfinite(values["all_time"])
        if not good.all():
            first_bad = int(np.argmin(good))
            report.drop(
                "bad_row", "a row without a time; dropped", count=int((~good).sum()), line=first_bad + 1
            )
            values = {name: v[good] for name, v in values.items()}
        t_ns, unit = _times(values["all_time"], report)
        tables: list[tuple[ChannelSpec, pl.DataFrame]] = []
        lines = np.flatnonzero(good) + 1
        for k, name in zip("12", names.values(), strict=True):
            columns = {f"acc_{a}": values[inertial[f"acc{k}{a}"]] * STANDARD_GRAVITY for a in "xyz"}
            columns |= {f"gyr_{a}": np.radians(values[inertial[f"gyr{k}{a}"]]) for a in "xyz"}
            check = SensorCheck(report, f"/leg/{name}/imu", list(columns))
            check.feed(list(columns.values()), lines)
            check.feed_si(list(columns.values())[:3], list(columns.values())[3:], lines)
            check.finish()
            tables.append((ChannelSpec(f"/leg/{name}/imu", IMU, f"{name}_imu"), pl.DataFrame(columns)))
            parts = [quats[f"quat{k}{q}"] for q in range(1, 5)]
            if all(p in values for p in parts):
                metadata = {"source": "the device's own (DMP)"}
                spec = ChannelSpec(f"/leg/{name}/orientation", ORIENTATION, f"{name}_imu", QUAT, metadata)
                turned = pl.DataFrame({q: values[p] for q, p in zip(QUAT, parts, strict=True)})
                tables.append((spec, turned))
        first, second = names.values()
        joint = {"joint.upper": first, "joint.lower": second}
        spec = ChannelSpec(ENCODER, JOINTS, "", ("joint",), joint)
        tables.append((spec, pl.DataFrame({"joint": np.radians(values["all_encoder"])})))
        blocks = blocks_of([(t_ns, lines, [(s.topic, t) for s, t in tables])], report)
        turning = [s.topic for s, _ in tables if s.schema == ORIENTATION]
        return Import(
            channels=[s for s, _ in tables],
            blocks=unwrapped(rotations(blocks, turning, report), [ENCODER], report),
            report=report,
            metadata={
                "device": {
                    "clock": "device",
                    "time": f"variable all_time ({unit})",
                    "name": "two MPU-6050 and an encoder, MATLAB file",
                    "frames": "sensors: their own axes",
                }
            },
        )


def _times(time: np.ndarray, report: ReportBuilder) -> tuple[np.ndarray, str]:
    steps = np.diff(time)
    steps = steps[steps > 0]
    step = float(np.median(steps)) if steps.size else 0.0
    seconds = step < SLOWEST_S
    if seconds:
        report.note(
            "unit_doubt",
            f"all_time steps by {step:g}: taken for seconds, although the format's description says ms",
            count=1,
            subject="all_time",
        )
    return nanoseconds(time, 1e9 if seconds else 1e6), "s" if seconds else "ms"
