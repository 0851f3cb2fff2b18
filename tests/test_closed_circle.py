"""A walk of each kind goes raw, convert, replay, annotate, through every exporter that applies, and other people's
readers find the same values: to the last bit where the format is binary, to 1e-9 where it is text.
"""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast
from xml.etree import ElementTree

import ezc3d
import gpxpy
import marcha.recording as mr
import numpy as np
import polars as pl
import pytest
from marcha.export import available, export
from marcha.ingest import convert
from marcha.ingest.simulate import simulate
from marcha.recording import Recording, UsageError
from marcha.recording.changes import change
from marcha.replay import replay
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from pympi.Elan import Eaf
from pympi.Praat import TextGrid
from rerun.chunk import RrdReader
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore
from scipy.io import loadmat

IMU, FIX = "sensor_msgs/msg/Imu", "sensor_msgs/msg/NavSatFix"
ALWAYS = {
    "mcap",
    "ros2bag",
    "csv",
    "parquet",
    "bids",
    "matlab",
    "rrd",
    "events",
    "eaf",
    "textgrid",
    "audacity",
}
KINDS: dict[str, tuple[str, dict[str, Any], str, set[str]]] = {
    "foot": ("rectangle", {"length_m": 8.0}, "foot.9iez", {"sto", "c3d"}),
    "phone": ("phone-turns", {"format": "phyphox"}, "phone.pdr", {"sto", "c3d", "gpx", "geojson", "kml"}),
    "indoor": ("floor-walk", {"format": "three-tables"}, "indoor.trilateration", {"sto", "c3d"}),
    "joint": ("walking", {"duration_s": "15"}, "joint.hinge", {"sto", "mot", "trc", "c3d"}),
}
"""Scenario, options, estimator, and the formats that have something to write beside :data:`ALWAYS`."""
LABELS = ["turn", "ein Bürgersteig", "歩行", "at once"]


@pytest.fixture(scope="module", params=KINDS)
def walk(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Recording]:
    scenario, options, estimator, _ = KINDS[request.param]
    folder = tmp_path_factory.mktemp(request.param)
    raw = simulate(scenario, folder / "raw", seed=7, **options)
    convert(raw.paths, folder / "walk.mcap")
    replay(mr.open(folder / "walk.mcap"), [estimator], out=folder / "done.mcap")
    rec = mr.open(folder / "done.mcap")
    step = (rec.end_ns - rec.start_ns) // 10
    at = [rec.start_ns + step * k for k in (1, 3, 5, 7)]
    marks = pl.DataFrame(
        {
            "tier": "manual",
            "label": LABELS,
            "start_ns": at,
            "end_ns": [at[0] + step, at[1] + 7, at[2] + step, at[3]],
        }
    )
    change(rec, folder / f"{request.param}.mcap", add=marks)
    done = mr.open(folder / f"{request.param}.mcap")
    assert any(t.startswith("/estimate/") for t in done.channels)
    return request.param, done


def test_the_formats_that_apply_are_those_that_are_checked(
    walk: tuple[str, Recording], tmp_path: Path
) -> None:
    kind, rec = walk
    applies = set()
    for name, exporter in available().items():
        try:
            export(rec, name, tmp_path / f"{name}{exporter.suffix}")
        except UsageError:
            continue
        applies.add(name)
    assert applies == ALWAYS | KINDS[kind][3]
    assert applies <= set(READERS)


@pytest.mark.parametrize("to", sorted({*ALWAYS, *(f for k in KINDS.values() for f in k[3])}))
def test_another_reader_finds_the_same(walk: tuple[str, Recording], to: str, tmp_path: Path) -> None:
    kind, rec = walk
    if to not in ALWAYS | KINDS[kind][3]:
        pytest.skip(f"a {kind} recording has nothing for {to}")
    path = tmp_path / f"out{available()[to].suffix}"
    export(rec, to, path)
    READERS[to](rec, path)


def chosen(rec: Recording, *schemas: str) -> list[str]:
    return [t for t, c in rec.channels.items() if c.count and (not schemas or c.schema in schemas)]


def accelerometer(rec: Recording) -> str:
    return next(t for t in chosen(rec, IMU) if "acc_x" in rec.channels[t].columns)


def numbers(table: pl.DataFrame) -> list[str]:
    return [c for c, d in table.schema.items() if d.is_float()]


def equal(got: Any, expected: Any) -> None:
    assert np.array_equal(np.asarray(got, float), np.asarray(expected, float), equal_nan=True)


