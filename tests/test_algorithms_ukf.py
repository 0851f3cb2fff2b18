"""The unscented filter against sampling, and against the linearized one where both must agree."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from marcha.algorithms import make
from marcha.algorithms.foot import ukf as foot_ukf
from marcha.algorithms.foot.sample import SAMPLE
from marcha.algorithms.numerics.records import attributes
from scipy.spatial.transform import Rotation

from .algorithms_support import columns, run, simulated

FORCE = np.array([2.0, -1.0, 9.5])


@pytest.mark.parametrize("sigma_att", [0.02, 0.3])
def test_prediction_equals_sampling(sigma_att: float) -> None:
    rng = np.random.default_rng(5)
    dt, n = 0.5, 400_000
    sd = np.array([1.0, 0.6, 0.8, 0.1, 0.2, 0.3, 0.05, 0.04, 0.03])
    sd[:3] *= sigma_att
    estimator: Any = make("foot.ukf", preset="published", sigma_gyr=0.0, sigma_acc=0.0)
    state = estimator.record
    state.P[:] = np.diag(sd**2)
    state.step_force[:] = FORCE
    r = attributes(np.zeros(1, SAMPLE))[0]
    r.dt = dt
    foot_ukf.predict(state, r)

    error = rng.standard_normal((n, 9)) * sd
    true_force = Rotation.from_rotvec(-error[:, :3]).apply(FORCE)
    velocity = error[:, 6:] + (FORCE - true_force) * dt
    position = error[:, 3:6] + 0.5 * (error[:, 6:] + velocity) * dt
    after = np.column_stack([error[:, :3], position, velocity])
    # The transform is exact to second order for the mean: what is left is of fourth order in the angle.
    left = 0.2 * sigma_att**4 * np.linalg.norm(FORCE) * dt
    noise = 5 * after[:, 6:].std(axis=0) / np.sqrt(n)
    assert np.all(np.abs(-state.vel - velocity.mean(axis=0)) < noise + left)
    measured = np.cov(after.T)
    found = state.P
    if sigma_att < 0.1:
        scale = np.sqrt(np.outer(np.diag(measured), np.diag(measured)))
        assert np.max(np.abs(found - measured) / scale) < 0.01
    else:  # mixed fourth moments are not captured: the transform errs on the safe side
        share = np.diag(found) / np.diag(measured)
        assert np.all((share > 0.97) & (share < 2.0))


def test_equals_the_linearized_filter_while_angles_are_small() -> None:
    rows, _ = simulated("rectangle", seed=3)
    linear, _ = run("foot.9iez", rows)
    unscented, _ = run("foot.ukf", rows)
    gap = columns(linear, "pose", "pos_x", "pos_y", "pos_z") - columns(
        unscented, "pose", "pos_x", "pos_y", "pos_z"
    )
    assert np.nanmax(np.abs(gap)) < 2e-3
    np.testing.assert_allclose(columns(linear, "sigma")[-1], columns(unscented, "sigma")[-1], rtol=5e-3)


def test_sigma_points_of_any_scaling_give_the_same_small_angle_covariance() -> None:
    rows, _ = simulated("rectangle", seed=3)
    plain, _ = run("foot.ukf", rows[:600], preset="published")
    scaled, _ = run("foot.ukf", rows[:600], preset="published", alpha=0.5, kappa=1.0)
    np.testing.assert_allclose(columns(plain, "sigma"), columns(scaled, "sigma"), rtol=1e-3, atol=1e-12)


@pytest.mark.parametrize("rank", [0, 3, 9])
def test_root_of_a_semidefinite_matrix(rank: int) -> None:
    rng = np.random.default_rng(rank)
    half = np.zeros((9, 9))
    half[:, :rank] = rng.standard_normal((9, rank))
    matrix = half @ half.T
    root = np.full((9, 9), np.nan)
    foot_ukf.semidefinite_root(matrix, root)
    np.testing.assert_allclose(root @ root.T, matrix, atol=1e-6)
