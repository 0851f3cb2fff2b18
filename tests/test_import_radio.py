"""Importers of radio logs: the contract, findings with their remedies, anchors and plan beside a log."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from hypothesis import given
from hypothesis import strategies as st
from marcha.ingest import convert
from marcha.ingest.contract import ReportBuilder
from marcha.ingest.formats.rssi_distances import RssiDistances
from marcha.ingest.formats.rssi_sheet import RssiSheet
from marcha.ingest.formats.three_tables import ThreeTables
from marcha.ingest.headers import TimeUnit, header_of, times_ns
from marcha.recording import MarchaError
from marcha.recording import open as open_recording

from .contracts.importer import ImporterContract
from .radio_samples import ANCHORS, distances, fingerprints, three_tables, workbook


class TestThreeTables(ImporterContract):
    importer = ThreeTables()

    def sample(self, folder: Path) -> Path:
        return three_tables(folder / "walk")


class TestInertialTable(ImporterContract):
    importer = ThreeTables()

    def sample(self, folder: Path) -> Path:
        return three_tables(folder / "walk") / "inertial.csv"


class TestRssiDistances(ImporterContract):
    importer = RssiDistances()

    def sample(self, folder: Path) -> Path:
        return distances(folder)


class TestRssiSheet(ImporterContract):
    importer = RssiSheet()

    def sample(self, folder: Path) -> Path:
        return workbook(folder / "points.xlsx", {"BLE": fingerprints()})


def converted(tmp_path, source, **options):
    done = convert(source, tmp_path / "out.mcap", options=options, overwrite=True)
    return open_recording(tmp_path / "out.mcap"), {f.kind: f for f in done.report.findings}


def test_the_three_tables_become_channels_anchors_and_plan(tmp_path):
    folder = three_tables(tmp_path / "walk")
    plan = {"type": "FeatureCollection", "x_axis_azimuth_deg": 74.0, "features": [
        {"type": "Feature", "properties": {"kind": "wall"},
         "geometry": {"type": "LineString", "coordinates": [[0, 0], [8, 0]]}}]}  # fmt: skip
    (folder / "plan.geojson").write_text(json.dumps(plan))
    rec, findings = converted(tmp_path, folder)
    assert not findings
    assert set(rec.channels) == {"/phone/acc", "/phone/mag", "/phone/orientation", "/phone/radio"}
    assert rec.table("/phone/acc")["t_ns"][1] - rec.table("/phone/acc")["t_ns"][0] == 20_000_000
    assert np.abs(rec.table("/phone/mag")["mag_x"].to_numpy()).max() < 1e-4  # tesla
    assert rec.metadata["device"]["clock"] == "unix"
    assert rec.metadata["plan"]["x_axis_azimuth_deg"] == "74.0"
    assert b"a4:6c:2a:00:00:01,wifi,0.0,0.0,2.6,-38.0,2.1" in rec.attachment("anchors.csv")
    assert json.loads(rec.attachment("plan.geojson"))["features"][0]["properties"]["kind"] == "wall"
    # azimuth 350° at the start: the phone's y axis points 10° west of north
    w, x, y, z = rec.table("/phone/orientation").select("quat_w", "quat_x", "quat_y", "quat_z").row(0)
    assert np.degrees(np.arctan2(2 * (x * y - w * z), 1 - 2 * (x * x + z * z))) == pytest.approx(-10, abs=0.1)


@pytest.mark.parametrize(
    ("unit", "factor"), [("timestamp_ms", 1), ("t [s]", 1e-3), ("time (us)", 1000), ("epoch ns", 1_000_000)]
)
def test_columns_in_any_order_names_and_unit_of_time(tmp_path, unit, factor):
    folder = three_tables(tmp_path / "walk")
    radio = pl.read_csv(folder / "radio.csv")
    stamp = radio["timestamp"] * factor if factor >= 1 else (radio["timestamp"] / 1000).round(3)
    pl.DataFrame(
        {"Level (dBm)": radio["rssi"], "BSSID": radio["mac"].str.to_uppercase(), unit: stamp}
    ).write_csv(folder / "radio.csv", separator=";")
    rec, findings = converted(tmp_path, folder)
    assert not findings
    table = rec.table("/phone/radio")
    assert table["t_ns"].to_list() == (radio["timestamp"] * 1_000_000).to_list()
    assert set(table["mac"]) == set(ANCHORS)


def test_a_device_clock_takes_its_unit_from_the_rate_and_says_so(tmp_path):
    rec, findings = converted(tmp_path, three_tables(tmp_path / "walk", start_ms=5000))
    assert "ms" in findings["assumed_unit"].detail
    assert rec.table("/phone/radio")["t_ns"][0] == 5_000_000_000
    assert rec.metadata["device"]["clock"] == "device"


def test_two_clocks_are_refused(tmp_path):
    folder = three_tables(tmp_path / "walk")
    text = (folder / "inertial.csv").read_text().replace("17730571", "")
    (folder / "inertial.csv").write_text(text)
    with pytest.raises(MarchaError, match=r"radio\.csv.*another clock"):
        convert(folder, tmp_path / "out.mcap")


def test_defects_of_powers_are_findings_with_remedies(tmp_path):
    folder = three_tables(tmp_path / "walk")
    radio = pl.read_csv(folder / "radio.csv")
    seen = radio["timestamp"].to_list()
    rows = [*zip(radio["timestamp"], radio["mac"], (-radio["rssi"]), seen, strict=True)]
    again = (rows[-1][0] + 500, *rows[-1][1:])  # a later scan hands the same measurement over again
    phone = (rows[-1][0] + 600, "0a:11:22:33:44:55", 60, rows[-1][0] + 600)
    text = "timestamp,mac,rssi,last_seen,technology\n"
    text += "".join(f"{a},{b},{c},{d},wifi\n" for a, b, c, d in [*rows, again, phone])
    (folder / "radio.csv").write_text(text + "7,short\n")
    rec, found = converted(tmp_path, folder)
    assert rec.table("/phone/radio")["rssi_dbm"].to_numpy().max() < 0
    assert found["repaired_sign"].count == len(rows) + 2
    assert (found["stale_scan"].count, found["stale_scan"].first_line) == (1, len(rows) + 2)
    assert found["hotspot"].count == 1
    assert "0a:11:22:33:44:55" in found["unknown_anchor"].detail
    assert found["bad_row"].first_line == len(rows) + 4
    with pytest.raises(MarchaError, match="strict"):
        convert(folder, tmp_path / "strict.mcap", strict=True)


def test_the_azimuth_is_the_column_over_the_circle_else_a_doubt(tmp_path):
    folder = three_tables(tmp_path / "walk")
    lines = (folder / "inertial.csv").read_text().splitlines()
    turned = [
        ",".join([*c[:2], c[3], c[4], c[2]]) if (c := row.split(","))[1] == "orientation" else row
        for row in lines
    ]
    whole, _ = converted(tmp_path, folder)
    before = whole.table("/phone/orientation")
    (folder / "inertial.csv").write_text("\n".join(turned))
    rec, findings = converted(tmp_path, folder)
    assert "axis_doubt" not in findings
    assert rec.table("/phone/orientation").equals(before)
    low = [row.replace(row.split(",")[2], "10.0", 1) if ",orientation," in row else row for row in lines]
    (folder / "inertial.csv").write_text("\n".join(low))
    _, findings = converted(tmp_path, folder)
    assert "azimuth=x, y or z" in findings["axis_doubt"].detail


def test_distances_come_from_names_options_or_a_spreadsheet_and_files_are_compared(tmp_path):
    folder = distances(tmp_path)
    rec, _ = converted(tmp_path, folder)
    assert sorted(set(rec.table("/reference/position")["pos_x"])) == [0.5, 1.0, 2.0, 4.0]
    for k, d in enumerate((0.5, 1, 2, 4), start=1):
        (folder / f"{d:g}m.txt").rename(folder / f"{k}.txt")
    with pytest.raises(MarchaError, match=r"1\.txt: nothing says how far"):
        convert(folder, tmp_path / "x.mcap")
    listed, _ = converted(tmp_path, folder, distances="0.5,1,2,4")
    assert listed.table("/indoor/radio").equals(rec.table("/indoor/radio"))
    rows = [["Distance", "RSSI", "Point"], [0.5, -48, 1], [1, -54, 2], [2, -60, 3], [4, -66, 4]]
    workbook(tmp_path / "pathloss.xlsx", {"BLE": rows, "WiFi": rows[:1]})
    rec, findings = converted(tmp_path, folder)
    assert "14.0 dB stronger" in findings["files_disagree"].detail
    assert sorted(set(rec.table("/reference/position")["pos_x"])) == [0.5, 1.0, 2.0, 4.0]


def test_a_spreadsheet_of_points_and_exchanged_anchors(tmp_path):
    anchors = "A 0 0, B 0 4, C 4 0"
    good = workbook(tmp_path / "good.xlsx", {"BLE": fingerprints(), "Zigbee": fingerprints(2)})
    rec, findings = converted(tmp_path, good, anchors=anchors)
    assert {"repaired_sign", "assumed_times"} == set(findings)
    assert set(rec.table("/indoor/radio")["technology"]) == {"ble", "zigbee"}
    assert rec.attachment("anchors.csv").count(b"\n") == 7
    bad = workbook(tmp_path / "bad.xlsx", {"BLE": fingerprints(exchanged=True)})
    _, findings = converted(tmp_path, bad, anchors=anchors)
    assert "B and C" in findings["exchanged_anchors"].detail
    rec, findings = converted(tmp_path, bad, anchors=anchors, exchange="B C")
    one, _ = converted(tmp_path, good, anchors=anchors, technology="ble")
    assert rec.table("/indoor/radio")["rssi_dbm"].equals(one.table("/indoor/radio")["rssi_dbm"])
    _, findings = converted(tmp_path, good)
    assert "anchors=" in findings["no_anchors"].detail


def test_anchors_and_plan_go_beside_any_log(tmp_path):
    folder = three_tables(tmp_path / "walk")
    anchors = (folder / "anchors.csv").rename(tmp_path / "beacons.csv")
    picture = tmp_path / "floor.png"
    from PIL import Image

    Image.new("RGB", (200, 100), "white").save(picture)
    log = folder / "radio.csv"
    with pytest.raises(MarchaError, match=r"floor\.png.*plan\.width_m"):
        convert([log, anchors, picture], tmp_path / "a.mcap")
    convert(
        [log, anchors, picture],
        tmp_path / "a.mcap",
        options={"plan.width_m": "10", "plan.x_axis_azimuth_deg": 90},
    )
    rec = open_recording(tmp_path / "a.mcap")
    place = json.loads(rec.attachment("plan.json"))
    assert (place["width_m"], place["height_m"], place["x_axis_azimuth_deg"]) == (10.0, 5.0, 90.0)
    assert rec.attachment("plan.png") == picture.read_bytes()
    assert b"a0:e6:f8:00:00:03,ble" in rec.attachment("anchors.csv")
    with pytest.raises(MarchaError, match="give the log as well"):
        convert([anchors], tmp_path / "b.mcap")


def test_a_plan_in_degrees_is_laid_out_in_metres(tmp_path):
    ring = [[120.0, 30.0], [120.001, 30.0], [120.001, 30.0005], [120.0, 30.0005], [120.0, 30.0]]
    plan = {"type": "FeatureCollection", "features": [
        {"type": "Feature", "properties": {"type": "floor"}, "geometry": {"type": "Polygon", "coordinates": [ring]}}
    ]}  # fmt: skip
    (tmp_path / "map.json").write_text(json.dumps(plan))
    log = three_tables(tmp_path / "walk") / "radio.csv"
    convert([log, tmp_path / "map.json"], tmp_path / "a.mcap")
    made = json.loads(open_recording(tmp_path / "a.mcap").attachment("plan.geojson"))
    corner = made["features"][0]["geometry"]["coordinates"][0][2]
    assert corner == pytest.approx([111319.49 * 0.001 * np.cos(np.radians(30.00025)), 55.66], abs=0.01)
    assert (made["features"][0]["properties"]["kind"], made["x_axis_azimuth_deg"]) == ("passable", 90.0)
    (tmp_path / "floor_info.json").write_text('{"map_info": {"width": 50, "height": 20}}')
    convert([log, tmp_path / "map.json", tmp_path / "floor_info.json"], tmp_path / "b.mcap")
    made = json.loads(open_recording(tmp_path / "b.mcap").attachment("plan.geojson"))
    assert made["features"][0]["geometry"]["coordinates"][0][2] == pytest.approx([50.0, 20.0])


def test_anchor_tables_name_the_line_that_does_not_do(tmp_path):
    log = three_tables(tmp_path / "walk") / "radio.csv"
    table = tmp_path / "anchors.csv"
    for text, said in (
        ("mac,x,y\nA,1,\n", "line 2: an anchor has"),
        ("mac,x,y\nA,1,2\nA,1,2\n", "line 3: A is there twice"),
    ):
        table.write_text(text)
        with pytest.raises(MarchaError, match=said):
            convert([log, table], tmp_path / "a.mcap", overwrite=True)


@given(st.integers(0, 4_000_000_000), st.integers(0, 999_999_999))
def test_times_are_exact_to_the_nanosecond(seconds: int, fraction: int) -> None:
    cells = pl.DataFrame({"time": [f"{seconds}.{fraction:09d}"], "line": [2]})
    table = times_ns(cells, TimeUnit(1.0, "unix"), Path("t.csv"), ReportBuilder())
    assert table["t_ns"][0] == seconds * 1_000_000_000 + fraction


@given(st.binary(max_size=300))
def test_no_bytes_make_the_header_raise(data: bytes) -> None:
    header = header_of(data)
    assert header is None or len(header.names) > 1


@pytest.mark.data
def test_the_published_path_losses(data_dir, tmp_path):
    """P_d0, η and residual by technology, from spreadsheets and from text files, and their disagreement."""
    from marcha.replay import calibrate

    folder = data_dir / "indoor" / "pathloss" / "Scenario1"
    expected = {"wifi": (-45.7, 2.16, 6.5), "ble": (-75.5, 2.27, 4.6), "zigbee": (-50.3, 2.93, 4.6)}
    rec, _ = converted(tmp_path, folder / "Pathloss_Scenario1.xlsx")
    (found,) = calibrate("radio", [rec], {"drop": 0})
    for technology, (p_d0, eta, left) in expected.items():
        pooled = found.values["pooled"][technology]
        assert (round(pooled["p_d0"], 1), round(pooled["eta"], 2), round(pooled["residual_db"], 1)) == (
            p_d0,
            eta,
            left,
        )
    for name, values, gap in (("WiFi", (-36.0, 1.89, 4.8), "9.8 dB"), ("BLE", (-61.8, 2.19, 5.1), "13.7 dB")):
        rec, findings = converted(tmp_path, folder / "Pathloss" / name)
        (found,) = calibrate("radio", [rec], {"drop": 0})
        pooled = found.values["pooled"][name.lower()]
        assert (round(pooled["p_d0"], 1), round(pooled["eta"], 2), round(pooled["residual_db"], 1)) == values
        assert gap in findings["files_disagree"].detail


@pytest.mark.data
def test_ten_points_are_located_once_the_exchange_of_two_anchors_is_undone(data_dir, tmp_path):
    """As they are, B and C of the test points are exchanged, which the import says; then each technology does 1.6 m."""
    from marcha.replay import calibrate, replay

    folder = data_dir / "indoor" / "pathloss" / "Scenario1"
    anchors = "A 0 0, B 0 4, C 4 0"
    _, findings = converted(tmp_path, folder / "Tests_Scenario1.xlsx", anchors=anchors)
    assert findings["exchanged_anchors"].count == 1
    for technology in ("wifi", "ble", "zigbee"):
        options = {"anchors": anchors, "technology": technology}
        rec, _ = converted(tmp_path, folder / "Database_Scenario1.xlsx", **options)
        survey = calibrate("radio", [rec])
        points, _ = converted(tmp_path, folder / "Tests_Scenario1.xlsx", **options, exchange="B C")
        result = replay(points, ["indoor.fingerprint", "indoor.fingerprint[preset=knn]"], calibrations=survey)
        assert {r.alignment for r in result.runs} == {"none"}
        assert min(r.metrics["position_error_mean_m"] for r in result.runs) < 1.4
