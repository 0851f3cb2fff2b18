"""Parts of recordings, several in one, and what tells whose it is taken out."""

from __future__ import annotations

from pathlib import Path

import marcha.recording as mr
import polars as pl
import pytest
from marcha.recording import Recording, UsageError
from marcha.recording.changes import change
from marcha.recording.parts import anonymize, cut, merge
from marcha.recording.provenance import hash_file
from polars.testing import assert_frame_equal

from .contracts.exporter import START_NS, example

S = 10**9


@pytest.fixture
def rec(tmp_path: Path) -> Recording:
    return mr.open(example(tmp_path / "walk.mcap"))


def test_a_part_has_the_rows_and_the_clipped_annotations_of_its_time(rec: Recording, tmp_path: Path) -> None:
    start, end = START_NS + 1_500_000_000, START_NS + 4 * S
    cut(rec, tmp_path / "b.mcap", start, end)
    part = mr.open(tmp_path / "b.mcap")
    assert_frame_equal(part.table("/foot/imu1"), rec.table("/foot/imu1", start_ns=start, end_ns=end))
    assert part.annotations.select("start_ns", "end_ns", "label").rows() == [
        (start, START_NS + 2 * S, "turn")
    ]
    assert part.annotations["id"][0] == rec.annotations["id"][0]
    assert part.metadata["cut"]["source_blake2b"] == hash_file(rec.path)
    assert part.attachment("plan/floor.txt") == b"a floor plan"
    with pytest.raises(UsageError, match="nothing lies between"):
        cut(rec, tmp_path / "c.mcap", 0, 5)


def test_two_parts_joined_are_the_whole(rec: Recording, tmp_path: Path) -> None:
    middle = START_NS + 3 * S
    cut(rec, tmp_path / "b.mcap", rec.start_ns, middle)
    cut(rec, tmp_path / "c.mcap", middle, rec.end_ns + 1)
    with pytest.raises(UsageError, match=r"is in .*b\.mcap too"):
        merge([mr.open(tmp_path / f"{n}.mcap") for n in "bc"], tmp_path / "d.mcap")
    merge([mr.open(tmp_path / f"{n}.mcap") for n in "bc"], tmp_path / "d.mcap", prefixes=["/b", "/c"])
    both = mr.open(tmp_path / "d.mcap")
    rows = pl.concat([both.table("/b/foot/imu1"), both.table("/c/foot/imu1")])
    assert_frame_equal(rows, rec.table("/foot/imu1"))
    assert both.annotations["tier"].to_list() == ["b/manual", "c/manual"]
    assert {both.metadata[f"merge/{k}"]["source"] for k in (1, 2)} == {"b.mcap", "c.mcap"}


def test_an_offset_moves_every_time(rec: Recording, tmp_path: Path) -> None:
    merge([rec, rec], tmp_path / "d.mcap", offsets_ns=[0, 7 * S], prefixes=["", "/late"])
    both = mr.open(tmp_path / "d.mcap")
    one, two = (both.table(t, log_time=True) for t in ("/estimate/mine/stance", "/estimate/late_mine/stance"))
    assert_frame_equal(two, one.with_columns(pl.col("t_ns", "t_log_ns") + 7 * S))
    assert both.annotations["id"].n_unique() == 4
    assert (both.annotations["start_ns"].to_list()[0], both.annotations.height) == (START_NS + S, 4)


def test_nothing_that_names_a_person_or_a_place_is_left(rec: Recording, tmp_path: Path) -> None:
    mark = pl.DataFrame(
        {
            "tier": "t",
            "start_ns": START_NS + S,
            "end_ns": START_NS + S,
            "label": "fall",
            "source": "human:anna",
            "note": "Anna fell",
        }
    )
    change(rec, tmp_path / "b.mcap", add=mark, by="anna")
    done = anonymize(mr.open(tmp_path / "b.mcap"), tmp_path / "c.mcap")
    bare = mr.open(tmp_path / "c.mcap")
    assert bare.start_ns == 0
    assert "/phone/gnss" not in bare.channels
    assert not bare.attachments
    everything = str(bare.metadata) + str(bare.annotations.rows())
    assert "anna" not in everything.lower()
    assert "example" not in everything
    assert bare.annotations.filter(label="fall")["start_ns"].to_list() == [S]
    assert_frame_equal(bare.table("/foot/imu1").drop("t_ns"), rec.table("/foot/imu1").drop("t_ns"))
    assert "metadata device: name" in done.removed
    assert "label 'fall'" in done.left
    assert "metadata device: clock = unix" in done.left


def test_hardware_addresses_are_numbered(tmp_path: Path) -> None:
    radio = pl.DataFrame(
        {
            "t_ns": [1, 2, 3],
            "mac": ["aa:bb:cc:dd:ee:ff", "11:22:33:44:55:66", "aa:bb:cc:dd:ee:ff"],
            "rssi_dbm": [-50.0, -60.0, -70.0],
        }
    )
    with mr.create(tmp_path / "a.mcap") as out:
        out.add_table("/phone/radio", "marcha_msgs/msg/RadioSignal", radio)
    anonymize(mr.open(tmp_path / "a.mcap"), tmp_path / "b.mcap")
    macs = mr.open(tmp_path / "b.mcap").table("/phone/radio")["mac"].to_list()
    assert macs == ["00:00:00:00:00:00", "00:00:00:00:00:01", "00:00:00:00:00:00"]
