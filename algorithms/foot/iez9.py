"""Foot-mounted error-state Kalman filter with nine states and zero-velocity updates ("9IEZ")."""

from __future__ import annotations

import math
from typing import Annotated, Any, ClassVar

from ..contract import FloatArray
from ..numerics import kalman, strapdown
from ..numerics.compiled import compiled, inlined
from ..numerics.records import Fields, record_type
from ..numerics.rotations import orthonormalize, turn_nav
from ..parameters import meta
from . import core, rest
from .aiding import AIDS, AidedEstimator, AidingParams, aid
from .estimator import FootEstimator
from .parameters import FootParams, with_parts

N = 9
ATT, POS, VEL = 0, 3, 6
"""First error states of attitude, position and velocity."""

STANDING = 0.2
"""Share of the specific force's variance while the foot stands."""

FILTER: Fields = [
    ("q_gyr", "f8"),  # σ_ω², per unit of Δt²
    ("q_acc", "f8"),
    ("q_scale", "f8"),  # σ_s²: of the angular rate itself
    ("r_vel", "f8"),
    ("lasting", "f8"),  # s
    ("tilt", "f8"),  # rad
    ("pivot", "f8", (2,)),  # m
    ("stance_vel", "f8", (3,)),  # of the standing foot, m/s, n
    *kalman.filter_fields(N),
]
"""Fields of a state with the nine-state filter, before the core's."""

RECORD = record_type(
    *FILTER,
    ("aids", AIDS),
    *core.CORE,
)

PUBLISHED: dict[str, Any] = FootEstimator.presets["published"] | {
    "sigma_acc": 0.1,
    "sigma_zupt": 0.01,
    "sigma_scale": 0.0,
    "sigma_tilt": 0.0,
    "noise_s": 0.0,
    "pivot_below_m": 0.0,
    "pivot_behind_m": 0.0,
}
"""The source's noise, and its foot that stands as a stone."""
PRESETS: dict[str, dict[str, Any]] = {
    name: PUBLISHED | values if name in ("published", "short-rest", "live") else values
    for name, values in FootEstimator.presets.items()
} | {"device": PUBLISHED | {"gravity_from_rest": True, "sigma_acc": 0.16}}
"""``device``: as sure as the errors of an uncalibrated MPU-6050 allow (docs/estimators.md)."""


