"""Whole commands on a short log, against ``marcha --help``: what a user waits for is mostly what is loaded."""

from __future__ import annotations

import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from marcha.ingest.simulate import simulate

from . import Row

ROUNDS = 5
"""Each command in turn; the median of the ratios to the help before it counts. The first round is not timed:
it writes bytecode and compiled kernels, as the first use after an installation does."""


def _time(*arguments: object) -> float:
    begin = time.perf_counter()
    command = [sys.executable, "-m", "marcha.cli", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode not in (0, 3):
        raise RuntimeError(done.stderr)
    return time.perf_counter() - begin


def rows(scale: float) -> list[Row]:
    """Return a row a command."""
    with tempfile.TemporaryDirectory() as folder:
        log = simulate("rectangle", folder, seed=0).paths[0]
        recording, out = Path(folder, "walk.mcap"), Path(folder, "out.mcap")
        commands = {
            "convert": ("convert", log, "-o", recording, "--force", "--quiet"),
            "replay": ("replay", recording, "-e", "foot.9iez", "-o", out, "--force", "--quiet"),
        }
        taken: dict[str, list[float]] = {name: [] for name in ("--help", *commands)}
        for number in range(ROUNDS + 1):
            for name in taken:
                seconds = _time(*commands.get(name, (name,)))
                if number:
                    taken[name].append(seconds)
    result: list[Row] = []
    for name, most in (("convert", 7.0), ("replay", 9.0)):
        ratio = statistics.median(a / b for a, b in zip(taken[name], taken["--help"], strict=True))
        result.append(
            Row(
                name=f"marcha {name} of a log of 28 s, whole command (times that of marcha --help)",
                ours=statistics.median(taken[name]),
                unit="s",
                peer="marcha --help",
                theirs=statistics.median(taken["--help"]),
                ratio=ratio,
                target=f"≤ {most:g}",
                met=ratio <= most,
            )
        )
    return result
