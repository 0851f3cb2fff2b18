"""The engine: the same bits whatever the mode, speed, path and batches; time; latency; sinks."""

from __future__ import annotations

import threading
from itertools import groupby
from typing import Any

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from marcha.algorithms import Annotate, Input, Output, Remark, RowEstimator
from marcha.recording import MarchaError, UsageError
from marcha.replay import GapPolicy, ManualClock, Sink

from .replay_helpers import (
    ACC,
    IMU,
    STEP_NS,
    VALUES,
    Echo,
    MemorySource,
    Smoother,
    channel,
    engine_of,
    imu_table,
    results_of,
    run_all,
    same_bits,
    table,
)

N = 120
START = 10**18
LEFT, RIGHT = channel("/left/imu", IMU, ACC), channel("/right/imu", IMU, ACC)
ESTIMATORS = [Smoother(), Smoother(latency=7), Echo()]


def two_feet(max_rows: int = 100) -> MemorySource:
    right = imu_table(N, 2).with_columns(pl.col("t_ns") + 3_000_000, pl.col("t_log_ns") + 3_000_000)
    return MemorySource([(LEFT, imu_table(N, 1)), (RIGHT, right)], max_rows)


@pytest.fixture(scope="module")
def expected() -> dict[str, pl.DataFrame]:
    """Everything stepped sample by sample, in one batch."""
    return run_all(two_feet(10**9), ESTIMATORS, mode="sample")[1]


def test_every_channel_of_the_kind_gets_a_run(expected: dict[str, pl.DataFrame]) -> None:
    assert len(expected) == 2 * (2 + 2 + 1)
    assert expected["/estimate/echo_left_imu/row"].height == N


@pytest.mark.parametrize("max_rows", [1, 7, 100, 10**6])
@pytest.mark.parametrize("mode", ["block", "sample"])
def test_bits_do_not_depend_on_mode_and_batches(
    expected: dict[str, pl.DataFrame], mode: str, max_rows: int
) -> None:
    assert same_bits(run_all(two_feet(max_rows), ESTIMATORS, mode=mode)[1], expected)


def test_block_mode_hands_over_blocks() -> None:
    estimator = Smoother()
    engine, _ = engine_of(two_feet(), [estimator], mode="block")
    engine.play()
    assert 1 < engine.runners[0].estimator.blocks < 20


@pytest.mark.parametrize("speed", [0.5, 1, "2", 300.0])
def test_bits_do_not_depend_on_speed(expected: dict[str, pl.DataFrame], speed: Any) -> None:
    assert same_bits(run_all(two_feet(), ESTIMATORS, speed=speed, clock=ManualClock())[1], expected)


def test_step_by_step_gives_the_same_bits(expected: dict[str, pl.DataFrame]) -> None:
    engine, tables = engine_of(two_feet(), ESTIMATORS)
    taken = []
    while (message := engine.step()) is not None:
        taken.append(message)
    assert len(taken) == 2 * N
    assert taken[:3] == [
        ("/left/imu", START),
        ("/right/imu", START + 3_000_000),
        ("/left/imu", START + STEP_NS),
    ]
    assert same_bits(results_of(engine.finish(), tables), expected)


moves = st.lists(st.tuples(st.sampled_from(["seek", "play", "step"]), st.integers(-50, N + 50)), max_size=8)


@settings(max_examples=60)
@given(moves=moves, max_rows=st.integers(1, 300), checkpoint_s=st.sampled_from([None, 0.05, 1.0]))
def test_bits_do_not_depend_on_seeks(
    expected: dict[str, pl.DataFrame], moves: list[tuple[str, int]], max_rows: int, checkpoint_s: float | None
) -> None:
    engine, tables = engine_of(two_feet(max_rows), ESTIMATORS, checkpoint_s=checkpoint_s)
    for what, row in moves:
        if what == "seek":
            engine.seek(START + row * STEP_NS)
        elif what == "play":
            engine.play(until_ns=START + row * STEP_NS)
        else:
            engine.step()
    engine.play()
    assert same_bits(results_of(engine.finish(), tables), expected)


@given(back=st.integers(0, N), forth=st.integers(0, N))
def test_a_sink_that_cannot_rewind_sees_every_message_once(back: int, forth: int) -> None:
    sink = Watcher()
    engine, _ = engine_of(two_feet(50), [Smoother(3)], [sink], checkpoint_s=0.3)
    engine.seek(START + forth * STEP_NS)
    engine.seek(START + back * STEP_NS)
    engine.play()
    engine.finish()
    straight = Watcher()
    engine, _ = engine_of(two_feet(50), [Smoother(3)], [straight])
    engine.play()
    engine.finish()
    assert same_bits(sink.joined(), straight.joined())


