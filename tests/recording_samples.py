"""Tables of every message type, and what the tests of recording share."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import marcha.recording as mr
import numpy as np
import polars as pl

STEP_NS = 10_000_000


def sample_table(
    schema: str, rows: int = 50, seed: int = 0, start_ns: int = 1_700_000_000_123_456_789
) -> pl.DataFrame:
    """Return a table with every column that the type may have, plausible values and a NaN here and there."""
    rng = np.random.default_rng(seed)
    t_ns = start_ns + STEP_NS * np.arange(rows, dtype=np.int64)
    spec = mr.SCHEMAS[schema]
    columns: dict[str, Any] = {"t_ns": t_ns}
    names = ["hip_left", "knee", "Gelenk ä"] if spec.names else [""]
    for name in names:
        for column in spec.columns:
            columns[name + column.name] = _values(column, rng, rows, t_ns)
    return pl.DataFrame(columns)


def _values(column: mr.Column, rng: np.random.Generator, rows: int, t_ns: np.ndarray) -> Any:
    if column.kind == "flag":
        return rng.random(rows) > 0.5
    if column.kind == "time":
        return t_ns - rng.integers(0, 10**9, rows)
    if column.kind == "mac":
        return [f"0{i % 3}:11:22:33:44:ff" for i in range(rows)]
    if column.kind == "technology":
        return [("wifi", "ble", "uwb", "cell", "unknown")[i % 5] for i in range(rows)]
    if column.kind == "text":
        return [("foot", "map", "a long name")[i % 3] for i in range(rows)]
    integer = {"index": pl.UInt32, "status": pl.Int8, "service": pl.UInt16}.get(column.name)
    if integer is not None:
        return pl.Series(np.arange(rows) % 3, dtype=integer)
    if column.kind == "sigma":
        return rng.integers(1, 50, rows) * 0.5  # squares and roots of these are exact
    values = rng.normal(size=rows)
    values[::7] = np.nan
    return values


def write(path: Path, topics: dict[str, tuple[str, pl.DataFrame]], **options: Any) -> Path:
    """Write tables by topic and return the path."""
    with mr.create(path, **options) as out:
        for topic, (schema, table) in topics.items():
            out.add_table(
                topic, schema, table, frame_id="frame" if schema != "tf2_msgs/msg/TFMessage" else ""
            )
    return path


def imu(rows: int, seed: int = 0, start_ns: int = 0, step_ns: int = STEP_NS) -> pl.DataFrame:
    """Return an accelerometer and gyroscope table."""
    rng = np.random.default_rng(seed)
    names = ("acc_x", "acc_y", "acc_z", "gyr_x", "gyr_y", "gyr_z")
    times = start_ns + step_ns * np.arange(rows, dtype=np.int64)
    return pl.DataFrame({"t_ns": times, **{n: rng.normal(size=rows) for n in names}})
