"""Surveys, offsets of receivers, the smoother, zones, errors on a plan, the simulated floor."""

from __future__ import annotations

import json

import numpy as np
import polars as pl
import pytest
from marcha.algorithms import AlgorithmError, Stretch, make
from marcha.algorithms.indoor.calibrate import RadioCalibration
from marcha.algorithms.indoor.places import coverage
from marcha.ingest import convert
from marcha.ingest.simulate import FLOOR_SCENARIOS, floor_walk, simulate
from marcha.ingest.simulate.floor import ANCHORS, HELD_Z, shadowing
from marcha.recording import MarchaError
from marcha.recording import open as open_recording
from marcha.replay import evaluate, replay
from marcha.replay.evaluate import recording_view
from marcha.replay.metrics_indoor import position_errors

from .event_loop import context_of, drive
from .test_indoor_contracts import PLAN, survey
from .test_indoor_estimators import FLOOR, errors, heard, table, walk


@pytest.mark.parametrize(("method", "most"), [("knn", 2.5), ("map", 1.5)])
def test_fingerprints_need_no_anchor_positions(method, most):
    still = np.tile([12.0, 4.0], (400, 1))
    found = drive(
        make("indoor.fingerprint", method=method),
        {"radio": {"/indoor/radio": heard(still, 1.0)}},
        calibrations={"radio": survey()},
    )
    assert found["position"].height >= 5
    assert errors(found["position"], still).mean() < most
    assert (found["sigma"]["sigma_pos_x"].to_numpy() > 0).all()


def test_fingerprints_without_a_survey_say_how_to_get_one():
    estimator = make("indoor.fingerprint")
    with pytest.raises(AlgorithmError, match="marcha calibrate radio"):
        estimator.start(context_of(estimator, {"radio": {"/r": heard(walk(20), 1.0)}}))


def test_neighbours_equal_scikit_learn():
    """The k nearest places by the mean square of powers, where all transmitters are heard."""
    from sklearn.neighbors import NearestNeighbors

    calibration = survey()
    places = calibration.values["places"]
    macs = sorted({m for p in places for m in p["powers"]})
    powers = np.array([[p["powers"][m] for m in macs] for p in places])
    estimator = make("indoor.fingerprint", method="knn", neighbours=3)
    estimator.start(
        context_of(estimator, {"radio": {"/r": heard(walk(20), 1.0)}}, calibrations={"radio": calibration})
    )
    here = powers[7] + np.array([1.0, -2.0, 0.5, 1.5, -1.0, 2.0])
    far, near = NearestNeighbors(n_neighbors=3).fit(powers).kneighbors(here[None])
    weight = 1 / (far[0] / np.sqrt(len(macs)))
    wanted = weight @ np.array([[places[i]["x"], places[i]["y"]] for i in near[0]]) / weight.sum()
    mean, _ = estimator._nearest(np.arange(len(macs)), here)
    assert mean == pytest.approx(wanted)


def test_two_receivers_get_their_offsets_and_a_recording_of_one_is_corrected():
    rng = np.random.default_rng(8)
    stretches = []
    for name, offset in (("phone one", 3.0), ("phone two", -3.0)):
        parts, where = [], []
        for k in range(25):
            place = rng.uniform([0, 0], [24, 8])
            part = heard(np.tile(place, (60, 1)), 1.0, seed=k).with_columns(
                pl.col("t_ns") + k * 10_000_000_000, pl.col("rssi_dbm") + offset
            )
            parts.append(part)
            where += [(part["t_ns"][0], *place, 1.2), (part["t_ns"][-1], *place, 1.2)]
        position = pl.DataFrame(where, schema=["t_ns", "pos_x", "pos_y", "pos_z"], orient="row")
        tables = {"radio": (pl.concat(parts),), "position": (position,)}
        stretches.append(Stretch({}, tables, {"device": {"phone": name}}, table(model=False), name))
    found = RadioCalibration().calibrate(stretches)
    assert found.values["offsets_db"]["phone one"] == pytest.approx(3.0, abs=0.5)
    assert sum(found.values["offsets_db"].values()) == pytest.approx(0.0, abs=1e-9)
    own = {a["mac"]: a for a in found.values["anchors"]}
    assert np.mean([a["p_d0"] for a in own.values()]) == pytest.approx(-57.55, abs=1.0)


