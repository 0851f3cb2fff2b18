"""Importers of the source's text, Sensor Logger, GetSensorData, GnssLogger, GPX, KML; archives of strangers."""

from __future__ import annotations

import contextlib
import csv
import json
import sqlite3
import stat
import zipfile
from collections.abc import Callable
from pathlib import Path

import marcha.recording as mr
import numpy as np
import pytest
from marcha.ingest import convert, recognise
from marcha.ingest.archive import unpack
from marcha.ingest.batch import logs
from marcha.ingest.formats.android_text import AndroidText
from marcha.ingest.formats.androsensor import AndroSensor
from marcha.ingest.formats.getsensordata import GetSensorData
from marcha.ingest.formats.gnsslogger import GnssLogger
from marcha.ingest.formats.phyphox import Phyphox
from marcha.ingest.formats.sensor_logger import SensorLogger
from marcha.ingest.formats.tracks import Gpx, Kml
from marcha.ingest.simulate import PhoneWalk
from marcha.recording import MarchaError
from scipy.spatial.transform import Rotation

from . import phone_samples as samples
from .test_import_phone import ACC, GYR, MAG, PhoneContract, kinds, read, same


@pytest.fixture(scope="module")
def walk() -> PhoneWalk:
    return samples.short_walk()


class TestAndroidText(PhoneContract):
    importer = AndroidText()

    def sample(self, folder: Path) -> Path:
        return samples.android_text(folder / "log.txt", self.walk)


class TestGetSensorData(PhoneContract):
    importer = GetSensorData()

    def sample(self, folder: Path) -> Path:
        return samples.getsensordata(folder / "log.txt", self.walk)


class TestGnssLogger(PhoneContract):
    importer = GnssLogger()

    def sample(self, folder: Path) -> Path:
        return samples.gnsslogger(folder / "log.txt", self.walk)


class TestGpx(PhoneContract):
    importer = Gpx()

    def sample(self, folder: Path) -> Path:
        return samples.gpx(folder / "walk.gpx", self.walk)


class TestKml(PhoneContract):
    importer = Kml()

    def sample(self, folder: Path) -> Path:
        return samples.kml(folder / "walk.kml", self.walk)


class TestSensorLogger(PhoneContract):
    importer = SensorLogger()

    def sample(self, folder: Path) -> Path:
        return samples.sensor_logger(folder / "log", self.walk)


def test_android_text_gives_fixes_once(tmp_path: Path, walk: PhoneWalk) -> None:
    imported, tables, report = read(AndroidText(), samples.android_text(tmp_path / "a.txt", walk))
    assert tables["/phone/gnss"].height == walk.fixes.height
    last = len(tables["/phone/acc"])
    assert same(tables["/phone/acc"], ACC, walk.acc_b[-last:])
    assert same(tables["/phone/mag"], MAG, walk.mag_b[-last:])
    assert kinds(report)["stale_repeat"] == last - walk.fixes.height
    assert imported.metadata["device"]["header SamplingTime"] == "50ms"


@pytest.mark.parametrize("empty", ["", ",,,", ",null,null,null", ",NaN,NaN,NaN"])
def test_android_text_before_and_without_any_fix(tmp_path: Path, empty: str) -> None:
    """Rows before the first fix end after the field, or have empty places; nothing of them is lost."""
    row = "{},-0.39,3.73,8.64,-16.7,-17.3,-15.6{}#"
    fix = ",-22.826485,-47.076044,645.1"
    lines = [row.format(1489060307326 + 50 * k, empty if k < 40 else fix) for k in range(60)]
    path = tmp_path / "a.txt"
    path.write_text("@Date: x\n" + "\n".join(lines))
    assert [c.name for c in recognise(path)] == ["android-text"]
    _, tables, report = read(AndroidText(), path)
    assert tables["/phone/acc"].height == tables["/phone/mag"].height == 60
    assert tables["/phone/gnss"].height == 1
    assert report.rows_dropped == 0
    path.write_text("\n".join(lines[:40]))
    assert [c.name for c in recognise(path)] == ["android-text"]
    _, tables, _ = read(AndroidText(), path)
    assert tables["/phone/acc"].height == 40
    assert "/phone/gnss" not in tables


