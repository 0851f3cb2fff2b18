"""Windows and messages: in log-time order, ties by channel order, disjoint, of bounded size."""

from __future__ import annotations

import marcha.recording as mr
import numpy as np
import polars as pl
import pytest
from hypothesis import given
from hypothesis import strategies as st
from marcha.recording import mcapfile, reader, writer

from .recording_samples import imu

STANCE = "marcha_msgs/msg/Stance"

times = st.lists(st.integers(0, 60), max_size=40).map(sorted)


@pytest.fixture
def small_chunks(monkeypatch):
    """Chunks of about 12 messages, so that a small recording has many."""
    monkeypatch.setattr(writer, "CHUNK_SIZE", 1000)
    monkeypatch.setattr(mcapfile, "CHUNK_SIZE", 1000)


def recording(folder, channels: list[list[int]]) -> mr.Recording:
    path = folder / "a.mcap"
    with mr.create(path) as out:
        for i, log in enumerate(channels):
            table = pl.DataFrame(
                {"t_ns": log, "t_log_ns": log}, schema={"t_ns": pl.Int64, "t_log_ns": pl.Int64}
            )
            still = pl.Series("still", [k % 2 == 0 for k in range(len(log))], dtype=pl.Boolean)
            out.add_table(f"/c{i}", STANCE, table.with_columns(still))
    return mr.open(path)


@given(
    st.lists(times, min_size=1, max_size=4),
    st.integers(1, 30),
    st.none() | st.integers(0, 60),
    st.integers(0, 70),
)
def test_windows_are_the_recording_cut_by_log_time(
    small_chunks, tmp_path_factory, channels, max_rows, start, end
):
    rec = recording(tmp_path_factory.mktemp("w"), channels)
    windows = list(rec.windows(start_ns=start, end_ns=end, max_rows=max_rows))
    last = -1
    for window in windows:
        assert last <= window.start_ns < window.end_ns
        last = window.end_ns
        logs = np.concatenate([t["t_log_ns"].to_numpy() for t in window.tables.values()])
        assert ((logs >= window.start_ns) & (logs < window.end_ns)).all()
        assert len(logs) <= max_rows or len(set(logs.tolist())) == 1
    for i, log in enumerate(channels):
        got = [t for w in windows if f"/c{i}" in w.tables for t in w.tables[f"/c{i}"]["t_log_ns"].to_list()]
        assert got == [t for t in log if (start or 0) <= t < end]


@given(st.lists(times, min_size=1, max_size=4), st.data())
def test_messages_are_a_stable_merge(small_chunks, tmp_path_factory, channels, data):
    rec = recording(tmp_path_factory.mktemp("m"), channels)
    topics = data.draw(
        st.none() | st.sets(st.sampled_from([f"/c{i}" for i in range(len(channels))]), min_size=1)
    )
    expected = [
        (t, i, k)
        for i, log in enumerate(channels)
        if topics is None or f"/c{i}" in topics
        for k, t in enumerate(log)
    ]
    got = [(m.t_log_ns, m.topic, m.values["still"]) for m in rec.messages(topics)]
    assert got == [(t, f"/c{i}", k % 2 == 0) for t, i, k in sorted(expected)]


@given(times, st.integers(-5, 65), st.integers(-5, 65))
def test_tables_obey_the_half_open_range(small_chunks, tmp_path_factory, log, start, end):
    rec = recording(tmp_path_factory.mktemp("t"), [log])
    table = rec.table("/c0", start, end, log_time=True)
    assert table["t_log_ns"].to_list() == [t for t in log if start <= t < end]
    assert table.schema == {"t_ns": pl.Int64, "t_log_ns": pl.Int64, "still": pl.Boolean}


def test_few_rows_are_held_whatever_the_length(tmp_path, monkeypatch):
    path = tmp_path / "a.mcap"
    with mr.create(path) as out:
        for topic in ("/a", "/b"):
            out.add_table(topic, "sensor_msgs/msg/Imu", imu(60_000))
    rec = mr.open(path)
    held = []
    cut = reader.cut

    def spy(tables, horizon, max_rows):
        held.append(sum(len(columns["t_ns"]) for parts in tables.values() for columns in parts))
        return cut(tables, horizon, max_rows)

    monkeypatch.setattr(reader, "cut", spy)
    rows = sum(t.height for w in rec.windows(max_rows=5000) for t in w.tables.values())
    per = (1 << 20) // 355
    assert rows == 120_000
    assert len(held) > 10
    assert max(held) <= 5000 + 4 * per


def test_annotations_are_not_replayed_unless_asked_for(tmp_path):
    with mr.create(tmp_path / "a.mcap") as out:
        out.add_table("/imu", "sensor_msgs/msg/Imu", imu(3))
        out.add_annotations(pl.DataFrame({"tier": ["t"], "start_ns": [0], "end_ns": [5], "label": ["x"]}))
    rec = mr.open(tmp_path / "a.mcap")
    assert {m.topic for m in rec.messages()} == {"/imu"}
    assert [m.values["label"] for m in rec.messages(["/annotation/t"])] == ["x"]
