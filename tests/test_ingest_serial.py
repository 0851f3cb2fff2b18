"""Serial text and packets of the shoe's MPU-6050: values, scales, damaged lines, real recordings."""

from __future__ import annotations

import csv
import math
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from marcha.ingest import Report
from marcha.ingest.contract import ReportBuilder
from marcha.ingest.formats.mpu6050 import Mpu6050Options
from marcha.ingest.formats.mpu6050_packets import Mpu6050Packets
from marcha.ingest.formats.mpu6050_serial import Mpu6050Serial
from marcha.ingest.simulate import simulate
from marcha.ingest.text import rows_of
from marcha.recording import MarchaError, UsageError

G = 9.80665
#: Files of the device without clipping, with it, and the axes that clip (data/README.md: ±2 g and ±250 °/s).
CLIPPED = {"0000": {"acc", "gyr"}, "0303": {"acc"}, "3030": {"gyr"}}
UNCLIPPED = ("1111", "2222", "2323", "3333")


def row(i: int, t0: int = 1000) -> list[int]:
    """A row unlike its neighbours in every column, and never at rest."""
    return [t0 + 10 * i, *((500 * (k + 1) + (-1) ** i * 30 * (i % 17 + k)) for k in range(12))]


def line(i: int) -> bytes:
    return ",".join(map(str, row(i))).encode()


def read(path: Path, **options: object) -> tuple[dict[str, pl.DataFrame], Report, dict[str, dict[str, str]]]:
    imported = Mpu6050Serial().read([path], Mpu6050Options(**options))  # type: ignore[arg-type]
    parts: dict[str, list[pl.DataFrame]] = {}
    for topic, table in imported.blocks():
        parts.setdefault(topic, []).append(table)
    return {t: pl.concat(p) for t, p in parts.items()}, imported.report, imported.metadata


def write(folder: Path, content: bytes, name: str = "conf-3210-walk.txt") -> Path:
    path = folder / name
    path.write_bytes(content)
    return path


def kinds(report: Report) -> dict[str, int]:
    return {f.kind: f.count for f in report.findings}


def test_every_code_has_its_scale(tmp_path: Path) -> None:
    """Counts to SI by the sensor's data sheet, each sensor with its own pair of codes."""
    path = write(tmp_path, b"\r\n\r\n".join(line(i) for i in range(50)) + b"\r\n")
    tables, _, _ = read(path)  # codes 3 2 | 1 0
    first = row(0)
    for topic, at, per_g, per_dps in (("/foot/imu1", 1, 2048, 32.8), ("/foot/imu2", 7, 8192, 131.0)):
        got = tables[topic].row(0)
        assert got[0] == 1000 * 1_000_000
        assert got[1:4] == pytest.approx([c / per_g * G for c in first[at : at + 3]], rel=1e-12)
        assert got[4:] == pytest.approx(
            [math.radians(c / per_dps) for c in first[at + 3 : at + 6]], rel=1e-12
        )


@pytest.mark.parametrize("separator", [b",", b"\t", b";", b" ", b" , ", b", ", b";\t"])
@pytest.mark.parametrize("end", [b"\n", b"\r\n", b"\r", b"\r\n\r\n", b"\n\n"])
def test_separators_and_line_ends(tmp_path: Path, separator: bytes, end: bytes) -> None:
    rows = [line(i).replace(b",", separator) for i in range(40)]
    tables, report, _ = read(write(tmp_path, end.join(rows) + end))
    assert tables["/foot/imu1"].height == tables["/foot/imu2"].height == report.rows_kept == 40
    assert report.findings == []


