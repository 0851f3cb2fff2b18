"""BIDS there and back: what marcha exports returns equal, and what others write is read by its channels."""

from __future__ import annotations

import json
from pathlib import Path

import marcha.recording as mr
import numpy as np
import polars as pl
import pytest
from marcha.export import export
from marcha.export.bids import BidsOptions, write_dataset
from marcha.ingest import convert
from marcha.ingest.formats.bids import Bids
from marcha.recording import MarchaError, Recording, UsageError
from polars.testing import assert_frame_equal

from .cli_helpers import marcha
from .contracts.exporter import START_NS, example
from .contracts.importer import ImporterContract

RATE = 128.0
HEADS = "name\tcomponent\ttype\ttracked_point\tunits\treference_frame\tsampling_frequency"


def foreign(folder: Path, *, rows: int = 600, system: str = "imu", latency: bool = False) -> Path:
    """Write the tables of one tracking system as other tools do; return the motion table."""
    rng = np.random.default_rng(5)
    motion = folder / "sub-01" / "motion"
    motion.mkdir(parents=True, exist_ok=True)
    (folder / "dataset_description.json").write_text('{"Name": "x", "BIDSVersion": "1.9.0"}')
    stem = f"sub-01_task-walk_tracksys-{system}"
    names = [
        (f"foot_{k}_{a}", a, k, "foot", u) for k, u in (("ACCEL", "g"), ("GYRO", "deg/s")) for a in "xyz"
    ]
    moves = (np.arange(rows) > 100)[:, None]  # at rest first
    values = rng.normal(0, 1e-3, (rows, 6)) + np.column_stack(
        (moves * rng.normal(0, 1, (rows, 3)) + np.array([0, 0, 1]), moves * rng.normal(0, 40, (rows, 3)))
    )
    if system == "optical":
        names = [(f"{p}_POS_{a}", a, "POS", p, "mm") for p in ("heel", "toe") for a in "xyz"]
        names += [(f"heel_q{a}", f"quat_{a}", "ORNT", "heel", "n/a") for a in "wxyz"]
        values = np.column_stack((rng.normal(0, 900, (rows, 6)), np.tile([1.0, 0.0, 0.0, 0.0], (rows, 1))))
    if latency:
        names = [("time", "n/a", "LATENCY", "n/a", "s"), *names]
        values = np.column_stack((np.arange(rows) / RATE, values))
    text = "\n".join("\t".join(map(repr, row)) for row in values.tolist()) + "\n"
    (motion / f"{stem}_motion.tsv").write_text(text)
    table = [HEADS, *("\t".join((n, c, k, p, u, "lab", str(RATE))) for n, c, k, p, u in names)]
    (motion / f"{stem}_channels.tsv").write_text("\n".join(table) + "\n")
    (motion / f"{stem}_motion.json").write_text(json.dumps({"SamplingFrequency": RATE, "TaskName": "walk"}))
    return motion / f"{stem}_motion.tsv"


class TestBids(ImporterContract):
    importer = Bids()

    def sample(self, folder: Path) -> Path:
        return foreign(folder)


