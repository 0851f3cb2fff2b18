"""Joints: an hour of two segments through SMeA and the hinge, and a calibration of ten minutes, beside vqf."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
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
"""Promised for the full sizes, as wall clock; the ratio to vqf says how busy or slow the machine of the run is."""
RUNS = 3
"""Of so many runs the quickest counts, ours and vqf's alike."""


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
            out = Path(folder, f"{name}.mcap")
            ours, cpu = least(
                lambda name=name, out=out: replay(
                    rec, [name], out=out, overwrite=True, keep_tables=False, metrics=False
                )
            )
            what = f"{hour / 60:.0f} min of two segments at {RATE_HZ} Hz through {name}, recorded"
            found.append(row(f"{what} (CPU {cpu:.2g} s)", ours, vqf_s(many), bound))
    stretch = Stretch({}, {n: (t,) for n, t in tables(ten).items()})
    if not JointCalibrator().calibrate([stretch]).usable:
        raise RuntimeError("the simulated ten minutes do not calibrate the joint")
    ours, cpu = least(lambda: JointCalibrator().calibrate([stretch]))
    what = f"calibration joint of {len(ten['thigh']) / RATE_HZ / 60:.0f} min (CPU {cpu:.2g} s)"
    return [*found, row(what, ours, vqf_s(ten), CALIBRATION_S)]


def row(what: str, ours: float, theirs: float, bound: float | None) -> Row:
    """Return the row of a time (s) with its promise in seconds, beside vqf's time for the same samples."""
    target = "" if bound is None else f"≤ {bound:g} s"
    peer = "vqf (C++), both sensors, no files"
    return Row(what, ours, "s", peer, theirs, ours / theirs, target, bound is None or ours <= bound)


def least(work: Callable[[], object]) -> tuple[float, float]:
    """Return wall clock and CPU time of all threads (s) of the quickest of ``RUNS`` runs."""
    found = []
    for _ in range(RUNS):
        begin, cpu = time.perf_counter(), time.process_time()
        work()
        found.append((time.perf_counter() - begin, time.process_time() - cpu))
    return min(found)


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

    def attitudes() -> None:
        for v in readings.values():
            VQF(1.0 / RATE_HZ).updateBatch(np.ascontiguousarray(v[:, 3:]), np.ascontiguousarray(v[:, :3]))

    return least(attitudes)[0]
