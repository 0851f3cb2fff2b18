"""Every command does what it says, with the JSON keys that other programs rely on."""

from __future__ import annotations

import shutil
from pathlib import Path

import marcha.recording as mr
import polars as pl
import pytest
from marcha.algorithms import CALIBRATIONS, available

from .cli_helpers import marcha

CHANNEL = {"topic", "schema", "count", "start_ns", "end_ns"}
RUN = "foot_9iez_foot_imu2"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a raw log, its recording and a replayed one; tests must leave it as it is."""
    folder = tmp_path_factory.mktemp("walk")
    assert (
        marcha("simulate", "straight", "-o", folder / "raw", "--set", "length_m=6", "--name", "walk").code
        == 0
    )
    raw = folder / "raw" / "conf-3333-walk.csv"
    assert marcha("convert", raw, "-o", folder / "walk.mcap").code == 0
    done = marcha(
        "replay", folder / "walk.mcap", "-e", "foot.9iez", "-e", "slow=foot.naive", "-o", folder / "done.mcap"
    )
    assert done.code == 0, done.err
    return folder


def raw(folder: Path) -> Path:
    return folder / "raw" / "conf-3333-walk.csv"


# -- what is available ----------------------------------------------------------------------------


def test_formats_name_importers_and_exporters() -> None:
    document = marcha("formats", "--json").document
    assert {"mpu6050-serial", "mpu6050-packets", "table"} <= {f["name"] for f in document["importers"]}
    assert {"mcap", "csv", "parquet", "rrd"} <= {f["name"] for f in document["exporters"]}


def test_formats_for_a_person() -> None:
    out = marcha("formats").out
    assert "mpu6050-serial: " in out
    assert "topics" in out


def test_estimators_have_parameters_with_units_and_defaults() -> None:
    entries = {e["name"]: e for e in marcha("estimators", "--json").document["estimators"]}
    sigma = {p["name"]: p for p in entries["foot.9iez"]["parameters"]}["sigma_acc"]
    assert sigma["default"] == pytest.approx(0.35)
    assert sigma["unit"] == "m/s²"
    assert sigma["description"]


def test_estimators_for_a_person_take_a_line_each() -> None:
    out = marcha("estimators").out
    assert "foot.9iez" in out
    assert "short-rest" in out
    assert "magnetometer" in out
    names = [*available(), *available(CALIBRATIONS)]
    presets = {p for cls in available().values() for p in cls.presets}
    assert out.count("\n") < len(names) + 2 * len(presets) + 8


def test_a_named_estimator_is_described_in_full() -> None:
    out = marcha("estimators", "foot.9iez").out
    assert "foot.9iez: " in out
    assert "sigma_acc" in out
    assert "foot.naive" not in out


def test_an_unknown_estimator_cannot_be_described() -> None:
    done = marcha("estimators", "foot.none")
    assert done.code == 2
    assert "foot.9iez" in done.complaint


# -- simulate ---------------------------------------------------------------------------------------


def test_simulate_says_what_it_wrote(tmp_path: Path) -> None:
    document = marcha("simulate", "straight", "-o", tmp_path, "--set", "length_m=4", "--json").document
    assert {"scenario", "output", "files", "truth", "rows", "closed", "length_m"} <= document.keys()
    assert all(Path(f).is_file() for f in document["files"] + document["truth"])


def test_simulate_gives_the_same_bytes_for_the_same_seed(tmp_path: Path) -> None:
    for name in ("a", "b"):
        marcha("simulate", "still", "-o", tmp_path / name, "--seed", "7", "--set", "duration_s=3")
    one, other = (min((tmp_path / n).glob("*-007.csv")) for n in ("a", "b"))
    assert one.read_bytes() == other.read_bytes()


# -- convert ------------------------------------------------------------------------------------------


def test_convert_has_the_agreed_keys(folder: Path, tmp_path: Path) -> None:
    document = marcha("convert", raw(folder), "-o", tmp_path / "a.mcap", "--json").document
    assert document.keys() == {"output", "format", "channels", "report", "also_read"}
    assert document["channels"][0].keys() == CHANNEL
    report = document["report"]
    assert report.keys() == {"rows_read", "rows_kept", "rows_repaired", "rows_dropped", "findings"}
    assert all(f.keys() == {"kind", "count", "first_line", "detail"} for f in report["findings"])


def test_convert_prints_channels_and_findings(folder: Path, tmp_path: Path) -> None:
    out = marcha("convert", raw(folder), "-o", tmp_path / "a.mcap").out
    assert "/foot/imu1" in out
    assert "rate [Hz]" in out


def test_convert_takes_truth_as_options(folder: Path, tmp_path: Path) -> None:
    options = ("--set", "closed=true", "--truth", "length_m=22.1")
    shutil.copy(raw(folder), tmp_path / "conf-3333-alone.csv")
    marcha("convert", tmp_path / "conf-3333-alone.csv", "-o", tmp_path / "a.mcap", *options)
    assert mr.open(tmp_path / "a.mcap").metadata["truth"] == {"closed": "true", "length_m": "22.1"}


def test_convert_of_clipped_data_exits_3(tmp_path: Path) -> None:
    marcha(
        "simulate", "straight", "-o", tmp_path, "--set", "length_m=4", "--set", "config=0000", "--name", "c"
    )
    done = marcha("convert", tmp_path / "conf-0000-c.csv", "-o", tmp_path / "a.mcap", "--json")
    assert done.code == 3
    assert "clipped" in {f["kind"] for f in done.document["report"]["findings"]}


def test_strict_makes_a_repair_a_failure(folder: Path, tmp_path: Path) -> None:
    lines = raw(folder).read_text().splitlines(keepends=True)
    (tmp_path / "conf-3333-x.csv").write_text("".join([*lines[:40], "1,2,three\r\n", *lines[40:]]))
    done = marcha("convert", tmp_path / "conf-3333-x.csv", "-o", tmp_path / "a.mcap", "--strict")
    assert done.code == 1
    assert not (tmp_path / "a.mcap").exists()


@pytest.fixture
def logs(folder: Path, tmp_path: Path) -> Path:
    """A student's folder: two good logs, a page of notes, and a log that holds nothing."""
    shutil.copytree(folder / "raw", tmp_path / "logs")
    shutil.copy(raw(folder), tmp_path / "logs" / "conf-3333-second.csv")
    (tmp_path / "logs" / "notes.txt").write_text("walked round the block\n")
    return tmp_path / "logs"