def close(got: Any, expected: Any, most: float = 1e-9) -> None:
    got, expected = np.asarray(got, float), np.asarray(expected, float)
    assert got.shape == expected.shape
    assert np.array_equal(np.isnan(got), np.isnan(expected))
    assert np.nanmax(np.abs(got - expected), initial=0.0) <= most


def by_mcap(rec: Recording, path: Path) -> None:
    topics = [accelerometer(rec)]
    found: dict[str, list[float]] = {t: [] for t in topics}
    counts: dict[str, int] = {}
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        summary = reader.get_summary()
        assert summary is not None
        for number, channel in summary.channels.items():
            counts[channel.topic] = summary.statistics.channel_message_counts.get(number, 0)  # type: ignore[union-attr]
        for _, channel, _, message in reader.iter_decoded_messages(topics=topics):
            found[channel.topic].append(message.linear_acceleration.y)
        assert "events.tsv" in {a.name for a in reader.iter_attachments()}
    for topic in chosen(rec):
        if not topic.startswith("/annotation/"):
            assert counts[topic] == rec.channels[topic].count
    for topic, values in found.items():
        equal(values, rec.table(topic)["acc_y"])


def by_rosbags(rec: Recording, path: Path) -> None:
    store = get_typestore(Stores.ROS2_JAZZY)
    topic = accelerometer(rec)
    with Reader(path) as bag:
        assert {t for t in chosen(rec) if not t.startswith("/annotation/")} <= set(bag.topics)
        connections = [c for c in bag.connections if c.topic == topic]
        rows = [
            (at, cast(Any, store.deserialize_cdr(raw, c.msgtype)).linear_acceleration.z)
            for c, at, raw in bag.messages(connections)
        ]
    table = rec.table(topic, log_time=True)
    assert [at for at, _ in rows] == table["t_log_ns"].to_list()
    equal([z for _, z in rows], table["acc_z"])


def by_polars(read: Callable[[Path], pl.DataFrame]) -> Callable[[Recording, Path], None]:
    def check(rec: Recording, path: Path) -> None:
        listing = json.loads((path / "channels.json").read_text("utf-8"))
        files = {c["topic"]: c["file"] for c in listing["channels"]}
        for topic in chosen(rec):
            if topic.startswith("/annotation/"):
                continue
            expected = rec.table(topic)
            got = read(path / files[topic])
            assert got["t_ns"].to_list() == expected["t_ns"].to_list()
            for column in numbers(expected):
                equal(got[column].cast(pl.Float64).fill_null(np.nan), expected[column])

    return check


def by_bids(rec: Recording, path: Path) -> None:
    tables = {p.name: p for p in path.rglob("*_motion.tsv")}
    (about,) = json.loads((path / "sourcedata" / "marcha.json").read_text("utf-8")).values()
    assert set(about["columns"]) == set(tables)
    seen = set()
    for name, columns in about["columns"].items():
        rows = pl.read_csv(
            tables[name], separator="\t", has_header=False, null_values=["n/a"], infer_schema_length=None
        )
        listing = pl.read_csv(
            tables[name].with_name(name.replace("_motion", "_channels")), separator="\t", infer_schema=False
        )
        facts = json.loads(tables[name].with_suffix(".json").read_text("utf-8"))
        assert rows.width == listing.height == facts["MotionChannelCount"] == len(columns) + 1
        seconds = rows["column_0"].to_numpy()
        assert facts["SamplingFrequency"] == pytest.approx((len(seconds) - 1) / (seconds[-1] - seconds[0]))
        for k, (_, topic, column, dtype) in enumerate(columns, 1):
            seen.add(topic)
            if dtype == "Float64":
                got = rows[f"column_{k}"].cast(pl.Float64).fill_null(np.nan)
                equal(got, rec.table(topic)[column])
    assert (
        seen == {t for t in chosen(rec) if not t.startswith("/annotation/") and numbers(rec.table(t))} | seen
    )
    (events,) = (p for p in path.rglob("*_events.tsv") if "sourcedata" not in p.parts)
    marks = pl.read_csv(events, separator="\t", null_values=["n/a"])
    assert marks["onset"].is_between(0, rec.duration_s).all()
    assert set(LABELS) <= set(marks["trial_type"])


def by_matlab(rec: Recording, path: Path) -> None:
    data = loadmat(path, simplify_cells=True)
    by_topic = {v["topic"]: v for v in data.values() if isinstance(v, dict) and "topic" in v}
    for topic in chosen(rec, IMU):
        for column in numbers(rec.table(topic)):
            equal(by_topic[topic][column], rec.table(topic)[column])


