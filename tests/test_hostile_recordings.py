"""Recordings and archives from strangers: what the fuzzer and others found, each as a test."""

from __future__ import annotations

import io
import json
import os
import resource
import signal
import stat
import struct
import subprocess
import sys
import time
import zipfile
from pathlib import Path

import marcha.recording as mr
import numpy as np
import polars as pl
import pytest
from marcha.ingest import convert
from marcha.ingest.batch import logs
from marcha.recording import MarchaError
from marcha.recording.check import check
from marcha.study.plan import find_sources
from marcha.study.study import write_csv
from mcap.opcode import Opcode
from mcap.writer import CompressionType, Writer

from .cli_helpers import marcha
from .contracts.exporter import example
from .fuzz import mcap
from .test_hostile_input import GOOD

IMU = "sensor_msgs/msg/Imu"


@pytest.fixture
def sound(tmp_path: Path) -> Path:
    return example(tmp_path / "sound.mcap", 60)


def foreign(
    path: Path, text: str, payload: bytes, times: tuple[int, ...] = (1, 2), **more: object
) -> mr.Recording:
    """Write a recording of another program: one channel of the given type, the same message at each time."""
    out = io.BytesIO()
    writer = Writer(out, compression=CompressionType.NONE, use_chunking=bool(more.get("chunks", True)))
    writer.start("ros2", "another")
    name = str(more.get("schema", "other_msgs/msg/Thing"))
    schema = writer.register_schema(name, "ros2msg", text.encode())
    about = {str(k): str(v) for k, v in dict(more.get("about", {})).items()}  # type: ignore[call-overload]
    channel = writer.register_channel("/x", "cdr", schema, about)
    for t in times:
        writer.add_message(channel, t, b"\x00\x01\x00\x00" + payload, t)
    writer.finish()
    path.write_bytes(out.getvalue())
    return mr.open(path)


@pytest.mark.parametrize("said", ["null", "1", '["acc_x"]', '["no_such"]', "[" * 3000, '["acc_x","acc_x"]'])
def test_columns_that_another_program_declares_are_not_believed(sound: Path, said: str) -> None:
    parts = mcap.records(sound.read_bytes())
    for part in parts:
        if part.opcode == Opcode.CHANNEL and b"/foot/imu1" in part.body:
            head = part.body[:4] + mcap._s("/foot/imu1") + mcap._s("cdr")
            part.body = head + mcap._m({"columns": said, "frame_id": "imu1"})
    sound.write_bytes(mcap.whole(mcap._without_summary(parts)))
    with mr.open(sound) as rec:
        assert rec.channels["/foot/imu1"].columns == ("acc_x", "acc_y", "acc_z", "gyr_x", "gyr_y", "gyr_z")


def test_an_empty_channel_has_the_columns_that_its_type_needs(tmp_path: Path) -> None:
    from marcha.recording.definitions import full_text

    rec = foreign(
        tmp_path / "a.mcap",
        full_text("sensor_msgs/msg/NavSatFix"),
        b"",
        (),
        schema="sensor_msgs/msg/NavSatFix",
    )
    assert {"lat_deg", "lon_deg"} <= set(rec.table("/x").columns)


def test_a_definition_that_names_a_field_twice_is_a_finding(tmp_path: Path) -> None:
    with foreign(tmp_path / "a.mcap", "float64 x\nfloat64 x\n", bytes(16)) as rec:
        assert rec.channels["/x"].columns == ()
        assert "unreadable_channel" in {f.kind for f in rec.findings}


@pytest.mark.parametrize("chunks", [True, False])
def test_a_time_that_no_integer_holds_is_a_finding_not_a_negative_one(tmp_path: Path, chunks: bool) -> None:
    with foreign(tmp_path / "a.mcap", "float64 x\n", bytes(8), (5, 2**63 + 5), chunks=chunks) as rec:
        table = rec.table("/x")
        assert (table["t_ns"] >= 0).all()
        assert {f.kind for f in check(rec)} & {"bad_chunk", "bad_record"}


def test_a_message_lost_in_a_file_without_chunks_is_found(tmp_path: Path) -> None:
    foreign(tmp_path / "a.mcap", "float64 x\n", bytes(8), tuple(range(1, 20)), chunks=False).close()
    parts = mcap.records((tmp_path / "a.mcap").read_bytes())
    parts.pop(next(k for k, p in enumerate(parts) if p.opcode == Opcode.MESSAGE))
    lost = 9 + 22 + 12
    for part in parts:
        if part.opcode == Opcode.FOOTER:
            start, offsets, _ = struct.unpack("<QQI", part.body)
            part.body = struct.pack("<QQI", start - lost, offsets - lost if offsets else 0, 0)
    (tmp_path / "a.mcap").write_bytes(mcap.whole(parts))
    with mr.open(tmp_path / "a.mcap") as rec:
        assert rec.channels["/x"].count == 18
        assert "lost_messages" in {f.kind for f in check(rec)}


