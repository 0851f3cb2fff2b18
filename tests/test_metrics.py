"""Metrics against values worked out by other means: by hand, SciPy, and evo."""

from __future__ import annotations

from typing import Any

import numpy as np
import polars as pl
import pytest
from hypothesis import given
from hypothesis import strategies as st
from marcha.recording import UsageError
from marcha.replay import (
    ALIGNMENTS,
    Evaluation,
    RunEvaluation,
    RunView,
    Truth,
    align,
    check_thresholds,
    nees_bounds,
)
from marcha.replay.alignment import match, wrap, yaw_of
from marcha.replay.evaluate import evaluate_run, truth_of
from marcha.replay.metrics import available_metrics, closure, consistency, distance, height, reference
from scipy.spatial.transform import Rotation

S = 1_000_000_000


def pose(t_s: Any, position: Any, yaw: Any = None) -> pl.DataFrame:
    position = np.asarray(position, float)
    columns: dict[str, Any] = {"t_ns": (np.asarray(t_s, float) * S).astype(np.int64)}
    columns |= {f"pos_{a}": position[:, i] for i, a in enumerate("xyz")}
    if yaw is not None:
        half = np.asarray(yaw, float) / 2
        zero = np.zeros(len(half))
        columns |= {"quat_w": np.cos(half), "quat_x": zero, "quat_y": zero, "quat_z": np.sin(half)}
    return pl.DataFrame(columns)


def view(tables: dict[str, pl.DataFrame], **options: Any) -> RunView:
    return RunView("run", "estimator", {}, lambda name, _: tables.get(name), **options)


SQUARE = [[0, 0, 0], [3, 0, 0], [3, 4, 0.5], [0.3, 0.4, 1.0]]


def test_closure_is_horizontal() -> None:
    found = closure(view({"pose": pose(range(4), SQUARE)}, truth=Truth(closed=True, length_m=10.0)))
    assert found == pytest.approx({"closure_m": 0.5, "closure_percent": 5.0})


@pytest.mark.parametrize(
    "truth", [Truth(), Truth(closed=True), Truth(closed=False, length_m=10.0), Truth(length_m=10.0)]
)
def test_closure_percent_needs_a_closed_walk_of_known_length(truth: Truth) -> None:
    assert list(closure(view({"pose": pose(range(4), SQUARE)}, truth=truth))) == ["closure_m"]


def test_height_is_signed_and_its_error_is_not() -> None:
    down = pose([0, 1], [[0, 0, 2.0], [1, 1, 0.5]])
    assert height(view({"pose": down})) == {"height_end_m": -1.5}
    assert height(view({"pose": down}, truth=Truth(closed=True)))["height_error_m"] == 1.5


def test_distance_goes_from_stance_to_stance_and_path_along_every_sample() -> None:
    # three stances 1 m apart; between them the track swings 0.5 m sideways and back
    x = [0, 0, 0, 0.5, 1, 1, 1, 1.5, 2, 2, 2]
    y = [0, 0, 0, 0.5, 0, 0, 0, 0.5, 0, 0, 0]
    still = [True, True, True, False, True, True, True, False, True, True, True]
    t = np.arange(11) / 10
    tables = {
        "pose": pose(t, np.column_stack((x, y, np.linspace(0, 9, 11)))),
        "stance": pl.DataFrame({"t_ns": (t * S).astype(np.int64), "still": still}),
    }
    found = distance(view(tables, truth=Truth(length_m=1.6)))
    assert found["distance_m"] == pytest.approx(2.0)
    assert found["path_m"] == pytest.approx(4 * np.hypot(0.5, 0.5))
    assert found["distance_error_percent"] == pytest.approx(25.0)
    assert found["path_error_percent"] == pytest.approx(100 * (4 * np.hypot(0.5, 0.5) - 1.6) / 1.6)


def test_the_rest_at_the_start_counts_though_the_track_begins_within_it() -> None:
    # the estimate begins at 0.8 s, at the end of the rest, whose middle lies before it
    t = np.arange(20) / 10
    still = np.ones(20, bool)
    still[[10, 11, 15, 16]] = False
    x = np.repeat([0.0, 1.0, 2.0], [11, 5, 4])
    tables = {
        "pose": pose(t[8:], np.column_stack((x, 0 * x, 0 * x))[8:]),
        "stance": pl.DataFrame({"t_ns": (t * S).astype(np.int64), "still": still}),
    }
    assert distance(view(tables))["distance_m"] == pytest.approx(2.0)


def test_nothing_is_measured_of_a_run_without_a_track() -> None:
    nothing = view({}, truth=Truth(True, 22.1), reference=pose(range(4), SQUARE))
    assert [metric(nothing) for metric in (closure, distance, height, reference, consistency)] == [{}] * 5