def test_each_sample_is_of_exactly_one_format(tmp_path: Path, walk: PhoneWalk) -> None:
    """Every importer of phones looks at every sample, and those of the other domains look as well."""
    made = {
        "android-text": samples.android_text(tmp_path / "a.txt", walk),
        "androsensor": samples.androsensor(tmp_path / "b.csv", walk),
        "sensortester": samples.sensortester(tmp_path / "c.csv", walk),
        "indoor-location": samples.indoor_location(tmp_path / "d.txt", walk),
        "android-ns": samples.android_ns(tmp_path / "e", walk),
        "rtk-pos": samples.rtk_pos(tmp_path / "f.pos", walk),
        "getsensordata": samples.getsensordata(tmp_path / "g.txt", walk),
        "gnsslogger": samples.gnsslogger(tmp_path / "h.txt", walk),
        "gpx": samples.gpx(tmp_path / "i.gpx", walk),
        "kml": samples.kml(tmp_path / "j.kml", walk),
        "phyphox": samples.phyphox(tmp_path / "k", walk),
        "sensor-logger": samples.sensor_logger(tmp_path / "l", walk),
    }
    for name, path in made.items():
        assert [c.name for c in recognise(path)] == [name]


def test_android_text_packed_fixes_are_no_track(tmp_path: Path) -> None:
    row = "{},-0.39,3.73,8.64,-16.7,-17.3,-15.6,{:.7f},-47.07604455#"
    lines = [row.format(1489060307326 + 53 * k, -22.8264 - (1e-4 * min(k, 4))) for k in range(60)]
    (tmp_path / "a.txt").write_text("@Date: x\n" + "\n".join(lines))
    imported, tables, report = read(AndroidText(), tmp_path / "a.txt")
    assert kinds(report)["packed_fixes"] == 5
    assert "/phone/gnss" not in tables
    assert imported.attachments[0].data.count(b"\n") == 6


@pytest.mark.parametrize(("platform", "standard"), [("android", False), ("ios", False), ("ios", True)])
def test_sensor_logger_has_one_sign_and_gravity(
    tmp_path: Path, walk: PhoneWalk, platform: str, standard: bool
) -> None:
    folder = samples.sensor_logger(tmp_path / "log", walk, platform, standard)
    imported, tables, _ = read(SensorLogger(), folder)
    assert same(tables["/phone/acc"], ACC, walk.acc_b, 1e-5)
    assert same(tables["/phone/gyr"], GYR, walk.gyr_b)
    assert same(tables["/phone/mag"], MAG, walk.mag_b)
    assert np.array_equal(tables["/phone/acc"]["t_ns"].to_numpy(), walk.t_ns)
    assert same(tables["/phone/gnss"], ["sd_east_m"], walk.fixes.select("sd_east_m").to_numpy(), 1e-5)
    assert imported.metadata["device"]["platform"] == platform


@pytest.mark.parametrize(("platform", "standard"), [("android", False), ("ios", False), ("ios", True)])
def test_sensor_logger_without_metadata_is_turned_by_the_field(
    tmp_path: Path, platform: str, standard: bool
) -> None:
    """In Munich, where the field dips by 64°."""
    walk = samples.short_walk(lat_deg=48.1, lon_deg=11.6, alt_m=520.0)
    folder = samples.sensor_logger(tmp_path / "log", walk, platform, standard)
    (folder / "Metadata.csv").unlink()
    _, tables, report = read(SensorLogger(), folder)
    assert same(tables["/phone/acc"], ACC, walk.acc_b, 1e-5)
    assert "the magnetic field there" in next(
        f.detail for f in report.findings if f.kind == "assumed_platform"
    )
    (folder / "Location.csv").unlink()  # nobody knows the field
    _, tables, report = read(SensorLogger(), folder)
    assert same(
        tables["/phone/acc"], ACC, walk.acc_b * (-1 if platform == "ios" and not standard else 1), 1e-5
    )
    assert "set platform=ios" in next(f.detail for f in report.findings if f.kind == "assumed_platform")


