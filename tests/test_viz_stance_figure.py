"""The figure of a stance detector's conditions."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import marcha.recording as mr
import pytest
from marcha import viz
from marcha.ingest import convert
from marcha.ingest.simulate import simulate
from marcha.recording import UsageError
from marcha.replay import replay
from marcha.viz.report import report

from .viz_helpers import drawn


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("walk")
    made = simulate("straight", folder, seed=1, length_m=8.0)
    convert(made.paths, folder / "walk.mcap")
    return folder / "walk.mcap"


def test_every_condition_its_and_and_the_cleaned_result_are_drawn(walk: Path, tmp_path: Path) -> None:
    """Source, figures 7 and 20 to 23: signals with limits and stance boxes, conditions as 0 and 1."""
    out = tmp_path / "out.mcap"
    runs = ["foot.9iez[detector=c1c2c3]", "foot.9iez[detector=pitch]", "foot.9iez"]
    replay(mr.open(walk), runs, inputs=["/foot/imu2"], out=out, metrics=False)
    figure: Any = viz.figure(mr.open(out), kind="conditions")
    titles = [ax.get_title(loc="left") for ax in figure.axes]
    for name in ("acc_norm", "acc_var", "gyr_norm", "pitch_dev", "pitch_var", "shoe"):
        assert any(f": {name} (detector" in t for t in titles)
    lanes = [
        [t.get_text() for t in ax.get_yticklabels()]
        for ax in figure.axes
        if "0 or 1" in ax.get_title(loc="left")
    ]
    assert lanes[0] == ["cleaned: still", "all of them", "gyr_norm", "acc_var", "acc_norm"]
    assert lanes[1] == ["cleaned: still", "all of them", "pitch_var", "pitch_dev"]
    assert lanes[2] == ["cleaned: still", "shoe"]


def test_without_a_detector_one_line_says_so(walk: Path) -> None:
    with pytest.raises(UsageError, match="no stance detector"):
        viz.figure(mr.open(walk), kind="conditions")


def test_the_viewer_has_a_lane_for_each_condition_and_says_first_what_must_not_be_used(
    tmp_path: Path,
) -> None:
    made = simulate("rectangle", tmp_path, seed=1, laps=3, config="3030")
    convert(made.paths, tmp_path / "clipped.mcap")
    out = tmp_path / "out.mcap"
    runs = ["foot.15iez-zaru[unclip=false]", "foot.9iez[detector=c1c2c3]"]
    results = replay(
        mr.open(tmp_path / "clipped.mcap"), runs, inputs=["/foot/imu2"], out=out, metrics=False
    ).runs
    assert [r.fatal for r in results] == [True, False]
    _, canvas = drawn(mr.open(out), tmp_path)
    panels = {(e.tab, e.kind, e.path.rsplit("/", 1)[-1]) for e in canvas.entries}
    assert {("Detector", "lanes", name) for name in ("acc_norm", "acc_var", "gyr_norm", "shoe")} <= panels
    assert ("Overview", "document", "verdict") in panels
    text = report(mr.open(out))
    assert text.index("results must not be used") < text.index("## Metrics")
    assert f"{results[1].run}: results must not be used" not in text
