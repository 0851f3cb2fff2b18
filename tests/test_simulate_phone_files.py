"""Simulated phones as files: each format comes back as the walk that was simulated, truth included."""

from __future__ import annotations

from pathlib import Path

import marcha.recording as mr
import numpy as np
import pytest
from marcha.ingest import convert
from marcha.ingest.simulate import phone_walk, simulate
from marcha.recording import OutputExists, UsageError

OPTIONS = {"rate_hz": 50, "placement": "pocket"}


@pytest.mark.parametrize("format", ["android-text", "phyphox", "sensor-logger"])
def test_a_format_gives_the_walk_back(tmp_path: Path, format: str) -> None:
    made = simulate("phone-10m", tmp_path / "raw", seed=3, format=format, **OPTIONS)  # type: ignore[arg-type]
    walk = phone_walk("phone-10m", seed=3, **OPTIONS)
    done = convert(made.paths, tmp_path / "w.mcap")
    assert done.format == format
    rec = mr.open(tmp_path / "w.mcap")
    acc = rec.table("/phone/acc").select("acc_x", "acc_y", "acc_z").to_numpy()
    assert np.allclose(acc, walk.acc_b[-len(acc) :], atol=1e-6)
    mag = rec.table("/phone/mag").select("mag_x", "mag_y", "mag_z").to_numpy()
    assert np.allclose(mag, walk.mag_b[-len(mag) :], atol=1e-9)
    fixes = rec.table("/phone/gnss")
    assert np.allclose(fixes["lat_deg"], walk.fixes["lat_deg"], atol=1e-9)
    origin = walk.t_ns[0] if format == "phyphox" else 0
    steps = rec.table("/reference/steps")
    assert np.array_equal(steps["end_ns"].to_numpy() + origin, walk.steps["end_ns"].to_numpy())
    pose = rec.table("/reference/pose")
    assert np.allclose(pose.select("pos_x", "pos_y", "pos_z").to_numpy(), walk.pos, atol=1e-9)
    assert rec.metadata["truth"]["steps"] == str(walk.steps.height)
    marks = rec.annotations
    assert marks.filter(tier="placement")["label"].to_list() == ["pocket"]
    activity = marks.filter(tier="activity")
    assert activity["label"].to_list() == ["standing", "walking", "standing"]
    walked = activity.filter(label="walking").row(0, named=True)
    assert abs(walked["start_ns"] + origin - int(walk.steps["start_ns"][0])) < 30_000_000
    assert abs(walked["end_ns"] + origin - int(walk.steps["end_ns"][-1])) < 30_000_000


def test_files_are_not_replaced_unasked(tmp_path: Path) -> None:
    simulate("phone-10m", tmp_path, format="phyphox", **OPTIONS)
    with pytest.raises(OutputExists):
        simulate("phone-10m", tmp_path, format="phyphox", **OPTIONS)
    again = simulate("phone-10m", tmp_path, format="phyphox", overwrite=True, **OPTIONS)
    assert again.paths[0].is_dir()
    assert not [p for p in tmp_path.iterdir() if p.name.startswith(".")]


def test_a_phone_has_no_packets(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="choose android-text"):
        simulate("phone-10m", tmp_path, format="packets")