@pytest.mark.parametrize("kind", ["json", "sqlite", "zip"])
def test_sensor_logger_in_one_file_is_the_same(tmp_path: Path, walk: PhoneWalk, kind: str) -> None:
    folder = samples.sensor_logger(tmp_path / "log", walk, "ios")
    (folder / "Light.csv").write_text("time,seconds_elapsed,lux\n1,0.0,3\n")
    tables = {f.stem: list(csv.DictReader(f.open())) for f in folder.glob("*.csv")}
    path = tmp_path / f"log.{kind}"
    if kind == "json":
        path.write_text(json.dumps([{"sensor": n} | r for n, rows in tables.items() for r in rows]))
    elif kind == "sqlite":
        with sqlite3.connect(path) as base:
            for name, rows in tables.items():
                base.execute(f'create table "{name}" ({",".join(f"[{c}] text" for c in rows[0])})')
                marks = ",".join("?" * len(rows[0]))
                base.executemany(f'insert into "{name}" values ({marks})', [list(r.values()) for r in rows])
        base.close()
    else:
        with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
            for f in folder.glob("*.csv"):
                archive.write(f, f.name)
    whole, single = convert(folder, tmp_path / "a.mcap"), convert(path, tmp_path / "b.mcap")
    assert whole.format == single.format == "sensor-logger"
    assert whole.channels == single.channels
    unread = [f.detail for done in (whole, single) for f in done.report.findings if f.kind == "unused_file"]
    assert [text.removesuffix(": not imported").removesuffix(".csv") for text in unread] == ["Light", "Light"]
    first, second = (mr.open(tmp_path / name).annotations for name in ("a.mcap", "b.mcap"))
    assert first.height == 2
    assert first.equals(second)


def test_sensor_logger_takes_what_the_user_wrote(tmp_path: Path, walk: PhoneWalk) -> None:
    folder = samples.sensor_logger(tmp_path / "log", walk)
    (folder / "Light.csv").write_text("time,seconds_elapsed,lux\n1,0.0,3\n")
    with (folder / "Annotation.csv").open("a") as file:
        file.write("soon,1.0,turn,80\n1,2\n4000000000000000000,3.0,turn,80\n")
    done = convert(folder, tmp_path / "a.mcap")
    findings = {(f.kind, f.count, f.first_line, f.detail.split(":")[0]) for f in done.report.findings}
    assert findings >= {
        ("bad_row", 1, 5, "time"),
        ("bad_row", 1, 6, "Annotation.csv"),
        ("bad_row", 1, 7, "Annotation"),
        ("unused_file", 1, None, "Light.csv"),
    }
    marks = mr.open(tmp_path / "a.mcap").annotations
    assert marks["label"].to_list() == ["door, left", "two\nlines"]
    assert marks["start_ns"].to_list() == marks["end_ns"].to_list() == walk.t_ns[[100, 200]].tolist()
    assert marks["metadata"][0] == '{"millisecond_press_duration":"118"}'
    assert set(marks["tier"]) == {"events"}
    assert set(marks["source"]) == {"human"}


def test_an_annotation_far_from_the_data_does_not_stretch_the_recording(
    tmp_path: Path, walk: PhoneWalk
) -> None:
    folder = samples.sensor_logger(tmp_path / "log", walk)
    soon = walk.t_ns[-1] + 30 * 10**9
    (folder / "Annotation.csv").write_text(f"time,seconds_elapsed,text\n5,0.3,early\n{soon},0.9,soon\n")
    done = convert(folder, tmp_path / "a.mcap")
    outside = next(f for f in done.report.findings if f.kind == "annotation_outside")
    assert (outside.count, outside.detail.split(" ")[0]) == (1, "'early'")
    assert done.report.lossy
    assert mr.open(tmp_path / "a.mcap").annotations["label"].to_list() == ["soon"]


def test_sensor_logger_of_old_versions_has_no_press(tmp_path: Path, walk: PhoneWalk) -> None:
    folder = samples.sensor_logger(tmp_path / "log", walk)
    rows = f"time,seconds_elapsed,text\n{walk.t_ns[3]},0.3,standing\n{walk.t_ns[9]},0.9,\n"
    (folder / "Annotation.csv").write_text(rows)
    convert(folder, tmp_path / "a.mcap")
    assert mr.open(tmp_path / "a.mcap").annotations["label"].to_list() == ["standing", ""]


def test_sensor_logger_without_gravity_says_so(tmp_path: Path, walk: PhoneWalk) -> None:
    folder = samples.sensor_logger(tmp_path / "log", walk)
    (folder / "Gravity.csv").unlink()
    _, tables, report = read(SensorLogger(), folder)
    assert "/phone/acc" not in tables
    assert "/phone/linear_acc" in tables
    assert kinds(report)["gravity_free"] == 1


