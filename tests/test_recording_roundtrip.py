"""What is written is read back equal: by us, by mcap, by mcap-ros2-support, by rosbags, by Rerun."""

from __future__ import annotations

import math

import marcha.recording as mr
import numpy as np
import polars as pl
import pytest
from mcap.reader import NonSeekingReader, make_reader
from mcap.stream_reader import StreamReader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

from .recording_samples import STEP_NS, imu, sample_table, write

SCHEMAS = sorted(mr.SCHEMAS)


@pytest.fixture(scope="module")
def everything(tmp_path_factory):
    """One recording with every message type, several chunks each for some."""
    path = tmp_path_factory.mktemp("all") / "all.mcap"
    tables = {f"/t{i}": (s, sample_table(s, 40, i)) for i, s in enumerate(SCHEMAS)}
    tables["/long"] = ("sensor_msgs/msg/Imu", imu(10_000))
    return write(path, tables), tables


@pytest.mark.parametrize("index", range(len(SCHEMAS)), ids=SCHEMAS)
def test_reads_back_equal(everything, index):
    path, tables = everything
    schema, table = tables[f"/t{index}"]
    rec = mr.open(path)
    assert rec.table(f"/t{index}").equals(table)
    channel = rec.channels[f"/t{index}"]
    assert (channel.schema, channel.columns, channel.count) == (schema, tuple(table.columns[1:]), 40)
    assert (channel.start_ns, channel.end_ns) == (table["t_ns"][0], table["t_ns"][-1])


def test_nothing_is_wrong_with_the_file(everything):
    from marcha.recording.integrity import structure

    rec = mr.open(everything[0])
    assert rec.contents.indexed
    assert structure(rec) == []
    assert rec.findings == []


def value_at(message, path: str):
    """Return the field of a decoded message at a path like ``position[1].x``."""
    for part in path.split("."):
        name, _, index = part.partition("[")
        message = getattr(message, name)
        if index:
            message = message[int(index[:-1])]
    return message


def expected(schema: str, table: pl.DataFrame, row: int):
    """Yield path and value of every column of a row, from the table of columns alone."""
    spec = mr.SCHEMAS[schema]
    names = list(
        dict.fromkeys(
            c.rsplit(".", 1)[0] if "Markers" in schema else c.split(".")[0] for c in table.columns[1:]
        )
    )
    for column in spec.columns:
        for i, name in enumerate(names if spec.names else [""]):
            value = table[name + column.name][row]
            path = column.field.replace("[i]", f"[{i}]")
            if spec.explode:
                path = f"{spec.explode}[0].{path}"
            yield path, column.kind, value


def check_decoded(schema: str, table: pl.DataFrame, row: int, message) -> None:
    stamp = value_at(message, "transforms[0].header.stamp" if "TFMessage" in schema else "header.stamp")
    assert stamp.sec * 10**9 + stamp.nanosec == table["t_ns"][row]
    for path, kind, value in expected(schema, table, row):
        got = value_at(message, path)
        if kind == "time":
            got = got.sec * 10**9 + got.nanosec
        elif kind == "mac":
            got = ":".join(f"{b:02x}" for b in got)
        elif kind == "technology":
            got = ("unknown", "wifi", "ble", "uwb", "cell")[got]
        elif kind == "sigma":
            got = math.sqrt(got)
        if isinstance(value, float) and math.isnan(value):
            assert isinstance(got, float), path
            assert math.isnan(got), path
        else:
            assert got == value, path


def test_mcap_and_ros2_support_decode_the_same_values(everything):
    path, tables = everything
    seen = dict.fromkeys(tables, 0)
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        topics = [t for t in tables if t != "/long"]
        for schema, channel, message, decoded in reader.iter_decoded_messages(topics=topics):
            assert schema is not None
            row = seen[channel.topic]
            table = tables[channel.topic][1]
            assert message.log_time == message.publish_time == table["t_ns"][row]
            assert message.sequence == row
            check_decoded(schema.name, table, row, decoded)
            seen[channel.topic] += 1
    assert all(n == 40 for t, n in seen.items() if t != "/long")