@pytest.fixture(scope="module")
def rec(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return mr.open(example(tmp_path_factory.mktemp("bids") / "walk.mcap"))


def test_what_was_exported_comes_back_equal(rec: Recording, tmp_path: Path) -> None:
    export(rec, "bids", tmp_path / "ds")
    first = next((tmp_path / "ds" / "sub-01" / "motion").glob("*_motion.tsv"))
    convert([first], tmp_path / "back.mcap")
    back = mr.open(tmp_path / "back.mcap")
    for topic, channel in rec.channels.items():
        if channel.count and not topic.startswith("/annotation/"):
            assert_frame_equal(back.table(topic, log_time=True), rec.table(topic, log_time=True))
            assert back.channels[topic].schema == channel.schema
            assert back.channels[topic].frame_id == channel.frame_id
    keep = ["tier", "start_ns", "end_ns", "id", "metadata", "source"]
    assert_frame_equal(back.annotations.select(keep), rec.annotations.select(keep))
    assert back.metadata["device"] == rec.metadata["device"]


def test_a_study_of_several_comes_back_as_its_recordings(rec: Recording, tmp_path: Path) -> None:
    other = mr.open(rec.path)
    write_dataset(
        {rec: BidsOptions(subject="01", session="a"), other: BidsOptions(subject="02", run="1")},
        tmp_path / "ds",
    )
    done = marcha("convert", tmp_path / "ds", "-o", f"{tmp_path / 'out'}/", "--json")
    assert done.code in (0, 3), done.err
    files = sorted((tmp_path / "out").glob("*.mcap"))
    assert len(files) == 2
    for file in files:
        assert mr.open(file).channels["/foot/imu1"].count == rec.channels["/foot/imu1"].count


def test_recordings_named_by_subject_become_one_study(rec: Recording, tmp_path: Path) -> None:
    walks = tmp_path / "walks"
    walks.mkdir()
    for name in ("sub-01_task-walk", "sub-01_task-stairs_run-2", "sub-02_ses-b_task-walk"):
        (walks / f"{name}.mcap").write_bytes(rec.path.read_bytes())
    assert marcha("export", walks, "--to", "bids", "-o", tmp_path / "ds").code == 0
    assert {p.name for p in (tmp_path / "ds").glob("sub-*")} == {"sub-01", "sub-02"}
    assert list((tmp_path / "ds" / "sub-02" / "ses-b" / "motion").glob("sub-02_ses-b_task-walk_*_motion.tsv"))
    (walks / "other.mcap").write_bytes(rec.path.read_bytes())
    said = marcha("export", walks, "--to", "bids", "-o", tmp_path / "ds2")
    assert said.code == 2
    assert "name the files sub-01_task-walk.mcap" in said.err.splitlines()[-1]
    assert not (tmp_path / "ds2").exists()
    assert marcha("export", walks, "--to", "parquet", "-o", tmp_path / "tables").code == 0
    assert (tmp_path / "tables" / "other" / "foot_imu1.parquet").is_file()


def test_tracking_systems_of_others_become_one_recording(tmp_path: Path) -> None:
    imu = foreign(tmp_path)
    foreign(tmp_path, system="optical", rows=300, latency=True)
    events = "onset\tduration\ttrial_type\n1.5\t0\theel strike\n2\t0.25\tturn\n"
    imu.with_name("sub-01_task-walk_events.tsv").write_text(events)
    scans = "filename\tacq_time\n" + "".join(
        f"motion/sub-01_task-walk_tracksys-{s}_motion.tsv\t2026-01-01T00:00:{k}\n"
        for s, k in (("imu", "00"), ("optical", "00.5"))
    )
    (tmp_path / "sub-01" / "sub-01_scans.tsv").write_text(scans)
    convert([imu], tmp_path / "out.mcap")
    rec = mr.open(tmp_path / "out.mcap")
    assert list(rec.channels)[:3] == ["/imu/foot/imu", "/reference/heel/pose", "/reference/toe/position"]
    table, raw = rec.table("/imu/foot/imu"), np.loadtxt(imu)
    assert np.allclose(table.select("acc_x", "acc_y", "acc_z").to_numpy(), raw[:, :3] * 9.80665, rtol=1e-15)
    assert np.allclose(table["gyr_y"].to_numpy(), np.radians(raw[:, 4]), rtol=1e-15)
    assert np.array_equal(np.diff(table["t_ns"].to_numpy()), np.full(599, 7_812_500))
    assert rec.metadata["device"]["clock"] == "utc"
    begin = 1_767_225_600 * 10**9
    assert table["t_ns"][0] == begin
    assert rec.table("/reference/heel/pose")["t_ns"][0] == begin + 500_000_000
    assert rec.annotations["label"].to_list() == ["heel strike", "turn"]
    assert rec.annotations["start_ns"].to_list() == [begin + 1_500_000_000, begin + 2_000_000_000]


def test_a_missing_reading_is_nan_and_a_row_without_a_time_is_counted(tmp_path: Path) -> None:
    path = foreign(tmp_path, latency=True)
    lines = path.read_text().split("\n")
    lines[10] = "\t".join(["n/a", *lines[10].split("\t")[1:]])
    lines[20] = "\t".join([lines[20].split("\t")[0], "n/a", *lines[20].split("\t")[2:]])
    path.write_text("\n".join(lines))
    done = convert([path], tmp_path / "out.mcap")
    assert done.report.rows_dropped == 1
    table = mr.open(tmp_path / "out.mcap").table("/imu/foot/imu")
    assert np.flatnonzero(np.isnan(table["acc_x"].to_numpy())).tolist() == [19]


@pytest.mark.parametrize(
    ("harm", "said"),
    [
        (
            lambda p: p.with_name(p.name.replace("motion.tsv", "channels.tsv")).unlink(),
            "no sub-01.*channels.tsv",
        ),
        (lambda p: p.write_text("1\t2\n3\t4\n"), "line 1: has 2 columns, .*channels.tsv lists 6"),
        (lambda p: p.with_name(p.name.replace(".tsv", ".json")).unlink(), "no LATENCY channel"),
        (lambda p: p.with_name(p.name.replace(".tsv", ".json")).write_text("{"), "is not JSON"),
    ],
)
def test_what_is_wrong_is_one_line(tmp_path: Path, harm: object, said: str) -> None:
    path = foreign(tmp_path)
    harm(path)  # type: ignore[operator]
    with pytest.raises(MarchaError, match=said) as caught:
        convert([path], tmp_path / "out.mcap", format="bids")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "out.mcap").exists()


