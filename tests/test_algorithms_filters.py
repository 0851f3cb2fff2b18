"""Kernels against independent references: plain NumPy filters, finite differences, closed forms, Madgwick."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from marcha.algorithms import make
from marcha.algorithms.foot import iez9_mad as foot_9iez_mad
from marcha.algorithms.foot import iez15_zaru as foot_15iez_zaru
from marcha.algorithms.foot.sample import SAMPLE
from marcha.algorithms.numerics import kalman, rotations
from marcha.algorithms.numerics.records import attributes, record_type
from scipy.spatial.transform import Rotation

from . import algorithms_reference as ref
from .algorithms_support import columns, rows_of, run, simulated

SMALL = st.floats(-1.5, 1.5)
VECTOR = st.tuples(SMALL, SMALL, SMALL)


def long_walk() -> tuple[np.ndarray, object]:
    """20,000 rows of a walk with stops, so that the zero angular rate comes in too."""
    first, walk = simulated(laps=9, seed=4)
    rest = simulated("still", seed=4, duration_s=20.0)[0]
    rows = np.vstack([first[:8000], rest[:1500], first[8000:]])
    assert len(rows) >= 20_000
    return rows[:20_000], walk


def state_columns(result: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    linear = np.hstack(
        [
            columns(result, "pose", "pos_x", "pos_y", "pos_z"),
            columns(result, "velocity"),
            columns(result, "sigma"),
        ]
    )
    quat = columns(result, "pose", "quat_w", "quat_x", "quat_y", "quat_z")
    return linear, quat


def compare(result: dict[str, np.ndarray], wanted: np.ndarray, first: int, tolerance: float) -> None:
    linear, quat = state_columns(result)
    assert np.isnan(linear[:first]).all()
    np.testing.assert_allclose(linear[first:], wanted[:, :15], rtol=0, atol=tolerance)
    got = Rotation.from_quat(quat[first:], scalar_first=True).as_matrix().reshape(-1, 9)
    np.testing.assert_allclose(got, wanted[:, 15:], rtol=0, atol=tolerance)


def test_nine_states_equal_the_plain_filter() -> None:
    rows, _ = long_walk()
    result, estimator = run("foot.9iez", rows, preset="published")
    first = int(estimator.record.rest.index)
    compare(result, ref.filter9(rows, result["stance.still"] > 0.5, first), first, 1e-9)


def test_fifteen_states_equal_the_plain_filter() -> None:
    rows, _ = long_walk()
    result, estimator = run("foot.15iez-zaru", rows, preset="published")
    p = estimator.params
    first = int(estimator.record.rest.index)
    wanted = ref.filter15(
        rows,
        result["stance.still"] > 0.5,
        first,
        bias_gyr=p.sigma_gyr_bias0,
        bias_acc=p.sigma_acc_bias0,
        walk_gyr=p.sigma_gyr_walk,
        walk_acc=p.sigma_acc_walk,
        zaru=p.sigma_zaru,
        after_s=p.zaru_after_s,
        rate=p.zaru_gyr_max,
    )
    compare(result, wanted, first, 1e-9)


def test_the_zero_angular_rate_takes_part_in_that_comparison() -> None:
    rows, _ = long_walk()
    with_rest = run("foot.15iez-zaru", rows, preset="published")[0]["pose.pos_x"][-1]
    without = run("foot.15iez-zaru", rows, preset="published", zaru_after_s=1e6)[0]["pose.pos_x"][-1]
    assert abs(with_rest - without) > 1e-6


def mechanize15(x: np.ndarray, c0: np.ndarray, f: np.ndarray, w: np.ndarray, dt: float) -> np.ndarray:
    """One Euler step from the state perturbed by x = [δφ, δω_b, δp, δv, δa_b] (estimate − truth); same
    errors out.
    """

    def step(e: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        c = Rotation.from_rotvec(e[0:3]).as_matrix() @ c0
        new = c @ Rotation.from_rotvec((w - e[3:6]) * dt).as_matrix()
        p = e[6:9] + e[9:12] * dt
        v = e[9:12] + (c @ (f - e[12:15]) - [0, 0, 9.81]) * dt
        return new, p, v

    true_c, true_p, true_v = step(np.zeros(15))
    c, p, v = step(x)
    phi = Rotation.from_matrix(c @ true_c.T).as_rotvec()
    return np.concatenate([phi, x[3:6], p - true_p, v - true_v, x[12:15]])


@given(force=VECTOR, rate=VECTOR, turn=VECTOR, dt=st.floats(1e-3, 0.02))
def test_transition_is_the_jacobian_of_the_mechanization(
    force: tuple, rate: tuple, turn: tuple, dt: float
) -> None:
    f, w = np.array(force) * 10, np.array(rate) * 4
    c = Rotation.from_rotvec(turn).as_matrix()
    eps = 1e-6
    numeric = np.column_stack(
        [
            (mechanize15(eps * e, c, f, w, dt) - mechanize15(-eps * e, c, f, w, dt)) / (2 * eps)
            for e in np.eye(15)
        ]
    )
    analytic = ref.transition15(c @ f, c, dt)
    # The rate's bias acts over the step at its middle: half a turn of C, second order in dt.
    slack = np.full((15, 15), 1e-7)
    slack[0:3, 3:6] = dt * dt * (np.linalg.norm(w) + 1e-3)
    assert (np.abs(numeric - analytic) <= slack).all()


@given(force=VECTOR, turn=VECTOR, dt=st.floats(1e-4, 0.1), seed=st.integers(0, 1000))
def test_kernel_prediction_is_the_matrix_product(force: tuple, turn: tuple, dt: float, seed: int) -> None:
    root = np.random.default_rng(seed).normal(size=(15, 15))
    cov = root @ root.T
    c = Rotation.from_rotvec(turn).as_matrix()
    f = np.array(force) * 10
    s = make("foot.15iez-zaru", preset="published").record  # type: ignore[attr-defined]
    s.rot[:], s.force[:], s.P[:] = c, f, cov
    r = attributes(np.zeros(1, SAMPLE))[0]
    r.dt = dt
    foot_15iez_zaru.predict(s, r)
    got = s.P
    phi = ref.transition15(f, c, dt)
    q = [0.01**2 * dt**2] * 3 + [1e-6**2 * dt] * 3 + [0] * 3 + [0.1**2 * dt**2] * 3 + [1e-5**2 * dt] * 3
    wanted = phi @ cov @ phi.T + np.diag(q)
    np.testing.assert_allclose(got, wanted, rtol=1e-11, atol=1e-11)
    np.testing.assert_array_equal(got, got.T)


@given(seed=st.integers(0, 1000), considered=st.sampled_from([0, 3]))
def test_sequential_update_is_the_joint_one(seed: int, considered: int) -> None:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(9, 9))
    cov, z, r = root @ root.T, rng.normal(size=3), rng.uniform(0.01, 1, 3)
    h = np.eye(9)[6:]
    s = attributes(np.zeros(1, record_type(*kalman.filter_fields(9))))[0]
    s.P[:] = cov
    for i in range(3):
        kalman.update(s, 6 + i, z[i], r[i], considered)
    got = s.P
    np.testing.assert_array_equal(got, got.T)
    if considered == 0:
        k, wanted = ref.joseph(cov, h, np.diag(r))
        np.testing.assert_allclose(s.dx, k @ z, rtol=1e-8, atol=1e-8)
        np.testing.assert_allclose(got, wanted, rtol=1e-8, atol=1e-8)
    else:
        assert (s.dx[:3] == 0).all()
        np.testing.assert_allclose(got[:3, :3], cov[:3, :3], rtol=1e-12)
        assert np.linalg.eigvalsh(got).min() > 0


def test_madgwick_equals_the_published_matrices() -> None:
    rng = np.random.default_rng(0)
    n = 5000
    q = np.array([1.0, 0, 0, 0])
    s = np.zeros(4)
    s[0] = 1.0
    force = rng.normal(size=(n, 3)) + np.array([0, 0, 9.81])
    for f, w in zip(force, rng.normal(size=(n, 3)), strict=True):
        q = ref.madgwick(q, f, w, 0.01, 0.1)
        foot_9iez_mad.madgwick(s, f[0], f[1], f[2], w[0], w[1], w[2], 0.01, 0.1)
    np.testing.assert_allclose(s, q, rtol=0, atol=1e-12)


def test_mahony_equals_a_library() -> None:
    mahony = pytest.importorskip("ahrs").filters.Mahony
    rng = np.random.default_rng(0)
    peer = mahony(frequency=100.0, k_P=0.7, k_I=0.2, b0=np.zeros(3))
    q, s, correction = np.array([1.0, 0, 0, 0]), np.array([1.0, 0, 0, 0]), np.zeros(3)
    force = rng.normal(size=(3000, 3)) + np.array([0, 0, 9.81])
    for f, w in zip(force, rng.normal(size=(3000, 3)), strict=True):
        q = peer.updateIMU(q, gyr=w, acc=f, dt=0.01)
        foot_9iez_mad.mahony(s, correction, f[0], f[1], f[2], w[0], w[1], w[2], 0.01, 0.7, 0.2)
    np.testing.assert_allclose(s, q, rtol=0, atol=1e-9)


def test_mahony_follows_a_walk_as_madgwick_does() -> None:
    rows, walk = simulated()
    result, _ = run("foot.9iez-mad", rows, orientation="mahony")
    pos = columns(result, "pose", "pos_x", "pos_y", "pos_z")
    assert np.linalg.norm(pos[-1] - (walk.pos - walk.pos[0])[-1]) < 0.3


def test_madgwick_finds_down_from_a_wrong_start() -> None:
    s = np.array([np.cos(0.4), np.sin(0.4), 0, 0])
    for _ in range(20_000):
        foot_9iez_mad.madgwick(s, 0.0, 0.0, 9.81, 0.0, 0.0, 0.0, 0.01, 0.05)
    down = Rotation.from_quat(s, scalar_first=True).apply([0, 0, 1])
    assert np.degrees(np.arccos(down[2])) < 0.1


# --- strapdown against closed forms -------------------------------------------------------------------------


def after_rest(motion: np.ndarray, rate: float = 100.0, **params) -> dict[str, np.ndarray]:
    """Run the naive strapdown over 1 s of rest and then ``motion`` (acc, gyr a row); the rest is cut off."""
    still = np.tile([0, 0, 9.81, 0, 0, 0], (int(rate) + 1, 1)).astype(float)
    samples = np.vstack([still, motion])
    rows = rows_of(np.arange(len(samples)) / rate, samples[:, :3], samples[:, 3:])
    result, _ = run("foot.naive", rows, init_s=1.0, rate_hz=rate, **params)
    return {k: v[len(still) - 1 :] for k, v in result.items()}


def test_free_fall_is_a_parabola() -> None:
    result = after_rest(np.zeros((200, 6)))
    t = np.arange(201) / 100
    # The trapezoid spreads the jump of the acceleration over its first step: half a step later.
    np.testing.assert_allclose(result["velocity.vel_z"][1:], -9.81 * (t[1:] - 0.005), atol=1e-9)
    assert abs(result["pose.pos_z"][-1] + 9.81 / 2 * 1.995**2) < 1e-3


def test_euler_free_fall_has_no_half_step() -> None:
    result = after_rest(np.zeros((200, 6)), integration="euler")
    np.testing.assert_allclose(result["velocity.vel_z"], -9.81 * np.arange(201) / 100, atol=1e-9)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_constant_rate_turns_by_rate_times_time(axis: int) -> None:
    rate = 2.0
    motion = np.zeros((1000, 6))
    motion[:, 2] = 9.81
    motion[:, 3 + axis] = rate
    result = after_rest(motion, rate=1000.0)
    quat = columns(result, "pose", "quat_w", "quat_x", "quat_y", "quat_z")
    angle = Rotation.from_quat(quat[-1], scalar_first=True).as_rotvec()
    wanted = np.zeros(3)
    wanted[axis] = rate
    np.testing.assert_allclose(angle, wanted, atol=1e-5)  # Padé: third order in ω dt


def test_coning_is_followed() -> None:
    """A cone of half angle a at Ω: the body rate has a constant part that a sum of angles would miss."""
    rate, cone, speed = 1000.0, 0.2, 2 * np.pi
    t = np.arange(0, 5, 1 / rate)
    truth = Rotation.from_rotvec(cone * np.column_stack([np.cos(speed * t), np.sin(speed * t), 0 * t]))
    gyr = (truth[:-1].inv() * truth[1:]).as_rotvec() * rate
    start = Rotation.from_rotvec([cone, 0, 0])
    force = start.inv().apply([0, 0, 9.81])
    still = np.tile(np.concatenate([force, np.zeros(3)]), (1001, 1))
    samples = np.vstack([still, np.column_stack([truth[1:].inv().apply([0, 0, 9.81]), gyr])])
    rows = rows_of(np.arange(len(samples)) / rate, samples[:, :3], samples[:, 3:])
    result, _ = run("foot.naive", rows, init_s=1.0, rate_hz=rate)
    quat = columns(result, "pose", "quat_w", "quat_x", "quat_y", "quat_z")[1000:]
    got = Rotation.from_quat(quat, scalar_first=True)
    error = (got * truth[: len(quat)].inv()).magnitude()
    assert error.max() < 1e-4
    assert np.abs(columns(result, "velocity")[1000:]).max() < 0.01


@given(angles=st.tuples(st.floats(-3.1, 3.1), st.floats(-1.5, 1.5)))
def test_any_mounting_is_levelled(angles: tuple[float, float]) -> None:
    mount = Rotation.from_euler("ZYX", [0.0, angles[1], angles[0]])
    force = mount.inv().apply([0, 0, 9.81])
    rows = rows_of(np.arange(150) / 100, np.tile(force, (150, 1)), np.zeros((150, 3)))
    result, estimator = run("foot.9iez", rows, init_s=1.0)
    quat = columns(result, "pose", "quat_w", "quat_x", "quat_y", "quat_z")[-1]
    got = Rotation.from_quat(quat, scalar_first=True)
    assert (got * mount.inv()).magnitude() < 1e-6
    assert np.abs(columns(result, "pose", "pos_x", "pos_y", "pos_z")[-1]).max() < 1e-6
    if abs(angles[0]) < 1.5:
        assert "upside_down" not in {r.kind for r in estimator.remarks()}


# --- rotations
# -----------------------------------------------------------------------------------------------


@given(turn=st.tuples(*[st.floats(-3, 3)] * 3), start=st.tuples(*[st.floats(-3, 3)] * 3))
def test_rotation_kernels(turn: tuple, start: tuple) -> None:
    c = Rotation.from_rotvec(start).as_matrix()
    rot = c.copy()
    rotations.turn_body(rot, *turn)
    np.testing.assert_allclose(rot, c @ ref.pade(np.array(turn)), atol=1e-12)
    rot = c.copy()
    rotations.turn_nav(rot, *turn)
    np.testing.assert_allclose(rot, ref.pade(np.array(turn)) @ c, atol=1e-12)
    quat = rotations.quat_of(rot)
    wanted = Rotation.from_matrix(rot).as_quat(canonical=True, scalar_first=True)
    np.testing.assert_allclose(np.abs(np.array(quat) @ wanted), 1, atol=1e-12)
    assert quat[0] >= 0
    back = np.zeros((3, 3))
    rotations.set_quat(back, *quat)
    np.testing.assert_allclose(back, rot, atol=1e-12)


@pytest.mark.parametrize("axis", np.vstack([np.eye(3), -np.eye(3)]))
def test_half_turns_keep_their_axis(axis: np.ndarray) -> None:
    quat = rotations.quat_of(Rotation.from_rotvec(np.pi * axis).as_matrix())
    np.testing.assert_allclose(np.abs(quat[1:]), np.abs(axis), atol=1e-12)


@given(seed=st.integers(0, 1000))
def test_orthonormalize_takes_rounding_out(seed: int) -> None:
    c = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    got = c + 1e-6 * np.random.default_rng(seed).normal(size=(3, 3))
    rotations.orthonormalize(got)
    np.testing.assert_allclose(got @ got.T, np.eye(3), atol=1e-10)
    np.testing.assert_allclose(got, c, atol=1e-5)


def test_rotation_stays_orthonormal_over_a_long_walk() -> None:
    rows, _ = long_walk()
    for name in ("foot.naive", "foot.9iez"):
        _, estimator = run(name, rows)
        c = estimator.record.rot
        np.testing.assert_allclose(c @ c.T, np.eye(3), atol=1e-11)


def test_covariance_stays_symmetric_and_positive() -> None:
    rows, _ = long_walk()
    for name in ("foot.9iez", "foot.15iez-zaru"):
        p = run(name, rows)[1].record.P
        np.testing.assert_array_equal(p, p.T)
        assert np.linalg.eigvalsh(p).min() > -1e-15
