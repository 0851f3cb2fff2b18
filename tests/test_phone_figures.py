"""Figures of a phone's walk, and what lies under its map."""

from __future__ import annotations

import json
from pathlib import Path

import marcha.recording as mr
import marcha.replay as rp
import marcha.viz as viz
import numpy as np
import pytest
from marcha.ingest import convert
from marcha.ingest.simulate import simulate
from marcha.recording import MarchaError
from marcha.recording.errors import UsageError
from marcha.replay.source_stages import source_stages
from PIL import Image


def streets(path: Path, lat: float, lon: float) -> Path:
    lines = [[[lon - 0.001, lat + d], [lon + 0.001, lat + d]] for d in (0.0, 0.0004)]
    features = [
        {"type": "Feature", "properties": {}, "geometry": {"type": "LineString", "coordinates": line}}
        for line in lines
    ]
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    return path


@pytest.fixture(scope="module")
def rec(tmp_path_factory: pytest.TempPathFactory) -> mr.Recording:
    folder = tmp_path_factory.mktemp("map")
    made = simulate("phone-turns", folder / "raw", seed=2, format="sensor-logger", rate_hz=25)
    lat, lon = -22.8263, -47.0759
    under = [streets(folder / "streets.geojson", lat, lon), folder / "aerial.png", folder / "aerial.json"]
    Image.fromarray(np.full((20, 30, 3), 200, np.uint8)).save(under[1])
    corners = {
        "north_deg": lat + 0.001,
        "south_deg": lat - 0.001,
        "west_deg": lon - 0.001,
        "east_deg": lon + 0.001,
    }
    under[2].write_text(json.dumps(corners))
    convert([*made.paths, *under], folder / "walk.mcap")
    rp.replay(mr.open(folder / "walk.mcap"), ["phone.transform"], out=folder / "done.mcap")
    return mr.open(folder / "done.mcap")


def test_the_map_has_streets_picture_fixes_and_track(rec: mr.Recording) -> None:
    (ax,) = viz.figure(rec, kind="map").axes
    labels = ax.get_legend_handles_labels()[1]
    assert labels[0] == "streets"
    assert any("gnss" in x for x in labels)
    assert any("transform" in x for x in labels)
    assert any("reference" in x for x in labels)
    (picture,) = ax.get_images()
    west, east, south, north = picture.get_extent()
    assert (west, north) == pytest.approx((-47.0769, -22.8253))
    assert east > west
    assert north > south


def test_the_transforms_last_stage_lies_on_the_fixes(rec: mr.Recording) -> None:
    axes = viz.figure(rec, kind="transform").axes
    points = [np.column_stack(ax.get_lines()[1].get_data()) for ax in axes]
    fixes = np.column_stack(axes[3].get_lines()[2].get_data())
    about = rec.table(next(t for t in rec.channels if t.endswith("/transform"))).row(0, named=True)
    assert np.sqrt(np.mean(np.sum((points[3] - fixes) ** 2, axis=1))) == pytest.approx(
        about["rms_m"], rel=1e-6
    )
    assert np.hypot(*(points[2][-1] - points[2][0])) == pytest.approx(
        about["scale"] * np.hypot(*(points[0][-1] - points[0][0]))
    )


def test_the_detectors_stages_grow_fewer(rec: mr.Recording) -> None:
    fig = viz.figure(rec, kind="detector")
    assert [ax.get_ylabel() for ax in fig.axes] == ["m/s²"] * 4
    table = rec.table("/phone/acc")
    norm = np.linalg.norm(table.select("acc_x", "acc_y", "acc_z").to_numpy(), axis=1)
    s = source_stages(table["t_ns"].to_numpy() * 1e-9, norm)
    assert len(s.peaks) >= len(s.high) >= len(s.kept_high) >= len(s.steps) > 40
    assert (norm[s.high] > s.upper[s.high]).all()
    assert set(s.steps) <= set(s.kept_high) <= set(s.high) <= set(s.peaks)


def test_without_a_transform_the_figure_says_what_is_missing(rec: mr.Recording, tmp_path: Path) -> None:
    with mr.create(tmp_path / "raw.mcap") as out:
        out.copy_from(rec, topics=["/phone/acc"])
    with pytest.raises(UsageError, match=r"phone\.transform"):
        viz.figure(mr.open(tmp_path / "raw.mcap"), kind="transform")


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("streets.geojson", "{", "is no JSON"),
        ("streets.geojson", "[]", "FeatureCollection"),
        ("aerial.json", '{"north_deg": 1, "south_deg": 2, "west_deg": 3, "east_deg": 4}', "no rectangle"),
        ("aerial.png", "x", "needs aerial.json"),
    ],
)
def test_what_cannot_lie_under_a_map_is_refused(tmp_path: Path, name: str, content: str, words: str) -> None:
    (tmp_path / name).write_text(content)
    made = simulate("phone-10m", tmp_path / "raw", seed=2, format="sensor-logger", rate_hz=20)
    with pytest.raises(MarchaError, match=words):
        convert([*made.paths, tmp_path / name], tmp_path / "walk.mcap")
    assert not (tmp_path / "walk.mcap").exists()
