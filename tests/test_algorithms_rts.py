"""The smoother against the textbook's recursion, against truth, and in pieces."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from marcha.algorithms import AlgorithmError, make, output_columns
from marcha.ingest import simulate as sim

from .algorithms_reference import transition15
from .algorithms_support import columns, rows_of, run, simulated

PARAMS: dict[str, Any] = {
    "sigma_gyr": 0.02,
    "sigma_acc": 0.2,
    "sigma_gyr_bias0": 1e-3,
    "sigma_acc_bias0": 1e-2,
    "sigma_gyr_walk": 1e-4,
    "sigma_acc_walk": 1e-3,
}
POSE = ("pos_x", "pos_y", "pos_z")


def smooth(rows: np.ndarray, **params: Any) -> dict[str, np.ndarray]:
    """Return one array a result column."""
    estimator: Any = make("foot.rts", **params)
    out = estimator.process(rows)
    return {c: out[:, i] for i, c in enumerate(output_columns(estimator))}


def matched_walk(seed: int) -> tuple[np.ndarray, Any]:
    """Return rows whose only error is white noise as the filter assumes it, and the walk."""
    walk = sim.walk("rectangle", seed=seed)
    rng = np.random.default_rng(seed)
    acc = walk.acc_b + 0.2 * rng.standard_normal(walk.acc_b.shape)
    gyr = walk.gyr_b + 0.02 * rng.standard_normal(walk.gyr_b.shape)
    return rows_of(walk.t, acc, gyr), walk


def test_equals_the_textbook_recursion() -> None:
    """Rauch–Tung–Striebel with a pseudo-inverse, from the filter's logged covariances."""
    from marcha.algorithms.foot import rts as f

    rows, _ = simulated("rectangle", seed=2)
    rows = rows[:620]
    estimator: Any = make("foot.rts", preset="published", **PARAMS)
    out = np.empty((len(rows), estimator.width))
    logs = np.zeros(len(rows), f.LOG)
    forward: Any = f.forward
    forward(*estimator.views(estimator.state.copy()), rows, out, logs)
    smoothed = smooth(rows, preset="published", **PARAMS)

    first = int(np.flatnonzero(logs["stage"] == f.START)[0])
    shift, cov = np.zeros(15), logs[-1]["P"]
    found = columns(smoothed, "pose", *POSE), columns(smoothed, "velocity"), columns(smoothed, "sigma")
    filtered = out[:, :3], out[:, 7:10]
    for k in range(len(rows) - 1, first, -1):
        np.testing.assert_allclose(found[0][k] - filtered[0][k], shift[6:9], atol=2e-8)
        np.testing.assert_allclose(found[1][k] - filtered[1][k], shift[9:12], atol=2e-8)
        sigma = np.sqrt(np.diag(cov))[[6, 7, 8, 9, 10, 11, 0, 1, 2]]
        np.testing.assert_allclose(found[2][k], sigma, atol=2e-8)
        log, before = logs[k], logs[k - 1]
        p = before["P"]
        dt = log["dt"]
        trans = transition15(log["force"], log["rot"], dt)
        q = np.repeat([0.02**2 * dt**2, 1e-4**2 * dt, 0.0, 0.2**2 * dt**2, 1e-3**2 * dt], 3)
        prior = trans @ p @ trans.T + np.diag(q)
        correction = np.zeros(15)  # what the updates of sample k added to the state
        for u in range(log["n_updates"]):
            correction -= log["gain"][u] * log["residual"][u]
        scale = np.sqrt(np.where(np.diag(prior) > 0, np.diag(prior), 1.0))
        inverse = np.linalg.pinv(prior / np.outer(scale, scale), rcond=1e-13) / np.outer(scale, scale)
        gain = p @ trans.T @ inverse
        cov = p + gain @ (cov - prior) @ gain.T
        shift = gain @ (correction + shift)


def test_smoothed_attitudes_are_unit_quaternions() -> None:
    rows, _ = simulated("rectangle", seed=2)
    quat = columns(smooth(rows, preset="published", **PARAMS), "pose", "quat_w", "quat_x", "quat_y", "quat_z")
    quat = quat[np.isfinite(quat[:, 0])]
    np.testing.assert_allclose(np.linalg.norm(quat, axis=1), 1.0, atol=1e-12)


