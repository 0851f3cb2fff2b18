"""What the writer refuses, in one line that names file, topic, rule and value."""

from __future__ import annotations

import marcha.recording as mr
import polars as pl
import pytest

IMU = "sensor_msgs/msg/Imu"
ACC = {"acc_x": [1.0], "acc_y": [1.0], "acc_z": [1.0]}
MAC = "aa:bb:cc:dd:ee:ff"
JOINTS = "sensor_msgs/msg/JointState"
RADIO = "marcha_msgs/msg/RadioSignal"
ROW = pl.DataFrame({"t_ns": [1], **ACC})
STEP = {"start_ns": [0], "end_ns": [1], "length_m": [1.0], "height_m": [1.0], "heading_rad": [1.0]}


@pytest.mark.parametrize(
    ("schema", "columns", "says"),
    [
        (IMU, {"t_ns": [1], **ACC, "acc_q": [1.0]}, "no column 'acc_q'"),
        (IMU, {"t_ns": [1], "acc_x": [1.0]}, "lacks the column acc_y, acc_z"),
        (IMU, {"t_ns": [1]}, "without any"),
        (IMU, dict(ACC), "column 't_ns' must be there"),
        (IMU, {"t_ns": [1.0], **ACC}, "'t_ns' must be there, Int64"),
        (IMU, {"t_ns": [None], **ACC}, "'t_ns' must be there, Int64"),
        (IMU, {"t_ns": [-1], **ACC}, "row 0: time -1e-09 s"),
        (IMU, {"t_ns": [2**61], **ACC}, "1970 to 2038"),
        (IMU, {"t_ns": [1], **ACC, "acc_x": ["1"]}, "'acc_x': type String, must be a number"),
        (JOINTS, {"t_ns": [1]}, "one column a name"),
        (JOINTS, {"t_ns": [1], "a": [1.0], "b": [1.0], "a.vel": [1.0]}, "lacks the column b.vel"),
        (RADIO, {"t_ns": [1], "mac": ["aa:bb"], "rssi_dbm": [1.0]}, "'aa:bb' is not a hardware address"),
        (RADIO, {"t_ns": [1], "mac": [MAC], "rssi_dbm": [1.0], "technology": ["x"]}, "'x' is none of"),
        ("marcha_msgs/msg/Stance", {"t_ns": [1], "still": [0.5]}, "must be Boolean"),
        ("marcha_msgs/msg/Stance", {"t_ns": [1], "still": [2]}, "other than 0 and 1"),
        ("marcha_msgs/msg/Stance", {"t_ns": [1], "still": pl.Series([None], dtype=pl.Boolean)}, "1 nulls"),
        ("marcha_msgs/msg/Step", {"t_ns": [1], **STEP, "index": [-1]}, "the field holds 0 to 4294967295"),
        ("marcha_msgs/msg/Step", {"t_ns": [1], **STEP, "index": [1.5]}, "must be an integer"),
    ],
)  # fmt: skip
def test_a_wrong_table_is_refused_and_nothing_is_written(tmp_path, schema, columns, says):
    path = tmp_path / "a.mcap"
    with pytest.raises(mr.MarchaError) as error, mr.create(path) as out:
        out.add_table("/x", schema, pl.DataFrame(columns))
    text = str(error.value)
    assert says in text
    assert text.startswith(str(path))
    assert "/x" in text
    assert "\n" not in text
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("across", [False, True])
def test_decreasing_log_time_is_refused(tmp_path, across):
    table = pl.DataFrame({"t_ns": [5, 4], "acc_x": [1.0, 2], "acc_y": [1.0, 2], "acc_z": [1.0, 2]})
    out = mr.create(tmp_path / "a")
    if across:
        out.add_table("/x", IMU, table[:1])
    with pytest.raises(mr.MarchaError, match="log time 4 ns is before the previous row's 5"):
        out.add_table("/x", IMU, table[1:] if across else table)
    out.abort()


def test_time_that_a_message_speaks_of_may_step_back(tmp_path):
    table = pl.DataFrame({"t_ns": [5, 4], "t_log_ns": [6, 6], "still": [True, False]})
    with mr.create(tmp_path / "a.mcap") as out:
        out.add_table("/x", "marcha_msgs/msg/Stance", table)
    assert mr.open(tmp_path / "a.mcap").table("/x")["t_ns"].to_list() == [5, 4]


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda out: out.add_channel("imu", IMU), "must start with '/'"),
        (lambda out: out.add_channel("/x", "no/msg/Such"), "unknown message type 'no/msg/Such'"),
        (lambda out: out.add_channel("/x", IMU, metadata={"columns": "a"}), "reserved"),
        (lambda out: [out.add_channel("/x", IMU) for _ in range(2)], "there already"),
        (lambda out: [out.add_metadata("a", {}) for _ in range(2)], "there already"),
        (lambda out: [out.add_attachment("a", b"") for _ in range(2)], "there already"),
        (lambda out: out.add_channel("/x", IMU), "never written"),
        (lambda out: [out.add_table("/x", s, ROW) for s in (IMU, JOINTS)], "into a channel of"),
        (lambda out: [out.add_table("/x", IMU, ROW, f) for f in "ab"], "frame_id 'b'"),
        (lambda out: [out.add_table("/x", IMU, t) for t in (ROW, ROW.drop("acc_x"))], "missing or unknown"),
    ],
)  # fmt: skip
def test_a_wrong_call_is_refused(tmp_path, call, says):
    with pytest.raises(mr.MarchaError) as error, mr.create(tmp_path / "a.mcap") as out:
        call(out)
    assert says in str(error.value)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "call",
    [lambda rec: rec.table("/no"), lambda rec: list(rec.windows(["/no"])), lambda rec: rec.attachment("no")],
)
def test_an_unknown_name_lists_those_that_are_there(tmp_path, call):
    with mr.create(tmp_path / "a.mcap") as out:
        out.add_table("/there", IMU, pl.DataFrame({"t_ns": [1], **ACC}))
        out.add_attachment("/there", b"")
    with pytest.raises(mr.UsageError, match="/there"):
        call(mr.open(tmp_path / "a.mcap"))
