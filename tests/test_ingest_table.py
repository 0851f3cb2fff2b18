"""Tables with a mapping: the documented example, units, layouts, defects, mistakes in the mapping."""

from __future__ import annotations

import math
import re
from pathlib import Path

import marcha.recording as mr
import numpy as np
import polars as pl
import pytest
from hypothesis import given
from hypothesis import strategies as st
from marcha.ingest import Report, convert
from marcha.ingest.formats.table import Table, TableOptions
from marcha.ingest.units import UNITS, conversion
from marcha.recording import MarchaError, UsageError

from .conftest import ROOT

IMU = """
[[topic]]
name = "/x/imu"
schema = "sensor_msgs/msg/Imu"
columns = { acc_x = "ax", acc_y = "ay", acc_z = "az" }
"""


def read(folder: Path, text: str | bytes, mapping: str) -> tuple[dict[str, pl.DataFrame], Report]:
    source, toml = folder / "table.csv", folder / "map.toml"
    source.write_bytes(text.encode() if isinstance(text, str) else text)
    toml.write_text(mapping, encoding="utf-8")
    imported = Table().read([source], TableOptions(mapping=str(toml)))
    parts: dict[str, list[pl.DataFrame]] = {}
    for topic, table in imported.blocks():
        parts.setdefault(topic, []).append(table)
    return {t: pl.concat(p) for t, p in parts.items()}, imported.report


def kinds(report: Report) -> dict[str, int]:
    return {f.kind: f.count for f in report.findings}


def table(n: int = 60, separator: str = ",", time: str = "{}") -> list[str]:
    rows = [separator.join([time.format(10 * i), f"{i}.5", f"-{i % 7}.25", f"9.{i}"]) for i in range(n)]
    return [separator.join(["t", "ax", "ay", "az"]), *rows]


def example(name: str) -> str:
    page = (ROOT / "docs" / "table-mapping.md").read_text(encoding="utf-8")
    found = re.search(rf"<!-- example: {re.escape(name)} -->\n```\w+\n(.*?)```", page, re.DOTALL)
    assert found is not None
    return found[1]


def test_the_documented_example(tmp_path: Path) -> None:
    for name in ("walk.csv", "walk.toml"):
        (tmp_path / name).write_text(example(name), encoding="utf-8")
    done = convert(tmp_path / "walk.csv", tmp_path / "walk.mcap", mapping=tmp_path / "walk.toml")
    assert {c.topic: c.count for c in done.channels} == {
        "/foot/imu1": 4,
        "/foot/mag": 4,
        "/foot/pressure": 2,
        "/phone/gnss": 2,
    }
    assert not done.report.lossy
    rec = mr.open(tmp_path / "walk.mcap")
    imu = rec.table("/foot/imu1")
    assert imu["t_ns"].to_list() == [0, 10_000_000, 20_000_000, 30_000_000]
    assert imu["acc_z"][1] == pytest.approx(1.01 * 9.80665)
    assert imu["gyr_x"][0] == pytest.approx(math.radians(0.5))
    assert rec.table("/foot/mag").row(0)[1:] == pytest.approx((21.5e-6, -3.0e-6, 42.1e-6))
    assert rec.table("/foot/pressure")["pressure_pa"].to_list() == pytest.approx([101320, 101330])
    assert rec.table("/phone/gnss")["lat_deg"].to_list() == [41.1496, 41.1497]
    assert rec.table("/phone/gnss")["alt_m"].to_list() == [85.0, 85.0]
    assert rec.metadata["device"]["mounting"] == "left shoe, x forward"
    assert rec.metadata["mapping"]["toml"] == example("walk.toml")
    assert rec.channels["/foot/imu1"].metadata["rate_hz"] == "100"
    assert rec.channels["/foot/imu1"].frame_id == "imu1"