def test_convert_a_folder_to_a_folder(logs: Path, tmp_path: Path) -> None:
    done = marcha("convert", logs, "-o", f"{tmp_path / 'out'}/", "--json")
    assert [Path(c["input"]).name for c in done.document["conversions"]] == [
        "conf-3333-second.csv",
        "conf-3333-walk.csv",
    ]
    assert [Path(s["input"]).name for s in done.document["skipped"]] == ["notes.txt"]
    assert {p.name for p in (tmp_path / "out").iterdir()} == {"conf-3333-second.mcap", "conf-3333-walk.mcap"}


def test_convert_many_goes_on_after_a_bad_file(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "empty.csv").write_bytes(b"")
    (tmp_path / "out").mkdir()
    done = marcha("convert", tmp_path / "empty.csv", raw(folder), "-o", tmp_path / "out", "--json")
    assert done.code == 1
    bad, good = done.document["conversions"]
    assert "empty" in bad["error"]
    assert bad["exit_code"] == 1
    assert Path(good["output"]).is_file()
    assert "empty.csv" in done.complaint


def test_convert_many_refuses_two_inputs_of_one_name(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    shutil.copy(raw(folder), tmp_path / "other")
    done = marcha("convert", raw(folder), tmp_path / "other" / raw(folder).name, "-o", f"{tmp_path}/out/")
    assert done.code == 2
    assert not (tmp_path / "out").exists()


def test_convert_a_folder_without_logs_fails(tmp_path: Path) -> None:
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / "notes.txt").write_text("nothing here\n")
    done = marcha("convert", tmp_path / "logs", "-o", f"{tmp_path}/out/")
    assert done.code == 1
    assert "no log of a known format" in done.complaint


# -- info and check ---------------------------------------------------------------------------------


def test_info_has_the_agreed_keys(folder: Path) -> None:
    document = marcha("info", folder / "walk.mcap", "--json").document
    assert {"path", "duration_s", "channels", "metadata", "attachments"} <= document.keys()
    assert document["channels"][0].keys() >= CHANNEL
    assert document["metadata"]["provenance"]["importer"] == "mpu6050-serial"


def test_info_is_aligned_and_has_units(folder: Path) -> None:
    lines = marcha("info", folder / "walk.mcap").out.splitlines()
    assert lines[1].split() == ["topic", "schema", "messages", "span", "[s]", "rate", "[Hz]"]
    assert lines[1].index("schema") == lines[2].index("sensor_msgs")


def test_check_of_a_sound_recording_finds_nothing(folder: Path) -> None:
    done = marcha("check", folder / "walk.mcap", "--json")
    assert (done.code, done.document["findings"]) == (0, [])


