"""Export of a million Imu messages against polars writing the same columns, and memory over ten times as many."""

from __future__ import annotations

import re
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import marcha.recording as mr
import numpy as np
import polars as pl
from marcha.export import export

from . import Row

MESSAGES = 1_000_000
REPEATS = 3
TARGETS = {"parquet": 1.5, "csv": 2.0, "bids": 3.0}
FLAT = 1.5
"""Most that the memory over ten times the rows may be, of that over the rows."""


def readings(count: int) -> pl.DataFrame:
    """Return readings of one sensor at 100 Hz."""
    rng = np.random.default_rng(1)
    t_ns = 1_700_000_000_000_000_000 + 10_000_000 * np.arange(count)
    return pl.DataFrame(
        {"t_ns": t_ns, **{f"{s}_{a}": rng.normal(0, 3, count) for s in ("acc", "gyr") for a in "xyz"}}
    )


def write(path: Path, count: int) -> mr.Recording:
    """Write a recording of readings and open it."""
    with mr.create(path) as out:
        for start in range(0, count, MESSAGES):
            part = readings(min(MESSAGES, count - start)).with_columns(pl.col("t_ns") + 10_000_000 * start)
            out.add_table("/foot/imu", "sensor_msgs/msg/Imu", part, frame_id="imu")
    return mr.open(path)


def rows(scale: float = 1.0) -> list[Row]:
    """Return the table's lines."""
    count = max(1000, round(MESSAGES * scale))
    found = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        rec = write(folder / "walk.mcap", count)
        table = rec.table("/foot/imu")
        motion = table.select((pl.col("t_ns") - rec.start_ns) / 1e9, *table.columns[1:])
        peers: dict[str, Callable[[], object]] = {
            "parquet": lambda: table.write_parquet(folder / "p.parquet"),
            "csv": lambda: table.write_csv(folder / "p.csv"),
            "bids": lambda: motion.write_csv(folder / "p.tsv", separator="\t", include_header=False),
        }
        for to, peer in peers.items():
            ours, theirs = [], []
            for _ in range(REPEATS):  # in turn: what disturbs one disturbs the other
                theirs.append(_seconds(peer))
                ours.append(_seconds(lambda to=to: export(rec, to, folder / to)))
                shutil.rmtree(folder / to)
            ratio = min(ours) / min(theirs)
            what = f"export {count:,} Imu messages as {to}"
            found.append(
                Row(
                    what,
                    min(ours),
                    "s",
                    "polars, the same columns",
                    min(theirs),
                    ratio,
                    f"≤ {TARGETS[to]}",
                    ratio <= TARGETS[to],
                )
            )
        few, many = folder / "few.mcap", folder / "many.mcap"
        write(few, count)
        write(many, 10 * count)
        for to in ("parquet", "csv", "bids"):
            small, large = (_peak_mb(to, path, folder / f"{to}-memory") for path in (few, many))
            what = f"memory of export as {to}, {10 * count:,} messages"
            found.append(
                Row(
                    what,
                    large,
                    "MB",
                    f"{count:,} messages",
                    small,
                    large / small,
                    f"≤ {FLAT}",
                    large / small <= FLAT,
                )
            )
    return found


def _seconds(call: Callable[[], object]) -> float:
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def _peak_mb(to: str, path: Path, out: Path) -> float:
    """Return the largest memory of a process that exports a recording."""
    done = subprocess.run(
        [sys.executable, "-m", __name__, to, str(path), str(out)], capture_output=True, text=True, check=True
    )
    shutil.rmtree(out)
    return float(done.stdout)


if __name__ == "__main__":
    export(mr.open(sys.argv[2]), sys.argv[1], sys.argv[3])
    status = Path("/proc/self/status")  # ru_maxrss would count the memory of the process that forked us
    peak = re.findall(r"VmHWM:\s+(\d+)", status.read_text()) if status.exists() else []
    print(int(peak[0]) / 1024 if peak else resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
