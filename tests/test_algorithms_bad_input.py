"""Recordings that cannot be estimated are stated, never computed wrong silently."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from marcha.algorithms import Remark, make

from .algorithms_support import FOOT, columns, rows_of, run, simulated

TURNED = np.diag([1.0, -1.0, -1.0])


def remarks(estimator: Any) -> dict[str, Remark]:
    found = {r.kind: r for r in estimator.remarks()}
    assert all("\n" not in r.detail for r in found.values())
    return found


def positions(result: dict[str, np.ndarray]) -> np.ndarray:
    return columns(result, "pose", "pos_x", "pos_y", "pos_z")


def walking_only() -> np.ndarray:
    rows, walk = simulated()
    moving = np.flatnonzero(~walk.still)
    return rows[moving[0] : moving[-1]]


@pytest.mark.parametrize("name", FOOT)
def test_never_at_rest_estimates_nothing_and_says_so(name: str) -> None:
    result, estimator = run(name, walking_only(), preset="published")
    assert np.isnan(positions(result)).all()
    assert remarks(estimator)["no_rest"].fatal


def test_no_rest_at_the_start_waits_for_the_first_one() -> None:
    rows = np.vstack([walking_only()[:500], simulated()[0]])
    result, estimator = run("foot.9iez", rows, preset="published")
    found = remarks(estimator)
    assert not found["no_rest"].fatal
    assert "begins at 4.99 s" in found["no_rest"].detail
    first = int(np.flatnonzero(np.isfinite(result["pose.pos_x"]))[0])
    assert 695 <= first <= 705
    assert np.isnan(positions(result)[:first]).all()
    np.testing.assert_allclose(positions(result)[first], 0)
    late = positions(run("foot.9iez", simulated()[0], preset="published")[0])[-1]
    np.testing.assert_allclose(positions(result)[-1], late, atol=0.05)


def test_a_pause_inside_the_rest_interrupts_it() -> None:
    rows = simulated("still", duration_s=6.0)[0]
    rows[100, 0] = 3.0
    _, estimator = run("foot.9iez", rows)
    assert "begins at 3.99 s" in remarks(estimator)["no_rest"].detail


def test_a_steady_turn_is_no_rest() -> None:
    rows = simulated("still", duration_s=6.0)[0]
    rows[:, 6] += 1.0
    result, estimator = run("foot.9iez", rows)
    assert np.isnan(positions(result)).all()
    assert remarks(estimator)["no_rest"].fatal


@pytest.mark.parametrize("name", FOOT)
def test_a_still_recording_stays_where_it_is_and_says_so(name: str) -> None:
    result, estimator = run(name, simulated("still", duration_s=20.0)[0])
    assert "never_moved" in remarks(estimator)
    assert not np.isfinite(result["step.index"]).any()
    if name != "foot.naive":
        assert np.abs(positions(result)[-1]).max() < 0.05


def test_a_still_recording_that_is_touched_at_the_end_has_no_step() -> None:
    rows = simulated("still", duration_s=6.0)[0]
    rows[-5:, 4] += 1.0
    found = remarks(run("foot.9iez", rows)[1])
    assert "for 0.05 s only" in found["no_step"].detail


@pytest.mark.parametrize("name", FOOT[1:])
def test_upside_down_gives_the_same_walk(name: str) -> None:
    rows, _ = simulated()
    turned = rows.copy()
    turned[:, 1:4] = rows[:, 1:4] @ TURNED
    turned[:, 4:7] = rows[:, 4:7] @ TURNED
    upright, _ = run(name, rows)
    result, estimator = run(name, turned)
    found = remarks(estimator)
    assert not found["upside_down"].fatal
    # Madgwick's step is normalized before its part along the quaternion falls away: how much turns depends
    # on mounting.
    slack = 0.2 if name == "foot.9iez-mad" else 1e-6
    np.testing.assert_allclose(positions(result)[300:], positions(upright)[300:], atol=slack)


def test_upside_down_works_with_the_pitch_detector_too() -> None:
    rows, walk = simulated()
    rows[:, 1:4] = rows[:, 1:4] @ TURNED
    rows[:, 4:7] = rows[:, 4:7] @ TURNED
    result, _ = run("foot.9iez", rows, detector="pitch")
    assert abs(np.isfinite(result["step.index"]).sum() - walk.steps.height) <= 1


@pytest.mark.parametrize("value", [0.0, np.nan])
@pytest.mark.parametrize("axis", [4, 5, 6])
def test_a_missing_gyroscope_axis_is_fatal(axis: int, value: float) -> None:
    rows, _ = simulated()
    rows[:, axis] = value
    _, estimator = run("foot.9iez", rows)
    found = remarks(estimator)
    assert found["dead_axis"].fatal
    assert f"gyr_{'xyz'[axis - 4]}" in found["dead_axis"].detail


def test_one_nan_does_not_ruin_the_walk() -> None:
    rows, _ = simulated()
    whole, _ = run("foot.9iez", rows)
    rows[1000, 1:7] = np.nan
    result, estimator = run("foot.9iez", rows)
    found = remarks(estimator)
    assert not found["not_finite"].fatal
    np.testing.assert_allclose(positions(result)[-1], positions(whole)[-1], atol=0.05)


def test_many_values_that_are_not_finite_are_fatal() -> None:
    rows, _ = simulated()
    rows[::10, 2] = np.inf
    assert remarks(run("foot.9iez", rows)[1])["not_finite"].fatal


@pytest.mark.parametrize(("factor", "fatal"), [(1 / 9.81, True), (0.95, False)])
def test_an_accelerometer_in_g_or_out_of_scale_is_stated(factor: float, fatal: bool) -> None:
    rows, _ = simulated()
    rows[:, 1:4] *= factor
    found = remarks(run("foot.9iez", rows)[1])
    assert ("unit_doubt" in found) is fatal
    assert ("gravity_norm" in found) is not fatal


def test_a_detector_that_never_fires_is_fatal() -> None:
    rows, _ = simulated()
    _, estimator = run("foot.9iez", rows, detector="c1c2c3", c1_min=9.9, c1_max=10.9, c3_max=1e-6)
    assert remarks(estimator)["never_still"].fatal


def test_a_wrong_rate_is_stated_with_the_right_one() -> None:
    rows, _ = simulated(rate_hz=200.0)
    found = remarks(run("foot.9iez", rows)[1])
    assert "rate_hz=200" in found["rate_mismatch"].detail
    assert "rate_mismatch" not in remarks(run("foot.9iez", rows, rate_hz=200)[1])


def test_a_restless_start_is_stated() -> None:
    rows, _ = simulated()
    rows[:400, 4:7] += 0.05 * np.sin(np.arange(400)[:, None] * [0.5, 0.7, 0.9])  # to the end of the rest
    assert "restless" in remarks(run("foot.9iez", rows)[1])


def test_no_rows_at_all() -> None:
    estimator = make("foot.9iez")
    assert estimator.remarks()[0].kind == "no_data"
    assert len(estimator.flush()) == 0


def test_equal_times_move_nothing() -> None:
    rows, _ = simulated()
    doubled = np.repeat(rows, 2, axis=0)
    doubled[1::2, 0] = 0.0
    once, _ = run("foot.naive", rows)
    twice, _ = run("foot.naive", doubled, integration="trapezoid", rate_hz=200)
    np.testing.assert_allclose(
        columns(twice, "pose", "quat_w", "quat_x")[-1],
        columns(once, "pose", "quat_w", "quat_x")[-1],
        atol=0.02,
    )
    assert np.isfinite(positions(twice)[-1]).all()


def test_gravity_from_rest_takes_the_scale_out_of_the_height() -> None:
    rows = rows_of(np.arange(1000) / 100, np.tile([0, 0, 9.6], (1000, 1)), np.zeros((1000, 3)))
    kept, _ = run("foot.naive", rows)
    taken, _ = run("foot.naive", rows, gravity_from_rest=True)
    assert kept["pose.pos_z"][-1] < -1
    assert taken["pose.pos_z"][-1] == 0
