"""Simulated captures of legs: the readings are those of the motion, and the truth is what it says."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from marcha.ingest.simulate import leg
from marcha.ingest.simulate.leg import SCENARIOS, LegCapture
from marcha.recording import MarchaError
from scipy.spatial.transform import Rotation

EXACT = {
    "noise": "none",
    "encoder_noise_deg": 0,
    "encoder_counts": 0,
    "optical_noise_m": 0,
    "dropout_share": 0,
}


@pytest.fixture(scope="module", params=SCENARIOS)
def ideal(request: pytest.FixtureRequest) -> LegCapture:
    return leg(request.param, seed=3, duration_s=12, rate_hz=400, soft_tissue=0.5, **EXACT)


@pytest.mark.parametrize("name", ["trunk", "thigh", "shank", "foot"])
def test_rates_integrate_to_the_true_attitudes(ideal: LegCapture, name: str) -> None:
    s = ideal.segments[name]
    turn = Rotation.from_rotvec(0.5 * (s.true_gyr_b[1:] + s.true_gyr_b[:-1]) / 400)
    rot = Rotation.from_matrix(s.rot_nb[0])
    for step in turn:
        rot = rot * step
    error = (rot.inv() * Rotation.from_matrix(s.rot_nb[-1])).magnitude()
    assert np.degrees(error) < 0.02


@pytest.mark.parametrize("name", ["trunk", "thigh", "shank", "foot"])
def test_specific_force_integrates_to_the_true_path(ideal: LegCapture, name: str) -> None:
    """Rigid mounting: the sensor's path is the segment's; the force without gravity leads along it."""
    rigid = leg(ideal.scenario, seed=3, duration_s=12, rate_hz=400, **EXACT)
    s = rigid.segments[name]
    acc_n = np.einsum("nij,nj->ni", s.rot_nb, s.true_acc_b) - [0, 0, rigid.options.gravity]
    pos = s.pos + s.rot_ns @ s.lever_s
    vel = np.cumsum(0.5 * (acc_n[1:] + acc_n[:-1]) / 400, axis=0)
    moved = np.concatenate(
        (np.zeros((1, 3)), np.cumsum(vel / 400 - 0.5 * np.diff(acc_n, axis=0) / 400**2, axis=0))
    )
    start = (pos[1] - pos[0]) * 400
    t = np.arange(len(pos))[:, None] / 400
    assert np.abs(pos[0] + start * t + moved - pos).max() < 0.02


def test_joints_of_a_hinge_are_differences_of_rolls(ideal: LegCapture) -> None:
    knee, s = ideal.joints["knee"], ideal.segments
    assert np.abs(knee.angle - (s["thigh"].roll - s["shank"].roll)).max() < 1e-12
    assert np.abs(knee.encoder - knee.angle).max() < 1e-9
    assert np.degrees(knee.angle.max()) > 55


def test_a_hinge_keeps_the_rates_across_its_axis_equal(ideal: LegCapture) -> None:
    """Seel's constraint: what both sensors turn across the axis is the same vector's length."""
    rigid = leg(ideal.scenario, seed=3, duration_s=8, mounting="random", **EXACT)
    knee, s = rigid.joints["knee"], rigid.segments
    across = [
        np.linalg.norm(np.cross(s[name].true_gyr_b, axis), axis=1)
        for name, axis in (("thigh", knee.axis_upper_b), ("shank", knee.axis_lower_b))
    ]
    assert np.abs(across[0] - across[1]).max() < 1e-6


def test_the_joint_centre_has_one_acceleration(ideal: LegCapture) -> None:
    rigid = leg(ideal.scenario, seed=3, duration_s=8, rate_hz=400, mounting="random", **EXACT)
    knee, s = rigid.joints["knee"], rigid.segments
    norms = []
    for name, o in (("thigh", knee.from_joint_upper_b), ("shank", knee.from_joint_lower_b)):
        g = s[name].true_gyr_b
        turn = np.cross(g, np.cross(g, o)) + np.cross(np.gradient(g, 1 / 400, axis=0), o)
        norms.append(np.linalg.norm(s[name].true_acc_b - turn, axis=1)[5:-5])
    assert np.abs(norms[0] - norms[1]).max() < 0.05


def test_soft_tissue_moves_the_sensor_but_not_the_bone() -> None:
    soft, rigid = (leg("walking", seed=1, duration_s=10, soft_tissue=k, **EXACT) for k in (1.0, 0.0))
    assert np.array_equal(soft.joints["knee"].angle, rigid.joints["knee"].angle)
    a, b = soft.segments["thigh"], rigid.segments["thigh"]
    off = Rotation.from_matrix(a.rot_nb) * Rotation.from_matrix(b.rot_nb).inv()
    assert 1 < np.degrees(off.magnitude().max()) < 15


def test_the_source_noise_is_that_of_its_table() -> None:
    s = leg("squats", seed=2, duration_s=40).segments["shank"]
    angle = np.std((s.acc_b - s.true_acc_b)[:, 1]) / 9.80665
    rate = np.std((s.gyr_b - s.true_gyr_b - s.bias_gyr)[:50, 0])
    assert angle**2 == pytest.approx(0.0014, rel=0.1)
    assert rate**2 == pytest.approx(1e-7, rel=0.5)


def test_encoder_errors_are_those_that_are_asked_for() -> None:
    exact = leg("squats", seed=2, duration_s=10, encoder_offset_deg=3, **EXACT).joints["knee"]
    assert np.degrees(exact.encoder - exact.angle) == pytest.approx(3, abs=1e-9)
    tilted = leg("squats", seed=2, duration_s=10, encoder_misalignment_deg=5, **EXACT).joints["knee"]
    half = np.tan(tilted.angle / 2) * np.cos(np.radians(5))
    assert tilted.encoder == pytest.approx(2 * np.arctan(half), abs=1e-9)
    shifted = leg("squats", seed=2, duration_s=10, encoder_eccentric_m="0.01,0.01", **EXACT).joints["knee"]
    assert 1 < np.degrees(np.abs(shifted.encoder - shifted.angle).max()) < 6


def test_the_cameras_have_their_own_clock_and_lose_markers() -> None:
    options = {"optical_offset_s": -12.5, "optical_drift_ppm": 40, "optical_start_s": 1, "optical_stop_s": 9}
    o = leg("walking", seed=4, duration_s=10, dropout_share=0.05, **options).optical
    assert o.t_ns / 1e9 == pytest.approx((o.t + 12.5) * (1 + 40e-6), abs=1e-9)
    assert 1 <= o.t[0] < 1.02
    assert 8.98 < o.t[-1] <= 9
    hidden = np.isnan(o.pos[..., 0])
    assert 0.02 < hidden.mean() < 0.1
    assert np.array_equal(np.isnan(o.pos).any(axis=2), hidden)


def test_markers_are_rigid_on_their_segments() -> None:
    o = leg("walking", seed=4, duration_s=6, **EXACT).optical
    at = {name: o.pos[:, k] for k, name in enumerate(o.names)}
    for a, b in (
        ("thigh_1", "thigh_4"),
        ("knee_lat", "knee_med"),
        ("trunk_1", "shoulder_left"),
        ("heel", "toe"),
    ):
        length = np.linalg.norm(at[a] - at[b], axis=1)
        assert np.ptp(length) < 1e-9
    knee = 0.5 * (at["knee_lat"] + at["knee_med"])
    assert np.abs(knee - at["knee"]).max() < 1e-9


def test_both_legs_walk_half_a_cycle_apart() -> None:
    both = leg("walking", seed=5, duration_s=20, sides="both", cycle_sd=0, **EXACT)
    left, right = both.joints["left_knee"].angle, both.joints["right_knee"].angle
    middle = slice(300, 700)
    shift = round(0.5 * np.diff(both.cycle_starts_s).mean() * 50)
    assert np.corrcoef(left[middle], right[middle])[0, 1] < 0.5
    assert np.corrcoef(left[middle], np.roll(right, shift)[middle])[0, 1] > 0.99


def test_seed_and_options_decide_every_bit() -> None:
    a, b = (leg("walking", seed=9, duration_s=5).segments["foot"].acc_b for _ in range(2))
    assert np.array_equal(a, b)
    assert not np.array_equal(a, leg("walking", seed=10, duration_s=5).segments["foot"].acc_b)


@pytest.mark.parametrize(
    ("scenario", "options", "said"),
    [
        ("jumping", {}, "scenario 'jumping' is unknown: choose one of walking, sit-to-stand, squats"),
        ("walking", {"knee": 3}, "has no option 'knee'"),
        ("walking", {"rate_hz": "0"}, "option rate_hz='0'"),
    ],
)
def test_unknown_things_are_named(scenario: str, options: dict[str, Any], said: str) -> None:
    with pytest.raises(MarchaError, match=said):
        leg(scenario, **options)
