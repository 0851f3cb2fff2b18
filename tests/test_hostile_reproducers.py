"""What broke in the hands of others has a test each: ``reproducers.md`` is the table, some of them are here."""

from __future__ import annotations

import ast
import contextlib
import json
import os
import re
import signal
import struct
import subprocess
import sys
import warnings
import zipfile
from pathlib import Path

import marcha.recording as mr
import numpy as np
import polars as pl
import pytest
from marcha import ingest
from marcha.recording import MarchaError
from marcha.recording.check import check
from marcha.recording.definitions import full_text
from mcap.opcode import Opcode

from .cli_helpers import marcha
from .conftest import ROOT
from .contracts.exporter import example
from .fuzz import mcap
from .kills import gone, living
from .test_hostile_recordings import foreign

TABLE = ROOT / "tests" / "reproducers.md"


def test_every_defect_of_the_table_has_its_test() -> None:
    pairs = re.findall(r"^\| (.+) \| `([\w/]+\.py)::([\w.]+)` \|$", TABLE.read_text("utf-8"), re.MULTILINE)
    assert len(pairs) > 50
    tests: dict[str, set[str]] = {}
    for defect, path, name in pairs:
        if path not in tests:
            tree = ast.parse((ROOT / "tests" / path).read_text(encoding="utf-8"))
            tests[path] = {n.name for n in ast.walk(tree) if isinstance(n, ast.FunctionDef)}
        assert name.rpartition(".")[2] in tests[path], defect