class Foot9IezParams(FootParams, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Parameters of the nine-state filter."""

    sigma_gyr: Annotated[
        float,
        meta("Error of the angular rate, Q = σ²Δt·noise_s", "rad/s", "authors' program: 0.01", ge=0.0),
    ] = 0.01
    sigma_acc: Annotated[
        float,
        meta(
            "Error of the specific force, Q = σ²Δt·noise_s",
            "m/s²",
            "ours, measured; authors' program: 0.1 (the text: 0.01)",
            ge=0.0,
        ),
    ] = 0.35
    sigma_scale: Annotated[
        float,
        meta("Error of the angular rate as a share of the rate: scale, axes, bandwidth", "1", "ours", ge=0.0),
    ] = 0.0045
    sigma_zupt: Annotated[
        float,
        meta(
            "Error of the stance's velocity, R = σ²·noise_s/Δt",
            "m/s",
            "ours, measured; eq 3.42 and authors' program: 0.01",
            gt=0.0,
        ),
    ] = 0.02
    noise_s: Annotated[
        float,
        meta(
            "How long these errors last; 0: one sample, Q = σ²Δt² and R = σ² (the source)",
            "s",
            "ours: a swing's errors and a rolling foot's velocity are no white noise",
            ge=0.0,
        ),
    ] = 0.05
    sigma_tilt: Annotated[
        float,
        meta(
            "Standard deviation of roll and pitch after the rest, at least",
            "rad",
            "ours: an accelerometer off by 5 to 6 mg; P0 = 0 in the source",
            ge=0.0,
        ),
    ] = 0.0055
    pivot_below_m: Annotated[
        float,
        meta(
            "The standing foot rolls about a point so far below the sensor; 0: the sensor itself stands still",
            "m",
            "ours, measured on Vicon",
            ge=0.0,
            le=0.5,
        ),
    ] = 0.08
    pivot_behind_m: Annotated[
        float,
        meta(
            "and so far behind it, in the direction of the steps",
            "m",
            "ours, measured on Vicon",
            ge=-0.5,
            le=0.5,
        ),
    ] = 0.03


Foot9IezAidedParams = with_parts(Foot9IezParams, "Foot9IezAidedParams", __name__, AidingParams)


@inlined
def predict(s: Any, r: Any) -> None:
    """Carry P over one time step: F P Fᵀ + Q with f_n in ``s.force`` (eqs 3.34–3.37)."""
    dt, lasting = r.dt, max(r.dt, s.lasting)
    kalman.predict_motion(s.P, ATT, POS, VEL, s.force, dt)
    kalman.add_noise(s.P, ATT, turn_noise(s, r) * dt * lasting)
    doubt_turn(s, r, ATT)
    kalman.add_noise(s.P, VEL, force_noise(s) * dt * lasting)
    kalman.mirror(s.P)


@inlined
def turn_noise(s: Any, r: Any) -> float:
    """Return the variance of the rate's error at the sample ``r``."""
    return s.q_gyr + s.q_scale * r.gyr_norm * r.gyr_norm


@inlined
def force_noise(s: Any) -> float:
    """Return the variance of the specific force's error: of a foot that stands it is a bias, not a swing's."""
    return s.q_acc * STANDING if s.lasting > 0.0 and s.stance_s > core.LONGEST_STANCE_S else s.q_acc


@inlined
def doubt_turn(s: Any, r: Any, att: int) -> None:
    """Add to P, about the axis of the sensor, what a rate beyond its ceiling leaves open."""
    for axis in range(3):
        if r.doubt[axis] > 0.0:
            for i in range(3):
                for j in range(3):
                    s.P[att + i, att + j] += s.rot[i, axis] * s.rot[j, axis] * r.doubt[axis] * r.dt


@inlined
def stance_variance(s: Any, dt: float) -> float:
    """Return R of one sample: an error that lasts is not averaged out by more samples."""
    return s.r_vel * max(1.0, s.lasting / dt) if dt > 0.0 else s.r_vel


@compiled
def rolling_velocity(s: Any, r: Any, velocity: FloatArray) -> None:
    """Write the sensor's velocity (n) while the foot rolls about its pivot: C (ω × r_b).

    r_b reaches from the pivot to the sensor: ``pivot_below_m`` along the vertical and ``pivot_behind_m``
    along the mean direction of the steps so far, as the foot sees it. On Vicon walks this explains the mean
    velocity of 1 to 3 cm/s at which a foot that counts as still moves on; taken for zero it makes a walk 1 to
    3 % too short and 0.1 to 0.2 m too high.
    """
    kalman.clear(velocity)
    if s.pivot[0] == 0.0 and s.pivot[1] == 0.0:
        return
    f = s.forward
    norm = math.sqrt(f[0] * f[0] + f[1] * f[1] + f[2] * f[2])
    behind = s.pivot[1] / norm if norm > 0.0 else 0.0
    x = s.pivot[0] * s.rot[2, 0] + behind * f[0]
    y = s.pivot[0] * s.rot[2, 1] + behind * f[1]
    z = s.pivot[0] * s.rot[2, 2] + behind * f[2]
    wx, wy, wz = r.gyr[0] - s.bias_gyr[0], r.gyr[1] - s.bias_gyr[1], r.gyr[2] - s.bias_gyr[2]
    u, v, w = wy * z - wz * y, wz * x - wx * z, wx * y - wy * x
    for i in range(3):
        velocity[i] = s.rot[i, 0] * u + s.rot[i, 1] * v + s.rot[i, 2] * w


@compiled
def zero_velocity(s: Any, r: Any, n_considered: int) -> None:
    """Correct by the standing foot's velocity (eqs 3.38–3.42); the first ``n_considered`` error states are
    left alone.
    """
    kalman.clear(s.dx)
    rolling_velocity(s, r, s.stance_vel)
    variance = stance_variance(s, r.dt)
    core.judge_innovation(s, r, VEL, variance)
    for i in range(3):
        kalman.update(s, VEL + i, s.vel[i] - s.stance_vel[i], variance, n_considered)
    feed_back(s, n_considered)


@compiled
def believe_rest(s: Any, att: int, vel: int) -> None:
    """Write what the rest leaves open of the tilt into P: ``sigma_tilt``, and what ‖f‖ is off gravity.

    An accelerometer whose norm at rest is off has errors of that size across, too.
    """
    if s.tilt == 0.0:
        return
    a = s.rest.acc
    off = (math.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2]) - s.gravity) / s.gravity
    s.unknown_tilt = s.tilt * s.tilt
    if not s.rest.stance:
        s.unknown_tilt += off * off
        off = 0.0
    for i in range(2):
        s.P[att + i, att + i] = s.unknown_tilt + off * off
    if s.rest.stance:
        for i in range(2):
            s.P[att + i, att + i] += rest.STANCE_TILT * rest.STANCE_TILT
        for i in range(3):
            s.P[vel + i, vel + i] = rest.STANCE_SPEED * rest.STANCE_SPEED