def test_coverage_is_that_of_a_grid():
    grid = [np.array([x, y, 0.0]) for x in range(0, 11, 2) for y in range(0, 5, 2)]
    found = coverage(grid)
    assert found["area_m2"] == pytest.approx(40.0)
    assert found["most_m"] == pytest.approx(np.sqrt(2.0), abs=0.1)
    assert coverage([np.zeros(3), np.ones(3)])["area_m2"] == 0.0


def test_the_smoother_is_nearer_than_the_filter_and_says_so_honestly():
    path = walk()
    tables = {"radio": {"/indoor/radio": heard(path, 4.0)}}
    ahead = drive(make("indoor.fused", seed=3), tables, attachments=table())
    whole = drive(make("indoor.smooth", seed=3), tables, attachments=table())
    assert make("indoor.smooth").offline
    assert errors(whole["position"], path).mean() < errors(ahead["position"], path).mean()
    sd = whole["sigma"].select("sigma_pos_x", "sigma_pos_y").to_numpy()
    delta = errors(whole["position"], path)
    assert (delta**2 < 5.991 * (sd**2).sum(axis=1)).mean() > 0.85


def test_simulated_walks_lie_within_the_bounds_of_consistency(tmp_path):
    """NEES of the particle filter over 16 walks at one time lies in its χ² bounds, with the simulator's own figures.

    At one time, as errors of one walk hang together (Bar-Shalom et al. 2001, section 5.4). The start is drawn from
    the doubt that the filter is told. Over three times the bounds are those of 99.9 %: three chances to miss.
    """
    from scipy.stats import chi2

    told = "known_start=true,fast_db=3,slow_db=2,correlation_m=3,heading_sd_deg=6,scale_sd=0.07"
    rng = np.random.default_rng(11)
    walks, times = 16, (0.35, 0.65, 0.98)
    nees = np.empty((walks, len(times)))
    for k in range(walks):
        made = simulate(
            "floor-walk",
            tmp_path,
            seed=500 + k,
            blocked_share=0.0,
            rest_s=3.0,
            step_m=rng.uniform(0.62, 0.78),
        )
        convert(made.paths, tmp_path / "w.mcap", overwrite=True)
        rec = open_recording(tmp_path / "w.mcap")
        x, y = np.array([2.5, 2.2]) + rng.standard_normal(2)
        run = replay(rec, [f"indoor.fused[{told},start_x={x:.3f},start_y={y:.3f}]"], metrics=False).runs[0]
        truth, at, sd = rec.table("/reference/pose"), run.tables["position"], run.tables["sigma"]
        t = at["t_ns"].to_numpy()
        rows = np.searchsorted(t, t[0] + np.array(times) * (t[-1] - t[0]))
        nees[k] = 0.0
        for axis in "xy":
            wrong = at[f"pos_{axis}"].to_numpy() - np.interp(t, truth["t_ns"], truth[f"pos_{axis}"])
            nees[k] += (wrong[rows] / sd[f"sigma_pos_{axis}"].to_numpy()[rows]) ** 2
    low, high = chi2.ppf([0.0005, 0.9995], 2 * walks) / walks
    assert ((nees.mean(axis=0) > low) & (nees.mean(axis=0) < high)).all(), (low, nees.mean(axis=0), high)


