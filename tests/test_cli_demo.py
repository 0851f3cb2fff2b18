"""The demo goes the whole way and leaves what it promises."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import marcha.recording as mr
import pytest

from .cli_helpers import Ran, marcha


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Ran]:
    folder = tmp_path_factory.mktemp("demo") / "demo"
    return folder, marcha("demo", "-o", folder, "--json", "-q")


def figures(demo: tuple[Path, Ran], walk: str) -> dict[str, dict[str, Any]]:
    found = next(w for w in demo[1].document["walks"] if w["name"] == walk)
    return {r["estimator"]: r["metrics"] for r in found["runs"]}


def test_everything_is_there(demo: tuple[Path, Ran]) -> None:
    folder, done = demo
    assert done.code == 0, done.err
    document = done.document
    paths = [document[k] for k in ("rrd", "figure", "summary")] + document["recordings"] + document["exports"]
    assert all(Path(p).exists() for p in paths)
    assert {p.name for p in folder.parent.iterdir()} == {"demo"}


def test_the_figure_is_a_picture(demo: tuple[Path, Ran]) -> None:
    assert (demo[0] / "tracks.png").read_bytes().startswith(b"\x89PNG")


def test_the_page_names_only_files_that_exist(demo: tuple[Path, Ran]) -> None:
    folder, _ = demo
    page = (folder / "summary.md").read_text()
    files = [line.split("|")[1].strip() for line in page.splitlines() if line.startswith("| ")]
    named = [f for f in files if "." in f or f.endswith("/")]
    assert len(named) >= 7
    assert all((folder / f).exists() for f in named)


def test_the_corrected_walk_closes_and_the_naive_one_runs_away(demo: tuple[Path, Ran]) -> None:
    runs = figures(demo, "rectangle")
    assert runs["foot.9iez"]["position_error_end_m"] < 0.25
    assert runs["foot.naive"]["position_error_end_m"] > 2


def test_the_stairs_are_climbed_and_left(demo: tuple[Path, Ran]) -> None:
    rec = mr.open(demo[0] / "stairs.mcap")
    height = rec.table("/estimate/foot_9iez_foot_imu2/pose")["pos_z"].drop_nans()
    truth = rec.table("/reference/imu2/pose")["pos_z"]
    climbed = truth.max() - truth[0]  # type: ignore[operator]
    assert height.max() - height[0] == pytest.approx(climbed, abs=0.15)  # type: ignore[operator]
    assert abs(height[-1] - height[0]) < 0.15


def test_clipping_is_told(demo: tuple[Path, Ran]) -> None:
    found = {w["name"]: {f["kind"] for f in w["findings"]} for w in demo[1].document["walks"]}
    assert "clipped" in found["rectangle-clipped"]
    assert "clipped" not in found["rectangle"]


def test_what_is_handed_on_is_annotated(demo: tuple[Path, Ran]) -> None:
    tiers = set(mr.open(demo[0] / "handed-on.mcap").annotations["tier"])
    assert {"foot_9iez_foot_imu2/stance", "foot_9iez_foot_imu2/step"} <= tiers
    assert json.loads((demo[0] / "csv" / "channels.json").read_text())["source"] == "rectangle.mcap"


def test_an_earlier_demo_is_left_alone(demo: tuple[Path, Ran]) -> None:
    before = (demo[0] / "summary.md").read_bytes()
    done = marcha("demo", "-o", demo[0])
    assert done.code == 1
    assert "--force" in done.complaint
    assert (demo[0] / "summary.md").read_bytes() == before
