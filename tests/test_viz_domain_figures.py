"""Figures of phones, radio and joints: they show the recording's numbers, and say what is missing."""

from __future__ import annotations

import re
from pathlib import Path

import marcha.recording as mr
import marcha.viz as viz
import numpy as np
import polars as pl
import pytest
from marcha.recording.errors import UsageError
from marcha.replay import evaluate

from .viz_walks import indoor, leg, phone

KINDS = {
    "phone": ("signals", "steps", "heading", "fixes", "map", "error"),
    "indoor": ("floor", "radio", "error", "anchors"),
    "leg": ("signals", "joints", "cycles", "jumps", "strides", "transitions", "attitude", "cross", "rmse"),
}


ON_A_FLOOR = ("geometry", "radiomap", "ranges", "powers", "threshold", "triples", "points", "particles")
"""Drawn of a simulated floor, in test_indoor_survey."""


@pytest.fixture(scope="module")
def recs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, mr.Recording]:
    folder = tmp_path_factory.mktemp("figures")
    return {
        "phone": phone(folder / "phone.mcap", seconds=20),
        "indoor": indoor(folder / "indoor.mcap"),
        "leg": leg(folder / "leg.mcap"),
    }


def test_every_figure_is_drawn_and_has_a_line_of_help(recs: dict[str, mr.Recording]) -> None:
    known = viz.available_figures()
    assert set(known) == {
        "walk",
        "detector",
        "transform",
        "conditions",
        *(k for kinds in KINDS.values() for k in kinds),
        *ON_A_FLOOR,
    }
    assert all(known.values())
    for name, kinds in KINDS.items():
        for kind in kinds:
            drawn = viz.figure(recs[name], kind=kind)
            assert all(ax.has_data() for ax in drawn.axes), kind
            assert all(ax.get_xlabel() for ax in drawn.axes), kind


def test_the_steps_that_are_counted_are_the_recordings(recs: dict[str, mr.Recording]) -> None:
    rec = recs["phone"]
    length = rec.table("/estimate/phone_fused_phone_imu/step")["length_m"].to_numpy()
    _, lengths, way = viz.figure(rec, kind="steps").axes
    np.testing.assert_allclose(lengths.patches[0].get_data().values, length)  # type: ignore[attr-defined]
    np.testing.assert_allclose(np.asarray(way.get_lines()[0].get_ydata()), np.cumsum(length))


def test_the_error_of_a_joint_is_to_the_reference_not_to_the_encoder(recs: dict[str, mr.Recording]) -> None:
    _, below = viz.figure(recs["leg"], kind="joints").axes
    assert "/reference/joint" in below.get_title(loc="left")
    (line,) = below.get_lines()
    t, wrong = (np.asarray(v) for v in line.get_data())
    np.testing.assert_allclose(wrong, 1.5 * np.sin(t), atol=1e-6)
    said = re.search(r"RMSE ([\d.]+)°", str(line.get_label()))
    assert said is not None
    assert float(said[1]) == pytest.approx(np.sqrt(np.mean(wrong**2)), abs=0.005)


def test_a_joint_without_a_reference_has_no_empty_panel_of_errors(tmp_path: Path) -> None:
    table = pl.DataFrame({"t_ns": np.arange(50) * 10**7, "knee": np.sin(np.arange(50) / 8.0)})
    with mr.create(tmp_path / "a.mcap") as out:
        out.add_table("/estimate/mine/joint", "sensor_msgs/msg/JointState", table)
    (only,) = viz.figure(mr.open(tmp_path / "a.mcap"), kind="joints").axes
    assert only.get_title(loc="left") == "knee angle"


def test_the_distribution_ends_at_all_samples_and_states_its_quantiles(recs: dict[str, mr.Recording]) -> None:
    over, share = viz.figure(recs["indoor"], kind="error").axes
    for far, steps in zip(over.get_lines(), share.get_lines(), strict=True):
        values = np.asarray(far.get_ydata(), dtype=float)
        assert np.asarray(steps.get_ydata(), dtype=float)[-1] == 100.0
        assert f"median {np.median(values):.2f}" in str(steps.get_label())


