"""Figures of tracks on the Earth and on plans, against values worked out by hand."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import marcha.recording as mr
import marcha.replay as rp
import numpy as np
import polars as pl
import pytest
from marcha.ingest import convert
from marcha.ingest.simulate import simulate
from marcha.recording import UsageError
from marcha.replay import RunView, align
from marcha.replay import metrics_place as mp
from marcha.replay.trajectory import Trajectory, stepwise

S = 1_000_000_000
LAT, LON = 48.0, 11.0


def on_earth(xy: Any, t_s: Any = None, sd: float | None = None) -> pl.DataFrame:
    """Return fixes at places east and north (m) of one point; metres a degree by the ellipsoid's radii."""
    xy = np.asarray(xy, float)
    lat, e2, a = np.radians(LAT), 0.00669437999014, 6378137.0
    w = 1 - e2 * np.sin(lat) ** 2
    north, east = a * (1 - e2) / w**1.5, a / np.sqrt(w) * np.cos(lat)
    t = np.arange(len(xy)) if t_s is None else np.asarray(t_s)
    table = pl.DataFrame(
        {
            "t_ns": (t * S).astype(np.int64),
            "lat_deg": LAT + np.degrees(xy[:, 1] / north),
            "lon_deg": LON + np.degrees(xy[:, 0] / east),
        }
    )
    return table if sd is None else table.with_columns(sd_east_m=pl.lit(sd), sd_north_m=pl.lit(sd))


class Given(RunView):
    """A view whose reference and raw fixes are given."""

    def reference_table(self, kind: str) -> pl.DataFrame | None:
        return GIVEN.get("reference") if kind == "fix" else None

    def raw(self, topic: str) -> pl.DataFrame | None:
        return GIVEN.get("raw")


GIVEN: dict[str, pl.DataFrame] = {}


def figures(fix: pl.DataFrame, **options: Any) -> dict[str, float]:
    tables = {"fix": fix, **options.pop("tables", {})}
    lineage = {"inputs": '{"gnss": ["/phone/gnss"]}', **options.pop("lineage", {})}
    GIVEN.clear()
    GIVEN.update({k: options.pop(k) for k in ("reference", "raw") if k in options})
    recording = object() if "reference" in GIVEN else None
    return mp.places(
        Given("run", "e", lineage, lambda name, _: tables.get(name), recording=recording, **options)  # type: ignore[arg-type]
    )


LINE = [[0, 0], [100, 0], [100, 50]]


def test_errors_beside_fixes_of_the_same_time() -> None:
    truth = on_earth([[k, 0.0] for k in range(11)])
    ours = on_earth([[k, 3.0] for k in range(10)] + [[10.0, 4.0]], sd=2.0)
    found = figures(ours, reference=truth, raw=on_earth([[k, 5.0] for k in range(11)]))
    assert found["fix_error_median_m"] == pytest.approx(3.0, abs=1e-3)
    assert found["fix_error_end_m"] == pytest.approx(4.0, abs=1e-3)
    assert found["raw_fix_error_mean_m"] == pytest.approx(5.0, abs=1e-3)
    assert found["nees_horizontal_end"] == pytest.approx(4.0, abs=1e-2)
    assert found["ellipse95_percent"] == 100.0
    assert not [name for name in found if name.startswith("line")]


def test_correlation_turns_the_ellipse() -> None:
    """An error along the long axis of a thin ellipse is likely, the same one across it is not."""
    truth = on_earth([[k, k] for k in range(5)])
    state = pl.DataFrame({"t_ns": truth["t_ns"], "correlation_en": [0.99] * 5})
    along = on_earth([[k + 2.0, k + 2.0] for k in range(5)], sd=2.0)
    across = on_earth([[k + 2.0, k - 2.0] for k in range(5)], sd=2.0)
    assert figures(along, reference=truth, tables={"state": state})["ellipse95_percent"] == 100.0
    assert figures(across, reference=truth, tables={"state": state})["ellipse95_percent"] == 0.0
    assert figures(across, reference=truth)["ellipse95_percent"] == 100.0
    ratio = mp.squared(np.array([[2.0, 2.0]]), np.array([[[4.0, 3.96], [3.96, 4.0]]]))
    assert ratio[0] == pytest.approx(float(np.array([2, 2]) @ np.linalg.inv([[4, 3.96], [3.96, 4]]) @ [2, 2]))


def test_distance_to_a_survey_of_another_time_and_beyond_its_ends() -> None:
    survey = on_earth([[x, 0.0] for x in range(0, 101, 5)], t_s=np.arange(21) + 5000)
    ours = on_earth([[-30.0, 0.0], *([x, 2.0] for x in range(5, 95, 5))], sd=1.5)
    found = figures(ours, survey=survey, raw=on_earth([[10, 6.0], [20, -6.0]]))
    assert found["line_median_m"] == pytest.approx(2.0, abs=1e-3)
    assert found["line_p95_m"] == pytest.approx(2.0, abs=1e-3)
    assert found["line_all_p95_m"] > 2.5
    assert found["line_covered_percent"] == pytest.approx(100 * 18 / 19)
    assert found["line_shape_p95_m"] < 0.01
    assert found["raw_line_median_m"] == pytest.approx(6.0, abs=1e-3)
    assert found["line_within95_percent"] == 100.0
    assert "fix_error_median_m" not in found


def test_a_survey_is_not_joined_over_a_gap() -> None:
    places = np.array([[0, 0], [10, 0], [20, 0], [80, 0], [90, 0], [100, 0]], float)
    line = mp.SurveyLine.through(places)
    assert line is not None
    near, beside = line.nearest(np.array([[15.0, 3.0], [50.0, 1.0], [85.0, -3.0]]))
    assert beside.tolist() == [True, False, True]
    np.testing.assert_allclose(near[[0, 2]], [[15, 0], [85, 0]])


