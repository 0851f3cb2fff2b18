"""The defaults' own standard deviations against the truth: simulated walks of an unkind device, and real ones."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from marcha.replay.metrics import nees_bounds

from benchmarks.foot_consistency import INSIDE, SEEDS, real, squared_errors


@cache
def ends(scenario: str) -> np.ndarray:
    """Return NEES of position, velocity and attitude at the end of each walk (n, 3), sensors in turn."""
    return squared_errors("foot.9iez", scenario)


@pytest.mark.parametrize("scenario", ["rectangle", "figure-eight", "stairs", "straight"])
def test_the_defaults_are_not_too_sure_of_an_unkind_device(scenario: str) -> None:
    """Careful is allowed, sure is not: what a figure-eight cancels is in no model."""
    assert (ends(scenario).mean(axis=0) < nees_bounds(len(SEEDS))[1]).all()


def test_over_all_scenarios_position_and_attitude_are_as_far_off_as_they_say() -> None:
    pooled = np.concatenate([ends(s) for s in ("rectangle", "figure-eight", "stairs", "straight")])
    low, high = nees_bounds(len(SEEDS))
    position, velocity, turn = pooled.mean(axis=0)
    assert 0.8 * low < position < high, position  # figure-eights and stairs cancel what is considered
    assert low < velocity < high, velocity
    assert low < turn < high, turn


@pytest.mark.data
def test_real_walks_end_within_their_ellipsoids(data_dir: Any, tmp_path: Path) -> None:
    """Twelve Vicon trials, headings laid upon the reference over the first three metres."""
    for name, squares in real(data_dir, tmp_path).items():
        assert len(squares) == 12
        assert np.median(squares) < 6.0
        assert np.mean(squares <= INSIDE) >= 0.9, (name, np.round(squares, 1))
