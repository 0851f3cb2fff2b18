"""Steps and fixes fused: honest covariance, a lost signal bridged, an outlier that bends nothing."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest
from marcha.ingest.simulate import phone_walk
from marcha.replay import nees_bounds
from marcha.replay.metrics_place import squared

from .phone_runs import carried, fused, run_phone, sensor_tables


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


def test_the_receivers_velocity_turns_and_scales_the_track() -> None:
    """A drifting heading and steps that are too long are put right, and what is stated of it holds."""
    end, size = [], {False: [], True: []}
    for seed in range(6):
        for velocity, errors in size.items():
            _, error, cov = carried(seed, velocity=velocity)
            errors.append(np.hypot(*error.T).mean())
            if velocity:
                end.append(squared(error[-1:], cov[-1:])[0])
    assert np.mean(size[True]) < np.mean(size[False])
    low, high = nees_bounds(len(end), dof=2, confidence=0.99)
    assert low < np.mean(end) < high


def test_a_velocity_of_a_car_is_not_believed() -> None:
    walk = phone_walk("phone-100m", seed=12, rate_hz=25, pressure_hz=0, gnss_hz=0.2)
    usual = sensor_tables(walk, velocity=True)
    wrong = pl.when(pl.int_range(pl.len()) == 8).then(pl.col("vel_x") + 9.0).otherwise(pl.col("vel_x"))
    off = usual | {"velocity": usual["velocity"].with_columns(vel_x=wrong)}
    tracks = [
        run_phone("phone.fused", tables)["pose"].select("pos_x", "pos_y").to_numpy()
        for tables in (usual, off)
    ]
    assert 0.0 < np.hypot(*(tracks[0] - tracks[1]).T).max() < 2.0


@pytest.mark.parametrize("at_s", [40.0, 75.0])
def test_an_outlier_of_fifty_metres_moves_the_track_by_less_than_three(at_s: float) -> None:
    usual, off = (
        fused(phone_walk("phone-100m", seed=11, rate_hz=25, pressure_hz=0, gnss_outliers=o))
        for o in ((), ((at_s, 50.0),))
    )
    np.testing.assert_array_equal(usual[0], off[0])
    assert 0.0 < np.hypot(*(usual[1] - off[1]).T).max() < 3.0