@inlined
def feed_back(s: Any, n_considered: int) -> None:
    """Take the errors in ``s.dx`` out of position, velocity and, unless it is considered, attitude."""
    for i in range(3):
        s.pos[i] -= s.dx[POS + i]
        s.vel[i] -= s.dx[VEL + i]
    if n_considered == 0:
        turn_nav(s.rot, -s.dx[ATT], -s.dx[ATT + 1], -s.dx[ATT + 2])
        orthonormalize(s.rot)


@compiled
def _navigate(s: Any, ring: Any, out: FloatArray) -> None:
    r = core.release(s, ring)
    if core.starts(s, r):
        believe_rest(s, ATT, VEL)
        s.unknown_bias = s.rest.bias_variance
    elif s.started:
        if s.rest.heard_out:
            rest.hear_out(s)
        strapdown.advance(s, r)
        predict(s, r)
        if r.still:
            zero_velocity(s, r, 0)
    if s.aids.on and aid(s, r, ATT, POS):
        feed_back(s, 0)
    core.emit(s, r, out)
    core.emit_sigma(s, POS, VEL, ATT, out)
    core.emit_detector(r, core.AFTER_SIGMA, out)


@compiled
def kernel(state: Any, ring: Any, row: FloatArray, out: FloatArray) -> bool:
    """Take one row; fill ``out`` and return True where a result is due."""
    s = state[0]
    if not core.take(s, ring, row):
        return False
    _navigate(s, ring, out)
    return True


@compiled
def run(state: Any, ring: Any, rows: FloatArray, out: FloatArray) -> int:
    """Take all rows; a row without a result is NaN. Return the number of results."""
    results = 0
    for i in range(rows.shape[0]):
        if kernel(state, ring, rows[i], out[i]):
            results += 1
        else:
            out[i, :] = math.nan
    return results


@compiled
def flush(state: Any, ring: Any, out: FloatArray) -> int:
    """Fill ``out`` with the results still held back, return their number."""
    s = state[0]
    results = 0
    while results < out.shape[0] and core.take_end(s, ring):
        _navigate(s, ring, out[results])
        results += 1
    return results


def configure(record: Any, params: Any) -> None:
    """Write the noise variances of the nine-state filter into a state's record."""
    record.q_gyr = params.sigma_gyr**2
    record.q_acc = params.sigma_acc**2
    record.q_scale = params.sigma_scale**2
    record.r_vel = params.sigma_zupt**2
    record.lasting, record.tilt = params.noise_s, params.sigma_tilt
    record.pivot[0], record.pivot[1] = params.pivot_below_m, params.pivot_behind_m


class Foot9Iez(AidedEstimator):
    """Error-state Kalman filter with nine states (attitude, position, velocity) and zero-velocity updates.

    Source: foot-navigation dissertation, eqs 3.28–3.42 (after Jiménez et al. 2010). F = [[I, 0, 0], [0, I,
    IΔt], [−[f_n]×Δt, 0, I]], Q = diag(σ_ω², 0, σ_a²)Δt², P0 = 0, H = [0 0 I], R = σ_v².

    Departures: the signs before R in (3.36) and Q in (3.37) and the Δt in (3.41) are taken for misprints;
    Joseph form, the three velocities one after another (equal to all at once). The aids of :mod:`.aiding`
    (flat ground, straight walking, magnetometer, barometer) are ours and off by default.
    """

    name: ClassVar[str] = "foot.9iez"
    title: ClassVar[str] = "error-state Kalman filter, 9 states, zero-velocity updates"
    source: ClassVar[str] = "foot-navigation dissertation, eqs 3.28–3.42"
    Params = Foot9IezAidedParams
    presets: ClassVar[dict[str, dict[str, Any]]] = PRESETS
    RECORD = RECORD
    kernel = staticmethod(kernel)
    run = staticmethod(run)
    flush_kernel = staticmethod(flush)

    def configure(self, record: Any, params: Any) -> None:
        """Write the noise variances into the state; P starts at zero."""
        super().configure(record, params)
        configure(record, params)