@pytest.mark.parametrize("packing", ["zstd", "lz4"])
def test_a_chunk_of_a_few_bytes_that_unpacks_to_many_is_refused(sound: Path, packing: str) -> None:
    parts = mcap.records(sound.read_bytes())
    at = next(k for k, p in enumerate(parts) if p.opcode == Opcode.CHUNK)
    parts[at].body = mcap._packed(0, 1, 1 << 27, 0, bytes(1 << 27), packing)
    sound.write_bytes(mcap.whole(mcap._without_summary(parts)))
    begun = time.process_time()
    with mr.open(sound) as rec:
        assert any(
            f.kind == "bad_chunk" and ("claims" in f.detail or "kind 0" in f.detail) for f in check(rec)
        )
    assert time.process_time() - begun < 5


def test_a_header_of_junk_costs_nothing_else(sound: Path) -> None:
    data = bytearray(sound.read_bytes())
    data[17:23] = b"\xff" * 6
    sound.write_bytes(data)
    with mr.open(sound) as rec:
        assert rec.table("/foot/imu1").height == 60


def test_truth_that_cannot_be_measured_against_is_said_before_anything_is_written(tmp_path: Path) -> None:
    t_ns = np.arange(500, dtype=np.int64) * 10**7 + 1
    table = pl.DataFrame(
        {"t_ns": t_ns, **{f"{s}_{a}": np.sin(t_ns / 1e8) for s in ("acc", "gyr") for a in "xyz"}}
    )
    with mr.create(tmp_path / "a.mcap") as out:
        out.add_table("/foot/imu1", IMU, table)
        out.add_metadata("truth", {"length_m": "\x1b[31m-3"})
    done = marcha("replay", tmp_path / "a.mcap", "-e", "foot.naive", "-o", tmp_path / "b.mcap")
    assert done.code == 1
    assert done.complaint.isprintable()
    assert not (tmp_path / "b.mcap").exists()


# -- archives ----------------------------------------------------------------------------------------------


def packed(path: Path, name: str, data: bytes = b"x", mode: int = 0) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("walk.csv", GOOD)
        member = zipfile.ZipInfo(name)
        member.external_attr = mode << 16
        member.compress_type = zipfile.ZIP_DEFLATED
        archive.writestr(member, data)
    return path


@pytest.mark.parametrize(
    ("name", "mode", "said"),
    [
        ("../x.csv", 0, "leads out"),
        ("/etc/x.csv", 0, "leads out"),
        ("a/../../x.csv", 0, "leads out"),
        ("C:x.csv", 0, "leads out"),
        ("x" * 300, 0, "too long"),
        ("WALK.csv", 0, "stands twice"),
        ("link", stat.S_IFLNK | 0o777, "is a link"),
    ],
)
def test_an_archive_that_is_not_to_be_trusted_is_refused(
    tmp_path: Path, name: str, mode: int, said: str
) -> None:
    source = packed(tmp_path / "a.zip", name, mode=mode)
    with pytest.raises(MarchaError, match=said):
        convert(source, tmp_path / "out.mcap")
    assert [p.name for p in tmp_path.iterdir()] == ["a.zip"]


def test_an_encrypted_member_is_refused(tmp_path: Path) -> None:
    data = bytearray(packed(tmp_path / "a.zip", "notes.txt").read_bytes())
    at = data.rindex(b"PK\x01\x02")
    data[at + 8] |= 1
    (tmp_path / "a.zip").write_bytes(data)
    with pytest.raises(MarchaError, match="encrypted"):
        convert(tmp_path / "a.zip", tmp_path / "out.mcap")


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="limits its memory")
def test_a_dictionary_of_any_size_is_one_line(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "a.zip", "w", zipfile.ZIP_LZMA) as archive:
        archive.writestr("walk.csv", GOOD)
    data = bytearray((tmp_path / "a.zip").read_bytes())
    place = 30 + len("walk.csv") + 4 + 1  # local header, version and length of the properties, lc lp pb
    data[place : place + 4] = b"\xff" * 4
    (tmp_path / "a.zip").write_bytes(data)
    before = resource.getrlimit(resource.RLIMIT_DATA)
    held = int(Path("/proc/self/status").read_text().split("VmData:")[1].split()[0]) * 1024
    resource.setrlimit(resource.RLIMIT_DATA, (held + (1 << 30), before[1]))
    try:
        with pytest.raises(MarchaError, match="more memory than there is"):
            convert(tmp_path / "a.zip", tmp_path / "out.mcap")
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, before)