def test_is_better_than_the_filter_and_knows_how_good_it_is() -> None:
    filter_square, smooth_square, nees = [], [], []
    params: dict[str, Any] = {
        "preset": "published",
        "sigma_gyr": 0.02,
        "sigma_acc": 0.2,
        "sigma_gyr_bias0": 2e-3,
        "sigma_acc_bias0": 1e-4,
    }
    for seed in range(12):
        rows, walk = matched_walk(seed)
        one, two = run("foot.15iez-zaru", rows, **params)[0], smooth(rows, **params)
        ok = np.isfinite(two["pose.pos_x"])
        errors = [columns(r, "pose", *POSE)[ok] - walk.pos[ok] for r in (one, two)]
        filter_square.append(np.mean(errors[0] ** 2))
        smooth_square.append(np.mean(errors[1] ** 2))
        middle = slice(len(errors[1]) // 4, None, 50)
        sigma = columns(two, "sigma")[ok][middle, :3]
        nees.append(np.mean((errors[1][middle] / sigma) ** 2))
    assert np.mean(smooth_square) < 0.9 * np.mean(filter_square)
    assert 0.4 < np.mean(nees) < 1.8


def test_the_end_is_the_filters() -> None:
    rows, _ = simulated("rectangle", seed=1)
    one, two = run("foot.15iez-zaru", rows)[0], smooth(rows)
    np.testing.assert_allclose(columns(one, "pose")[-1], columns(two, "pose")[-1], atol=1e-12)


def test_sigma_is_never_larger_than_the_filters() -> None:
    rows, _ = simulated("rectangle", seed=1)
    one, two = run("foot.15iez-zaru", rows)[0], smooth(rows)
    ok = np.isfinite(two["pose.pos_x"])
    assert np.all(columns(two, "sigma")[ok] <= columns(one, "sigma")[ok] * (1 + 1e-6) + 1e-9)


def test_positions_do_not_jump_when_the_foot_lands() -> None:
    rows, _ = matched_walk(3)
    params: dict[str, Any] = {"preset": "published", "sigma_gyr": 0.02, "sigma_acc": 0.2}
    one, two = run("foot.15iez-zaru", rows, **params)[0], smooth(rows, **params)

    def jump(result: dict[str, np.ndarray]) -> float:
        """Return the greatest position step that the velocity does not explain."""
        pos, vel = columns(result, "pose", *POSE), columns(result, "velocity")
        moved = np.diff(pos, axis=0) - 0.5 * (vel[1:] + vel[:-1]) * rows[1:, :1]
        return float(np.nanmax(np.abs(moved)))

    assert jump(two) < 0.2 * jump(one)


@pytest.mark.parametrize("segment", [1, 97, 100_000])
def test_segments_change_no_bit(segment: int) -> None:
    rows, _ = simulated("rectangle", seed=1)
    pieces: Any = make("foot.rts")
    whole: Any = make("foot.rts")
    assert pieces.process(rows[:900], segment).tobytes() == whole.process(rows[:900]).tobytes()


def test_steps_are_those_of_the_smoothed_track() -> None:
    rows, _ = simulated("rectangle", seed=1)
    one, two = run("foot.15iez-zaru", rows)[0], smooth(rows)
    taken = np.flatnonzero(np.isfinite(two["step.length_m"]))
    np.testing.assert_array_equal(taken, np.flatnonzero(np.isfinite(one["step.length_m"])))
    pos = columns(two, "pose", "pos_x", "pos_y")[taken]
    length = np.linalg.norm(np.diff(pos, axis=0), axis=1)
    np.testing.assert_allclose(two["step.length_m"][taken][1:], length, atol=1e-9)


@pytest.mark.parametrize("count", [0, 1, 5])
def test_few_rows(count: int) -> None:
    rows, _ = simulated("rectangle", seed=1)
    estimator: Any = make("foot.rts")
    assert estimator.process(rows[:count]).shape == (count, estimator.width)


def test_refuses_to_run_live() -> None:
    with pytest.raises(AlgorithmError, match="offline"):
        make("foot.rts").step(np.zeros(7))
