"""Figures by interval: parts keep the walk's alignment, and what they count adds up to the walk's."""

from __future__ import annotations

from typing import Any

import marcha.recording as mr
import numpy as np
import polars as pl
import pytest
from hypothesis import given
from hypothesis import strategies as st
from marcha.ingest import convert
from marcha.ingest.simulate import simulate
from marcha.recording import Recording, UsageError
from marcha.replay import RunView, evaluate, replay
from marcha.replay.evaluate import evaluate_run
from marcha.replay.metrics_joint import joints
from marcha.replay.trajectory import inside, joined

from .cli_helpers import marcha

S = 10**9


@given(
    st.lists(st.tuples(st.integers(-50, 50), st.integers(0, 20)), max_size=8),
    st.lists(st.integers(-60, 90), max_size=40),
)
def test_stretches_are_joined_and_hold_what_each_of_them_holds(
    spans: list[tuple[int, int]], times: list[int]
) -> None:
    given_spans = np.array([(a, a + n) for a, n in spans], np.int64).reshape(-1, 2)
    one = joined(given_spans)
    t = np.array(times, np.int64)
    expected = [any(a <= x < b for a, b in given_spans) for x in times]
    assert inside(t, one).tolist() == expected
    assert (one[1:, 0] > one[:-1, 1]).all()


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """A rectangle replayed, with the tier `course` of two labels: a part of a side, and its corners."""
    folder = tmp_path_factory.mktemp("walk")
    raw = simulate("rectangle", folder / "raw", seed=3)
    convert(raw.paths, folder / "walk.mcap")
    replay(mr.open(folder / "walk.mcap"), ["foot.9iez"], out=folder / "done.mcap")
    rec = mr.open(folder / "done.mcap")
    cuts = rec.start_ns + np.linspace(0.1, 0.9, 9) * (rec.end_ns - rec.start_ns)
    marks = pl.DataFrame(
        {
            "tier": ["course"] * 6,
            "start_ns": cuts[[0, 2, 4, 1, 3, 6]].astype(np.int64),
            "end_ns": cuts[[1, 3, 5, 2, 4, 8]].astype(np.int64) - 1,
            "label": ["side", "side", "side", "corner", "corner", "corner"],
        }
    )
    with mr.create(folder / "marked.mcap") as out:
        out.copy_from(rec)
        out.add_annotations(marks)
    return mr.open(folder / "marked.mcap")


def test_errors_and_counts_over_the_labels_add_up_to_the_walk(walk: Recording) -> None:
    for run in evaluate(walk, by="course").runs:
        assert [g.label for g in run.groups] == ["side", "corner", None]
        assert [g.intervals for g in run.groups[:2]] == [3, 3]
        assert sum(g.matched for g in run.groups) == run.matched
        assert sum(g.dropped for g in run.groups) == run.dropped
        assert sum(g.duration_s for g in run.groups) == pytest.approx(walk.duration_s)
        squares = sum(g.matched * g.metrics["ate_rmse_m"] ** 2 for g in run.groups)
        assert squares == pytest.approx(run.matched * run.metrics["ate_rmse_m"] ** 2)
        assert max(g.metrics["position_error_max_m"] for g in run.groups) == pytest.approx(
            run.metrics["position_error_max_m"]
        )
        for name in ("path_m", "distance_m", "steps", "strides"):
            assert sum(g.metrics[name] for g in run.groups) == pytest.approx(run.metrics[name])
        assert not any("closure_m" in g.metrics for g in run.groups)


def test_a_single_interval_keeps_the_alignment_of_the_walk(walk: Recording) -> None:
    run = evaluate(walk, by="course").runs[0]
    parts = [i for i in run.intervals if i.label == "side"]
    (side,) = [g for g in run.groups if g.label == "side"]
    squares = sum(i.matched * i.metrics["ate_rmse_m"] ** 2 for i in parts)
    assert squares == pytest.approx(side.matched * side.metrics["ate_rmse_m"] ** 2)


def test_an_own_tier_of_the_run_comes_first_and_an_unknown_one_is_named(walk: Recording) -> None:
    run = evaluate(walk, by="stance").runs[0]
    still, moving = run.groups
    assert (still.label, moving.label) == ("stance", None)
    assert moving.metrics["path_m"] > 10 * still.metrics["path_m"]
    with pytest.raises(UsageError, match=r"no tier 'stairs'; there are .*course"):
        evaluate(walk, by="stairs")


def test_parts_of_overlapping_labels_are_said_twice_and_time_is_not() -> None:
    t = np.arange(0, 10 * S, S // 10)
    pose = pl.DataFrame({"t_ns": t, "pos_x": t * 1e-9, "pos_y": 0.0 * t, "pos_z": 0.0 * t})
    view = RunView("run", "e", {}, lambda name, _: {"pose": pose}.get(name))
    tier = pl.DataFrame(
        {"start_ns": [S, 2 * S, 3 * S], "end_ns": [4 * S, 5 * S, 6 * S], "label": ["a", "a", "b"]}
    )
    a, b, rest = evaluate_run(view, None, tier).groups
    assert (a.duration_s, b.duration_s) == (pytest.approx(4.0), pytest.approx(3.0))
    assert a.metrics["path_m"] == pytest.approx(4.0)
    assert rest.metrics["path_m"] == pytest.approx(9.9 - 5.0)


class Joint(RunView):
    """A view whose reference of a joint is given."""

    def reference_table(self, kind: str) -> pl.DataFrame | None:
        assert kind == "joint"
        return self._within(TRUE_KNEE)


T = np.arange(0, 40 * S, S // 100)
TRUE_KNEE = pl.DataFrame({"t_ns": T, "knee": np.sin(2 * np.pi * T * 1e-9 / 1.1)})
KNEE = TRUE_KNEE.with_columns(knee=pl.col("knee") + 0.02 * np.cos(T * 0.7e-9))


def test_joint_errors_over_the_labels_add_up_to_the_walk() -> None:
    view: Any = Joint("run", "e", {}, lambda name, _: {"joint": KNEE}.get(name))
    whole = joints(view)
    cut = np.array([[0, 7 * S], [20 * S, 33 * S]], np.int64)
    rest = np.array([[7 * S, 20 * S], [33 * S, 100 * S]], np.int64)
    parts = [joints(view.part(spans)) for spans in (cut, rest)]
    assert sum(p["samples.knee"] for p in parts) == whole["samples.knee"]
    squares = sum(p["samples.knee"] * p["rmse_deg.knee"] ** 2 for p in parts)
    assert squares == pytest.approx(whole["samples.knee"] * whole["rmse_deg.knee"] ** 2)
    assert 0 < sum(p["cycles.knee"] for p in parts) <= whole["cycles.knee"]


def test_the_command_shows_a_column_a_label(walk: Recording) -> None:
    done = marcha("evaluate", str(walk.path), "--by", "course", "--run", "foot_9iez_foot_imu1")
    assert done.code == 0
    assert "side" in done.out
    assert "(between)" in done.out
