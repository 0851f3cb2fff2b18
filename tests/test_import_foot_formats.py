"""Importers of the other foot recordings: x-io, x-IMU, SensorConnect, Vicon MAT."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import polars as pl
import pytest
import scipy.io
from hypothesis import given
from hypothesis import strategies as st
from marcha.ingest import Import, Report
from marcha.ingest.contract import ReportBuilder
from marcha.ingest.formats.sensorconnect_csv import SensorConnectCsv
from marcha.ingest.formats.vicon_mat import ViconMat
from marcha.ingest.formats.ximu_csv import XimuCsv
from marcha.ingest.formats.xio_csv import XioCsv
from marcha.ingest.inertial import Plateau
from marcha.ingest.registry import make_options
from marcha.ingest.simulate import Walk, walk
from marcha.recording import MarchaError, UsageError
from scipy.spatial.transform import Rotation

from .contracts.importer import ImporterContract

G = 9.80665
AXES = ["acc_x", "acc_y", "acc_z", "gyr_x", "gyr_y", "gyr_z"]
XIO = (
    "Time (s),Gyroscope X (deg/s),Gyroscope Y (deg/s),Gyroscope Z (deg/s),"
    "Accelerometer X (g),Accelerometer Y (g),Accelerometer Z (g)"
)
XIMU = XIO.replace("Time (s)", "Packet number") + ",Magnetometer X (G),Magnetometer Y (G),Magnetometer Z (G)"
NODE = "inertial-1.2"
SENSORCONNECT = "Time," + ",".join(
    f"{NODE}:{field}"
    for field in (
        *(f"scaled{s}{a}" for s in ("Accel", "Gyro", "Mag") for a in "XYZ"),
        *("roll", "pitch", "yaw"),
    )
)
FOOTPRINTS = "strideIndex,timestamp,gcpX,gcpY"


def one_walk() -> Walk:
    """Return a walk whose ideal readings carry a trace of noise: a real sensor never repeats itself."""
    w = walk("straight", length_m=6, errors="none", rate_hz=200, late_share=0, acc_noise=1e-5, gyr_noise=1e-6)
    acc, gyr = w.measured()
    return replace(w, acc_b=acc, gyr_b=gyr)


def lines(header: str, rows: np.ndarray) -> bytes:
    return "\n".join([header, *(",".join(f"{v:.9g}" for v in row) for row in rows), ""]).encode()


def xio(w: Walk) -> bytes:
    return lines(XIO, np.column_stack((w.t, np.degrees(w.gyr_b), w.acc_b / G)))


def counter(n: int) -> np.ndarray:
    """Count packets as the x-IMU does: other kinds at half of the rate and once a second."""
    i = np.arange(n)
    return 3 + i + (i + 1) // 2 + i // 256


def ximu(w: Walk) -> bytes:
    n = len(w.t)
    mag = np.repeat(
        np.column_stack((np.arange(n), -np.arange(n), np.ones(n)))[: -(-n // 4)] * 1e-4 + 0.4, 4, 0
    )[:n]
    return lines(XIMU, np.column_stack((counter(n), np.degrees(w.gyr_b), w.acc_b / G, mag)))


def turned_down(v: np.ndarray) -> np.ndarray:
    """Give a vector in the axes x forward, y right, z down."""
    return v * [1, -1, -1]


def sensorconnect(w: Walk) -> bytes:
    up = Rotation.from_quat(w.quat_wxyz, scalar_first=True)
    half_turn = Rotation.from_euler("x", np.pi)
    yaw, pitch, roll = (half_turn * up * half_turn).as_euler("ZYX").T  # both frames turned to z down
    mag = np.tile([0.2, 0.0, 0.4], (len(w.t), 1))
    table = (w.t, turned_down(w.acc_b) / G, turned_down(w.gyr_b), mag, roll, pitch, yaw)
    return lines(SENSORCONNECT, np.column_stack(table))


def footprints(w: Walk) -> bytes:
    feet = w.simulation.route.footfalls
    at = [0, *np.searchsorted(w.t_ns, w.steps["end_ns"].to_numpy())]
    return lines(
        FOOTPRINTS, np.column_stack((at, w.t[at], feet[:, 0], -feet[:, 1] + 0.1 * np.arange(len(at))))
    )


def vicon(w: Walk) -> dict[str, Any]:
    return {
        "imu": np.hstack((w.acc_b, w.gyr_b)),
        "gt": w.pos * [1, -1, 1],
        "ts": w.t[None] + 0.005,
        "zv_vicon_opt": w.still[None].astype(np.int64),
        "G_vicon_opt": np.array([[0.1]]),
    }


class TestXioCsv(ImporterContract):
    importer = XioCsv()

    def sample(self, folder: Path) -> Path:
        (path := folder / "short_walk.csv").write_bytes(xio(one_walk()))
        return path


class TestXimuCsv(ImporterContract):
    importer = XimuCsv()
    options: ClassVar = {"rate_hz": 200}

    def sample(self, folder: Path) -> Path:
        (path := folder / "stairs_CalInertialAndMag.csv").write_bytes(ximu(one_walk()))
        return path


class TestSensorConnectCsv(ImporterContract):
    importer = SensorConnectCsv()

    def sample(self, folder: Path) -> Path:
        (folder / "log_strideIndex_timestamp_gcpX_gcpY.csv").write_bytes(footprints(one_walk()))
        (path := folder / "log.csv").write_bytes(sensorconnect(one_walk()))
        return path


class TestViconMat(ImporterContract):
    importer = ViconMat()

    def sample(self, folder: Path) -> Path:
        scipy.io.savemat(path := folder / "walk.mat", vicon(one_walk()))
        return path


def read(importer: Any, *paths: Path, **options: Any) -> tuple[Import, dict[str, pl.DataFrame], Report]:
    imported = importer.read(list(paths), make_options(importer, options))
    parts: dict[str, list[pl.DataFrame]] = {}
    for topic, table in imported.blocks():
        parts.setdefault(topic, []).append(table)
    return imported, {t: pl.concat(p) for t, p in parts.items()}, imported.report


def findings(report: Report) -> dict[str, int]:
    out: dict[str, int] = {}
    for f in report.findings:
        out[f.kind] = out.get(f.kind, 0) + f.count
    return out


@pytest.fixture
def truth() -> Walk:
    return one_walk()


def test_xio_gives_the_walk_in_si(tmp_path: Path, truth: Walk) -> None:
    (path := tmp_path / "w.csv").write_bytes(xio(truth))
    _, tables, report = read(XioCsv(), path)
    imu = tables["/foot/imu"]
    np.testing.assert_array_equal(imu["t_ns"], np.round(truth.t * 1e9).astype(np.int64))
    np.testing.assert_allclose(imu.select(AXES), np.hstack((truth.acc_b, truth.gyr_b)), atol=1e-6, rtol=1e-7)
    assert report.findings == []


def test_xio_units_come_from_the_header(tmp_path: Path) -> None:
    header = XIO.replace("Time (s)", "Timestamp (us)").replace("deg/s", "rad/s").replace("(g)", "(m/s^2)")
    (path := tmp_path / "w.csv").write_text(f"{header}\n1000000,1,2,3,4,5,6\n1010000,1,2,3,4,5,7\n")
    _, tables, _ = read(XioCsv(), path)
    assert tables["/foot/imu"].rows()[1] == (1_010_000_000, 4, 5, 7, 1, 2, 3)


def test_xio_doubled_rows_are_dropped_and_gaps_found(tmp_path: Path, truth: Walk) -> None:
    rows = xio(truth).splitlines()
    cut = rows[:100] + rows[140:]
    (path := tmp_path / "w.csv").write_bytes(b"\n".join([*cut[:50], cut[49], *cut[50:], cut[-1]]) + b"\n")
    _, tables, report = read(XioCsv(), path)
    assert len(tables["/foot/imu"]) == len(cut) - 1
    assert findings(report) == {"duplicate_row": 2, "gap": 1}
    assert {f.kind: f.first_line for f in report.findings} == {"duplicate_row": 51, "gap": 102}
    assert (report.rows_read, report.rows_kept, report.rows_dropped) == (len(cut) + 1, len(cut) - 1, 2)


def test_xio_arbitrary_magnetometer_units_are_left_out_and_said(tmp_path: Path) -> None:
    header = XIO + "".join(f",Magnetometer {a} (a.u.)" for a in "XYZ")
    (path := tmp_path / "w.csv").write_text(f"{header}\n0,1,2,3,0,0,1,.5,.5,.5\n.01,1,2,4,0,0,1,.5,.5,.5\n")
    imported, tables, report = read(XioCsv(), path)
    assert [c.topic for c in imported.channels] == list(tables) == ["/foot/imu"]
    assert findings(report)["unused_column"] == 3


def test_an_incomplete_gyroscope_is_said_and_not_computed_with(tmp_path: Path) -> None:
    header = XIO.replace(",Gyroscope Z (deg/s)", "")
    (path := tmp_path / "w.csv").write_text(f"{header}\n0,1,2,0,0,1\n.01,1,2,0,0,1\n")
    _, tables, report = read(XioCsv(), path)
    assert tables["/foot/imu"].columns == ["t_ns", "acc_x", "acc_y", "acc_z"]
    assert findings(report)["unused_column"] == 2


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            XIO.replace("(g)", "(lb)") + "\n0,1,2,3,0,0,1\n",
            r"line 1: column 'Accelerometer X \(lb\)': unit 'lb'",
        ),
        (XIO + "\n", "ends before its first row|no row of numbers"),
        (XIO + ",Gyroscope X (deg/s)\n0,1,2,3,0,0,1,1\n", "stands twice"),
        (
            "Time (s),Gyroscope X (deg/s),Accelerometer X (g)\n0,1,2\n",
            "neither an accelerometer nor a gyroscope",
        ),
    ],
)
def test_a_file_that_cannot_be_read_is_one_line(text: str, words: str, tmp_path: Path) -> None:
    (path := tmp_path / "w.csv").write_text(text)
    with pytest.raises(MarchaError, match=words) as caught:
        read(XioCsv(), path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_damaged_rows_are_dropped_and_cells_become_nan(tmp_path: Path, truth: Walk) -> None:
    rows = xio(truth).splitlines()
    rows[10] = b"1,2,3"
    rows[20] = rows[20].rsplit(b",", 1)[0] + b",banana"
    rows[30] = rows[30].rsplit(b",", 1)[0] + b","
    rows[40] = b"x" + rows[40]
    (path := tmp_path / "w.csv").write_bytes(b"\r\n\r\n".join(rows))
    _, tables, report = read(XioCsv(), path)
    imu = tables["/foot/imu"]
    assert len(imu) == len(truth.t) - 2
    assert imu["acc_z"].is_nan().sum() == 2
    assert (report.rows_dropped, report.rows_repaired) == (2, 1)
    assert any("'banana' is not a number" in f.detail for f in report.findings)
    assert {(f.kind, f.first_line) for f in report.findings} >= {
        ("bad_row", 21),
        ("missing_cell", 41),
    }


def test_clipping_is_found_where_the_full_scale_is_unknown(tmp_path: Path, truth: Walk) -> None:
    clipped = np.clip(truth.acc_b / G, -2, 2)
    assert (np.abs(clipped) == 2).sum() > 5
    table = np.column_stack((truth.t, np.degrees(truth.gyr_b), clipped * 0.99))
    (path := tmp_path / "w.csv").write_bytes(lines(XIO, table))
    _, _, report = read(XioCsv(), path)
    assert findings(report)["clipped"] == (np.abs(clipped) == 2).sum()
    assert report.lossy


def test_clipping_is_counted_over_blocks() -> None:
    report = ReportBuilder()
    plateau = Plateau(report, "/foot/imu", ["acc_x"])
    for first, block in ((1, [1.0, 2 * G]), (3, [2 * G, 0.0]), (5, [2 * G, -1.0])):
        plateau.feed([np.array(block)], np.array([first, first + 1]))
    plateau.finish()
    found = report.build().findings
    assert [(f.kind, f.count, f.first_line) for f in found] == [("clipped", 3, 2)]


def test_ximu_time_is_the_assumed_rate_not_the_counter(tmp_path: Path, truth: Walk) -> None:
    (path := tmp_path / "w.csv").write_bytes(ximu(truth))
    for options, rate in (({}, 256), ({"rate_hz": "100"}, 100)):
        _, tables, report = read(XimuCsv(), path, **options)
        expected = np.round(np.arange(len(truth.t)) * 1e9 / rate).astype(np.int64)
        np.testing.assert_array_equal(tables["/foot/imu"]["t_ns"], expected)
        assert f"1/{rate} s" in next(f.detail for f in report.findings if f.kind == "assumed_rate")
        assert "gap" not in findings(report)


def test_ximu_lost_packets_move_the_time(tmp_path: Path, truth: Walk) -> None:
    rows = ximu(truth).splitlines()
    (path := tmp_path / "w.csv").write_bytes(b"\n".join(rows[:201] + rows[241:]) + b"\n")
    _, tables, report = read(XimuCsv(), path)
    expected = np.delete(np.round(np.arange(len(truth.t)) * 1e9 / 256), slice(200, 240))
    off = (tables["/foot/imu"]["t_ns"].to_numpy() - expected) * 256e-9
    assert not off[:200].any()
    np.testing.assert_allclose(off[200:], 0, atol=0.01)
    gap = next(f for f in report.findings if f.kind == "gap")
    assert (gap.count, gap.first_line) == (1, 202)
    assert report.lossy


def test_ximu_the_fewest_lost_packets_that_are_sure(tmp_path: Path, truth: Walk) -> None:
    rows = ximu(truth).splitlines()
    (path := tmp_path / "w.csv").write_bytes(b"\n".join(rows[:201] + rows[204:]) + b"\n")  # a step of 6
    _, tables, report = read(XimuCsv(), path)
    assert findings(report)["gap"] == 1
    assert tables["/foot/imu"]["t_ns"][200] == round(203 * 1e9 / 256)


@pytest.mark.filterwarnings("error")
def test_ximu_a_counter_that_falls_is_found_without_a_warning(tmp_path: Path, truth: Walk) -> None:
    rows = [row.split(b",", 1)[1] for row in ximu(truth).splitlines()[:6]]
    counters = (b"Packet number", b"3", b"5", b"0", b"-4", b"-9")
    (path := tmp_path / "w.csv").write_bytes(
        b"\n".join(map(b",".join, zip(counters, rows, strict=True))) + b"\n"
    )
    assert findings(read(XimuCsv(), path)[2])["backwards_time"] == 3


def test_ximu_a_single_lost_packet_proves_nothing(tmp_path: Path, truth: Walk) -> None:
    rows = ximu(truth).splitlines()
    (path := tmp_path / "w.csv").write_bytes(b"\n".join(rows[:201] + rows[202:]) + b"\n")
    assert "gap" not in findings(read(XimuCsv(), path)[2])


def test_ximu_doubled_row_is_dropped_and_takes_no_time(tmp_path: Path, truth: Walk) -> None:
    rows = ximu(truth).splitlines()
    (path := tmp_path / "w.csv").write_bytes(b"\n".join([*rows[:50], rows[49], *rows[50:]]) + b"\n")
    _, tables, report = read(XimuCsv(), path)
    assert len(tables["/foot/imu"]) == len(truth.t)
    assert tables["/foot/imu"]["t_ns"][-1] == round((len(truth.t) - 1) * 1e9 / 256)
    assert findings(report)["duplicate_row"] == 1


def test_ximu_magnetometer_in_tesla_without_its_repeats(tmp_path: Path, truth: Walk) -> None:
    (path := tmp_path / "w.csv").write_bytes(ximu(truth))
    _, tables, report = read(XimuCsv(), path)
    n = len(truth.t)
    fresh = -(-n // 4)
    expected = (np.column_stack((np.arange(fresh), -np.arange(fresh), np.ones(fresh))) * 1e-4 + 0.4) * 1e-4
    np.testing.assert_allclose(tables["/foot/mag"].drop("t_ns"), expected, rtol=1e-7)
    np.testing.assert_array_equal(tables["/foot/mag"]["t_ns"], tables["/foot/imu"]["t_ns"].to_numpy()[::4])
    assert findings(report)["stale_repeat"] == n - fresh


def test_sensorconnect_gives_body_axes_and_attitude_against_z_up(tmp_path: Path, truth: Walk) -> None:
    (path := tmp_path / "w.csv").write_bytes(sensorconnect(truth))
    imported, tables, report = read(SensorConnectCsv(), path)
    imu = tables["/foot/imu"]
    np.testing.assert_allclose(imu.select("acc_x", "acc_y", "acc_z"), turned_down(truth.acc_b), atol=1e-6)
    np.testing.assert_allclose(imu.select("gyr_x", "gyr_y", "gyr_z"), turned_down(truth.gyr_b), atol=1e-8)
    rot_nb = Rotation.from_quat(
        imu.select("quat_w", "quat_x", "quat_y", "quat_z").to_numpy(), scalar_first=True
    )
    force = rot_nb[:500].apply(turned_down(truth.acc_b[:500]))  # at rest
    np.testing.assert_allclose(force, np.tile([0, 0, 9.81], (500, 1)), atol=1e-3)
    forward = rot_nb.apply([1, 0, 0])
    expected = Rotation.from_quat(truth.quat_wxyz, scalar_first=True).apply([1, 0, 0])
    np.testing.assert_allclose(forward, expected, atol=1e-6)
    np.testing.assert_allclose(tables["/foot/mag"].row(0)[1:], (2e-5, 0, 4e-5))
    assert report.findings == []
    assert "truth" not in imported.metadata


def test_sensorconnect_estimated_columns_and_their_flags(tmp_path: Path, truth: Walk) -> None:
    acc, gyr = turned_down(truth.acc_b), turned_down(truth.gyr_b)
    valid = np.ones(len(truth.t))
    valid[100:103] = 0
    fields = [f"estCompensatedAccel{a}" for a in "XYZ"] + [f"estAngularRate{a}" for a in "XYZ"]
    names = ["Time", *(f"n:{f}{end}" for f in fields for end in ("", ":valid"))]
    values = [truth.t]
    for k, column in enumerate((*acc.T, *gyr.T)):
        values += [column, valid if k == 3 else np.ones(len(valid))]
    (path := tmp_path / "w.csv").write_bytes(lines(",".join(names), np.column_stack(values)))
    _, tables, report = read(SensorConnectCsv(), path)
    imu = tables["/foot/imu"]
    np.testing.assert_allclose(imu.select("acc_x", "acc_y", "acc_z"), acc, atol=1e-6)
    got = imu.select("gyr_x", "gyr_y", "gyr_z").to_numpy()
    assert np.isnan(got[100:103, 0]).all()
    np.testing.assert_allclose(
        np.delete(got, slice(100, 103), axis=0), np.delete(gyr, slice(100, 103), axis=0)
    )
    assert findings(report)["invalid_value"] == 3


@pytest.mark.parametrize("way", ["beside", "option", "second input"])
def test_sensorconnect_footprints(tmp_path: Path, truth: Walk, way: str) -> None:
    (path := tmp_path / "w.csv").write_bytes(sensorconnect(truth))
    name = "w_strideIndex_timestamp_gcpX_gcpY.csv" if way == "beside" else "prints.csv"
    (prints := tmp_path / name).write_bytes(footprints(truth))
    paths = [path, prints] if way == "second input" else [path]
    options = {"footprints": str(prints)} if way == "option" else {}
    imported, tables, report = read(SensorConnectCsv(), *paths, **options)
    channel = tables["/reference/footprints"]
    feet = truth.simulation.route.footfalls
    np.testing.assert_allclose(channel["pos_x"], feet[:, 0], atol=1e-6)
    np.testing.assert_allclose(channel["pos_y"], feet[:, 1] - 0.1 * np.arange(len(feet)), atol=1e-6)
    assert findings(report) == {"mirrored_reference": len(feet)}
    assert imported.metadata["truth"]["closed"] == "false"
    length = np.hypot(np.diff(feet[:, 0]), 0.1).sum()
    assert float(imported.metadata["truth"]["length_m"]) == pytest.approx(length, rel=1e-5)


def test_sensorconnect_footprints_of_another_walk_are_said(tmp_path: Path, truth: Walk) -> None:
    (path := tmp_path / "w.csv").write_bytes(sensorconnect(truth))
    (tmp_path / "w_prints.csv").write_text(f"{FOOTPRINTS}\n1,1.0,0,0\n900,900.0,1,0\n")
    report = read(SensorConnectCsv(), path, mirror="none")[2]
    assert findings(report) == {"reference_outside": 1}


def test_sensorconnect_damaged_footprints_are_one_line(tmp_path: Path, truth: Walk) -> None:
    (path := tmp_path / "w.csv").write_bytes(sensorconnect(truth))
    (tmp_path / "w_prints.csv").write_text(f"{FOOTPRINTS}\n1,1.0,0,0\n2,2.0,1,0\n3,1.5,1,0\n")
    with pytest.raises(MarchaError, match=r"w_prints\.csv, line 4: timestamp does not grow"):
        read(SensorConnectCsv(), path)


def test_sensorconnect_of_two_nodes_asks_which(tmp_path: Path) -> None:
    columns = [f"{n}:scaledAccel{a}" for n in ("left", "right") for a in "XYZ"]
    rows = "0,1,0,0,0,0,1\n0.01,1,0,0,0,0,1\n"
    (path := tmp_path / "w.csv").write_text(f"DATA_START\nTime,{','.join(columns)}\n{rows}")
    with pytest.raises(UsageError, match="choose one with node=: left, right"):
        read(SensorConnectCsv(), path)
    _, tables, report = read(SensorConnectCsv(), path, node="right")
    assert tables["/foot/imu"].row(0) == (0, 0.0, 0.0, G)
    assert findings(report)["unused_column"] == 3


def test_vicon_gives_the_walk_and_turns_the_mirror(tmp_path: Path, truth: Walk) -> None:
    scipy.io.savemat(path := tmp_path / "w.mat", vicon(truth))
    _, tables, report = read(ViconMat(), path)
    np.testing.assert_array_equal(
        tables["/foot/imu"]["t_ns"], np.round((truth.t + 0.005) * 1e9).astype(np.int64)
    )
    np.testing.assert_array_equal(tables["/foot/imu"].select(AXES), np.hstack((truth.acc_b, truth.gyr_b)))
    np.testing.assert_array_equal(tables["/reference/pose"].drop("t_ns"), truth.pos)
    np.testing.assert_array_equal(tables["/reference/stance"]["still"], truth.still)
    assert findings(report)["mirrored_reference"] == len(truth.t)
    _, raw, report = read(ViconMat(), path, mirror="none")
    np.testing.assert_array_equal(raw["/reference/pose"]["pos_y"], -truth.pos[:, 1])
    assert "mirrored_reference" not in findings(report)


def test_vicon_unseen_positions_are_left_out(tmp_path: Path, truth: Walk) -> None:
    content = vicon(truth)
    content["gt"][100:110, 1] = np.nan
    del content["zv_vicon_opt"]
    scipy.io.savemat(path := tmp_path / "w.mat", content)
    imported, tables, report = read(ViconMat(), path)
    assert len(tables["/reference/pose"]) == len(truth.t) - 10 == len(tables["/foot/imu"]) - 10
    assert findings(report)["missing_cell"] == 10
    assert [c.topic for c in imported.channels] == ["/foot/imu", "/reference/pose"]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"gt": None}, "no variable 'gt'"),
        ({"imu": np.zeros((3, 6))}, "variable 'imu' is 3 × 6; it must be"),
        ({"ts": np.array([["a"]])}, "variable 'ts' is no table of numbers"),
        ({"ts": np.full((1, 5), np.nan), "imu": np.zeros((5, 6)), "gt": np.zeros((5, 3))}, r"ts\[0\] is nan"),
    ],
)
def test_vicon_with_other_content_is_one_line(change: dict, words: str, tmp_path: Path, truth: Walk) -> None:
    content = {k: v for k, v in (vicon(truth) | change).items() if v is not None}
    scipy.io.savemat(path := tmp_path / "w.mat", content)
    with pytest.raises(MarchaError, match=words) as caught:
        read(ViconMat(), path)
    assert str(caught.value).startswith(str(path))


def test_a_matlab_7_3_file_says_what_to_do(tmp_path: Path) -> None:
    head = b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM"
    (path := tmp_path / "w.mat").write_bytes(head + bytes(400))
    with pytest.raises(MarchaError, match="HDF5"):
        read(ViconMat(), path)


@given(
    cut=st.integers(0, 5000),
    junk=st.binary(max_size=12),
    sort=st.sampled_from(["xio", "ximu", "sensorconnect"]),
)
def test_any_damage_is_a_finding_or_one_line(
    cut: int, junk: bytes, sort: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.mktemp("damaged") / "w.csv"
    make, importer = {
        "xio": (xio, XioCsv()),
        "ximu": (ximu, XimuCsv()),
        "sensorconnect": (sensorconnect, SensorConnectCsv()),
    }[sort]
    data = b"\n".join(make(SHORT).splitlines()[:60]) + b"\n"
    path.write_bytes(data[: cut % len(data)] + junk + data[cut % len(data) :])
    try:
        _, tables, report = read(importer, path)
    except MarchaError as error:
        line = str(error)
        assert "\n" not in line
        return
    assert report.rows_read == report.rows_kept + report.rows_dropped
    assert all(t["t_ns"].is_sorted() for t in tables.values())


SHORT = walk("still", duration_s=0.5)


@pytest.mark.data
def test_real_xio(data_dir: Path) -> None:
    _, tables, report = read(XioCsv(), data_dir / "foot/xio/short_walk.csv")
    assert (report.rows_read, report.rows_kept, findings(report)["duplicate_row"]) == (16539, 16334, 205)
    t = tables["/foot/imu"]["t_ns"].to_numpy()
    assert 1e9 / np.median(np.diff(t)) == pytest.approx(398.3, abs=0.5)
    assert findings(report)["gap"] == (np.diff(t) > 1.8 * np.median(np.diff(t))).sum()


@pytest.mark.data
def test_real_ximu(data_dir: Path) -> None:
    path = data_dir / "foot/stairs/spiralStairs_CalInertialAndMag.csv"
    _, tables, report = read(XimuCsv(), path)
    assert len(tables["/foot/imu"]) == report.rows_kept == 13420
    assert tables["/foot/imu"]["t_ns"][-1] == round(13419 * 1e9 / 256)
    assert "gap" not in findings(report)
    assert findings(report)["clipped"] == 35  # at ±7.84 and −7.99 g
    assert np.linalg.norm(tables["/foot/mag"].row(0)[1:]) == pytest.approx(73e-6, abs=3e-6)


@pytest.mark.data
def test_real_sensorconnect(data_dir: Path) -> None:
    imported, tables, report = read(SensorConnectCsv(), data_dir / "foot/footprints/SensorConnectData_31.csv")
    assert len(tables["/foot/imu"]) == report.rows_kept == 8549
    assert len(tables["/reference/footprints"]) == 34
    assert imported.metadata["truth"]["length_m"] == "47.8547"
    imu = tables["/foot/imu"][:200]
    rot_nb = Rotation.from_quat(
        imu.select("quat_w", "quat_x", "quat_y", "quat_z").to_numpy(), scalar_first=True
    )
    force = rot_nb.apply(imu.select("acc_x", "acc_y", "acc_z").to_numpy()).mean(axis=0)
    np.testing.assert_allclose(force, [0, 0, 9.8], atol=0.25)


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "rows", "held"), [("2017-11-22-11-25-20", 5323, 2), ("2018-02-22-10-10-56", 3247, 270)]
)
def test_real_vicon(data_dir: Path, name: str, rows: int, held: int) -> None:
    _, tables, report = read(ViconMat(), data_dir / f"foot/vicon/{name}.mat")
    assert {t: len(f) for t, f in tables.items()} == dict.fromkeys(
        ("/foot/imu", "/reference/pose", "/reference/stance"), rows
    )
    assert findings(report) == {"mirrored_reference": rows, "stale_repeat": held}
    assert tables["/reference/stance"]["still"][:100].all()
