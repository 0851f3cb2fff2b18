"""Turns that a gyroscope cut off are put back; what it did not cut off is left alone."""

from __future__ import annotations

import numpy as np
import pytest
from marcha.algorithms.foot import ceiling
from marcha.algorithms.numerics.records import kernel_view, record_type

from .algorithms_support import columns, run, simulated

SAMPLE = record_type(("dt", "f8"), ("gyr", "f8", (3,)), ("gyr_norm", "f8"), ("doubt", "f8", (3,)))


def put_back(rates: np.ndarray, rate_hz: float, released: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return the rates about one axis as the search leaves them, and the variance that it adds, both (n,)."""
    ring = kernel_view(np.zeros(1024 * SAMPLE.itemsize, np.uint8), SAMPLE, 0, 1024)
    state = kernel_view(np.zeros(ceiling.CEILING.itemsize, np.uint8), ceiling.CEILING, 0)
    state["edge"] = max(2, round(ceiling.EDGE_S * rate_hz))
    state["axes"]["pending"][..., 0] = -1
    for k, rate in enumerate(rates):
        ring[k]["dt"] = 1.0 / rate_hz
        ring[k]["gyr"][1] = rate
        watch(state, ring, k, released)
    n = len(rates)
    return ring["gyr"][:n, 1].copy(), ring["doubt"][:n, 1].copy()


def watch(state: np.ndarray, ring: np.ndarray, k: int, released: int) -> None:
    ceiling.watch(state[0], ring, k, released)


def swings(rate_hz: float, peak: float = 10.0) -> np.ndarray:
    """Return five half sines of 0.3 s, 0.5 s apart, a whole peak each."""
    t = np.arange(0.0, 2.5, 1.0 / rate_hz) % 0.5
    return peak * np.sin(np.pi * np.clip((t - 0.1) / 0.3, 0.0, 1.0))


@pytest.mark.parametrize("rate_hz", [100.0, 200.0, 400.0])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_half_of_what_is_lost_comes_back_at_least(rate_hz: float, side: float) -> None:
    true = swings(rate_hz)
    cut = np.minimum(true, 8.5)
    rates, doubt = put_back(side * cut, rate_hz)
    lost = (true - cut).sum() / rate_hz
    assert 0.5 * lost < (side * rates - cut).sum() / rate_hz < 1.5 * lost
    assert (doubt[np.abs(rates - side * cut) > 0.1] > 0).all()


def test_peaks_and_steady_turns_are_left_alone() -> None:
    steady = np.concatenate(
        [swings(200.0, 9.0)[:100], np.linspace(0, 8, 20), np.full(30, 8.0), np.linspace(8, 0, 20)]
    )
    for rates in (swings(100.0), swings(400.0), np.tile(steady, 3)):
        left, doubt = put_back(rates, 200.0)
        assert (left == rates).all()
        assert (doubt == 0).all()


def test_what_was_released_does_not_change() -> None:
    cut = np.minimum(swings(200.0), 8.5)
    rates, _ = put_back(cut, 200.0, released=len(cut))
    assert (rates == cut).all()


def test_a_walk_is_better_for_it_and_says_so() -> None:
    rows, walk = simulated()
    rows[:, 5] = np.clip(rows[:, 5], -0.75 * np.abs(rows[:, 5]).max(), 0.75 * np.abs(rows[:, 5]).max())
    errors = {}
    for unclip in (False, True):
        result, estimator = run("foot.9iez", rows, unclip=unclip)
        pos = columns(result, "pose", "pos_x", "pos_y", "pos_z")
        first = int(np.flatnonzero(np.isfinite(pos[:, 0]))[0])
        true = np.linalg.norm(np.diff(walk.pos[first:], axis=0), axis=1).sum()
        errors[unclip] = abs(np.linalg.norm(np.diff(pos[first:], axis=0), axis=1).sum() - true) / true
        remarks = [r.detail for r in estimator.remarks() if r.kind == "clipped"]
        assert any("put back" in m for m in remarks) == unclip
    assert errors[True] < 0.5 * errors[False]


def test_a_walk_within_the_range_has_the_same_bits() -> None:
    rows, _ = simulated()
    with_it, without = (run("foot.9iez", rows, unclip=u)[0] for u in (True, False))
    assert all(np.array_equal(with_it[c], without[c], equal_nan=True) for c in with_it)