def test_getsensordata_takes_the_sensors_clock(tmp_path: Path, walk: PhoneWalk) -> None:
    _, tables, _ = read(GetSensorData(), samples.getsensordata(tmp_path / "g.txt", walk))
    assert same(tables["/phone/gyr"], GYR, walk.gyr_b)
    intervals = np.diff(tables["/phone/acc"]["t_ns"].to_numpy()) - np.diff(walk.t_ns)
    assert np.abs(intervals).max() <= 2000  # not the 4 ms of the app
    assert tables["/phone/radio"]["mac"][0] == "16:74:9c:2b:4d:1b"
    assert tables["/reference/fix"].height == 1


@pytest.mark.parametrize("app", ["phyphox", "androsensor", "sensor_logger", "getsensordata", "gnsslogger"])
def test_speed_and_course_are_the_receivers_velocity(tmp_path: Path, walk: PhoneWalk, app: str) -> None:
    importer, path = {
        "phyphox": (Phyphox(), lambda: samples.phyphox(tmp_path, walk)),
        "androsensor": (AndroSensor(), lambda: samples.androsensor(tmp_path / "a.csv", walk)),
        "sensor_logger": (SensorLogger(), lambda: samples.sensor_logger(tmp_path / "log", walk)),
        "getsensordata": (GetSensorData(), lambda: samples.getsensordata_21(tmp_path / "g.txt", walk)),
        "gnsslogger": (GnssLogger(), lambda: samples.gnsslogger_v3(tmp_path / "gnss_log.txt", walk)),
    }[app]
    imported, tables, _ = read(importer, path())
    table = tables["/phone/gnss_velocity"]
    assert table["t_ns"].equals(tables["/phone/gnss"]["t_ns"])
    assert same(table, ["vel_x", "vel_y"], walk.fixes.select("vel_east", "vel_north").to_numpy(), 1e-4)
    assert table["vel_z"].is_nan().all()
    assert next(c.frame_id for c in imported.channels if c.topic == "/phone/gnss_velocity") == "enu"


@pytest.mark.parametrize(("speed", "course"), [("-1", "-1"), ("0.0", "0.0"), ("", ""), ("1.2", "")])
def test_a_velocity_that_is_none_is_no_message(
    tmp_path: Path, walk: PhoneWalk, speed: str, course: str
) -> None:
    path = samples.phyphox(tmp_path, walk) / "Location.csv"
    head, *rows = path.read_text().splitlines()
    cells = [row.split(",") for row in rows]
    cells[1][4:6] = speed, course
    path.write_text("\n".join([head, *(",".join(c) for c in cells), ""]))
    _, tables, _ = read(Phyphox(), tmp_path)
    assert tables["/phone/gnss"].height == walk.fixes.height
    assert tables["/phone/gnss_velocity"].height == walk.fixes.height - 1


def test_gnsslogger_takes_the_bias_off(tmp_path: Path, walk: PhoneWalk) -> None:
    _, tables, _ = read(GnssLogger(), samples.gnsslogger(tmp_path / "g.txt", walk))
    assert same(tables["/phone/acc"], ACC, walk.acc_b, 1e-5)
    assert np.allclose(tables["/phone/mag"].select(MAG).to_numpy(), walk.mag_b, atol=1e-10)
    assert tables["/phone/gnss"].height == walk.fixes.height


def test_getsensordata_reads_the_columns_that_its_head_declares(tmp_path: Path, walk: PhoneWalk) -> None:
    """Version 2.1: beacons without a sensor's time, Wi-Fi with a frequency, satellites by their own clock."""
    path = samples.getsensordata_21(tmp_path / "logfile_2026_03_09.txt", walk)
    assert [c.name for c in recognise(path)] == ["getsensordata"]
    _, tables, report = read(GetSensorData(), path)
    assert report.rows_dropped == 0
    assert np.abs(tables["/phone/acc"].select(ACC).to_numpy() - walk.acc_b).max() < 1e-5
    assert np.abs(tables["/phone/mag"].select(MAG).to_numpy() - walk.mag_b).max() < 1e-10
    turn = tables["/phone/orientation"].select("quat_w", "quat_x", "quat_y", "quat_z").to_numpy()
    assert np.abs(np.abs((turn * walk.quat_wxyz).sum(axis=1)) - 1).max() < 1e-6
    radio = tables["/phone/radio"].unique("mac", maintain_order=True)
    assert dict(zip(radio["mac"], radio["rssi_dbm"], strict=True)) == {
        "16:74:9c:2b:4d:1b": -41,
        "e0:78:a3:3d:b5:ab": -77,
        "e0:78:a3:3d:b5:ac": -80,
        "e0:78:a3:3d:b5:ad": -60,
    }
    assert radio.filter(technology="wifi")["frequency_hz"].to_list() == [2.412e9]
    fixes = tables["/phone/gnss"]
    assert np.abs(fixes["t_ns"].to_numpy() - (walk.fixes["t_ns"].to_numpy() - walk.t_ns[0])).max() < 2_000_000
    assert same(fixes, ["lat_deg"], walk.fixes.select("lat_deg").to_numpy(), 1e-7)


