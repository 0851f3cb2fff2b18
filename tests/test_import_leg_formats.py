"""Importers of legs: contracts on simulated captures, facts of real ones, and one line for what is wrong."""

from __future__ import annotations

from pathlib import Path

import marcha.recording as mr
import numpy as np
import polars as pl
import pytest
from marcha.ingest import convert
from marcha.ingest.formats.angles import Angles
from marcha.ingest.formats.exo_csv import ExoCsv
from marcha.ingest.formats.segments_csv import SegmentsCsv
from marcha.ingest.formats.trc import Trc
from marcha.ingest.formats.xsens_text import XsensText
from marcha.ingest.matfile import read_mat
from marcha.ingest.simulate import leg, simulate
from marcha.recording import MarchaError

from .contracts.importer import ImporterContract


class TestExoCsv(ImporterContract):
    importer = ExoCsv()

    def sample(self, folder: Path) -> Path:
        return simulate("squats", folder, seed=1, overwrite=True, duration_s=10, noise="mems").paths[0]


class TestTrc(ImporterContract):
    importer = Trc()

    def sample(self, folder: Path) -> Path:
        return simulate("squats", folder, seed=1, overwrite=True, duration_s=6).paths[1]


class TestSegmentsCsv(ImporterContract):
    importer = SegmentsCsv()

    def sample(self, folder: Path) -> Path:
        s = leg("squats", seed=1, duration_s=10, noise="mems").segments["thigh"]
        columns = {
            f"thigh_{k}_{a}": v[:, j]
            for k, v in (("acc", s.acc_b), ("gyr", s.gyr_b))
            for j, a in enumerate("xyz")
        }
        path = folder / "imu.csv"
        path.write_text("# sampling frequency: 50\n" + pl.DataFrame(columns).write_csv())
        return path


class TestXsensText(ImporterContract):
    importer = XsensText()

    def sample(self, folder: Path) -> Path:
        s = leg("squats", seed=1, duration_s=10, noise="mems").segments["thigh"]
        table = {"PacketCounter": (np.arange(500) + 65_400) % 65_536}
        table |= {
            f"{w}_{a}": v[:, j] for w, v in (("Acc", s.acc_b), ("Gyr", s.gyr_b)) for j, a in enumerate("XYZ")
        }
        path = folder / "MT_012005D6_00B421AF.txt"
        path.write_text("// Update Rate: 50.0Hz\n" + pl.DataFrame(table).write_csv(separator="\t"))
        return path


class TestAngles(ImporterContract):
    importer = Angles()

    def sample(self, folder: Path) -> Path:
        capture = leg("squats", seed=1, duration_s=10)
        table = pl.DataFrame({"time": capture.t, "knee_deg": np.degrees(capture.joints["knee"].angle)})
        path = folder / "angles.csv"
        path.write_text(table.write_csv())
        return path


EXACT = {"noise": "none", "encoder_noise_deg": 0, "encoder_counts": 0, "mount_deg": 0}


def kinds(made: object) -> set[str]:
    return {f.kind for f in made.report.findings}  # pyright: ignore[reportAttributeAccessIssue]


