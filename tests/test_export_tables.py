"""CSV and Parquet folders: read back equal, say what is in them, bounded in memory."""

from __future__ import annotations

import json
from pathlib import Path

import marcha.recording as mr
import polars as pl
import pytest
from marcha.export import export
from marcha.export.tables import _file_names
from marcha.recording import MarchaError, Recording
from polars.testing import assert_frame_equal

from .contracts.exporter import ROWS, START_NS, example
from .recording_samples import sample_table, write


@pytest.fixture
def rec(tmp_path: Path) -> Recording:
    return mr.open(example(tmp_path / "example.mcap"))


def sidecar(folder: Path) -> dict:
    return json.loads((folder / "channels.json").read_text())


@pytest.mark.parametrize("topic", ["/foot/imu1", "/foot/mag", "/estimate/mine/stance", "/empty"])
def test_parquet_reads_back_equal(rec: Recording, tmp_path: Path, topic: str) -> None:
    export(rec, "parquet", tmp_path / "out")
    (entry,) = (c for c in sidecar(tmp_path / "out")["channels"] if c["topic"] == topic)
    assert_frame_equal(pl.read_parquet(tmp_path / "out" / entry["file"]), rec.table(topic, log_time=True))


@pytest.mark.parametrize("topic", ["/foot/imu1", "/foot/mag", "/estimate/mine/stance"])
def test_csv_reads_back_equal(rec: Recording, tmp_path: Path, topic: str) -> None:
    export(rec, "csv", tmp_path / "out")
    table = rec.table(topic, log_time=True)
    (entry,) = (c for c in sidecar(tmp_path / "out")["channels"] if c["topic"] == topic)
    assert_frame_equal(pl.read_csv(tmp_path / "out" / entry["file"], schema_overrides=table.schema), table)


@pytest.mark.parametrize("schema", list(mr.SCHEMAS))
@pytest.mark.parametrize("to", ["csv", "parquet"])
def test_every_message_type_keeps_every_value(tmp_path: Path, schema: str, to: str) -> None:
    rec = mr.open(write(tmp_path / "a.mcap", {"/a": (schema, sample_table(schema, rows=30))}))
    export(rec, to, tmp_path / "out")
    table = rec.table("/a", log_time=True)
    if to == "csv":
        again = pl.read_csv(tmp_path / "out" / "a.csv", schema_overrides=table.schema)
    else:
        again = pl.read_parquet(tmp_path / "out" / "a.parquet")
    assert_frame_equal(again, table)


@pytest.mark.parametrize("schema", list(mr.SCHEMAS))
def test_every_column_has_a_unit_and_a_meaning(tmp_path: Path, schema: str) -> None:
    rec = mr.open(write(tmp_path / "a.mcap", {"/a": (schema, sample_table(schema, rows=3))}))
    export(rec, "csv", tmp_path / "out")
    (entry,) = sidecar(tmp_path / "out")["channels"]
    header = (tmp_path / "out" / "a.csv").read_text().splitlines()[0].split(",")
    assert [c["name"] for c in entry["columns"]] == header
    assert all(c["unit"] and c["meaning"] for c in entry["columns"])


def test_sidecar_says_where_it_comes_from(rec: Recording, tmp_path: Path) -> None:
    export(rec, "csv", tmp_path / "out")
    said = sidecar(tmp_path / "out")
    assert said["source"] == "example.mcap"
    assert said["metadata"]["device"] == {"clock": "unix", "name": "example"}
    imu = said["channels"][0]
    assert (imu["schema"], imu["frame_id"], imu["rows"]) == ("sensor_msgs/msg/Imu", "imu1", ROWS)


def test_attachments_come_along_and_cannot_leave_the_folder(tmp_path: Path) -> None:
    with mr.create(tmp_path / "a.mcap") as out:
        out.add_channel("/empty", "sensor_msgs/msg/Temperature", columns=("temperature_c",))
        out.add_attachment("../../evil/x.txt", b"x")
    export(mr.open(tmp_path / "a.mcap"), "csv", tmp_path / "out")
    assert (tmp_path / "out" / "attachments" / "evil" / "x.txt").read_bytes() == b"x"
    assert not (tmp_path / "evil").exists()


def test_events_are_bids(rec: Recording, tmp_path: Path) -> None:
    export(rec, "csv", tmp_path / "out")
    events = pl.read_csv(tmp_path / "out" / "events.tsv", separator="\t")
    assert events.columns[:3] == ["onset", "duration", "trial_type"]
    assert events["onset"].to_list() == [1.0, 5.0]
    assert events["duration"].to_list() == [1.0, 0.0]
    assert events["trial_type"].to_list() == ["turn", "a tab\tand a comma, in it"]


def test_a_range_of_time_is_half_open(rec: Recording, tmp_path: Path) -> None:
    options = {"start_ns": START_NS + 10**9, "end_ns": START_NS + 2 * 10**9, "topics": ("/foot/imu1",)}
    export(rec, "parquet", tmp_path / "out", options=options)
    t_ns = pl.read_parquet(tmp_path / "out" / "foot_imu1.parquet")["t_ns"]
    assert (t_ns[0], t_ns[-1], t_ns.len()) == (START_NS + 10**9, START_NS + 2 * 10**9 - 10_000_000, 100)


def test_topics_that_would_share_a_file_are_numbered() -> None:
    names = _file_names(["/a/b", "/a_b", "/A/b", "/"], ".csv")
    assert list(names.values()) == ["a_b.csv", "a_b_2.csv", "A_b_3.csv", "channel.csv"]


def test_a_folder_of_something_else_is_never_replaced(rec: Recording, tmp_path: Path) -> None:
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "thesis.txt").write_text("do not lose me")
    with pytest.raises(MarchaError, match="marcha did not make"):
        export(rec, "csv", tmp_path / "home", overwrite=True)
    assert (tmp_path / "home" / "thesis.txt").read_text() == "do not lose me"


def test_what_a_killed_export_left_is_removed_by_the_next(rec: Recording, tmp_path: Path) -> None:
    left = tmp_path / ".out.999999999.part"
    left.mkdir()
    (left / "half.csv").write_text("1,2")
    export(rec, "csv", tmp_path / "out")
    assert not left.exists()


def test_an_export_that_stepped_aside_for_a_killed_one_comes_back(rec: Recording, tmp_path: Path) -> None:
    export(rec, "csv", tmp_path / "out")
    (tmp_path / "out").rename(tmp_path / ".out.999999999.old")
    with pytest.raises(mr.OutputExists):
        export(rec, "csv", tmp_path / "out")
    assert (tmp_path / "out" / "channels.json").is_file()


def test_a_failing_reader_is_not_disguised(
    rec: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = Recording.windows

    def breaks_later(self: Recording, *args: object, **kwargs: object) -> object:
        yield from real(self, *args, **kwargs)  # type: ignore[arg-type]
        raise MarchaError("example.mcap: chunk 7 is broken")

    monkeypatch.setattr(Recording, "windows", breaks_later)
    with pytest.raises(MarchaError, match="chunk 7 is broken"):
        export(rec, "parquet", tmp_path / "out")
    assert not (tmp_path / "out").exists()
