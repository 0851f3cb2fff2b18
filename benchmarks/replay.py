"""Replay: foot.9iez through the engine, beside a plain NumPy filter and vqf; memory."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import marcha.recording as mr
import numpy as np
import polars as pl
from marcha.algorithms import make
from marcha.ingest.simulate import walk
from marcha.replay import replay

from . import Row

IMU = "sensor_msgs/msg/Imu"
COLUMNS = ("acc_x", "acc_y", "acc_z", "gyr_x", "gyr_y", "gyr_z")
SAMPLES = 1_000_000
PLAIN_SAMPLES = 20_000
PER_SAMPLE, MEMORY_MB = 150_000, 400
IN_BLOCKS, VQF_WHERE_PROMISED = 1_500_000, 1e6 / 0.23
"""Samples a second in blocks, promised for a machine on which vqf takes 0.23 µs a sample: what is compared is
their ratio, 0.345, since machines differ by more than two."""
PAIRS = 5
"""Blocks and vqf are measured in turn; the pair with the median ratio counts."""


def rows(scale: float) -> list[Row]:
    """Measure; ``scale`` 1 replays 1,000,000 samples."""
    n = max(20_000, int(SAMPLES * scale))
    with tempfile.TemporaryDirectory() as folder:
        small, large = Path(folder, "walk.mcap"), Path(folder, "long.mcap")
        readings = _recording(small, n)
        run: Callable[..., Any] = lambda **o: replay(mr.open(small), ["foot.9iez"], **o)  # noqa: E731
        run(end_ns=10**9)  # compile
        run(end_ns=10**9, mode="sample")
        kept = n / _best(lambda: run())
        out = Path(folder, "out.mcap")
        gone: Callable[[], object] = lambda: out.unlink(missing_ok=True)  # noqa: E731
        pairs = [
            (n / _best(lambda: _written(run, out), gone), n / _best(lambda: _vqf(readings)))
            for _ in range(PAIRS)
        ]
        blocks, vqf = sorted(pairs, key=lambda p: p[0] / p[1])[PAIRS // 2]
        single = n / _best(lambda: run(mode="sample"))
        written = n / _best(lambda: _written(run, out, mode="sample"), gone)
        plain = PLAIN_SAMPLES / _best(lambda: _plain_filter(readings[:PLAIN_SAMPLES]))
        _recording(large, 4 * n)
        growth = _peak_mb(large) - _peak_mb(small)
    numpy_loop, library = "9-state filter in plain NumPy, no files", "vqf (C++), orientation only, no files"
    ratio = IN_BLOCKS / VQF_WHERE_PROMISED
    fixed, adaptive = _kernel(readings, detector="c1c2c3"), _kernel(readings)
    return [
        Row("foot.9iez, adaptive detector, kernel alone", adaptive * 1e6, "µs/sample", "detector c1c2c3",
            fixed * 1e6, adaptive / fixed, "≤ 1.3 × c1c2c3", adaptive <= 1.3 * fixed),
        _rate("replay per sample, results in memory", single, numpy_loop, plain, PER_SAMPLE),
        _rate("replay per sample, all six outputs recorded", written, numpy_loop, plain, PER_SAMPLE),
        Row("replay in blocks, results in memory, with metrics", kept, "samples/s", library, vqf, kept / vqf,
            f"≥ {ratio:.3f} × vqf", kept >= ratio * vqf),
        Row("replay in blocks, all six outputs recorded", blocks, "samples/s", library, vqf, blocks / vqf,
            f"≥ {ratio:.3f} × vqf", blocks >= ratio * vqf),
        Row("the same, against the plain filter", blocks, "samples/s", numpy_loop, plain, blocks / plain,
            "", True),
        Row(
            f"memory of a recorded replay, {4 * n:,} samples above {n:,}", growth, "MB", "", None, None,
            f"< {MEMORY_MB} MB", growth < MEMORY_MB,
        ),
    ]  # fmt: skip


def _kernel(readings: np.ndarray, **params: Any) -> float:
    """Return seconds a sample of the filter's compiled loop, without the engine."""
    rows = np.column_stack([np.full(len(readings), 0.01), readings])
    out = np.empty((len(rows), make("foot.9iez", **params).width))  # type: ignore[attr-defined]
    return _best(lambda: make("foot.9iez", **params).run_block(rows, out)) / len(rows)  # type: ignore[attr-defined]


