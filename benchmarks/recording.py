"""Writing and reading of Imu messages against mcap-ros2-support, the reference stack for ROS 2 messages."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import marcha.recording as mr
import numpy as np
import polars as pl
from marcha.recording.definitions import full_text
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from mcap_ros2.writer import Writer

from . import Row

IMU = "sensor_msgs/msg/Imu"
TOPIC = "/foot/imu1"
PEER = "mcap-ros2-support"
T = TypeVar("T")
MESSAGES = 1_000_000


def readings(rows: int) -> pl.DataFrame:
    """Return readings as a 16-bit sensor at 100 Hz gives them: a swing, noise, counts times a scale."""
    rng = np.random.default_rng(0)
    t = np.arange(rows) * 0.01
    columns: dict[str, np.ndarray] = {"t_ns": np.arange(rows, dtype=np.int64) * 10_000_000}
    for i, name in enumerate(("acc_x", "acc_y", "acc_z", "gyr_x", "gyr_y", "gyr_z")):
        counts = np.round(3000 * np.sin(2 * np.pi * t + i) + rng.normal(0, 30, rows))
        columns[name] = counts * (9.80665 / 2048 if i < 3 else np.pi / 180 / 16.4)
    return pl.DataFrame(columns)


def _write_peer(path: Path, table: pl.DataFrame) -> None:
    cov, absent = [0.0] * 9, [-1.0] + [0.0] * 8
    quaternion = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
    with path.open("wb") as file:
        writer = Writer(file)
        schema = writer.register_msgdef(IMU, full_text(IMU))
        for t, ax, ay, az, gx, gy, gz in table.iter_rows():
            message = {
                "header": {"stamp": {"sec": t // 10**9, "nanosec": t % 10**9}, "frame_id": "imu1"},
                "orientation": quaternion,
                "orientation_covariance": absent,
                "angular_velocity": {"x": gx, "y": gy, "z": gz},
                "angular_velocity_covariance": cov,
                "linear_acceleration": {"x": ax, "y": ay, "z": az},
                "linear_acceleration_covariance": cov,
            }
            writer.write_message(TOPIC, schema, message, t, t)
        writer.finish()


def _write(path: Path, table: pl.DataFrame) -> None:
    with mr.create(path, overwrite=True) as out:
        out.add_table(TOPIC, IMU, table, frame_id="imu1")


def _read_peer(path: Path) -> pl.DataFrame:
    rows = []
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for *_, message in reader.iter_decoded_messages(log_time_order=False):
            stamp, a, g = message.header.stamp, message.linear_acceleration, message.angular_velocity
            rows.append((stamp.sec * 10**9 + stamp.nanosec, a.x, a.y, a.z, g.x, g.y, g.z))
    names = ("t_ns", *(f"{s}_{a}" for s in ("acc", "gyr") for a in "xyz"))
    return pl.DataFrame(rows, schema=names, orient="row")


def _read(path: Path) -> pl.DataFrame:
    with mr.open(path) as rec:
        return rec.table(TOPIC)


def _seconds(call: Callable[[], T], repeats: int = 2) -> tuple[float, T]:
    """Return the best time of several calls, as many for us as for the peer, and the last result."""
    start = time.perf_counter()
    result = call()
    best = time.perf_counter() - start
    for _ in range(repeats - 1):
        start = time.perf_counter()
        result = call()
        best = min(best, time.perf_counter() - start)
    return best, result


def rows(scale: float = 1.0) -> list[Row]:
    """Return the table's lines for ``scale`` times a million messages."""
    count = max(1000, round(MESSAGES * scale))
    table = readings(count)
    with tempfile.TemporaryDirectory() as folder:
        ours, theirs = Path(folder, "ours.mcap"), Path(folder, "theirs.mcap")
        write_s, _ = _seconds(lambda: _write(ours, table))
        peer_write_s, _ = _seconds(lambda: _write_peer(theirs, table))
        read_s, got = _seconds(lambda: _read(ours))
        peer_read_s, expected = _seconds(lambda: _read_peer(theirs))
    assert got.equals(expected)
    assert got.equals(table)
    what = f"{count:,} Imu messages"
    return [
        _row(f"write {what}", write_s, peer_write_s, 20),
        _row(f"read {what} into columns", read_s, peer_read_s, 80),
    ]


def _row(name: str, ours: float, theirs: float, target: int) -> Row:
    ratio = theirs / ours
    return Row(name, ours, "s", PEER, theirs, ratio, f"≥ {target} times faster", ratio >= target)
