"""Inclination of a pendulum's three segments beside cameras, the frames of sensors and cameras brought together."""

from __future__ import annotations

from pathlib import Path

import marcha.recording as mr
import numpy as np
import polars as pl
import pytest
from marcha.algorithms.contract import FloatArray
from marcha.ingest import convert
from marcha.replay import calibrate, replay
from scipy.spatial.transform import Rotation

SEGMENTS = ("thigh", "shank", "foot")
PIVOT = "-0.122,-0.006,0.009"
"""From the pivot to the first sensor (m), by least squares on its force and rate."""


def rotations(table: pl.DataFrame) -> Rotation:
    return Rotation.from_quat(table.select("quat_x", "quat_y", "quat_z", "quat_w").to_numpy())


def turn_to_sensor(rate: FloatArray, seen: FloatArray) -> Rotation:
    """Return the rotation of the cameras' frame of a segment to the sensor's, from both rates, without outliers."""
    keep = np.linalg.norm(seen, axis=1) < 12.0
    found = Rotation.identity()
    for _ in range(6):
        found = Rotation.align_vectors(rate[keep], seen[keep])[0]
        misfit = np.linalg.norm(rate - found.apply(seen), axis=1)
        keep &= misfit < 3.0 * np.median(misfit)
    return found


@pytest.mark.data
def test_inclination_of_three_segments_beside_cameras(data_dir: Path, tmp_path: Path) -> None:
    """The second misses the promised 1.3°; the third is best where the cameras are steady (docs/joints.md)."""
    files = sorted((data_dir / "leg" / "pendulum_optical").glob("*.csv"))
    convert(files, tmp_path / "pendulum.mcap", options={"segments": ",".join(SEGMENTS)})
    rec = mr.open(tmp_path / "pendulum.mcap")
    hinges = calibrate("joint", [rec], params={"axis": "z"})
    params = {"axis": "z", "up": "x", "joint": "hinge", "anchor": PIVOT}
    tables = replay(rec, ["joint.relative"], params=params, calibrations=hinges).runs[0].tables
    whole, steady = [], []
    for segment in SEGMENTS:
        cameras = rec.table(f"/reference/{segment}/orientation")
        imu = rec.table(f"/leg/{segment}/imu")
        t = cameras["t_ns"].to_numpy()
        s = (t - t[0]) * 1e-9
        gyr = np.stack([np.interp(t, imu["t_ns"], imu[f"gyr_{a}"]) for a in "xyz"], 1)
        turned = np.r_[np.zeros((1, 3)), np.cumsum(0.5 * (gyr[1:] + gyr[:-1]) * np.diff(s)[:, None], axis=0)]
        seen = rotations(cameras)
        span = (s[9:] - s[:-9])[:, None]
        to_sensor = turn_to_sensor(
            (turned[9:] - turned[:-9]) / span, (seen[:-9].inv() * seen[9:]).as_rotvec() / span
        )
        rest = imu.filter(pl.col("t_ns") < t[0] + 1_400_000_000).select("acc_x", "acc_y", "acc_z").to_numpy()
        up = to_sensor.inv().apply(rest.mean(axis=0) / np.linalg.norm(rest.mean(axis=0)))
        truth = to_sensor.apply((seen.inv() * seen[0]).apply(up))
        at = tables[segment]["t_ns"].to_numpy()
        ours = rotations(tables[segment]).inv().apply([0.0, 0.0, 1.0])
        ours = np.stack([np.interp(t, at, c) for c in ours.T], 1)
        ours /= np.linalg.norm(ours, axis=1)[:, None]
        error = np.degrees(np.arccos(np.clip(np.sum(ours * truth, axis=1), -1.0, 1.0)))
        step = to_sensor.apply((seen[:-1].inv() * seen[1:]).as_rotvec()) - np.diff(turned, axis=0)
        jumps = s[1:][np.linalg.norm(step, axis=1) > np.radians(5.0)]
        near = (np.abs(s[:, None] - jumps[None]) < 0.5).any(axis=1)
        whole.append(np.sqrt(np.mean(error[s > 1.2] ** 2)))
        steady.append(np.sqrt(np.mean(error[(s > 1.2) & ~near] ** 2)))
    assert whole[0] < 1.1
    assert whole[1] < 1.6
    assert whole[2] < 5.5
    assert steady[2] < 2.5
