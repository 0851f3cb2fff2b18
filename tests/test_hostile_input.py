"""Files from strangers: each of these once ended in a traceback, endless work or a wrong word."""

from __future__ import annotations

import io
import json
import os
import re
import sys
import zipfile
from pathlib import Path

import polars as pl
import pytest
from marcha.cli import main
from marcha.ingest.contract import ReportBuilder
from marcha.ingest.timestamps import TimestampRepair
from marcha.recording import MarchaError
from marcha.recording.errors import MOST_CHARACTERS, Finding

from .cli_helpers import Ran, marcha, marcha_process

HEADER = "Time (s),Gyroscope X (deg/s),Gyroscope Y (deg/s),Gyroscope Z (deg/s),Accelerometer X (g),"
HEADER += "Accelerometer Y (g),Accelerometer Z (g)\n"
MAP = """
[time]
column = "t"
unit = "ns"
[[topic]]
name = "/foot/imu1"
schema = "sensor_msgs/msg/Imu"
frame = "imu1"
units = { acc = "m/s²" }
columns = { acc_x = "x", acc_y = "y", acc_z = "z" }
"""


def xio(times: list[object], header: str = HEADER) -> str:
    return header + "".join(f"{t},1,2,{k % 7},0,0,1\n" for k, t in enumerate(times))


GOOD = xio([k / 100 for k in range(300)])


def convert(folder: Path, text: str, *more: object, name: str = "log.csv") -> Ran:
    (folder / name).write_text(text)
    return marcha("convert", folder / name, "-o", folder / "out.mcap", "--json", *more)


def mapped(folder: Path, mapping: str | bytes, text: str | None = None) -> Ran:
    (folder / "map.toml").write_bytes(mapping if isinstance(mapping, bytes) else mapping.encode())
    text = text or "t,x,y,z\n" + "".join(f"{k * 10**7},0.{k % 7},1,9.8\n" for k in range(300))
    return convert(folder, text, "--map", folder / "map.toml")


# -- times and cells ----------------------------------------------------------------------------------


@pytest.mark.parametrize("time", ["1e30", "-1e25", "9.3e9"])
def test_a_time_beyond_any_clock_is_a_bad_row(tmp_path: Path, time: str) -> None:
    done = convert(tmp_path, xio([*(k / 100 for k in range(150)), time, *(k / 100 for k in range(150, 300))]))
    assert done.code == 3
    assert {f["kind"]: f["count"] for f in done.document["report"]["findings"]}["bad_row"] == 1
    assert done.document["channels"][0]["count"] == 300


def test_a_time_of_a_table_whose_nanoseconds_leave_decimals_is_a_bad_row(tmp_path: Path) -> None:
    rows = "".join(f"{'9' * 28 if k == 7 else k * 10},0.{k % 7},1,9.8\n" for k in range(300))
    done = mapped(tmp_path, MAP.replace('"ns"', '"ms"'), "t,x,y,z\n" + rows)
    assert done.code == 3
    (row,) = [f for f in done.document["report"]["findings"] if f["kind"] == "bad_row"]
    assert (row["count"], row["first_line"]) == (1, 9)
    assert "beyond any clock" in row["detail"]


def test_a_row_without_a_time_is_a_bad_row() -> None:
    report = ReportBuilder()
    repair = TimestampRepair(report, tick_ns=1)
    frame = pl.DataFrame(
        {"t": [0, 10, None, 20, 10**19 % 2**63], "line": [1, 2, 3, 4, 5], "x": [1.0, 2.0, 3.0, 4.0, 5.0]}
    )
    assert repair.feed(frame, final=True)["t_ns"].to_list()[:3] == [0, 10, 20]
    assert report.dropped >= 1


def test_a_log_of_nothing_but_such_times_is_one_line(tmp_path: Path) -> None:
    assert convert(tmp_path, xio([1e30 + k for k in range(300)])).code == 1


def test_counters_at_the_end_of_64_bits_do_not_wrap(tmp_path: Path) -> None:
    rows = [f"{2**63 - 1 - k if k < 150 else -(2**63) + k},0.{k % 7},1,9.8\n" for k in range(300)]
    done = mapped(tmp_path, MAP, "t,x,y,z\n" + "".join(rows))
    assert done.code == 1
    assert "has a time and a value" in done.complaint


