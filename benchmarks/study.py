"""The study of simulated walks: its time, and what a second process gains.

What is timed is the whole command in a fresh interpreter, from its start until the study is there: imports,
simulation, conversion, replay, evaluation, statistics, figures, report. One and two processes are treated
alike: the same walks into an empty folder, with bytecode and compiled kernels on disk (an environment that
forbids to write bytecode does not count: what is installed has it), one thread a process, in turn; of
:data:`REPEATS` pairs the one with the median ratio counts. CPU seconds (of all processes, children included)
stand beside the wall time: on a machine that others use, wall times of two processes suffer more than those
of one.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from . import Row

WALKS = 30
"""Walks of each of the four configurations at scale 1: 480 cells with four filters."""
REPEATS = 3
"""Runs of each kind, in turn; the pair with the median ratio counts."""


def rows(scale: float) -> list[Row]:
    """Measure the preset ``foot-simulated`` with one and with two processes."""
    walks = max(1, round(WALKS * scale))
    with tempfile.TemporaryDirectory(prefix="marcha-bench-") as folder:
        _measure(1, 1, Path(folder) / "warm")  # fills the caches of bytecode and of numba on disk
        pairs = [
            [_measure(workers, walks, Path(folder) / f"{workers}-{k}") for workers in (1, 2)]
            for k in range(REPEATS)
        ]
    (one, one_cpu), (two, two_cpu) = sorted(pairs, key=lambda p: p[0][0] / p[1][0])[REPEATS // 2]
    speed_up = one / two
    name = f"study of {16 * walks} simulated walks: simulate, convert, replay, statistics, report"
    return [
        Row(
            name=f"{name} (CPU: {one_cpu:.1f} s on 1 process, {two_cpu:.1f} s on 2)",
            ours=two,
            unit="s on 2 processes",
            peer="1 process",
            theirs=one,
            ratio=speed_up,
            target="≥ 1.7 times faster (efficiency 0.85)",
            met=speed_up >= 1.7,
        )
    ]


def _measure(workers: int, walks: int, folder: Path) -> tuple[float, float]:
    """Return wall and CPU seconds of a whole study; a process means a core: libraries get one thread."""
    from marcha.study.executors import SINGLE_THREAD

    arguments = [str(workers), str(walks), str(folder)]
    command = [sys.executable, "-W", "ignore", "-m", "benchmarks.study", *arguments]
    cpu, begin = _children_cpu(), time.monotonic()
    done = subprocess.run(
        command,
        env=os.environ | SINGLE_THREAD | {"PYTHONDONTWRITEBYTECODE": ""},
        cwd=Path(__file__).resolve().parents[1],
        check=True,
        stdout=subprocess.PIPE,
        text=True,
    )
    return float(done.stdout) - begin, _children_cpu() - cpu


def _children_cpu() -> float:
    times = os.times()
    return times.children_user + times.children_system


def _run(workers: int, walks: int, folder: Path) -> None:
    from multiprocessing import forkserver

    import msgspec
    from marcha.study import load, run_study

    config, _ = load("foot-simulated")
    assert config.simulate is not None
    config = msgspec.structs.replace(config, simulate=msgspec.structs.replace(config.simulate, walks=walks))
    result = run_study(config, folder, workers=workers)
    print(time.monotonic())  # a clock that all processes share; the server takes a while to end
    if result.cells_failed:
        raise RuntimeError(f"{result.cells_failed} cells failed: {result.notes[:1]}")
    if workers > 1:
        # Waits for the server that workers are forked from: only then their CPU time counts as ours.
        forkserver._forkserver._stop()  # pyright: ignore[reportAttributeAccessIssue]


if __name__ == "__main__":
    _run(int(sys.argv[1]), int(sys.argv[2]), Path(sys.argv[3]))