def test_gnsslogger_takes_one_provider_and_the_exact_clock(tmp_path: Path, walk: PhoneWalk) -> None:
    path = samples.gnsslogger_v3(tmp_path / "gnss_log_2026_03_09.txt", walk)
    assert [c.name for c in recognise(path)] == ["gnsslogger"]
    _, tables, report = read(GnssLogger(), path)
    assert kinds(report)["other_provider"] == 2 * walk.fixes.height
    assert same(tables["/phone/gnss"], ["lat_deg"], walk.fixes.select("lat_deg").to_numpy(), 1e-9)
    assert same(tables["/phone/gyr"], GYR, walk.gyr_b, 1e-6)
    assert np.abs(tables["/phone/mag"].select(MAG).to_numpy() - walk.mag_b).max() < 1e-9
    t = tables["/phone/acc"]["t_ns"].to_numpy()
    assert np.array_equal(np.diff(t), np.diff(walk.t_ns))  # UTC alone is cut to milliseconds
    assert np.abs(t - walk.t_ns).max() < 1_000_000
    w, x, y, z = tables["/phone/orientation"].select("quat_w", "quat_x", "quat_y", "quat_z").row(0)
    top = 2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)  # where the phone's y axis points
    assert np.degrees(np.arcsin(top[2])) == pytest.approx(52.0)
    assert np.degrees(np.arctan2(top[0], top[1])) % 360 == pytest.approx(201.0)


@pytest.mark.parametrize("stamp", ["1e308", "-9e18", "inf", ""])
def test_gnsslogger_a_bad_time_since_boot_is_missing_and_counted(
    tmp_path: Path, walk: PhoneWalk, stamp: str
) -> None:
    """The row keeps its place by UTC, and all others keep the exact clock."""
    path = samples.gnsslogger_v3(tmp_path / "gnss_log_2026_03_09.txt", walk)
    lines = path.read_text().split("\n")
    bad = [i for i, line in enumerate(lines) if line.startswith("UncalGyro")][20]
    cells = lines[bad].split(",")
    lines[bad] = ",".join([*cells[:2], stamp, *cells[3:]])
    path.write_text("\n".join(lines))
    _, tables, report = read(GnssLogger(), path)
    assert report.rows_dropped == kinds(report)["other_provider"]
    assert [(f.count, f.first_line) for f in report.findings if f.kind == "missing_cell"] == [(1, bad + 1)]
    wrong = tables["/phone/gyr"]["t_ns"].to_numpy() - walk.t_ns
    wrong -= wrong[0]
    assert np.flatnonzero(wrong).tolist() in ([20], [])
    assert np.abs(wrong).max() < 1_000_000


@pytest.mark.parametrize(("platform", "inverse"), [("android", False), ("ios", False), ("ios", True)])
def test_sensor_logger_keeps_the_phones_own_orientation(
    tmp_path: Path, walk: PhoneWalk, platform: str, inverse: bool
) -> None:
    """On iOS x is north, and which way a quaternion turns is found from gravity and field; text columns are no loss."""
    folder = samples.sensor_logger(tmp_path / "log", walk, platform)
    turn = Rotation.from_quat(np.roll(walk.quat_wxyz, -1, axis=1))
    if platform == "ios":
        turn = Rotation.from_euler("z", -90, degrees=True) * turn
    given = (turn.inv() if inverse else turn).as_quat()
    rows = (
        f"{t},{s:.6f},2026-03-09 08:51:47,"
        + ",".join(f"{v:.9f}" for v in (q[2], q[1], q[0], q[3]))
        + ",0,0,0"
        for t, s, q in zip(walk.t_ns, samples.seconds(walk), given, strict=True)
    )
    head = "time,seconds_elapsed,date,qz,qy,qx,qw,roll,pitch,yaw"
    (folder / "Orientation.csv").write_text("\n".join([head, *rows, ""]))
    _, tables, report = read(SensorLogger(), folder)
    found = tables["/phone/orientation"].select("quat_w", "quat_x", "quat_y", "quat_z").to_numpy()
    assert np.abs(np.abs((found * walk.quat_wxyz).sum(axis=1)) - 1).max() < 1e-6
    assert "missing_cell" not in kinds(report)


