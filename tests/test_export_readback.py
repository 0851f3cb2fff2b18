"""What is exported reads back equal with other people's readers."""

from __future__ import annotations

import json
import math
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any, cast
from xml.etree import ElementTree

import ezc3d
import gpxpy
import marcha.recording as mr
import numpy as np
import polars as pl
import pytest
from marcha.export import export, losses
from marcha.export.bids import BidsOptions, write_dataset
from marcha.export.series import together
from marcha.recording import Recording, UsageError
from marcha.recording.selection import Selection
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore
from scipy.io import loadmat

from .contracts.exporter import ROWS, START_NS, example

TOOLS = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])


@pytest.fixture(scope="module")
def rec(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return mr.open(example(tmp_path_factory.mktemp("x") / "walk.mcap"))


def table(rec: Recording, topic: str) -> pl.DataFrame:
    return rec.table(topic)


def test_gpx_by_gpxpy(rec: Recording, tmp_path: Path) -> None:
    export(rec, "gpx", tmp_path / "a.gpx")
    points = gpxpy.parse((tmp_path / "a.gpx").read_text("utf-8")).tracks[0].segments[0].points
    fixes = rec.table("/phone/gnss")
    assert [p.latitude for p in points] == fixes["lat_deg"].to_list()
    assert [p.longitude for p in points] == fixes["lon_deg"].to_list()
    times = [p.time.timestamp() for p in points if p.time]
    assert np.allclose(times, fixes["t_ns"].to_numpy() / 1e9, atol=1e-6, rtol=0)


def test_geojson_and_kml_have_every_point(rec: Recording, tmp_path: Path) -> None:
    fixes = rec.table("/phone/gnss")
    export(rec, "geojson", tmp_path / "a.geojson")
    (feature,) = json.loads((tmp_path / "a.geojson").read_text("utf-8"))["features"]
    assert feature["geometry"]["coordinates"] == [list(r) for r in fixes.select("lon_deg", "lat_deg").rows()]
    assert feature["properties"]["t_ns"] == fixes["t_ns"].to_list()
    export(rec, "kml", tmp_path / "a.kml")
    root = ElementTree.parse(tmp_path / "a.kml").getroot()
    coords = [e.text or "" for e in root.iter("{http://www.google.com/kml/ext/2.2}coord")]
    assert [tuple(map(float, c.split()[:2])) for c in coords] == fixes.select("lon_deg", "lat_deg").rows()
    assert len(list(root.iter("{http://www.opengis.net/kml/2.2}when"))) == fixes.height


def test_accuracies_are_kept_and_privacy_hides(tmp_path: Path) -> None:
    steps = np.arange(200)
    fixes = pl.DataFrame(
        {
            "t_ns": START_NS + 10**9 * steps,
            "lat_deg": 38.7 + 1e-5 * steps,
            "lon_deg": np.full(200, -9.1),
            "alt_m": 100.0 + steps,
            **{f"sd_{a}_m": 2.0 + steps for a in ("east", "north", "up")},
        }
    )
    with mr.create(tmp_path / "g.mcap") as out:
        out.add_table("/gnss", "sensor_msgs/msg/NavSatFix", fixes)
    rec = mr.open(tmp_path / "g.mcap")
    export(rec, "gpx", tmp_path / "a.gpx")
    point = gpxpy.parse((tmp_path / "a.gpx").read_text()).tracks[0].segments[0].points[3]
    assert {e.tag.rpartition("}")[2]: float(e.text or "") for e in point.extensions} == {
        "sd_east_m": 5.0,
        "sd_north_m": 5.0,
        "sd_up_m": 5.0,
    }
    assert point.elevation == 103.0
    options = {"trim_m": "50", "coarsen_m": "10", "move_east_m": "100"}
    assert any("privacy" in line for line in losses(rec, "gpx", options=options))
    export(rec, "gpx", tmp_path / "p.gpx", options=options)
    text = (tmp_path / "p.gpx").read_text()
    hidden = gpxpy.parse(text).tracks[0].segments[0].points
    lat = np.array([p.latitude for p in hidden])
    assert lat.min() >= 38.7 + 40 / 111_319.5
    assert len(np.unique(lat)) < len(lat)
    assert "walk" not in text
    assert rec.path.name not in text
    assert "sd_east" not in text
    with pytest.raises(UsageError, match="no fixes are left"):
        export(rec, "gpx", tmp_path / "q.gpx", options={"trim_m": "1e6"})


def opensim_rows(path: Path) -> tuple[list[str], list[list[str]]]:
    lines = path.read_text("utf-8").splitlines()
    k = lines.index("endheader")
    return lines[k + 1].split("\t"), [line.split("\t") for line in lines[k + 2 :]]


def test_sto_has_the_quaternions_to_the_last_digit(rec: Recording, tmp_path: Path) -> None:
    export(rec, "sto", tmp_path / "a.sto", options={"names": "/reference/pose=foot_r_imu", "y_up": "false"})
    names, rows = opensim_rows(tmp_path / "a.sto")
    assert names == ["time", "foot_r_imu"]
    got = np.array([[float(v) for v in row[1].split(",")] for row in rows])
    expected = rec.table("/reference/pose").select(f"quat_{a}" for a in "wxyz").to_numpy()
    assert np.array_equal(got, expected)
    assert float(rows[-1][0]) == pytest.approx((ROWS - 1) * 0.01, abs=1e-9)


def test_sto_with_y_up_turns_the_frame(rec: Recording, tmp_path: Path) -> None:
    from scipy.spatial.transform import Rotation

    export(rec, "sto", tmp_path / "a.sto")
    _, rows = opensim_rows(tmp_path / "a.sto")
    got = Rotation.from_quat([[float(v) for v in row[1].split(",")] for row in rows], scalar_first=True)
    q = rec.table("/reference/pose").select(f"quat_{a}" for a in "wxyz").to_numpy()
    before = Rotation.from_quat(q, scalar_first=True).apply([0.1, 0.2, 0.3])
    expected = np.column_stack((before[:, 0], before[:, 2], -before[:, 1]))
    assert np.abs(got.apply([0.1, 0.2, 0.3]) - expected).max() < 1e-12


def test_mot_is_in_degrees_with_the_sign_that_was_asked_for(rec: Recording, tmp_path: Path) -> None:
    export(rec, "mot", tmp_path / "a.mot", options={"names": "knee=knee_angle_r", "flip": "knee_angle_r"})
    names, rows = opensim_rows(tmp_path / "a.mot")
    assert names == ["time", "knee_angle_r"]
    expected = -np.rad2deg(rec.table("/leg/encoder")["knee"].to_numpy())
    assert np.abs(np.array([float(r[1]) for r in rows]) - expected).max() < 1e-9
    with pytest.raises(UsageError, match="flip: hip"):
        export(rec, "mot", tmp_path / "b.mot", options={"flip": "hip"})


def test_trc_rows(rec: Recording, tmp_path: Path) -> None:
    export(rec, "trc", tmp_path / "a.trc", options={"y_up": "false"})
    lines = (tmp_path / "a.trc").read_text().split("\n")
    assert lines[3].split("\t")[:3] == ["Frame#", "Time", "heel"]
    got = np.array([[float(v) for v in line.rstrip("\t").split("\t")[2:]] for line in lines[6:] if line])
    assert np.array_equal(
        got, table(rec, "/reference/markers").select("heel.x", "heel.y", "heel.z").to_numpy()
    )


def test_c3d_by_ezc3d(rec: Recording, tmp_path: Path) -> None:
    export(rec, "c3d", tmp_path / "a.c3d", options={"topics": "/reference/*,/foot/imu1,/annotation/*"})
    file: Any = ezc3d.c3d(str(tmp_path / "a.c3d"))
    heel = table(rec, "/reference/markers").select("heel.x", "heel.y", "heel.z").to_numpy()
    assert file["parameters"]["POINT"]["LABELS"]["value"] == ["heel"]
    assert np.abs(file["data"]["points"][:3, 0].T / 1000 - heel).max() < 1e-6
    imu = rec.table("/foot/imu1")
    names = file["parameters"]["ANALOG"]["LABELS"]["value"]
    assert names[0] == "foot/imu1/acc_x"
    assert file["parameters"]["ANALOG"]["RATE"]["value"][0] == pytest.approx(100)
    analog = file["data"]["analogs"][0, 0]
    assert (
        np.abs(analog[: imu.height - 1] - imu["acc_x"].to_numpy()[: len(analog)][: imu.height - 1]).max()
        < 1e-4
    )
    events = file["parameters"]["EVENT"]
    assert events["LABELS"]["value"] == ["turn", "turn end", "a tab and a comma, in it"]
    assert events["TIMES"]["value"][1].tolist() == pytest.approx([1.0, 2.0, 5.0])


def test_matlab_by_scipy(rec: Recording, tmp_path: Path) -> None:
    export(rec, "matlab", tmp_path / "a.mat")
    data = loadmat(tmp_path / "a.mat", simplify_cells=True)
    imu = rec.table("/foot/imu1")
    assert data["foot_imu1"]["topic"] == "/foot/imu1"
    assert np.array_equal(data["foot_imu1"]["acc_x"], imu["acc_x"].to_numpy())
    assert np.array_equal(data["foot_imu1"]["t_ns"], imu["t_ns"].to_numpy())
    assert list(data["annotations"]["label"]) == rec.annotations["label"].to_list()
    assert data["foot_imu1"]["units"][2] == "m/s²"


def test_ros2_bag_by_rosbags(rec: Recording, tmp_path: Path) -> None:
    export(rec, "ros2bag", tmp_path / "bag")
    store = get_typestore(Stores.ROS2_JAZZY)
    with Reader(tmp_path / "bag") as bag:
        assert bag.topics["/foot/imu1"].msgcount == ROWS
        read = [
            cast(Any, store.deserialize_cdr(raw, connection.msgtype)).linear_acceleration.x
            for connection, _, raw in bag.messages([c for c in bag.connections if c.topic == "/foot/imu1"])
        ]
    assert read == rec.table("/foot/imu1")["acc_x"].to_list()


def test_parquet_says_its_units(rec: Recording, tmp_path: Path) -> None:
    export(rec, "parquet", tmp_path / "p")
    about = pl.read_parquet_metadata(tmp_path / "p" / "foot_imu1.parquet")
    assert about["unit.acc_x"] == "m/s²"
    assert about["unit.t_ns"] == "ns"


def test_names_that_would_clash_or_are_too_long(tmp_path: Path) -> None:
    long = "/" + "ä" * 300
    names = ("a", "a/b", "A", "a/b/c", "x/y", "x", "\x1b[31m", "n" * 400 + ".txt")
    with mr.create(tmp_path / "a.mcap") as out:
        out.add_table(
            long, "sensor_msgs/msg/Temperature", pl.DataFrame({"t_ns": [1], "temperature_c": [20.0]})
        )
        for name in names:
            out.add_attachment(name, name.encode())
    for to in ("csv", "parquet"):
        files = export(mr.open(tmp_path / "a.mcap"), to, tmp_path / to)
        assert all(f.is_file() for f in files)
        read = {
            f.read_bytes() for f in files if "attachments" in f.parts[-2] or "attachments" in str(f.parent)
        }
        assert read == {n.encode() for n in names}


def motion_files(folder: Path) -> list[Path]:
    return sorted(folder.rglob("*_motion.tsv"))


def test_bids_counts_rates_and_values_agree(rec: Recording, tmp_path: Path) -> None:
    export(rec, "bids", tmp_path / "ds", options={"subject": "07", "task": "stroll"})
    found = motion_files(tmp_path / "ds")
    assert len({f.name.split("_tracksys-")[1] for f in found}) == len(found) >= 6
    for file in found:
        rows = pl.read_csv(file, separator="\t", has_header=False, null_values=["n/a"])
        stem = file.name.removesuffix("_motion.tsv")
        channels = pl.read_csv(file.with_name(f"{stem}_channels.tsv"), separator="\t", infer_schema=False)
        about = json.loads(file.with_name(f"{stem}_motion.json").read_text())
        assert channels.height == rows.width == about["MotionChannelCount"]
        assert (
            sum(v for k, v in about.items() if k.endswith("ChannelCount") and k != "MotionChannelCount")
            == rows.width
        )
        seconds = rows["column_0"].to_numpy()
        assert about["SamplingFrequency"] == pytest.approx((len(seconds) - 1) / (seconds[-1] - seconds[0]))
        assert float(channels["sampling_frequency"][0]) == about["SamplingFrequency"]
    (imu,) = [f for f in found if "tracksys-footimu1_" in f.name]
    rows = pl.read_csv(imu, separator="\t", has_header=False)
    assert np.array_equal(rows["column_1"].to_numpy(), rec.table("/foot/imu1")["acc_x"].to_numpy())
    events = pl.read_csv(next((tmp_path / "ds").rglob("*_events.tsv")), separator="\t", null_values=["n/a"])
    assert events["onset"].is_between(0, rec.duration_s).all()


def test_two_recordings_of_one_name_are_refused(rec: Recording, tmp_path: Path) -> None:
    other = mr.open(rec.path)
    with pytest.raises(UsageError, match="two recordings would have one name"):
        write_dataset({rec: BidsOptions(), other: BidsOptions()}, tmp_path / "ds")
    assert not (tmp_path / "ds").exists()


def test_bids_names_of_two_topics_differ(tmp_path: Path) -> None:
    imu = pl.DataFrame({"t_ns": [0, 10**7]} | {f"acc_{a}": [0.0, 1.0] for a in "xyz"})
    with mr.create(tmp_path / "a.mcap") as out:
        for topic in ("/leg/a/imu", "/leg/a_imu"):
            out.add_table(topic, "sensor_msgs/msg/Imu", imu)
    export(mr.open(tmp_path / "a.mcap"), "bids", tmp_path / "ds")
    (listing,) = (tmp_path / "ds").glob("sub-*/motion/*_channels.tsv")
    names = pl.read_csv(listing, separator="\t")["name"]
    assert {"leg_a_imu_acc_x", "leg_a_imu_acc_x_2"} < set(names)
    assert names.is_unique().all()


@pytest.mark.skipif(
    shutil.which("bids-validator-deno", path=TOOLS) is None, reason="bids-validator-deno is not installed"
)
def test_bids_has_no_error(rec: Recording, tmp_path: Path) -> None:
    other = mr.open(rec.path)
    several = {rec: BidsOptions(subject="01", session="a"), other: BidsOptions(subject="02", run="1")}
    write_dataset(several, tmp_path / "ds")
    done = subprocess.run(
        [str(shutil.which("bids-validator-deno", path=TOOLS)), "--format", "json", str(tmp_path / "ds")],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "DENO_NO_UPDATE_CHECK": "1"},
    )
    if not done.stdout.strip():
        pytest.skip("the validator could not start: " + " ".join(done.stderr.split())[:200])
    issues = json.loads(done.stdout)["issues"]["issues"]
    assert [i for i in issues if i.get("severity") == "error"] == []


def test_channels_of_other_clocks_are_interpolated_and_named(tmp_path: Path) -> None:
    fast, slow = (np.arange(0, 10 * 10**9, step) for step in (10**7, 4 * 10**7))
    with mr.create(tmp_path / "a.mcap") as out:
        for topic, t in (("/fast", fast), ("/slow", slow)):
            half = t * 0.3e-9
            columns = {"quat_w": np.cos(half), "quat_x": np.sin(half), "quat_y": 0 * half, "quat_z": 0 * half}
            out.add_table(topic, "geometry_msgs/msg/QuaternionStamped", pl.DataFrame({"t_ns": t, **columns}))
    data = together(mr.open(tmp_path / "a.mcap"), ["/fast", "/slow"], Selection())
    assert data.resampled == ["/slow"]
    angle = data.t_ns * 0.3e-9
    assert np.abs(data.columns["/slow"]["quat_x"] - np.sin(angle)).max() < 1e-12
    assert math.isclose(float(data.columns["/fast"]["quat_w"][5]), math.cos(angle[5]))