@pytest.mark.parametrize(
    ("seconds", "said"),
    [
        (-150_000_000, "1970 to 2038"),
        (2_200_000_000, "1970 to 2038"),
        (7_000_000_000, "beyond any clock (ns)"),
    ],
)
def test_times_that_no_recording_holds_are_one_line_with_a_remedy(
    tmp_path: Path, seconds: int, said: str
) -> None:
    rows = "".join(f"{seconds * 10**9 + k * 10**7},0.{k % 7},1,9.8\n" for k in range(300))
    done = mapped(tmp_path, MAP, "t,x,y,z\n" + rows)
    assert done.code == 1
    assert said in done.complaint
    assert re.search("add a constant to the times|does the mapping fit", done.complaint)


def test_a_header_whose_time_has_no_unit_is_one_line(tmp_path: Path) -> None:
    done = convert(tmp_path, GOOD.replace("Time (s)", "Time ("))
    assert done.code == 1
    assert "no column is a time" in done.complaint


def test_a_cell_longer_than_any_is_one_short_line(tmp_path: Path) -> None:
    done = mapped(tmp_path, MAP, 't,x,y,z\n"' + "1" * 200_000 + '",1,2,3\n0,1,2,3\n')
    assert done.code == 1
    assert "field larger" in done.complaint
    assert len(done.complaint) < MOST_CHARACTERS


# -- TOML ------------------------------------------------------------------------------------------------

ENDLESS = "a = " + "1" * 5000 + "\n"


def test_a_mapping_with_a_number_of_5000_digits_is_one_line(tmp_path: Path) -> None:
    assert "not TOML" in mapped(tmp_path, ENDLESS + MAP).complaint


def test_a_truth_with_a_number_of_5000_digits_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "log.truth.toml").write_text(ENDLESS)
    assert "not TOML" in convert(tmp_path, GOOD).complaint


@pytest.mark.parametrize("text", [ENDLESS.encode(), b"\xff\xfe = 1"])
def test_a_study_that_is_no_toml_is_wrong_usage(tmp_path: Path, text: bytes) -> None:
    (tmp_path / "study.toml").write_bytes(text)
    done = marcha("study", tmp_path / "study.toml", "-o", tmp_path / "out")
    assert done.code == 2
    assert "not TOML" in done.complaint


@pytest.mark.parametrize("encoding", ["punycode", "undefined", "utf-16", "hex", "no-such"])
def test_an_encoding_that_does_not_fit_is_one_line(tmp_path: Path, encoding: str) -> None:
    done = mapped(tmp_path, f'[layout]\nencoding = "{encoding}"' + MAP)
    assert done.code == 1
    assert f"layout.encoding {encoding}" in done.complaint


# -- files that are none, names that are none ---------------------------------------------------------------


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no named pipes")
@pytest.mark.parametrize(
    "command",
    [
        ("convert", "PIPE", "-o", "out.mcap"),
        ("convert", "log.csv", "--map", "PIPE", "-o", "out.mcap"),
        ("info", "PIPE"),
        ("check", "/dev/zero"),
    ],
    ids=lambda c: " ".join(c[:3]),
)
def test_pipes_and_devices_are_refused_not_read(tmp_path: Path, command: tuple[str, ...]) -> None:
    os.mkfifo(tmp_path / "PIPE")
    (tmp_path / "log.csv").write_text(GOOD)
    done = marcha_process(*command, cwd=tmp_path)
    assert done.code == 1
    assert "pipe, socket or device" in done.complaint


@pytest.mark.parametrize(
    "command", [("convert", "LOGS", "-o", "OUT/"), ("study", "STUDY", "--data", "LOGS", "-o", "OUT")]
)
def test_a_folder_that_may_not_be_listed_is_named_not_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: tuple[str, ...]
) -> None:
    real = os.scandir

    def scandir(path: str | Path) -> object:
        if str(path).endswith("secret"):
            raise PermissionError(13, "Permission denied", str(path))
        return real(path)

    (tmp_path / "logs" / "secret").mkdir(parents=True)
    (tmp_path / "logs" / "walk.csv").write_text(GOOD)
    (tmp_path / "study.toml").write_text(
        '[recordings]\nfiles = ["*.csv"]\n[[estimators]]\nname = "foot.naive"\n'
    )
    monkeypatch.setattr(os, "scandir", scandir)
    places = {"LOGS": tmp_path / "logs", "STUDY": tmp_path / "study.toml", "OUT": tmp_path / "out"}
    done = marcha(*(places.get(a, a if a != "OUT/" else f"{tmp_path / 'out'}/") for a in command))
    assert done.code == 1
    assert done.complaint == f"{tmp_path / 'logs' / 'secret'}: cannot be read: Permission denied"
    assert not (tmp_path / "out").exists()


