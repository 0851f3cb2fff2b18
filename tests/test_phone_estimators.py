"""Estimators of phones: their contract, and a simulated walk from the calibration to the track."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any, ClassVar

import marcha.recording as mr
import marcha.replay as rp
import numpy as np
import polars as pl
import pytest
from marcha.ingest import convert
from marcha.ingest.simulate import PhoneWalk, phone_walk, simulate

from .contracts.estimator import EstimatorContract, Tables
from .phone_runs import run_phone, sensor_tables
from .phone_samples import short_walk


@cache
def sensors() -> dict[str, pl.DataFrame]:
    """Return tables of a walk of 10 m by sensor, about 12 s."""
    return sensor_tables(short_walk(rate_hz=25, rest_s=1.5, pressure_hz=1, seed=4), velocity=True)


class PhoneContract(EstimatorContract):
    """Feed what the estimator takes."""

    def tables(self) -> Tables:
        return {i.name: {f"/phone/{i.name}": sensors()[i.name]} for i in self.make().inputs}


class TestSteps(PhoneContract):
    name = "phone.steps"


class TestSourceSteps(PhoneContract):
    name = "phone.steps"
    params: ClassVar = {"method": "peaks"}


class TestPdr(PhoneContract):
    name = "phone.pdr"


class TestFused(PhoneContract):
    name = "phone.fused"


HARD_IRON = (30e-6, -24e-6, 14e-6)


def turned_about(path: Path, strength_t: float) -> mr.Recording:
    """Record the magnetometer of the same device while it is turned about all axes."""
    directions = np.random.default_rng(6).normal(size=(600, 3))
    field = strength_t * directions / np.linalg.norm(directions, axis=1, keepdims=True) + HARD_IRON
    field += np.random.default_rng(7).normal(scale=0.4e-6, size=field.shape)
    times = pl.Series("t_ns", 10**18 + 20_000_000 * np.arange(600))
    table = pl.DataFrame([times, *(pl.Series(f"mag_{a}", field[:, i]) for i, a in enumerate("xyz"))])
    with mr.create(path) as out:
        out.add_table("/phone/mag", "sensor_msgs/msg/MagneticField", table, frame_id="body")
    return mr.open(path)


def walked(folder: Path) -> tuple[mr.Recording, PhoneWalk]:
    """Simulate a walk of 32 m with two turns as an app's files, and convert them."""
    options: dict[str, Any] = {
        "route": "12:right 90,12:left 90,8",
        "hard_iron_t": HARD_IRON,
        "soft_iron": 0.0,
        "rate_hz": 50,
    }
    made = simulate("phone-turns", folder / "raw", seed=5, format="phyphox", **options)
    convert(made.paths, folder / "walk.mcap")
    return mr.open(folder / "walk.mcap"), phone_walk("phone-turns", seed=5, **options)


def test_calibration_steps_and_dead_reckoning_in_one_pass(tmp_path: Path) -> None:
    """With its calibration the track lies on the simulated one without any alignment; without it turned away."""
    rec, walk = walked(tmp_path)
    (found,) = rp.calibrate(
        "magnetometer", [turned_about(tmp_path / "turned.mcap", float(np.linalg.norm(walk.mag_true[0])))]
    )
    assert found.usable
    pdr = f"phone.pdr[declination_deg={np.degrees(walk.declination_rad)}]"
    apart = {}
    for name, given in (("with", [found]), ("without", [])):
        result = rp.replay(rec, ["phone.steps", pdr], calibrations=given)
        steps, track = result.runs
        assert abs(steps.tables["step"].height - walk.steps.height) <= 1
        assert steps.metrics["steps_recall"] >= 0.95
        assert steps.metrics["steps_precision"] >= 0.95
        assert track.tables["step"].select("t_ns").equals(steps.tables["step"].select("t_ns"))
        apart[name] = distances(track.tables["pose"], walk)
        remarks = {f.kind for f in track.findings}
        assert ("calibrated" in remarks, "mag_uncalibrated" in remarks) == (bool(given), not given)
        if given:
            assert track.tables["heading"]["disturbed"].to_numpy().mean() < 0.1
    assert apart["with"].max() < 0.08 * walk.length_m
    assert apart["without"].max() > 4 * apart["with"].max()


