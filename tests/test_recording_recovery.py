"""Damaged files: read as far as they are sound, the loss said; never another exception than MarchaError."""

from __future__ import annotations

import struct

import marcha.recording as mr
import polars as pl
import pytest
from hypothesis import given
from hypothesis import strategies as st
from marcha.recording.check import check
from marcha.recording.integrity import structure
from mcap.opcode import Opcode

from .recording_samples import imu, sample_table

ROWS = 9000
TABLE = imu(ROWS)
STANCE = sample_table("marcha_msgs/msg/Stance", 200, start_ns=0)


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> bytes:
    """A recording of four chunks, a metadata record, an attachment and an annotation."""
    path = tmp_path_factory.mktemp("whole") / "a.mcap"
    with mr.create(path) as out:
        out.add_metadata("walk", {"closed": "true"})
        out.add_table("/imu", "sensor_msgs/msg/Imu", TABLE, "imu1")
        out.add_table("/stance", "marcha_msgs/msg/Stance", STANCE)
        out.add_attachment("a.txt", b"text", "text/plain")
        out.add_annotations(pl.DataFrame({"tier": ["t"], "start_ns": [1], "end_ns": [2], "label": ["x"]}))
    return path.read_bytes()


def records(data: bytes):
    """Yield position, opcode and length of every top-level record, by the format's rule alone."""
    at = 8
    while at + 9 <= len(data) - 8:
        opcode, length = struct.unpack_from("<BQ", data, at)
        yield at, opcode, 9 + length
        at += 9 + length


def read_all(path) -> dict[str, pl.DataFrame]:
    """Use everything that a reader offers and return the tables."""
    rec = mr.open(path)
    tables = {t: rec.table(t) for t, c in rec.channels.items() if c.columns}
    assert sum(t.height for w in rec.windows() for t in w.tables.values()) <= sum(map(len, tables.values()))
    assert rec.annotations.height <= 1
    assert isinstance(rec.metadata, dict)
    for attachment in rec.attachments:
        rec.attachment(attachment.name)
    return tables


def open_cut(tmp_path, data: bytes):
    path = tmp_path / "cut.mcap"
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("part", range(60))
def test_cut_anywhere_gives_a_prefix(whole, tmp_path, part):
    cut = len(whole) * part // 60 + 13
    path = open_cut(tmp_path, whole[:cut])
    if part == 0:  # not even the first channel
        with pytest.raises(mr.MarchaError, match="no channel can be read"):
            mr.open(path)
        return
    tables = read_all(path)
    got = tables.get("/imu", TABLE[:0])
    assert got.equals(TABLE[: got.height])
    ends = [at + n for at, opcode, n in records(whole) if opcode == Opcode.CHUNK]
    assert got.height == min(ROWS, sum(end <= cut for end in ends) * ((1 << 20) // 355))
    assert [f.kind for f in mr.open(path).findings] == ["truncated"]


@pytest.mark.parametrize("cut", range(1, 50, 3))
def test_cut_in_the_last_bytes_keeps_all_data(whole, tmp_path, cut):
    path = open_cut(tmp_path, whole[:-cut])
    tables = read_all(path)
    assert tables["/imu"].equals(TABLE)
    assert tables["/stance"].equals(STANCE)
    rec = mr.open(path)
    assert {"truncated", "bad_summary"} >= {f.kind for f in rec.findings} != set()
    assert rec.metadata == {"walk": {"closed": "true"}}
    assert rec.attachment("a.txt") == b"text"
    assert rec.channels["/imu"].count == ROWS
    assert rec.annotations["label"].to_list() == ["x"]


def test_no_footer_at_all(whole, tmp_path):
    end = next(at for at, opcode, _ in records(whole) if opcode == Opcode.DATA_END)
    rec = mr.open(open_cut(tmp_path, whole[:end]))
    assert rec.table("/imu").equals(TABLE)
    assert [f.kind for f in rec.findings] == ["truncated"]


def damaged(whole: bytes, which: int, offset: int) -> bytes:
    at = [at for at, opcode, _ in records(whole) if opcode == Opcode.CHUNK][which]
    out = bytearray(whole)
    out[at + offset] ^= 0xFF
    return bytes(out)


@pytest.mark.parametrize("offset", [33, 60, 5000], ids=["checksum", "zstd head", "zstd body"])
@pytest.mark.parametrize("footer", [True, False])
def test_a_bad_chunk_is_left_out_and_said(whole, tmp_path, offset, footer):
    data = damaged(whole, 1, offset)
    if not footer:
        data = data[:-40]
    rec = mr.open(open_cut(tmp_path, data))
    per = (1 << 20) // 355
    assert rec.table("/imu").equals(pl.concat([TABLE[:per], TABLE[2 * per :]]))
    assert rec.table("/stance").equals(STANCE)
    found = {f.kind: f for f in rec.findings}
    assert found["bad_chunk"].count == 1
    assert "chunk at byte" in found["bad_chunk"].detail
    assert "bad_chunk" in {f.kind for f in check(rec)}


def test_a_chunk_that_claims_too_much_is_refused(whole, tmp_path):
    at = next(at for at, opcode, _ in records(whole) if opcode == Opcode.CHUNK)
    data = bytearray(whole)
    data[at + 25 : at + 33] = (2**62).to_bytes(8, "little")
    rec = mr.open(open_cut(tmp_path, bytes(data)))
    assert rec.table("/stance").equals(STANCE)
    rec.table("/imu")
    assert [f.kind for f in rec.findings] == ["bad_chunk"]


def test_a_bad_summary_is_not_trusted(whole, tmp_path):
    end = next(at + n for at, opcode, n in records(whole) if opcode == Opcode.DATA_END)
    data = bytearray(whole)
    data[end + 40] ^= 1
    rec = mr.open(open_cut(tmp_path, bytes(data)))
    assert rec.table("/imu").equals(TABLE)
    assert [f.kind for f in rec.findings] == ["bad_summary"]


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (b"", "empty file"),
        (b"\x89MCAP", r"not an MCAP recording \(5 bytes\)"),
        (b"t_ms,ax,ay,az\n1,2,3,4\n", "not an MCAP recording"),
        (b"\x89MCAP0\r\n", "no channel can be read"),
        (b"\x89MCAP0\r\n" + bytes(1000), "no channel can be read"),
        (b"\x89MCAP0\r\n" + b"\xff" * 1000, "no channel can be read"),
    ],
)
def test_a_file_that_is_no_recording(tmp_path, data, says):
    path = open_cut(tmp_path, data)
    with pytest.raises(mr.MarchaError, match=says) as error:
        mr.open(path)
    assert str(path) in str(error.value)


