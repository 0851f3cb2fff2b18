"""Sensors of any logger: headers in English and Portuguese, units, what is wrong, the knee beside its markers."""

from __future__ import annotations

from pathlib import Path

import marcha.recording as mr
import numpy as np
import pytest
from marcha.ingest import convert
from marcha.recording import MarchaError

from .c3d_files import write_c3d
from .cli_helpers import marcha
from .leg_files import xsens_and_markers
from .test_import_leg_contracts import sensor_csv, squats

X_IO = ["Time (s)"] + [
    f"{w} {a} ({u})" for w, u in (("Gyroscope", "deg/s"), ("Accelerometer", "g")) for a in "XYZ"
]
ENGLISH = "time_ms,ax_g,ay_g,az_g,gx_dps,gy_dps,gz_dps"
PORTUGUESE = "Tempo (ms);" + ";".join(
    f"{w} {a} ({u})" for w, u in (("Aceleração", "g"), ("Velocidade angular", "graus/s")) for a in "XYZ"
)


@pytest.mark.parametrize(
    "header",
    [
        ENGLISH,
        PORTUGUESE,
        "Timestamp [ms],AccX [g],AccY [g],AccZ [g],GyroX [°/s],GyroY [°/s],GyroZ [°/s]",
        "t_ms,accel_x_g,accel_y_g,accel_z_g,gyr_x_dps,gyr_y_dps,gyr_z_dps",
    ],
)
def test_headers_of_loggers(tmp_path: Path, header: str) -> None:
    """Words, separators and decimal signs vary; what comes out is the sensor's, in SI."""
    capture = squats()
    convert(sensor_csv(tmp_path / "thigh.csv", capture, "thigh", header), tmp_path / "a.mcap")
    table = mr.open(tmp_path / "a.mcap").table("/leg/thigh/imu")
    assert table["t_ns"].to_numpy() == pytest.approx(capture.t * 1e9, abs=2e4)
    one = capture.segments["thigh"]
    for kind, values in (("acc", one.acc_b), ("gyr", one.gyr_b)):
        got = table.select(f"{kind}_{a}" for a in "xyz").to_numpy()
        assert got == pytest.approx(values, abs=1e-4)


def test_units_in_parentheses_do_not_make_it_a_phones_table(tmp_path: Path) -> None:
    """As phyphox writes them, but it has a table for each sensor; two of one logger are one session."""
    header = "Time (s)," + ",".join(
        f"{w} {a} ({u})" for w, u in (("Acc", "m/s²"), ("Gyr", "rad/s")) for a in "XYZ"
    )
    rows = "".join(f"{0.01 * k:.2f},0,0,9.8,0,0,{0.1 * (k % 7)}\n" for k in range(100))
    files = [tmp_path / "a.csv", tmp_path / "b.csv"]
    for file in files:
        file.write_text(f"{header}\n{rows}", encoding="utf-8")
    convert(files, tmp_path / "a.mcap", options={"segments": "thigh,shank"})
    assert {"/leg/thigh/imu", "/leg/shank/imu"} <= set(mr.open(tmp_path / "a.mcap").channels)


def sensor(path: Path, header: str) -> Path:
    """Write 100 rows of a sensor, seconds first, with gravity on the last axis of the accelerometer."""
    names = header.split(";" if ";" in header else ",")
    gravity = next(k for k, name in enumerate(names) if name.startswith("Accelerometer Z"))
    rows = [[0.01 * k, *(0.1 * ((k + j) % 7) for j in range(1, len(names)))] for k in range(100)]
    for row in rows:
        row[gravity] = 1.0 if "(g)" in names[gravity] else 9.8
    text = "".join((";" if ";" in header else ",").join(f"{v:.2f}" for v in row) + "\n" for row in rows)
    path.write_text(f"{header}\n{text}", encoding="utf-8")
    return path