def test_sensor_logger_leaves_out_an_orientation_that_gravity_denies(tmp_path: Path, walk: PhoneWalk) -> None:
    folder = samples.sensor_logger(tmp_path / "log", walk)
    rows = (f"{t},{s:.6f},0,0.8,0,0.6" for t, s in zip(walk.t_ns, samples.seconds(walk), strict=True))
    (folder / "Orientation.csv").write_text("\n".join(["time,seconds_elapsed,qz,qy,qx,qw", *rows, ""]))
    _, tables, report = read(SensorLogger(), folder)
    assert "/phone/orientation" not in tables
    assert kinds(report)["odd_orientation"] == len(walk.t_ns)


def test_a_line_without_times_is_no_recording(tmp_path: Path) -> None:
    line = "<LineString><coordinates>1,2,3 1.1,2,3</coordinates></LineString>"
    (tmp_path / "l.kml").write_text(f"<kml><Placemark>{line}</Placemark></kml>")
    with pytest.raises(MarchaError, match="no time"):
        read(Kml(), tmp_path / "l.kml")


def test_a_route_is_no_recording(tmp_path: Path) -> None:
    (tmp_path / "r.gpx").write_text('<gpx><rte><rtept lat="48" lon="2"/></rte></gpx>')
    with pytest.raises(MarchaError, match="no point of a track"):
        read(Gpx(), tmp_path / "r.gpx")


@pytest.mark.parametrize("app", [samples.phyphox, samples.sensor_logger])
def test_walks_in_one_zip_are_recordings_of_their_own(tmp_path: Path, walk: PhoneWalk, app: Callable) -> None:
    path = tmp_path / "walks.zip"
    with zipfile.ZipFile(path, "w") as archive:
        for name in ("one", "two"):
            (tmp_path / name / "meta").mkdir(parents=True)
            (tmp_path / name / "meta" / "notes.csv").write_text("a,b\n1,2\n")
            for file in sorted(app(tmp_path / name, walk).rglob("*.csv")):
                archive.write(file, file.relative_to(tmp_path))
    with pytest.raises(MarchaError, match=r"holds 2 recordings: one .*two .*-o FOLDER/"):
        convert(path, tmp_path / "o.mcap")
    assert not (tmp_path / "o.mcap").exists()
    with contextlib.ExitStack() as stack:
        found = logs([path], stack)
        assert [p.name for p in found.logs] == ["one", "two"]
        assert not found.skipped
        for folder in found.logs:
            done = convert(folder, tmp_path / f"{folder.name}.mcap")
            assert {c.topic: c.count for c in done.channels}["/phone/acc"] == len(walk.t_ns)


