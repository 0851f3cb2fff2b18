"""Indoor positioning: 150 s among 12 anchors through every method; 2000 particles at 1000 packets a second."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any

import marcha.recording as mr
import numpy as np
import polars as pl
from marcha.replay import replay

from . import Row

ANCHORS, SECONDS, PACKETS_HZ = 12, 150.0, 23.0
"""As in the tracks of a BLE beacon among twelve receivers: 23 packets a second."""
FAST_HZ, PARTICLES = 1000.0, 2000
METHODS = {
    "triples with votes": "indoor.trilateration",
    "weighted least squares": "indoor.trilateration[preset=wls]",
    "hybrid of the source": "indoor.hybrid",
    "particle filter with walls and steps": "indoor.fused",
    "smoother": "indoor.smooth",
}


def rows(scale: float) -> list[Row]:
    """Measure; ``scale`` shortens the track."""
    seconds = max(10.0, SECONDS * scale)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "track.mcap")
        _track(path, seconds, PACKETS_HZ)
        found = []
        for name, estimator in METHODS.items():
            took = _loop_s(path, estimator)
            target = f"< 1 s for {SECONDS:g} s"
            found.append(
                Row(
                    f"indoor, {seconds:g} s, 12 anchors: {name}",
                    took,
                    "s",
                    "",
                    None,
                    None,
                    target,
                    took < 1.0,
                )
            )
        fast = Path(folder, "fast.mcap")
        _track(fast, 10.0, FAST_HZ)
        took = _loop_s(fast, f"indoor.fused[particles={PARTICLES}]")
    rate = 10.0 * FAST_HZ / took
    found.append(
        Row(
            f"indoor, {PARTICLES} particles: packets a second",
            rate,
            "1/s",
            "",
            None,
            None,
            f"≥ {FAST_HZ:g}/s",
            rate >= FAST_HZ,
        )
    )
    return found


def _loop_s(path: Path, estimator: str) -> float:
    rec = mr.open(path)
    replay(rec, [estimator], end_ns=10**9, metrics=False)  # compile
    best = float("inf")
    for _ in range(3):
        begin = time.process_time()  # on a busy machine the wall clock measures the others
        replay(rec, [estimator], metrics=False)
        best = min(best, time.process_time() - begin)
    return best


def _track(path: Path, seconds: float, packets_hz: float) -> None:
    """Write a beacon that walks in a hall of 20 m × 16 m with a wall, and a phone's accelerations and attitude."""
    rng = np.random.default_rng(1)
    where = np.array([[x, y, 2.3] for x in (1.0, 7.0, 13.0, 19.0) for y in (1.0, 8.0, 15.0)])
    macs = [f"a0:e6:f8:00:00:{k:02x}" for k in range(ANCHORS)]
    t = np.arange(0.0, seconds, 1 / packets_hz)
    at = np.column_stack([10 + 7 * np.cos(0.15 * t), 8 + 5 * np.sin(0.15 * t)])
    who = rng.integers(0, ANCHORS, len(t))
    d = np.maximum(np.linalg.norm(np.column_stack([at, np.full(len(t), 1.2)]) - where[who], axis=1), 0.3)
    rssi = np.round(-60 - 18 * np.log10(d) + 4 * rng.standard_normal(len(t)))
    radio = pl.DataFrame(
        {"t_ns": (t * 1e9).astype(np.int64), "mac": [macs[k] for k in who], "rssi_dbm": rssi}
    )
    s = np.arange(0.0, seconds, 0.02)
    up = 9.81 + 2 * np.sin(2 * np.pi * s / 0.5)
    imu: dict[str, Any] = {"t_ns": (s * 1e9).astype(np.int64), "acc_x": 0 * s, "acc_y": 0 * s, "acc_z": up}
    heading = np.arctan2(5 * np.cos(0.15 * s), -7 * np.sin(0.15 * s))
    half = (heading - np.pi / 2) / 2
    turn = {
        "t_ns": imu["t_ns"],
        "quat_w": np.cos(half),
        "quat_x": 0 * s,
        "quat_y": 0 * s,
        "quat_z": np.sin(half),
    }
    table = "mac,technology,x,y,z,p_d0,eta\n" + "".join(
        f"{m},ble,{x},{y},{z},-60,1.8\n" for m, (x, y, z) in zip(macs, where, strict=True)
    )
    plan = (
        '{"type":"FeatureCollection","x_axis_azimuth_deg":90,"features":['
        '{"type":"Feature","properties":{"kind":"passable"},"geometry":{"type":"Polygon","coordinates":'
        "[[[0,0],[20,0],[20,16],[0,16],[0,0]]]}},"
        '{"type":"Feature","properties":{"kind":"wall"},"geometry":{"type":"LineString","coordinates":[[9,8],[11,8]]}}]}'
    )
    with mr.create(path) as out:
        out.add_table("/phone/radio", "marcha_msgs/msg/RadioSignal", radio)
        out.add_table("/phone/acc", "sensor_msgs/msg/Imu", pl.DataFrame(imu))
        out.add_table("/phone/orientation", "geometry_msgs/msg/QuaternionStamped", pl.DataFrame(turn))
        out.add_attachment("anchors.csv", table.encode(), "text/csv")
        out.add_attachment("plan.geojson", plan.encode(), "application/geo+json")