class StandsWhilePositive(RowEstimator):
    """Still where the first value is positive."""

    name = "stands"
    inputs = (Input("imu", IMU, ("acc_x",)),)
    outputs = (
        Output("stance", "marcha_msgs/msg/Stance", ("still",), annotate=Annotate("stance", "state", "still")),
    )

    def step(self, row: np.ndarray) -> np.ndarray:
        return (row[1:] > 0).astype(float)


@given(
    still=st.lists(st.booleans(), min_size=1, max_size=40),
    max_rows=st.integers(1, 45),
    back=st.integers(0, 40),
)
def test_stances_are_the_runs_of_still_samples_however_they_come(
    still: list[bool], max_rows: int, back: int
) -> None:
    t_ns = [START + i * STEP_NS for i in range(len(still))]
    rows = table(t_ns, {"acc_x": [1.0 if s else -1.0 for s in still]})
    source = MemorySource([(channel("/foot/imu", IMU, ("acc_x",)), rows)], max_rows)
    engine, _ = engine_of(source, [StandsWhilePositive()], checkpoint_s=0.05)
    engine.play()
    engine.seek(START + back * STEP_NS)
    engine.play()
    (run,) = engine.finish().runs
    runs = [list(g) for s, g in groupby(zip(still, t_ns, strict=True), lambda p: p[0]) if s]
    expected = [(g[0][1], g[-1][1]) for g in runs]
    assert run.annotations.select("start_ns", "end_ns").rows() == expected


def test_seek_back_goes_to_the_nearest_checkpoint() -> None:
    source = two_feet(20)
    engine, _ = engine_of(source, [Echo()], checkpoint_s=0.1)
    engine.play()
    read = source.batches_read
    engine.seek(START + 110 * STEP_NS)
    assert source.batches_read - read < 6
    assert engine.position_ns == START + 110 * STEP_NS


def test_position_after_a_seek_is_before_the_message_of_that_time() -> None:
    engine, _ = engine_of(two_feet(), [Echo()])
    engine.seek(START + 5 * STEP_NS)
    assert engine.step() == ("/left/imu", START + 5 * STEP_NS)


def test_range_is_half_open() -> None:
    _, rows = run_all(two_feet(), [Echo()], start_ns=START + 10 * STEP_NS, end_ns=START + 20 * STEP_NS)
    left = rows["/estimate/echo_left_imu/row"]["t_ns"].to_list()
    assert left == [START + k * STEP_NS for k in range(10, 20)]


def test_a_range_that_ends_before_its_start_is_refused() -> None:
    with pytest.raises(UsageError, match="not after its start"):
        engine_of(two_feet(), [Echo()], start_ns=5, end_ns=5)


class Watcher(Sink):
    """Takes everything down."""

    def __init__(self) -> None:
        self.tables: dict[str, list[pl.DataFrame]] = {}
        self.closed: list[Any] = []

    def open(self, plan: Any) -> None:
        self.plan = plan

    def write(self, topic: str, table: pl.DataFrame) -> None:
        self.tables.setdefault(topic, []).append(table)

    def close(self, result: Any) -> None:
        self.closed.append(result)

    def joined(self) -> dict[str, pl.DataFrame]:
        return {t: pl.concat(p) for t, p in self.tables.items()}


def test_sinks_get_raw_and_estimates_as_planned() -> None:
    sink = Watcher()
    engine, _ = engine_of(two_feet(), [Echo()], [sink])
    engine.play()
    result = engine.finish()
    raw = {"/left/imu", "/right/imu"}
    assert set(sink.plan.channels) == raw | {"/estimate/echo_left_imu/row", "/estimate/echo_right_imu/row"}
    assert sink.joined()["/left/imu"].equals(imu_table(N, 1))
    assert sink.closed == [result]


# -- pacing ------------------------------------------------------------------------------------------------


class Timed(Watcher):
    """Notes when each message came."""

    def __init__(self, clock: ManualClock) -> None:
        super().__init__()
        self.clock = clock
        self.came: list[tuple[int, int]] = []

    def write(self, topic: str, table: pl.DataFrame) -> None:
        self.came += [(t, self.clock.now_ns()) for t in table["t_log_ns"].to_list()]