@pytest.mark.skipif(os.name != "posix", reason="names of files are Unicode here")
def test_names_that_are_no_utf8_are_kept_as_escapes(tmp_path: Path) -> None:
    log, out = (os.fsdecode(os.fsencode(tmp_path) + b"/n\xff\xfe" + end) for end in (b".csv", b".mcap"))
    Path(log).write_text(GOOD)
    done = marcha("convert", log, "-o", out, "--set", "keep_source=true", "--json")
    assert done.code == 3  # its sensors stand still
    assert "\\udcff" in done.document["output"]
    document = marcha("info", out, "--json").document
    assert "\\udcff" in document["metadata"]["provenance"]["given"]
    assert [a["name"] for a in document["attachments"]] == ["source/n\\udcff\\udcfe.csv"]


def test_a_recording_is_named_so(tmp_path: Path) -> None:
    (tmp_path / "log.csv").write_text(GOOD)
    done = marcha("convert", tmp_path / "log.csv", "-o", tmp_path / "y.txt")
    assert done.code == 2
    assert "y.mcap" in done.complaint
    assert not (tmp_path / "y.txt").exists()


# -- archives ------------------------------------------------------------------------------------------------


def archive(path: Path, count: int, packing: int = zipfile.ZIP_DEFLATED) -> Path:
    with zipfile.ZipFile(path, "w", packing) as file:
        for k in range(count):
            file.writestr(f"walk{k}.csv", xio([i / 100 for i in range(300 + k)]))
        file.writestr("notes.txt", "nothing")
    return path


@pytest.mark.parametrize("packing", [zipfile.ZIP_DEFLATED, zipfile.ZIP_LZMA, zipfile.ZIP_BZIP2])
def test_a_damaged_archive_is_one_line(tmp_path: Path, packing: int) -> None:
    data = bytearray(archive(tmp_path / "a.zip", 1, packing).read_bytes())
    refused = 0
    for at in range(60, 700, 40):
        damaged = data.copy()
        damaged[at : at + 4] = b"\xff\x00\xff\x00"
        (tmp_path / "b.zip").write_bytes(damaged)
        done = marcha("convert", tmp_path / "b.zip", "-o", tmp_path / "out.mcap", "--force", "--json")
        assert done.code in (1, 3)
        if done.code == 1:
            refused += 1
            assert "cannot be unpacked" in done.complaint
        else:  # a date of a member, for example
            assert done.document["channels"][0]["count"] == 300
    assert refused > 5