@pytest.mark.parametrize(
    ("damaged", "why"),
    [
        (b"1200,1,2,3,4,5,6,7,8,9,10,11", "12 of 13"),
        (b"1200,1,2,3,4,5,6,7,8,9,10,11,12,13", "more than 13"),
        (b"1200,1,2,3,4,5,x,7,8,9,10,11,12", "column 7 .gz1. is not"),
        (b"1200,1,2,3,4,5,,7,8,9,10,11,12", "column 7 .gz1. is not"),
        (b"1200,1,2,3,4,5.5,6,7,8,9,10,11,12", "column 6 .gy1. is not"),
        (b"1200,1,2,3,4,40000,6,7,8,9,10,11,12", "column 6 .gy1. is outside -32768"),
        (b"4294967296,1,2,3,4,5,6,7,8,9,10,11,12", "column 1 .t_ms. is outside"),
        (b"1200,1,2,3,4,99999999999999999999,6,7,8,9,10,11,12", "column 6 .gy1. is outside"),
        (b"-1200,1,2,3,4,5,6,7,8,9,10,11,12", "column 1 .t_ms. is outside"),
        (b"\x00\xff\x80,,", "column 1 .t_ms. is not"),
        (b"garbage,1,2", "column 1 .t_ms. is not"),
        (b"x200,1,2,3,4,5,6,7,8,9,10,11,12", "column 1 .t_ms. is not"),
    ],
)
def test_bad_row_says_line_and_reason(tmp_path: Path, damaged: bytes, why: str) -> None:
    rows = [line(i) for i in range(60)]
    rows[20] = damaged
    tables, report, _ = read(write(tmp_path, b"\r\n\r\n".join(rows) + b"\r\n"))
    assert tables["/foot/imu1"].height == 59
    assert report.rows_dropped == 1
    finding = next(f for f in report.findings if f.kind == "bad_row")
    assert (finding.count, finding.first_line) == (1, 41)

    assert re.search(why, finding.detail)
    assert "\n" not in finding.detail


def test_boot_chatter_is_named_not_counted(tmp_path: Path) -> None:
    chatter = b"Configuring MPU-01...\r\nt_ms,ax1,ay1,az1\r\n# full scale 16 g\r\nreset, code 7\r\n"
    text = chatter + b"\n".join(line(i) for i in range(60)) + b"\n"
    _, report, _ = read(write(tmp_path, text))
    assert kinds(report) == {"chatter": 4}
    assert report.rows_read == 60
    assert not report.lossy