def test_check_of_a_cut_recording_says_the_loss(folder: Path, tmp_path: Path) -> None:
    data = (folder / "walk.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: len(data) // 2])
    done = marcha("check", tmp_path / "cut.mcap", "--json")
    assert done.code == 3
    assert done.document["findings"]


def test_check_finds_gaps_repeats_and_dead_sensors(tmp_path: Path) -> None:
    t_ns = [10**7 * k for k in range(300)]
    t_ns[150:] = [t + 2 * 10**9 for t in t_ns[150:]]
    t_ns[200] = t_ns[199]
    zero = {f"{s}_{a}": [0.0] * 300 for s in ("acc", "gyr") for a in "xyz"} | {"acc_z": [9.8] * 300}
    with mr.create(tmp_path / "a.mcap") as out:
        out.add_table("/imu", "sensor_msgs/msg/Imu", pl.DataFrame({"t_ns": t_ns, **zero}))
    done = marcha("check", tmp_path / "a.mcap", "--json")
    found = {f["kind"]: (f["count"], f["first_line"]) for f in done.document["findings"]}
    assert found == {"gap": (1, 151), "duplicate_time": (1, 201), "all_zero": (300, 1)}
    assert done.code == 3


# -- replay and evaluate ----------------------------------------------------------------------------


def test_replay_has_the_agreed_keys(folder: Path) -> None:
    document = marcha("replay", folder / "walk.mcap", "-e", "foot.9iez", "--json").document
    assert {"output", "runs"} <= document.keys()
    assert [r["input"] for r in document["runs"]] == ["/foot/imu1", "/foot/imu2"]
    run = document["runs"][0]
    assert {"estimator", "input", "samples", "loop_s", "outputs", "metrics"} <= run.keys()
    assert "closure_m" in run["metrics"]
    assert all(topic.startswith("/estimate/") for topic in run["outputs"])


def test_replay_takes_label_input_and_parameters(folder: Path) -> None:
    done = marcha(
        *("replay", folder / "walk.mcap", "-e", "mine=foot.9iez[sigma_acc=0.5]", "--input", "/foot/imu2"),
        *("-p", "sigma_gyr=0.02", "--json"),
    )
    (run,) = done.document["runs"]
    assert run["run"] == "mine_foot_imu2"
    assert (run["params"]["sigma_acc"], run["params"]["sigma_gyr"]) == (0.5, 0.02)


def test_replay_takes_a_preset_for_every_estimator(folder: Path) -> None:
    several = ("-e", "foot.9iez", "-e", "foot.naive", "--input", "/foot/imu2")
    done = marcha("replay", folder / "walk.mcap", *several, "-p", "preset=short-rest", "--json")
    assert [r["params"]["init_s"] for r in done.document["runs"]] == [0.3, 0.3]


def test_replay_names_the_alignment_of_its_errors(folder: Path) -> None:
    done = marcha("replay", folder / "walk.mcap", "-e", "foot.9iez", "--input", "/foot/imu1", "--json")
    (run,) = done.document["runs"]
    assert run["metrics"]["ate_rmse_m"] > 0
    assert run["alignment"] == "se3"


def test_what_holds_for_every_run_is_said_once(folder: Path) -> None:
    several = ("-e", "foot.9iez", "-e", "foot.naive", "-p", "init=fixed", "-p", "init_s=600")
    done = marcha("replay", folder / "walk.mcap", *several)
    assert done.code == 3
    assert [line.split(":")[0] for line in done.out.splitlines() if "no_rest" in line] in (
        ["/foot/imu1", "/foot/imu2"],
        ["/foot/imu1, /foot/imu2"],
    )


def test_a_wrong_input_lists_the_raw_channels_only(folder: Path) -> None:
    done = marcha("replay", folder / "done.mcap", "-e", "foot.9iez", "--input", "/nope")
    assert done.code == 2
    assert "/foot/imu1" in done.complaint
    assert "/estimate/" not in done.complaint


@pytest.mark.parametrize(
    "command",
    [
        ("replay", "-e", "foot.naive", "--input", "/foot/imu1"),
        ("annotate", "list"),
        ("export", "--to", "csv", "-o", "OUT"),
    ],
    ids=["replay", "annotate", "export"],
)
def test_every_reader_says_the_loss_of_a_cut_recording(
    folder: Path, tmp_path: Path, command: tuple[str, ...]
) -> None:
    data = (folder / "done.mcap").read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(data[: len(data) // 2])
    options = [str(tmp_path / "out") if c == "OUT" else c for c in command]
    groups = 2 if command[0] == "annotate" else 1
    done = marcha(*options[:groups], cut, *options[groups:])
    assert "warning" in done.err
    assert "truncated" in done.err


@pytest.mark.parametrize(("start", "end"), [("1", "3"), ("1s", "3000ms"), ("1000000000ns", "0.05m")])
def test_replay_of_a_part(folder: Path, start: str, end: str) -> None:
    part = ("--input", "/foot/imu1", "--from", start, "--to", end)
    (run,) = marcha("replay", folder / "walk.mcap", "-e", "foot.naive", *part, "--json").document["runs"]
    assert run["samples"] in (199, 200, 201)


def test_replay_compares_runs_in_columns(folder: Path) -> None:
    done = marcha("replay", folder / "walk.mcap", "-e", "foot.9iez", "--input", "/foot/imu1")
    assert "foot_9iez_foot_imu1" in done.out
    assert "closure_m" in done.out


def test_replay_writes_a_rerun_file(folder: Path, tmp_path: Path) -> None:
    rrd = tmp_path / "a.rrd"
    done = marcha("replay", folder / "walk.mcap", "-e", "foot.9iez", "--rrd", rrd, "--json")
    assert done.document["rrd"] == str(rrd)
    assert rrd.read_bytes()[:3] == b"RRF"


def test_evaluate_has_the_agreed_keys(folder: Path) -> None:
    document = marcha("evaluate", folder / "done.mcap", "--json").document
    assert len(document["runs"]) == 4
    run = next(r for r in document["runs"] if r["run"] == RUN)
    assert {"estimator", "metrics", "matched", "dropped", "alignment"} <= run.keys()
    assert run["matched"] > 0
    assert run["alignment"] == "se3"


def test_evaluate_prints_matched_dropped_and_alignment(folder: Path) -> None:
    out = marcha("evaluate", folder / "done.mcap", "--run", RUN).out
    assert all(word in out for word in ("matched", "dropped", "alignment", "se3", "ate_rmse_m"))


@pytest.mark.parametrize(
    ("bound", "code"),
    [
        (("--max", "ate_rmse_m=1000"), 0),
        (("--max", "ate_rmse_m=0"), 4),
        (("--min", "path_m=1"), 0),
        (("--min", "path_m=1e6"), 4),
        (("--max", "no_such_metric=1"), 2),
        (("--max", "ate_rmse_m"), 2),
        (("--max", "ate_rmse_m=low"), 2),
    ],
)
def test_evaluate_thresholds(folder: Path, bound: tuple[str, str], code: int) -> None:
    assert marcha("evaluate", folder / "done.mcap", "--run", RUN, *bound, "--json").code == code


def test_evaluate_of_a_raw_recording_says_what_to_do(folder: Path) -> None:
    done = marcha("evaluate", folder / "walk.mcap")
    assert done.code == 1
    assert "marcha replay" in done.complaint


# -- look and hand on -------------------------------------------------------------------------------


def test_view_writes_a_rerun_file(folder: Path, tmp_path: Path) -> None:
    done = marcha("view", folder / "done.mcap", "--rrd", tmp_path / "a.rrd", "--json")
    assert done.code == 0
    assert (tmp_path / "a.rrd").read_bytes()[:3] == b"RRF"


@pytest.mark.parametrize(
    ("to", "name"), [("mcap", "o.mcap"), ("csv", "o"), ("parquet", "o"), ("rrd", "o.rrd")]
)
def test_export(folder: Path, tmp_path: Path, to: str, name: str) -> None:
    document = marcha("export", folder / "done.mcap", "--to", to, "-o", tmp_path / name, "--json").document
    assert document["format"] == to
    assert document["files"]
    assert all(Path(f).is_file() for f in document["files"])


def test_export_of_a_part(folder: Path, tmp_path: Path) -> None:
    part = ("--topic", "/foot/imu1", "--start", "1s", "--end", "2s")
    assert marcha("export", folder / "done.mcap", "--to", "csv", "-o", tmp_path / "o", *part).code == 0
    assert pl.read_csv(tmp_path / "o" / "foot_imu1.csv").height in (99, 100, 101)
    assert not (tmp_path / "o" / "foot_imu2.csv").exists()


def test_annotate_add_then_list(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "a.mcap"
    what = ("--label", "turn", "--from", "1s", "--to", "2.5s", "--meta", "who=me")
    assert marcha("annotate", "add", folder / "walk.mcap", *what, "-o", out, "--json").document["added"] == 1
    (entry,) = marcha("annotate", "list", out, "--json").document["annotations"]
    assert (entry["onset"], entry["duration"], entry["trial_type"], entry["tier"]) == (
        1.0,
        1.5,
        "turn",
        "manual",
    )
    assert "turn" in marcha("annotate", "list", out).out


def test_annotate_in_place_keeps_everything(folder: Path, tmp_path: Path) -> None:
    copy = tmp_path / "a.mcap"
    shutil.copy(folder / "walk.mcap", copy)
    marcha("annotate", "add", copy, "--label", "a", "--from", "1s", "--in-place")
    marcha("annotate", "add", copy, "--label", "b", "--from", "2s", "--in-place")
    rec, before = mr.open(copy), mr.open(folder / "walk.mcap")
    assert rec.annotations["label"].to_list() == ["a", "b"]
    assert rec.table("/foot/imu1").equals(before.table("/foot/imu1"))
    assert rec.metadata == before.metadata
    assert marcha("annotate", "undo", copy, "--in-place").code == 0
    assert mr.open(copy).annotations["label"].to_list() == ["a"]
    assert [c["action"] for c in marcha("annotate", "log", copy, "--json").document["changes"]] == [
        "add",
        "add",
        "undo",
    ]


def test_annotate_import_of_what_export_wrote(folder: Path, tmp_path: Path) -> None:
    marcha("export", folder / "done.mcap", "--to", "csv", "-o", tmp_path / "csv")
    done = marcha(
        *(
            "annotate",
            "import",
            folder / "walk.mcap",
            tmp_path / "csv" / "events.tsv",
            "-o",
            tmp_path / "a.mcap",
        )
    )
    assert done.code == 0, done.err
    expected = mr.open(folder / "done.mcap").annotations.sort("tier", "start_ns")
    assert mr.open(tmp_path / "a.mcap").annotations.sort("tier", "start_ns").equals(expected)


def test_annotate_import_of_plain_bids(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "video.tsv").write_text("onset\tduration\ttrial_type\n0.5\t0.25\tfall\nn/a\t1\tx\n")
    done = marcha(
        "annotate", "import", folder / "walk.mcap", tmp_path / "video.tsv", "-o", tmp_path / "a.mcap"
    )
    assert done.code == 1
    assert "video.tsv: line 3: onset" in done.complaint
    (tmp_path / "video.tsv").write_text("onset\tduration\ttrial_type\n0.5\t0.25\tfall\n")
    marcha("annotate", "import", folder / "walk.mcap", tmp_path / "video.tsv", "-o", tmp_path / "a.mcap")
    rec = mr.open(tmp_path / "a.mcap")
    assert rec.annotations["tier"].to_list() == ["video"]
    assert rec.annotations["start_ns"][0] - rec.start_ns == 500_000_000


def test_an_annotation_outside_of_the_recording_is_said(folder: Path, tmp_path: Path) -> None:
    late = ("--label", "x", "--from", "1000", "-o", tmp_path / "late.mcap")
    done = marcha("annotate", "add", folder / "walk.mcap", *late)
    assert done.code == 1
    assert "outside" in done.complaint
    assert not (tmp_path / "late.mcap").exists()


def test_annotate_needs_one_place_to_write_to(folder: Path, tmp_path: Path) -> None:
    what = ("annotate", "add", folder / "walk.mcap", "--label", "x", "--from", "1s")
    assert marcha(*what).code == 2
    assert marcha(*what, "-o", tmp_path / "a.mcap", "--in-place").code == 2


STUDY = """
title = "one filter"
[recordings]
files = ["conf-*.csv"]
[[estimators]]
name = "foot.naive"
[[metrics]]
column = "path_m"
"""


def test_study_of_raw_logs(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "study.toml").write_text(STUDY)
    arguments = (
        "study",
        tmp_path / "study.toml",
        "--data",
        folder / "raw",
        "-o",
        tmp_path / "out",
        "--workers",
        "1",
    )
    done = marcha(*arguments, "--json")
    assert done.code == 0, done.err
    assert {"output", "cells", "files"} <= done.document.keys()
    assert pl.read_parquet(tmp_path / "out" / "results.parquet").height == done.document["cells"] == 2
    assert (tmp_path / "out" / "report.html").is_file()


def test_study_with_an_unknown_preset(tmp_path: Path) -> None:
    done = marcha("study", "no-such-preset", "-o", tmp_path / "s", "--json")
    assert done.code == 2
    assert "no-such-preset" in done.document["error"]