# -- matching ------------------------------------------------------------------------------------------------

times = st.lists(st.integers(0, 60), max_size=25, unique=True).map(lambda v: np.array(sorted(v), np.int64))


@given(wanted=times, other=times, gap=st.integers(1, 20))
def test_match_equals_a_search_by_hand(wanted: np.ndarray, other: np.ndarray, gap: int) -> None:
    values = np.sqrt(other + 1.0)[:, None]
    expected = {}
    for i, t in enumerate(wanted):
        before, after = other[other <= t], other[other >= t]
        if len(before) and len(after) and (after[0] == t or after[0] - before[-1] <= gap):
            expected[i] = np.interp(t, other, values[:, 0])
    found = match(wanted, other, gap / 1e9)
    assert found.index.tolist() == list(expected)
    assert found.dropped == len(wanted) - len(expected)
    np.testing.assert_allclose(
        found.linear(values)[:, 0] if expected else [], list(expected.values()), rtol=1e-12
    )


@given(wanted=times, other=times)
def test_the_time_difference_told_is_the_largest_to_the_nearest(
    wanted: np.ndarray, other: np.ndarray
) -> None:
    found = match(wanted, other, 1.0)
    if len(found.index):
        nearest = np.abs(wanted[found.index][:, None] - other[None, :]).min(axis=1)
        assert found.max_distance_s == pytest.approx(nearest.max() / 1e9)


def test_angles_interpolate_across_the_cut() -> None:
    found = match(np.array([5]), np.array([0, 10]), 1.0)
    assert abs(wrap(found.angle(np.radians([170.0, -170.0])))[0]) == pytest.approx(np.pi)


@given(yaw=st.floats(-3.1, 3.1), pitch=st.floats(-1.4, 1.4), roll=st.floats(-3.1, 3.1))
def test_yaw_is_the_first_angle_of_zyx(yaw: float, pitch: float, roll: float) -> None:
    x, y, z, w = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_quat()
    assert yaw_of(np.array([[w, x, y, z]]))[0] == pytest.approx(yaw, abs=1e-6)


# -- alignment -----------------------------------------------------------------------------------------------


def cloud(seed: int, n: int = 40) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(n, 3)) * [5.0, 3.0, 1.0]


def test_se3_equals_scipy() -> None:
    estimate = cloud(1)
    truth = Rotation.from_euler("xyz", [0.3, -1.0, 2.0]).apply(estimate) + [4, 5, 6] + 0.1 * cloud(2)
    found = align(estimate, truth, "se3")
    expected = Rotation.align_vectors(truth - truth.mean(axis=0), estimate - estimate.mean(axis=0))[0]
    np.testing.assert_allclose(found.rotation, expected.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(found.translation, truth.mean(axis=0) - expected.apply(estimate.mean(axis=0)))


def test_se3_never_mirrors() -> None:
    estimate = cloud(3)
    found = align(estimate, estimate * [1, -1, 1], "se3")
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)


def test_se2_is_the_best_turn_about_z() -> None:
    from scipy.optimize import minimize_scalar

    estimate, truth = cloud(4), Rotation.from_euler("z", 1.2).apply(cloud(4)) + 0.3 * cloud(5)

    def cost(yaw: float) -> float:
        turned = Rotation.from_euler("z", yaw).apply(estimate)
        return float(np.sum((turned - turned.mean(axis=0) - truth + truth.mean(axis=0)) ** 2))

    best = minimize_scalar(cost, bounds=(0, 2.4), method="bounded", options={"xatol": 1e-10})
    assert align(estimate, truth, "se2").yaw == pytest.approx(best.x, abs=1e-6)


@given(yaw=st.floats(-3, 3), shift=st.tuples(*[st.floats(-50, 50)] * 3))
def test_every_alignment_but_none_undoes_what_it_can(yaw: float, shift: tuple[float, float, float]) -> None:
    truth = np.cumsum(np.abs(cloud(6)), axis=0)
    turn = Rotation.from_euler("z", yaw)
    moved = turn.inv().apply(truth - shift)
    for kind in ("origin-yaw", "se2", "se3"):
        np.testing.assert_allclose(align(moved, truth, kind).points(moved), truth, atol=1e-6)
    np.testing.assert_allclose(align(truth - shift, truth, "origin").points(truth - shift), truth, atol=1e-9)
    np.testing.assert_array_equal(align(moved, truth, "none").points(moved), moved)


def test_origin_yaw_takes_orientations_where_they_are_given() -> None:
    estimate = np.array([[0.0, 0, 0], [1, 0, 0]])
    found = align(estimate, estimate, "origin-yaw", 0.2, 0.5)
    assert found.yaw == pytest.approx(0.3)


