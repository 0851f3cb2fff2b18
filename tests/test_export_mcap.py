"""The annotated recording: everything in it, stance and steps as annotations, parts of it."""

from __future__ import annotations

import json
from pathlib import Path

import marcha.recording as mr
import numpy as np
import polars as pl
import pytest
from marcha.export import export
from marcha.export.series import evenly
from marcha.recording import Recording
from polars.testing import assert_frame_equal

from .contracts.exporter import START_NS, example


@pytest.fixture
def rec(tmp_path: Path) -> Recording:
    return mr.open(example(tmp_path / "example.mcap"))


def exported(rec: Recording, **options: object) -> Recording:
    path = rec.path.with_name("out.mcap")
    export(rec, "mcap", path, options=options)
    return mr.open(path)


@pytest.mark.parametrize("topic", ["/foot/imu1", "/foot/mag", "/estimate/mine/stance", "/empty"])
def test_channels_are_all_there(rec: Recording, topic: str) -> None:
    out = exported(rec)
    assert_frame_equal(out.table(topic, log_time=True), rec.table(topic, log_time=True))
    assert out.channels[topic].metadata == rec.channels[topic].metadata


def test_metadata_attachments_and_provenance_come_along(rec: Recording) -> None:
    out = exported(rec)
    assert out.metadata["device"] == rec.metadata["device"]
    assert out.attachment("plan/floor.txt") == b"a floor plan"
    assert out.metadata["export"]["source"] == "example.mcap"


def test_an_export_of_an_export_keeps_both_provenances(rec: Recording) -> None:
    export(exported(rec), "mcap", rec.path.with_name("again.mcap"))
    metadata = mr.open(rec.path.with_name("again.mcap")).metadata
    assert metadata["export"]["source"] == "example.mcap"
    assert metadata["export_2"]["source"] == "out.mcap"


def test_stances_become_annotations(rec: Recording) -> None:
    stance = rec.table("/estimate/mine/stance")
    found = exported(rec).annotations.filter(tier="mine/stance")
    inside = pl.lit(False)
    for row in found.iter_rows(named=True):
        inside = inside | pl.col("t_ns").is_between(row["start_ns"], row["end_ns"], closed="both")
    assert_frame_equal(stance.with_columns(still=inside), stance)


def test_stances_that_are_annotated_already_are_not_doubled(rec: Recording) -> None:
    once = exported(rec)
    export(once, "mcap", rec.path.with_name("again.mcap"))
    assert_frame_equal(mr.open(rec.path.with_name("again.mcap")).annotations, once.annotations)


def test_steps_become_annotations(tmp_path: Path) -> None:
    step = pl.DataFrame(
        {
            "t_ns": [20, 40],
            "start_ns": [10, 30],
            "end_ns": [20, 40],
            "index": pl.Series([0, 1], dtype=pl.UInt32),
            "length_m": [1.25, 1.5],
            "height_m": [0.0, 0.25],
            "heading_rad": [0.5, 0.75],
        }
    )
    with mr.create(tmp_path / "a.mcap") as out:
        out.add_table("/estimate/mine/step", "marcha_msgs/msg/Step", step)
    found = exported(mr.open(tmp_path / "a.mcap")).annotations
    assert found.select("tier", "start_ns", "end_ns", "label").rows() == [
        ("mine/step", 10, 20, "step 0"),
        ("mine/step", 30, 40, "step 1"),
    ]
    assert json.loads(found["metadata"][1])["length_m"] in (1.5, "1.5")


def test_estimates_can_be_left_out(rec: Recording) -> None:
    out = exported(rec, estimates="false")
    assert "/estimate/mine/stance" not in out.channels
    assert "mine/stance" in out.annotations["tier"]


def test_annotations_can_be_left_out(rec: Recording) -> None:
    assert exported(rec, annotations=False).annotations.height == 0


def test_a_part_of_the_time(rec: Recording) -> None:
    out = exported(rec, start_ns=START_NS + 10**9, end_ns=START_NS + 3 * 10**9)
    expected = rec.table("/foot/imu1", start_ns=START_NS + 10**9, end_ns=START_NS + 3 * 10**9)
    assert_frame_equal(out.table("/foot/imu1"), expected)
    assert out.channels["/empty"].count == 0
    assert out.annotations.filter(tier="manual")["label"].to_list() == ["turn"]
    assert out.metadata["device"] == rec.metadata["device"]


def test_topics_can_be_chosen(rec: Recording) -> None:
    out = exported(rec, topics="/foot/*")
    assert [t for t in out.channels if not t.startswith("/annotation")] == ["/foot/imu1", "/foot/mag"]


def test_readings_at_even_times(rec: Recording) -> None:
    out = exported(rec, rate_hz="40")
    imu, own = out.table("/foot/imu1"), rec.table("/foot/imu1")
    t = imu["t_ns"].to_numpy()
    assert np.array_equal(np.diff(t), np.full(len(t) - 1, 25_000_000))
    assert t[0] == own["t_ns"][0]
    assert own["t_ns"][-1] - t[-1] < 25_000_000
    expected = np.interp(t - t[0], own["t_ns"].to_numpy() - t[0], own["acc_y"].to_numpy())
    assert np.allclose(imu["acc_y"].to_numpy(), expected, atol=1e-12)
    norm = np.linalg.norm(
        out.table("/reference/pose").select([f"quat_{a}" for a in "wxyz"]).to_numpy(), axis=1
    )
    assert np.abs(norm - 1).max() < 1e-12
    assert out.channels["/foot/imu1"].metadata["resampled_hz"] == "40"
    for topic in ("/phone/gnss", "/estimate/mine/stance"):  # no quantity between two of these
        assert_frame_equal(out.table(topic, log_time=True), rec.table(topic, log_time=True))
    assert out.metadata["device"] == rec.metadata["device"]
    assert out.annotations["label"].to_list().count("turn") == 1


def test_a_gap_stays_a_gap() -> None:
    t = np.r_[np.arange(0, 10**9, 10**7), np.arange(3 * 10**9, 4 * 10**9, 10**7)]
    table = evenly(pl.DataFrame({"t_ns": t, "x": t * 1e-9}), 50.0)
    got = table["t_ns"].to_numpy()
    assert not ((got > 990_000_000) & (got < 3 * 10**9)).any()
    assert np.allclose(table["x"].to_numpy(), got * 1e-9)