def test_shares_of_the_states_add_up(recs: dict[str, mr.Recording]) -> None:
    (ax,) = viz.figure(recs["leg"], kind="jumps").axes
    shares = [float(str(c.get_label()).split(": ")[1].rstrip(" %")) for c in ax.collections]
    assert sum(shares) == pytest.approx(100.0, abs=1.5)


def test_the_jump_diagram_counts_every_transition(recs: dict[str, mr.Recording]) -> None:
    rec = recs["leg"]
    state = rec.table("/estimate/joint_smea/jump")["state"].to_numpy()
    (ax,) = viz.figure(rec, kind="transitions").axes
    said = [t.get_text() for t in ax.texts]
    stays = sum(int(t.split("stays ")[1]) for t in said if "stays" in t)
    moves = sum(int(t) for t in said if t.isdigit())
    assert stays == np.sum(np.diff(state) == 0)
    assert moves == np.sum(np.diff(state) != 0)


def test_bars_are_the_metrics(recs: dict[str, mr.Recording]) -> None:
    (run,) = evaluate(recs["leg"]).runs
    (ax,) = viz.figure(recs["leg"], kind="rmse").axes
    heights = sorted(bar.get_height() for bar in ax.patches)  # type: ignore[attr-defined]
    expected = sorted(v for k, v in run.metrics.items() if k.startswith("rmse_deg."))
    np.testing.assert_allclose(heights, expected)


@pytest.mark.parametrize(("name", "kind"), [("leg", "fixes"), ("phone", "joints"), ("phone", "radio")])
def test_what_a_recording_has_not_is_said(recs: dict[str, mr.Recording], name: str, kind: str) -> None:
    with pytest.raises(UsageError, match="nothing for this figure"):
        viz.figure(recs[name], kind=kind)


def test_an_unknown_figure_and_several_recordings_are_refused(recs: dict[str, mr.Recording]) -> None:
    with pytest.raises(UsageError, match=r"'pie' is unknown; there are walk, signals"):
        viz.figure(recs["leg"], kind="pie")
    with pytest.raises(UsageError, match="of one recording"):
        viz.figure([recs["leg"], recs["leg"]], kind="joints")


def test_the_same_bytes_each_time(recs: dict[str, mr.Recording], tmp_path: Path) -> None:
    first = viz.save_figure(recs["leg"], tmp_path / "a.png", kind="joints").read_bytes()
    assert viz.save_figure(recs["leg"], tmp_path / "b.png", kind="joints").read_bytes() == first


def test_panels_of_a_walk_are_never_empty(recs: dict[str, mr.Recording]) -> None:
    """A phone's sigma says nothing of the height and is drawn all the same; no accelerometer, no panel of it."""
    phone = {ax.get_title(loc="left"): ax for ax in viz.figure(recs["phone"]).axes}
    (own,) = (ax for title, ax in phone.items() if "1σ" in title)
    heights = np.concatenate([np.asarray(p.vertices)[:, 1] for c in own.collections for p in c.get_paths()])
    assert np.nanmax(heights) > 0.0
    bare = {ax.get_title(loc="left") for ax in viz.figure(recs["indoor"]).axes}
    sensed = any("acc_x" in c.columns for c in recs["indoor"].channels.values())
    assert any("accelerometer" in title for title in bare) == sensed


def test_labels_of_near_places_do_not_cover_each_other() -> None:
    from marcha.viz.plan_figures import place_labels
    from matplotlib.figure import Figure

    ax = Figure(figsize=(6, 4)).subplots()
    where = np.array([[1.0, 1.0], [1.3, 1.05], [4.0, 2.0], [4.1, 2.2]])
    ax.plot(where[:, 0], where[:, 1], "s")
    boxes = place_labels(ax, [(f"a0:e6:f8:00:00:0{k}", at) for k, at in enumerate(where)])
    assert len(boxes) == len(where)
    assert not any(a.overlaps(b) for i, a in enumerate(boxes) for b in boxes[:i])