def test_a_bomb_is_refused_unless_an_option_raises_the_limit(tmp_path: Path) -> None:
    source = packed(tmp_path / "a.zip", "zeros.bin", bytes(30_000_000))
    with pytest.raises(MarchaError, match="unpack_limit_gb"):
        convert(source, tmp_path / "out.mcap", options={"unpack_limit_gb": 0.01})
    assert convert(source, tmp_path / "out.mcap", options={"unpack_limit_gb": 0.1}).report.rows_kept == 300


# -- processes -----------------------------------------------------------------------------------------------


@pytest.mark.skipif(os.name != "posix", reason="needs signals")
@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_a_signal_ends_a_command_with_its_own_code_and_nothing_left(
    sound: Path, number: signal.Signals, code: int
) -> None:
    program = (
        "import sys, marcha.recording.mcapfile as m\n"
        "real = m.McapFile.finish\n"
        "def finish(self): print('writing', flush=True); sys.stdin.read(); real(self)\n"
        "m.McapFile.finish = finish\n"
        "from marcha.cli import main; sys.exit(main(sys.argv[1:]))"
    )
    process = subprocess.Popen(
        [
            sys.executable,
            "-c",
            program,
            "export",
            str(sound),
            "--to",
            "mcap",
            "-o",
            str(sound.with_name("b.mcap")),
        ],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == b"writing\n"
    process.send_signal(number)
    _, err = process.communicate(timeout=20)
    assert process.returncode == code
    assert err.decode().count("\n") == 1
    assert [p.name for p in sound.parent.iterdir()] == [sound.name]


@pytest.mark.skipif(os.name != "posix", reason="asks whether a process lives")
def test_what_a_killed_process_left_the_next_one_removes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from marcha.recording.scratch import scratch_folder

    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    (tmp_path / f"marcha-{dead.pid}-abc").mkdir()
    (tmp_path / f"marcha-{os.getpid()}-mine").mkdir()
    (tmp_path / f".x.mcap.{dead.pid}.part").write_bytes(b"half")
    with scratch_folder() as folder:
        assert {p.name for p in tmp_path.iterdir()} == {folder.name, f"marcha-{os.getpid()}-mine"}
    assert not folder.exists()


def test_logs_of_an_archive_are_shown_as_members_of_it(tmp_path: Path) -> None:
    import contextlib

    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        for name in ("one.csv", "two.csv"):
            archive.writestr(name, GOOD)
    with contextlib.ExitStack() as stack:
        found = logs([tmp_path / "a.zip"], stack)
        assert [found.shown(p) for p in found.logs] == [
            str(tmp_path / "a.zip" / n) for n in ("one.csv", "two.csv")
        ]


# -- studies -------------------------------------------------------------------------------------------------


def test_a_label_stays_a_text_in_a_spreadsheet(tmp_path: Path) -> None:
    table = pl.DataFrame({"filter": ["=1+1", "-3.5", "@x", "9IEZ"], "value": [1.0, 2.0, 3.0, 4.0]})
    write_csv(table, tmp_path / "results.csv")
    assert pl.read_csv(tmp_path / "results.csv", infer_schema=False)["filter"].to_list() == [
        "'=1+1",
        "-3.5",
        "'@x",
        "9IEZ",
    ]


def test_a_study_says_which_files_it_leaves_out(tmp_path: Path) -> None:
    from marcha.study.config import load

    (tmp_path / "study.toml").write_text(
        '[recordings]\nfiles = ["*.mcap"]\n[[estimators]]\nname = "foot.naive"\n'
    )
    (tmp_path / "sub").mkdir()
    for name in ("a.mcap", "b.csv", "sub/c.mcap"):
        (tmp_path / name).write_bytes(b"x")
    sources, notes = find_sources(load(tmp_path / "study.toml")[0], tmp_path, "")
    assert len(sources) == 1
    assert any("2 of 3 files" in n and "b.csv" in n and "c.mcap" in n for n in notes)


def test_an_error_of_a_command_is_json_without_control_characters(tmp_path: Path) -> None:
    (tmp_path / "\x1b[31mx.mcap").write_bytes(b"nothing")
    done = marcha("info", tmp_path / "\x1b[31mx.mcap", "--json")
    assert "\x1b" not in json.loads(done.out)["error"] + done.err