def test_rosbags_decodes_the_same_values(everything):
    path, tables = everything
    seen = dict.fromkeys(tables, 0)
    with AnyReader([path]) as reader:
        for connection, time, raw in reader.messages():
            row = seen[connection.topic]
            seen[connection.topic] += 1
            schema, table = tables[connection.topic]
            assert time == table["t_ns"][row]
            if row < 40 and connection.topic != "/long":
                check_decoded(schema, table, row, reader.deserialize(raw, connection.msgtype))
    assert seen["/long"] == 10_000


def test_streaming_reader_finds_every_checksum_right(everything):
    with everything[0].open("rb") as file:
        count = sum(1 for _ in StreamReader(file, validate_crcs=True).records)
    with everything[0].open("rb") as file:
        messages = sum(
            1 for _ in NonSeekingReader(file, validate_crcs=True).iter_messages(log_time_order=False)
        )
    assert messages == 10_000 + 40 * len(SCHEMAS)
    assert count > messages


def test_summary_of_mcap_agrees(everything):
    path, tables = everything
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    topics = {i: c.topic for i, c in summary.channels.items()}
    counts = {topics[i]: n for i, n in summary.statistics.channel_message_counts.items()}
    assert counts == {t: len(table) for t, (_, table) in tables.items()}
    assert summary.statistics.chunk_count == len(summary.chunk_indexes)
    assert all(len(c.message_index_offsets) == 1 for c in summary.chunk_indexes)
    assert max(c.uncompressed_size for c in summary.chunk_indexes) <= 1 << 20
    assert all("offered_qos_profiles" in c.metadata for c in summary.channels.values())


@pytest.mark.parametrize(
    ("schema", "kinds"),
    [
        ("sensor_msgs/msg/Imu", "Scalars"),
        ("sensor_msgs/msg/MagneticField", "Arrows3D"),
        ("sensor_msgs/msg/NavSatFix", "GeoPoints"),
        ("sensor_msgs/msg/JointState", "Scalars"),
        ("geometry_msgs/msg/PoseStamped", "InstancePoses3D"),
        ("marcha_msgs/msg/Stance", "Stance"),
        ("marcha_msgs/msg/NavigationSigma", "NavigationSigma"),
    ],
)
def test_rerun_reads_every_message(tmp_path, schema, kinds):
    rerun_chunk = pytest.importorskip("rerun.chunk")
    table = sample_table(schema, 30)
    path = write(tmp_path / "a.mcap", {"/foot/x": (schema, table)})
    chunks = list(rerun_chunk.McapReader(str(path)).stream())
    ours = [c for c in chunks if str(c.entity_path).startswith("/foot/x") and not c.is_static]
    assert ours
    assert max(c.num_rows for c in ours) == 30
    batches = [c.to_record_batch() for c in ours]
    names = " ".join(str(f.name) for b in batches for f in b.schema)
    assert kinds.lower() in names.lower()
    columns = [c for b in batches for c in b.columns if not str(c.type).startswith(("timestamp", "duration"))]
    seen = {float(np.float32(v)) for column in columns for v in numbers(column.to_pylist())}
    for column in table.select(pl.col(pl.Float64)).iter_columns():
        if not column.name.startswith(("sd_", "alt_")):  # Rerun's map has no height and drops covariances
            assert {float(np.float32(v)) for v in column.drop_nans()} <= seen, column.name


def numbers(value):
    """Yield every number in nested lists and dicts."""
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list):
        for item in value:
            yield from numbers(item)
    elif isinstance(value, (int, float)) and abs(value) < 1e30:
        yield value


@pytest.mark.parametrize("columns", ["acc", "gyr", "quat", "acc gyr", "gyr quat"])
def test_absent_parts_of_imu_are_marked_and_stay_absent(tmp_path, columns):
    full = sample_table("sensor_msgs/msg/Imu", 5)
    table = full.select("t_ns", *(c for c in full.columns if c.split("_")[0] in columns.split()))
    path = write(tmp_path / "a.mcap", {"/imu": ("sensor_msgs/msg/Imu", table)})
    assert mr.open(path).table("/imu").equals(table)
    fields = {"acc": "linear_acceleration", "gyr": "angular_velocity", "quat": "orientation"}
    with path.open("rb") as file:
        decoded = [
            d for *_, d in make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages()
        ]
    for prefix, field in fields.items():
        absent = prefix not in columns.split()
        assert (getattr(decoded[0], f"{field}_covariance")[0] == -1) == absent
        assert math.isnan(getattr(decoded[1], field).x) == absent


