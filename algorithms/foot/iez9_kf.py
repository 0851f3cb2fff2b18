"""Nine-state zero-velocity filter whose orientation comes from its own Kalman filter ("9IEZ+KF")."""

from __future__ import annotations

import math
from typing import Annotated, Any, ClassVar

from ..contract import FloatArray
from ..numerics import kalman
from ..numerics.compiled import compiled, inlined
from ..numerics.rotations import orthonormalize, turn_nav
from ..parameters import meta
from . import common as foot
from . import iez9 as base
from . import layout as la
from . import strapdown
from .layout import (
    ACC_N,
    BIAS_GYR,
    GRAVITY,
    R_DT,
    R_GYR,
    R_NORM_ACC,
    R_STILL,
    ROT,
    STARTED,
)

M = 6
TILT, BIAS = 0, 3

_take = la.Allocator(base.SIZE)
FEEDBACK = _take()
Q_TURN = _take()
Q_BIAS = _take()
R_LEVEL = _take()
LEVEL_GATE = _take()
R_ZARU = _take()
ZARU_AFTER = _take()
ZARU_RATE = _take()
P = _take(M * M)
DX = _take(M)
WORK = _take(2 * M)
SIZE = _take.size


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
            "Let the zero-velocity update correct this orientation too; the source leaves it to its own "
            "filter"
        ),
    ] = False


@inlined
def _predict(s: FloatArray, dt: float) -> None:
    kalman.predict_bias(s, P, M, TILT, BIAS, ROT, dt)
    kalman.add_noise(s, P, M, TILT, s[Q_TURN] * dt * dt)
    kalman.add_noise(s, P, M, BIAS, s[Q_BIAS] * dt)
    kalman.mirror(s, P, M)


@compiled
def _correct(s: FloatArray, r: int) -> None:
    """Level by the accelerometer and take the bias from a rest, where the sample at ``r`` allows."""
    if s[r + R_STILL] < 0.5:
        return
    level = abs(s[r + R_NORM_ACC] - s[GRAVITY]) < s[LEVEL_GATE]
    rest = foot.at_rest(s, r, s[ZARU_AFTER], s[ZARU_RATE])
    if not (level or rest):
        return
    kalman.clear(s, DX, M)
    if level:
        # Estimated f_n = (I + [δφ]×)(0, 0, g): its horizontal part is (g δφ_y, −g δφ_x).
        g = s[GRAVITY]
        variance = s[R_LEVEL] / (g * g)
        kalman.update(s, P, M, DX, WORK, TILT, -s[ACC_N + 1] / g, variance, 0)
        kalman.update(s, P, M, DX, WORK, TILT + 1, s[ACC_N] / g, variance, 0)
    if rest:
        for i in range(3):
            seen = s[BIAS_GYR + i] - s[r + R_GYR + i]
            kalman.update(s, P, M, DX, WORK, BIAS + i, seen, s[R_ZARU], 0)
    turn_nav(s, ROT, -s[DX], -s[DX + 1], -s[DX + 2])
    orthonormalize(s, ROT)
    for i in range(3):
        s[BIAS_GYR + i] -= s[DX + BIAS + i]


@inlined
def _advance(s: FloatArray, r: int) -> None:
    strapdown.resolve(s, r)
    x, y, z = s[ACC_N], s[ACC_N + 1], s[ACC_N + 2]
    strapdown.turn(s, r)
    _predict(s, s[r + R_DT])
    strapdown.resolve(s, r)
    _correct(s, r)
    strapdown.resolve(s, r)
    strapdown.average_force(s, x, y, z)
    strapdown.move(s, s[r + R_DT])


@compiled
def _navigate(s: FloatArray, out: FloatArray) -> None:
    r = foot.release(s)
    if not foot.starts(s) and s[STARTED] > 0.5:
        _advance(s, r)
        base.predict(s, s[r + R_DT])
        if s[r + R_STILL] > 0.5:
            base.zero_velocity(s, 0 if s[FEEDBACK] > 0.5 else 3)
    foot.emit(s, r, out)
    foot.emit_sigma(s, base.P, base.N, base.XPOS, base.XVEL, base.ATT, out)
    for i in range(3):
        if s[STARTED] > 0.5:
            out[la.O_REST + 6 + i] = math.sqrt(max(0.0, s[P + i * (M + 1)]))
    foot.emit_detector(s, r, base.FIRST_DETECTOR, out)


@compiled
def kernel(state: FloatArray, row: FloatArray, out: FloatArray) -> bool:
    """Take one row; fill ``out`` and return True where a result is due."""
    if not foot.take(state, row):
        return False
    _navigate(state, out)
    return True


@compiled
def run(state: FloatArray, rows: FloatArray, out: FloatArray) -> int:
    """Take all rows; see :class:`..contract.RowKernel`."""
    results = 0
    for i in range(rows.shape[0]):
        if kernel(state, rows[i], out[i]):
            results += 1
        else:
            out[i, :] = float("nan")
    return results


@compiled
def flush(state: FloatArray, out: FloatArray) -> int:
    """Fill ``out`` with the results still held back, return their number."""
    results = 0
    while results < out.shape[0] and foot.take_end(state):
        _navigate(state, out[results])
        results += 1
    return results


class Foot9IezKf(foot.FootEstimator):
    """Position and velocity of the nine-state filter, orientation of a Kalman filter with gyroscope biases.

    Source: foot-navigation dissertation, section 3.6.2: the gyroscope predicts, the accelerometer corrects
    roll and pitch, the zero angular rate while still corrects the biases.

    Departures: the states are the small errors about the level axes and the three biases, not roll, pitch
    and yaw: the same filter to first order, without the singularity at pitch ±90° that a shoe comes near.
    The accelerometer levels in stance only, where it measures gravity, and the zero angular rate has its own
    stricter rest. The orientation is considered in the position filter, as in ``foot.9iez-mad``.
    """

    name: ClassVar[str] = "foot.9iez-kf"
    title: ClassVar[str] = "9 states, zero-velocity updates, orientation by its own Kalman filter"
    source: ClassVar[str] = "foot-navigation dissertation, section 3.6.2"
    Params = Foot9IezKfParams
    presets: ClassVar[dict[str, dict[str, Any]]] = base.PRESETS
    state_size: ClassVar[int] = SIZE
    kernel = staticmethod(kernel)
    run = staticmethod(run)
    flush_kernel = staticmethod(flush)

    def configure(self, params: Any) -> None:
        """Write the noise variances, the gates and the initial covariance into the state."""
        base.configure(self.state, params)
        self.state[FEEDBACK] = params.zupt_turns
        s = self.state
        s[Q_TURN], s[Q_BIAS] = params.sigma_turn**2, params.sigma_gyr_walk**2
        s[R_LEVEL], s[LEVEL_GATE] = params.sigma_level**2, params.level_gate
        s[R_ZARU] = params.sigma_zaru**2
        s[ZARU_AFTER], s[ZARU_RATE] = params.zaru_after_s, params.zaru_gyr_max
        for i in range(3):
            s[P + (BIAS + i) * (M + 1)] = params.sigma_gyr_bias0**2