def test_given_steps_are_not_detected_a_second_time():
    """Steps of 0.5 m and accelerations of the same steps together go 10 m, not 20."""
    n = 20
    steps = pl.DataFrame(
        {"t_ns": np.arange(1, n + 1) * 500_000_000, "length_m": np.full(n, 0.5), "heading_rad": np.zeros(n)}
    )
    t = np.arange(0, 10, 0.02)
    up = 9.8 + 2 * np.sin(2 * np.pi * t / 0.5)
    imu = pl.DataFrame({"t_ns": (t * 1e9).astype(np.int64), "acc_x": 0 * t, "acc_y": 0 * t, "acc_z": up})
    turn = pl.DataFrame({"t_ns": [0], "quat_w": [1.0], "quat_x": [0.0], "quat_y": [0.0], "quat_z": [0.0]})
    tables = {"steps": {"/s": steps}, "imu": {"/phone/acc": imu}, "orientation": {"/phone/orientation": turn}}
    given = {
        "known_start": True,
        "heading_sd_deg": 1.0,
        "scale_sd": 0.01,
        "step_sd": 0.01,
        "turn_sd_deg": 1.0,
    }
    # the steps' channel is in no plan's frame: their headings are from east, and the plan's x axis points there
    plan = {"plan.geojson": json.dumps({"x_axis_azimuth_deg": 90.0, "features": []}).encode()}
    found = drive(make("indoor.fused", walls=False, **given), tables, attachments=plan)
    end = found["position"].select("pos_x", "pos_y").row(-1)
    assert end == pytest.approx((10.0, 0.0), abs=0.5)
    north = {"plan.geojson": json.dumps({"x_axis_azimuth_deg": 1e-9, "features": []}).encode()}
    found = drive(make("indoor.fused", walls=False, **given), tables, attachments=north)
    assert found["position"].select("pos_x", "pos_y").row(-1) == pytest.approx((0.0, -10.0), abs=0.5)


def test_zones_have_probabilities_and_do_not_flicker():
    t = np.arange(61) * 100_000_000
    x = 10.0 + np.concatenate([np.full(20, -3.0), 0.2 * (-1.0) ** np.arange(21), np.full(20, 3.0)])
    tables = {
        "position": {"/p": pl.DataFrame({"t_ns": t, "pos_x": x, "pos_y": np.full(61, 4.0)})},
        "sigma": {"/s": pl.DataFrame({"t_ns": t, "sigma_pos_x": np.ones(61), "sigma_pos_y": np.ones(61)})},
    }
    found = drive(make("indoor.zones"), tables, attachments={"plan.geojson": json.dumps(PLAN).encode()})
    table_ = found["zone"]
    assert table_.select(
        pl.sum_horizontal("west", "east", "outside")
    ).to_series().to_numpy() == pytest.approx(1.0)
    assert table_["west"][5] > 0.95 > 0.7 > table_["west"][30] > 0.3
    assert found["stay"]["zone"].to_list() == [0.0, 1.0]  # once in the west, once in the east
    with pytest.raises(AlgorithmError, match="names no zone"):
        drive(make("indoor.zones"), tables)


def test_floors_change_with_stairs_and_not_with_the_weather():
    t = np.arange(0, 1200, 0.2)
    height = np.interp(t, [0, 300, 320, 600, 640, 1200], [0, 0, 3.4, 3.4, 10.2, 10.2])
    weather = 30.0 * np.sin(2 * np.pi * t / 7200)  # at first 1 hPa an hour, which is 8 m of height
    noise = 1.5 * np.random.default_rng(2).standard_normal(len(t))
    pressure = 101_325 * np.exp(-height / 8434.5) + weather + noise
    table_ = pl.DataFrame({"t_ns": (t * 1e9).astype(np.int64), "pressure_pa": pressure})
    found = drive(make("indoor.floors"), {"pressure": {"/phone/pressure": table_}})
    assert found["change"]["to"].to_list() == [1.0, 2.0, 3.0]
    at = found["change"]["t_ns"].to_numpy() / 1e9
    assert (at > [300, 600, 620]).all()
    assert (at < [330, 630, 650]).all()


def test_a_radio_map_is_judged_on_the_path_that_it_does_not_know(tmp_path):
    from marcha.replay.leave_out import leave_one_out

    recs = []
    for seed in (1, 2, 3):
        made = simulate("floor-walk", tmp_path, seed=seed, shadow_db=1.0, rest_s=2.0)
        convert(made.paths, tmp_path / f"{seed}.mcap")
        recs.append(open_recording(tmp_path / f"{seed}.mcap"))
    runs = leave_one_out(recs, ["indoor.fingerprint[window_s=2]"], params={"cell_m": 1.0})
    assert len(runs) == 3
    assert np.mean([r[0].metrics["position_error_mean_m"] for r in runs.values()]) < 3.5
    with pytest.raises(MarchaError, match="two recordings"):
        leave_one_out(recs[:1], ["indoor.fingerprint"])