def test_documented_units_are_the_known_ones() -> None:
    page = (ROOT / "docs" / "table-mapping.md").read_text(encoding="utf-8")
    for wanted, units in re.findall(r"^\| (\S+) \| ((?:`[^`]+` ?)+)\|$", page, re.MULTILINE):
        if wanted in UNITS:
            listed = re.findall(r"`([^`]+)`", units)
            for unit in listed:
                assert math.isfinite(conversion(unit, wanted)[0])
            missing = {
                u
                for u in UNITS[wanted]
                if conversion(u, wanted) not in {conversion(x, wanted) for x in listed}
            }
            assert not missing, (wanted, missing)


@pytest.mark.parametrize(
    ("value", "given_unit", "wanted", "result"),
    [  # by the units' definitions (SI brochure, NIST SP 811)
        (1, "g", "m/s²", 9.80665),
        (180, "°/s", "rad/s", math.pi),
        (1, "gauss", "T", 1e-4),
        (50, "μT", "T", 50e-6),
        (1013.25, "hPa", "Pa", 101325),
        (760, "mmHg", "Pa", 101325),
        (300, "K", "°C", 26.85),
        (212, "degF", "°C", 100),
        (3937, "us-survey-ft", "m", 1200),
        (36, "km/h", "m/s", 10),
        (math.pi, "rad", "°", 180),
        (90, "deg", "rad", math.pi / 2),
        (2.4, "GHz", "Hz", 2.4e9),
    ],
)
def test_units(value: float, given_unit: str, wanted: str, result: float) -> None:
    factor, offset = conversion(given_unit, wanted)
    assert value * factor + offset == pytest.approx(result, rel=1e-12)


def test_unit_of_another_kind() -> None:
    with pytest.raises(UsageError, match="'uT' cannot become m/s²; known here: m/s2, g"):
        conversion("uT", "m/s²")


@pytest.mark.parametrize("separator", [",", ";", "\t", "|", "blanks"])
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r", "\n\n"])
def test_layouts(tmp_path: Path, separator: str, end: str) -> None:
    text = end.join(table(separator="   " if separator == "blanks" else separator)) + end
    mapping = f'[layout]\nseparator = "{separator}"\n[time]\ncolumn = "t"\nunit = "ms"\n{IMU}'.replace(
        "\t", "\\t"
    )
    tables, report = read(tmp_path, text, mapping)
    assert tables["/x/imu"].height == 60
    assert tables["/x/imu"].row(3) == (30_000_000, 3.5, -3.25, 9.3)
    assert report.findings == []


def test_preamble_comments_quotes_and_byte_order_mark(tmp_path: Path) -> None:
    rows = table(40)
    text = "\n".join(["Logger 3", "sep=,", '"t","ax","ay","az"', "# note", *rows[1:20], "# more", *rows[20:]])
    text = text.replace("10,1.5", '10,"1.5"')
    mapping = f'[layout]\nskip_rows = 2\ncomment = "#"\n[time]\ncolumn = "t"\nunit = "ms"\n{IMU}'
    tables, report = read(tmp_path, b"\xef\xbb\xbf" + text.encode() + b"\n", mapping)
    assert tables["/x/imu"].height == 40
    assert tables["/x/imu"].row(1) == (10_000_000, 1.5, -1.25, 9.1)
    assert report.rows_dropped == 0


def test_decimal_comma(tmp_path: Path) -> None:
    text = "\n".join(table(separator=";", time="{},5")).replace(".", ",") + "\n"
    mapping = f'[layout]\nseparator = ";"\ndecimal_comma = true\n[time]\ncolumn = "t"\nunit = "ms"\n{IMU}'
    tables, report = read(tmp_path, text, mapping)
    assert tables["/x/imu"].row(3) == (30_500_000, 3.5, -3.25, 9.3)
    assert not report.lossy


