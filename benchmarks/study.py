"""The study of simulated walks: its time, and what a second process gains."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

from . import Row

WALKS = 30
"""Walks of each of the four configurations at scale 1: 480 cells with four filters."""


def rows(scale: float) -> list[Row]:
    """Measure the preset ``foot-simulated`` with one and with two processes, in fresh interpreters."""
    walks = max(1, round(WALKS * scale))
    with tempfile.TemporaryDirectory(prefix="marcha-bench-") as folder:
        _measure(1, 1, Path(folder) / "warm")  # fills numba's caches on disk
        one = _measure(1, walks, Path(folder) / "one")
        two = _measure(2, walks, Path(folder) / "two")
    speed_up = one / two
    return [
        Row(
            name=f"study of {16 * walks} simulated walks: simulate, convert, replay, statistics, report",
            ours=two,
            unit="s on 2 processes",
            peer="1 process",
            theirs=one,
            ratio=speed_up,
            target="≥ 1.7 times faster (efficiency 0.85)",
            met=speed_up >= 1.7,
        )
    ]


def _measure(workers: int, walks: int, folder: Path) -> float:
    """Return the seconds of a whole study; one process means one core, so libraries get one thread."""
    from marcha.replay.study.executors import SINGLE_THREAD

    arguments = [str(workers), str(walks), str(folder)]
    command = [sys.executable, "-W", "ignore", "-m", "benchmarks.study", *arguments]
    done = subprocess.run(
        command,
        env=os.environ | SINGLE_THREAD,
        cwd=Path(__file__).resolve().parents[1],
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    return float(done.stdout)


def _run(workers: int, walks: int, folder: Path) -> float:
    import msgspec
    from marcha.ingest import convert
    from marcha.ingest.simulate import simulate
    from marcha.replay.study import load, run_study

    config, _ = load("foot-simulated")
    assert config.simulate is not None
    config = msgspec.structs.replace(config, simulate=msgspec.structs.replace(config.simulate, walks=walks))
    result = run_study(config, folder, workers=workers, convert=convert, simulate=simulate)
    if result.cells_failed:
        raise RuntimeError(f"{result.cells_failed} cells failed: {result.notes[:1]}")
    return result.elapsed_s


if __name__ == "__main__":
    print(_run(int(sys.argv[1]), int(sys.argv[2]), Path(sys.argv[3])))