@pytest.mark.data
def test_walls_of_the_shops_help_dead_reckoning_on_both_paths(data_dir, tmp_path):
    """Steps from the first waypoint, shops closed; the hybrid without anchors says what to run instead."""
    folder = data_dir / "indoor" / "android_paths"
    free_m, wall_m = [], []
    for name, (x, y) in (
        ("5dd9efa99191710006b57090", (143.9522, 85.64752)),
        ("5dda0221c5b77e0006b17410", (84.03667, 139.25401)),
    ):
        inputs = [folder / f"{name}.txt", folder / "geojson_map.json", folder / "floor_info.json"]
        convert(inputs, tmp_path / f"{name}.mcap", options={"plan.rooms": "obstacle"})
        rec = open_recording(tmp_path / f"{name}.mcap")
        with pytest.raises(MarchaError, match=r"anchors\.csv.*phone\.pdr"):
            replay(rec, ["indoor.hybrid"])
        start = f"preset=walls,start_x={x},start_y={y}"
        runs = replay(
            rec, [f"indoor.fused[{start}]", f"indoor.fused[{start},walls=false]"], metrics=False
        ).runs
        points = rec.table("/reference/position")[1:]
        for run, into in zip(runs, (wall_m, free_m), strict=True):
            track = run.tables["position"]
            at = [np.interp(points["t_ns"], track["t_ns"], track[c]) for c in ("pos_x", "pos_y")]
            into.append(
                np.hypot(at[0] - points["pos_x"].to_numpy(), at[1] - points["pos_y"].to_numpy()).mean()
            )
    assert all(w <= f for w, f in zip(wall_m, free_m, strict=True)), (wall_m, free_m)
    assert np.mean(wall_m) < 0.95 * np.mean(free_m)


def test_shadowing_is_a_field_of_unit_variance_and_exponential_correlation():
    place = np.column_stack([np.linspace(0, 3, 4), np.zeros(4)])
    draws = np.array([shadowing(place, 3.0, np.random.default_rng(k)) for k in range(3000)])
    assert draws.std(axis=0) == pytest.approx(1.0, abs=0.05)
    correlation = np.asarray(np.corrcoef(draws.T))[0]
    assert correlation == pytest.approx(np.exp(-place[:, 0] / 3.0), abs=0.07)


def test_the_simulated_floor_states_its_sigma_and_repeats_itself():
    quiet = floor_walk("floor-walk", seed=4, shadow_db=0.0, multipath_db=0.0, blocked_share=0.0)
    for anchor in ANCHORS:
        mine = quiet.radio.filter(pl.col("mac") == anchor.mac)
        model = anchor.p_d0 - 10 * anchor.eta * np.log10(mine["true_m"].to_numpy())
        assert np.abs(mine["rssi_dbm"].to_numpy() - model).max() <= 0.5  # whole dB
    loud = floor_walk("floor-survey", seed=4, blocked_share=0.0)
    left = []
    for anchor in ANCHORS:
        mine = loud.radio.filter((pl.col("mac") == anchor.mac) & (pl.col("rssi_dbm") > -88))
        left.append(
            mine["rssi_dbm"].to_numpy() - anchor.p_d0 + 10 * anchor.eta * np.log10(mine["true_m"].to_numpy())
        )
    spread = np.hypot(loud.options.shadow_db, loud.options.multipath_db)
    assert np.concatenate(left).std() == pytest.approx(spread, rel=0.15)
    assert floor_walk("floor-walk", seed=4).radio.equals(floor_walk("floor-walk", seed=4).radio)
    start = quiet.position[0]
    assert start == pytest.approx([2.5, 2.2], abs=0.05)
    assert quiet.position[-1] == pytest.approx([20.5, 3.7], abs=0.6)


