"""Foot-mounted error-state Kalman filter with fifteen states, zero-velocity and zero-rate updates
("15IEZ+ZARU").
"""

from __future__ import annotations

from typing import Annotated, Any, ClassVar

from ..contract import FloatArray
from ..numerics import kalman
from ..numerics.compiled import compiled, inlined
from ..numerics.rotations import orthonormalize, turn_nav
from ..parameters import meta
from . import aiding, strapdown
from . import common as foot
from . import iez9 as base
from . import layout as la
from .layout import (
    ACC_N,
    BIAS_ACC,
    BIAS_GYR,
    POS,
    R_DT,
    R_GYR,
    R_STILL,
    ROT,
    STARTED,
    VEL,
)

N = 15
ATT, BGYR, XPOS, XVEL, BACC = 0, 3, 6, 9, 12

_take = la.Allocator(aiding.SIZE)
Q_GYR = _take()
Q_ACC = _take()
Q_GYR_WALK = _take()
Q_ACC_WALK = _take()
R_VEL = _take()
R_ZARU = _take()
ZARU_AFTER = _take()
ZARU_RATE = _take()
P = _take(N * N)
DX = _take(N)
WORK = _take(2 * N)
SIZE = _take.size


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


Foot15IezZaruAidedParams = aiding.with_aids(Foot15IezZaruParams, "Foot15IezZaruAidedParams", __name__)


@inlined
def predict(s: FloatArray, dt: float) -> None:
    """Carry P over one time step: F P Fᵀ + Q (eqs 3.34–3.37 with the bias columns of 3.43)."""
    kalman.predict_motion(s, P, N, ATT, XPOS, XVEL, ACC_N, dt)
    kalman.predict_bias(s, P, N, XVEL, BACC, ROT, dt)
    kalman.predict_bias(s, P, N, ATT, BGYR, ROT, dt)
    kalman.add_noise(s, P, N, ATT, s[Q_GYR] * dt * dt)
    kalman.add_noise(s, P, N, XVEL, s[Q_ACC] * dt * dt)
    kalman.add_noise(s, P, N, BGYR, s[Q_GYR_WALK] * dt)
    kalman.add_noise(s, P, N, BACC, s[Q_ACC_WALK] * dt)
    kalman.mirror(s, P, N)


@compiled
def correct(s: FloatArray, r: int) -> None:
    """Correct by zero velocity and, where the foot really rests, by zero angular rate (eq 3.44)."""
    kalman.clear(s, DX, N)
    for i in range(3):
        kalman.update(s, P, N, DX, WORK, XVEL + i, s[VEL + i], s[R_VEL], 0)
    if foot.at_rest(s, r, s[ZARU_AFTER], s[ZARU_RATE]):
        for i in range(3):
            # Measured rate = true bias at rest, so the bias estimate's error is seen directly.
            seen = s[BIAS_GYR + i] - s[r + R_GYR + i]
            kalman.update(s, P, N, DX, WORK, BGYR + i, seen, s[R_ZARU], 0)
    feed_back(s)


@inlined
def feed_back(s: FloatArray) -> None:
    """Take the errors in ``DX`` out of position, velocity, biases and attitude."""
    for i in range(3):
        s[POS + i] -= s[DX + XPOS + i]
        s[VEL + i] -= s[DX + XVEL + i]
        s[BIAS_GYR + i] -= s[DX + BGYR + i]
        s[BIAS_ACC + i] -= s[DX + BACC + i]
    turn_nav(s, ROT, -s[DX + ATT], -s[DX + ATT + 1], -s[DX + ATT + 2])
    orthonormalize(s, ROT)


@compiled
def _navigate(s: FloatArray, out: FloatArray) -> None:
    r = foot.release(s)
    if not foot.starts(s) and s[STARTED] > 0.5:
        strapdown.advance(s, r)
        predict(s, s[r + R_DT])
        if s[r + R_STILL] > 0.5:
            correct(s, r)
    if s[aiding.ON] > 0.5 and aiding.aid(s, r, P, N, ATT, XPOS, DX, WORK):
        feed_back(s)
    foot.emit(s, r, out)
    foot.emit_sigma(s, P, N, XPOS, XVEL, ATT, out)
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


class Foot15IezZaru(aiding.AidedEstimator):
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
    state_size: ClassVar[int] = SIZE
    kernel = staticmethod(kernel)
    run = staticmethod(run)
    flush_kernel = staticmethod(flush)

    def configure(self, params: Any) -> None:
        """Write the noise variances, the gates and the initial covariance into the state."""
        s = self.state
        s[Q_GYR], s[Q_ACC] = params.sigma_gyr**2, params.sigma_acc**2
        s[Q_GYR_WALK], s[Q_ACC_WALK] = params.sigma_gyr_walk**2, params.sigma_acc_walk**2
        s[R_VEL], s[R_ZARU] = params.sigma_zupt**2, params.sigma_zaru**2
        s[ZARU_AFTER], s[ZARU_RATE] = params.zaru_after_s, params.zaru_gyr_max
        for i in range(3):
            s[P + (BGYR + i) * (N + 1)] = params.sigma_gyr_bias0**2
            s[P + (BACC + i) * (N + 1)] = params.sigma_acc_bias0**2