@pytest.mark.parametrize("speed", [0.25, 1.0, 8.0])
def test_messages_come_when_they_are_due(speed: float) -> None:
    clock = ManualClock(5)
    sink = Timed(clock)
    engine, _ = engine_of(two_feet(), [Echo()], [sink], speed=speed, clock=clock)
    engine.play()
    log, wall = np.array(sink.came).T
    late = (wall - 5) - (log - START) / speed
    assert late.min() >= -1
    assert late.max() <= 20_000_000 + 2  # one beat
    assert max(clock.slept) <= 0.02  # a pause is noticed soon


def test_pause_from_a_sink_and_on() -> None:
    source, sink = two_feet(50), Watcher()
    engine, _ = engine_of(source, [Echo()], [sink])
    sink.write = lambda topic, table: engine.pause()  # type: ignore[method-assign]
    assert not engine.play()
    first = engine.position_ns
    assert START < first < START + 60 * STEP_NS
    assert not engine.play()
    assert engine.position_ns > first
    while not engine.play():
        pass
    assert engine.finish().runs[0].samples == N


def test_paced_play_starts_at_the_present_position() -> None:
    clock = ManualClock()
    engine, _ = engine_of(two_feet(), [Echo()], speed=1.0, clock=clock)
    engine.seek(START + 70 * STEP_NS)
    assert not clock.slept
    engine.play()
    assert sum(clock.slept) == pytest.approx(0.5, abs=0.03)


@pytest.mark.parametrize("speed", ["fast", 0, -1, float("nan"), float("inf")])
def test_speed_is_max_or_a_factor(speed: Any) -> None:
    with pytest.raises(UsageError, match="speed"):
        engine_of(two_feet(), [Echo()], speed=speed)


# -- latency, events, offline --------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", ["block", "sample"])
def test_a_late_result_speaks_of_its_row_and_is_logged_when_known(mode: str) -> None:
    _, at_once = run_all(two_feet(64), [Smoother()], mode=mode)
    _, late = run_all(two_feet(64), [Smoother(latency=7)], mode=mode)
    now, then = at_once["/estimate/smoother_left_imu/state"], late["/estimate/smoother_left_imu/state"]
    assert then.drop("t_log_ns").equals(now.drop("t_log_ns"))
    logs = now["t_log_ns"].to_list()
    assert then["t_log_ns"].to_list() == logs[7:] + [logs[-1]] * 7


def test_an_event_exists_only_where_it_has_a_value() -> None:
    _, found = run_all(two_feet(), [Smoother()])
    strong = imu_table(N, 1).filter(pl.col("acc_x") > 1.5)
    assert found["/estimate/smoother_left_imu/peak"]["t_ns"].to_list() == strong["t_ns"].to_list()


class TooEarly(Smoother):
    name = "early"

    def step(self, row: np.ndarray) -> np.ndarray:
        return self._update(row)


def test_a_result_before_its_latency_is_an_error() -> None:
    engine, _ = engine_of(two_feet(), [TooEarly(latency=3)])
    with pytest.raises(MarchaError, match="first 3 rows"):
        engine.play()


class Centred(RowEstimator):
    """Needs the future: subtracts the mean of the whole walk."""

    name = "centred"
    offline = True
    inputs = (Input("imu", IMU, ACC),)
    outputs = (Output("acc", VALUES, ACC),)

    def process(self, rows: np.ndarray) -> np.ndarray:
        return rows[:, 1:] - rows[:, 1:].mean(axis=0)


def test_an_offline_estimator_is_known_at_the_end_of_the_recording() -> None:
    result, found = run_all(two_feet(64), [Centred])
    acc = found["/estimate/centred_left_imu/acc"]
    assert acc["t_ns"].to_list() == imu_table(N, 1)["t_ns"].to_list()
    assert acc["t_log_ns"].unique().to_list() == [START + (N - 1) * STEP_NS + 3_000_000]
    raw = imu_table(N, 1).select(ACC).to_numpy()
    np.testing.assert_allclose(acc.select(ACC).to_numpy(), raw - raw.mean(axis=0))
    assert result.runs[0].lineage["offline"] == "true"


def test_an_offline_estimator_survives_a_seek() -> None:
    engine, tables = engine_of(two_feet(64), [Centred], checkpoint_s=0.5)
    engine.play(until_ns=START + 70 * STEP_NS)
    engine.seek(START + 30 * STEP_NS)
    engine.play()
    assert same_bits(results_of(engine.finish(), tables), run_all(two_feet(64), [Centred])[1])


