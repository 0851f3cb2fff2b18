"""Figures: what they show, and the same bytes each time."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import marcha.recording as mr
import marcha.replay as rp
import marcha.viz as viz
import numpy as np
import pytest
from marcha.recording.errors import OutputExists, UsageError
from marcha.replay import PlannedChannel
from marcha.replay.references import shown_reference
from marcha.viz import style
from marcha.viz.top_view import nice
from marcha.viz.trace import LIMIT, Trace, axes_error, compared, framed

from .test_viz_rrd import RUN, write_walk


@pytest.fixture(scope="module")
def raw(tmp_path_factory: pytest.TempPathFactory) -> mr.Recording:
    return write_walk(tmp_path_factory.mktemp("figures") / "walk.mcap")


@pytest.fixture(scope="module")
def done(raw: mr.Recording) -> mr.Recording:
    out = raw.path.with_name("done.mcap")
    rp.replay(raw, ["foot.9iez", "foot.naive"], out=out)
    return mr.open(out)


def test_the_plan_shows_every_run_and_the_reference_with_equal_axes(done: mr.Recording) -> None:
    figure = viz.figure(done)
    plan = next(ax for ax in figure.axes if ax.get_title(loc="left").startswith("from above"))
    labels = [t.get_text() for part in figure.subfigs for legend in part.legends for t in legend.get_texts()]
    assert labels == ["reference", RUN, "foot_naive_foot_imu1", "start", "end"]
    assert plan.get_aspect() == 1.0
    assert (plan.get_xlabel(), plan.get_ylabel()) == ("x (m)", "y (m)")


def test_the_plan_has_the_positions_of_the_recording(done: mr.Recording) -> None:
    plan = next(ax for ax in viz.figure(done, alignment="none").axes if "above" in ax.get_title(loc="left"))
    line = next(line for line in plan.get_lines() if line.get_label() == RUN)
    expected = done.table(f"/estimate/{RUN}/pose").select("pos_x", "pos_y").to_numpy()
    np.testing.assert_array_equal(np.column_stack(line.get_data()), expected)


def area_of_sigma(rec: mr.Recording) -> float | None:
    """Return the highest point of the area of the standard deviation; None where none is drawn."""
    axes = [ax for ax in viz.figure(rec).axes if "1σ" in ax.get_title(loc="left")]
    areas = [c.get_paths()[0].vertices for ax in axes for c in ax.collections]
    return max(float(np.max(np.asarray(a)[:, 1])) for a in areas) if areas else None


@pytest.mark.parametrize("schema", ["NavigationSigma", "NamedValues"])  # the second: older recordings
def test_the_area_is_the_standard_deviation_of_the_position_if_it_is_there(
    done: mr.Recording, tmp_path: Path, schema: str
) -> None:
    pose, sigma = (done.table(f"/estimate/{RUN}/{what}") for what in ("pose", "sigma"))
    for name, table in {"all": sigma, "velocity": sigma.select("t_ns", "^sigma_vel_[xyz]$")}.items():
        with mr.create(tmp_path / f"{name}.mcap") as out:
            out.add_table("/estimate/r/pose", "geometry_msgs/msg/PoseStamped", pose)
            out.add_table("/estimate/r/sigma", f"marcha_msgs/msg/{schema}", table)
    expected = np.linalg.norm(sigma.select("^sigma_pos_[xyz]$").to_numpy(), axis=1).max()
    assert area_of_sigma(mr.open(tmp_path / "all.mcap")) == pytest.approx(expected)
    assert area_of_sigma(mr.open(tmp_path / "velocity.mcap")) is None


def test_lanes_show_the_stances(done: mr.Recording) -> None:
    axes = next(ax for ax in viz.figure(done).axes if "stances" in ax.get_title(loc="left"))
    reference = done.table("/reference/stance")["still"].cast(int).to_numpy()
    count = int(np.sum(np.diff(reference, prepend=0) == 1))
    assert len(axes.collections[0].get_paths()) == count == 9


def test_a_raw_recording_shows_its_signals(raw: mr.Recording, tmp_path: Path) -> None:
    with mr.create(tmp_path / "only.mcap") as out:
        out.add_table("/foot/imu1", "sensor_msgs/msg/Imu", raw.table("/foot/imu1"))
    (axes,) = viz.figure(mr.open(tmp_path / "only.mcap")).axes
    assert axes.get_ylabel() == "‖acc‖ (m/s²)"


def test_several_recordings_have_a_row_each(raw: mr.Recording, done: mr.Recording) -> None:
    figure = viz.figure([done, raw])
    assert sum("above" in ax.get_title(loc="left") for ax in figure.axes) == 2


@pytest.mark.parametrize("suffix", [".png", ".svg"])
def test_the_same_recording_gives_the_same_bytes(done: mr.Recording, tmp_path: Path, suffix: str) -> None:
    first = viz.save_figure(done, tmp_path / f"a{suffix}").read_bytes()
    second = viz.save_figure(done, tmp_path / f"b{suffix}").read_bytes()
    assert first == second
    assert b"20" + b"26-" not in first


def test_global_state_of_matplotlib_stays(done: mr.Recording, tmp_path: Path) -> None:
    code = (
        "import sys, matplotlib, marcha.recording as mr, marcha.viz as viz\n"
        "keys = [k for k in matplotlib.rcParams if k != 'backend']  # asking for it sets it\n"
        "before = {k: matplotlib.rcParams[k] for k in keys}\n"
        "viz.save_figure(mr.open(sys.argv[1]), sys.argv[2])\n"
        "assert {k: matplotlib.rcParams[k] for k in keys} == before\n"
        "assert 'matplotlib.pyplot' not in sys.modules"
    )
    command = [sys.executable, "-c", code, str(done.path), str(tmp_path / "x.png")]
    assert subprocess.run(command, capture_output=True).returncode == 0


def test_another_suffix_and_an_existing_file_are_refused(done: mr.Recording, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"\.png or \.svg"):
        viz.save_figure(done, tmp_path / "x.pdf")
    (tmp_path / "x.png").write_bytes(b"mine")
    with pytest.raises(OutputExists):
        viz.save_figure(done, tmp_path / "x.png")
    assert [p.name for p in tmp_path.iterdir()] == ["x.png"]


# -- tracks ------------------------------------------------------------------------------------------


def line(n: int, *, turn: float = 0.0, start: float = 0.0) -> Trace:
    track = Trace("t", "#000000")
    s = np.linspace(0.0, 10.0, n)
    xyz = np.column_stack([s * np.cos(turn) + start, s * np.sin(turn), 0 * s])
    for part in np.array_split(np.arange(n), 7):  # it comes in pieces
        track.add(part * 1_000_000, xyz[part])
    return track


def test_a_long_track_is_thinned_evenly_and_bounded() -> None:
    track = line(5 * LIMIT + 3)
    assert LIMIT // 2 <= track.count <= LIMIT
    assert set(np.diff(track.t_ns).tolist()) == {8_000_000}
    assert track.seen == 5 * LIMIT + 3


def test_a_thinned_track_does_not_keep_the_pieces_that_it_was_taken_from() -> None:
    track = line(5 * LIMIT + 3)
    before = track.count
    for k in range(1, 4):
        piece = np.arange(8 * LIMIT) * 1_000_000 + k * 10**15
        track.add(piece, np.zeros((len(piece), 3)))
        assert all(part.base is None or part.base.nbytes < piece.nbytes for part in (*track._t, *track._p))
    assert track.count <= LIMIT < 2 * before


def test_a_turned_and_moved_track_has_no_error() -> None:
    found = compared(line(500, turn=1.0, start=3.0), line(500), "origin-yaw")
    assert found is not None
    np.testing.assert_allclose(axes_error(found), 0.0, atol=1e-9)


def test_a_sparse_reference_is_compared_at_its_own_times() -> None:
    reference = Trace("r", "#000000")
    reference.add(np.array([0, 200, 400]) * 1_000_000, line(500).positions[[0, 200, 400]])
    found = compared(line(500), reference, "none")
    assert found is not None
    assert found.t_ns.tolist() == [0, 200_000_000, 400_000_000]
    np.testing.assert_allclose(axes_error(found), 0.0, atol=1e-9)


def test_tracks_that_do_not_meet_in_time_are_not_compared() -> None:
    later = Trace("r", "#000000")
    later.add(np.array([10**12, 10**12 + 10**6]), np.zeros((2, 3)))
    assert compared(line(50), later, "none") is None


def test_a_run_is_compared_with_the_truth_of_its_own_sensor() -> None:
    def shown(topics: tuple[str, ...], input_topic: str, label: str = "mine") -> str | None:
        channels = {t: PlannedChannel(t, "geometry_msgs/msg/PoseStamped") for t in topics}
        return shown_reference(channels, label, {"run/mine": {"input": input_topic}})

    both = ("/reference/pose", "/reference/imu2/pose")
    assert shown(both, "/foot/imu2") == "/reference/imu2/pose"
    assert shown(both, "/foot/imu1") == "/reference/pose"
    assert shown(("/reference/footprints",), "/foot/imu") == "/reference/footprints"
    assert shown(("/reference/a/pose", "/reference/b/pose"), "/foot/imu") == "/reference/a/pose"
    assert shown((), "/foot/imu") is None


def test_a_track_that_ran_away_does_not_set_the_frame() -> None:
    away = Trace("a", "#000000")
    away.add(np.arange(2), np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -500.0]]))
    good = line(50)
    assert framed([good, away]) == [good]
    assert framed([away]) == [away]
    short = Trace("s", "#000000")
    short.add(np.arange(2), good.shown[[0, 8]])
    more = [line(50), line(50)]
    assert framed([short, *more, away]) == [short, *more]  # one that found half of the steps hides none


@pytest.mark.parametrize(
    ("least", "expected"), [(0.07, 0.1), (0.1, 0.1), (0.11, 0.2), (3.0, 5.0), (51.0, 100.0)]
)
def test_grid_spacings_are_round(least: float, expected: float) -> None:
    assert nice(least) == pytest.approx(expected)


# -- colours -----------------------------------------------------------------------------------------

BACKGROUNDS = ("#FFFFFF", "#0D1011", "#181C22")
DEUTERANOPE = np.array([[0.625, 0.375, 0.0], [0.7, 0.3, 0.0], [0.0, 0.3, 0.7]])  # the usual linear mix


def luminance(color: str) -> float:
    c = np.array(style.rgb(color)) / 255.0
    linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


@pytest.mark.parametrize(
    "color", sorted({*style.AXES, *style.RUNS, style.REFERENCE, style.THRESHOLD, style.NORM, style.STILL})
)
@pytest.mark.parametrize("background", BACKGROUNDS)
def test_colours_stand_out_from_dark_and_light(color: str, background: str) -> None:
    low, high = sorted((luminance(color), luminance(background)))
    assert (high + 0.05) / (low + 0.05) >= 3.0  # WCAG 2.1, non-text contrast


def test_the_first_runs_and_axes_differ_for_a_deuteranope() -> None:
    for colors in (style.AXES, style.RUNS[:4]):
        seen = [DEUTERANOPE @ np.array(style.rgb(c)) for c in colors]
        apart = [np.linalg.norm(a - b) for i, a in enumerate(seen) for b in seen[:i]]
        assert min(apart) > 25.0


def test_no_two_of_nine_runs_share_a_colour() -> None:
    assert len({style.run_color(i) for i in range(9)}) == 9
    assert style.run_color(9) == style.run_color(0)
