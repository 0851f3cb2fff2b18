"""Live sources: what arrives now gives the bits that the recording gives."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path

import marcha.recording as mr
import numpy as np
import polars as pl
import pytest
from marcha.recording import UsageError
from marcha.replay import LiveSource, PlannedChannel, SourceFailed, replay

from .replay_helpers import (
    ACC,
    IMU,
    Echo,
    MemorySource,
    Smoother,
    channel,
    engine_of,
    imu_table,
    run_all,
    same_bits,
)

LEFT = channel("/left/imu", IMU, ACC, rate_hz="100")
RIGHT = channel("/right/imu", IMU, ACC, rate_hz="100")
ESTIMATORS = [Smoother(latency=5), Echo()]


def tables() -> list[tuple[PlannedChannel, pl.DataFrame]]:
    right = imu_table(200, 2).with_columns(pl.col("t_ns") + 4_000_000, pl.col("t_log_ns") + 4_000_000)
    return [(LEFT, imu_table(200, 1)), (RIGHT, right)]


def arrivals() -> list[tuple[str, int, list[float]]]:
    rows = [(t, c.topic, list(v)) for c, table in tables() for t, _, *v in table.iter_rows()]
    return [(topic, t, v) for t, topic, v in sorted(rows, key=lambda r: r[0])]


def test_an_iterator_gives_the_bits_of_the_recording() -> None:
    live = LiveSource([LEFT, RIGHT], iter(arrivals()))
    assert same_bits(run_all(live, ESTIMATORS)[1], run_all(MemorySource(tables()), ESTIMATORS)[1])


def test_another_thread_gives_the_bits_of_the_recording() -> None:
    live = LiveSource([LEFT, RIGHT], capacity=3)

    def device() -> None:
        for message in arrivals():
            live.put(*message)
        live.close()

    thread = threading.Thread(target=device)
    thread.start()
    found = run_all(live, ESTIMATORS, mode="sample")[1]
    thread.join()
    assert same_bits(found, run_all(MemorySource(tables()), ESTIMATORS)[1])


def test_results_come_while_the_device_still_talks() -> None:
    live = LiveSource([LEFT])
    engine, _ = engine_of(live, [Echo()])
    for topic, t_ns, values in arrivals()[:20:2]:
        live.put(topic, t_ns, values)
        assert engine.step() == (topic, t_ns)
    live.close()
    assert engine.finish().runs[0].samples == 10


def test_a_late_message_is_logged_when_it_came() -> None:
    live = LiveSource([LEFT, RIGHT], iter([("/left/imu", 50, [1.0] * 3), ("/right/imu", 20, [2.0] * 3)]))
    _, found = run_all(live, [Echo()])
    late = found["/estimate/echo_right_imu/row"]
    assert (late["t_ns"][0], late["t_log_ns"][0]) == (20, 50)


def test_repeated_and_backward_times_are_counted_not_fed() -> None:
    times = [10, 20, 20, 15, 30]
    live = LiveSource([LEFT], iter([("/left/imu", t, [1.0] * 3) for t in times]))
    result, found = run_all(live, [Echo()])
    assert found["/estimate/echo_left_imu/row"]["t_ns"].to_list() == [10, 20, 30]
    assert {f.kind: f.count for f in result.runs[0].findings} == {"duplicate_time": 1, "backwards_time": 1}


def failing() -> Iterator[tuple[str, int, list[float]]]:
    yield "/left/imu", 1, [1.0] * 3
    raise OSError("device unplugged")


def test_a_device_that_fails_is_one_line_and_loses_nothing(tmp_path: Path) -> None:
    with pytest.raises(SourceFailed, match="device unplugged"):
        replay(LiveSource([LEFT], failing()), [Echo()], out=tmp_path / "live.mcap")
    assert mr.open(tmp_path / "live.mcap").channels["/left/imu"].count == 1


def interrupted() -> Iterator[tuple[str, int, list[float]]]:
    yield "/left/imu", 1, [1.0] * 3


class Interrupting(Echo):
    def step(self, row: np.ndarray) -> np.ndarray:
        raise KeyboardInterrupt


def test_an_interrupt_ends_a_live_session_and_keeps_it(tmp_path: Path) -> None:
    replay(LiveSource([LEFT], interrupted()), [Interrupting()], out=tmp_path / "live.mcap")
    assert mr.open(tmp_path / "live.mcap").channels["/left/imu"].count == 1


def test_an_interrupt_of_a_recording_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        replay(MemorySource(tables()), [Interrupting()], out=tmp_path / "out.mcap")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("topic", "values"), [("/hand/imu", [1.0] * 3), ("/left/imu", [1.0] * 2)])
def test_a_message_that_does_not_fit_is_refused(topic: str, values: list[float]) -> None:
    with pytest.raises(UsageError):
        LiveSource([LEFT]).put(topic, 0, values)


def test_a_live_source_cannot_go_back() -> None:
    engine, _ = engine_of(LiveSource([LEFT]), [Echo()])
    with pytest.raises(UsageError, match="cannot seek"):
        engine.seek(0)


def test_the_declared_rate_is_used() -> None:
    assert LiveSource([LEFT]).rate_hz("/left/imu") == 100.0
