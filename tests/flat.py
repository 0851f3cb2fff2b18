"""What one process holds after many replays, exports and Rerun files: ``python -m tests.flat 500``."""

from __future__ import annotations

import os
import sys
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import marcha.recording as mr

from .contracts.exporter import example

POOLED = 4
"""Threads by which the pools of Rerun (tokio ends idle ones after 10 s) and jemalloc grow and shrink, however many
calls there were; a thread lost in each call would be as many as the calls."""


class Held(NamedTuple):
    """What a process holds: threads of the system, open files, resident memory (MB)."""

    threads: int
    files: int
    memory_mb: float


def held() -> Held:
    """Return what this process holds now."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    threads = len(os.listdir("/proc/self/task"))
    return Held(threads, len(os.listdir("/proc/self/fd")), pages * os.sysconf("SC_PAGE_SIZE") / 1e6)


def tasks(folder: Path) -> dict[str, Callable[[], object]]:
    """Return what is done again and again."""
    from marcha.export import export
    from marcha.replay import replay
    from marcha.viz import write_rrd

    source = example(folder / "example.mcap", 600)

    def replayed() -> None:
        with mr.open(source) as rec:
            replay(rec, ["foot.naive"], inputs=["/foot/imu1"], out=folder / "out.mcap", overwrite=True)

    def exported() -> None:
        with mr.open(source) as rec:
            export(rec, "csv", folder / "csv", overwrite=True)
            export(rec, "parquet", folder / "parquet", overwrite=True)

    def drawn() -> None:
        with mr.open(source) as rec:
            write_rrd(rec, folder / "out.rrd", overwrite=True)

    return {"replay": replayed, "export": exported, "rrd": drawn}


def growth(task: Callable[[], object], count: int, before: int = 10) -> Held:
    """Return how much more a process holds after ``count`` times than after the first ``before``."""
    for _ in range(before):
        task()
    first = held()
    for _ in range(count):
        task()
    last = held()
    return Held(last.threads - first.threads, last.files - first.files, last.memory_mb - first.memory_mb)


def main() -> int:
    """Print how much each task grows; exit code 1 where it is not flat."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 500
    bad = 0
    with tempfile.TemporaryDirectory(prefix="flat-") as folder:
        for name, task in tasks(Path(folder)).items():
            more = growth(task, count)
            flat = more.threads <= POOLED and more.files <= 0 and more.memory_mb < 20
            bad += not flat
            print(
                f"{name}: {count} more times: {more.threads} threads, {more.files} files, {more.memory_mb:.1f} MB"
            )
    print(f"{threading.active_count()} threads of Python at the end")
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