def test_an_archive_of_logs_becomes_as_many_recordings_as_a_folder(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    done = marcha("convert", archive(tmp_path / "a.zip", 3), "-o", tmp_path / "out", "--json")
    assert done.code == 3
    assert [c["input"] for c in done.document["conversions"]] == [
        str(tmp_path / "a.zip" / f"walk{k}.csv") for k in range(3)
    ]
    assert [s["input"] for s in done.document["skipped"]] == [str(tmp_path / "a.zip" / "notes.txt")]
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == [f"walk{k}.mcap" for k in range(3)]


def test_an_archive_of_logs_for_one_recording_names_the_remedy(tmp_path: Path) -> None:
    done = marcha("convert", archive(tmp_path / "a.zip", 3), "-o", tmp_path / "out.mcap")
    assert done.code == 1
    assert "-o FOLDER/" in done.complaint


@pytest.mark.parametrize("several", [False, True])
def test_an_error_inside_an_archive_names_archive_and_member(tmp_path: Path, several: bool) -> None:
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as file:
        file.writestr("day1/walk.csv", xio([1e30 + k for k in range(300)]))
    output = (tmp_path / "out", "--json") if several else (tmp_path / "out.mcap",)
    if several:
        (tmp_path / "out").mkdir()
    done = marcha("convert", tmp_path / "a.zip", "-o", *output)
    assert done.code == 1
    assert done.complaint.startswith(f"{tmp_path / 'a.zip' / 'day1' / 'walk.csv'}: no row of numbers")


def test_a_file_that_was_read_beside_a_log_is_not_called_skipped(tmp_path: Path) -> None:
    logs = tmp_path / "logs"
    logs.mkdir()
    names = ("6015-1:scaledAccelX", "6015-1:scaledAccelY", "6015-1:scaledAccelZ")
    rates = ("6015-1:scaledGyroX", "6015-1:scaledGyroY", "6015-1:scaledGyroZ")
    rows = "".join(f"{1.5e9 + k / 100:.2f},0,0.{k % 5},-1,0,0,{k % 7}\n" for k in range(400))
    (logs / "walk.csv").write_text(",".join(("DATA_START\nTime", *names, *rates)) + "\n" + rows)
    steps = "".join(f"{k * 100},{1.5e9 + k},{k},0\n" for k in range(4))
    (logs / "walk_feet.csv").write_text("strideIndex,timestamp,gcpX,gcpY\n" + steps)
    (logs / "notes.txt").write_text("nothing")
    done = marcha("convert", logs, "-o", f"{tmp_path / 'out'}/", "--json")
    assert [c["also_read"] for c in done.document["conversions"]] == [[str(logs / "walk_feet.csv")]]
    assert [s["input"] for s in done.document["skipped"]] == [str(logs / "notes.txt")]
    said = marcha("convert", logs, "-o", f"{tmp_path / 'again'}/").out
    assert "1 of 1 logs converted" in said
    assert "1 other files skipped" in said


# -- what reaches the terminal -----------------------------------------------------------------------------


def test_an_error_is_one_printable_line_of_bounded_length() -> None:
    said = str(MarchaError("walk.csv:\n\x1b[31mred\x07 " + "x" * 9999 + " \u202eremedy"))
    assert said.startswith("walk.csv: \\x1b[31mred\\x07 xxx")
    assert said.endswith("\\u202eremedy")
    assert len(said) < 1.2 * MOST_CHARACTERS
    assert Finding("bad_row", 1, 1, "a\x1b[2Jb").detail == "a\\x1b[2Jb"


def test_control_characters_of_a_file_do_not_reach_the_terminal(tmp_path: Path) -> None:
    header = HEADER.replace("(g)\n", "(g),\x1b]0;x\n")
    (tmp_path / "log.csv").write_text(
        GOOD.replace(HEADER, f"{header}\x1b[31mred\x07,1\n").replace(",1\n", ",1,0\n")
    )
    done = marcha("convert", tmp_path / "log.csv", "-o", tmp_path / "out.mcap")
    assert done.code == 3
    assert "bad_row" in done.out
    assert "\\x1b" in done.out
    assert "\x1b" not in done.out + done.err
    assert "\x07" not in done.out + done.err


@pytest.mark.parametrize("encoding", ["ascii", "latin-1"])
def test_a_terminal_of_another_encoding_gets_escapes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, encoding: str
) -> None:
    (tmp_path / "Füße→.csv").write_text(GOOD)
    said = {}
    for more in ((), ("--json",)):
        monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(io.BytesIO(), encoding=encoding))
        assert main(
            ["convert", str(tmp_path / "Füße→.csv"), "-o", str(tmp_path / "→.mcap"), "--force", *more]
        ) in (0, 3)
        sys.stdout.flush()
        said[more] = sys.stdout.buffer.getvalue().decode(encoding)  # type: ignore[attr-defined]
    assert "\\u2192.mcap" in said[()]
    assert json.loads(said[("--json",)])["output"] == str(tmp_path / "→.mcap")


def test_an_argument_in_another_encoding_is_one_line(tmp_path: Path) -> None:
    convert(tmp_path, GOOD)
    label = ("--label", os.fsdecode(b"\xe9"), "--from", "0.1")
    done = marcha("annotate", "add", tmp_path / "out.mcap", *label, "-o", tmp_path / "b.mcap")
    assert done.code == 2
    assert "no UTF-8" in done.complaint
    assert not (tmp_path / "b.mcap").exists()


def test_a_finding_is_whole_in_a_pipe(tmp_path: Path) -> None:
    names = ",".join(f"Unknown column {k}" for k in range(40))
    (tmp_path / "log.csv").write_text(
        GOOD.replace("(g)\n", f"(g),{names}\n").replace(",1\n", ",1" + 40 * ",0" + "\n")
    )
    done = marcha("convert", tmp_path / "log.csv", "-o", tmp_path / "out.mcap")
    assert "Unknown column 39: not imported" in done.out


def test_check_does_not_call_a_clipped_log_flawless(tmp_path: Path) -> None:
    convert(tmp_path, GOOD)
    done = marcha("check", tmp_path / "out.mcap")
    assert done.code == 3
    assert "nothing is wrong" not in done.out
    assert "the raw log was not" in done.out