def test_a_folder_or_nothing_is_one_line(tmp_path):
    with pytest.raises(mr.MarchaError, match="is a folder"):
        mr.open(tmp_path)
    with pytest.raises(mr.MarchaError, match="no such file"):
        mr.open(tmp_path / "none.mcap")


@given(st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.integers(0, 255)), min_size=1, max_size=6))
def test_any_flipped_bytes_raise_only_marcha_error(whole, tmp_path_factory, flips):
    data = bytearray(whole)
    for where, value in flips:
        data[int(where * len(data))] = value
    path = open_cut(tmp_path_factory.mktemp("f"), bytes(data))
    try:
        tables = read_all(path)
    except mr.MarchaError:
        return
    got = tables.get("/imu")
    if got is not None and got.columns == TABLE.columns:
        assert got.join(TABLE, on=TABLE.columns, how="semi").height == got.height


@given(st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.integers(0, 255)), min_size=1, max_size=3))
def test_flipped_bytes_of_head_and_tail_raise_only_marcha_error(whole, tmp_path_factory, flips):
    data = bytearray(whole)
    tail = next(at for at, opcode, _ in records(whole) if opcode == Opcode.DATA_END)
    for i, (where, value) in enumerate(flips):
        span = (0, 4000) if i % 2 else (tail, len(data))
        data[span[0] + int(where * (span[1] - span[0]))] = value
    path = open_cut(tmp_path_factory.mktemp("f"), bytes(data))
    try:
        read_all(path)
        structure(mr.open(path))
    except mr.MarchaError:
        return


def test_check_finds_a_wrong_data_checksum(whole, tmp_path):
    end = next(at for at, opcode, _ in records(whole) if opcode == Opcode.DATA_END)
    data = bytearray(whole)
    data[end + 9] ^= 1
    assert [f.kind for f in check(mr.open(open_cut(tmp_path, bytes(data))))] == ["bad_checksum"]


def test_check_finds_a_message_index_that_lies(whole, tmp_path):
    at = next(at for at, opcode, _ in records(whole) if opcode == Opcode.MESSAGE_INDEX)
    data = bytearray(whole)
    data[at + 15 + 16 * 5] ^= 1
    kinds = [f.kind for f in structure(mr.open(open_cut(tmp_path, bytes(data))))]
    assert kinds == ["bad_checksum", "bad_index"]