def test_one_decimal_comma_among_points_is_a_named_repair(tmp_path: Path) -> None:
    text = "\n".join(table(separator=";")).replace("50;5.5", "50;5,5") + "\n"
    tables, report = read(
        tmp_path, text, f'[layout]\nseparator = ";"\n[time]\ncolumn = "t"\nunit = "ms"\n{IMU}'
    )
    assert tables["/x/imu"]["acc_x"][5] == 5.5
    assert [(f.kind, f.count, f.first_line) for f in report.findings] == [("decimal_comma", 1, 7)]
    assert report.rows_repaired == 1


@pytest.mark.parametrize(
    ("cell", "unit", "extra", "wanted"),
    [
        ("1700000000.123456789", "s", "", 1_700_000_000_123_456_789),
        ("1.5e1", "s", "", 15_000_000_000),
        ("1700000000123", "ms", "", 1_700_000_000_123_000_000),
        ("7", "us", "", 7_000),
        ("1700000000123456789", "ns", "", 1_700_000_000_123_456_789),
        ("2023-11-14T22:13:20.5Z", "datetime", "", 1_700_000_000_500_000_000),
        ("2023-11-14 22:13:20", "datetime", "", 1_700_000_000_000_000_000),
        (
            "14.11.2023 22:13:20:250",
            "datetime",
            'format = "%d.%m.%Y %H:%M:%S:%3f"',
            1_700_000_000_250_000_000,
        ),
    ],
)
def test_time_to_the_nanosecond(tmp_path: Path, cell: str, unit: str, extra: str, wanted: int) -> None:
    text = f"t,ax,ay,az\n{cell},1,2,3\n"
    tables, _ = read(tmp_path, text, f'[time]\ncolumn = 1\nunit = "{unit}"\n{extra}\n{IMU}')
    assert tables["/x/imu"]["t_ns"].to_list() == [wanted]


def test_time_from_a_rate(tmp_path: Path) -> None:
    text = "\n".join(table(10)) + "\n"
    tables, _ = read(tmp_path, text, f"[time]\nrate_hz = 3.0\n{IMU}")
    assert tables["/x/imu"]["t_ns"].to_list() == [round(i * 1e9 / 3) for i in range(10)]


def test_rollover_of_a_counter(tmp_path: Path) -> None:
    rows = [f"{(65_000 + 10 * i) % 65_536},{i},0,9" for i in range(100)]
    mapping = f'[time]\ncolumn = "t"\nunit = "ms"\nrollover = 65536\n{IMU}'
    tables, report = read(tmp_path, "t,ax,ay,az\n" + "\n".join(rows) + "\n", mapping)
    assert tables["/x/imu"]["t_ns"].diff().drop_nulls().unique().to_list() == [10_000_000]
    assert kinds(report)["counter_rollover"] == 1


def test_defects_are_named_with_their_lines(tmp_path: Path) -> None:
    rows = table(60)
    rows[10] = "90,1,2"
    rows[11] = "100,1,2,3,4"
    rows[12] = "soon,1,2,3"
    rows[13] = "120,one,2,3"
    rows[14] = "130,,,"
    rows[15] = "140,-,2,3"
    tables, report = read(tmp_path, "\n".join(rows) + "\n", f'[time]\ncolumn = "t"\nunit = "ms"\n{IMU}')
    found = {(f.kind, f.count, f.first_line) for f in report.findings}
    assert ("bad_row", 3, 11) in found
    assert ("missing_cell", 1, 14) in found  # unreadable
    assert report.rows_read == 60
    assert report.rows_dropped == 4
    assert report.rows_repaired == 1
    values = tables["/x/imu"].filter(pl.col("t_ns").is_in([120_000_000, 140_000_000]))
    assert np.isnan(values["acc_x"].to_numpy()).all()
    assert values["acc_y"].to_list() == [2.0, 2.0]


def test_clipping_by_the_mapping(tmp_path: Path) -> None:
    text = "\n".join(table()).replace("30,3.5", "30,16.0") + "\n"
    mapping = (
        f'[time]\ncolumn = "t"\nunit = "ms"\n{IMU}units = {{ acc = "g" }}\nfull_scale = {{ acc = 16 }}\n'
    )
    rows = [r for r in text.splitlines() if not re.match(r"\d+,(1[6-9]|[2-9]\d)\.5", r)]
    _, report = read(tmp_path, "\n".join(rows) + "\n", mapping)
    assert [(f.count, f.first_line) for f in report.findings if f.kind == "clipped"] == [(1, 5)]