def test_a_stored_zip_of_two_logs_is_two_recordings(tmp_path: Path) -> None:
    from .test_ingest_importers import TestMpu6050Serial

    (tmp_path / "one").mkdir()
    data = TestMpu6050Serial().sample(tmp_path / "one").read_bytes()
    with zipfile.ZipFile(tmp_path / "two.zip", "w", zipfile.ZIP_STORED) as archive:
        for k in (1, 2):
            archive.writestr(f"conf-3333-walk{k}.csv", data[: len(data) // k].rpartition(b"\n")[0] + b"\n")
    done = marcha("convert", tmp_path / "two.zip", "-o", tmp_path / "x.mcap")
    assert done.code == 1
    assert "-o FOLDER/" in done.complaint
    done = marcha("convert", tmp_path / "two.zip", "-o", f"{tmp_path / 'out'}/", "--json")
    assert [c["input"] for c in done.document["conversions"]] == [
        str(tmp_path / "two.zip" / f"conf-3333-walk{k}.csv") for k in (1, 2)
    ]
    one, two = (mr.open(tmp_path / "out" / f"conf-3333-walk{k}.mcap") for k in (1, 2))
    assert one.channels["/foot/imu1"].count > 1.5 * two.channels["/foot/imu1"].count > 0


@pytest.mark.parametrize("number", [2**31, 2**63 - 1, 2**64 - 1], ids=hex)
def test_lengths_and_offsets_of_any_size_are_findings_or_one_line(tmp_path: Path, number: int) -> None:
    sound = mcap.records(example(tmp_path / "sound.mcap", 60).read_bytes())
    damaged = tmp_path / "damaged.mcap"
    kinds = {part.opcode for part in sound}
    assert {Opcode.CHUNK, Opcode.CHUNK_INDEX, Opcode.SUMMARY_OFFSET, Opcode.FOOTER} <= kinds
    for kind in sorted(kinds):
        which = next(k for k, part in enumerate(sound) if part.opcode == kind)
        places = [None, *range(0, min(48, len(sound[which].body) - 8), 8)]
        for place in places:
            parts = list(sound)
            if place is None:
                parts[which] = mcap.Record(kind, sound[which].body, number)
            else:
                body = bytearray(sound[which].body)
                body[place : place + 8] = struct.pack("<Q", number)
                parts[which] = mcap.Record(kind, bytes(body))
            damaged.write_bytes(mcap.whole(parts))
            with contextlib.suppress(MarchaError), mr.open(damaged) as rec:
                check(rec)
                for topic, channel in rec.channels.items():
                    if channel.columns:
                        assert rec.table(topic).height <= 200


@pytest.mark.parametrize("text", ["abc", "", "nan", "-inf", "1e999", "[]"])
def test_texts_where_numbers_are_expected_do_not_stop_evaluate(tmp_path: Path, text: str) -> None:
    parts = mcap.records(example(tmp_path / "sound.mcap", 60).read_bytes())
    for k, part in enumerate(parts):
        if part.opcode == Opcode.METADATA:
            n = int.from_bytes(part.body[:4], "little")
            pairs = mcap.texts(part.body[4 + n + 4 :])
            kept = {b"estimator", b"input", b"outputs"}
            changed = [
                v if key in kept else text.encode() for key, v in zip(pairs[::2], pairs[1::2], strict=True)
            ]
            body = b"".join(
                struct.pack("<I", len(t)) + t for pair in zip(pairs[::2], changed, strict=True) for t in pair
            )
            parts[k] = mcap.Record(part.opcode, part.body[: 4 + n] + struct.pack("<I", len(body)) + body)
    summary = next(k for k, part in enumerate(parts) if part.opcode == Opcode.DATA_END)
    footer = mcap.Record(Opcode.FOOTER, bytes(20))
    (tmp_path / "odd.mcap").write_bytes(mcap.whole([*parts[: summary + 1], footer]))
    for more in ((), ("--json",)):
        assert marcha("evaluate", tmp_path / "odd.mcap", *more).code in (0, 1, 3)


def test_messages_shorter_than_their_type_are_findings(tmp_path: Path) -> None:
    with foreign(tmp_path / "a.mcap", "float64 x\nfloat64 y\n", bytes(9), times=tuple(range(1, 9))) as rec:
        for _ in "ab":
            with pytest.raises(MarchaError, match="cannot be read"):
                rec.table("/x")
        assert "unreadable_channel" in {f.kind for f in check(rec)}


SENSORCONNECT = (
    "DATA_START\nTime,6015-1:scaledAccelX,6015-1:scaledAccelY,6015-1:scaledAccelZ,"
    "6015-1:scaledGyroX,6015-1:scaledGyroY,6015-1:scaledGyroZ\n"
)


@pytest.mark.parametrize("time", ["1e30", "-1e25", "99999999999.0", "1e308"])
def test_a_time_beyond_any_clock_costs_its_row(tmp_path: Path, time: str) -> None:
    rows = [f"{1.5e9 + k / 100:.2f},0,0.{k % 5},-1,0,0,{k % 7}\n" for k in range(200)]
    rows[100] = rows[100].replace("1500000001.00", time)
    (tmp_path / "walk.csv").write_text(SENSORCONNECT + "".join(rows))
    report = ingest.convert(tmp_path / "walk.csv", tmp_path / "out.mcap").report
    assert (report.rows_kept, report.rows_dropped) == (199, 1)


def test_a_recording_with_a_text_channel_is_viewed_and_exported(tmp_path: Path) -> None:
    text = b"hello\x1b[31m"
    payload = struct.pack("<I", len(text) + 1) + text + b"\0"
    foreign(tmp_path / "a.mcap", "string data\n", payload, schema="std_msgs/msg/String").close()
    assert marcha("view", tmp_path / "a.mcap", "--rrd", tmp_path / "a.rrd").code == 0
    assert marcha("export", tmp_path / "a.mcap", "--to", "rrd", "-o", tmp_path / "b.rrd").code == 0
    assert (tmp_path / "a.rrd").stat().st_size > 0
    assert (tmp_path / "b.rrd").stat().st_size > 0


MARKERS = "marcha_msgs/msg/OpticalMarkers"


def test_markers_without_names_and_facts_that_are_no_numbers_are_drawn(tmp_path: Path) -> None:
    """Rerun keeps the first type of a name for the whole process: the text came after the number."""
    from marcha.viz import write_rrd

    payload = struct.pack("<iII4sIII", 0, 1, 1, b"\0", 0, 0, 0)
    with foreign(tmp_path / "a.mcap", full_text(MARKERS), payload, schema=MARKERS) as rec:
        assert rec.channels["/x"].columns == ()
        write_rrd(rec, tmp_path / "a.rrd")
    for k, length in enumerate(("22.1", "twenty")):
        with mr.create(tmp_path / f"{k}.mcap") as out:
            out.add_table(
                "/x", "sensor_msgs/msg/Temperature", pl.DataFrame({"t_ns": [1], "temperature_c": [20.0]})
            )
            out.add_metadata("subject", {"length_m": length, "": "x"})
        with warnings.catch_warnings(), mr.open(tmp_path / f"{k}.mcap") as rec:
            warnings.simplefilter("error")
            write_rrd(rec, tmp_path / f"{k}.rrd")


def imu_with_references(path: Path, references: tuple[str, ...]) -> Path:
    t_ns = np.arange(500, dtype=np.int64) * 10**7 + 1
    table = pl.DataFrame(
        {"t_ns": t_ns, **{f"{s}_{a}": np.sin(t_ns / 1e8) for s in ("acc", "gyr") for a in "xyz"}}
    )
    zero = {f"pos_{a}": np.zeros(500) for a in "xyz"}
    with mr.create(path) as out:
        out.add_table("/foot/imu1", "sensor_msgs/msg/Imu", table)
        for topic in references:
            out.add_table(topic, "geometry_msgs/msg/PointStamped", pl.DataFrame({"t_ns": t_ns, **zero}))
    return path


def test_a_replay_is_kept_where_several_references_fit(tmp_path: Path) -> None:
    rec = imu_with_references(tmp_path / "a.mcap", ("/reference/a/position", "/reference/b/position"))
    done = marcha("replay", rec, "-e", "foot.naive", "-o", tmp_path / "b.mcap")
    assert done.code in (0, 3)
    assert "name one (--reference)" in done.err
    said = marcha("evaluate", tmp_path / "b.mcap")
    assert said.code == 2
    assert "name one (--reference)" in said.complaint


def test_json_holds_no_sign_that_turns_the_direction_of_writing(tmp_path: Path) -> None:
    rec = imu_with_references(tmp_path / "a.mcap", ())
    marked = tmp_path / "b.mcap"
    assert marcha("annotate", "add", rec, "--label", "\u202ex\x9bé", "--from", "1", "-o", marked).code == 0
    done = marcha("annotate", "list", marked, "--json")
    assert done.out.rstrip("\n").isprintable()
    assert "\u202ex\x9bé" in json.dumps(done.document, ensure_ascii=False)


def test_every_package_says_that_it_is_typed() -> None:
    packages = {p.parent for p in ROOT.glob("*/__init__.py")} - {ROOT / "tests", ROOT / "benchmarks"}
    assert len(packages) >= 8
    assert [p.name for p in sorted(packages) if not (p / "py.typed").is_file()] == []


WORKERS = """
import os, time
from marcha.study.executors import Executor

def wait(task):
    os.write(1, b"begun\\n")  # one write: two workers share the pipe, and print may write the end of the line by itself
    time.sleep(60)

if __name__ == "__main__":
    with Executor(2) as executor:
        dict(executor.run(wait, [1, 2]))
"""


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="asks /proc which processes live")
def test_workers_of_a_killed_study_end(tmp_path: Path) -> None:
    (tmp_path / "run.py").write_text(WORKERS)
    process = subprocess.Popen(
        [sys.executable, tmp_path / "run.py"], stdout=subprocess.PIPE, start_new_session=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == b"begun\n"
    assert len(living(process.pid)) >= 2
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert gone(process.pid, 10.0), living(process.pid)
    process.stdout.close()
