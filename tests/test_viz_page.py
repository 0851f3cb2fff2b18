"""The report of recordings: it says what was measured, needs nothing else, and trusts no text."""

from __future__ import annotations

import re
from html.parser import HTMLParser
from pathlib import Path

import marcha.recording as mr
import numpy as np
import polars as pl
import pytest
from marcha.ingest import convert
from marcha.ingest.simulate import simulate
from marcha.recording import OutputExists, Recording, UsageError
from marcha.recording.changes import change
from marcha.replay import evaluate, replay
from marcha.replay.metrics import BETWEEN
from marcha.replay.metrics_joint import starts_from_signal
from marcha.viz.recording_page import recordings_page, write_page
from marcha.viz.stride_figures import joint_cycles, side_of

from .cli_helpers import marcha
from .viz_walks import indoor

S = 10**9
VOID = {"meta", "img", "br"}


class Page(HTMLParser):
    """Tables of a page as rows of texts, its headings, and whether its tags are balanced."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tables: list[list[list[str]]] = []
        self.headings: list[str] = []
        self.sources: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.sources += [v or "" for k, v in attrs if k in ("src", "href")]
        if tag == "table":
            self.tables.append([])
        if tag == "tr":
            self.tables[-1].append([])
        if tag in ("td", "th"):
            self.tables[-1][-1].append("")
        if tag in ("h2", "h3"):
            self.headings.append("")
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] in ("td", "th"):
            self.tables[-1][-1][-1] += data
        if self.open and self.open[-1] in ("h2", "h3"):
            self.headings[-1] += data


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """A walk with two sensors, estimates, and annotations whose text is hostile."""
    folder = tmp_path_factory.mktemp("page")
    raw = simulate("rectangle", folder / "raw", seed=5, length_m=8.0)
    convert(raw.paths, folder / "walk.mcap")
    replay(mr.open(folder / "walk.mcap"), ["foot.9iez"], out=folder / "done.mcap")
    rec = mr.open(folder / "done.mcap")
    middle = (rec.start_ns + rec.end_ns) // 2
    marks = pl.DataFrame(
        {
            "tier": ["ground"] * 2,
            "start_ns": [rec.start_ns + S, middle],
            "end_ns": [middle - 1, rec.end_ns - S],
            "label": ["<script>alert(1)</script>", "gravel"],
            "note": ["a & b", "\x1b[31mred"],
        }
    )
    change(rec, folder / "marked.mcap", add=marks)
    return mr.open(folder / "marked.mcap")


@pytest.fixture(scope="module")
def text(walk: Recording) -> str:
    return recordings_page([walk], picture=False)


@pytest.fixture(scope="module")
def page(text: str) -> Page:
    return Page(text)


def test_the_page_has_all_parts_and_needs_no_other_file(walk: Recording, page: Page) -> None:
    assert not page.open
    assert {
        "Errors and other figures",
        "Pictures",
        "By annotation",
        "Annotations",
        "Runs and their parameters",
        "Channels",
        "Provenance",
    } <= set(page.headings)
    assert page.sources
    assert all(s.startswith(("data:image/png;base64,", "#")) for s in page.sources)


def test_no_text_of_the_recording_becomes_code(text: str) -> None:
    assert "<script" not in text
    assert "&lt;script&gt;alert(1)" in text
    assert "\x1b" not in text


def test_figures_are_those_of_the_evaluation(walk: Recording, page: Page) -> None:
    runs = evaluate(walk).runs
    head, *rows = page.tables[0]
    assert head[1:] == [r.run for r in runs]
    shown = {row[0]: row[1:] for row in rows}
    for name in ("ate_rmse_m", "closure_m", "stride_time_s"):
        assert [float(c) for c in shown[name]] == pytest.approx([r.metrics[name] for r in runs], rel=1e-3)
    by = evaluate(walk, by="ground").runs[0]
    table = next(t for t in page.tables if t[0][-1] == BETWEEN)
    errors = next(row for row in table if row[0] == "ate_rmse_m")
    assert [float(c) for c in errors[1:]] == pytest.approx(
        [g.metrics["ate_rmse_m"] for g in by.groups], rel=1e-3
    )
    gait = next(t for t in page.tables if t[0][:3] == ["tier", "label", "run"])
    assert len(gait) == 1 + 2 * len(runs)


def test_several_recordings_begin_with_a_table_of_all(walk: Recording, tmp_path: Path) -> None:
    other = indoor(tmp_path / "indoor.mcap")
    page = Page(recordings_page([walk, other], picture=False, by="ground"))
    runs = [("marked", r.run) for r in evaluate(walk).runs] + [
        ("indoor", r.run) for r in evaluate(other).runs
    ]
    assert [tuple(row[:2]) for row in page.tables[0][1:]] == runs
    assert {"All recordings", "marked", "indoor"} <= set(page.headings)
    with pytest.raises(UsageError, match="no recording has the tier 'water'"):
        recordings_page([walk], picture=False, by="water")


def test_the_command_takes_folders_and_replaces_nothing(walk: Recording, tmp_path: Path) -> None:
    done = marcha("report", walk.path, "-o", tmp_path / "r.html", "--no-picture")
    assert done.code == 0
    assert (tmp_path / "r.html").read_text("utf-8").startswith("<!DOCTYPE html>")
    with pytest.raises(OutputExists):
        write_page([walk], tmp_path / "r.html", picture=False)
    (tmp_path / "empty").mkdir()
    assert "holds no recording" in marcha("report", tmp_path / "empty", "-o", tmp_path / "s.html").complaint
    assert sorted(p.name for p in tmp_path.iterdir()) == ["empty", "r.html"]


def test_a_missing_driver_is_said(walk: Recording, monkeypatch: pytest.MonkeyPatch) -> None:
    from marcha.viz import screenshot

    def none(*_: object, **__: object) -> None:
        raise mr.MarchaError("no graphics here")

    monkeypatch.setattr(screenshot, "screenshots", none)
    assert "No picture of the viewer: no graphics here" in recordings_page([walk])


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("knee_angle_r", ("knee_angle", "right")),
        ("left_hip", ("hip", "left")),
        ("/foot/L/imu", ("foot/imu", "left")),
        ("knee", ("knee", "")),
        ("rolling", ("rolling", "")),
    ],
)
def test_sides_are_words_of_their_own(name: str, expected: tuple[str, str]) -> None:
    assert side_of(name) == expected


def test_cycles_by_label_are_those_that_lie_in_its_intervals_whole(tmp_path: Path) -> None:
    t = np.arange(0, 40 * S, S // 100)
    knee = np.where(t < 20 * S, 0.5, 0.25) * (1 + np.sin(2 * np.pi * t * 1e-9))
    with mr.create(tmp_path / "leg.mcap") as out:
        table = pl.DataFrame({"t_ns": t, "knee_l": 0.4 * (1 + np.sin(2 * np.pi * t * 1e-9)), "knee_r": knee})
        out.add_table("/leg/encoder", "sensor_msgs/msg/JointState", table)
    rec = mr.open(tmp_path / "leg.mcap")
    marks = pl.DataFrame({"start_ns": [5 * S], "end_ns": [19 * S], "label": ["grass"]})
    whole, parts = joint_cycles(rec), joint_cycles(rec, marks)
    assert {(c.base, c.side) for c in whole} == {("knee", "left"), ("knee", "right")}
    grass = {c.joint: c for c in parts if c.label == "grass"}
    starts = starts_from_signal(t, 0.4 * (1 + np.sin(2 * np.pi * t * 1e-9)))
    assert len(grass["knee_l"].curves) == np.count_nonzero((starts >= 5 * S) & (starts <= 19 * S)) - 1
    assert np.ptp(grass["knee_r"].curves[0]) == pytest.approx(np.degrees(1.0), rel=1e-3)
    text = recordings_page([rec], picture=False)
    assert re.search(r"left against right", text)
