"""Files with a structure of their own, damaged inside it: each of these was found by the fuzzer."""

from __future__ import annotations

import json
import re
import zipfile
from collections.abc import Callable
from pathlib import Path

import marcha.recording as mr
import numpy as np
import polars as pl
import pytest
from marcha.export import export
from marcha.export.labels import read_labels
from marcha.ingest import convert
from marcha.ingest.anatomy import cluster_attitude, frame
from marcha.ingest.contract import SourceAttachment
from marcha.ingest.radio import addresses
from marcha.ingest.workbook import MOST_CELLS, read_workbook
from marcha.recording import MarchaError, UsageError
from marcha.viz import domain_figures
from marcha.viz.figures import figure

from .c3d_files import write_c3d
from .cli_helpers import marcha
from .contracts.exporter import example
from .fuzz import mcap
from .radio_samples import workbook

GPX = """<?xml version="1.0"?><gpx version="1.1" xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>{}
</trkseg></trk></gpx>"""
KML = """<?xml version="1.0"?><kml xmlns="http://www.opengis.net/kml/2.2"
xmlns:gx="http://www.google.com/kml/ext/2.2"><Document><Placemark>{}</Placemark></Document></kml>"""


def gpx_point(k: int, lat: object = 38.7, lon: object = -9.1) -> str:
    return f'<trkpt lat="{lat}" lon="{lon}"><time>2024-05-01T10:00:{k:02d}Z</time></trkpt>'


def when(k: int) -> str:
    return f"<when>2024-05-01T10:00:{k:02d}Z</when>"


def rewritten(path: Path, change: Callable[[bytes], bytes], part: str = "sheet1") -> Path:
    """Change a member of an archive, with a checksum that fits."""
    with zipfile.ZipFile(path) as archive:
        members = [(m.filename, archive.read(m)) for m in archive.infolist()]
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members:
            archive.writestr(name, change(content) if part in name else content)
    return path


# -- spreadsheets ------------------------------------------------------------------------------------------


def far(cell: str, row: int | None = None) -> Callable[[bytes], bytes]:
    place = f'<row r="{row}">' if row else "<row>"
    return lambda sheet: sheet.replace(b"</sheetData>", f"{place}{cell}</row></sheetData>".encode())