def test_a_simulated_walk_becomes_a_track_on_the_plan(tmp_path):
    assert set(FLOOR_SCENARIOS) >= {"floor-walk", "floor-points", "floor-survey"}
    made = simulate("floor-walk", tmp_path, seed=2)
    done = convert(made.paths, tmp_path / "w.mcap")
    assert not done.report.findings
    rec = open_recording(tmp_path / "w.mcap")
    start = "known_start=true,start_x=2.5,start_y=2.2"
    replay(
        rec,
        [f"indoor.fused[{start}]", f"indoor.pdr[{start}]", "indoor.fused+indoor.zones"],
        out=tmp_path / "d.mcap",
    )
    runs = evaluate(open_recording(tmp_path / "d.mcap")).runs
    found = {r.estimator: r for r in reversed(runs)}
    fused = found["indoor.fused"].metrics
    assert found["indoor.fused"].alignment == found["indoor.pdr"].alignment == "none"
    assert fused["position_error_mean_m"] < 1.5 < found["indoor.pdr"].metrics["position_error_end_m"] + 1.5
    assert 80 < fused["ellipse95_percent"] <= 100
    assert {"position_error_mean_m.west_hall", "position_error_mean_m.heard6"} <= set(fused)
    rec = open_recording(tmp_path / "d.mcap")
    lineage = next(m for n, m in rec.metadata.items() if n == f"run/{found['indoor.fused'].run}")
    errors_ = position_errors(recording_view(rec, lineage, None))
    assert errors_ is not None
    assert errors_["error_m"].to_numpy().mean() == pytest.approx(fused["position_error_mean_m"], abs=0.01)
    assert set(errors_["zone"]) == {"west hall", "corridor", "east hall"}
    assert abs(HELD_Z - FLOOR[0, 1]) < 1  # both lie on one floor


def test_figures_of_a_floor_show_what_the_recording_says(tmp_path):
    import marcha.viz as viz
    from marcha.replay.geometry import geometry_of

    made = simulate("floor-walk", tmp_path, seed=2)
    convert(made.paths, tmp_path / "w.mcap")
    rec = open_recording(tmp_path / "w.mcap")
    replay(rec, ["indoor.trilateration", "indoor.pdr", "indoor.fused"], out=tmp_path / "d.mcap")
    rec = open_recording(tmp_path / "d.mcap")
    for kind in ("geometry", "radiomap", "ranges", "powers", "threshold", "triples", "points", "particles"):
        drawn = viz.figure(rec, kind=kind)
        assert any(ax.has_data() for ax in drawn.axes), kind
    from .test_viz_rrd import column, statics

    viz.write_rrd(rec, tmp_path / "v.rrd")  # powers with the model's line, particles and triples in the plan
    mac = rec.table("/phone/radio")["mac"][0].replace(":", "\\:")
    _, line = column(tmp_path / "v.rrd", f"/phone/radio/{mac}/model", "Scalars:scalars")
    assert np.isfinite(line).all()
    for output, run in (("particles", "indoor_fused"), ("triples", "indoor_trilateration")):
        times, _ = column(tmp_path / "v.rrd", f"/run/{run}_phone_radio/{output}", "Points3D:positions")
        assert len(times) == rec.table(f"/estimate/{run}_phone_radio/{output}")["t_ns"].n_unique()
    # on a plan a track stays where it is: no transform but the identity
    moved = statics(tmp_path / "v.rrd", "/run/indoor_fused_phone_radio", "Transform3D:translation")
    np.testing.assert_array_equal(np.ravel(moved), 0.0)
    found = geometry_of(rec)
    known = np.isfinite(found.bound_m)
    assert (found.extra_bound_m[known] <= found.bound_m[known] + 1e-9).all()  # another anchor never harms
    assert np.nanmedian(found.extra_bound_m) < np.nanmedian(found.bound_m)
    near = np.linalg.norm(FLOOR - [found.x[10], found.y[10]], axis=1) <= 10
    assert found.heard[10, 10] == near.sum()


def test_walkthrough_of_a_floor(tmp_path, monkeypatch):
    """A log, an anchor table and a picture of the floor: three commands to a track with its error distribution."""
    from PIL import Image

    from .cli_helpers import marcha
    from .conftest import ROOT
    from .docs_blocks import blocks, commands

    (folder, *_), _ = simulate("floor-walk", tmp_path, seed=3, name="walk").paths, None
    (folder / "anchors.csv").rename(tmp_path / "beacons.csv")
    (folder / "plan.geojson").unlink()
    Image.new("RGB", (500, 168), "white").save(tmp_path / "floor.png")
    monkeypatch.chdir(tmp_path)
    first = next(b for b in blocks(ROOT / "docs" / "indoor.md", "bash") if b.runs)
    three = commands(first.text)
    assert len(three) == 3
    said = ""
    for command in three:
        done = marcha(*command.words)
        assert done.code == 0, f"{command.words}\n{done.out}{done.err}"
        said += done.out
    assert "position_error_p95_m" in said
    assert (tmp_path / "error.png").exists()
