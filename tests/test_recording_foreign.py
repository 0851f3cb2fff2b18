"""Recordings that others wrote, in every arrangement, read the same as ours."""

from __future__ import annotations

import json

import marcha.recording as mr
import numpy as np
import polars as pl
import pytest
from marcha.recording.cdr import encode
from marcha.recording.definitions import full_text, load, parse_full
from mcap.writer import CompressionType, IndexType, Writer
from mcap_ros2.writer import Writer as Ros2Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as BagWriter
from rosbags.typesys import Stores, get_typestore

from .recording_samples import imu

IMU = "sensor_msgs/msg/Imu"
JAZZY = get_typestore(Stores.ROS2_JAZZY)


def imu_value(row: dict, frame_id: str = "imu") -> dict:
    """Return an Imu message as nested dicts, the orientation marked absent."""
    sec, nanosec = divmod(row["t_ns"], 10**9)
    return {
        "header": {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": frame_id},
        "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
        "orientation_covariance": [-1.0] + [0.0] * 8,
        "angular_velocity": {a: row[f"gyr_{a}"] for a in "xyz"},
        "angular_velocity_covariance": [0.0] * 9,
        "linear_acceleration": {a: row[f"acc_{a}"] for a in "xyz"},
        "linear_acceleration_covariance": [0.0] * 9,
    }


def imu_bytes(row: dict, frame_id: str = "imu") -> bytes:
    library = load(IMU)
    return encode(imu_value(row, frame_id), library["sensor_msgs/Imu"], library)


def raw_writer(path, messages, topics=("/imu",), schema=IMU, text=None, encoding="cdr", **options):
    """Write ``(topic, log time, bytes)`` with mcap's own writer."""
    with path.open("wb") as file:
        writer = Writer(file, **options)
        writer.start(profile="ros2")
        id_ = writer.register_schema(schema, "ros2msg", (text or full_text(schema)).encode())
        channels = {t: writer.register_channel(t, encoding, id_) for t in topics}
        for topic, log, data in messages:
            writer.add_message(channels[topic], log, data, log)
        writer.finish()
    return path


ARRANGEMENTS = {
    "zstd": {},
    "lz4": {"compression": CompressionType.LZ4},
    "uncompressed": {"compression": CompressionType.NONE},
    "no chunks": {"use_chunking": False},
    "small chunks": {"chunk_size": 4000},
    "no indexes": {"index_types": IndexType.NONE},
    "no message index": {"index_types": IndexType.CHUNK},
    "no statistics": {"use_statistics": False},
    "no summary": {
        "index_types": IndexType.NONE,
        "use_statistics": False,
        "use_summary_offsets": False,
        "repeat_channels": False,
        "repeat_schemas": False,
    },
    "no checksums": {"enable_crcs": False},
}


@pytest.mark.parametrize("name", ARRANGEMENTS)
def test_interleaved_channels_in_every_arrangement(tmp_path, name):
    tables = {"/a": imu(500), "/b": imu(300, 1, 3, 17_000_000)}
    messages = sorted(
        ((row["t_ns"], topic, imu_bytes(row)) for topic, t in tables.items() for row in t.to_dicts()),
        key=lambda m: m[:2],
    )
    path = raw_writer(
        tmp_path / "a.mcap", [(t, n, d) for n, t, d in messages], tuple(tables), **ARRANGEMENTS[name]
    )
    rec = mr.open(path)
    for topic, table in tables.items():
        assert rec.table(topic).select(table.columns).equals(table)
        channel = rec.channels[topic]
        assert (channel.count, channel.start_ns, channel.end_ns) == (
            len(table),
            table["t_ns"][0],
            table["t_ns"][-1],
        )
        assert (channel.frame_id, channel.columns) == ("imu", tuple(table.columns[1:]))
    assert [m.t_log_ns for m in rec.messages()] == [m[0] for m in messages]
    assert rec.findings == []


def test_bag_of_rosbags(tmp_path):
    table = imu(200)
    with BagWriter(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection("/imu", IMU, typestore=JAZZY)
        for row in table.to_dicts():
            writer.write(connection, row["t_ns"], imu_bytes(row))
    rec = mr.open(next((tmp_path / "bag").glob("*.mcap")))
    assert rec.table("/imu").select(table.columns).equals(table)


def test_file_of_mcap_ros2_support(tmp_path):
    table = imu(200)
    writer = Ros2Writer(str(tmp_path / "a.mcap"))
    schema = writer.register_msgdef(IMU, full_text(IMU))
    for row in table.to_dicts():
        writer.write_message("/imu", schema, imu_value(row), row["t_ns"], row["t_ns"])
    writer.finish()
    rec = mr.open(tmp_path / "a.mcap")
    assert rec.table("/imu").select(table.columns).equals(table)
    assert rec.channels["/imu"].columns == ("acc_x", "acc_y", "acc_z", "gyr_x", "gyr_y", "gyr_z")


def test_frame_ids_of_different_length_are_read_message_by_message(tmp_path):
    table = imu(60)
    frames = ["", "imu", "a", "much longer"]
    rows = [("/imu", r["t_ns"], imu_bytes(r, frames[i % 4])) for i, r in enumerate(table.to_dicts())]
    rec = mr.open(raw_writer(tmp_path / "a.mcap", rows))
    assert rec.table("/imu").equals(table)


def test_trailing_padding_and_pad_bits_do_not_matter(tmp_path):
    table = imu(60)
    rows = [
        ("/imu", r["t_ns"], b"\0\1\0\3" + imu_bytes(r)[4:] + b"\0" * (i % 2))
        for i, r in enumerate(table.to_dicts())
    ]
    rec = mr.open(raw_writer(tmp_path / "a.mcap", rows))
    assert rec.table("/imu").equals(table)


def test_big_endian_messages(tmp_path):
    table = imu(60)
    rows = []
    for row in table.to_dicts():
        message = JAZZY.deserialize_cdr(imu_bytes(row), IMU)
        rows.append(("/imu", row["t_ns"], bytes(JAZZY.serialize_cdr(message, IMU, little_endian=False))))
    assert mr.open(raw_writer(tmp_path / "a.mcap", rows)).table("/imu").equals(table)


def test_log_time_out_of_order_is_sorted_stably(tmp_path):
    table = imu(300)
    order = np.random.default_rng(0).permutation(300)
    rows = [("/imu", r["t_ns"] // 3 * 3, imu_bytes(r)) for r in table[order.tolist()].to_dicts()]
    rec = mr.open(raw_writer(tmp_path / "a.mcap", rows, chunk_size=5000))
    assert rec.table("/imu")["t_ns"].to_list() == table["t_ns"].to_list()
    assert [m.t_ns for m in rec.messages()] == table["t_ns"].to_list()


ODD = (
    "std_msgs/Header header\nuint8 LIMIT=3\nbool on\nfloat32[3] xyz\nstring name\nint16[] few\n"
    f"pkg/Point[] points\nbuiltin_interfaces/Time seen\n{'=' * 80}\nMSG: pkg/Point\nfloat64 x\nfloat64 y\n"
)


def odd_bytes(i: int) -> bytes:
    library = parse_full("pkg/msg/Odd", ODD)
    value = {
        "header": {"stamp": {"sec": 0, "nanosec": i}, "frame_id": "f"},
        "on": i % 2 == 0,
        "xyz": [i, i + 0.5, -i],
        "name": "n" * (i % 3),
        "few": list(range(i % 4)),
        "points": [{"x": 1.0 * i, "y": 2.0}] * (i % 2),
        "seen": {"sec": i, "nanosec": 5},
    }
    return encode(value, library["pkg/Odd"], library)


def test_an_unknown_type_is_flattened(tmp_path):
    rows = [("/odd", i, odd_bytes(i)) for i in range(12)]
    rec = mr.open(raw_writer(tmp_path / "a.mcap", rows, ("/odd",), "pkg/msg/Odd", ODD))
    table = rec.table("/odd")
    assert table["t_ns"].to_list() == list(range(12))
    assert table["on"].to_list() == [i % 2 == 0 for i in range(12)]
    assert table["xyz[1]"].to_list() == [i + 0.5 for i in range(12)]
    assert table["name"].to_list() == ["n" * (i % 3) for i in range(12)]
    assert table["few"].to_list() == [list(range(i % 4)) for i in range(12)]
    assert table["seen_ns"].to_list() == [i * 10**9 + 5 for i in range(12)]
    assert table["points[0].x"].to_list() == [float(i) if i % 2 else None for i in range(12)]
    assert rec.channels["/odd"].schema == "pkg/msg/Odd"


def test_a_type_of_the_same_name_with_other_fields_is_taken_as_it_is(tmp_path):
    text = "builtin_interfaces/Time when\nfloat64 acceleration\n"
    library = parse_full(IMU, text)
    data = encode(
        {"when": {"sec": 1, "nanosec": 2}, "acceleration": 3.0}, library["sensor_msgs/Imu"], library
    )
    table = mr.open(raw_writer(tmp_path / "a.mcap", [("/imu", 7, data)], text=text)).table("/imu")
    assert table.to_dicts() == [{"t_ns": 7, "when_ns": 10**9 + 2, "acceleration": 3.0}]


def test_half_a_stamp_is_a_column_and_no_time(tmp_path):
    text = "Top header\nfloat64 x\n" + "=" * 80 + "\nMSG: pkg/Top\nStamp stamp\n" + "=" * 80
    text += "\nMSG: pkg/Stamp\nint32 sec\n"
    library = parse_full("pkg/msg/Half", text)
    data = encode({"header": {"stamp": {"sec": 3}}, "x": 0.5}, library["pkg/Half"], library)
    path = raw_writer(tmp_path / "a.mcap", [("/half", 7, data)], ("/half",), "pkg/msg/Half", text)
    assert mr.open(path).table("/half").to_dicts() == [{"t_ns": 7, "header.stamp.sec": 3.0, "x": 0.5}]


def test_a_json_channel_is_listed_and_skipped_with_a_finding(tmp_path):
    table = imu(5)
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        text = writer.register_schema("thing", "jsonschema", b"{}")
        json_id = writer.register_channel("/json", "json", text)
        imu_id = writer.register_channel(
            "/imu", "cdr", writer.register_schema(IMU, "ros2msg", full_text(IMU).encode())
        )
        for row in table.to_dicts():
            writer.add_message(json_id, row["t_ns"], json.dumps({"a": 1}).encode(), 0)
            writer.add_message(imu_id, row["t_ns"], imu_bytes(row), 0)
        writer.finish()
    rec = mr.open(tmp_path / "a.mcap")
    assert [f.kind for f in rec.findings] == ["unreadable_channel"]
    assert (rec.channels["/json"].count, rec.channels["/json"].columns) == (5, ())
    assert rec.table("/imu").equals(table)
    assert {m.topic for m in rec.messages()} == {"/imu"}
    with pytest.raises(mr.MarchaError, match=r"/json.*cannot be read"):
        rec.table("/json")
    with pytest.raises(mr.MarchaError, match="only cdr"), mr.create(tmp_path / "b.mcap") as out:
        out.copy_from(rec)
    with mr.create(tmp_path / "b.mcap") as out:
        out.copy_from(rec, ["/imu"])
    assert mr.open(tmp_path / "b.mcap").table("/imu").equals(table)


def test_messages_that_do_not_fit_their_type_become_a_finding(tmp_path):
    table = imu(3)
    rows = [("/imu", r["t_ns"], imu_bytes(r)[:100]) for r in table.to_dicts()]
    rec = mr.open(raw_writer(tmp_path / "a.mcap", rows))
    assert rec.channels["/imu"].columns == ()
    assert [f.kind for f in rec.findings] == ["unreadable_channel"]


def test_equal_names_do_not_hide_each_other(tmp_path):
    library = load("sensor_msgs/msg/JointState")
    value = {
        "header": {"stamp": {"sec": 0, "nanosec": 1}, "frame_id": ""},
        "name": ["knee", "knee", "t_ns"],
        "position": [1.0, 2.0, 3.0],
        "velocity": [],
        "effort": [],
    }
    data = encode(value, library["sensor_msgs/JointState"], library)
    table = mr.open(
        raw_writer(tmp_path / "a.mcap", [("/j", 1, data)], ("/j",), "sensor_msgs/msg/JointState")
    ).table("/j")
    assert table.to_dicts() == [{"t_ns": 1, "knee": 1.0, "knee#2": 2.0, "t_ns#2": 3.0}]


def test_a_field_called_t_ns_does_not_hide_the_time(tmp_path):
    library = parse_full("pkg/msg/Clock", "int64 t_ns\n")
    data = encode({"t_ns": 5}, library["pkg/Clock"], library)
    table = mr.open(
        raw_writer(tmp_path / "a.mcap", [("/c", 7, data)], ("/c",), "pkg/msg/Clock", "int64 t_ns\n")
    ).table("/c")
    assert table.to_dicts() == [{"t_ns": 7, "t_ns#2": 5}]


def test_joint_names_that_change_are_kept_apart(tmp_path):
    library = load("sensor_msgs/msg/JointState")
    rows = []
    for i in range(4):
        names = ["knee", "hip_"] if i < 2 else ["toes", "hip_"]
        value = {
            "header": {"stamp": {"sec": 0, "nanosec": i}, "frame_id": ""},
            "name": names,
            "position": [1.0 * i, 2.0],
            "velocity": [],
            "effort": [],
        }
        rows.append(("/j", i, encode(value, library["sensor_msgs/JointState"], library)))
    table = mr.open(raw_writer(tmp_path / "a.mcap", rows, ("/j",), "sensor_msgs/msg/JointState")).table("/j")
    assert table["knee"].to_list() == [0.0, 1.0, None, None]
    assert table["toes"].to_list() == [None, None, 2.0, 3.0]
    assert table["hip_"].to_list() == [2.0] * 4


def test_several_transforms_in_one_message_become_rows(tmp_path):
    library = load("tf2_msgs/msg/TFMessage")
    pose = {
        "translation": {"x": 1.0, "y": 2.0, "z": 3.0},
        "rotation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
    }
    rows = []
    for i, count in enumerate([2, 0, 1, 3]):
        transforms = [
            {
                "header": {"stamp": {"sec": 0, "nanosec": i}, "frame_id": "map"},
                "child_frame_id": f"c{k}",
                "transform": pose,
            }
            for k in range(count)
        ]
        rows.append(("/tf", i, encode({"transforms": transforms}, library["tf2_msgs/TFMessage"], library)))
    table = mr.open(raw_writer(tmp_path / "a.mcap", rows, ("/tf",), "tf2_msgs/msg/TFMessage")).table("/tf")
    assert table["child_frame_id"].to_list() == ["c0", "c1", "c0", "c0", "c1", "c2"]
    assert table["t_ns"].to_list() == [0, 0, 2, 3, 3, 3]


def test_copy_of_a_foreign_recording_is_read_by_its_own_tools(tmp_path):
    tables = {"/a": imu(500), "/b": imu(300, 1, 3, 17_000_000)}
    messages = sorted((r["t_ns"], t, imu_bytes(r)) for t, v in tables.items() for r in v.to_dicts())
    path = raw_writer(
        tmp_path / "a.mcap", [(t, n, d) for n, t, d in messages], tuple(tables), chunk_size=20_000
    )
    with mr.create(tmp_path / "b.mcap") as out:
        out.copy_from(mr.open(path), ["/b"])
        out.add_table("/c", IMU, tables["/a"])
    rec = mr.open(tmp_path / "b.mcap")
    assert rec.table("/b").equals(tables["/b"])
    assert rec.table("/c").equals(tables["/a"])
    assert list(rec.channels) == ["/b", "/c"]
    assert pl.concat([t.select("t_ns") for t in tables.values()]).height == 800