@pytest.mark.parametrize(
    "header",
    [
        ",".join([X_IO[0], *X_IO[4:], *X_IO[1:4]]),
        ";".join(X_IO),
        ",".join(X_IO).replace("(g)", "(m/s^2)"),
        ",".join([*X_IO[1:], X_IO[0]]),
        ",".join([X_IO[0], "Battery (V)", *X_IO[1:]]),
    ],
    ids=["acceleration first", "semicolons", "another unit", "time last", "a column between"],
)
def test_words_of_x_io_in_another_header_are_of_another_logger(tmp_path: Path, header: str) -> None:
    """x-io's software has one order, one separator and one unit of each sensor."""
    path = sensor(tmp_path / "thigh.csv", header)
    done = convert(path, tmp_path / "a.mcap")
    assert done.format == "inertial-csv"
    assert "/leg/thigh/imu" in mr.open(tmp_path / "a.mcap").channels


@pytest.mark.parametrize(
    "header", [X_IO, ["Timestamp (us)", *X_IO[1:]], [*X_IO, *(f"Magnetometer {a} (a.u.)" for a in "XYZ")]]
)
def test_headers_of_x_io_are_its_own(tmp_path: Path, header: list[str]) -> None:
    """As the x-IMU3's software writes them, one file is a foot's."""
    path = sensor(tmp_path / "walk.csv", ",".join(header))
    assert convert(path, tmp_path / "a.mcap").format == "xio-csv"
    assert set(mr.open(tmp_path / "a.mcap").channels) == {"/foot/imu"}


def test_one_file_of_x_io_with_a_segments_name_is_on_a_leg(tmp_path: Path) -> None:
    """Named, it is that segment's sensor, its magnetometer beside it."""
    header = ",".join([*X_IO, *(f"Magnetometer {a} (uT)" for a in "XYZ")])
    convert(sensor(tmp_path / "a.csv", header), tmp_path / "a.mcap", options={"segments": "shank"})
    assert set(mr.open(tmp_path / "a.mcap").channels) == {"/leg/shank/imu", "/leg/shank/mag"}


@pytest.mark.parametrize("name", [None, "inertial-csv", "xio-csv"])
def test_two_sensors_with_the_header_of_x_io_stand_beside_a_c3d(tmp_path: Path, name: str | None) -> None:
    """A format that is named is that of the sensors; the capture of markers keeps its own."""
    files = [sensor(tmp_path / f"{segment}.csv", ",".join(X_IO)) for segment in ("thigh", "shank")]
    rng = np.random.default_rng(1)
    points, analogs = rng.normal(500, 10, (200, 3, 3)).round(), np.zeros((200, 1))
    write_c3d(tmp_path / "walk.c3d", points, analogs, processor="intel", integers=False)
    convert(
        [*files, tmp_path / "walk.c3d"], tmp_path / "a.mcap", options={"segments": "thigh,shank"}, format=name
    )
    channels = mr.open(tmp_path / "a.mcap").channels
    assert {"/leg/thigh/imu", "/leg/shank/imu", "/reference/markers"} <= set(channels)


def test_a_named_format_is_kept_where_no_input_looks_like_it(tmp_path: Path) -> None:
    """The user may know better: then every input is read as said, and the fault is said."""
    points, analogs = np.full((200, 3, 3), 500.0), np.zeros((200, 1))
    for name in "ab":
        write_c3d(tmp_path / f"{name}.c3d", points, analogs, processor="intel", integers=False)
    with pytest.raises(MarchaError, match=r"a\.c3d: no header line like"):
        convert([tmp_path / "a.c3d", tmp_path / "b.c3d"], tmp_path / "a.mcap", format="inertial-csv")


def test_units_are_said_or_refused(tmp_path: Path) -> None:
    """Without units one line names every missing one and how to say it; said, it converts."""
    path = sensor_csv(tmp_path / "thigh.csv", squats(), "thigh", "time,AccX,AccY,AccZ,GyrX,GyrY,GyrZ")
    with pytest.raises(
        MarchaError, match=r"'time', 'AccX', 'GyrX'.*time_unit=ms.*acc_unit=g.*gyr_unit=deg/s"
    ):
        convert(path, tmp_path / "a.mcap")
    units = {"time_unit": "ms", "acc_unit": "g", "gyr_unit": "deg/s"}
    assert convert(path, tmp_path / "a.mcap", options=units).report.rows_kept == 500
    with pytest.raises(MarchaError, match=r"column 'GyrX': unit 'm/s' cannot become rad/s"):
        convert(path, tmp_path / "b.mcap", options=units | {"gyr_unit": "m/s"})


