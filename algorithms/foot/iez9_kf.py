"""Nine-state zero-velocity filter whose orientation comes from its own Kalman filter ("9IEZ+KF")."""

from __future__ import annotations

import math
from typing import Annotated, Any, ClassVar

from ..contract import FloatArray
from ..numerics import kalman, strapdown
from ..numerics.compiled import compiled, inlined
from ..numerics.records import record_type
from ..numerics.rotations import orthonormalize, turn_nav
from ..parameters import meta
from . import core
from . import iez9 as base
from .estimator import FootEstimator
from .parameters import with_parts

TILT, BIAS = 0, 3
"""First error states of the orientation filter: attitude in n, gyroscope bias."""

ORIENTATION = record_type(
    ("q_turn", "f8"),
    ("q_bias", "f8"),
    ("r_level", "f8"),
    ("level_gate", "f8"),
    ("r_zaru", "f8"),
    ("zaru_after", "f8"),
    ("zaru_rate", "f8"),
    *kalman.filter_fields(6),
)

RECORD = record_type(
    *base.FILTER,
    ("zupt_turns", "?"),
    ("orientation", ORIENTATION),
    *core.CORE,
)


class Foot9IezKfParams(base.Foot9IezParams, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Parameters of the nine-state filter with its own orientation filter."""

    sigma_turn: Annotated[
        float,
        meta("Orientation filter: noise of the angular rate, Q = σ²Δt²", "rad/s", "as sigma_gyr", ge=0.0),
    ] = 0.01
    sigma_gyr_bias0: Annotated[
        float,
        meta("Standard deviation of the gyroscope bias after the rest", "rad/s", "measured: 1e-4", ge=0.0),
    ] = 1e-4
    sigma_gyr_walk: Annotated[
        float, meta("Random walk of the gyroscope bias, Q = σ²Δt", "rad/s/√s", "ours", ge=0.0)
    ] = 1e-6
    sigma_level: Annotated[
        float,
        meta(
            "Noise of the accelerometer as a level: motion that passes the gate included",
            "m/s²",
            "ours",
            gt=0.0,
        ),
    ] = 0.5
    level_gate: Annotated[
        float,
        meta("The accelerometer levels only while still and | ‖f‖ − g | is below", "m/s²", "ours", ge=0.0),
    ] = 0.5
    sigma_zaru: Annotated[float, meta("Noise of the zero angular rate", "rad/s", "ours", gt=0.0)] = 0.01
    zaru_after_s: Annotated[
        float,
        meta("Zero angular rate only after so long a stance: longer than a step's", "s", "ours", ge=0.0),
    ] = 0.8
    zaru_gyr_max: Annotated[
        float, meta("Zero angular rate only below so small a rate (bias taken off)", "rad/s", "ours", gt=0.0)
    ] = 0.05
    zupt_turns: Annotated[
        bool,
        meta(
            "Let the zero-velocity update correct this orientation too; the published figures need it: they "
            "follow 9IEZ in all four configurations",
            source="dissertation, tables 5 to 7",
        ),
    ] = True


Foot9IezKfAllParams = with_parts(Foot9IezKfParams, "Foot9IezKfAllParams", __name__)


@inlined
def _believe_rest(s: Any) -> None:
    """Begin with the tilt and the bias as sure as the rest leaves them."""
    P = s.orientation.P
    for i in range(3):
        P[TILT + i, TILT + i] = s.P[base.ATT + i, base.ATT + i]
        P[BIAS + i, BIAS + i] = max(P[BIAS + i, BIAS + i], s.rest.bias_variance)


@inlined
def _predict(s: Any, dt: float) -> None:
    o = s.orientation
    kalman.predict_bias(o.P, TILT, BIAS, s.rot, dt)
    kalman.add_noise(o.P, TILT, o.q_turn * dt * dt)
    kalman.add_noise(o.P, BIAS, o.q_bias * dt)
    kalman.mirror(o.P)


@compiled
def _correct(s: Any, r: Any) -> None:
    """Level by the accelerometer and take the bias from a rest, where the sample ``r`` allows."""
    o = s.orientation
    if not r.still:
        return
    is_level = abs(r.acc_norm - s.gravity) < o.level_gate
    is_rest = core.at_rest(s, r, o.zaru_after, o.zaru_rate)
    if not (is_level or is_rest):
        return
    kalman.clear(o.dx)
    if is_level:
        # Estimated f_n = (I + [δφ]×)(0, 0, g): its horizontal part is (g δφ_y, −g δφ_x).
        g = s.gravity
        variance = o.r_level / (g * g)
        kalman.update(o, TILT, -s.force[1] / g, variance, 0)
        kalman.update(o, TILT + 1, s.force[0] / g, variance, 0)
    if is_rest:
        for i in range(3):
            kalman.update(o, BIAS + i, s.bias_gyr[i] - r.gyr[i], o.r_zaru, 0)
    turn_nav(s.rot, -o.dx[TILT], -o.dx[TILT + 1], -o.dx[TILT + 2])
    orthonormalize(s.rot)
    for i in range(3):
        s.bias_gyr[i] -= o.dx[BIAS + i]


@inlined
def _advance(s: Any, r: Any) -> None:
    strapdown.resolve(s, r)
    x, y, z = s.force[0], s.force[1], s.force[2]
    strapdown.turn(s, r)
    _predict(s, r.dt)
    strapdown.resolve(s, r)
    _correct(s, r)
    strapdown.resolve(s, r)
    strapdown.average_force(s, x, y, z)
    strapdown.move(s, r.dt)


@compiled
def _navigate(s: Any, ring: Any, out: FloatArray) -> None:
    r = core.release(s, ring)
    if core.starts(s, r):
        base.believe_rest(s, base.ATT, base.VEL)
        _believe_rest(s)
        s.unknown_bias = s.rest.bias_variance  # of what is walked before the first long rest shows the bias
    elif s.started:
        _advance(s, r)
        base.predict(s, r)
        if r.still:
            base.zero_velocity(s, r, 0 if s.zupt_turns else base.POS)
    core.emit(s, r, out)
    core.emit_sigma(s, base.POS, base.VEL, base.ATT, out)
    if s.started:
        # Its orientation filter knows neither the gyroscope's scale nor what a biased accelerometer hides of the tilt.
        for i in range(3):
            own = math.sqrt(max(0.0, s.orientation.P[i, i]))
            out[core.SIGMA + 6 + i] = max(out[core.SIGMA + 6 + i], own) if s.tilt > 0.0 else own
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


class Foot9IezKf(FootEstimator):
    """Position and velocity of the nine-state filter, orientation of a Kalman filter with gyroscope biases.

    Source: foot-navigation dissertation, section 3.6.2: the gyroscope predicts, the accelerometer corrects
    roll and pitch, the zero angular rate while still corrects the biases.

    Departures: the states are the small errors about the level axes and the three biases, not roll, pitch
    and yaw: the same filter to first order, without the singularity at pitch ±90° that a shoe comes near.
    The accelerometer levels in stance only, where it measures gravity, and the zero angular rate has its own
    stricter rest. Without ``zupt_turns`` the orientation is considered in the position filter, as in
    ``foot.9iez-mad``.
    """

    name: ClassVar[str] = "foot.9iez-kf"
    title: ClassVar[str] = "9 states, zero-velocity updates, orientation by its own Kalman filter"
    source: ClassVar[str] = "foot-navigation dissertation, section 3.6.2"
    Params = Foot9IezKfAllParams
    presets: ClassVar[dict[str, dict[str, Any]]] = base.PRESETS
    RECORD = RECORD
    kernel = staticmethod(kernel)
    run = staticmethod(run)
    flush_kernel = staticmethod(flush)

    def configure(self, record: Any, params: Any) -> None:
        """Write the noise variances, the gates and the initial covariance into the state."""
        base.configure(record, params)
        record.zupt_turns = params.zupt_turns
        o = record.orientation
        o.q_turn, o.q_bias = params.sigma_turn**2, params.sigma_gyr_walk**2
        o.r_level, o.level_gate = params.sigma_level**2, params.level_gate
        o.r_zaru = params.sigma_zaru**2
        o.zaru_after, o.zaru_rate = params.zaru_after_s, params.zaru_gyr_max
        for i in range(BIAS, BIAS + 3):
            o.P[i, i] = params.sigma_gyr_bias0**2
