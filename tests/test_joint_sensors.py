"""Sensors that say something impossible: left-handed axes, the same reading over and over, biases that none has."""

from __future__ import annotations

from typing import Any

import numpy as np
import polars as pl
import pytest
from marcha.algorithms import make
from marcha.algorithms.joint import handedness, vectorfit
from marcha.algorithms.joint.calibrate import JointCalibrator
from marcha.ingest.simulate.leg import leg

from .test_joint_hinge import blocks, simulated, stretch
from .test_joint_source import COLUMNS, table

Tables = dict[str, dict[str, pl.DataFrame]]


def captured(kind: str, **options: Any) -> Tables:
    """Return the sensors of thigh and shank in a simulated movement of 20 s."""
    capture = leg(kind, segments=("thigh", "shank"), duration_s=20.0, **options)
    t = np.round(capture.t * 1e9).astype(np.int64)
    return {
        s: {f"/leg/{s}/imu": table(capture.segments[s].acc_b, capture.segments[s].gyr_b, t)}
        for s in ("thigh", "shank")
    }


def mirrored(tables: Tables, segments: tuple[str, ...], axis: str = "y") -> Tables:
    """Return the same with left-handed axes: one of both sensors of a segment reversed."""
    turned = {
        s: {
            topic: t.with_columns(-pl.col(f"acc_{axis}"), -pl.col(f"gyr_{axis}"))
            for topic, t in tables[s].items()
        }
        for s in segments
    }
    return {**tables, **turned}


def remarks(name: str, tables: Tables) -> dict[str, Any]:
    """Return the remarks of an estimator by kind."""
    estimator = make(name)
    blocks(estimator, tables)
    return {r.kind: r for r in estimator.remarks()}


@pytest.mark.parametrize(
    ("segments", "tissue"), [(("thigh",), 0.0), (("shank",), 1.0), (("thigh", "shank"), 0.0)]
)
def test_a_mirrored_sensor_on_a_walker_is_named_and_nothing_is_judged(
    segments: tuple[str, ...], tissue: float
) -> None:
    """Walking hides the turn of gravity from one sensor alone; both sensors of the joint show it."""
    tables = mirrored(captured("walking", seed=3, soft_tissue=tissue), segments)
    remark = remarks("joint.hinge", tables)["sensor_mirrored"]
    assert remark.fatal
    assert remark.detail.startswith(" and ".join(segments) + ":")


@pytest.mark.parametrize("name", ["joint.relative", "joint.local", "joint.global", "joint.smp", "joint.sme"])
def test_a_mirrored_sensor_on_a_walker_is_seen_where_no_axes_are_looked_for(name: str) -> None:
    """By the joints with its neighbours: knee and ankle are hinges here, a hip is none and says nothing."""
    segments = ("trunk", "thigh", "shank", "foot")
    capture = leg("walking", seed=3, segments=segments, duration_s=20.0, mounting="random", soft_tissue=1.0)
    t = np.round(capture.t * 1e9).astype(np.int64)
    tables: Tables = {
        s: {f"/leg/{s}/imu": table(capture.segments[s].acc_b, capture.segments[s].gyr_b, t)} for s in segments
    }
    if name in ("joint.smp", "joint.sme"):
        tables["encoder"] = {"/e": pl.DataFrame({"t_ns": t, "knee": capture.joints["knee"].encoder})}
    assert "sensor_mirrored" not in remarks(name, tables)
    for segment in segments[1:]:
        remark = remarks(name, mirrored(tables, (segment,)))["sensor_mirrored"]
        assert remark.fatal
        assert remark.detail.startswith(f"{segment}:")


def test_calibration_refuses_a_mirrored_sensor() -> None:
    found = JointCalibrator().calibrate([stretch(mirrored(captured("walking", seed=3), ("shank",)))])
    assert not found.usable
    assert "shank: gravity turns against the gyroscope" in found.remarks[0]


@pytest.mark.parametrize("name", ["joint.relative", "joint.smea"])
def test_slow_movements_show_a_mirrored_sensor_to_every_estimator(name: str) -> None:
    """One sensor is enough: its force turns against its rate, whichever of its axes is reversed."""
    tables = captured("squats", seed=4, soft_tissue=1.0)
    assert "sensor_mirrored" not in remarks(name, tables)
    for axis in "xz":
        remark = remarks(name, mirrored(tables, ("thigh",), axis))["sensor_mirrored"]
        assert remark.fatal
        assert remark.detail.startswith("thigh:")


