"""Rows: order, joins, missing values, gaps."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from marcha.algorithms import Input
from marcha.recording import UsageError
from marcha.replay import GapPolicy
from marcha.replay.merging import Merged
from marcha.replay.sources import Batch, measured_rate

from .replay_helpers import ACC, IMU, MAG, STEP_NS, Echo, MemorySource, channel, oracle_rows, run_all, table

MS = 1_000_000
IMU_CHANNEL = channel("/foot/imu", IMU, ACC)
MAG_COLUMNS = ("mag_x", "mag_y")
MAG_CHANNEL = channel("/foot/mag", MAG, MAG_COLUMNS)
number = st.sampled_from([0.0, 1.5, -2.0, float("nan")])


def messages(columns: tuple[str, ...], size: int = 30) -> st.SearchStrategy[pl.DataFrame]:
    """Tables with ties, repeated, backward and uneven times, late arrivals and missing values."""
    row = st.tuples(st.integers(-2, 4), st.integers(0, 3), *[number] * len(columns))

    def build(rows: list[tuple]) -> pl.DataFrame:
        t = np.cumsum([r[0] for r in rows], dtype=np.int64) * MS if rows else np.empty(0, np.int64)
        log = np.maximum.accumulate(t + np.array([r[1] for r in rows], np.int64) * MS) if rows else t
        values = {c: [r[2 + i] for r in rows] for i, c in enumerate(columns)}
        frame = table(t.tolist(), values, log.tolist())
        return frame.cast(dict.fromkeys(columns, pl.Float64))

    return st.lists(row, max_size=size).map(build)


def echoed(result: dict[str, pl.DataFrame]) -> list[tuple[int, int, list[float]]]:
    (rows,) = result.values()
    return [(t, log, list(values)) for t, log, *values in rows.iter_rows()]


@settings(max_examples=150)
@given(imu=messages(ACC), mag=messages(MAG_COLUMNS), mag_first=st.booleans(), max_rows=st.integers(1, 40))
def test_rows_equal_a_plain_event_loop(
    imu: pl.DataFrame, mag: pl.DataFrame, mag_first: bool, max_rows: int
) -> None:
    pairs = [(IMU_CHANNEL, imu), (MAG_CHANNEL, mag)]
    source = MemorySource(pairs[::-1] if mag_first else pairs, max_rows)
    result, tables = run_all(
        source, [Echo(further=[Input("mag", MAG, MAG_COLUMNS)])], gap=GapPolicy(max_gap_s=1.0)
    )
    columns = {"/foot/imu": ACC, "/foot/mag": MAG_COLUMNS}
    expected, counts = oracle_rows(source.tables, columns, "/foot/imu")
    got = echoed(tables)
    assert [r[:2] for r in got] == [r[:2] for r in expected]
    np.testing.assert_array_equal([r[2] for r in got], [r[2] for r in expected])
    findings = {f.kind: f.count for f in result.runs[0].findings}
    assert {k: findings.get(k, 0) for k in counts} == counts


def test_ties_go_by_channel_order() -> None:
    imu = table([0, STEP_NS], {c: [1.0, 1.0] for c in ACC})
    mag = table([STEP_NS], {c: [7.0] for c in MAG_COLUMNS})
    echo = Echo(further=[Input("mag", MAG, MAG_COLUMNS)])
    _, before = run_all(MemorySource([(MAG_CHANNEL, mag), (IMU_CHANNEL, imu)]), [echo])
    _, after = run_all(MemorySource([(IMU_CHANNEL, imu), (MAG_CHANNEL, mag)]), [echo])
    assert echoed(before)[1][2][-1] == 7.0
    assert np.isnan(echoed(after)[1][2][-1])


def test_merged_order_is_stable() -> None:
    a, b = table([5, 5, 9], {"v": [1, 2, 3]}), table([5, 7, 9], {"v": [4, 5, 6]})
    merged = Merged(Batch(10, {"/a": a, "/b": b}))
    assert merged.log_ns.tolist() == [5, 5, 5, 7, 9, 9]
    assert merged.positions["/a"].tolist() == [0, 1, 4]
    assert merged.positions["/b"].tolist() == [2, 3, 5]


def test_the_message_is_joined_once_it_is_known_not_when_it_was_measured() -> None:
    imu = table([0, STEP_NS, 2 * STEP_NS], {c: [1.0] * 3 for c in ACC})
    late = table([0], {c: [7.0] for c in MAG_COLUMNS}, t_log_ns=[STEP_NS + 1])
    _, result = run_all(
        MemorySource([(IMU_CHANNEL, imu), (MAG_CHANNEL, late)]),
        [Echo(further=[Input("mag", MAG, MAG_COLUMNS)])],
    )
    column = [row[-1] for _, _, row in echoed(result)]
    assert np.isnan(column[0])
    assert np.isnan(column[1])
    assert column[2] == 7.0


def gappy(*intervals_ms: int) -> MemorySource:
    t = np.cumsum([0, *intervals_ms]) * MS
    return MemorySource(
        [(IMU_CHANNEL, table(t.tolist(), {c: np.arange(1.0, len(t) + 1) for c in ACC}))], max_rows=2
    )


def test_bridge_feeds_the_true_time_difference() -> None:
    result, rows = run_all(gappy(10, 10, 700, 10), [Echo()])
    assert [r[2][0] for r in echoed(rows)] == [0.0, 0.01, 0.01, 0.7, 0.01]
    (gap,) = [f for f in result.runs[0].findings if f.kind == "gap"]
    assert gap.count == 1
    assert "0.700 s" in gap.detail


def test_reset_starts_anew_in_a_new_segment() -> None:
    result, rows = run_all(gappy(10, 700, 10, 300, 10), [Echo()], gap=GapPolicy("reset"))
    assert [r[2][0] for r in echoed(rows)] == [0.0, 0.01, 0.0, 0.01, 0.0, 0.01]
    assert result.runs[0].segments == 3


def test_stop_ends_the_run_before_the_gap() -> None:
    result, rows = run_all(gappy(10, 700, 10, 10), [Echo()], gap=GapPolicy("stop"))
    assert len(echoed(rows)) == result.runs[0].samples == 2
    assert "3 messages were not fed" in next(f.detail for f in result.runs[0].findings if f.kind == "gap")


@pytest.mark.parametrize(("rate_hz", "limit_s"), [(100.0, 0.2), (10.0, 0.5), (0.0, 0.2)])
def test_a_gap_is_longer_than_five_samples_and_a_fifth_of_a_second(rate_hz: float, limit_s: float) -> None:
    assert GapPolicy().limit_s(rate_hz) == limit_s


def test_an_interval_of_the_limit_is_no_gap() -> None:
    result, _ = run_all(gappy(10, 200, 10), [Echo()])
    assert "gap" not in {f.kind for f in result.runs[0].findings}


def test_jitter_is_told_with_its_longest_interval() -> None:
    result, _ = run_all(gappy(10, 16, 24, 15, 10), [Echo()])
    (jitter,) = [f for f in result.runs[0].findings if f.kind == "jitter"]
    assert jitter.count == 2
    assert "24 ms" in jitter.detail


@pytest.mark.parametrize("bad", [{"policy": "guess"}, {"max_gap_s": 0.0}, {"max_gap_s": float("nan")}])
def test_gap_policy_refuses(bad: dict) -> None:
    with pytest.raises(UsageError):
        GapPolicy(**bad)


def test_a_sensor_without_values_is_said_not_computed() -> None:
    t = (np.arange(50) * STEP_NS).tolist()
    nothing = table(t, {"acc_x": [1.0] * 50, "acc_y": [float("nan")] * 50, "acc_z": [1.0] * 50})
    result, _ = run_all(MemorySource([(IMU_CHANNEL, nothing)]), [Echo()])
    run = result.runs[0]
    assert run.fatal
    assert {f.kind for f in run.findings} == {"missing_value", "no_samples"}


@given(rate=st.floats(5.0, 1000.0), gaps=st.lists(st.integers(1, 99), max_size=3))
def test_measured_rate_ignores_gaps_and_repeats(rate: float, gaps: list[int]) -> None:
    t = np.round(np.arange(100) * 1e9 / rate).astype(np.int64)
    for g in gaps:
        t[g:] += 10_000_000_000
    t = np.sort(np.concatenate((t, t[10:12])))
    assert measured_rate(t) == pytest.approx(rate, rel=1e-4)


def test_measured_rate_of_nothing_is_unknown() -> None:
    assert measured_rate(np.array([5, 5])) == 0.0