@pytest.mark.parametrize(
    "change",
    [
        far('<c r="XFD1048576"><v>1</v></c>', 1048576),
        far('<c t=">" r="AAA100000"><v>1</v></c>', 100_000),
        far("<c r='zz99999'><v>1</v></c>"),
        far('<x:c r = "ZZZ99999"/>'),
        far('<c r="&#88;FD1048576"/>'),
        far("<c/>" * (MOST_CELLS // 100), 200),
    ],
)
def test_a_cell_far_from_the_table_does_not_take_the_memory_of_all_between(
    tmp_path: Path, change: Callable[[bytes], bytes]
) -> None:
    """The reader holds the whole rectangle: 5 kB ended the process, or took 2.8 GB."""
    path = rewritten(workbook(tmp_path / "a.xlsx", {"BLE": [["x", "y"], [1.0, 2.0]]}), change)
    with pytest.raises(MarchaError, match="cells, more than"):
        read_workbook(path)


def test_a_sheet_that_unpacks_to_much_is_refused_before_it_is_read(tmp_path: Path) -> None:
    path = rewritten(
        workbook(tmp_path / "a.xlsx", {"BLE": [["x", "y"], [1.0, 2.0]]}),
        lambda sheet: sheet.replace(b"</sheetData>", b" " * 110_000_000 + b"</sheetData>"),
    )
    assert path.stat().st_size < 200_000
    with pytest.raises(MarchaError, match="unpacks to 110 MB"):
        read_workbook(path)


@pytest.mark.parametrize("rows", [1, 3000])
def test_a_sheet_of_any_usual_size_is_read(tmp_path: Path, rows: int) -> None:
    path = workbook(tmp_path / "a.xlsx", {"BLE": [["x", "y"], *([float(k), 2.0] for k in range(rows))]})
    assert read_workbook(path)["BLE"].height == rows


def test_a_member_without_a_name_is_refused(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        archive.writestr("x", b"1,2\n")
    data = (tmp_path / "a.zip").read_bytes()
    local = data.index(b"PK\x03\x04") + 26
    nameless = bytearray(data.replace(b"x1,2\n", b"1,2\n"))
    nameless[local : local + 2] = b"\x00\x00"
    central = nameless.index(b"PK\x01\x02")
    nameless[central + 28 : central + 30] = b"\x00\x00"
    del nameless[central + 46]
    end = nameless.index(b"PK\x05\x06")
    nameless[end + 12 : end + 20] = (end - central).to_bytes(4, "little") + central.to_bytes(4, "little")
    (tmp_path / "a.zip").write_bytes(bytes(nameless))
    with pytest.raises(MarchaError, match="has no name"):
        convert(tmp_path / "a.zip", tmp_path / "out.mcap")
    assert not (tmp_path / "out.mcap").exists()


# -- tracks ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("encoding", ["x", "punycode", "utf-7", "cp932"])
@pytest.mark.parametrize("name", ["walk.gpx", "labels.eaf"])
def test_an_encoding_that_xml_does_not_have_is_one_line(tmp_path: Path, name: str, encoding: str) -> None:
    head = f'<?xml version="1.0" encoding="{encoding}"?>'
    path = tmp_path / name
    if name == "walk.gpx":
        path.write_text(head + GPX.format(gpx_point(1)).partition("?>")[2])
        with pytest.raises(MarchaError, match="is no whole XML"):
            convert(path, tmp_path / "out.mcap", format="gpx")
    else:
        path.write_text(head + "<ANNOTATION_DOCUMENT/>")
        with pytest.raises(MarchaError, match="is not XML"), mr.open(example(tmp_path / "a.mcap", 50)) as rec:
            read_labels(path, rec)


@pytest.mark.parametrize("lat", ["", "x", "nan", "inf", "3_8", "٣"])
def test_a_point_without_a_place_is_left_out_and_counted(tmp_path: Path, lat: str) -> None:
    points = "".join(gpx_point(k, lat if k == 5 else 38.7 + k * 1e-5) for k in range(10))
    (tmp_path / "walk.gpx").write_text(GPX.format(points), encoding="utf-8")
    done = convert(tmp_path / "walk.gpx", tmp_path / "out.mcap")
    assert (done.report.rows_read, done.report.rows_dropped) == (10, 1)
    with mr.open(tmp_path / "out.mcap") as rec:
        table = rec.table("/phone/gnss")
    np.testing.assert_allclose(table["lat_deg"], [38.7 + k * 1e-5 for k in range(10) if k != 5], rtol=1e-12)
    assert np.all(np.diff(table["t_ns"].to_numpy()) == [1e9] * 4 + [2e9] + [1e9] * 3)


@pytest.mark.parametrize(
    "time", ["9999-12-31T23:59:59Z", "0001-01-01T00:00:00+14:00", "2300-01-01", "x" * 900]
)
def test_a_point_at_a_time_that_no_clock_says_is_left_out(tmp_path: Path, time: str) -> None:
    points = "".join(map(gpx_point, range(5))) + gpx_point(5).replace("2024-05-01T10:00:05Z", time)
    (tmp_path / "walk.gpx").write_text(GPX.format(points))
    done = convert(tmp_path / "walk.gpx", tmp_path / "out.mcap")
    assert (done.report.rows_read, done.report.rows_dropped) == (6, 1)


@pytest.mark.parametrize("place", ["", "-9.1", "x y z"])
def test_a_place_of_too_few_numbers_is_left_out(tmp_path: Path, place: str) -> None:
    coords = "".join(
        f"<gx:coord>{place if k == 5 else f'-9.1 {38.7 + k * 1e-5} 3'}</gx:coord>" for k in range(9)
    )
    (tmp_path / "walk.kml").write_text(
        KML.format(f"<gx:Track>{''.join(map(when, range(9)))}{coords}</gx:Track>")
    )
    done = convert(tmp_path / "walk.kml", tmp_path / "out.mcap")
    assert (done.report.rows_read, done.report.rows_dropped) == (9, 1)


def test_a_track_with_a_time_too_few_is_refused_not_shifted(tmp_path: Path) -> None:
    """Every place behind the one without a time got the time of the next."""
    coords = "".join(f"<gx:coord>-9.1 {38.7 + k * 1e-5} 3</gx:coord>" for k in range(9))
    times = "".join(when(k) for k in range(9) if k != 4)
    (tmp_path / "walk.kml").write_text(KML.format(f"<gx:Track>{times}{coords}</gx:Track>"))
    with pytest.raises(MarchaError, match="8 times and 9 places"):
        convert(tmp_path / "walk.kml", tmp_path / "out.mcap")


# -- recordings --------------------------------------------------------------------------------------------


def test_a_topic_of_hundreds_of_signs_has_a_short_name_in_bids(tmp_path: Path) -> None:
    table = pl.DataFrame({"t_ns": np.arange(20) * 10**7, **{f"acc_{a}": np.arange(20.0) for a in "xyz"}})
    with mr.create(tmp_path / "a.mcap") as out:
        for last in "ab":
            out.add_table("/" + "x" * 300 + last, "sensor_msgs/msg/Imu", table)
    with mr.open(tmp_path / "a.mcap") as rec:
        files = export(rec, "bids", tmp_path / "made")
    assert len([f for f in files if f.name.endswith("_motion.tsv")]) == 2
    about = [json.loads(f.read_text()) for f in files if f.name.endswith("_motion.json")]
    assert len(about) == 2


def test_a_declared_value_that_no_message_has_is_missing(tmp_path: Path) -> None:
    """Views, figures and exports took what the metadata declare for what the tables have."""
    table = pl.DataFrame({"t_ns": np.arange(20) * 10**7, "shoe": np.arange(20.0), "mag": np.ones(20)})
    with mr.create(tmp_path / "a.mcap") as out:
        out.add_table("/estimate/a/detector", "marcha_msgs/msg/NamedValues", table)
    data = (tmp_path / "a.mcap").read_bytes()
    parts = mcap.records(data)
    for part in parts:
        part.body = part.body.replace(b'"mag"]', b'"sea"]')
    (tmp_path / "a.mcap").write_bytes(mcap.whole(mcap._without_summary(parts)))
    with mr.open(tmp_path / "a.mcap") as rec:
        assert rec.channels["/estimate/a/detector"].columns == ("shoe", "sea")
        found = rec.table("/estimate/a/detector")
    np.testing.assert_array_equal(found["shoe"], np.arange(20.0))
    assert found["sea"].is_nan().all()
    assert marcha("view", tmp_path / "a.mcap", "--rrd", tmp_path / "a.rrd").code in (0, 3)


# -- tables beside a log -----------------------------------------------------------------------------------


def test_footprints_beyond_any_clock_are_one_line(tmp_path: Path) -> None:
    from .test_import_foot_formats import TestSensorConnectCsv

    log = TestSensorConnectCsv().sample(tmp_path)
    (table,) = [p for p in tmp_path.iterdir() if "strideIndex" in p.name]
    lines = table.read_text().splitlines()
    cells = lines[-1].split(",")
    cells[lines[0].split(",").index("timestamp")] = "1e30"
    table.write_text("\n".join([*lines[:-1], ",".join(cells)]) + "\n")
    with pytest.raises(MarchaError, match="beyond any clock"):
        convert(log, tmp_path / "out.mcap", format="sensorconnect-csv")


# -- figures -----------------------------------------------------------------------------------------------


def test_what_is_left_of_a_damaged_recording_has_a_report(tmp_path: Path) -> None:
    """A channel whose chunk is lost counts messages and gives none: a figure of it is left out."""
    path = example(tmp_path / "a.mcap", 200)
    data = bytearray(path.read_bytes())
    with mr.open(path) as rec:
        source = rec._source("/foot/imu1")
        (chunk,) = rec.chunk_refs(set(source.ids), None, None)
    data[chunk.start + 200] ^= 0xFF
    path.write_bytes(data)
    done = marcha("report", path, "--no-picture", "-o", tmp_path / "a.html")
    assert done.code in (0, 3), done.complaint
    assert (tmp_path / "a.html").stat().st_size > 1000


def test_a_figure_that_fails_on_a_sound_recording_is_a_defect(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(rec: mr.Recording, fig: object) -> None:
        raise IndexError("0")

    monkeypatch.setitem(domain_figures.FIGURES, "detector", fails)
    path = example(tmp_path / "a.mcap", 200)
    with mr.open(path) as rec, pytest.raises(IndexError):
        figure(rec, kind="detector")
    path.write_bytes(path.read_bytes()[:-4000])
    with mr.open(path) as rec, pytest.raises(UsageError, match="no figure 'detector'"):
        figure(rec, kind="detector")


def test_directions_too_long_to_square_give_no_attitude() -> None:
    long = np.array([[1e200, 0.0, 0.0], [0.0, 0.0, 1.0]])
    z = np.array([[0.0, 1e160, 1e160], [0.0, 1.0, 0.0]])
    for found in (frame(z, long), frame(z, long, along_x=True)):
        assert np.isnan(found[0]).any()
        np.testing.assert_allclose(np.linalg.det(found[1]), 1.0, atol=1e-12)


# -- outputs -----------------------------------------------------------------------------------------------

ONTO_ITSELF = (
    ("replay", "-e", "foot.naive"),
    ("cut", "--start", "0.1"),
    ("anonymize",),
    ("merge", "OTHER", "--prefix", "/a", "--prefix", "/b"),
    ("annotate", "add", "--label", "x", "--from", "0.1"),
    ("export", "--to", "mcap"),
    ("export", "--to", "csv"),
    ("export", "--to", "matlab"),
)


@pytest.mark.parametrize("name", ["a.mcap", "link.mcap", "hard.mcap"])
@pytest.mark.parametrize("command", ONTO_ITSELF, ids=" ".join)
def test_no_command_replaces_its_input(tmp_path: Path, command: tuple[str, ...], name: str) -> None:
    path = example(tmp_path / "a.mcap", 200)
    other = example(tmp_path / "b.mcap", 20)
    (tmp_path / "link.mcap").symlink_to(path)
    (tmp_path / "hard.mcap").hardlink_to(path)
    before = path.read_bytes()
    at = 2 if command[0] == "annotate" else 1
    more = [other if a == "OTHER" else a for a in command[at:]]
    done = marcha(*command[:at], path, *more, "-o", tmp_path / name, "--force")
    assert done.code == 2, done.err
    assert "is the input itself" in done.err.splitlines()[-1]
    assert path.read_bytes() == before
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.mcap", "b.mcap", "hard.mcap", "link.mcap"]


def test_a_table_that_lacks_an_axis_is_left_out_and_counted(tmp_path: Path) -> None:
    from .test_import_phone_apps import TestSensorLogger

    log = TestSensorLogger().sample(tmp_path)
    table = log / "Gravity.csv"
    lines = table.read_text().splitlines()
    table.write_text("\n".join([lines[0].replace(",y,", ",why,"), *lines[1:]]) + "\n")
    done = convert(log, tmp_path / "out.mcap", format="sensor-logger")
    assert done.report.rows_read == done.report.rows_kept + done.report.rows_dropped
    (finding,) = [f for f in done.report.findings if f.kind == "missing_column"]
    assert finding.count == len(lines) - 1


@pytest.mark.parametrize("numbers", ["9" * 400 + ",", "null,", '"x",', ""], ids=lambda t: t[:5])
def test_a_receiver_at_no_place_is_one_line(tmp_path: Path, numbers: str) -> None:
    from .test_import_ble_mbd import TestBleMbd

    log = TestBleMbd().sample(tmp_path)
    (table,) = tmp_path.rglob("*.dev")
    said = table.read_text()
    table.write_text(re.sub(r"\[\[\s*-?[\d.]+,", f"[[{numbers}", said, count=1))
    assert table.read_text() != said
    with pytest.raises(MarchaError, match="not \\[\\[x, y, z\\]"):
        convert(log, tmp_path / "out.mcap", format="ble-mbd")


@pytest.mark.parametrize("rate", ["..", "50.0.1", ".", "9" * 400, "0"], ids=lambda t: t[:6])
def test_a_rate_that_is_none_is_one_line(tmp_path: Path, rate: str) -> None:
    from .test_import_leg_formats import TestSegmentsCsv, TestXsensText

    for contract, format, unit in (
        (TestSegmentsCsv, "segments-csv", ""),
        (TestXsensText, "xsens-text", "Hz"),
    ):
        log = contract().sample(tmp_path)
        said = log.read_text()
        log.write_text(re.sub(rf"(ency|Rate): 50(\.0)?{unit}", rf"\1: {rate}{unit}", said, count=1))
        assert log.read_text() != said
        with pytest.raises(MarchaError) as error:
            convert(log, tmp_path / "out.mcap", format=format)
        assert len(str(error.value)) < 400
        assert not (tmp_path / "out.mcap").exists()


def test_an_anchor_table_with_returns_inside_is_read_by_lines() -> None:
    table = b"name,mac,x_m,y_m\na,00:00:00:00:00:01,0,0\rb,00:00:00:00:00:02,1,1\n"
    found = addresses([SourceAttachment("anchors.csv", table, "text/csv")])
    assert found == ["00:00:00:00:00:01", "00:00:00:00:00:02"]


def test_a_marker_beyond_any_room_is_not_looked_for_endlessly() -> None:
    """LAPACK's singular values of what overflowed took 10 s and more."""
    rng = np.random.default_rng(1)
    pos = rng.normal(size=(1, 4, 3)) + rng.normal(0, 1e-3, (50, 4, 3))
    pos[20, 2, 1], pos[21, 0, 0] = 1e200, np.inf
    rot, _, shape, misfit = cluster_attitude(pos)
    assert np.isfinite(rot[[19, 20, 21, 22]]).all()
    assert np.isfinite(shape).all()
    assert misfit < 0.01


def test_a_reference_of_another_type_is_no_position(tmp_path: Path) -> None:
    from marcha.viz.plan_figures import true_positions

    from .test_recording_foreign import ODD, odd_bytes, raw_writer

    rows = [("/reference/position", k, odd_bytes(k)) for k in range(12)]
    path = raw_writer(tmp_path / "a.mcap", rows, ("/reference/position",), "pkg/msg/Odd", ODD)
    with mr.open(path) as rec:
        assert rec.channels["/reference/position"].count == 12
        assert true_positions(rec) is None


def test_a_marker_whose_name_is_no_utf8_is_read(tmp_path: Path) -> None:
    pytest.importorskip("ezc3d")
    pos = np.arange(60.0).reshape(20, 1, 3)
    write_c3d(tmp_path / "a.c3d", pos, np.zeros((20, 1)), processor="intel", integers=False)
    data = (tmp_path / "a.c3d").read_bytes()
    assert data.count(b"m1") == 1
    (tmp_path / "a.c3d").write_bytes(data.replace(b"m1", b"m\xff"))
    convert(tmp_path / "a.c3d", tmp_path / "out.mcap")
    with mr.open(tmp_path / "out.mcap") as rec:
        assert rec.channels["/reference/markers"].columns == ("m?.x", "m?.y", "m?.z")
