"""The simulated phone: its readings agree with its truth, and every error is the one that was asked for."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from marcha.ingest.simulate import PHONE_SCENARIOS, PhoneWalk, phone_walk
from marcha.recording import UsageError
from scipy.spatial.transform import Rotation

PLACEMENTS = ("hand", "pocket", "bag", "armband", "neck", "swinging")


def attitude(walk: PhoneWalk) -> Rotation:
    return Rotation.from_quat(np.roll(walk.quat_wxyz, -1, axis=1))


@pytest.fixture(scope="module", params=PLACEMENTS)
def ideal(request: pytest.FixtureRequest) -> PhoneWalk:
    route = "12:right 90,8:left 90,6"
    return phone_walk(
        "phone-turns", route=route, placement=request.param, rate_hz=200, errors="none", jitter_s=0
    )


def test_angular_rate_integrates_to_the_attitude(ideal: PhoneWalk) -> None:
    got = attitude(ideal)[0]
    for rate in ideal.gyr_true[:-1] / 2 + ideal.gyr_true[1:] / 2:
        got = got * Rotation.from_rotvec(rate / 200)
    assert np.degrees((got.inv() * attitude(ideal)[-1]).magnitude()) < 0.5


def test_specific_force_integrates_to_the_track(ideal: PhoneWalk) -> None:
    """Twice integrated from the true attitude it ends where the walker does; levers are back in place."""
    acc = attitude(ideal).apply(ideal.acc_true) - [0, 0, ideal.options.gravity]
    vel = np.cumsum(acc, axis=0) / 200
    vel -= vel[:800].mean(axis=0)  # who stands sways, but stays: so fast was the first sample
    pos = np.cumsum(vel, axis=0) / 200
    assert np.linalg.norm(pos[-1] - (ideal.pos[-1] - ideal.pos[0])) < 0.5
    assert np.abs(vel[-1]).max() < 0.1


def test_field_points_to_magnetic_north(ideal: PhoneWalk) -> None:
    field = attitude(ideal).apply(ideal.mag_b)
    bearing = np.arctan2(field[:, 0], field[:, 1])
    assert np.degrees(ideal.declination_rad) == pytest.approx(-21.8, abs=0.3)  # WMM, Campinas 2026
    assert np.abs(bearing - ideal.declination_rad).max() < 1e-6


def test_steps_lie_on_the_track(ideal: PhoneWalk) -> None:
    steps = ideal.steps
    assert steps["length_m"].sum() == pytest.approx(26.0, abs=0.6)  # chords of rounded corners are shorter
    assert steps["start_ns"].is_sorted()
    assert (steps["end_ns"] > steps["start_ns"]).all()
    east = (steps["length_m"] * steps["heading_rad"].cos()).sum()
    north = (steps["length_m"] * steps["heading_rad"].sin()).sum()
    assert np.allclose(np.array([east, north]), ideal.pos[-1, :2], atol=1e-6)


@pytest.mark.parametrize("placement", PLACEMENTS)
def test_each_step_is_in_the_signal(placement: str) -> None:
    """The norm of the acceleration repeats itself from step to step, or from stride to stride."""
    walk = phone_walk("phone-50m", placement=placement, rate_hz=50, step_sd=0.01)
    norm = np.linalg.norm(walk.acc_b[walk.walking], axis=1)
    power = np.abs(np.fft.rfft((norm - norm.mean()) * np.hanning(len(norm)))) ** 2
    hz = np.fft.rfftfreq(len(norm), 1 / 50)
    peak = hz[np.argmax(power * (hz > 0.5))]
    assert min(abs(peak - 1 / 0.55), abs(peak - 0.5 / 0.55)) < 0.06
    assert norm.std() > 1.0


def test_placements_differ_and_a_loop_closes() -> None:
    walks = [phone_walk("phone-loop", placement=p, rate_hz=20, seed=3) for p in PLACEMENTS]
    assert all(w.closed and np.linalg.norm(w.pos[-1]) < 1e-3 for w in walks)
    assert all(w.steps.equals(walks[0].steps) for w in walks)
    assert len({round(float(w.acc_b[0, 2]), 3) for w in walks}) == 6


def test_right_turns_are_right() -> None:
    walk = phone_walk("phone-turns", route="10:right 90,10", course_deg=0, step_sd=0)
    assert walk.pos[-1, 0] > 9 and walk.pos[-1, 1] > 9  # noqa: PT018 - north, then east
    turned = walk.heading_rad[-1] - walk.heading_rad[0]
    assert np.degrees(turned) == pytest.approx(-90)


def test_an_error_switched_off_leaves_the_others_alone() -> None:
    a = phone_walk("phone-10m", seed=5)
    b = phone_walk("phone-10m", seed=5, hard_iron_t=(0, 0, 0), gnss_sigma_m=0, disturbance_t=3e-5)
    assert np.array_equal(a.acc_b, b.acc_b)
    assert np.array_equal(a.gyr_b, b.gyr_b)
    assert not np.array_equal(a.mag_b, b.mag_b)
    assert np.array_equal(phone_walk("phone-10m", seed=5).mag_b, a.mag_b)
    assert not np.array_equal(phone_walk("phone-10m", seed=6).acc_b, a.acc_b)


def test_magnetometer_has_the_asked_iron_and_disturbance() -> None:
    walk = phone_walk("phone-50m", hard_iron_t=(1e-5, -2e-5, 3e-5), soft_iron=0, disturbance_t=4e-5)
    assert np.allclose((walk.mag_b - walk.mag_true).mean(axis=0), [1e-5, -2e-5, 3e-5], atol=1e-7)
    share = walk.disturbed.mean()
    assert 0.15 < share < 0.6
    size = np.linalg.norm(walk.mag_true, axis=1)
    assert np.abs(size[walk.disturbed] - size[0]).max() > 1e-5
    assert np.abs(size[~walk.disturbed] - size[0]).max() < 2e-6


def test_fixes_err_as_they_state() -> None:
    """Standard deviation of the fixes' error is the stated one; losses are empty; an outlier is one."""
    walk = phone_walk(
        "phone-rest",
        duration_s=800,
        pressure_hz=0,
        rate_hz=5,
        gnss_tau_s=2,
        gnss_loss=((100, 60),),
        gnss_outliers=((300, 50),),
    )
    t = (walk.fixes["t_ns"] - walk.t_ns[0]).to_numpy() / 1e9
    assert not ((t >= 100) & (t < 160)).any()
    metre = np.pi / 180 * 6.378e6
    north = (walk.fixes["lat_deg"].to_numpy() - walk.options.lat_deg) * metre * 0.9943
    east = (walk.fixes["lon_deg"].to_numpy() - walk.options.lon_deg) * metre
    east *= np.cos(np.radians(walk.options.lat_deg)) * 1.0005
    error = np.hypot(east, north)
    assert np.argmax(error) == np.argmin(np.abs(t - 300))
    assert error.max() == pytest.approx(50, abs=10)
    good = error < 20
    stated = walk.fixes["sd_north_m"][0]
    assert north[good].std() == pytest.approx(stated, rel=0.15)
    assert east[good].std() == pytest.approx(stated, rel=0.15)