def test_right_handed_sensors_are_not_called_mirrored() -> None:
    for kind, tissue in (("walking", 0.0), ("walking", 1.0), ("sit-to-stand", 0.0), ("squats", 1.0)):
        tables = captured(kind, seed=5, soft_tissue=tissue, mounting="random")
        assert "sensor_mirrored" not in remarks("joint.hinge", tables)


def test_what_is_left_of_a_turning_sensor_is_its_noise() -> None:
    """On a lever of .2 m about a fixed point: noise under the right sign, more than 2 m/s² under the wrong one."""
    rng = np.random.default_rng(1)
    t = np.arange(0.0, 20.0, 0.01)
    angle, lever = np.sin(1.3 * t), np.array([0.0, 0.0, -0.2])
    rate = np.stack([1.3 * np.cos(1.3 * t), 0 * t, 0 * t], axis=1)
    slope = np.stack([-1.69 * np.sin(1.3 * t), 0 * t, 0 * t], axis=1)
    force = 9.81 * np.stack([0 * t, np.sin(angle), np.cos(angle)], axis=1)
    force += np.cross(rate, np.cross(rate, lever)) + np.cross(slope, lever)
    force += 0.05 * rng.normal(size=force.shape)
    turned = np.stack([angle, 0 * t, 0 * t], axis=1)
    one = np.hstack([rate, force, slope, turned])
    wrong = np.hstack([-rate, force, -slope, -turned])
    s = np.zeros(1, handedness.PAIR)
    handedness.look_through(s[0], np.hstack([one, wrong]), 0.01)
    plain, other = handedness.left_over(s[0], 0)
    assert plain == pytest.approx(0.05, rel=0.1)
    assert other > 2.0
    assert handedness.left_over(s[0], 1) == pytest.approx((other, plain))
    assert [handedness.left_handed(s[0], i) for i in range(2)] == [False, True]


def test_a_stuck_sensor_is_said_and_fatal() -> None:
    """From 8 s on the shank repeats its last reading; a pause of half a second is nothing to say."""
    tables = captured("walking", seed=3)
    ((topic, one),) = tables["shank"].items()
    t = one["t_ns"].to_numpy()
    for first, last, kinds in ((8.0, 20.0, True), (8.0, 8.5, False)):
        values = one.select(COLUMNS).to_numpy().copy()
        held = (t >= t[0] + first * 1e9) & (t < t[0] + last * 1e9)
        values[held] = values[np.flatnonzero(held)[0]]
        found = remarks("joint.hinge", {**tables, "shank": {topic: table(values[:, :3], values[:, 3:], t)}})
        assert ("sensor_stuck" in found) == kinds
        if kinds:
            assert found["sensor_stuck"].fatal
            assert found["sensor_stuck"].detail.startswith("shank: ")


def test_what_looks_like_a_bias_is_no_larger_than_sensors_have() -> None:
    """A shank that turns about its long axis as the knee bends: not 12 °/s of bias in both sensors."""
    capture, tables, t = simulated(seed=4, duration_s=20.0, mount_deg=0.0)
    ((topic, one),) = tables["shank"].items()
    values = one.select(COLUMNS).to_numpy()
    bend = capture.joints["knee"].angle
    values[:, 5] += 0.25 * np.gradient(bend, t * 1e-9) + 0.25 * np.abs(np.gradient(bend, t * 1e-9))
    tables["shank"] = {topic: table(values[:, :3], values[:, 3:], t)}
    found = JointCalibrator().calibrate([stretch(tables)])
    (hinge,) = found.values["hinges"]
    assert np.abs(hinge["gyr_bias_rad_s"]).max() <= vectorfit.MOST_SD * vectorfit.SD_GYR_BIAS
    assert np.abs(hinge["acc_bias_m_s2"]).max() <= vectorfit.MOST_SD * vectorfit.SD_ACC_BIAS
    assert hinge["biases_bounded"]
    assert any("larger than sensors have" in r for r in found.remarks)
