"""Cut, merged and anonymous recordings: their marks, their parents, and everything that is left to read."""

from __future__ import annotations

import json
from pathlib import Path

import marcha.recording as mr
import polars as pl
import pytest
from marcha.recording import Recording
from marcha.recording.events import VOCABULARY, vocabularies
from marcha.recording.parts import anonymize, cut, merge
from marcha.recording.provenance import hash_file

S = 10**9
ZERO = 1_700_000_000 * S
MARKS = {
    "before": (1, 2),
    "up to the cut": (2, 3),
    "into it": (2, 4),
    "instant at the cut": (3, 3),
    "inside": (4, 5),
    "over both": (1, 9),
    "out of it": (6, 8),
    "instant at its end": (7, 7),
    "from its end": (7, 9),
}
"""Marks of a walk of ten seconds, cut from 3 to 7 s: start and end in seconds."""


def walk(path: Path, words: str = "turn") -> Recording:
    """Write ten seconds of a sensor, an estimate of it, radio, and marks."""
    t_ns = ZERO + S * pl.arange(10, eager=True)
    with mr.create(path) as out:
        imu = pl.DataFrame({"t_ns": t_ns, **{f"gyr_{a}": 0.5 for a in "xyz"}})
        out.add_table("/foot/imu", "sensor_msgs/msg/Imu", imu, "sole", {"serial": "A1", "side": "left"})
        pose = pl.DataFrame({"t_ns": t_ns, **{f"pos_{a}": 0.5 for a in "xyz"}})
        out.add_table(
            "/estimate/a/pose", "geometry_msgs/msg/PoseStamped", pose, "nav", {"input": "/foot/imu"}
        )
        seen = pl.DataFrame(
            {"t_ns": t_ns, "mac": "aa:bb:cc:dd:ee:ff", "rssi_dbm": -50.0, "last_seen_ns": 5 + t_ns - ZERO}
        )
        out.add_table("/phone/radio", "marcha_msgs/msg/RadioSignal", seen)
        values = pl.DataFrame({"t_ns": t_ns, "jitter_ns": 7.0})
        out.add_table("/phone/values", "marcha_msgs/msg/NamedValues", values)
        marks = pl.DataFrame(
            {
                "tier": "walk of Eva",
                "start_ns": [ZERO + a * S for a, _ in MARKS.values()],
                "end_ns": [ZERO + b * S for _, b in MARKS.values()],
                "label": list(MARKS),
                "channel": "/foot/imu",
            }
        )
        out.add_annotations(marks)
        out.add_metadata(VOCABULARY, {"walk of Eva": json.dumps({"labels": {words: words}})})
        out.add_metadata("provenance", {"tool": "x", "sources": "eva.csv"})
        out.add_metadata("study", {"place": "a " + "long " * 40 + "way", "serial_number": "77"})
    return mr.open(path)


@pytest.fixture
def rec(tmp_path: Path) -> Recording:
    return walk(tmp_path / "eva.mcap")


def test_marks_are_cut_to_the_part_and_none_is_made(rec: Recording, tmp_path: Path) -> None:
    last = ZERO + 7 * S - 1
    cut(rec, tmp_path / "b.mcap", ZERO + 3 * S, ZERO + 7 * S)
    found = mr.open(tmp_path / "b.mcap").annotations
    assert {label: (a, b) for label, a, b in found.select("label", "start_ns", "end_ns").iter_rows()} == {
        "into it": (ZERO + 3 * S, ZERO + 4 * S),
        "instant at the cut": (ZERO + 3 * S, ZERO + 3 * S),
        "inside": (ZERO + 4 * S, ZERO + 5 * S),
        "over both": (ZERO + 3 * S, last),
        "out of it": (ZERO + 6 * S, last),
    }


def test_a_part_of_a_part_keeps_both_cuts_and_the_first_provenance(rec: Recording, tmp_path: Path) -> None:
    cut(rec, tmp_path / "b.mcap", ZERO + 1 * S, ZERO + 9 * S)
    cut(mr.open(tmp_path / "b.mcap"), tmp_path / "c.mcap", ZERO + 3 * S, ZERO + 7 * S)
    metadata = mr.open(tmp_path / "c.mcap").metadata
    assert metadata["provenance"] == rec.metadata["provenance"]
    assert [metadata[k]["source_blake2b"] for k in ("cut", "cut_2")] == [
        hash_file(tmp_path / name) for name in ("eva.mcap", "b.mcap")
    ]


def test_joined_recordings_keep_both_parents_and_what_points_at_topics(
    rec: Recording, tmp_path: Path
) -> None:
    other = walk(tmp_path / "ada.mcap")
    merge([rec, other], tmp_path / "d.mcap", prefixes=["/l", "/r"], offsets_ns=[0, -2 * S])
    both = mr.open(tmp_path / "d.mcap")
    for number, parent in ((1, rec), (2, other)):
        assert both.metadata[f"merge/{number}"]["source_blake2b"] == hash_file(parent.path)
        assert both.metadata[f"{parent.path.stem}/provenance"] == parent.metadata["provenance"]
    assert both.channels["/estimate/r_a/pose"].metadata["input"] == "/r/foot/imu"
    marks = both.annotations
    assert set(marks.filter(tier="r/walk of Eva")["channel"]) == {"/r/foot/imu"}
    assert marks.filter(tier="r/walk of Eva", label="inside")["start_ns"].to_list() == [ZERO + 2 * S]
    assert marks.height == 2 * len(MARKS)
    assert set(vocabularies(both.metadata)) == {"l/walk of Eva", "r/walk of Eva"}
    radio, values = both.table("/r/phone/radio"), both.table("/r/phone/values")
    assert radio["t_ns"][0] == ZERO - 2 * S
    assert radio["last_seen_ns"].to_list() == rec.table("/phone/radio")["last_seen_ns"].to_list()
    assert values["jitter_ns"].unique().to_list() == [7.0]


