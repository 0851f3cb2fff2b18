"""Rules on simulated walks: against what the walk was, and against what the estimator said."""

from __future__ import annotations

from typing import NamedTuple

import marcha.ingest as ingest
import marcha.recording as mr
import marcha.replay as rp
import numpy as np
import polars as pl
import pytest
from marcha.export.agreement import compare
from marcha.export.rules import apply_rules
from marcha.ingest.simulate import simulate
from marcha.recording import Recording
from marcha.recording.annotations import COLUMNS, check_annotations, identified
from marcha.recording.changes import change

RUN = "foot_9iez_foot_imu2"
WALKS = [(s, seed) for s in ("rectangle", "figure-eight", "stairs", "straight") for seed in (3, 4)]


class Walked(NamedTuple):
    """A simulated walk that an estimator saw, its annotations, and the one before rules were applied."""

    rec: Recording
    before: Recording


@pytest.fixture(scope="module")
def walks(tmp_path_factory: pytest.TempPathFactory) -> dict[tuple[str, int], Walked]:
    folder = tmp_path_factory.mktemp("walks")
    found = {}
    for scenario, seed in WALKS:
        name = f"{scenario}-{seed}"
        raw = simulate(scenario, folder / name, seed=seed)
        ingest.convert(raw.paths, folder / f"{name}.mcap")
        rec = mr.open(folder / f"{name}.mcap")
        rp.replay(rec, ["foot.9iez"], inputs=["/foot/imu2"], out=folder / f"{name}.r.mcap", metrics=False)
        before = mr.open(folder / f"{name}.r.mcap")
        add, stale = apply_rules(before)
        assert stale == []
        change(before, folder / f"{name}.a.mcap", add=add)
        found[scenario, seed] = Walked(mr.open(folder / f"{name}.a.mcap"), before)
    return found


def stretches(true: np.ndarray) -> list[tuple[int, int]]:
    """First and last place of each stretch of true values."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], true.astype(np.int8), [0]))))
    return [(int(a), int(b) - 1) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def truth(rec: Recording) -> pl.DataFrame:
    """Turns and flights of stairs of the walk itself, from the foot's true path: no estimate is looked at."""
    stance = rec.table("/reference/imu2/stance")
    t_ns = stance["t_ns"].to_numpy()
    rests = stretches(stance["still"].to_numpy())
    path = rec.table("/reference/imu2/pose").select("pos_x", "pos_y", "pos_z").to_numpy()
    strides = np.diff([path[(a + b) // 2] for a, b in rests], axis=0)
    start = [t_ns[b] for _, b in rests[:-1]]
    end = [t_ns[a] for a, _ in rests[1:]]
    bearing = np.rad2deg(np.unwrap(np.arctan2(strides[:, 1], strides[:, 0])))
    turned = np.diff(bearing)
    rows = []
    for sign, word in ((1, "turn left"), (-1, "turn right")):
        for i, j in stretches(sign * turned >= 10):
            if sign * turned[i : j + 1].sum() >= 45:
                rows.append(("turn", end[i], start[j + 1], word))
    for sign, word in ((1, "stairs up"), (-1, "stairs down")):
        for i, j in stretches(sign * strides[:, 2] >= 0.08):
            if j > i:
                rows.append(("stair", start[i], end[j], word))
    table = pl.DataFrame(rows, schema=["tier", "start_ns", "end_ns", "label"], orient="row")
    return identified(check_annotations(table.cast({"start_ns": pl.Int64, "end_ns": pl.Int64})))


@pytest.mark.parametrize("kind", ["turn", "stair"])
def test_turns_and_stairs_are_found_and_no_others(walks: dict[tuple[str, int], Walked], kind: str) -> None:
    matched = missed = added = 0
    worst = 0.0
    for rec, _ in walks.values():
        expected = truth(rec).filter(tier=kind)
        found = rec.annotations.filter(tier=f"{RUN}/{kind}")
        span = rec.data_span
        assert span is not None
        agreed, _ = compare(expected, found, span)
        matched, missed, added = matched + agreed.matched, missed + agreed.missed, added + agreed.added
        if agreed.matched:
            worst = max(worst, agreed.start_max_s, agreed.end_max_s)
    assert matched >= (14 if kind == "turn" else 4)
    assert matched / (matched + added) >= 0.95
    assert matched / (matched + missed) >= 0.95
    assert worst < 0.15  # the estimator's stance is a little shorter than the true one


def test_every_stance_and_step_is_there_once_at_the_estimator_s_samples(
    walks: dict[tuple[str, int], Walked],
) -> None:
    for rec, _ in walks.values():
        sample = 10_100_000  # ns, with the jitter of the device
        stance = rec.table(f"/estimate/{RUN}/stance")
        t_ns = stance["t_ns"].to_numpy()
        rests = np.array([(t_ns[a], t_ns[b]) for a, b in stretches(stance["still"].to_numpy())])
        step = rec.table(f"/estimate/{RUN}/step")
        assert step.height == int(rec.metadata["truth"]["steps"])
        for kind, expected in (
            ("stance", rests),
            ("step", step.select("start_ns", "end_ns").to_numpy()),
            ("swing", np.column_stack((rests[:-1, 1], rests[1:, 0]))),
        ):
            found = rec.annotations.filter(tier=f"{RUN}/{kind}").sort("start_ns").select("start_ns", "end_ns")
            assert found.height == len(expected), kind
            assert np.abs(found.to_numpy() - expected).max() <= sample, kind


def test_run_twice_the_table_is_the_same(walks: dict[tuple[str, int], Walked]) -> None:
    for rec, before in walks.values():
        again, stale = apply_rules(rec)
        assert (again.height, stale) == (0, [])
        once, twice = apply_rules(before)[0], apply_rules(before)[0]
        assert once.equals(twice)
        assert list(once.columns) == list(COLUMNS)
        assert rec.annotations["id"].n_unique() == rec.annotations.height