@pytest.mark.parametrize("groups", ["pos", "vel", "att", "pos vel", "vel att"])
def test_absent_parts_of_navigation_sigma_are_nan_and_stay_absent(tmp_path, groups):
    full = sample_table("marcha_msgs/msg/NavigationSigma", 5)
    table = full.select("t_ns", *(c for c in full.columns[1:] if c.split("_")[1] in groups.split()))
    path = write(tmp_path / "a.mcap", {"/sigma": ("marcha_msgs/msg/NavigationSigma", table)})
    assert mr.open(path).table("/sigma").equals(table)
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        decoded = [d for *_, d in reader.iter_decoded_messages()]
    for key, field in {"pos": "position", "vel": "velocity", "att": "attitude"}.items():
        absent = key not in groups.split()
        assert math.isnan(getattr(decoded[1], field).x) == absent


def test_small_appends_give_the_same_bytes_as_one_table(tmp_path):
    table = imu(7000)
    with mr.create(tmp_path / "many.mcap") as out:
        for at in range(0, 7000, 333):
            out.add_table("/imu", "sensor_msgs/msg/Imu", table[at : at + 333])
    write(tmp_path / "one.mcap", {})
    with mr.create(tmp_path / "whole.mcap") as out:
        out.add_table("/imu", "sensor_msgs/msg/Imu", table)
    assert (tmp_path / "many.mcap").read_bytes() == (tmp_path / "whole.mcap").read_bytes()


def test_late_results_keep_both_times(tmp_path):
    table = imu(100).with_columns((pl.col("t_ns") + 10 * STEP_NS).alias("t_log_ns"))
    path = write(tmp_path / "a.mcap", {"/imu": ("sensor_msgs/msg/Imu", table)})
    rec = mr.open(path)
    assert rec.table("/imu", log_time=True).select(table.columns).equals(table)
    assert rec.table("/imu", 10 * STEP_NS, 12 * STEP_NS)["t_ns"].to_list() == [0, STEP_NS]
    with path.open("rb") as file:
        first = next(iter(make_reader(file).iter_messages()))[2]
    assert (first.publish_time, first.log_time) == (0, 10 * STEP_NS)


def test_metadata_and_attachments(tmp_path):
    with mr.create(tmp_path / "a.mcap") as out:
        out.add_metadata("provenance", {"tool": "marcha", "ü": "λ"})
        out.add_attachment("anchors.csv", b"\x00\xff" * 5, "text/csv")
        out.add_channel("/imu", "sensor_msgs/msg/Imu", "imu1", ("acc_x", "acc_y", "acc_z"), {"rate": "100"})
    rec = mr.open(tmp_path / "a.mcap")
    assert rec.metadata == {"provenance": {"tool": "marcha", "ü": "λ"}}
    assert rec.attachments == [mr.Attachment("anchors.csv", "text/csv", 10)]
    assert rec.attachment("anchors.csv") == b"\x00\xff" * 5
    assert rec.channels["/imu"].metadata == {"rate": "100"}
    assert rec.channels["/imu"].frame_id == "imu1"
    assert rec.table("/imu").columns == ["t_ns", "acc_x", "acc_y", "acc_z"]
    assert (rec.start_ns, rec.end_ns, rec.duration_s) == (0, 0, 0.0)
    with (tmp_path / "a.mcap").open("rb") as file:
        reader = make_reader(file)
        assert [m.name for m in reader.iter_metadata()] == ["provenance"]
        assert [a.data for a in reader.iter_attachments()] == [b"\x00\xff" * 5]


def test_values_survive_at_their_limits(tmp_path):
    limits = [0.0, -0.0, np.nan, np.inf, -np.inf, 5e-324, 1.7976931348623157e308]
    table = pl.DataFrame({"t_ns": [2**31 * 10**9 - 1] * 7, "pressure_pa": limits})
    path = write(tmp_path / "a.mcap", {"/p": ("sensor_msgs/msg/FluidPressure", table)})
    got = mr.open(path).table("/p")["pressure_pa"].to_numpy()
    assert got.tobytes() == np.array(limits).tobytes()
