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
from . import core
from .aiding import AIDS, AidedEstimator, AidingParams, aid
from .estimator import FootEstimator
from .parameters import FootParams, with_parts

N = 9
ATT, POS, VEL = 0, 3, 6
"""First error states of attitude, position and velocity."""

FILTER: Fields = [
    ("q_gyr", "f8"),  # σ_ω², per unit of Δt²
    ("q_acc", "f8"),
    ("r_vel", "f8"),
    *kalman.filter_fields(N),
]
"""Fields of a state with the nine-state filter, before the core's."""

RECORD = record_type(
    *FILTER,
    ("aids", AIDS),
    *core.CORE,
)

PRESETS = FootEstimator.presets | {"device": {"gravity_from_rest": True, "sigma_acc": 0.16}}
"""``device``: as sure as the errors of an uncalibrated MPU-6050 allow (docs/estimators.md)."""


class Foot9IezParams(FootParams, frozen=True, forbid_unknown_fields=True, kw_only=True):
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


Foot9IezAidedParams = with_parts(Foot9IezParams, "Foot9IezAidedParams", __name__, AidingParams)


@inlined
def predict(s: Any, dt: float) -> None:
    """Carry P over one time step: F P Fᵀ + Q with f_n in ``s.force`` (eqs 3.34–3.37)."""
    kalman.predict_motion(s.P, ATT, POS, VEL, s.force, dt)
    kalman.add_noise(s.P, ATT, s.q_gyr * dt * dt)
    kalman.add_noise(s.P, VEL, s.q_acc * dt * dt)
    kalman.mirror(s.P)


@compiled
def zero_velocity(s: Any, n_considered: int) -> None:
    """Correct by zero velocity (eqs 3.38–3.42); the first ``n_considered`` error states are left alone."""
    kalman.clear(s.dx)
    for i in range(3):
        kalman.update(s, VEL + i, s.vel[i], s.r_vel, n_considered)
    feed_back(s, n_considered)


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
    if not core.starts(s) and s.started:
        strapdown.advance(s, r)
        predict(s, r.dt)
        if r.still:
            zero_velocity(s, 0)
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
    record.r_vel = params.sigma_zupt**2


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