def test_words_on_which_two_recordings_differ_stay_below_their_names(rec: Recording, tmp_path: Path) -> None:
    other = walk(tmp_path / "ada.mcap", "stair")
    with mr.create(tmp_path / "marks.mcap") as out:  # no channel twice
        out.copy_from(other, ["/annotation/walk of Eva"])
    merge([rec, mr.open(tmp_path / "marks.mcap")], tmp_path / "d.mcap")
    metadata = mr.open(tmp_path / "d.mcap").metadata
    assert not vocabularies(metadata)
    assert {k for k in metadata if k.endswith(VOCABULARY)} == {f"eva/{VOCABULARY}", f"marks/{VOCABULARY}"}


def test_everything_that_is_left_is_listed_whole(rec: Recording, tmp_path: Path) -> None:
    done = anonymize(rec, tmp_path / "out.mcap")
    bare = mr.open(tmp_path / "out.mcap")
    assert set(done.left) >= {
        f"metadata study: place = {rec.metadata['study']['place']}",
        "tier 'walk of Eva'",
        "label 'inside'",
        "channel '/foot/imu'",
        "channel /foot/imu: side = left",
        "column /phone/values: jitter_ns",
    }
    assert set(done.removed) >= {
        "channel /foot/imu: serial",
        "metadata study: serial_number",
        "metadata provenance: sources",
        "/phone/radio: last_seen_ns, times of the receiver's own clock",
    }
    listed = "\n".join(done.left)
    for topic, channel in bare.channels.items():
        assert topic in listed or topic.startswith("/annotation/")
        assert channel.frame_id in listed
    for values in bare.metadata.values():
        assert all(f"{k} = {v}" in listed for k, v in values.items())
    assert "last_seen_ns" not in bare.table("/phone/radio").columns


def test_no_date_and_no_file_name_is_left_of_cuts_exports_and_merges(rec: Recording, tmp_path: Path) -> None:
    other = walk(tmp_path / "ada.mcap")
    cut(rec, tmp_path / "eva2.mcap", ZERO + S, ZERO + 9 * S)
    cut(mr.open(tmp_path / "eva2.mcap"), tmp_path / "eva3.mcap", ZERO + 2 * S, ZERO + 9 * S)
    merge([mr.open(tmp_path / "eva3.mcap"), other], tmp_path / "d.mcap", prefixes=["/l", "/r"])
    done = anonymize(mr.open(tmp_path / "d.mcap"), tmp_path / "out.mcap")
    metadata = mr.open(tmp_path / "out.mcap").metadata
    assert set(metadata) == {"part1/study", "part1/vocabulary", "part2/study", "part2/vocabulary", VOCABULARY}
    everything = str(metadata).replace("walk of Eva", "")  # the tier, which is listed
    assert not any(word in everything for word in ("eva", "ada", str(ZERO)[:6]))
    assert "metadata eva3/cut_2: start_ns" in done.removed


def test_hardware_addresses_in_texts_are_numbered_as_those_of_the_rows(tmp_path: Path) -> None:
    with mr.create(tmp_path / "ble.mcap") as out:
        seen = pl.DataFrame({"t_ns": [ZERO], "mac": ["aa:bb:cc:dd:ee:ff"], "rssi_dbm": [-50.0]})
        about = {"beacon": "E7:8F:13:56:24:CE", "heard": "aa:bb:cc:dd:ee:ff and 12:30:15 h"}
        out.add_table("/phone/radio", "marcha_msgs/msg/RadioSignal", seen, metadata=about)
        made = {"values": {"p_d0": -60}, "computed_from": [{"recording": "eva.mcap", "start_ns": "1"}]}
        values = {"findings": "no power of aa:bb:cc:dd:ee:ff", "calibration.radio": json.dumps(made)}
        out.add_metadata("run/a", values)
    found = anonymize(mr.open(tmp_path / "ble.mcap"), tmp_path / "b.mcap")
    anonymous = mr.open(tmp_path / "b.mcap")
    mac = anonymous.table("/phone/radio")["mac"][0]
    texts = anonymous.channels["/phone/radio"].metadata
    assert texts["heard"] == f"{mac} and 12:30:15 h"
    assert texts["beacon"] != mac
    values = anonymous.metadata["run/a"]
    assert values["findings"] == f"no power of {mac}"
    assert json.loads(values["calibration.radio"]) == {**made, "computed_from": []}
    assert "metadata run/a: calibration.radio: computed_from" in found.removed
    assert "2 hardware addresses: numbered" in found.removed
    left = (tmp_path / "b.mcap").read_bytes().lower() + "".join(found.left).lower().encode()
    assert b"aa:bb" not in left
    assert b"e7:8f" not in left