def test_alignment_by_shape_moves_and_turns_but_does_not_stretch() -> None:
    line = mp.SurveyLine.through(np.array([[0, 0], [15, 0], [30, 0], [30, 15], [30, 30], [45, 30]], float))
    assert line is not None
    on = np.array([[x, 0.0] for x in range(2, 30, 2)] + [[30.0, y] for y in range(2, 30, 2)])
    turn = np.radians(6.0)
    moved = on @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]) + [2.0, -1.5]
    np.testing.assert_allclose(mp.by_shape(moved, line), on, atol=0.05)
    stretched = mp.by_shape(1.2 * on, line)
    assert np.hypot(*(stretched[-1] - stretched[0])) == pytest.approx(1.2 * np.hypot(*(on[-1] - on[0])))


def test_error_at_the_end_of_a_loss_is_measured_against_what_was_withheld() -> None:
    raw = on_earth([[k, 0.0] for k in range(61)])
    ours = on_earth(
        [[k, 0.0 if k < 20 else 0.1 * (k - 20)] for k in range(50)] + [[k, 0.0] for k in range(50, 61)]
    )
    lineage = {"withheld": f'{{"/phone/gnss": [[{20 * S}, {50 * S}]], "/other": [[0, {S}]]}}'}
    found = figures(ours, raw=raw, lineage=lineage)
    assert found["loss_error_m"] == pytest.approx(2.9, abs=0.01)
    assert "loss_error_m" not in figures(ours, raw=raw)


def test_a_walk_stands_still_between_its_steps() -> None:
    track = Trajectory(np.array([2, 3, 13], np.int64) * S, np.array([[1.0, 0, 0], [2.0, 0, 0], [3.0, 0, 0]]))
    steps = pl.DataFrame(
        {
            "start_ns": np.array([1, 2, 12]) * S,
            "end_ns": np.array([2, 3, 13]) * S,
            "length_m": [1.0] * 3,
            "heading_rad": [0.0] * 3,
        }
    )
    whole = stepwise(track, steps, 0, 20 * S)
    at = np.interp(np.array([0, 1, 1.5, 7, 12, 12.5, 20]) * S, whole.t_ns, whole.position[:, 0])
    np.testing.assert_allclose(at, [0, 0, 0.5, 2, 2, 2.5, 3])


def test_similarity_finds_the_scale() -> None:
    rng = np.random.default_rng(3)
    here = rng.normal(size=(12, 3)) * (4, 4, 0)
    turn = 1.1
    rotation = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    there = 0.87 * here @ rotation.T + [5.0, -2.0, 1.0]
    found = align(here, there, "sim2")
    assert found.scale == pytest.approx(0.87, abs=1e-9)
    np.testing.assert_allclose(found.points(here)[:, :2], there[:, :2], atol=1e-9)
    assert align(here, there, "se2").scale == 1.0


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> mr.Recording:
    folder = tmp_path_factory.mktemp("place")
    made = simulate("phone-loop", folder / "raw", seed=8, format="sensor-logger", rate_hz=50)
    convert(made.paths, folder / "walk.mcap")
    return mr.open(folder / "walk.mcap")


def test_a_loss_reaches_the_estimator_and_not_the_recording(walk: mr.Recording, tmp_path: Path) -> None:
    fixes = walk.table("/phone/gnss")["t_ns"].to_numpy()
    begin = int(fixes[0]) + 30 * S
    spans = {"/phone/gnss": [(begin, begin + 40 * S)]}
    result = rp.replay(walk, ["phone.fused"], withhold=spans, out=tmp_path / "out.mcap")
    done = mr.open(tmp_path / "out.mcap")
    assert done.table("/phone/gnss").equals(walk.table("/phone/gnss"))
    kept = int(((fixes < begin) | (fixes >= begin + 40 * S)).sum())
    assert result.runs[0].tables["state"]["fixes"][-1] == kept
    velocities = rp.RecordingSource(walk, withheld=spans).batches(["/phone/gnss_velocity"])
    assert sum(b.tables["/phone/gnss_velocity"].height for b in velocities) == kept  # they are lost, too
    again = rp.evaluate(done).runs[0].metrics  # the loss is in the run's record
    assert again["loss_error_m"] == pytest.approx(result.runs[0].metrics["loss_error_m"])
    assert 0.0 < again["loss_error_m"] < 8.0
    assert again["fix_error_median_m"] < again["raw_fix_error_median_m"] + 1.0
    with pytest.raises(UsageError, match="/phone/gps to withhold"):
        rp.replay(walk, ["phone.fused"], withhold={"/phone/gps": [(0, 1)]})


def test_a_survey_needs_fixes(walk: mr.Recording, tmp_path: Path) -> None:
    with mr.create(tmp_path / "none.mcap") as out:
        out.add_table("/a", "marcha_msgs/msg/NamedValues", pl.DataFrame({"t_ns": [1], "x": [1.0]}))
    with pytest.raises(UsageError, match="is no survey"):
        rp.replay(walk, ["phone.fused"], survey=mr.open(tmp_path / "none.mcap"))


def test_the_same_walk_as_a_survey_of_another_time(walk: mr.Recording) -> None:
    """The track's distance to the line of the true walk, whatever its clock."""
    true = walk.table("/reference/fix")
    view = Given("run", "e", {}, lambda name, _: {"fix": true}.get(name), survey=true)
    found = mp.places(replace(view, survey=true.with_columns(pl.col("t_ns") - 10**15)))
    assert found["line_p95_m"] < 1e-6
