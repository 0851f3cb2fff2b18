"""One process may replay, export and draw as often as it likes (``python -m tests.flat 500`` does it 500 times)."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from .conftest import ROOT


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="needs /proc")
def test_threads_files_and_memory_stay_flat() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "tests.flat", "40"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    for name in ("replay", "export", "rrd"):
        assert f"{name}: 40 more times: " in done.stdout