@pytest.mark.parametrize("outer", ["folder", "zip"])
def test_zips_in_a_folder_or_a_zip_are_recordings_of_their_own(
    tmp_path: Path, walk: PhoneWalk, outer: str
) -> None:
    many = tmp_path / "many"
    many.mkdir()
    for name, app in (("a", samples.phyphox), ("b", samples.sensor_logger)):
        with zipfile.ZipFile(many / f"{name}.zip", "w") as archive:
            for file in sorted(app(tmp_path / name, walk).rglob("*.csv")):
                archive.write(file, file.relative_to(tmp_path))
    made(many / "photos.zip", ("a.jpg", b"x"))
    (many / "broken.zip").write_bytes(b"PK\x03\x04")
    path = many
    if outer == "zip":
        path = tmp_path / "all.zip"
        with zipfile.ZipFile(path, "w") as archive:
            for file in many.iterdir():
                archive.write(file, file.name)
        with pytest.raises(MarchaError, match=r"holds archives \(a.zip, .*-o FOLDER/"):
            convert(path, tmp_path / "o.mcap")
    with contextlib.ExitStack() as stack:
        found = logs([path], stack)
        assert [p.name for p in found.logs] == ["a.zip", "b.zip"]
        assert sorted(p.name for p, _ in found.skipped) == ["broken.zip", "photos.zip"]
        for log in found.logs:
            done = convert(log, tmp_path / f"{log.stem}.mcap")
            assert {c.topic: c.count for c in done.channels}["/phone/acc"] == len(walk.t_ns)
    if outer == "zip":
        with contextlib.ExitStack() as stack:
            found = logs([path], stack, unpack_limit_gb=path.stat().st_size / 1e9 + 1e-5)
            why = {p.name: reason for p, reason in found.skipped}
            assert "unpacks to" in why["a.zip"]  # one limit for all that lies in the archive
            assert "unpacks to" in why["b.zip"]


def test_reference_track(tmp_path: Path, walk: PhoneWalk) -> None:
    _, tables, _ = read(Gpx(), samples.gpx(tmp_path / "r.gpx", walk), role="reference")
    assert set(tables) == {"/reference/fix"}


def made(path: Path, *members: tuple[zipfile.ZipInfo | str, bytes]) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in members:
            archive.writestr(name, data)
    return path


def link() -> zipfile.ZipInfo:
    info = zipfile.ZipInfo("link.csv")
    info.external_attr = (stat.S_IFLNK | 0o777) << 16
    return info


@pytest.mark.parametrize(
    ("members", "said"),
    [
        ([("../out.csv", b"x")], "leads out"),
        ([("/etc/out.csv", b"x")], "leads out"),
        ([("a\\..\\..\\b.csv", b"x")], "leads out"),
        ([(link(), b"/etc/passwd")], "is a link"),
        ([("a.csv", b"x"), ("A.csv", b"y")], "stands twice"),
        ([("n" * 250 + ".csv", b"x")], "too long"),
        ([("big.csv", b"0" * 3_000_000)], "unpacks to"),
    ],
)
def test_archives_that_could_do_harm_are_refused(tmp_path: Path, members: list, said: str) -> None:
    path = made(tmp_path / "z.zip", *members)
    folder = tmp_path / "out"
    folder.mkdir()
    with pytest.raises(MarchaError, match=said) as caught:
        unpack(path, folder, 0.002)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "out.csv").exists()


@pytest.mark.data
def test_every_real_phone_log_has_one_format(data_dir: Path) -> None:
    found = {}
    for name in ("phone", "indoor/android_paths"):
        for path in sorted((data_dir / name).rglob("*")):
            if len(candidates := recognise(path)) >= 1:
                assert len(candidates) == 1 or candidates[0].confidence - candidates[1].confidence >= 0.1, (
                    path
                )
                found[path.relative_to(data_dir).as_posix()] = candidates[0].name
    assert found["phone/phyphox"] == found["phone/broken/phyphox_semicolon"] == "phyphox"
    assert found["phone/androsensor/Coordinates.pos"] == "rtk-pos"
    assert found["phone/steps/Nexus_Jamie_Hard_InHand_2"] == "android-ns"
    assert found["indoor/android_paths/5dd9efa99191710006b57090.txt"] == "indoor-location"


@pytest.mark.data
def test_real_findings(data_dir: Path, tmp_path: Path) -> None:
    done = convert(data_dir / "phone" / "sensortester", tmp_path / "s.mcap")
    assert {f.kind for f in done.report.findings} >= {"backwards_time", "duplicate_row", "unit_doubt"}
    for name, steps in (("Nexus_Jamie_Hard_InHand_2", 306), ("Samsung_Dario_Hard_InHand_1", 277)):
        done = convert(data_dir / "phone" / "steps" / name, tmp_path / f"{name}.mcap")
        assert {c.topic: c.count for c in done.channels}["/reference/steps"] == steps
    done = convert(data_dir / "phone" / "broken" / "phyphox_semicolon", tmp_path / "b.mcap")
    assert "outside_recording" in {f.kind for f in done.report.findings}
    with pytest.raises(MarchaError, match="spreadsheet"):
        convert(data_dir / "phone" / "broken" / "excel_rounded", tmp_path / "e.mcap")
