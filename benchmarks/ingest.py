"""Convert serial text of the shoe's device: time against polars reading the same rows, and peak memory."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path

from . import Row

ROWS, LONG = 1_000_000, 10_000_000
ROUNDS = 5
"""Each the best of three of both, one after the other; the median of their ratios counts."""

_WRITE = """
import sys
import numpy as np, polars as pl
out, rows = sys.argv[1], int(sys.argv[2])
rng = np.random.default_rng(0)
with open(out, "wb") as f:
    for start in range(0, rows, 100_000):
        n = min(100_000, rows - start)
        t = (np.arange(start, start + n) * 10 + 5000) % 2**32
        step = np.sin(np.arange(start, start + n) * 0.05)[:, None]
        still = (step < 0) * 1.0
        counts = rng.normal(0, 8 + 60 * (1 - still), (n, 12)) + 3000 * step * (1 - still)
        counts[:, [2, 8]] += 2048
        table = pl.DataFrame({"t": t} | {f"c{k}": counts[:, k].round().astype(np.int16) for k in range(12)})
        f.write(table.write_csv(include_header=False, line_terminator="\\r\\n\\r\\n").encode())
"""
_CONVERT = """
import json, pathlib, re, sys, time
from marcha.ingest import convert
source, out = sys.argv[1:3]
best = 1e9
for _ in range(int(sys.argv[3])):
    start = time.perf_counter()
    done = convert(source, out, overwrite=True)
    best = min(best, time.perf_counter() - start)
status = pathlib.Path("/proc/self/status")  # ru_maxrss would count the memory of the process that forked us
peak = re.findall(r"VmHWM:\\s+(\\d+)", status.read_text()) if status.exists() else []
mb = int(peak[0]) / 1024 if peak else float("nan")
print(json.dumps({"s": best, "mb": mb, "rows": done.report.rows_kept}))
"""
_POLARS = """
import json, sys, time
import polars as pl
best = 1e9
for _ in range(int(sys.argv[2])):
    start = time.perf_counter()
    table = pl.read_csv(sys.argv[1], has_header=False)
    best = min(best, time.perf_counter() - start)
print(json.dumps({"s": best}))
"""


def _run(code: str, *args: object) -> dict[str, float]:
    done = subprocess.run(
        [sys.executable, "-c", code, *map(str, args)], check=True, capture_output=True, text=True
    )
    return json.loads(done.stdout) if done.stdout else {}


def rows(scale: float) -> list[Row]:
    """Return time against polars and peak memory on a long text."""
    with tempfile.TemporaryDirectory() as folder:
        text, out = Path(folder, "conf-3333-long.csv"), Path(folder, "out.mcap")
        count = max(1000, int(ROWS * scale))
        _run(_WRITE, text, count)
        rounds: list[tuple[float, float, float]] = []
        for _ in range(ROUNDS):  # in turn: a machine that others use is not equally fast all the time
            theirs = _run(_POLARS, text, 3)["s"]
            done = _run(_CONVERT, text, out, 3)
            assert done["rows"] == count
            rounds.append((done["s"] / theirs, done["s"], theirs))
        ratio, ours, theirs = sorted(rounds)[ROUNDS // 2]
        long = max(1000, int(LONG * scale))
        _run(_WRITE, text, long)
        peak = _run(_CONVERT, text, out, 1)
        assert peak["rows"] == long
    return [
        Row(
            f"convert {count:,} rows of serial text (times polars' time)",
            ours,
            "s",
            "polars.read_csv",
            theirs,
            ratio,
            "≤ 4",
            ratio <= 4,
        ),
        Row(
            f"convert {long:,} rows: peak memory",
            peak["mb"],
            "MB",
            "",
            None,
            None,
            "≤ 1000 MB",
            peak["mb"] <= 1000,
        ),
    ]