def test_unit_doubts(tmp_path: Path) -> None:
    rows = [
        "t,ax,ay,az,p",
        *(f"{10 * i},{0.01 * (i % 3)},0,{1 + 0.001 * (i % 2)},1013.{i % 9}" for i in range(200)),
    ]
    mapping = f"""[time]
column = "t"
unit = "ms"
{IMU}
[[topic]]
name = "/x/p"
schema = "sensor_msgs/FluidPressure"
columns = {{ pressure_pa = "p" }}
"""
    _, report = read(tmp_path, "\n".join(rows) + "\n", mapping)
    doubts = [f.detail for f in report.findings if f.kind == "unit_doubt"]
    assert any("g given as m/s²?" in d for d in doubts)
    assert any("/x/p" in d and "Pa" in d for d in doubts)


def test_named_channels_flags_and_texts(tmp_path: Path) -> None:
    text = "t,knee,rate,on,mac,rssi\n" + "".join(
        f"{10 * i},{i},{2 * i},{'yes' if i % 2 else 'no'},aa:bb:cc:00:00:0{i},{-50 - i}\n" for i in range(5)
    )
    mapping = """
[time]
column = "t"
unit = "ms"
[[topic]]
name = "/leg/encoder"
schema = "sensor_msgs/msg/JointState"
columns = { knee = { column = "knee", unit = "deg" }, "knee.vel" = { column = "rate", unit = "deg/s" } }
[[topic]]
name = "/foot/contact"
schema = "marcha_msgs/msg/Stance"
columns = { still = "on" }
[[topic]]
name = "/phone/ble"
schema = "marcha_msgs/msg/RadioSignal"
columns = { mac = "mac", rssi_dbm = "rssi", technology = { constant = "ble" } }
"""
    (tmp_path / "t.csv").write_text(text)
    (tmp_path / "m.toml").write_text(mapping)
    convert(tmp_path / "t.csv", tmp_path / "o.mcap", mapping=tmp_path / "m.toml")
    rec = mr.open(tmp_path / "o.mcap")
    assert rec.table("/leg/encoder").row(3) == (30_000_000, math.radians(3), math.radians(6))
    assert rec.table("/foot/contact")["still"].to_list() == [False, True, False, True, False]
    assert rec.table("/phone/ble")["mac"][4] == "aa:bb:cc:00:00:04"
    assert rec.table("/phone/ble")["technology"].unique().to_list() == ["ble"]


def test_folder_of_files(tmp_path: Path) -> None:
    folder = tmp_path / "export"
    folder.mkdir()
    (folder / "Acc.csv").write_text("\n".join(table(30)) + "\n")
    (folder / "Baro.csv").write_text("t,p\n" + "".join(f"{100 * i},1013\n" for i in range(9)))
    mapping = f"""[time]
column = "t"
unit = "ms"
{IMU}file = "Acc.csv"
[[topic]]
name = "/x/p"
schema = "sensor_msgs/msg/FluidPressure"
file = "B*.csv"
columns = {{ pressure_pa = {{ column = "p", unit = "hPa" }} }}
"""
    (tmp_path / "m.toml").write_text(mapping)
    done = convert(folder, tmp_path / "o.mcap", mapping=tmp_path / "m.toml")
    assert {c.topic: c.count for c in done.channels} == {"/x/imu": 30, "/x/p": 9}


TIME = '[time]\ncolumn = "t"\nunit = "ms"\n'