def _rate(name: str, ours: float, peer: str, theirs: float, target: float) -> Row:
    return Row(name, ours, "samples/s", peer, theirs, ours / theirs, f"≥ {target:,}/s", ours >= target)


def _recording(path: Path, n: int) -> np.ndarray:
    """Write ``n`` samples of a simulated walk; return them."""
    source = walk("rectangle", seed=1, duration_s=n / 100 + 10)
    readings = np.hstack(source.measured())[:n]
    table = {"t_ns": source.t_ns[:n]} | {c: readings[:, i].copy() for i, c in enumerate(COLUMNS)}
    with mr.create(path) as out:
        out.add_table("/foot/imu1", IMU, pl.DataFrame(table), frame_id="imu1")
    return readings


def _written(run: Callable[..., Any], path: Path, **options: Any) -> None:
    """Replay into a new recording, and nothing else: no tables in memory, no metrics."""
    run(out=path, keep_tables=False, metrics=False, **options)


def _best(task: Callable[[], Any], before: Callable[[], object] | None = None, times: int = 3) -> float:
    """Return the shortest of a few runs in seconds; ``before`` each, something that does not count."""
    best = float("inf")
    for _ in range(times):
        if before is not None:
            before()
        begin = time.perf_counter()
        task()
        best = min(best, time.perf_counter() - begin)
    return best


def _plain_filter(readings: np.ndarray, dt: float = 0.01) -> None:
    """The error-state filter as one writes it in NumPy: 9 states, C1&C2&C3, zero-velocity updates."""
    eye3, eye9, gravity = np.eye(3), np.eye(9), np.array([0.0, 0.0, -9.81])
    rot, v, p, cov = np.eye(3), np.zeros(3), np.zeros(3), np.zeros((9, 9))
    q = np.diag([1e-4] * 3 + [0.0] * 3 + [1e-2] * 3) * dt * dt
    h, r = np.hstack((np.zeros((3, 6)), eye3)), 1e-4 * eye3
    norms = np.linalg.norm(readings[:, :3], axis=1)
    for k, row in enumerate(readings):
        f, w = row[:3], row[3:]
        rot = rot @ (2 * eye3 + _skew(w) * dt) @ np.linalg.inv(2 * eye3 - _skew(w) * dt)
        force = rot @ f
        v = v + (force + gravity) * dt
        p = p + v * dt
        transition = eye9.copy()
        transition[3:6, 6:9] = eye3 * dt
        transition[6:9, 0:3] = -_skew(force) * dt
        cov = transition @ cov @ transition.T + q
        if 9 < norms[k] < 11 and norms[max(0, k - 9) : k + 1].var() < 3 and np.linalg.norm(w) < 0.6:
            gain = cov @ h.T @ np.linalg.inv(h @ cov @ h.T + r)
            delta = gain @ v
            keep = eye9 - gain @ h
            cov = keep @ cov @ keep.T + gain @ r @ gain.T
            v, p = v - delta[6:], p - delta[3:6]
            rot = (2 * eye3 - _skew(delta[:3])) @ np.linalg.inv(2 * eye3 + _skew(delta[:3])) @ rot


def _skew(w: np.ndarray) -> np.ndarray:
    return np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])


def _vqf(readings: np.ndarray) -> None:
    from vqf import VQF

    VQF(0.01).updateBatch(np.ascontiguousarray(readings[:, 3:]), np.ascontiguousarray(readings[:, :3]))


def _peak_mb(path: Path) -> float:
    """Return the peak memory of a process that replays a recording into another one (Linux; else NaN)."""
    code = (
        "import pathlib, re, sys, marcha.recording as mr; from marcha.replay import replay\n"
        "replay(mr.open(sys.argv[1]), ['foot.9iez'], out=sys.argv[1] + '.out', overwrite=True,"
        " keep_tables=False, metrics=False)\n"
        "status = pathlib.Path('/proc/self/status')\n"  # ru_maxrss would count the parent's memory too
        "text = status.read_text() if status.exists() else ''\n"
        "print(next(iter(re.findall(r'VmHWM:\\s+(\\d+)', text)), 'nan'))\n"
    )
    done = subprocess.run([sys.executable, "-c", code, str(path)], capture_output=True, text=True, check=True)
    return float(done.stdout) / 1024