def test_stages_in_a_chain_give_the_track_of_the_whole(tmp_path: Path) -> None:
    """Steps, lengths and headings by stages, summed: the steps of ``phone.pdr`` and nearly its track."""
    rec, walk = walked(tmp_path)
    chain = "phone.steps+phone.length+phone.heading+phone.track"
    *_, by_stages, whole = rp.replay(rec, [chain, "phone.pdr"]).runs
    ours, theirs = by_stages.tables["pose"], whole.tables["pose"]
    assert ours["t_ns"].equals(theirs["t_ns"])
    assert by_stages.metrics["path_m"] == pytest.approx(whole.metrics["path_m"], rel=1e-6)
    assert by_stages.metrics["ate_rmse_m"] < 0.05 * walk.length_m


def test_offline_estimators_lie_on_the_fixes(tmp_path: Path) -> None:
    rec, walk = walked(tmp_path)
    for run in rp.replay(rec, ["phone.smooth", "phone.transform", "phone.pdr-source"]).runs:
        assert not [f for f in run.findings if f.kind in ("not_smoothed", "not_transformed")]
        if "fix" in run.tables:
            fix = run.tables["fix"]
            assert np.isfinite(fix["lat_deg"].to_numpy()).all()
            north_m = (fix["lat_deg"].to_numpy() - walk.options.lat_deg) * 111_000
            assert np.abs(north_m).max() < 40.0


def distances(pose: pl.DataFrame, walk: PhoneWalk) -> np.ndarray:
    """Return the distances (m) of a track's positions from the true ones of their times, nothing aligned.

    Files of this app count from the first sample.
    """
    t = pose["t_ns"].to_numpy()
    true = walk.t_ns - (walk.t_ns[0] if t[0] < 10**17 else 0)
    return np.hypot(
        *(pose[f"pos_{a}"].to_numpy() - np.interp(t, true, walk.pos[:, i]) for i, a in enumerate("xy"))
    )


@pytest.mark.parametrize(("placement", "works"), [("hand", True), ("pocket", False), ("armband", False)])
def test_the_sources_chain_says_where_it_cannot_work(placement: str, works: bool, tmp_path: Path) -> None:
    """Its heading is for a phone that is held level: elsewhere the run is fatal and names the remedy."""
    made = simulate(
        "phone-turns", tmp_path / "raw", seed=5, format="sensor-logger", rate_hz=20, placement=placement
    )
    convert(made.paths, tmp_path / "walk.mcap")
    (run,) = rp.replay(mr.open(tmp_path / "walk.mcap"), ["phone.pdr-source"]).runs
    assert run.fatal == (not works)
    assert [f.detail for f in run.findings if f.kind == "not_level" and "phone.pdr" in f.detail] == (
        [] if works else [f.detail for f in run.findings if f.kind == "not_level"]
    )
    assert bool(run.metrics) == works


def test_offline_estimators_are_labelled(tmp_path: Path) -> None:
    rec, _ = walked(tmp_path)
    rp.replay(rec, ["phone.smooth", "phone.fused"], out=tmp_path / "done.mcap")
    done = mr.open(tmp_path / "done.mcap")
    assert done.metadata["run/phone_smooth_phone_gyr"]["offline"] == "true"
    assert done.metadata["run/phone_fused_phone_gyr"]["offline"] == "false"


def test_floors_by_the_barometer() -> None:
    """Two flights of 3.4 m: the height at the end, and its stated deviation."""
    walk = phone_walk("phone-floors", seed=3, rate_hz=25)
    out = run_phone("phone.pdr", sensor_tables(walk))
    climbed = float(walk.pos[-1, 2] - walk.pos[0, 2])
    assert climbed == pytest.approx(6.8, abs=0.01)
    assert out["pose"]["pos_z"][-1] == pytest.approx(climbed, abs=1.0)
    assert 0.0 < out["sigma"]["sigma_pos_z"][-1] < 1.0
    assert np.nansum(out["step"]["height_m"].to_numpy()) == pytest.approx(climbed, abs=1.0)


def off_course(walk: PhoneWalk, out: dict[str, pl.DataFrame]) -> np.ndarray:
    """Return by how much (rad) the walking direction of each step is off the person's course."""
    t = out["heading"]["t_ns"].to_numpy() - 300_000_000
    true = np.interp(t - walk.t_ns[0], walk.t_ns - walk.t_ns[0], walk.heading_rad)
    return np.angle(np.exp(1j * (out["heading"]["walking_rad"].to_numpy() - true)))