@pytest.mark.data
def test_half_a_capture_says_that_it_is_cut_off(data_dir: Path, tmp_path: Path) -> None:
    pytest.importorskip("ezc3d")
    for name, whole, there in (("walking2.c3d", 1249, 621), ("walk_free_01.trc", 900, 37)):
        data = (data_dir / "leg" / "optical_formats" / name).read_bytes()
        (tmp_path / name).write_bytes(data[: len(data) // 2])
        report = convert(tmp_path / name, tmp_path / f"{name}.mcap").report
        (doubt,) = [f.detail for f in report.findings if f.kind == "header_doubt"]
        assert str(whole) in doubt
        assert str(there) in doubt
        assert report.lossy


def test_an_orientation_that_no_row_has_is_an_empty_channel(tmp_path: Path) -> None:
    """The only row was cut off behind its first orientation."""
    head = "DataType=Quaternion\nversion=3\nendheader\ntime\tpelvis_imu\ttorso_imu\n"
    (tmp_path / "a.sto").write_text(f"{head}417\t1,0,0,0\t0.4,0.5")
    done = convert(tmp_path / "a.sto", tmp_path / "r.mcap")
    assert [c.count for c in done.channels] == [1, 0]
    assert {f.kind for f in done.report.findings} == {"no_rotation"}


def test_a_count_of_5000_digits_in_a_head_is_doubted(tmp_path: Path) -> None:
    path = TestTrc().sample(tmp_path)
    path.write_text(path.read_text().replace("\t601\t", f"\t{'9' * 5000}\t", 1))
    findings = convert(path, tmp_path / "r.mcap").report.findings
    assert [f.detail for f in findings if f.kind == "header_doubt"] == [
        f"NumFrames is {'9' * 20}, but there are 601 rows"
    ]


@pytest.mark.parametrize(
    ("name", "head"),
    [
        (
            "a.trc",
            "PathFileType\t4\t(X/Y/Z)\ta.trc\nDataRate\tUnits\n100\tmm\nFrame#\tTime\thip\n\t\tX1\tY1\tZ1\n",
        ),
        ("a.sto", "DataType=Quaternion\nversion=3\nendheader\ntime\tpelvis_imu\n"),
    ],
)
def test_a_capture_without_a_row_is_said(tmp_path: Path, name: str, head: str) -> None:
    (tmp_path / name).write_text(head)
    with pytest.raises(MarchaError, match="no row"):
        convert(tmp_path / name, tmp_path / "r.mcap")


def test_a_capture_and_its_markers_are_one_recording_on_two_clocks(tmp_path: Path) -> None:
    made = simulate("walking", tmp_path, seed=2, duration_s=20, optical_offset_s=1.5, noise="mems")
    done = convert(made.paths, tmp_path / "r.mcap")
    rec = mr.open(tmp_path / "r.mcap")
    assert {c.topic for c in done.channels} >= {
        "/leg/thigh/imu",
        "/leg/encoder",
        "/reference/markers",
        "/reference/joint",
    }
    assert rec.metadata["clocks"]["/reference/markers"] == "walking-002.trc"
    assert rec.metadata["clocks"]["/leg/shank/imu"] == "walking-002.csv"
    truth = leg("walking", seed=2, duration_s=20, noise="mems").joints["knee"].angle
    assert np.abs(rec.table("/reference/joint")["knee"].to_numpy() - truth).max() < 1e-9
    assert not kinds(done) & {"swapped", "mirrored", "upside_down", "still_sensor"}


def edited(tmp_path: Path, change: dict[str, pl.Expr], scenario: str = "walking") -> set[str]:
    log = simulate(scenario, tmp_path, seed=3, duration_s=30, noise="mems").paths[0]
    pl.read_csv(log).with_columns(**change).write_csv(log)
    return kinds(convert(log, tmp_path / "r.mcap"))


def swap(a: str, b: str) -> dict[str, pl.Expr]:
    names = [f"{k}_{x}" for k in ("acc", "gyr") for x in "xyz"]
    return {f"{s}_{n}": pl.col(f"{o}_{n}") for s, o in ((a, b), (b, a)) for n in names}


@pytest.mark.parametrize("scenario", ["walking", "squats"])
def test_swapped_segments_are_found(tmp_path: Path, scenario: str) -> None:
    assert "swapped" in edited(tmp_path, swap("thigh", "shank"), scenario)


def test_a_mirrored_sensor_is_found(tmp_path: Path) -> None:
    change = {"shank_acc_y": -pl.col("shank_acc_y"), "shank_gyr_y": -pl.col("shank_gyr_y")}
    assert "mirrored" in edited(tmp_path, change, "squats")


def test_an_upside_down_sensor_is_found(tmp_path: Path) -> None:
    change = {f"thigh_{k}_{a}": -pl.col(f"thigh_{k}_{a}") for k in ("acc", "gyr") for a in "yz"}
    assert "upside_down" in edited(tmp_path, change)


def test_a_dead_sensor_is_found(tmp_path: Path) -> None:
    zero = {f"thigh_{k}_{a}": pl.lit(0.0) for k in ("acc", "gyr") for a in "xyz"}
    assert "all_zero" in edited(tmp_path, zero)


def test_a_sensor_that_is_missing_for_a_stretch_is_found(tmp_path: Path) -> None:
    hole = pl.when(pl.col("time").is_between(10, 12)).then(None)
    change = {
        f"thigh_{k}_{a}": hole.otherwise(pl.col(f"thigh_{k}_{a}")) for k in ("acc", "gyr") for a in "xyz"
    }
    assert "sensor_gap" in edited(tmp_path, change)


def test_an_encoder_that_jumps_by_a_turn_goes_on(tmp_path: Path) -> None:
    log = simulate("squats", tmp_path, seed=3, duration_s=12, **EXACT).paths[0]
    table = pl.read_csv(log)
    table.with_columns(knee_enc=pl.col("knee_enc") - 360 * (pl.col("time") > 5)).write_csv(log)
    done = convert(log, tmp_path / "r.mcap")
    assert "angle_wrap" in kinds(done)
    read = mr.open(tmp_path / "r.mcap").table("/leg/encoder")["knee"].to_numpy()
    assert read == pytest.approx(np.radians(table["knee_enc"].to_numpy()), abs=1e-9)


def test_a_mounting_is_applied_and_said(tmp_path: Path) -> None:
    log = simulate("squats", tmp_path, seed=3, duration_s=10, **EXACT).paths[0]
    mapping = log.with_suffix(".toml")
    units = 'units = { acc = "m/s2", gyr = "rad/s" }\n'
    mapping.write_text(units + "[segment.thigh]\nmounting_deg = [0, 0, 90]\n")
    convert(log, tmp_path / "r.mcap")
    rec, raw = mr.open(tmp_path / "r.mcap"), pl.read_csv(log)
    got = rec.table("/leg/thigh/imu")
    assert got["acc_y"].to_numpy() == pytest.approx(raw["thigh_acc_x"].to_numpy(), abs=1e-9)
    assert rec.channels["/leg/thigh/imu"].metadata["mounting_wxyz"].startswith("0.707")


@pytest.mark.parametrize("share", [0.02, 0.3, 0.7, 0.99])
def test_a_cut_matlab_file_is_one_line(tmp_path: Path, share: float) -> None:
    from scipy.io import savemat

    path = tmp_path / "a.mat"
    savemat(path, {"imu": np.ones((50, 6)), "ts": np.arange(50.0)}, do_compression=share > 0.5)
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    try:
        read_mat(path, {"imu", "ts"})
    except MarchaError as error:
        assert "\n" not in str(error)  # noqa: PT017 - a cut between variables is whole


def test_any_damaged_byte_of_a_matlab_file_is_survived(tmp_path: Path) -> None:
    from scipy.io import savemat

    path, rng = tmp_path / "a.mat", np.random.default_rng(0)
    savemat(path, {"imu": rng.random((20, 6)), "ts": np.arange(20.0), "word": "text"})
    whole = path.read_bytes()
    assert np.array_equal(read_mat(path, {"ts"})["ts"].values.ravel(), np.arange(20.0))  # pyright: ignore
    for _ in range(300):
        data = bytearray(whole)
        for at in rng.integers(0, len(data), 3):
            data[at] = rng.integers(0, 256)
        path.write_bytes(data)
        try:
            read_mat(path, {"imu", "ts"})
        except MarchaError as error:
            assert "\n" not in str(error)  # noqa: PT017 - most changes only change a value


@pytest.mark.data
@pytest.mark.parametrize(
    ("files", "topics"),
    [
        (
            ["chain_optical/imu_rigid.csv", "chain_optical/omc.csv"],
            {"/leg/seg5/imu": 2650, "/reference/markers": 1988},
        ),
        (["mpu6050_encoder/raw_roll_slow.mat"], {"/leg/imu1/imu": 149_741, "/leg/encoder": 149_741}),
        (["optical_formats/walk_free_01.trc"], {"/reference/markers": 73}),
        (["optical_formats/walking2.c3d"], {"/reference/markers": 1249}),
        (
            [f"xsens_pair/MT_012005D6_031-000_{k}.txt" for k in ("00B421AF", "00B4227B")],
            {"/leg/imu_00b421af/imu": 3369, "/leg/imu_00b4227b/orientation": 3369},
        ),
    ],
)
def test_real_captures(data_dir: Path, tmp_path: Path, files: list[str], topics: dict[str, int]) -> None:
    done = convert([data_dir / "leg" / f for f in files], tmp_path / "r.mcap")
    counts = {c.topic: c.count for c in done.channels}
    assert {t: counts[t] for t in topics} == topics
