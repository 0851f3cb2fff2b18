"""Foot-mounted error-state Kalman filter with nine states and zero-velocity updates ("9IEZ")."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar

from ..contract import FloatArray
from ..numerics import kalman
from ..numerics.compiled import compiled, inlined
from ..numerics.rotations import orthonormalize, turn_nav
from ..parameters import meta
from . import aiding, strapdown
from . import common as foot
from . import layout as la
from .layout import (
    ACC_N,
    POS,
    R_DT,
    R_STILL,
    ROT,
    STARTED,
    VEL,
)

N = 9
ATT, XPOS, XVEL = 0, 3, 6

_take = la.Allocator(aiding.SIZE)
Q_GYR = _take()  # σ_ω², per unit of Δt²
Q_ACC = _take()
R_VEL = _take()
P = _take(N * N)
DX = _take(N)
WORK = _take(2 * N)
SIZE = _take.size

FIRST_DETECTOR = la.O_REST + 9

PRESETS = foot.FootEstimator.presets | {"device": {"gravity_from_rest": True, "sigma_acc": 0.16}}
"""``device``: as sure as the errors of an uncalibrated MPU-6050 allow (docs/estimators.md)."""


class Foot9IezParams(foot.FootParams, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Parameters of the nine-state filter."""

    sigma_gyr: Annotated[
        float,
        meta("Noise of the angular rate in Q = σ²Δt²", "rad/s", "authors' program: 0.01", ge=0.0),
    ] = 0.01
    sigma_acc: Annotated[
        float,
        meta(
            "Noise of the specific force in Q = σ²Δt²",
            "m/s²",
            "authors' program: 0.1 (the text: 0.01)",
            ge=0.0,
        ),
    ] = 0.1
    sigma_zupt: Annotated[
        float, meta("Noise of the zero velocity in R", "m/s", "eq 3.42 and authors' program: 0.01", gt=0.0)
    ] = 0.01


Foot9IezAidedParams = aiding.with_aids(Foot9IezParams, "Foot9IezAidedParams", __name__)


@inlined
def predict(s: FloatArray, dt: float) -> None:
    """Carry P over one time step: F P Fᵀ + Q with f_n in ``ACC_N`` (eqs 3.34–3.37)."""
    kalman.predict_motion(s, P, N, ATT, XPOS, XVEL, ACC_N, dt)
    kalman.add_noise(s, P, N, ATT, s[Q_GYR] * dt * dt)
    kalman.add_noise(s, P, N, XVEL, s[Q_ACC] * dt * dt)
    kalman.mirror(s, P, N)


@compiled
def zero_velocity(s: FloatArray, considered: int) -> None:
    """Correct by zero velocity (eqs 3.38–3.42); the first ``considered`` error states are left alone."""
    kalman.clear(s, DX, N)
    for i in range(3):
        kalman.update(s, P, N, DX, WORK, XVEL + i, s[VEL + i], s[R_VEL], considered)
    feed_back(s, considered)


@inlined
def feed_back(s: FloatArray, considered: int) -> None:
    """Take the errors in ``DX`` out of position, velocity and, unless it is considered, attitude."""
    for i in range(3):
        s[POS + i] -= s[DX + XPOS + i]
        s[VEL + i] -= s[DX + XVEL + i]
    if considered == 0:
        turn_nav(s, ROT, -s[DX + ATT], -s[DX + ATT + 1], -s[DX + ATT + 2])
        orthonormalize(s, ROT)


@compiled
def _navigate(s: FloatArray, out: FloatArray) -> None:
    r = foot.release(s)
    if not foot.starts(s) and s[STARTED] > 0.5:
        strapdown.advance(s, r)
        predict(s, s[r + R_DT])
        if s[r + R_STILL] > 0.5:
            zero_velocity(s, 0)
    if s[aiding.ON] > 0.5 and aiding.aid(s, r, P, N, ATT, XPOS, DX, WORK):
        feed_back(s, 0)
    foot.emit(s, r, out)
    foot.emit_sigma(s, P, N, XPOS, XVEL, ATT, out)
    foot.emit_detector(s, r, FIRST_DETECTOR, out)


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


def configure(state: FloatArray, params: Any) -> None:
    """Write the noise variances of the nine-state filter into ``state``."""
    state[Q_GYR] = params.sigma_gyr**2
    state[Q_ACC] = params.sigma_acc**2
    state[R_VEL] = params.sigma_zupt**2


class Foot9Iez(aiding.AidedEstimator):
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
    state_size: ClassVar[int] = SIZE
    kernel = staticmethod(kernel)
    run = staticmethod(run)
    flush_kernel = staticmethod(flush)

    def configure(self, params: Any) -> None:
        """Write the noise variances into the state; P starts at zero."""
        configure(self.state, params)
