"""Indoor estimators on synthetic radio: calibrated, located, refused where it cannot be done."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest
from marcha.algorithms import AlgorithmError, Stretch, make
from marcha.algorithms.indoor.anchors import parse_anchors
from marcha.algorithms.indoor.calibrate import RadioCalibration
from marcha.algorithms.indoor.hybrid import steady_gain
from marcha.algorithms.indoor.steps import azimuth_of, compass, make_state, plan_heading, take_acceleration

from .event_loop import context_of, drive

FLOOR = np.array([[23.1, 1.5], [1.5, 6.9], [3.9, 1.5], [8.1, 5.7], [18.3, 6.3], [17.7, 0.9]])
ETA = (2.43, 2.12, 1.71, 1.61, 1.53, 1.68)
MACS = [f"02:00:00:00:00:0{i + 1}" for i in range(6)]


def table(keep=range(6), model=True) -> dict[str, bytes]:
    rows = ["mac,technology,x,y,z,p_d0,eta,name"]
    for i in keep:
        of = f"-57.55,{ETA[i]}" if model else ","
        rows.append(f"{MACS[i]},ble,{FLOOR[i, 0]},{FLOOR[i, 1]},1.2,{of},a{i + 1}")
    return {"anchors.csv": "\n".join(rows).encode()}


def heard(path: np.ndarray, sigma: float, keep=range(6), dt=0.1, seed=0) -> pl.DataFrame:
    """Powers of each anchor in turn along a path, one every ``dt``."""
    rng = np.random.default_rng(seed)
    keep = list(keep)
    i = np.array([keep[k % len(keep)] for k in range(len(path))])
    d = np.maximum(np.linalg.norm(path - FLOOR[i], axis=1), 0.3)
    rssi = -57.55 - 10 * np.array(ETA)[i] * np.log10(d) + sigma * rng.standard_normal(len(path))
    t = (np.arange(len(path)) * dt * 1e9).astype(np.int64)
    return pl.DataFrame({"t_ns": t, "mac": [MACS[k] for k in i], "rssi_dbm": rssi})


def walk(n=600) -> np.ndarray:
    return np.column_stack([np.linspace(3, 21, n), np.full(n, 4.0)])


def errors(found: pl.DataFrame, path: np.ndarray, dt=0.1) -> np.ndarray:
    t = found["t_ns"].to_numpy() / 1e9
    at = np.column_stack([np.interp(t, np.arange(len(path)) * dt, path[:, k]) for k in (0, 1)])
    return np.linalg.norm(found.select("pos_x", "pos_y").to_numpy() - at, axis=1)


@pytest.mark.parametrize("method", ["triples", "wls"])
def test_powers_without_noise_give_the_position(method):
    still = np.tile([10.0, 4.0], (200, 1))
    estimator = make("indoor.trilateration", method=method, correction="none", reach_m=0)
    found = drive(estimator, {"radio": {"/indoor/radio": heard(still, 0.0)}}, attachments=table())
    assert found["position"].height == 3
    assert errors(found["position"], still).max() < 1e-5
    assert found["position"]["t_ns"].to_list() == [5_000_000_000, 10_000_000_000, 15_000_000_000]
    assert not any(r.fatal for r in estimator.remarks())


def test_anchors_beyond_the_reach_are_left_out_before_the_correction():
    still = np.tile([10.0, 4.0], (120, 1))
    found = drive(
        make("indoor.trilateration", reach_m=9.0),
        {"radio": {"/indoor/radio": heard(still, 0.0)}},
        attachments=table(),
    )
    near = np.linalg.norm(FLOOR - [10.0, 4.0], axis=1) <= 9.0
    assert 0 < near.sum() < 6
    assert set(found["ranges"]["mac"]) == {m for m, n in zip(MACS, near, strict=True) if n}
    assert found["ranges"]["distance_m"].to_numpy().max() <= 9.0


@pytest.mark.parametrize(("keep", "kind"), [((0, 2), "too_few_anchors"), ((0, 1), "too_few_anchors")])
def test_too_few_anchors_are_said_and_never_a_fix(keep, kind):
    still = np.tile([10.0, 4.0], (200, 1))
    estimator = make("indoor.trilateration", reach_m=0)
    found = drive(estimator, {"radio": {"/indoor/radio": heard(still, 1.0, keep)}}, attachments=table(keep))
    assert found["position"].is_empty()
    assert any(r.kind == kind and r.fatal for r in estimator.remarks())


def test_anchors_on_a_line_are_said_and_never_a_fix():
    rows = b"mac,x,y,p_d0,eta\n" + b"\n".join(f"{m},{5 * i},0,-57,2".encode() for i, m in enumerate(MACS[:4]))
    still = np.tile([10.0, 4.0], (200, 1))
    estimator = make("indoor.trilateration", reach_m=0, method="wls")
    found = drive(
        estimator, {"radio": {"/r": heard(still, 1.0, range(4))}}, attachments={"anchors.csv": rows}
    )
    assert found["position"].is_empty()
    assert any(r.kind == "collinear_anchors" and r.fatal for r in estimator.remarks())


@pytest.mark.parametrize("name", ["indoor.trilateration", "indoor.fused", "indoor.hybrid"])
def test_without_anchor_positions_it_says_what_to_run_instead(name):
    estimator = make(name)
    tables = {"radio": {"/indoor/radio": heard(walk(50), 1.0)}}
    with pytest.raises(AlgorithmError, match=r"anchors\.csv.*pdr"):
        estimator.start(context_of(estimator, tables))


def test_the_particle_filter_follows_and_knows_its_error():
    path = walk()
    estimator = make("indoor.fused", seed=3)
    found = drive(estimator, {"radio": {"/indoor/radio": heard(path, 5.0)}}, attachments=table())
    wrong = errors(found["position"], path)
    assert found["position"].height == len(path)
    assert wrong[100:].mean() < 2.0
    delta = wrong[100:] ** 2 / (
        found["sigma"].select("sigma_pos_x", "sigma_pos_y").to_numpy()[100:] ** 2
    ).sum(axis=1)
    assert (delta < 5.991).mean() > 0.8


def test_anchors_go_off_and_on_in_mid_track():
    """While four of six anchors are silent the error and the stated sigma grow; both come back with them."""
    path = walk(900)
    radio = heard(path, 4.0, seed=2)
    second = radio["t_ns"].to_numpy() / 1e9
    off = (second >= 30) & (second < 60)
    gone = set(MACS[2:])
    silent = radio.filter(~(pl.Series(off) & radio["mac"].is_in(gone)))
    whole = drive(make("indoor.fused", seed=3), {"radio": {"/r": radio}}, attachments=table())
    found = drive(make("indoor.fused", seed=3), {"radio": {"/r": silent}}, attachments=table())
    t = found["position"]["t_ns"].to_numpy() / 1e9
    wrong = errors(found["position"], path)
    sd = np.hypot(*found["sigma"].select("sigma_pos_x", "sigma_pos_y").to_numpy().T)
    during, after = (t >= 40) & (t < 60), (t >= 65) & (t < 88)
    all_heard = np.hypot(*whole["sigma"].select("sigma_pos_x", "sigma_pos_y").to_numpy().T)
    all_t = whole["position"]["t_ns"].to_numpy() / 1e9
    assert (
        sd[during].mean() > 1.2 * all_heard[(all_t >= 40) & (all_t < 60)].mean()
    )  # it says that it knows less
    assert (wrong[during] ** 2 < 5.991 * sd[during] ** 2).mean() > 0.85  # and is right
    assert wrong[after].mean() < 2.0
    assert sd[after].mean() < 1.25 * all_heard[(all_t >= 65) & (all_t < 88)].mean()


def test_the_particle_filter_gives_the_same_bits_in_blocks_and_after_a_restore():
    path, radio = walk(200), heard(walk(200), 4.0)
    one = make("indoor.fused", particles=50)
    single = drive(one, {"radio": {"/indoor/radio": radio}}, attachments=table())["position"]
    other = make("indoor.fused", particles=50)
    other.start(context_of(other, {"radio": {"/indoor/radio": radio}}, attachments=table()))
    values = np.full((len(path), 4), np.nan)
    values[:, :2] = other.encode(0, 0, radio)
    t = radio["t_ns"].to_numpy()
    rows = []
    for first, last in ((0, 70), (70, 71), (71, 200)):
        saved = other.snapshot()
        count, out = 0, np.empty((0, 6))
        for again in range(2):  # the second time after a restore
            if again:
                other.restore(saved)
            n = last - first
            at, when, out = np.zeros(n, np.int64), np.zeros(n, np.int64), np.full((n, 6), np.nan)
            zero = np.zeros(n, np.int64)
            count = other.run(other.state, zero, zero, t[first:last], values[first:last], at, when, out)
        rows.append(out[:count, :2])
    assert np.vstack(rows).tobytes() == single.select("pos_x", "pos_y").to_numpy().tobytes()


def test_walls_hold():
    """Two rooms, powers that say nothing of the side: no particle gets through the wall between."""
    plan = (
        b'{"type":"FeatureCollection","features":['
        b'{"type":"Feature","properties":{"kind":"passable"},"geometry":{"type":"Polygon","coordinates":'
        b"[[[0,0],[24,0],[24,8],[0,8],[0,0]]]}},"
        b'{"type":"Feature","properties":{"kind":"wall"},"geometry":{"type":"LineString","coordinates":'
        b"[[0,5],[24,5]]}}]}"
    )
    n = 40
    steps = pl.DataFrame(
        {"t_ns": np.arange(n) * 500_000_000, "length_m": np.full(n, 0.4), "heading_rad": np.full(n, 0.15)}
    )
    start = {"known_start": True, "start_x": 2.0, "start_y": 3.0, "start_sd_m": 0.2, "heading_sd_deg": 10.0}
    ends = {}
    for walls in (True, False):
        estimator = make("indoor.fused", walls=walls, particles=500, **start)
        found = drive(estimator, {"steps": {"/s": steps}}, attachments={"plan.geojson": plan})
        ends[walls] = found["position"]["pos_y"].to_numpy()
    assert ends[True].max() < 5.0 < ends[False].max()


def test_calibration_finds_the_model_and_says_what_is_pooled():
    rng = np.random.default_rng(5)
    parts, where = [], []
    for k in range(30):
        place = rng.uniform([0, 0], [24, 8])
        part = heard(np.tile(place, (120, 1)), 1.0, seed=k).with_columns(pl.col("t_ns") + k * 60_000_000_000)
        parts.append(part.filter(pl.col("mac") != MACS[5]))
        where += [(part["t_ns"][0], *place, 1.2), (part["t_ns"][-1], *place, 1.2)]
    position = pl.DataFrame(where, schema=["t_ns", "pos_x", "pos_y", "pos_z"], orient="row")
    stretch = Stretch(
        {}, {"radio": (pl.concat(parts),), "position": (position,)}, {}, table(model=False), "survey"
    )
    found = RadioCalibration().calibrate([stretch])
    own = {a["mac"]: a for a in found.values["anchors"]}
    for mac, eta in zip(MACS[:5], ETA, strict=False):
        assert own[mac]["eta"] == pytest.approx(eta, abs=0.1)
        assert own[mac]["p_d0"] == pytest.approx(-57.55, abs=1.0)
    assert MACS[5] not in own
    assert any("1 of 6" in r for r in found.remarks)
    estimator = make("indoor.fused")
    drive(
        estimator,
        {"radio": {"/indoor/radio": heard(walk(30), 1.0)}},
        attachments=table(model=False),
        calibrations={"radio": found},
    )
    assert any(r.kind == "pooled_anchors" and "a6" in r.detail for r in estimator.remarks())
    without = Stretch({}, {"radio": (pl.concat(parts),)}, {}, table(model=False), "survey")
    with pytest.raises(AlgorithmError, match="positions"):
        RadioCalibration().calibrate([without])


@pytest.mark.parametrize(
    ("r", "q", "gain"),
    [
        (1, 0.38, 0.455),
        (1.25, 0.005, 0.061),
        (1, 0.05, 0.200),
        (1, 0.5, 0.500),
        (0.1, 0.38, 0.822),
        (1, 0.038, 0.177),
    ],
)
def test_steady_gains(r, q, gain):
    assert steady_gain(r, q) == pytest.approx(gain, abs=1e-3)
    variance, k = 1.0, 0.0
    for _ in range(500):
        k = (variance + q) / (variance + q + r)
        variance = (1 - k) * (variance + q)
    assert k == pytest.approx(steady_gain(r, q), abs=1e-9)


def detector(**kwargs):
    given = {"threshold": 0.55, "least_s": 0.15, "most_s": 0.4, "gravity_s": 0.08, "along_gravity": False}
    return make_state(**(given | kwargs))


def test_gravity_at_rest_is_removed_wholly():
    state = detector()
    for k in range(500):
        take_acceleration(state[0], k * 20_000_000, 0.473, 0.453, 9.404)
    assert state[0]["grav"] == pytest.approx([0.473, 0.453, 9.404], abs=1e-12)


@pytest.mark.parametrize(("period", "steps"), [(0.5, True), (0.1, False), (2.0, False)])
def test_a_step_takes_as_long_as_a_step(period, steps):
    """Both passages half a period apart: 0.25 s is a step, 0.05 s and 1 s are not."""
    state = detector(gravity_s=5.0)
    count = 0
    for k in range(1000):
        z = 9.8 + 2.0 * np.sin(2 * np.pi * k * 0.01 / period)
        count += take_acceleration(state[0], k * 10_000_000, 0.0, 0.0, z)
    assert count == pytest.approx(10 / period, abs=1) if steps else count <= 1


def test_headings():
    assert azimuth_of(1, 0, 0, 0) == 0.0  # y points north
    half = np.pi / 4
    assert azimuth_of(np.cos(half), 0, 0, -np.sin(half)) == pytest.approx(np.pi / 2)  # turned clockwise: east
    assert compass(np.array([0.0, 20.0, -40.0]), np.array([0.0, 0.0, 9.8])) == pytest.approx(0.0)
    assert compass(np.array([-20.0, 0.0, -40.0]), np.array([0.0, 0.0, 9.8])) == pytest.approx(np.pi / 2)
    # the plan's x axis points east: walking north is +90° on a right-handed plan, −90° where y points down
    assert plan_heading(0.0, np.pi / 2, False) == pytest.approx(np.pi / 2)
    assert plan_heading(0.0, np.pi / 2, True) == pytest.approx(-np.pi / 2)


def test_the_hybrid_lies_between_its_parts():
    """Steps that drift to the side, noisy powers: the fused track is nearer to the truth than each of them."""
    path = walk(300)
    t = np.arange(0, 30, 0.01)
    imu = pl.DataFrame(
        {
            "t_ns": (t * 1e9).astype(np.int64),
            "acc_x": 0 * t,
            "acc_y": 0 * t,
            "acc_z": 9.8 + 2 * np.sin(2 * np.pi * t / 0.5),
        }
    )
    half = np.radians(-90 + 12) / 2  # azimuth 78° instead of 90°
    orientation = pl.DataFrame(
        {"t_ns": [0], "quat_w": [np.cos(half)], "quat_x": [0.0], "quat_y": [0.0], "quat_z": [np.sin(half)]}
    )
    tables = {
        "radio": {"/indoor/radio": heard(path, 4.0)},
        "imu": {"/phone/acc": imu},
        "orientation": {"/phone/orientation": orientation},
    }
    params = {
        "known_start": True,
        "start_x": 3.0,
        "start_y": 4.0,
        "step_m": 0.3,
        "x_axis_azimuth_deg": 90.0,
        "reach_m": 0.0,
    }
    params |= {"correction": "none", "method": "wls", "gravity_s": 1.0}
    fused = errors(drive(make("indoor.hybrid", **params), tables, attachments=table())["position"], path)
    alone = errors(
        drive(make("indoor.hybrid", **params, r=1e9), tables, attachments=table())["position"], path
    )
    fixes = errors(
        drive(make("indoor.hybrid", **params, q=1e9), tables, attachments=table())["position"], path
    )
    assert alone[-1] > 2.0
    assert fused[-50:].mean() < alone[-50:].mean()
    assert fused.mean() < alone.mean() or fused.mean() < fixes.mean()
    # a window's powers speak of its middle: fixes that are moved by half of its steps do not lag
    moved = errors(
        drive(make("indoor.hybrid", **params, move_fix=True), tables, attachments=table())["position"], path
    )
    assert moved.mean() < fused.mean()


def test_anchor_tables_name_the_line():
    assert len(parse_anchors(table()["anchors.csv"])) == 6
    for bad, said in (
        (b"mac,x,y\na,1,two\n", "line 2: y 'two'"),
        (b"mac,x,y\na,1,2\na,1,2\n", "line 3.*twice"),
        (b"x,y\n1,2", "mac"),
    ):
        with pytest.raises(AlgorithmError, match=said):
            parse_anchors(bad)