def test_wall_clock_becomes_metadata(tmp_path: Path) -> None:
    rows = [b"12:34:%02d.%03d " % (56 + i // 100, i % 100 * 10) + line(i) for i in range(150)]
    path = write(tmp_path, b"\r\n12:34:56.789 \r\n".join(rows) + b"\r\n")
    assert Mpu6050Serial().sniff(path.read_bytes(), path) > 0.9
    tables, report, metadata = read(path)
    assert tables["/foot/imu1"].height == 150
    assert report.findings == []
    assert metadata["device"]["wall_clock_first"] == "12:34:56.000"
    assert metadata["device"]["wall_clock_last"] == "12:34:57.490"
    assert metadata["device"]["wall_clock_last_t_ms"] == "2490"


def test_cut_first_and_last_line(tmp_path: Path) -> None:
    text = b"\r\n\r\n".join(line(i) for i in range(60))
    tables, report, _ = read(write(tmp_path, text[10:-20]))
    assert tables["/foot/imu1"].height == 58
    assert report.rows_dropped == 2
    assert report.rows_read == 60


def test_last_line_without_end_is_kept_and_said(tmp_path: Path) -> None:
    _, report, _ = read(write(tmp_path, b"\n".join(line(i) for i in range(60))))
    assert report.rows_kept == 60
    assert kinds(report) == {"no_final_newline": 1}


def test_clipping_each_axis(tmp_path: Path) -> None:
    rows = [row(i) for i in range(60)]
    rows[5][1] = rows[6][1] = 32767
    rows[30][12] = -32768
    rows[31][12] = -32767  # the last value that is still a reading
    _, report, _ = read(write(tmp_path, b"\n".join(",".join(map(str, r)).encode() for r in rows) + b"\n"))
    found = [(f.count, f.first_line, f.detail.split(":")[0]) for f in report.findings if f.kind == "clipped"]
    assert found == [(2, 6, "/foot/imu1 acc_x"), (1, 31, "/foot/imu2 gyr_z")]
    assert report.lossy


def test_silent_sensor(tmp_path: Path) -> None:
    rows = [[*row(i)[:7], 0, 0, 0, 0, 0, 0] for i in range(60)]
    _, report, _ = read(write(tmp_path, b"\n".join(",".join(map(str, r)).encode() for r in rows) + b"\n"))
    assert {f.kind for f in report.findings} == {"all_zero", "stale_repeat"}
    assert all("/foot/imu2" in f.detail for f in report.findings)


def test_constant_axis(tmp_path: Path) -> None:
    rows = [[*row(i)[:4], 77, *row(i)[5:]] for i in range(60)]
    _, report, _ = read(write(tmp_path, b"\n".join(",".join(map(str, r)).encode() for r in rows) + b"\n"))
    assert [(f.kind, f.detail.split(":")[0]) for f in report.findings] == [("constant", "/foot/imu1 gyr_x")]


def test_wrong_full_scale_is_doubted(tmp_path: Path) -> None:
    path = simulate("straight", tmp_path, seed=1, config="1111").paths[0]
    _, right, _ = read(path)
    _, wrong, _ = read(path, conf="3333")
    assert "unit_doubt" not in kinds(right)
    doubts = [f.detail for f in wrong.findings if f.kind == "unit_doubt"]
    assert len(doubts) == 2
    assert all(re.search(r"\((3\.[89]|4).*full scale", d) for d in doubts)


def test_unknown_full_scale_is_an_error(tmp_path: Path) -> None:
    path = write(tmp_path, b"\n".join(line(i) for i in range(60)), "walk.txt")
    with pytest.raises(UsageError, match=r"walk\.txt: the full scale of sensor 1 is unknown.*conf="):
        read(path)
    tables, _, _ = read(path, accel1_g=16, gyro1_dps=2000, accel2_g=2, gyro2_dps=250)
    assert tables["/foot/imu2"]["acc_x"][0] == pytest.approx(row(0)[7] / 16384 * G)


def test_option_beats_file_name(tmp_path: Path) -> None:
    path = write(tmp_path, b"\n".join(line(i) for i in range(60)), "conf-0000-walk.txt")
    tables, _, _ = read(path, conf="3333", gyro1_dps=500)
    assert tables["/foot/imu1"]["acc_x"][0] == pytest.approx(row(0)[1] / 2048 * G)
    assert tables["/foot/imu1"]["gyr_x"][0] == pytest.approx(math.radians(row(0)[4] / 65.5))
    assert tables["/foot/imu2"]["gyr_x"][0] == pytest.approx(math.radians(row(0)[10] / 16.4))


def test_pieces_of_one_capture(tmp_path: Path) -> None:
    whole = [line(i) + b"\r\n\r\n" for i in range(80)]
    first = write(tmp_path, b"".join(whole[:30]), "conf-3333-a.txt")
    second = write(tmp_path, b"".join(whole[30:]), "conf-3333-b.txt")
    imported = Mpu6050Serial().read([first, second], Mpu6050Options())
    tables = [t for topic, t in imported.blocks() if topic == "/foot/imu1"]
    assert pl.concat(tables)["t_ns"].to_list() == [row(i)[0] * 1_000_000 for i in range(80)]
    assert imported.report.findings == []


MUTATION = st.tuples(
    st.sampled_from(
        ["delete", "double", "cut", "flip", "lf", "chatter", "blank", "junk", "swap"],
    ),
    st.integers(0, 10_000),
    st.integers(0, 255),
)


@given(st.lists(MUTATION, max_size=12))
def test_damaged_text_never_surprises(tmp_path: Path, mutations: list[tuple[str, int, int]]) -> None:
    """Whatever happens to the bytes: rows add up and time never decreases, or one line of error."""
    rows = [line(i) + b"\r\n\r\n" for i in range(120)]
    for kind, at, value in mutations:
        i = at % len(rows)
        if kind == "delete":
            rows[i] = b""
        elif kind == "double":
            rows.insert(i, rows[i])
        elif kind == "cut":
            rows[i] = rows[i][: value % 60]
        elif kind == "flip" and rows[i]:
            k = value % len(rows[i])
            rows[i] = rows[i][:k] + bytes([value]) + rows[i][k + 1 :]
        elif kind == "lf":
            rows[i] = rows[i].replace(b"\r\n", b"\n")
        elif kind == "chatter":
            rows.insert(i, b"MPU reset, code %d\r\n" % value)
        elif kind == "blank":
            rows.insert(i, b" \t\r\n")
        elif kind == "junk":
            rows.insert(i, bytes([value]) * (value % 50))
        elif kind == "swap":
            j = value % len(rows)
            rows[i], rows[j] = rows[j], rows[i]
    path = write(tmp_path, b"".join(rows))
    Mpu6050Serial().sniff(path.read_bytes(), path)
    try:
        tables, report, _ = read(path)
    except MarchaError as error:
        assert "\n" not in str(error)  # noqa: PT017
        return
    assert report.rows_read == report.rows_kept + report.rows_dropped
    assert report.rows_repaired <= report.rows_kept
    lines = b"".join(rows).replace(b"\r\n", b"\n").replace(b"\r", b"\n").split(b"\n")
    assert report.rows_read + kinds(report).get("chatter", 0) == sum(bool(x.strip(b" \t")) for x in lines)
    for table in tables.values():
        assert table.height == report.rows_kept
        assert table["t_ns"].is_sorted()
        assert not table.null_count().sum_horizontal().item()
    if not mutations:
        assert report.findings == []


@given(st.lists(st.tuples(st.integers(0, 100_000), st.integers(0, 255), st.booleans()), max_size=10))
@example([(1, 0, False)])  # a device id of another way of counting
def test_damaged_packets_are_resynchronised(tmp_path: Path, mutations: list[tuple[int, int, bool]]) -> None:
    path = tmp_path / "conf-3333-x.bin"
    if not hasattr(test_damaged_packets_are_resynchronised, "data"):
        made = simulate("still", tmp_path, format="packets", duration_s=2.0, overwrite=True).paths[0]
        test_damaged_packets_are_resynchronised.data = made.read_bytes()  # type: ignore[attr-defined]
    data = bytearray(test_damaged_packets_are_resynchronised.data)  # type: ignore[attr-defined]
    whole = len(data) // 28
    for at, value, insert in mutations:
        i = at % len(data)
        if insert:
            data[i:i] = bytes([value]) * (value % 40)
        else:
            data[i] = value
    path.write_bytes(data)
    imported = Mpu6050Packets().read([path], Mpu6050Options())
    tables: dict[str, list[pl.DataFrame]] = {}
    for topic, table in imported.blocks():
        tables.setdefault(topic, []).append(table)
    report = imported.report
    assert report.rows_read == report.rows_kept + report.rows_dropped
    assert report.rows_kept >= whole - 2 * len(mutations) - 40 * sum(1 for m in mutations if not m[2])
    for parts in tables.values():
        assert pl.concat(parts)["t_ns"].is_sorted()
    if not mutations:
        assert report.rows_kept == whole


def test_lost_bytes_are_counted(tmp_path: Path) -> None:
    made = simulate("straight", tmp_path, format="packets").paths[0]
    data = made.read_bytes()
    path = tmp_path / "conf-3333-damaged.bin"
    path.write_bytes(b"boot" + data[: 28 * 50] + b"$$garbage\r\n" + data[28 * 50 : -5])
    imported = Mpu6050Packets().read([path], Mpu6050Options())
    kept = sum(t.height for _, t in imported.blocks())
    assert kept == len(data) // 28 - 1
    lost = next(f for f in imported.report.findings if f.kind == "lost_bytes")
    assert lost.count == 4 + 11 + 23
    assert lost.first_line == 1


def test_packets_and_text_of_one_walk_agree(tmp_path: Path) -> None:
    text = simulate("straight", tmp_path / "a", seed=5).paths[0]
    packets = simulate("straight", tmp_path / "b", seed=5, format="packets").paths[0]
    tables, _, _ = read(text)
    imported = Mpu6050Packets().read([packets], Mpu6050Options())
    for topic, table in imported.blocks():
        assert table.drop("quat_w", "quat_x", "quat_y", "quat_z").equals(tables[topic])
        quat = table.select("quat_w", "quat_x", "quat_y", "quat_z").to_numpy()
        assert np.allclose(np.linalg.norm(quat, axis=1), 1)


@pytest.mark.data
@pytest.mark.parametrize("conf", [*CLIPPED, *UNCLIPPED])
def test_real_recordings(data_dir: Path, conf: str) -> None:
    """Counts, scales and clipping of the device's own files; the csv module is the independent reader."""
    path = next((data_dir / "foot" / "mpu6050").glob(f"conf-{conf}-*"))
    with path.open(newline="") as f:
        raw = np.array([[int(c) for c in r] for r in csv.reader(f) if r], dtype=np.int64)
    tables, report, _ = read(path)
    assert report.rows_kept == report.rows_read == len(raw)
    assert (raw[:, 0] * 1_000_000 == tables["/foot/imu1"]["t_ns"].to_numpy()).all()
    for sensor in (1, 2):
        table = tables[f"/foot/imu{sensor}"]
        counts = raw[:, 6 * sensor - 5 : 6 * sensor + 1]
        scale = np.array(
            [G * 2.0 ** (int(conf[0]) - 14)] * 3
            + [math.radians({"0": 1 / 131, "1": 1 / 65.5, "2": 1 / 32.8, "3": 1 / 16.4}[conf[1]])] * 3
        )
        np.testing.assert_allclose(table.to_numpy()[:, 1:], counts * scale, rtol=1e-12)
    rest = np.linalg.norm(tables["/foot/imu2"].head(200).select("acc_x", "acc_y", "acc_z").to_numpy(), axis=1)
    assert 0.99 < np.median(rest) / G < 1.01
    clipped = {f.detail.split()[1][:3] for f in report.findings if f.kind == "clipped"}
    assert clipped == CLIPPED.get(conf, set())
    assert "unit_doubt" not in kinds(report)
    assert {"jitter", "gap"} & set(kinds(report))
    full = (raw[:, 1:] == 32767) | (raw[:, 1:] == -32768)
    assert sum(f.count for f in report.findings if f.kind == "clipped") == full.sum()


PIECES = st.lists(
    st.one_of(
        st.lists(st.integers(-70_000, 70_000).map(str), min_size=2, max_size=4).map(",".join).map(str.encode),
        st.tuples(
            st.sampled_from([b"12:34:56 ", b"12:34:56.7 -> ", b"2020-01-02T12:34:56,789 > ", b""]),
            st.sampled_from(
                [b"1;2;3", b"1 2 3", b"1,-2\t3,", b"+1 , 2 ,3", b"1,,3", b"--1,2,3", b"1,2-3,4", b"0x1,2,3"]
            ),
        ).map(b"".join),
        st.sampled_from(
            [
                b"",
                b" \t",
                b"Boot v1.2",
                b"# 1,2",
                b"t,a,b",
                b"12345678901234567890123,1,2",
                b"000000000000000000000001,2,3",
            ]
        ),
        st.binary(max_size=12).map(lambda line: line.replace(b"\n", b"").replace(b"\r", b"")),
    ),
    min_size=1,
    max_size=12,
)


@given(lines=PIECES, end=st.sampled_from([b"\n", b"\r\n", b"\r"]), final=st.booleans())
def test_the_compiled_scanner_and_the_reader_of_lines_are_the_same(
    lines: list[bytes], end: bytes, final: bool
) -> None:
    limits = [(0, 65_535), (-32_768, 32_767), (-32_768, 32_767)]
    reports = [ReportBuilder(), ReportBuilder()]
    piece = end.join(lines) + end * final
    (slow, lines_slow), (fast, lines_fast) = (
        rows_of(piece, limits, ["t", "a", "b"], report, first_line=3, compiled=compiled)
        for report, compiled in zip(reports, (False, True), strict=True)
    )
    assert slow.lines.tolist() == fast.lines.tolist()
    assert slow.values.tolist() == fast.values.tolist()
    assert slow.wall_ms.tolist() == fast.wall_ms.tolist()
    assert lines_slow == lines_fast
    assert reports[0].build() == reports[1].build()


def test_a_log_is_converted_without_a_compiler(tmp_path: Path) -> None:
    """Loading one would take longer than everything else together."""
    walk = simulate("still", tmp_path, seed=0).paths[0]
    code = (
        "import sys, marcha.cli as c\n"
        f"try: c.main(['convert', {str(walk)!r}, '-o', {str(tmp_path / 'a.mcap')!r}, '--quiet'])\n"
        "except SystemExit as end: assert end.code in (0, 3), end.code\n"
        "heavy = {'numba', 'scipy', 'matplotlib', 'rerun'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
