"""Importers of phone logs: the contract of each, and what its format makes difficult."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

import numpy as np
import polars as pl
import pytest
from marcha.ingest import Import, Importer, Report
from marcha.ingest.formats.android_ns import AndroidNs
from marcha.ingest.formats.androsensor import AndroSensor
from marcha.ingest.formats.indoor_location import IndoorLocation
from marcha.ingest.formats.phyphox import Phyphox
from marcha.ingest.formats.rtk_pos import RtkPos
from marcha.ingest.formats.sensortester import SensorTester
from marcha.ingest.registry import make_options
from marcha.ingest.simulate import PhoneWalk
from marcha.recording import MarchaError

from . import phone_samples as samples
from .contracts.importer import ImporterContract

ACC = ["acc_x", "acc_y", "acc_z"]
GYR = ["gyr_x", "gyr_y", "gyr_z"]
MAG = ["mag_x", "mag_y", "mag_z"]


@pytest.fixture(scope="module")
def walk() -> PhoneWalk:
    return samples.short_walk()


def read(importer: Importer, path: Path, **options: object) -> tuple[Import, dict[str, pl.DataFrame], Report]:
    imported = importer.read([path], make_options(importer, options))
    parts: dict[str, list[pl.DataFrame]] = {}
    for topic, block in imported.blocks():
        parts.setdefault(topic, []).append(block)
    return imported, {t: pl.concat(p) for t, p in parts.items()}, imported.report


def kinds(report: Report) -> dict[str, int]:
    out: dict[str, int] = {}
    for f in report.findings:
        out[f.kind] = out.get(f.kind, 0) + f.count
    return out


class PhoneContract(ImporterContract):
    walk: ClassVar[PhoneWalk] = samples.short_walk()


class TestPhyphox(PhoneContract):
    importer = Phyphox()

    def sample(self, folder: Path) -> Path:
        return samples.phyphox(folder / "phyphox", self.walk)


class TestPhyphoxFile(PhoneContract):
    importer = Phyphox()

    def sample(self, folder: Path) -> Path:
        return samples.phyphox(folder / "one", self.walk, ";") / "Accelerometer.csv"


class TestAndroSensor(PhoneContract):
    importer = AndroSensor()

    def sample(self, folder: Path) -> Path:
        return samples.androsensor(folder / "Sensor_record.csv", self.walk)


class TestSensorTester(PhoneContract):
    importer = SensorTester()

    def sample(self, folder: Path) -> Path:
        return samples.sensortester(folder / "SensorLog.csv", self.walk)


class TestIndoorLocation(PhoneContract):
    importer = IndoorLocation()

    def sample(self, folder: Path) -> Path:
        return samples.indoor_location(folder / "path.txt", self.walk)


class TestAndroidNs(PhoneContract):
    importer = AndroidNs()

    def sample(self, folder: Path) -> Path:
        return samples.android_ns(folder / "walk", self.walk) / "accelerometer.csv"


class TestRtkPos(PhoneContract):
    importer = RtkPos()
    walk = samples.short_walk(rest_s=20)

    def sample(self, folder: Path) -> Path:
        return samples.rtk_pos(folder / "survey.pos", self.walk)


def same(table: pl.DataFrame, columns: list[str], values: np.ndarray, rel: float = 1e-6) -> bool:
    return np.allclose(table.select(columns).to_numpy(), values, rtol=rel, atol=1e-9)


@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_phyphox_gives_the_walk_in_si(tmp_path: Path, walk: PhoneWalk, separator: str) -> None:
    _, tables, report = read(Phyphox(), samples.phyphox(tmp_path / "p", walk, separator))
    assert same(tables["/phone/acc"], ACC, walk.acc_b)
    assert same(tables["/phone/gyr"], GYR, walk.gyr_b)
    assert same(tables["/phone/mag"], MAG, walk.mag_b)
    assert np.abs(tables["/phone/acc"]["t_ns"].to_numpy() - (walk.t_ns - walk.t_ns[0])).max() < 1000
    fixes = tables["/phone/gnss"]
    assert same(fixes, ["lat_deg", "lon_deg"], walk.fixes.select("lat_deg", "lon_deg").to_numpy(), 1e-12)
    assert same(fixes, ["sd_east_m"], walk.fixes.select("sd_east_m").to_numpy())
    assert not report.lossy


def test_phyphox_time_goes_on_by_the_wall_clock_over_a_pause(tmp_path: Path, walk: PhoneWalk) -> None:
    folder = samples.phyphox(tmp_path / "p", walk)
    (folder / "meta").mkdir()
    events = [
        "START,0,1750383375.135",
        "PAUSE,5,1750383380.135",
        "START,5,1750383389.035",
        "PAUSE,99,1750383483",
    ]
    rows = ["event,experiment time,system time,system time text", *(f"{e},x" for e in events)]
    (folder / "meta" / "time.csv").write_text("\n".join(rows))
    imported, tables, report = read(Phyphox(), folder)
    t = tables["/phone/acc"]["t_ns"].to_numpy()
    elapsed = samples.seconds(walk)
    assert imported.metadata["device"]["clock"] == "utc"
    assert t[0] == 1_750_383_375_135_000_000
    assert np.diff(t).max() / 1e9 == pytest.approx(8.9 - 5 + 5 + 0.02, abs=0.01)
    assert t[-1] / 1e9 == pytest.approx(1_750_383_389.035 + elapsed[-1] - 5, abs=1e-3)
    assert kinds(report)["paused_clock"] == 1


def test_phyphox_rows_of_another_measurement_are_dropped(tmp_path: Path, walk: PhoneWalk) -> None:
    folder = samples.phyphox(tmp_path / "p", walk)
    (folder / "time.csv").write_text("event,a,b\nSTART,0,1750383375\nPAUSE,6,1750383381\n")
    _, tables, report = read(Phyphox(), folder)
    elapsed = samples.seconds(walk)
    assert tables["/phone/acc"].height == (elapsed <= 6.5).sum()
    assert report.rows_dropped >= 3 * (elapsed > 6.5).sum()
    assert "outside_recording" in kinds(report)


def test_phyphox_decimal_comma_and_german_file(tmp_path: Path, walk: PhoneWalk) -> None:
    folder = samples.phyphox(tmp_path / "p", walk, ";")
    for file in folder.glob("*.csv"):
        head, _, rows = file.read_text().partition("\n")
        file.write_text(head + "\n" + rows.replace(".", ","))
    _, tables, report = read(Phyphox(), folder)
    assert same(tables["/phone/acc"], ACC, walk.acc_b)
    assert kinds(report)["decimal_comma"] >= 1


def test_phyphox_without_gravity_is_no_accelerometer(tmp_path: Path, walk: PhoneWalk) -> None:
    folder = samples.phyphox(tmp_path / "p", walk)
    (folder / "Accelerometer.csv").rename(folder / "Linear Accelerometer.csv")
    imported, tables, _ = read(Phyphox(), folder)
    assert "/phone/acc" not in tables
    spec = next(c for c in imported.channels if c.topic == "/phone/linear_acc")
    assert spec.schema == "marcha_msgs/msg/NamedValues"


def test_gravity_free_accelerometer_is_said(tmp_path: Path, walk: PhoneWalk) -> None:
    rows = np.column_stack((samples.seconds(walk), walk.acc_b - walk.acc_b.mean(axis=0)))
    header = '"Time (s)","X (m/s^2)","Y (m/s^2)","Z (m/s^2)"'
    _, _, report = read(Phyphox(), samples.table(tmp_path / "Accelerometer.csv", header, rows))
    assert kinds(report)["gravity_free"] == 1
    assert report.lossy


def test_phyphox_saved_by_a_spreadsheet_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "Accelerometer.csv"
    file.write_text(
        "timestamps,x,y,z\r\n1.00E+00,-5.68E-01,-1.73E-01,9.75E+00\r\n3.00E-01,-5.69E-01,1E-1,9.7E+00\r\n"
    )
    with pytest.raises(MarchaError, match=r"Accelerometer.csv, line 2.*3 digits.*spreadsheet"):
        read(Phyphox(), tmp_path)


def test_header_only_file_is_an_empty_channel(tmp_path: Path, walk: PhoneWalk) -> None:
    folder = samples.phyphox(tmp_path / "p", walk)
    (folder / "Gyroscope.csv").write_text('"Time (s)","X (rad/s)","Y (rad/s)","Z (rad/s)"\n')
    _, tables, report = read(Phyphox(), folder)
    assert "/phone/gyr" not in tables
    assert kinds(report)["header_only"] == 1


def test_androsensor_keeps_each_fix_once(tmp_path: Path, walk: PhoneWalk) -> None:
    imported, tables, report = read(AndroSensor(), samples.androsensor(tmp_path / "a.csv", walk))
    assert same(tables["/phone/imu"], ACC + GYR, np.hstack((walk.acc_b, walk.gyr_b)))
    assert same(tables["/phone/mag"], MAG, walk.mag_b)
    assert tables["/phone/gnss"].height == walk.fixes.height
    late = tables["/phone/gnss"]["t_ns"].to_numpy() - (walk.fixes["t_ns"].to_numpy() - walk.t_ns[0])
    assert (late >= -1e6).all() and (late < 25e6).all()  # noqa: PT018 - on the first row behind it
    assert kinds(report)["stale_repeat"] > 700
    assert imported.metadata["device"]["wall_clock_start"].startswith("2026-03-09 08:51:47:000")


def test_sensortester_pressure_and_damaged_time(tmp_path: Path, walk: PhoneWalk) -> None:
    path = samples.sensortester(tmp_path / "s.csv", walk)
    rows = path.read_text().splitlines()
    rows[200], rows[201] = rows[201], rows[200]
    rows.insert(300, rows[300])
    path.write_text("\n".join(rows))
    _, tables, report = read(SensorTester(), path)
    assert tables["/phone/pressure"]["pressure_pa"][0] == pytest.approx(93_820)
    found = kinds(report)
    assert found["unit_doubt"] == found["backwards_time"] == found["duplicate_row"] == 1
    assert report.rows_kept == len(walk.t_ns) - 1
    assert tables["/phone/imu"]["t_ns"][0] == walk.t_ns[0] // 1_000_000 * 1_000_000


def test_indoor_location_signals_and_waypoints(tmp_path: Path, walk: PhoneWalk) -> None:
    imported, tables, report = read(IndoorLocation(), samples.indoor_location(tmp_path / "i.txt", walk))
    radio = tables["/phone/radio"]
    assert radio["t_ns"].is_sorted()
    wifi = radio.filter(technology="wifi").row(0, named=True)
    assert (wifi["mac"], wifi["rssi_dbm"], wifi["frequency_hz"]) == ("16:74:9c:2b:4d:1b", -41, 5.825e9)
    assert wifi["t_ns"] - wifi["last_seen_ns"] == 300_000_000
    ble = radio.filter(technology="ble").row(0, named=True)
    assert (ble["mac"], ble["rssi_dbm"], ble["tx_power_dbm"]) == ("e0:78:a3:3d:b5:ab", -89, -56)
    assert tables["/reference/position"].select("pos_x", "pos_y").rows() == [
        (143.9522, 85.64752),
        (137.1, 88.0),
    ]
    quat = tables["/phone/orientation"].select("quat_w", "quat_x", "quat_y", "quat_z").to_numpy()
    assert np.abs((quat * walk.quat_wxyz).sum(axis=1)).min() > 1 - 1e-9
    assert kinds(report)["backwards_time"] == radio.filter(technology="ble").height
    assert imported.metadata["device"]["floor"] == "F1"
    assert "/phone/gnss" not in {c.topic for c in imported.channels}


def test_android_ns_folder_has_the_feet_as_reference(tmp_path: Path, walk: PhoneWalk) -> None:
    imported, tables, _ = read(AndroidNs(), samples.android_ns(tmp_path / "w", walk))
    assert same(tables["/phone/acc"], ACC, walk.acc_b)
    steps = tables["/reference/steps"]
    assert steps.height == walk.steps.height
    true = walk.steps["end_ns"].to_numpy() - walk.t_ns[0] + 263_415_142_248_209
    assert np.abs(steps["t_ns"].to_numpy() - true).max() < 100_000_000  # the counter looks every 97 ms
    assert imported.metadata["device"]["accelerometer"] == "MPU6515 Accelerometer"


def test_android_ns_of_unknown_sensor_asks(tmp_path: Path, walk: PhoneWalk) -> None:
    file = samples.android_ns(tmp_path / "w", walk) / "gyroscope.csv"
    other = file.rename(tmp_path / "data.csv")
    with pytest.raises(MarchaError, match="sensor=acc, gyr or mag"):
        read(AndroidNs(), other)
    assert set(read(AndroidNs(), other, sensor="gyr")[1]) == {"/phone/gyr"}


def test_rtk_survey_is_reference(tmp_path: Path, walk: PhoneWalk) -> None:
    _, tables, _ = read(RtkPos(), samples.rtk_pos(tmp_path / "c.pos", walk), sigma_m=0.02)
    fix = tables["/reference/fix"]
    assert fix["lat_deg"][0] == pytest.approx(walk.options.lat_deg, abs=1e-9)
    assert fix["lon_deg"][0] == pytest.approx(walk.options.lon_deg, abs=1e-9)
    assert fix["sd_up_m"][0] == 0.02
    assert abs(fix["t_ns"][0] - walk.t_ns[0]) < 1_000_000


def test_rtk_minus_zero_degrees(tmp_path: Path) -> None:
    rows = [f"2015-10-30 19:02:3{k}.600 51 30 0.00000 -0 30 0.00000 72.598" for k in range(5)]
    (tmp_path / "c.pos").write_text("\n".join(rows))
    assert read(RtkPos(), tmp_path / "c.pos")[1]["/reference/fix"]["lon_deg"][0] == -0.5
