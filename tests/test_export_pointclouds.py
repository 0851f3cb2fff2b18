"""Trajectories as point clouds, read by ROS 2's message reader and by Rerun's own importer."""

from __future__ import annotations

from pathlib import Path

import marcha.recording as mr
import numpy as np
import polars as pl
import pytest
from marcha.export import export
from marcha.export.pointclouds import CLOUD, ROOT, TRACK
from marcha.recording.parts import cut, merge
from mcap_ros2.reader import read_ros2_messages
from numpy.typing import NDArray
from rerun.chunk import McapReader

N = 50
BARE = "/reference/pose"
"""Trajectory without orientation, in a frame of its own; one position of it was not seen."""
POSED = "/estimate/mine/pose"


@pytest.fixture
def rec(tmp_path: Path) -> mr.Recording:
    t = np.arange(N, dtype=np.int64) * 10_000_000 + 5_000_000_000
    rng = np.random.default_rng(5)
    with mr.create(tmp_path / "a.mcap") as out:
        for topic, frame, quat in (
            (BARE, "vicon", {}),
            (POSED, "nav", {"w": 1.0, "x": 0.0, "y": 0.0, "z": 0.0}),
        ):
            columns = {f"pos_{a}": rng.normal(size=N) for a in "xyz"}
            if topic == BARE:
                columns["pos_y"][7] = np.nan
            columns |= {f"quat_{a}": np.full(N, v) for a, v in quat.items()}
            out.add_table(topic, "geometry_msgs/msg/PoseStamped", pl.DataFrame({"t_ns": t, **columns}), frame)
        gyr = {f"gyr_{a}": np.zeros(N) for a in "xyz"}
        out.add_table("/foot/imu", "sensor_msgs/msg/Imu", pl.DataFrame({"t_ns": t, **gyr}), "imu")
    return mr.open(tmp_path / "a.mcap")


def drawn(rec: mr.Recording, name: str = "tracks.mcap", **options: object) -> Path:
    path = rec.path.with_name(name)
    export(rec, "mcap", path, options={"tracks": True, **options})
    return path


def expected(rec: mr.Recording, topic: str) -> NDArray[np.float32]:
    points = rec.table(topic).select("pos_x", "pos_y", "pos_z").to_numpy().astype(np.float32)
    return points[np.isfinite(points).all(axis=1)]


@pytest.mark.parametrize(("topic", "count"), [(BARE, N - 1), (POSED, N)])
def test_one_cloud_a_trajectory_in_the_viewers_root(rec: mr.Recording, topic: str, count: int) -> None:
    (found,) = read_ros2_messages(drawn(rec), topics=[TRACK + topic])
    cloud = found.ros_msg
    assert found.schema.name == CLOUD
    assert cloud.header.frame_id == ROOT
    assert (cloud.height, cloud.width, cloud.point_step, cloud.row_step) == (1, count, 12, 12 * count)
    assert [(f.name, f.offset, f.datatype, f.count) for f in cloud.fields] == [
        ("x", 0, 7, 1),
        ("y", 4, 7, 1),
        ("z", 8, 7, 1),
    ]
    assert found.log_time_ns == cloud.header.stamp.sec * 10**9 + cloud.header.stamp.nanosec == rec.start_ns
    points = np.frombuffer(bytes(cloud.data), "<f4").reshape(-1, 3)
    assert np.array_equal(points, expected(rec, topic))


@pytest.mark.parametrize("topic", [BARE, POSED])
def test_rerun_alone_has_the_points(rec: mr.Recording, topic: str) -> None:
    found = [
        chunk.to_record_batch().column("Points3D:positions")[0].as_py()
        for chunk in McapReader(str(drawn(rec))).stream()
        if str(chunk.entity_path) == TRACK + topic
        and "Points3D:positions" in chunk.to_record_batch().schema.names
    ]
    assert len(found) == 1
    assert np.array_equal(np.array(found[0], np.float32), expected(rec, topic))


def test_frames_of_trajectories_hang_below_the_root(rec: mr.Recording) -> None:
    frames = [
        (t.header.frame_id, t.child_frame_id, t.transform.rotation.w)
        for m in read_ros2_messages(drawn(rec), topics=["/tf_static"])
        for t in m.ros_msg.transforms
    ]
    assert sorted(frames) == [(ROOT, "nav", 1.0), (ROOT, "vicon", 1.0)]  # a sensor moves: it has none


def test_a_part_has_the_track_of_the_part(rec: mr.Recording) -> None:
    start = rec.start_ns + 100_000_000
    (found,) = read_ros2_messages(drawn(rec, start_ns=start), topics=[TRACK + POSED])
    assert (found.ros_msg.width, found.log_time_ns) == (N - 10, start)


def test_drawn_again_is_drawn_once(rec: mr.Recording) -> None:
    once = mr.open(drawn(rec))
    again = mr.open(drawn(once, "again.mcap"))
    assert {t: c.count for t, c in again.channels.items()} == {t: c.count for t, c in once.channels.items()}
    assert again.table(POSED).equals(rec.table(POSED))
    assert again.channels[BARE].columns == ("pos_x", "pos_y", "pos_z")


def test_nothing_is_drawn_where_it_is_not_wanted(rec: mr.Recording) -> None:
    export(rec, "mcap", rec.path.with_name("out.mcap"), options={"tracks": False})
    assert list(mr.open(rec.path.with_name("out.mcap")).channels) == list(rec.channels)


def test_what_is_drawn_stays_behind_where_a_recording_is_taken_apart(
    rec: mr.Recording, tmp_path: Path
) -> None:
    """It shows other channels: parts, joins and other formats take those, and the next export draws anew."""
    shown = mr.open(drawn(rec))
    cut(shown, tmp_path / "part.mcap", rec.start_ns + 100_000_000, rec.end_ns + 1)
    merge([shown, shown], tmp_path / "both.mcap", prefixes=["", "/again"])
    assert list(mr.open(tmp_path / "part.mcap").channels) == list(rec.channels)
    assert sum(t.startswith(TRACK) for t in mr.open(tmp_path / "both.mcap").channels) == 0
    export(shown, "csv", tmp_path / "csv")
    assert not [p for p in (tmp_path / "csv").iterdir() if "track" in p.name or "tf" in p.name]
    part = mr.open(drawn(mr.open(tmp_path / "part.mcap"), "again.mcap"))
    assert part.channels[TRACK + POSED].count == 1
