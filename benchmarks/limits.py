"""How much memory and time a long recording takes: ten million rows through every command.

Each command runs as a process of its own on all rows and on a quarter of them: the peer of its time is four
times the quarter's (a time that grows with the rows), the promise of its memory is 600 MB.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import marcha.recording as mr
import numpy as np
import polars as pl

from . import Row

ROWS = 10_000_000
MOST_MB = 600.0
MOST_GROWTH = 1.3
"""Time may grow by so much more than the rows: caches of the machine end somewhere."""
PIECE = 500_000
SCALE = 16 * 9.80665 / 32768


def rows(scale: float = 1.0) -> list[Row]:
    """Return two rows a command: memory, and time against a quarter of the input."""
    count = max(40_000, int(ROWS * scale)) // 4 * 4
    found: list[Row] = []
    with tempfile.TemporaryDirectory(prefix="limits-") as folder:
        whole, quarter = Path(folder) / "whole", Path(folder) / "quarter"
        measured = [_all(quarter, count // 4), _all(whole, count)]
        for (name, _, less_s), (_, peak_mb, took_s) in zip(*measured, strict=True):
            what, ratio = f"{name}: {count / 1e6:g} million rows", took_s / (4 * less_s)
            found += [
                Row(
                    f"{what}, peak memory",
                    peak_mb,
                    "MB",
                    "",
                    None,
                    None,
                    f"≤ {MOST_MB:g} MB",
                    peak_mb <= MOST_MB,
                ),
                Row(
                    f"{what}, processor time",
                    took_s,
                    "s",
                    "4 × a quarter",
                    4 * less_s,
                    ratio,
                    f"≤ {MOST_GROWTH:g} × (grows with the rows)",
                    ratio <= MOST_GROWTH,
                ),
            ]
    return found


def _all(folder: Path, count: int) -> list[tuple[str, float, float]]:
    """Return name, peak memory (MB) and processor time (s) of every command on so many rows."""
    folder.mkdir()
    log, rec, done = folder / "conf-3333-walk.csv", folder / "walk.mcap", folder / "done.mcap"
    _serial(log, count)
    _sensor(folder / "shank.csv", count)
    _recording(rec, count)
    commands: list[tuple[str, list[object]]] = [
        ("convert", ["convert", log, "-o", folder / "out.mcap"]),
        ("convert inertial-csv", ["convert", folder / "shank.csv", "-o", folder / "leg.mcap"]),
        ("check", ["check", rec]),
        ("replay", ["replay", rec, "-e", "foot.9iez", "-o", done]),
        ("evaluate", ["evaluate", done]),
        ("export csv", ["export", rec, "--to", "csv", "-o", folder / "csv"]),
        ("view --rrd", ["view", rec, "--rrd", folder / "walk.rrd"]),
        ("cut", ["cut", rec, "--start", "10", "--end", str(count // 110), "-o", folder / "cut.mcap"]),
        ("merge", ["merge", rec, rec, "--prefix", "/a", "--prefix", "/b", "-o", folder / "merged.mcap"]),
        (
            "annotate add",
            ["annotate", "add", rec, "--label", "x", "--from", "1", "-o", folder / "noted.mcap"],
        ),
        ("anonymize", ["anonymize", rec, "-o", folder / "nobody.mcap"]),
        ("report", ["report", done, "--no-picture", "-o", folder / "page.html"]),
        ("export bids", ["export", rec, "--to", "bids", "-o", folder / "bids"]),
        ("convert bids", ["convert", folder / "bids", "-o", folder / "back.mcap"]),
    ]
    return [(name, *_measured(arguments)) for name, arguments in commands]


def _walk(start: int, count: int) -> np.ndarray:
    """Return readings (count, 6) of a foot that rests for 3 s and then swings once a second, at 100 Hz."""
    k = np.arange(start, start + count)
    phase = np.clip((k % 100) / 100 - 0.55, 0, None) / 0.45 * (k >= 300)
    noise = np.random.default_rng(start).normal(0, 0.01, (count, 6))
    noise[:, 0] += 8 * np.sin(2 * np.pi * phase)
    noise[:, 2] += 9.80665 + 3 * np.sin(4 * np.pi * phase)
    noise[:, 4] += 4 * np.sin(2 * np.pi * phase)
    return noise


def _serial(path: Path, count: int) -> None:
    with path.open("wb") as out:
        for start in range(0, count, PIECE):
            n = min(PIECE, count - start)
            walk = _walk(start, n)
            raw = np.hstack([np.rint(walk[:, :3] / SCALE), np.rint(np.degrees(walk[:, 3:]) * 16.4)]).astype(
                np.int64
            )
            table = np.column_stack([np.arange(start, start + n) * 10, raw, raw])
            pl.from_numpy(table).write_csv(out, include_header=False)


def _sensor(path: Path, count: int) -> None:
    """Write the table of one sensor on a leg, of the text formats the one whose checks hold most."""
    names = ["time_ms", *(f"a{a}_g" for a in "xyz"), *(f"g{a}_dps" for a in "xyz")]
    with path.open("wb") as out:
        for start in range(0, count, PIECE):
            n = min(PIECE, count - start)
            walk = _walk(start, n) * np.array([1 / 9.80665] * 3 + [180 / np.pi] * 3)
            table = pl.DataFrame(np.column_stack([np.arange(start, start + n) * 10.0, walk]), schema=names)
            table.write_csv(out, include_header=start == 0, float_precision=5)


def _recording(path: Path, count: int) -> None:
    names = [f"{s}_{a}" for s in ("acc", "gyr") for a in "xyz"]
    with mr.create(path) as out:
        for start in range(0, count, PIECE):
            n = min(PIECE, count - start)
            t_ns = (np.arange(start, start + n, dtype=np.int64) + 100) * 10_000_000
            walk = _walk(start, n)
            columns = {c: walk[:, k] for k, c in enumerate(names)}
            out.add_table(
                "/foot/imu1", "sensor_msgs/msg/Imu", pl.DataFrame({"t_ns": t_ns, **columns}), frame_id="imu1"
            )


_WATCH = """
import os, subprocess, sys
process = subprocess.Popen(sys.argv[1:], stdout=subprocess.DEVNULL)
_, status, usage = os.wait4(process.pid, 0)
print(os.waitstatus_to_exitcode(status), usage.ru_maxrss, usage.ru_utime + usage.ru_stime)
"""
"""Starts a command and watches it: a child's peak memory counts from that of the process that starts it."""


def _measured(arguments: list[object]) -> tuple[float, float]:
    """Run a command; return its peak memory (MB) and its processor time (s)."""
    command = [sys.executable, "-m", "marcha.cli", *map(str, arguments), "-q"]
    watch = [sys.executable, "-S", "-c", _WATCH, *command]
    done = subprocess.run(watch, capture_output=True, text=True, check=True)
    code, peak, took_s = done.stdout.split()
    if int(code) not in (0, 3):
        raise RuntimeError(f"{arguments[0]} ended with {code}: {done.stderr[-500:]}")
    return int(peak) / 1024, float(took_s)


def lines(scale: float) -> Iterator[str]:
    """Yield the figures as text, for a look."""
    for row in rows(scale):
        yield f"{row.name:50} {row.ours:8.1f} {row.unit:3} {'' if row.ratio is None else f'{row.ratio:.2f}'}"


if __name__ == "__main__":
    for line in lines(float(sys.argv[1]) if len(sys.argv) > 1 else 1.0):
        print(line)
