"""Ceilings of gyroscopes below their nominal range: found where they are, not where a walk is only regular."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from marcha.ingest import convert
from marcha.ingest import simulate as sim
from marcha.ingest.ceiling import CeilingSearch


def search(values: np.ndarray, block: int = 10**9) -> list[tuple[float, int, int]]:
    found = CeilingSearch()
    for k in range(0, len(values), block):
        found.feed(values[k : k + block], np.arange(k, min(k + block, len(values))))
    return found.ceilings()


def swings(seed: int, ceiling: float | None, scatter: float = 0.004) -> np.ndarray:
    """Return 40 swings of differing height at 200 Hz, cut at a ceiling and blurred."""
    rng = np.random.default_rng(seed)
    t = np.arange(0, 40.0, 1 / 200)
    rate = rng.uniform(8.0, 13.0, 40)[t.astype(int)] * np.sin(2 * np.pi * t)
    if ceiling is not None:
        rate = np.clip(rate, -100.0, ceiling)
        rate = rate + scatter * ceiling * rng.normal(size=len(t)) * (rate > 0.9 * ceiling)
    return rate


@given(seed=st.integers(0, 100), block=st.sampled_from([50, 333, 4096]))
def test_a_blurred_ceiling_is_found_however_the_log_is_cut(seed: int, block: int) -> None:
    values = swings(seed, 7.0)
    ((ceiling, waves, line),) = search(values, block)
    assert 6.9 < ceiling < 7.5
    assert waves >= 20
    assert values[line] > 0.95 * ceiling
    assert search(values) == search(values, block)


@given(seed=st.integers(0, 100))
def test_regular_swings_are_no_ceiling(seed: int) -> None:
    rng = np.random.default_rng(seed)
    t = np.arange(0, 40.0, 1 / 200)
    alike = 9.0 * np.sin(2 * np.pi * t) * (1 + 0.003 * rng.normal(size=len(t)))
    assert search(alike) == []
    assert search(swings(seed, None)) == []


def test_a_simulated_walk_has_none() -> None:
    walk = sim.walk("rectangle", seed=3, length_m=60.0)
    assert all(search(axis) == [] for axis in walk.measured()[1].T)


@pytest.mark.data
def test_real_ceilings_are_reported(data_dir: Path, tmp_path: Path) -> None:
    """The Vicon sensor stops near 9.2 rad/s, the footprints' near 8.8 (source data README)."""

    def clipped(path: Path) -> list[Any]:
        done = convert([path], tmp_path / f"{path.stem}.mcap")
        return [f for f in done.report.findings if f.kind == "clipped"]

    foot = data_dir / "foot"
    assert "gyr_y" in clipped(foot / "vicon/2017-11-22-11-36-45.mat")[0].detail
    assert "gyr_y" in clipped(foot / "footprints/SensorConnectData_35.csv")[0].detail
    assert not clipped(foot / "vicon/2017-11-22-11-23-25.mat")
    assert not clipped(foot / "footprints/SensorConnectData_32.csv")
