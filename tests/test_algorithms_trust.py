"""A wrong walk is not passed off for a right one: starts of any length, stances in any gait, verdicts."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from .algorithms_support import columns, run, simulated

POSITION = ("pos_x", "pos_y", "pos_z")


def kinds(estimator: Any, fatal: bool | None = None) -> set[str]:
    return {r.kind for r in estimator.remarks() if fatal is None or r.fatal == fatal}


def end_error(result: dict[str, np.ndarray], walk: Any) -> float:
    """Horizontal distance of the end from the start, less the true one."""
    pos = columns(result, "pose", *POSITION)
    pos = pos[np.isfinite(pos[:, 0])]
    true = walk.pos[-1, :2] - walk.pos[0, :2]
    return float(np.linalg.norm(pos[-1, :2] - pos[0, :2]) - np.linalg.norm(true))


@pytest.mark.parametrize("rest_s", [0.15, 0.4, 1.0, 3.0])
def test_a_rest_of_any_length_starts_the_walk(rest_s: float) -> None:
    rows, walk = simulated(rest_s=4.0)
    rows = rows[int((4.0 - rest_s) * 100) :]
    result, estimator = run("foot.9iez", rows, preset="adaptive")
    first = int(np.flatnonzero(np.isfinite(result["pose.pos_x"]))[0])
    assert first / 100 <= min(rest_s, 2.0) + 0.3
    assert not kinds(estimator, fatal=True)
    assert abs(np.isfinite(result["step.index"]).sum() - walk.steps.height) <= 2
    assert abs(end_error(result, walk)) < 1.0


def test_a_walk_that_begins_in_motion_starts_in_its_first_stances() -> None:
    rows, walk = simulated(rest_s=1.0)
    rows = rows[180:]
    result, estimator = run("foot.9iez", rows, preset="adaptive")
    first = int(np.flatnonzero(np.isfinite(result["pose.pos_x"]))[0])
    assert first < 300
    assert not kinds(estimator, fatal=True)
    assert np.isfinite(result["step.index"]).sum() > 0.6 * walk.steps.height


def test_a_start_after_the_walk_is_fatal() -> None:
    rows, _ = simulated(rest_s=1.0)
    rows = np.vstack([rows[180:], np.tile(rows[20], (400, 1))])
    _, estimator = run("foot.9iez", rows, preset="published", init_s=2.0)
    assert "late_start" in kinds(estimator, fatal=True)


def test_missed_stances_are_fatal() -> None:
    """The rest is found, but no stance of the walk: the free strapdown runs away."""
    rows, _ = simulated(rest_s=3.0)
    _, estimator = run("foot.9iez", rows, preset="published", c3_max=1e-3)
    assert kinds(estimator, fatal=True) & {"implausible_speed", "lost_stances", "never_still"}
    assert all(type(r.fatal) is bool for r in estimator.remarks())  # results are written as JSON


def test_a_turn_before_the_walk_is_no_bias() -> None:
    rows, walk = simulated(rest_s=2.0)
    turned = rows.copy()
    turned[120:200, 6] += np.linspace(0.0, 0.14, 80)  # the foot begins to turn before it lifts
    fixed, _ = run("foot.9iez", turned, preset="published", init_s=1.9)
    quiet, estimator = run("foot.9iez", turned, preset="adaptive")
    assert abs(estimator.record.bias_gyr[2] - rows[:120, 6].mean()) < 0.01
    assert abs(end_error(quiet, walk)) < abs(end_error(fixed, walk))


def test_a_bias_may_be_left_in() -> None:
    rows, _ = simulated()
    _, estimator = run("foot.9iez-mad", rows, rest_bias=False)
    assert (estimator.record.bias_gyr == 0).all()


def test_a_ceiling_is_remarked() -> None:
    rows, _ = simulated()
    assert "clipped" not in kinds(run("foot.9iez", rows)[1])
    ceiling = 0.6 * np.abs(rows[:, 5]).max()
    rows[:, 5] = np.clip(rows[:, 5], -ceiling, ceiling)
    assert "clipped" in kinds(run("foot.9iez", rows)[1])


@pytest.mark.data
def test_real_walks_and_runs_with_one_setting(data_dir: Any) -> None:
    """Vicon walks and fast gait, all with the adaptive preset and nothing else (metres RMSE after SE3)."""
    from marcha.replay.alignment import align
    from scipy.io import loadmat

    errors = {}
    for name in ("2017-11-22-11-25-20", "2017-11-27-11-25-12", "2017-12-15-18-02-28"):
        mat = loadmat(data_dir / "foot" / "vicon" / f"{name}.mat")
        t, imu, truth = mat["ts"].ravel(), mat["imu"], mat["gt"][:, :3] * [1, -1, 1]
        rows = np.column_stack([np.diff(t, prepend=t[0]), imu])
        result, estimator = run("foot.9iez", rows, preset="adaptive", rate_hz=200.0)
        pos = columns(result, "pose", *POSITION)
        ok = np.isfinite(pos[:, 0])
        gap = align(pos[ok], truth[ok], "se3").points(pos[ok]) - truth[ok]
        errors[name] = float(np.sqrt((gap**2).sum(axis=1).mean()))
        assert not kinds(estimator, fatal=True)
    assert errors["2017-11-22-11-25-20"] < 0.09
    assert errors["2017-11-27-11-25-12"] < 0.2
    assert errors["2017-12-15-18-02-28"] < 0.2


def remark(estimator: Any, kind: str) -> Any:
    return next((r for r in estimator.remarks() if r.kind == kind), None)


def test_a_good_walk_has_nothing_against_it() -> None:
    for gait in ("walk", "fast", "run"):
        rows, walk = simulated(gait=gait, rate_hz=200.0, length_m=60.0)
        _, estimator = run("foot.15iez-zaru", rows, rate_hz=200.0)
        doubts = {"steps_against_swings", "path_against_steps", "bias_moved", "unsure", "clipped"}
        assert not kinds(estimator) & doubts, gait
        assert 0.9 < estimator.record.verdict.swings / walk.steps.height < 1.4, (
            gait
        )  # a slow swing turns twice


def test_swings_are_counted_without_a_stance_detector() -> None:
    """A detector that joins strides makes fewer steps than the foot has swung."""
    rows, walk = simulated(laps=2)
    _, estimator = run("foot.9iez", rows, preset="published", step_min_m=3.0)
    assert 0.9 < estimator.record.verdict.swings / walk.steps.height < 1.4
    assert remark(estimator, "steps_against_swings")


def test_a_way_without_steps_is_fatal() -> None:
    rows, _ = simulated(laps=2)
    _, estimator = run("foot.9iez", rows, step_min_m=50.0)
    assert remark(estimator, "path_against_steps").fatal


def test_a_lost_angle_taken_for_bias_is_fatal() -> None:
    """A gyroscope that stops at 250 °/s: fifteen states find a bias that no rest showed, nine know of none."""
    rows, _ = simulated(laps=3, config="3030")
    _, fifteen = run("foot.15iez-zaru", rows, unclip=False)
    assert remark(fifteen, "clipped")
    assert remark(fifteen, "inconsistent")
    assert remark(fifteen, "bias_moved").fatal
    assert not remark(run("foot.9iez", rows)[1], "bias_moved")
    _, repaired = run("foot.15iez-zaru", rows)
    moved = [abs(e.record.bias_gyr - e.record.verdict.first_bias).max() for e in (repaired, fifteen)]
    assert moved[0] < 0.75 * moved[1]  # what is put back need not be taken for bias


def test_the_innovations_tell_of_a_wrong_scale() -> None:
    rows, _ = simulated(laps=2)
    assert not remark(run("foot.9iez", rows)[1], "inconsistent")
    rows[:, 4:7] *= 1.1
    assert remark(run("foot.9iez", rows)[1], "inconsistent")


def test_a_walk_without_a_rest_says_how_unsure_it_is() -> None:
    rows, _ = simulated(rest_s=0.0, laps=8)
    _, estimator = run("foot.9iez", rows)
    assert remark(estimator, "unsure")
