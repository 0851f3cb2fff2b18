"""The preset `device`: the filters' own sigma against the truth of walks with the simulated device's errors.

The preset was chosen on rectangles of the seeds 1 to 200; the seeds here are others.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from scipy.stats import chi2

from .algorithms_support import columns, run, simulated

FILTERS = ("foot.9iez", "foot.15iez-zaru", "foot.ukf")
SEEDS = range(2001, 2031)


@cache
def squared_errors(name: str, scenario: str, preset: str) -> np.ndarray:
    """Return the squared error at the end of every walk in units of sigma: position, velocity (n, 2, 3)."""
    found = []
    for seed in SEEDS:
        draw = np.random.default_rng([seed, 1])
        gait = {"stride_m": draw.uniform(1.15, 1.45), "stride_s": draw.uniform(1.05, 1.35)}
        for sensor in (1, 2):
            rows, walk = simulated(scenario, seed, sensor, **gait)
            result, _ = run(name, rows, preset=preset)
            position = columns(result, "pose", "pos_x", "pos_y", "pos_z")
            start = np.flatnonzero(np.isfinite(position[:, 0]))[0]
            error = np.stack(
                (
                    position[-1] - position[start] - (walk.pos[-1] - walk.pos[start]),
                    columns(result, "velocity")[-1] - walk.vel[-1],
                )
            )
            sigma = columns(result, "sigma")[-1, :6].reshape(2, 3)
            found.append((error / sigma) ** 2)
    return np.array(found)


def nees(name: str, scenario: str, preset: str) -> tuple[float, float]:
    """Return the mean normalized squared error of position and of velocity."""
    position, velocity = squared_errors(name, scenario, preset).sum(axis=2).mean(axis=0)
    return float(position), float(velocity)


def bounds() -> tuple[float, float]:
    n = 2 * len(SEEDS)
    low, high = chi2.ppf([0.005, 0.995], 3 * n) / n
    return float(low), float(high)


@pytest.mark.parametrize("name", FILTERS)
def test_the_position_error_of_a_closed_walk_is_as_large_as_the_filter_says(name: str) -> None:
    low, high = bounds()
    assert low < nees(name, "rectangle", "device")[0] < high


@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.parametrize("scenario", ["rectangle", "figure-eight", "stairs"])
def test_no_filter_is_too_sure_of_a_closed_walk(name: str, scenario: str) -> None:
    position, velocity = nees(name, scenario, "device")
    assert position < bounds()[1]
    assert velocity < bounds()[1]


def test_the_sources_values_are_too_sure_on_this_device() -> None:
    position, velocity = nees("foot.9iez", "rectangle", "published")
    assert position > 2 * bounds()[1]
    assert velocity > 2 * bounds()[1]


def test_across_a_straight_walk_sigma_holds_and_along_it_the_scale_error_is_in_no_model() -> None:
    along, across, _ = squared_errors("foot.9iez", "straight", "device")[:, 0].mean(axis=0)
    assert across < 1.5
    assert along > 10
