"""Steps and fixes fused: honest covariance, a lost signal bridged, an outlier that bends nothing."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
from marcha.ingest.simulate import PhoneWalk, phone_walk
from marcha.replay import nees_bounds
from marcha.replay.metrics_place import Plane, squared, stated_covariances

from .phone_runs import run_phone, sensor_tables

PLACEMENTS = ("hand", "pocket", "bag", "armband", "neck", "swinging")
Places = tuple[np.ndarray, np.ndarray, np.ndarray]


def fused(walk: PhoneWalk) -> Places:
    """Return times (s), errors (n, 2) in metres, and covariances (n, 2, 2) that ``phone.fused`` states."""
    out = run_phone("phone.fused", sensor_tables(walk))
    fix = out["fix"]
    t = fix["t_ns"].to_numpy() - walk.t_ns[0]
    place = Plane(walk.options.lat_deg, walk.options.lon_deg)(fix)
    true = np.column_stack([np.interp(t, walk.t_ns - walk.t_ns[0], walk.pos[:, i]) for i in range(2)])
    return t * 1e-9, place - true, stated_covariances(fix, out["state"])


@cache
def carried(seed: int, scenario: str = "phone-100m") -> Places:
    rng = np.random.default_rng(seed)
    options: dict[str, Any] = {
        "placement": PLACEMENTS[seed % 6],
        "course_deg": float(rng.uniform(0, 360)),
        "step_m": float(rng.uniform(0.6, 0.8)),
        "step_s": float(rng.uniform(0.5, 0.6)),
    }
    return fused(phone_walk(scenario, seed=seed, rate_hz=25, pressure_hz=0, **options))


def test_the_stated_covariance_holds() -> None:
    """Walks of their own; benchmarks/phone_consistency.py has a hundred."""
    walks = range(12)
    end = [squared(e[-1:], cov[-1:])[0] for _, e, cov in map(carried, walks)]
    low, high = nees_bounds(len(walks), dof=2, confidence=0.99)
    assert low < np.mean(end) < high
    inside = [np.mean(squared(e, cov) <= 5.99) for _, e, cov in map(carried, walks)]
    assert 0.85 < np.mean(inside) <= 1.0


@pytest.mark.parametrize(("placement", "bound_m"), [("hand", 8.0), ("pocket", 12.0), ("bag", 12.0)])
def test_sixty_seconds_without_a_signal_are_bridged(placement: str, bound_m: float) -> None:
    end = []
    for seed in range(2):
        walk = phone_walk(
            "phone-city",
            seed=seed,
            placement=placement,
            rate_hz=25,
            pressure_hz=0,
            gnss_loss=((120.0, 60.0),),
        )
        t, error, cov = fused(walk)
        k = int(np.searchsorted(t, 180.0)) - 1
        end.append(float(np.hypot(*error[k])))
        assert squared(error[k : k + 1], cov[k : k + 1])[0] < 16.0
    assert np.mean(end) <= bound_m


@pytest.mark.parametrize("at_s", [40.0, 75.0])
def test_an_outlier_of_fifty_metres_moves_the_track_by_less_than_three(at_s: float) -> None:
    usual, off = (
        fused(phone_walk("phone-100m", seed=11, rate_hz=25, pressure_hz=0, gnss_outliers=o))
        for o in ((), ((at_s, 50.0),))
    )
    np.testing.assert_array_equal(usual[0], off[0])
    assert 0.0 < np.hypot(*(usual[1] - off[1]).T).max() < 3.0
