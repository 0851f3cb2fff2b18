"""What is found of mountings that nobody states: in sit-to-stand and squats the axes, the sign by the upright pose."""

from __future__ import annotations

from typing import Any

import numpy as np
import polars as pl
import pytest
from marcha.algorithms import make
from marcha.algorithms.joint import axisfit, mounting
from marcha.ingest.simulate.leg import leg
from marcha.replay import metrics_joint as mj
from scipy.spatial.transform import Rotation

from .test_joint_hinge import blocks
from .test_joint_source import table


def randomly_mounted(
    kind: str, seed: int, **options: Any
) -> tuple[Any, dict[str, dict[str, pl.DataFrame]], np.ndarray]:
    capture = leg(kind, seed=seed, segments=("thigh", "shank"), mounting="random", **options)
    t = np.round(capture.t * 1e9).astype(np.int64)
    sensors = {s: table(capture.segments[s].acc_b, capture.segments[s].gyr_b, t) for s in ("thigh", "shank")}
    return capture, {s: {f"/leg/{s}/imu": one} for s, one in sensors.items()}, t


@pytest.mark.parametrize("estimator", ["joint.hinge", "joint.smooth"])
@pytest.mark.parametrize(
    ("kind", "seed", "tissue"), [("sit-to-stand", 21, 0.0), ("sit-to-stand", 22, 1.0), ("squats", 23, 0.0)]
)
def test_nothing_is_stated_and_a_knee_bends_forward_from_standing(
    estimator: str, kind: str, seed: int, tissue: float
) -> None:
    """Any mounting, axis not stated: the published error without bias, the zero within what is stated."""
    capture, tables, t = randomly_mounted(kind, seed, duration_s=60.0, soft_tissue=tissue)
    made = make(estimator)
    results = blocks(made, tables)
    times, knee = results["joint"]["t_ns"].to_numpy(), results["joint"]["knee"].to_numpy()
    remarks = made.remarks()
    assert not [r.detail for r in remarks if r.fatal]
    assert any("its bend from the upright pose" in r.detail for r in remarks)
    there = np.isfinite(knee)
    assert there.mean() > (0.4 if estimator == "joint.hinge" else 0.99)
    figures = mj.figures(times, knee, t, capture.joints["knee"].angle)
    assert figures["rmse_unbiased_deg"] < 1.2
    assert figures["pearson_r"] > 0.999
    sd = np.degrees(results["sigma"]["knee"].to_numpy()[there])
    assert abs(figures["bias_deg"]) < sd.min() < 20.0


def test_what_is_no_hinge_has_no_axes() -> None:
    """Both segments turn about all directions on their own: whole vectors do not make a hinge of it."""
    rng = np.random.default_rng(4)
    count = 3000
    t = np.arange(count) * 20_000_000
    tables = {}
    for segment in ("thigh", "shank"):
        rate = np.cumsum(rng.normal(size=(count, 3)), axis=0)
        rate = 1.5 * (rate - np.linspace(rate[0], rate[-1], count)) / rate.std()
        attitude = Rotation.identity()
        force = np.zeros((count, 3))
        for k in range(count):
            force[k] = attitude.inv().apply([0.0, 0.0, 9.81])
            attitude = attitude * Rotation.from_rotvec(0.02 * rate[k])
        tables[segment] = {f"/leg/{segment}/imu": table(force, rate, t)}
    estimator = make("joint.hinge")
    knee = blocks(estimator, tables)["joint"]["knee"].to_numpy()
    assert [r.kind for r in estimator.remarks() if r.fatal] == ["not_observable"]
    assert np.isnan(knee[-1])


@pytest.mark.parametrize(
    ("thigh_deg", "shank_deg", "pose"),
    [
        ((0.0, 90.0), (0.0, 5.0), 1.0),  # standing and sitting
        ((90.0, 90.0), (0.0, -80.0), 0.0),  # a leg stretched while sitting: the thigh says nothing
        ((0.0, 20.0), (0.0, -30.0), 0.0),  # walking: hardly less upright at the flexed end
    ],
)
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_upright_pose_is_that_of_the_thigh(
    thigh_deg: tuple[float, float], shank_deg: tuple[float, float], pose: float, sign: float
) -> None:
    """Two still postures by their angles to the vertical, flexion positive; levers 20° off the long axes."""
    rows = np.zeros((100, axisfit.COLUMNS))
    lever = Rotation.from_euler("x", 20.0, degrees=True).apply([0.0, 0.0, 0.2])
    for i, angles in enumerate((thigh_deg, shank_deg)):
        for half, angle in enumerate(angles):
            up = Rotation.from_euler("x", -angle, degrees=True).apply([0.0, 0.0, 9.81])
            first = axisfit.WIDTH * i + axisfit.ACC
            rows[50 * half : 50 * half + 50, first : first + 3] = up
    record = np.zeros(1, mounting.RECORD)
    s = record[0]
    s["axis"], s["gravity"], s["upper_sd"] = [sign, 0.0, 0.0], 9.81, 0.02
    s["pos"] = lever, -lever
    mounting.find_pose(s, rows, len(rows))
    assert s["pose"] == sign * pose
    if pose:
        standing = s["pose_up"] / np.linalg.norm(s["pose_up"], axis=1, keepdims=True)
        np.testing.assert_allclose(standing, [[0.0, 0.0, 1.0]] * 2, atol=1e-9)


@pytest.mark.parametrize("estimator", ["joint.relative", "joint.local", "joint.global", "joint.sme"])
def test_filters_that_find_no_axes_say_that_the_joint_turns_about_another(estimator: str) -> None:
    """Sensors at random: fatal where x is only taken, a remark where an axis is stated, silence where it is right."""
    capture, tables, t = randomly_mounted("walking", 7, duration_s=20.0)
    tables["encoder"] = {"/e": pl.DataFrame({"t_ns": t, "knee": capture.joints["knee"].encoder})}
    right = " ".join(
        f"{s}=" + ",".join(f"{v:.3f}" for v in capture.segments[s].axis_b) for s in ("thigh", "shank")
    )
    wrong = "thigh=" + ",".join(f"{v:.3f}" for v in np.roll(capture.segments["thigh"].axis_b, 1))
    up = " ".join(
        f"{s}=" + ",".join(f"{v:.3f}" for v in capture.segments[s].rot_sb.T[:, 2]) for s in ("thigh", "shank")
    )
    for axis, doubted in (("", True), (right, None), (f"{wrong} {right.split()[1]}", False)):
        made = make(estimator, axis=axis, **({"up": up} if axis == right else {}))
        blocks(made, tables)
        doubts = [r for r in made.remarks() if r.kind == "mounting_doubtful"]
        if doubted is None:
            assert not doubts
        else:
            assert doubts
            assert all(r.fatal == doubted for r in doubts)