def test_tables_of_two_recordings_are_refused(tmp_path: Path) -> None:
    one, two = foreign(tmp_path), foreign(tmp_path / "other")
    with pytest.raises(UsageError, match="another recording than"):
        convert([one, two], tmp_path / "out.mcap")


def test_the_origin_is_that_of_the_export(rec: Recording, tmp_path: Path) -> None:
    export(rec, "bids", tmp_path / "ds", options={"topics": "/foot/mag"})
    (table,) = (tmp_path / "ds").rglob("*_motion.tsv")
    convert([table], tmp_path / "back.mcap")
    assert mr.open(tmp_path / "back.mcap").start_ns == START_NS
    assert isinstance(mr.open(tmp_path / "back.mcap").annotations, pl.DataFrame)


def test_channels_known_at_other_times_stay_row_by_row(tmp_path: Path) -> None:
    """Windows are cut by when rows were known; a tracking system's row is of one time, in every window."""
    rows = 80_000  # more than a window holds
    t_ns = START_NS + 10_000_000 * np.arange(rows)
    with mr.create(tmp_path / "a.mcap") as out:
        for name, late_ns in (("near", 0), ("far", 300 * 10**9)):
            table = pl.DataFrame(
                {
                    "t_ns": t_ns,
                    "t_log_ns": t_ns + late_ns,
                    **{f"gyr_{a}": np.arange(rows) % 997.0 for a in "xyz"},
                }
            )
            out.add_table(f"/foot/{name}", "sensor_msgs/msg/Imu", table, frame_id=name)
    rec = mr.open(tmp_path / "a.mcap")
    export(rec, "bids", tmp_path / "ds")
    (path,) = (tmp_path / "ds").rglob("*_motion.tsv")
    found = pl.read_csv(path, separator="\t", has_header=False)
    assert found.shape == (rows, 1 + 3 + 3 + 1)
    assert np.array_equal(found[:, 0].to_numpy(), (t_ns - rec.start_ns) / 1e9)
    for column in range(1, 7):
        assert np.array_equal(found[:, column].to_numpy(), np.arange(rows) % 997.0)
    assert np.array_equal(found[:, 7].to_numpy(), (t_ns + 300 * 10**9 - rec.start_ns) / 1e9)
    about = json.loads(path.with_name(path.name.replace(".tsv", ".json")).read_text())
    assert about["SamplingFrequency"] == pytest.approx(100.0, rel=1e-12)
    assert about["RecordingDuration"] == (rows - 1) / 100