def test_an_unknown_alignment_lists_those_that_exist() -> None:
    with pytest.raises(UsageError, match=", ".join(ALIGNMENTS)):
        align(cloud(0), cloud(0), "best")


# -- reference -----------------------------------------------------------------------------------------------


def evo_pair() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A helix and a drifting estimate of it, by formula, so that another program can repeat them."""
    t = np.arange(200) / 20.0
    truth = np.column_stack((3 * np.cos(0.7 * t), 3 * np.sin(0.7 * t), 0.1 * t))
    drift = np.column_stack((0.02 * t * np.cos(t), 0.03 * t, 0.01 * t**1.5))
    turn = Rotation.from_euler("xyz", [0.05, -0.1, 0.9])
    return t, truth, turn.apply(truth + drift) + np.array([1.0, -2.0, 0.5])


EVO = {  # evo 1.38.1: APE(translation_part) of evo_pair(); as is, align_origin, align(correct_scale=False)
    "none": (3.314692332115757, 3.040290607127238, 4.791906394223204),
    "origin": (3.4813413042466, 3.061159140445507, 5.173256855330231),
    "se3": (0.12854286918951366, 0.11109902992911885, 0.2622665741307322),
}


@pytest.mark.parametrize("alignment", list(EVO))
def test_absolute_trajectory_error_equals_evo(alignment: str) -> None:
    t, truth, estimate = evo_pair()
    found = reference(view({"pose": pose(t, estimate)}, reference=pose(t, truth), alignment=alignment))
    got = (found["ate_rmse_m"], found["position_error_mean_m"], found["position_error_max_m"])
    assert got == pytest.approx(EVO[alignment], rel=1e-9)


def test_matched_and_dropped_add_up() -> None:
    t = np.arange(100) / 10
    line = np.column_stack((t, 0 * t, 0 * t))
    whole = view(
        {"pose": pose(t, line)},
        reference=pose(t[20:60] + 0.03, line[20:60] + np.array([0.03, 0, 0])),
        max_gap_s=0.15,
    )
    found = evaluate_run(whole)
    assert (found.matched, found.dropped) == (39, 61)
    assert found.max_time_difference_s == pytest.approx(0.03)
    assert found.metrics["ate_rmse_m"] == pytest.approx(0.0, abs=1e-9)
    assert (found.alignment, found.time_base) == ("se3", "estimate")


def test_a_hole_in_the_reference_is_not_interpolated_across() -> None:
    t = np.arange(100) / 10
    line = np.column_stack((t, t**2, 0 * t))
    holed = pose(t, line).filter((pl.col("t_ns") < 3 * S) | (pl.col("t_ns") > 6 * S))
    found = evaluate_run(view({"pose": pose(t + 0.05, line)}, reference=holed, max_gap_s=0.15))
    assert found.dropped == 33


def test_surveyed_points_are_compared_at_their_own_times() -> None:
    t = np.arange(1000) / 100
    line = np.column_stack((t, np.sin(t), 0 * t))
    survey = pose([1.0, 4.0, 7.5], [[1, np.sin(1), 0], [4, np.sin(4), 0], [7.5, np.sin(7.5) + 0.3, 0]])
    found = evaluate_run(view({"pose": pose(t, line)}, reference=survey, alignment="none"))
    assert (found.matched, found.time_base) == (3, "reference")
    assert found.metrics["position_error_end_m"] == pytest.approx(0.3)


def test_heading_error_leaves_out_how_the_sensor_is_mounted() -> None:
    t = np.arange(101) / 10
    line = np.column_stack((np.cos(t), np.sin(t), 0 * t))
    drifting = pose(t, line, 0.3 * t + 0.7 + np.radians(2.0) * t / 10)
    found = reference(view({"pose": drifting}, reference=pose(t, line, 0.3 * t), alignment="none"))
    assert found["heading_error_end_deg"] == pytest.approx(2.0)
    assert found["heading_rmse_deg"] == pytest.approx(2.0 * np.sqrt(np.mean((t / 10) ** 2)))


def test_velocity_error_is_in_the_frame_of_the_reference() -> None:
    t = np.arange(101) / 10
    line = np.column_stack((t, 0 * t, 0 * t))

    def velocity(v: np.ndarray) -> pl.DataFrame:
        return pl.DataFrame(
            {"t_ns": (t * S).astype(np.int64)} | {f"vel_{a}": v[:, i] for i, a in enumerate("xyz")}
        )

    turned = Rotation.from_euler("z", -1.0).apply(line)
    ahead = np.tile([1.0, 0.0, 0.0], (101, 1))
    tables = {
        "pose": pose(t, turned),
        "velocity": velocity(Rotation.from_euler("z", -1.0).apply(ahead) + np.array([0, 0, 0.2])),
    }
    found = reference(
        view(tables, reference=pose(t, line), reference_velocity=velocity(ahead), alignment="origin-yaw")
    )
    assert found["velocity_rmse_m_s"] == pytest.approx(0.2)


# -- consistency ---------------------------------------------------------------------------------------------


def noisy_view(scale: float, n: int = 4000) -> RunView:
    rng = np.random.default_rng(11)
    t = np.arange(n) / 100
    line = np.column_stack((t, 0.2 * t, 0 * t))
    sd = np.column_stack((0.1 + 0.01 * t, 0.2 + 0 * t, 0.05 + 0.02 * t))
    error = rng.normal(size=(n, 3)) * sd
    error[0] = 0
    sd[1] = 1e-7  # a filter just after its start
    sigma = pl.DataFrame(
        {"t_ns": (t * S).astype(np.int64)} | {f"sigma_pos_{a}": scale * sd[:, i] for i, a in enumerate("xyz")}
    )
    turn = Rotation.from_euler("z", 0.8)
    tables = {"pose": pose(t, turn.inv().apply(line) + error, np.full(n, -0.8)), "sigma": sigma}
    return view(tables, reference=pose(t, line, np.zeros(n)))


def test_a_filter_that_says_the_truth_is_consistent() -> None:
    found = consistency(noisy_view(1.0))
    low, high = nees_bounds(4000, confidence=0.999)
    assert low < found["nees_position"] < high
    assert found["within95_position_percent"] == pytest.approx(95.0, abs=1.0)


def test_a_filter_that_is_too_sure_of_itself_is_seen() -> None:
    found = consistency(noisy_view(0.5))
    assert found["nees_position"] == pytest.approx(12.0, rel=0.1)
    assert found["within95_position_percent"] < 70


def test_chi_square_bounds() -> None:
    # Bar-Shalom, Li, Kirubarajan 2001, example 5.4.2: 50 runs of 2 states: chi2_100 = [74.2, 129.6] / 50
    assert nees_bounds(50, 2) == pytest.approx((1.484, 2.591), abs=2e-3)


# -- evaluation ----------------------------------------------------------------------------------------------


def test_every_metric_is_registered() -> None:
    assert {"closure", "distance", "height", "reference", "consistency"} <= set(available_metrics())


@pytest.mark.parametrize(
    ("lineage", "said"),
    [
        ({"fatal": "true", "findings": '[["upside_down", 1, "gravity points up"]]'}, "gravity points up"),
        ({"segments": "2"}, "restarted"),
    ],
)
def test_a_run_that_must_not_be_used_is_said_not_measured(lineage: dict[str, str], said: str) -> None:
    run = RunView("run", "estimator", lineage, lambda name, _: {"pose": pose(range(4), SQUARE)}.get(name))
    found = evaluate_run(run)
    assert found.metrics == {}
    assert said in found.note


def test_intervals_are_measured_by_themselves() -> None:
    t = np.arange(11.0)
    whole = view({"pose": pose(t, np.column_stack((t, 0 * t, 0 * t)))}, truth=Truth(True, 5.0))
    marks = pl.DataFrame({"tier": ["task"], "start_ns": [2 * S], "end_ns": [5 * S], "label": ["stairs"]})
    (part,) = evaluate_run(whole, marks).intervals
    assert (part.tier, part.label) == ("task", "stairs")
    assert part.metrics["path_m"] == pytest.approx(3.0)
    assert "closure_percent" not in part.metrics


@pytest.mark.parametrize(
    ("record", "truth"),
    [
        ({}, Truth()),
        ({"closed": "true", "length_m": "22.1"}, Truth(True, 22.1)),
        ({"closed": "False"}, Truth(False, None)),
    ],
)
def test_truth_of_a_recording(record: dict[str, str], truth: Truth) -> None:
    assert truth_of({"truth": record}) == truth


EVALUATION = Evaluation(
    [RunEvaluation("a", "x", "/i", {"m": 1.0, "n": float("nan")}), RunEvaluation("b", "x", "/i", {"m": 3.0})]
)


@pytest.mark.parametrize(
    ("maximum", "minimum", "missed"),
    [
        ({"m": 3.0}, {}, []),
        ({"m": 2.0}, {}, ["b"]),
        ({}, {"m": 2.0}, ["a"]),
        ({"n": 9.0}, {}, ["a", "b"]),  # NaN, and a run without it
        ({}, {"n": -9.0}, ["a", "b"]),
    ],
)
def test_thresholds(maximum: dict[str, float], minimum: dict[str, float], missed: list[str]) -> None:
    assert [m.run for m in check_thresholds(EVALUATION, maximum, minimum)] == missed


def test_a_misspelt_threshold_does_not_pass() -> None:
    with pytest.raises(UsageError, match="ate_mrse_m"):
        check_thresholds(EVALUATION, {"ate_mrse_m": 1.0})