def by_rerun(rec: Recording, path: Path) -> None:
    topic = accelerometer(rec)
    axes = [f"acc_{a}" for a in "xyz"]
    found = []
    for chunk in RrdReader(path).stream().filter(content=f"{topic}/acc"):
        batch = chunk.to_record_batch()
        if "Scalars:scalars" in batch.schema.names:
            found += batch.column("Scalars:scalars").to_pylist()
    equal(np.array(found)[:, :3], rec.table(topic).select(axes).to_numpy())


def opensim_table(path: Path) -> tuple[list[str], list[list[str]]]:
    lines = path.read_text("utf-8").splitlines()
    k = lines.index("endheader")
    return lines[k + 1].split("\t"), [line.split("\t") for line in lines[k + 2 :]]


def by_sto(rec: Recording, path: Path) -> None:
    from scipy.spatial.transform import Rotation

    names, rows = opensim_table(path)
    topics = json.loads(path.with_name(path.name + ".json").read_text("utf-8"))["topics"]
    start = rec.start_ns
    at = np.rint(np.array([float(r[0]) for r in rows]) * 1e9).astype(np.int64) + start
    turn = Rotation.from_euler("x", 90, degrees=True)
    compared = 0
    for k, topic in enumerate(topics, 1):
        table = rec.table(topic).unique("t_ns", keep="first", maintain_order=True)
        mine = table.filter(pl.col("t_ns").is_in(at.tolist()))
        if mine.height != len(at):
            continue  # of another clock: interpolated, and said
        got = turn * Rotation.from_quat(
            [[float(v) for v in r[k].split(",")] for r in rows], scalar_first=True
        )
        expected = Rotation.from_quat(mine.select(f"quat_{a}" for a in "wxyz").to_numpy(), scalar_first=True)
        assert (got * expected.inv()).magnitude().max() < 1e-9
        compared += 1
    assert compared
    assert len(names) == len(topics) + 1


def by_mot(rec: Recording, path: Path) -> None:
    names, rows = opensim_table(path)
    values = np.array(rows, float)
    at = np.rint(values[:, 0] * 1e9).astype(np.int64) + rec.start_ns
    compared = 0
    for topic in chosen(rec, "sensor_msgs/msg/JointState"):
        mine = rec.table(topic).filter(pl.col("t_ns").is_in(at.tolist()))
        for k, name in enumerate(names[1:], 1):
            prefix, _, joint = name.rpartition("_")
            if (
                mine.height == len(at)
                and prefix == topic.strip("/").replace("/", "_")
                and joint in mine.columns
            ):
                close(np.radians(values[:, k]), mine[joint])
                compared += 1
    assert compared


def by_trc(rec: Recording, path: Path) -> None:
    lines = path.read_text("utf-8").splitlines()
    names = [n for n in lines[3].split("\t")[2:] if n]
    rows = [line.split("\t") for line in lines[6:]]
    table = rec.table("/reference/markers")
    for k, name in enumerate(names):
        got = np.array([[float(c) if c else np.nan for c in r[2 + 3 * k : 5 + 3 * k]] for r in rows])
        x, y, z = (table[f"{name}.{a}"].to_numpy() for a in "xyz")
        close(got, np.column_stack((x, z, -y)))


def by_ezc3d(rec: Recording, path: Path) -> None:
    file: Any = ezc3d.c3d(str(path))
    labels = file["parameters"]["ANALOG"]["LABELS"]["value"]
    side = json.loads(path.with_name(path.name + ".json").read_text("utf-8"))
    if "/reference/markers" in rec.channels:
        table = rec.table("/reference/markers")
        for k, name in enumerate(file["parameters"]["POINT"]["LABELS"]["value"]):
            for i, a in enumerate("xyz"):
                close(file["data"]["points"][i, k], np.float32(1000 * table[f"{name}.{a}"].to_numpy()), 1e-3)
    topic = accelerometer(rec)
    own = rec.table(topic)
    signal = file["data"]["analogs"][0, labels.index(f"{topic.strip('/')}/acc_x")]
    rate = file["parameters"]["ANALOG"]["RATE"]["value"][0]
    at = side["first_frame_ns"] + np.arange(len(signal)) * 1e9 / rate
    expected = np.interp(at, own["t_ns"].to_numpy(), own["acc_x"].to_numpy())
    known = np.isfinite(signal) & (at >= own["t_ns"][0]) & (at <= own["t_ns"][-1])
    assert known.mean() > 0.9
    rough = np.abs(signal - expected)[known]
    assert np.median(rough) < 1e-3 * max(1.0, np.ptp(expected))
    events = file["parameters"]["EVENT"]["LABELS"]["value"]
    assert {"turn", "turn end", "at once"} <= set(events)