WAYS = [("pocket", 4), ("armband", 4), ("swinging", 4), ("neck", 4), *(("bag", k) for k in (1, 4, 6, 7))]


@pytest.mark.parametrize(("placement", "seed"), WAYS)
def test_the_walking_direction_is_not_the_phones(placement: str, seed: int) -> None:
    """Found from the motion: within 15° after the first steps, turns included, screen up or not."""
    walk = phone_walk(
        "phone-turns", seed=seed, placement=placement, rate_hz=50, hard_iron_sigma_t=0.0, soft_iron=0.0
    )
    out = run_phone("phone.pdr", sensor_tables(walk), declination_deg=float(np.degrees(walk.declination_rad)))
    assert np.degrees(np.median(np.abs(off_course(walk, out)[8:]))) < 15.0
    assert out["heading"]["offset_used"].to_numpy()[8:].all()


def test_a_direction_that_may_be_the_opposite_one_is_doubted(tmp_path: Path) -> None:
    """An arm that swings so that fore and aft look alike: the run says so, and its sigma reaches to the true place."""
    made = simulate(
        "phone-turns", tmp_path / "raw", seed=0, format="phyphox", placement="swinging", rate_hz=50
    )
    convert(made.paths, tmp_path / "walk.mcap")
    (run,) = rp.replay(mr.open(tmp_path / "walk.mcap"), ["phone.pdr"]).runs
    assert "direction_doubtful" in {f.kind for f in run.findings}
    heading, sigma, pose = (run.tables[n] for n in ("heading", "sigma", "pose"))
    assert heading["opposite_p"].to_numpy()[8:].mean() > 0.3
    assert sigma["sigma_att_z"][-1] > 0.5 * np.pi
    walked = np.hypot(pose["pos_x"].to_numpy(), pose["pos_y"].to_numpy())
    far = int(walked.argmax())  # the place opposite to it lies within two deviations
    assert np.hypot(sigma["sigma_pos_x"][far], sigma["sigma_pos_y"][far]) > walked[far]


def test_a_phone_without_a_gyroscope_goes_by_force_and_field(tmp_path: Path) -> None:
    """The source's own format: the better chain runs, says what it lacks, and states larger deviations."""
    options: dict[str, Any] = {"seed": 7, "rate_hz": 20, "hard_iron_sigma_t": 0.0, "soft_iron": 0.0}
    made = simulate("phone-turns", tmp_path / "raw", format="android-text", **options)
    convert(made.paths, tmp_path / "walk.mcap")
    rec, walk = mr.open(tmp_path / "walk.mcap"), phone_walk("phone-turns", **options)
    declination = np.degrees(walk.declination_rad)
    pdr, fused, smooth = rp.replay(
        rec, [f"phone.pdr[declination_deg={declination}]", "phone.fused", "phone.smooth"]
    ).runs
    for run in (pdr, fused, smooth):
        assert {f.kind for f in run.findings} >= {"no_gyroscope"}
        assert not run.fatal
        assert abs(run.tables["step"].height - walk.steps.height) <= 0.02 * walk.steps.height + 1
    assert np.degrees(np.median(np.abs(off_course(walk, pdr.tables)[4:]))) < 15.0
    assert distances(pdr.tables["pose"], walk).max() < 0.12 * walk.length_m
    with_gyr = run_phone("phone.pdr", sensor_tables(walk), declination_deg=float(declination))
    ours, theirs = pdr.tables["sigma"]["sigma_att_z"], with_gyr["sigma"]["sigma_att_z"]
    assert ours[-1] > theirs[0]


def test_neither_gyroscope_nor_magnetometer_is_no_heading(tmp_path: Path) -> None:
    t_ns = 10**18 + 20_000_000 * np.arange(500)
    force = pl.DataFrame({"t_ns": t_ns, "acc_x": 0.0, "acc_y": 0.0, "acc_z": 9.8 + np.sin(t_ns * 1e-8)})
    with mr.create(tmp_path / "a.mcap") as out:
        out.add_table("/phone/acc", "sensor_msgs/msg/Imu", force, frame_id="body")
    with pytest.raises(
        mr.MarchaError, match=r"phone\.pdr needs a gyroscope or a magnetometer .*phone\.steps"
    ):
        rp.replay(mr.open(tmp_path / "a.mcap"), ["phone.pdr"])
