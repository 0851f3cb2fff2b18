"""Joints: an hour of two segments through SMeA and the hinge, and a calibration of ten minutes, beside vqf."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import marcha.recording as mr
import numpy as np
import polars as pl
from marcha.algorithms import Stretch
from marcha.algorithms.joint.calibrate import JointCalibrator
from marcha.ingest.simulate.leg import leg
from marcha.replay import replay

from . import Row

IMU = "sensor_msgs/msg/Imu"
COLUMNS = ("acc_x", "acc_y", "acc_z", "gyr_x", "gyr_y", "gyr_z")
RATE_HZ = 100
HOUR_S, MINUTES_S = 3600.0, 600.0
SMEA_S, CALIBRATION_S = 3.0, 5.0
VQF_S = 0.23e-6
"""Promised for a machine on which vqf takes this for a sample; what is compared is the ratio, since machines differ."""


def rows(scale: float) -> list[Row]:
    """Measure; ``scale`` 1 is an hour, and ten minutes."""
    capture = leg("walking", seed=1, segments=("thigh", "shank"), duration_s=60.0, rate_hz=RATE_HZ)
    readings = {n: np.hstack([s.acc_b, s.gyr_b]) for n, s in capture.segments.items()}
    many = {n: np.tile(v, (max(1, round(60 * scale)), 1)) for n, v in readings.items()}
    hour = len(many["thigh"]) / RATE_HZ
    ten = {n: v[: int(MINUTES_S * RATE_HZ)] for n, v in many.items()}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "leg.mcap")
        with mr.create(path) as out:
            for name, table in tables(many).items():
                out.add_table(f"/leg/{name}/imu", IMU, table)
        rec = mr.open(path)
        found = []
        for name, bound in (("joint.smea", SMEA_S), ("joint.hinge", None)):
            replay(rec, [name], end_ns=2 * 10**9)  # compile
            begin = time.perf_counter()
            replay(rec, [name], out=Path(folder, f"{name}.mcap"), keep_tables=False, metrics=False)
            ours, theirs = time.perf_counter() - begin, vqf_s(many)
            limit = None if bound is None else bound / (2 * RATE_HZ * HOUR_S * VQF_S)
            what = f"{hour / 60:.0f} min of two segments at {RATE_HZ} Hz through {name}, recorded"
            target = "" if limit is None else f"≤ {limit:.3g} × vqf"
            peer = "vqf (C++), both sensors, no files"
            met = limit is None or ours <= limit * theirs
            found.append(Row(what, ours, "s", peer, theirs, ours / theirs, target, met))
    begin = time.perf_counter()
    calibration = JointCalibrator().calibrate([Stretch({}, {n: (t,) for n, t in tables(ten).items()})])
    ours, theirs = time.perf_counter() - begin, vqf_s(ten)
    what = f"calibration joint of {len(ten['thigh']) / RATE_HZ / 60:.0f} min"
    limit = CALIBRATION_S / (2 * len(ten["thigh"]) * VQF_S)
    met = calibration.usable and ours <= limit * theirs
    peer = "vqf (C++), both sensors"
    return [*found, Row(what, ours, "s", peer, theirs, ours / theirs, f"≤ {limit:.3g} × vqf", met)]


def tables(readings: dict[str, np.ndarray]) -> dict[str, pl.DataFrame]:
    """Return one table a segment, at even times."""
    return {
        name: pl.DataFrame(
            {"t_ns": np.arange(len(v)) * (10**9 // RATE_HZ)}
            | {c: v[:, i].copy() for i, c in enumerate(COLUMNS)}
        )
        for name, v in readings.items()
    }


def vqf_s(readings: dict[str, np.ndarray]) -> float:
    """Return the time that vqf takes for the attitudes of all sensors (s)."""
    from vqf import VQF

    begin = time.perf_counter()
    for v in readings.values():
        VQF(1.0 / RATE_HZ).updateBatch(np.ascontiguousarray(v[:, 3:]), np.ascontiguousarray(v[:, :3]))
    return time.perf_counter() - begin