def by_gpxpy(rec: Recording, path: Path) -> None:
    fixes = rec.table(chosen(rec, FIX)[0])
    points = gpxpy.parse(path.read_text("utf-8")).tracks[0].segments[0].points
    equal([p.latitude for p in points], fixes["lat_deg"])
    equal([p.longitude for p in points], fixes["lon_deg"])


def by_geojson(rec: Recording, path: Path) -> None:
    fixes = rec.table(chosen(rec, FIX)[0])
    feature = json.loads(path.read_text("utf-8"))["features"][0]
    equal([c[:2] for c in feature["geometry"]["coordinates"]], fixes.select("lon_deg", "lat_deg").to_numpy())


def by_kml(rec: Recording, path: Path) -> None:
    fixes = rec.table(chosen(rec, FIX)[0])
    root = ElementTree.parse(path).getroot()
    found = [(e.text or "").split() for e in root.iter("{http://www.google.com/kml/ext/2.2}coord")]
    if not found:  # a clock without a date has a line, not a track
        lines = [e.text or "" for e in root.iter("{http://www.opengis.net/kml/2.2}coordinates")]
        found = [c.split(",") for c in lines[0].split()]
    equal([list(map(float, c[:2])) for c in found[: fixes.height]], fixes.select("lon_deg", "lat_deg"))


def seconds(rec: Recording) -> dict[str, float]:
    marks = rec.annotations.filter(pl.col("tier") == "manual")
    return {r["label"]: (r["start_ns"] - rec.start_ns) / 1e9 for r in marks.iter_rows(named=True)}


def by_events(rec: Recording, path: Path) -> None:
    table = pl.read_csv(path, separator="\t", null_values=["n/a"])
    own = rec.annotations
    key = ["start_ns", "end_ns", "trial_type"]
    assert (
        table.select(key).sort(key).rows() == own.select("start_ns", "end_ns", "label").sort(pl.all()).rows()
    )


def by_pympi_eaf(rec: Recording, path: Path) -> None:
    eaf = Eaf(str(path))
    tiers = [t for t in eaf.get_tier_names() if t.split(" [")[0] == "manual"]
    found = {label: a / 1e3 for t in tiers for a, _, label, *_ in eaf.get_annotation_data_for_tier(t)}
    assert found == pytest.approx(seconds(rec), abs=1e-3)


def by_pympi_grid(rec: Recording, path: Path) -> None:
    grid = TextGrid(str(path), codec="utf-8")
    found = {}
    for tier in grid.get_tiers():
        if tier.name.startswith("manual"):
            found |= (
                {row[-1]: row[0] for row in tier.get_all_intervals() if row[-1]}
                if tier.tier_type == ("IntervalTier")
                else {row[-1]: row[0] for row in tier.get_all_intervals()}
            )
    assert found == pytest.approx(seconds(rec), abs=1e-3)


def by_lines(rec: Recording, path: Path) -> None:
    rows = [line.split("\t") for line in path.read_text("utf-8").splitlines() if not line.startswith("\\")]
    found = {r[2].removeprefix("[manual] "): float(r[0]) for r in rows if r[2].startswith("[manual] ")}
    found = found or {r[2]: float(r[0]) for r in rows}
    assert found == pytest.approx(seconds(rec), abs=1e-6)


READERS: dict[str, Callable[[Recording, Path], None]] = {
    "mcap": by_mcap,
    "ros2bag": by_rosbags,
    "csv": by_polars(lambda p: pl.read_csv(io.BytesIO(p.read_bytes()), infer_schema_length=None)),
    "parquet": by_polars(pl.read_parquet),
    "bids": by_bids,
    "matlab": by_matlab,
    "rrd": by_rerun,
    "sto": by_sto,
    "mot": by_mot,
    "trc": by_trc,
    "c3d": by_ezc3d,
    "gpx": by_gpxpy,
    "geojson": by_geojson,
    "kml": by_kml,
    "events": by_events,
    "eaf": by_pympi_eaf,
    "textgrid": by_pympi_grid,
    "audacity": by_lines,
}
