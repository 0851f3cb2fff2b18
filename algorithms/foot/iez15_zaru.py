"""Foot-mounted error-state Kalman filter with fifteen states, zero-velocity and zero-rate updates
("15IEZ+ZARU").
"""

from __future__ import annotations

import math
from typing import Annotated, Any, ClassVar

from ..contract import FloatArray
from ..numerics import kalman, strapdown
from ..numerics.compiled import compiled, inlined
from ..numerics.records import Fields, record_type
from ..numerics.rotations import orthonormalize, turn_nav
from ..parameters import meta
from . import core
from . import iez9 as base
from .aiding import AIDS, AidedEstimator, AidingParams, aid
from .parameters import with_parts

N = 15
ATT, BIAS_GYR, POS, VEL, BIAS_ACC = 0, 3, 6, 9, 12
"""First error states of attitude, gyroscope bias, position, velocity and accelerometer bias."""

FILTER: Fields = [
    ("q_gyr", "f8"),
    ("q_acc", "f8"),
    ("q_gyr_walk", "f8"),
    ("q_acc_walk", "f8"),
    ("q_scale", "f8"),
    ("r_vel", "f8"),
    ("lasting", "f8"),
    ("tilt", "f8"),
    ("pivot", "f8", (2,)),
    ("stance_vel", "f8", (3,)),
    ("r_zaru", "f8"),
    ("zaru_after", "f8"),
    ("zaru_rate", "f8"),
    *kalman.filter_fields(N),
]
"""Fields of a state with the fifteen-state filter, before the core's."""

RECORD = record_type(
    *FILTER,
    ("aids", AIDS),
    *core.CORE,
)