@pytest.mark.parametrize(
    ("mapping", "said"),
    [
        ("", "top level: Object missing required field `topic`"),
        (TIME, "top level: .*`topic`"),
        (IMU, "top level: .*`time`"),
        (f"{TIME}speed = 3\n{IMU}", "time: .*unknown field `speed`"),
        (f'[time]\ncolumn = "t"\nunit = "h"\n{IMU}', "time.unit: Invalid enum value 'h'; one of s, ms"),
        (f"[time]\n{IMU}", "time: give time.column, time.rate_hz, or both"),
        (
            f'[time]\ncolumn = "when"\n{IMU}',
            "time.column: table.csv has no column 'when'; it has t, ax, ay, az",
        ),
        (f"[time]\ncolumn = 9\n{IMU}", "time.column: .*no column 9"),
        (
            TIME + IMU.replace("Imu", "Sock"),
            r"topic\[0\].schema: unknown message type 'sensor_msgs/msg/Sock'",
        ),
        (TIME + IMU.replace('"ax"', '"qx"'), r"topic\[0\].columns.acc_x: table.csv has no column 'qx'"),
        (
            TIME + IMU.replace("acc_x", "acc_w"),
            r"topic\[0\].columns.acc_w: .* has no column 'acc_w'; it has acc_x",
        ),
        (TIME + IMU.replace(', acc_z = "az"', ""), r"topic\[0\].columns: acc_z is missing beside acc_x"),
        (
            TIME + IMU + 'units = { acc = "uT" }',
            r"topic\[0\].columns.acc_x.unit: unit 'uT' cannot become m/s²",
        ),
        (TIME + IMU.replace('"ax"', "{ unit = 'g' }"), r"columns.acc_x: give either column or constant"),
        (TIME + IMU.replace("/x/imu", "imu"), r"topic\[0\].name: "),
        (TIME + IMU + IMU, "topic.name: two topics"),
        (f"[layout]\nseparator = 'ab'\n{TIME}{IMU}", "layout.separator: 'ab'"),
        (f"[layout]\nheader = false\n{TIME}{IMU}", "time.column: 't' is a name, but layout.header is false"),
        (f"[layout]\nskip_rows = -1\n{TIME}{IMU}", "layout.skip_rows: "),
        ("topic = [", "not TOML"),
    ],
)
def test_mistakes_name_the_key(tmp_path: Path, mapping: str, said: str) -> None:
    with pytest.raises(MarchaError, match=said) as caught:
        read(tmp_path, "\n".join(table()) + "\n", mapping)
    assert "\n" not in str(caught.value)
    assert "map.toml" in str(caught.value)


def test_missing_mapping_and_wrong_format(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text("\n".join(table()) + "\n")
    with pytest.raises(MarchaError, match=r"gone\.toml: no such mapping file"):
        convert(tmp_path / "t.csv", tmp_path / "o.mcap", mapping=tmp_path / "gone.toml")
    with pytest.raises(UsageError, match="mapping"):
        convert(tmp_path / "t.csv", tmp_path / "o.mcap", format="table")
    with pytest.raises(UsageError, match="--map belongs to the formats table"):
        convert(tmp_path / "t.csv", tmp_path / "o.mcap", format="mpu6050-serial", mapping="m.toml")


@given(st.lists(st.tuples(st.integers(0, 10_000), st.binary(max_size=12), st.integers(0, 12)), max_size=8))
def test_damaged_tables_never_surprise(tmp_path: Path, edits: list[tuple[int, bytes, int]]) -> None:
    data = ("\r\n".join(table(80)) + "\r\n").encode()
    for at, new, gone in edits:
        i = at % (len(data) + 1)
        data = data[:i] + new + data[i + gone :]
    try:
        tables, report = read(tmp_path, data, TIME + IMU)
    except MarchaError as error:
        assert "\n" not in str(error)  # noqa: PT017
        return
    assert report.rows_read == report.rows_kept + report.rows_dropped
    for frame in tables.values():
        assert frame["t_ns"].is_sorted()
        assert frame.height <= report.rows_kept
    if not edits:
        assert report.findings == []
        assert report.rows_kept == 80