def test_two_sensors_and_markers_give_a_judged_knee_in_three_commands(tmp_path: Path) -> None:
    """Two loggers' files in Portuguese beside a TRC of another clock, up to the error per cycle."""
    capture = xsens_and_markers(tmp_path)
    for segment, name in (("thigh", "coxa"), ("shank", "perna")):
        sensor_csv(tmp_path / f"{name}.csv", capture, segment, PORTUGUESE)
    files = [tmp_path / n for n in ("coxa.csv", "perna.csv", "walk.trc")]
    raw, one, knee = (tmp_path / f"{n}.mcap" for n in ("raw", "one", "knee"))
    assert marcha("convert", *files, "--set", "segments=thigh,shank", "-o", raw).code == 0
    early = tmp_path / "early.mcap"
    assert marcha("replay", raw, "-e", "joint.hinge", "-o", early).code == 0
    assert "align them first (marcha align)" in marcha("evaluate", early).out
    assert marcha("align", raw, "-o", one).code == 0
    ran = marcha("replay", one, "-e", "joint.hinge", "-o", knee, "--json")
    assert ran.code == 0
    metrics = ran.document["runs"][0]["metrics"]
    assert metrics["cycles.knee"] >= 25
    assert metrics["rmse_unbiased_deg.knee"] < 1.0
    assert metrics["cycle_rmse_deg.knee"] < 4.0  # the mounting's share is in it


def test_a_silent_stretch_does_not_keep_the_clocks_apart(tmp_path: Path) -> None:
    """The shank's sensor misses 8 s: the clocks are found from the rest."""
    capture = xsens_and_markers(tmp_path)
    for segment in ("thigh", "shank"):
        sensor_csv(tmp_path / f"{segment}.csv", capture, segment, ENGLISH)
    lines = (tmp_path / "shank.csv").read_text().splitlines(keepends=True)
    (tmp_path / "shank.csv").write_text("".join(lines[:1500] + lines[2300:]))
    files = [tmp_path / n for n in ("thigh.csv", "shank.csv", "walk.trc")]
    assert marcha("convert", *files, "-o", tmp_path / "raw.mcap").code == 3  # sensor_gap
    ran = marcha("align", tmp_path / "raw.mcap", "-o", tmp_path / "one.mcap", "--json")
    assert ran.code == 0
    assert ran.document["offset_s"] == pytest.approx(1.3, abs=0.003)


@pytest.mark.parametrize("estimator", ["joint.hinge", "joint.relative", "joint.global"])
def test_a_dead_sensor_is_said_and_never_crashes(tmp_path: Path, estimator: str) -> None:
    """Every reading of the shank is 0: import and estimator say so, and the result must not be used."""
    capture = squats()
    for segment in ("thigh", "shank"):
        sensor_csv(tmp_path / f"{segment}.csv", capture, segment, ENGLISH)
    lines = (tmp_path / "shank.csv").read_text().splitlines()
    dead = [f"{line.split(',')[0]},0,0,0,0,0,0" for line in lines[1:]]
    (tmp_path / "shank.csv").write_text("\n".join([lines[0], *dead, ""]))
    ran = marcha(
        "convert", tmp_path / "thigh.csv", tmp_path / "shank.csv", "-o", tmp_path / "raw.mcap", "--json"
    )
    kinds = {f["kind"] for f in ran.document["report"]["findings"]}
    assert ran.code == 3
    assert {"all_zero", "still_sensor"} <= kinds
    assert "swapped" not in kinds
    ran = marcha("replay", tmp_path / "raw.mcap", "-e", estimator, "-o", tmp_path / "k.mcap", "--json")
    assert ran.code == 3
    assert "sensor_dead" in {f["kind"] for f in ran.document["runs"][0]["findings"]}