def test_floors_show_in_the_barometer() -> None:
    walk = phone_walk("phone-floors", pressure_noise_pa=0)
    pressure = walk.pressure["pressure_pa"].to_numpy()
    fall = pressure[:10].mean() - pressure[-10:].mean()
    assert fall == pytest.approx(6.8 * 11.2, rel=0.15)  # about 11.2 Pa a metre at 645 m
    assert walk.steps["height_m"].sum() == pytest.approx(6.8, abs=0.01)


def test_rest_and_handling_have_no_steps() -> None:
    rest = phone_walk("phone-rest", duration_s=20)
    assert not len(rest.steps)
    assert np.linalg.norm(rest.acc_b, axis=1).std() < 0.06
    handled = phone_walk("phone-handled", duration_s=60, seed=1)
    assert not len(handled.steps)
    assert np.linalg.norm(handled.acc_b, axis=1).std() > 0.2
    turned = (attitude(handled)[0].inv() * attitude(handled)).magnitude()
    assert np.degrees(turned.max()) > 25


@pytest.mark.parametrize("rate", [10, 100])
def test_rates(rate: float) -> None:
    walk = phone_walk("phone-10m", rate_hz=rate)
    assert np.median(np.diff(walk.t_ns)) == pytest.approx(1e9 / rate, rel=0.02)
    assert (np.diff(walk.t_ns) > 0).all()
    assert len(walk.steps) == 14


@pytest.mark.parametrize("scenario", PHONE_SCENARIOS)
def test_every_scenario_is_finite(scenario: str) -> None:
    walk = phone_walk(scenario, rate_hz=10, duration_s=10)
    for values in (walk.acc_b, walk.gyr_b, walk.mag_b, walk.pos, walk.vel, walk.quat_wxyz):
        assert np.isfinite(values).all()
    assert len(walk.fixes)
    assert len(walk.pressure)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"placement": "ear"}, "placement"),
        ({"speed": 1}, "has no option 'speed'"),
        ({"route": "20:up 90"}, "is no leg"),
        ({"start": "today"}, "ISO 8601"),
        ({"gnss_loss": "10"}, "gnss_loss"),
    ],
)
def test_refuses(options: dict[str, Any], said: str) -> None:
    with pytest.raises(UsageError, match=said):
        phone_walk("phone-50m", **options)


def test_options_as_text() -> None:
    walk = phone_walk("phone-50m", gnss_loss="10:20", hard_iron_t="1e-5,0,0", gyr_noise="0")
    assert walk.options.gnss_loss == ((10.0, 20.0),)
    assert walk.hard_iron_t.tolist() == [1e-5, 0, 0]
    assert walk.options.imu is not None
    assert walk.options.imu.gyr_noise == 0