class Foot15IezZaruParams(base.Foot9IezParams, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Parameters of the fifteen-state filter."""

    sigma_gyr_bias0: Annotated[
        float,
        meta(
            "Standard deviation of the gyroscope bias after the rest; a loose one ruins the walk (see docs)",
            "rad/s",
            "measured; the MPU-6050 wanders by about 1e-4 in a minute",
            ge=0.0,
        ),
    ] = 2e-4
    sigma_acc_bias0: Annotated[
        float, meta("Standard deviation of the accelerometer bias after the rest", "m/s²", "measured", ge=0.0)
    ] = 3e-4
    sigma_gyr_walk: Annotated[
        float, meta("Random walk of the gyroscope bias, Q = σ²Δt", "rad/s/√s", "ours", ge=0.0)
    ] = 1e-6
    sigma_acc_walk: Annotated[
        float, meta("Random walk of the accelerometer bias, Q = σ²Δt", "m/s²/√s", "ours", ge=0.0)
    ] = 1e-5
    sigma_zaru: Annotated[float, meta("Noise of the zero angular rate in R", "rad/s", "ours", gt=0.0)] = 0.01
    zaru_after_s: Annotated[
        float,
        meta("Zero angular rate only after so long a stance: longer than a step's", "s", "ours", ge=0.0),
    ] = 0.8
    zaru_gyr_max: Annotated[
        float, meta("Zero angular rate only below so small a rate (bias taken off)", "rad/s", "ours", gt=0.0)
    ] = 0.05


Foot15IezZaruAidedParams = with_parts(Foot15IezZaruParams, "Foot15IezZaruAidedParams", __name__, AidingParams)


@inlined
def predict(s: Any, r: Any) -> None:
    """Carry P over one time step: F P Fᵀ + Q (eqs 3.34–3.37 with the bias columns of 3.43)."""
    dt, lasting = r.dt, max(r.dt, s.lasting)
    kalman.predict_motion(s.P, ATT, POS, VEL, s.force, dt)
    kalman.predict_bias(s.P, VEL, BIAS_ACC, s.rot, dt)
    kalman.predict_bias(s.P, ATT, BIAS_GYR, s.rot, dt)
    kalman.add_noise(s.P, ATT, base.turn_noise(s, r) * dt * lasting)
    base.doubt_turn(s, r, ATT)
    kalman.add_noise(s.P, VEL, base.force_noise(s) * dt * lasting)
    kalman.add_noise(s.P, BIAS_GYR, s.q_gyr_walk * dt)
    kalman.add_noise(s.P, BIAS_ACC, s.q_acc_walk * dt)
    kalman.mirror(s.P)


@compiled
def correct(s: Any, r: Any) -> None:
    """Correct by zero velocity and, where the foot really rests, by zero angular rate (eq 3.44)."""
    kalman.clear(s.dx)
    base.rolling_velocity(s, r, s.stance_vel)
    variance = base.stance_variance(s, r.dt)
    core.judge_innovation(s, r, VEL, variance)
    for i in range(3):
        kalman.update(s, VEL + i, s.vel[i] - s.stance_vel[i], variance, 0)
    if core.at_rest(s, r, s.zaru_after, s.zaru_rate):
        for i in range(3):
            # Measured rate = true bias at rest, so the bias estimate's error is seen directly.
            kalman.update(s, BIAS_GYR + i, s.bias_gyr[i] - r.gyr[i], s.r_zaru, 0)
    feed_back(s)


@inlined
def feed_back(s: Any) -> None:
    """Take the errors in ``s.dx`` out of position, velocity, biases and attitude."""
    for i in range(3):
        s.pos[i] -= s.dx[POS + i]
        s.vel[i] -= s.dx[VEL + i]
        s.bias_gyr[i] -= s.dx[BIAS_GYR + i]
        s.bias_acc[i] -= s.dx[BIAS_ACC + i]
    turn_nav(s.rot, -s.dx[ATT], -s.dx[ATT + 1], -s.dx[ATT + 2])
    orthonormalize(s.rot)


@compiled
def believe_rest(s: Any) -> None:
    """Write what the rest leaves open into P: of the tilt, and of the biases where their priors are 0."""
    base.believe_rest(s, ATT, VEL)
    for i in range(3):
        s.P[BIAS_GYR + i, BIAS_GYR + i] = max(s.P[BIAS_GYR + i, BIAS_GYR + i], s.rest.bias_variance)


@compiled
def _navigate(s: Any, ring: Any, out: FloatArray) -> None:
    r = core.release(s, ring)
    if core.starts(s, r):
        believe_rest(s)
    elif s.started:
        strapdown.advance(s, r)
        predict(s, r)
        if r.still:
            correct(s, r)
    if s.aids.on and aid(s, r, ATT, POS):
        feed_back(s)
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
    """Write the noise variances, the gates and the initial covariance into a state's record."""
    record.q_gyr, record.q_acc = params.sigma_gyr**2, params.sigma_acc**2
    record.q_gyr_walk, record.q_acc_walk = params.sigma_gyr_walk**2, params.sigma_acc_walk**2
    record.q_scale = params.sigma_scale**2
    record.r_vel, record.r_zaru = params.sigma_zupt**2, params.sigma_zaru**2
    record.lasting, record.tilt = params.noise_s, params.sigma_tilt
    record.pivot[0], record.pivot[1] = params.pivot_below_m, params.pivot_behind_m
    record.zaru_after, record.zaru_rate = params.zaru_after_s, params.zaru_gyr_max
    for i in range(3):
        record.P[BIAS_GYR + i, BIAS_GYR + i] = params.sigma_gyr_bias0**2
        record.P[BIAS_ACC + i, BIAS_ACC + i] = params.sigma_acc_bias0**2


class Foot15IezZaru(AidedEstimator):
    """Error-state Kalman filter with fifteen states, zero-velocity and zero-angular-rate updates.

    Source: foot-navigation dissertation, eqs 3.43–3.44. δx = [δφ, δω_b, δp, δv, δa_b], error = estimate −
    truth, so F has −C Δt from δω_b to δφ and from δa_b to δv, and both zero velocity and zero rate see their
    error with H = +I.

    Departures: the source updates the bias in every stance; here the zero angular rate needs a rest of its
    own (``zaru_after_s``, ``zaru_gyr_max``), because a walking foot turns by 0.1–0.5 rad/s while it counts
    as still. The prior of the gyroscope bias is what the rest leaves open (2e-4 rad/s); a loose one ruins
    the walk. The aids of :mod:`.aiding` are ours and off by default.
    """

    name: ClassVar[str] = "foot.15iez-zaru"
    title: ClassVar[str] = "error-state Kalman filter, 15 states, zero-velocity and zero-angular-rate updates"
    source: ClassVar[str] = "foot-navigation dissertation, eqs 3.43–3.44"
    Params = Foot15IezZaruAidedParams
    presets: ClassVar[dict[str, dict[str, Any]]] = base.PRESETS
    RECORD = RECORD
    kernel = staticmethod(kernel)
    run = staticmethod(run)
    flush_kernel = staticmethod(flush)

    def configure(self, record: Any, params: Any) -> None:
        """Write the noise variances, the gates and the initial covariance into the state."""
        super().configure(record, params)
        configure(record, params)
