"""Rows logged to Rerun a second, drawing a recording's channels, against logging row by row."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import numpy as np
import polars as pl

from . import Row

TARGET = 1_000_000.0
TOPIC = "/foot/imu1"
IMU = "sensor_msgs/msg/Imu"


def rows(scale: float = 1.0) -> list[Row]:
    """Measure logged entity rows a second into a file, in columns and row by row."""
    n = max(20_000, int(1_000_000 * scale))
    ours, samples = _columns(n)
    theirs = _row_by_row(min(n, 20_000))
    return [
        Row(
            "Rerun: rows logged, an IMU's four entities, to a file",
            ours,
            "rows/s",
            "rerun log(), one scalar a row",
            theirs,
            ours / theirs,
            "at least 1,000,000 rows/s",
            ours >= TARGET,
        ),
        Row(
            "Rerun: IMU samples drawn (10 numbers each)",
            samples,
            "samples/s",
            "",
            None,
            None,
            "at least 250,000 samples/s (four rows each)",
            samples >= TARGET / 4,
        ),
    ]


def _table(n: int) -> pl.DataFrame:
    rng = np.random.default_rng(0)
    names = [f"{s}_{a}" for s in ("acc", "gyr") for a in "xyz"]
    return pl.DataFrame({"t_ns": np.arange(n) * 10_000_000, **{name: rng.normal(size=n) for name in names}})


def _columns(n: int) -> tuple[float, float]:
    import rerun as rr
    from marcha.replay import PlannedChannel
    from marcha.viz.canvas import Canvas
    from marcha.viz.scene import Scene
    from marcha.viz.stream import new_stream
    from marcha.viz.timeaxis import TimeAxis

    table = _table(n)
    channel = PlannedChannel(TOPIC, IMU, columns=tuple(table.columns[1:]))
    with tempfile.TemporaryDirectory() as folder:
        stream = new_stream()
        stream.set_sinks(rr.FileSink(Path(folder) / "x.rrd"))
        scene = Scene(Canvas(stream, [channel], TimeAxis()))
        scene.begin()
        start = time.perf_counter()
        scene.write(TOPIC, table)
        stream.flush()
        seconds = time.perf_counter() - start
        stream.disconnect()
    return scene.canvas.rows / seconds, n / seconds


def _row_by_row(n: int) -> float:
    import rerun as rr
    from marcha.viz.stream import new_stream

    values = _table(n)["acc_x"].to_list()
    with tempfile.TemporaryDirectory() as folder:
        stream = new_stream()
        stream.set_sinks(rr.FileSink(Path(folder) / "x.rrd"))
        start = time.perf_counter()
        for i, value in enumerate(values):
            stream.set_time("time", duration=np.timedelta64(i * 10_000_000, "ns"))
            stream.log("/x", rr.Scalars(value))
        stream.flush()
        seconds = time.perf_counter() - start
        stream.disconnect()
    return n / seconds