def test_a_restart_flushes_what_was_held() -> None:
    t = [k * STEP_NS for k in (*range(10), *range(100, 110))]
    source = MemorySource([(LEFT, table(t, {c: np.arange(20.0) for c in ACC}))])
    _, found = run_all(source, [Smoother(latency=4)], gap=GapPolicy("reset"))
    state = found["/estimate/smoother_left_imu/state"]
    assert state["t_ns"].to_list() == t
    assert state["t_log_ns"].to_list()[6:10] == [9 * STEP_NS] * 4
    alone = MemorySource([(LEFT, source.tables["/left/imu"][10:])])
    _, second = run_all(alone, [Smoother(latency=4)])
    assert state[10:].equals(second["/estimate/smoother_left_imu/state"])


class Bare:
    """The least that the protocol asks: no base class, no snapshot, no latency."""

    name = "bare"
    inputs = (Input("imu", IMU, ACC),)
    outputs = (Output("sum", VALUES, ("total",)),)

    def __init__(self) -> None:
        self.total = 0.0

    def step(self, row: np.ndarray) -> np.ndarray | None:
        self.total += row[1]
        return np.array([self.total]) if self.total > 0 else None


def test_a_bare_class_is_enough_and_can_be_sought() -> None:
    _, straight = run_all(two_feet(), [Bare()])
    engine, tables = engine_of(two_feet(), [Bare()], checkpoint_s=0.5)
    engine.play()
    engine.seek(START + 50 * STEP_NS)
    engine.play()
    assert same_bits(results_of(engine.finish(), tables), straight)
    totals = np.cumsum(imu_table(N, 1)["acc_x"].to_numpy())
    found = straight["/estimate/bare_left_imu/sum"]["total"].to_numpy()
    np.testing.assert_array_equal(found, totals[totals > 0])


class Worried(Echo):
    name = "worried"

    def remarks(self) -> list[Remark]:
        return [Remark("upside_down", "gravity points up", fatal=True)]


def test_remarks_become_findings() -> None:
    result, _ = run_all(two_feet(), [Worried()])
    assert result.runs[0].fatal
    assert ("upside_down", "gravity points up") in [(f.kind, f.detail) for f in result.runs[0].findings]


# -- failure -------------------------------------------------------------------------------------------------


class Broken(Echo):
    def step(self, row: np.ndarray) -> np.ndarray:
        raise ZeroDivisionError("a bug of the user")


def test_an_estimator_that_raises_leaves_nothing_behind() -> None:
    sink = Watcher()
    engine, _ = engine_of(two_feet(), [Broken()], [sink])
    with pytest.raises(ZeroDivisionError), engine:
        engine.play()
    assert sink.closed == [None]


class BadSink(Watcher):
    def close(self, result: Any) -> None:
        super().close(result)
        raise MarchaError("disk full")


def test_a_sink_that_fails_to_close_does_not_keep_the_others_open() -> None:
    bad, good = BadSink(), Watcher()
    engine, _ = engine_of(two_feet(), [Echo()], [bad, good])
    engine.play()
    with pytest.raises(MarchaError, match="disk full"):
        engine.finish()
    assert len(good.closed) == 1


class FailingSource(MemorySource):
    def batches(self, *args: Any, **kwargs: Any) -> Any:
        yield from super().batches(*args, **kwargs)
        raise MarchaError("file.mcap: chunk 7 cannot be read")


def test_an_error_of_the_reading_thread_arrives() -> None:
    engine, _ = engine_of(FailingSource([(LEFT, imu_table(N))]), [Echo()])
    with pytest.raises(MarchaError, match="chunk 7"):
        engine.play()


def test_no_thread_outlives_the_engine() -> None:
    before = threading.active_count()
    engine, _ = engine_of(two_feet(1), [Echo()])
    engine.step()
    engine.abort()
    assert threading.active_count() == before


def test_reading_runs_only_a_little_ahead() -> None:
    source = two_feet(1)
    engine, _ = engine_of(source, [Echo()])
    for _ in range(10):
        engine.step()
    assert source.batches_read <= 10 + 4
    engine.abort()


def test_progress_ends_at_the_whole() -> None:
    calls: list[tuple[int, int]] = []
    run_all(two_feet(50), [Echo()], progress=lambda done, total: calls.append((done, total)))
    assert len(calls) == 5
    assert calls == sorted(calls)
    assert calls[-1][0] == calls[-1][1] > 0
