"""What is exported to TRC, STO, MOT, C3D and GPX comes back by marcha's own importers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import marcha.recording as mr
import numpy as np
import polars as pl
import pytest
from marcha.export import available, export
from marcha.export.labels import read_labels
from marcha.ingest import convert
from marcha.recording import Recording
from marcha.recording.changes import change

from .contracts.exporter import START_NS, example

SEEN = slice(1, None)  # a marker at exactly 0, 0, 0 is taken for one that was not seen
QUAT = [f"quat_{a}" for a in "wxyz"]


@pytest.fixture(scope="module")
def rec(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return mr.open(example(tmp_path_factory.mktemp("there") / "walk.mcap"))


def back(rec: Recording, to: str, folder: Path, **options: str) -> Recording:
    path = folder / f"a.{to}"
    export(rec, to, path, options={k: v for k, v in options.items() if k != "y_up"})
    convert([path], folder / "back.mcap", options={"y_up": "true"} if "y_up" in options else {})
    return mr.open(folder / "back.mcap")


def test_markers_by_trc(rec: Recording, tmp_path: Path) -> None:
    found = back(rec, "trc", tmp_path, y_up="true").table("/reference/markers")
    expected = rec.table("/reference/markers")
    assert np.abs(found["t_ns"].to_numpy() + START_NS - expected["t_ns"].to_numpy()).max() == 0
    for name in ("heel.x", "heel.y", "heel.z"):
        assert np.array_equal(found[name].to_numpy()[SEEN], expected[name].to_numpy()[SEEN])


def test_orientations_by_sto(rec: Recording, tmp_path: Path) -> None:
    found = back(rec, "sto", tmp_path, y_up="true")
    (topic,) = found.channels
    got, expected = (
        found.table(topic).select(QUAT).to_numpy(),
        rec.table("/reference/pose").select(QUAT).to_numpy(),
    )
    assert np.abs(np.abs(np.sum(got * expected, axis=1)) - 1).max() < 1e-12
    assert np.abs(got - expected).max() < 1e-9


def test_angles_by_mot(rec: Recording, tmp_path: Path) -> None:
    found = back(rec, "mot", tmp_path).table("/reference/joint")
    assert np.abs(found["knee"].to_numpy() - rec.table("/leg/encoder")["knee"].to_numpy()).max() < 1e-12


def test_markers_sensors_and_events_by_c3d(rec: Recording, tmp_path: Path) -> None:
    found = back(rec, "c3d", tmp_path)
    markers, imu = found.table("/reference/markers"), found.table("/foot/imu1")
    expected = rec.table("/reference/markers")
    for name in ("heel.x", "heel.y", "heel.z"):
        assert np.abs(markers[name].to_numpy() - expected[name].to_numpy())[SEEN].max() < 1e-6
    own = rec.table("/foot/imu1")
    for name in ("acc_x", "gyr_z"):
        there, here = imu[name].to_numpy()[: own.height], own[name].to_numpy()[: imu.height]
        known = np.isfinite(there)
        assert known.sum() > own.height - 10  # where all sensors have readings
        assert np.abs(there - here)[known].max() < 1e-4
    marks = found.annotations
    assert marks["label"].to_list() == ["turn", "turn end", "a tab and a comma, in it"]
    assert marks["start_ns"].to_list() == pytest.approx([10**9, 2 * 10**9, 5 * 10**9], abs=100)
    assert set(marks["tier"]) == {"manual"}


def test_fixes_by_gpx(rec: Recording, tmp_path: Path) -> None:
    found = back(rec, "gpx", tmp_path)
    (topic,) = (t for t, c in found.channels.items() if c.schema == "sensor_msgs/msg/NavSatFix")
    got, expected = found.table(topic), rec.table("/phone/gnss")
    assert np.array_equal(got["lat_deg"].to_numpy(), expected["lat_deg"].to_numpy())
    assert np.array_equal(got["lon_deg"].to_numpy(), expected["lon_deg"].to_numpy())
    assert np.abs(got["t_ns"].to_numpy() - expected["t_ns"].to_numpy()).max() <= 1000


def test_hundreds_of_events_go_through_c3d_and_back(rec: Recording, tmp_path: Path) -> None:
    """A parameter of C3D has 255 values and words of 255 bytes; ezc3d itself writes more and then cannot read it."""
    step = (rec.end_ns - rec.start_ns) // 700
    starts = [rec.start_ns + step * k for k in range(600)]
    labels = [f"event {k} 歩" for k in range(599)] + ["long " * 100]
    marks = pl.DataFrame({"tier": "many", "start_ns": starts, "end_ns": starts, "label": labels})
    change(rec, tmp_path / "many.mcap", add=marks)
    many = mr.open(tmp_path / "many.mcap")
    c3d: Any = available()["c3d"]()
    losses = c3d.losses(many, c3d.Options())
    assert any("LABELS2" in text for text in losses)
    assert any("cut" in text for text in losses)
    export(many, "c3d", tmp_path / "a.c3d")
    convert([tmp_path / "a.c3d"], tmp_path / "back.mcap")
    back = mr.open(tmp_path / "back.mcap")
    read = [read_labels(tmp_path / "a.c3d", back).annotations, back.annotations]
    for table in read:
        mine = table.filter(pl.col("tier") == "many").sort("start_ns")["label"].to_list()
        kept = len(mine)
        assert kept > 255
        assert mine == [label.strip()[:119] if len(label) > 120 else label for label in labels[:kept]]
