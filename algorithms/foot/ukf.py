"""Foot-mounted unscented Kalman filter with nine states and zero-velocity updates."""

from __future__ import annotations

import math
from typing import Annotated, Any, ClassVar

from ..contract import FloatArray
from ..numerics import kalman, strapdown
from ..numerics.compiled import compiled
from ..numerics.records import record_type
from ..parameters import meta
from . import core, rest
from . import iez9 as base
from .estimator import FootEstimator
from .iez9 import ATT, POS, VEL, N
from .parameters import with_parts

POINTS = 2 * N + 1

RECORD = record_type(
    *base.FILTER,
    ("spread", "f8"),  # √(n + λ)
    ("w_centre", "f8"),  # weight of the centre in the covariance
    ("w_other", "f8"),  # weight of every other point
    ("step_force", "f8", (3,)),  # specific force in n that acts over the step
    ("root", "f8", (N, N)),
    ("deviation", "f8", (POINTS, N)),  # sigma points about the nominal navigation
    ("centre", "f8", (N,)),  # their mean
    *core.CORE,
)


class FootUkfParams(base.Foot9IezParams, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Parameters of the unscented filter."""

    alpha: Annotated[
        float,
        meta(
            "Spread of the sigma points, in √(n + κ) standard deviations",
            "1",
            "Wan 2000, eq 15",
            gt=0.0,
            le=1.0,
        ),
    ] = 0.1
    beta: Annotated[
        float, meta("Knowledge of the distribution; 2 is best for a Gaussian", "1", "Wan 2000, eq 15", ge=0.0)
    ] = 2.0
    kappa: Annotated[
        float, meta("Second scaling of the spread, n + κ > 0", "1", "Wan 2000, eq 15", gt=-9.0)
    ] = 0.0


FootUkfAllParams = with_parts(FootUkfParams, "FootUkfAllParams", __name__)


@compiled
def semidefinite_root(P: FloatArray, root: FloatArray) -> None:
    """Write the lower L with L Lᵀ = ``P`` (n, n) to ``root``.

    Cholesky's columns, where a pivot within rounding of zero makes a column of zeros: P starts at zero.
    """
    n = P.shape[0]
    greatest = 0.0
    for i in range(n):
        greatest = max(greatest, P[i, i])
        for j in range(n):
            root[i, j] = 0.0
    for j in range(n):
        pivot = P[j, j]
        for k in range(j):
            pivot -= root[j, k] * root[j, k]
        if pivot <= 1e-15 * greatest:
            continue
        pivot = math.sqrt(pivot)
        root[j, j] = pivot
        for i in range(j + 1, n):
            value = P[i, j]
            for k in range(j):
                value -= root[i, k] * root[j, k]
            root[i, j] = value / pivot


@compiled
def _spread(d: FloatArray, force: FloatArray, trapezoid: bool, dt: float) -> None:
    """Carry one deviation from the nominal navigation, ``d``, over the time step, without linearizing.

    The attitude error turns about n-axes (true C = exp([−δφ]×) C) and the body's own turn multiplies from the
    other side: it stays as it is. The estimate's force is off by (I − exp([−δφ]×)) f_n, the rotation exact.
    """
    x, y, z = d[ATT], d[ATT + 1], d[ATT + 2]
    square = x * x + y * y + z * z
    if square < 1e-8:
        a, b = 1.0 - square / 6.0, 0.5 - square / 24.0
    else:
        angle = math.sqrt(square)
        a, b = math.sin(angle) / angle, (1.0 - math.cos(angle)) / square
    u, v, w = force[0], force[1], force[2]
    cx, cy, cz = y * w - z * v, z * u - x * w, x * v - y * u
    for i in range(3):
        if i == 0:
            change = a * cx - b * (y * cz - z * cy)
        elif i == 1:
            change = a * cy - b * (z * cx - x * cz)
        else:
            change = a * cz - b * (x * cy - y * cx)
        old = d[VEL + i]
        new = old + change * dt
        d[VEL + i] = new
        d[POS + i] += (0.5 * (old + new) if trapezoid else new) * dt


@compiled
def predict(s: Any, r: Any) -> None:
    """Carry P, and the second-order part of the mean, over one time step by the unscented transform.

    Runs after :func:`.strapdown.advance`, which has carried the nominal navigation; ``s.step_force`` is set.
    Attitude deviations have no mean of their own, so only velocity and position move.
    """
    dt, lasting = r.dt, max(r.dt, s.lasting)
    semidefinite_root(s.P, s.root)
    d = s.deviation
    for i in range(N):
        d[0, i] = 0.0
    for k in range(N):
        for i in range(N):
            value = s.spread * s.root[i, k]
            d[1 + k, i] = value
            d[1 + N + k, i] = -value
    for k in range(1, POINTS):
        _spread(d[k], s.step_force, s.trapezoid, dt)
    for i in range(N):
        total = 0.0
        for k in range(1, POINTS):
            total += d[k, i]
        s.centre[i] = s.w_other * total
    for i in range(N):
        for j in range(i, N):
            total = s.w_centre * s.centre[i] * s.centre[j]
            for k in range(1, POINTS):
                total += s.w_other * (d[k, i] - s.centre[i]) * (d[k, j] - s.centre[j])
            s.P[i, j] = total
    # Error = estimate − truth: the mean of the errors is what the estimate has too much.
    for i in range(3):
        s.vel[i] -= s.centre[VEL + i]
        s.pos[i] -= s.centre[POS + i]
    kalman.add_noise(s.P, ATT, base.turn_noise(s, r) * dt * lasting)
    base.doubt_turn(s, r, ATT)
    kalman.add_noise(s.P, VEL, base.force_noise(s) * dt * lasting)
    kalman.mirror(s.P)


@compiled
def _navigate(s: Any, ring: Any, out: FloatArray) -> None:
    r = core.release(s, ring)
    if core.starts(s, r):
        base.believe_rest(s, ATT, VEL)
        s.unknown_bias = s.rest.bias_variance
    elif s.started:
        if s.rest.heard_out:
            rest.hear_out(s)
        for i in range(3):
            s.step_force[i] = s.acc_n[i]
        strapdown.advance(s, r)
        for i in range(3):
            if s.trapezoid:
                s.step_force[i] = 0.5 * (s.step_force[i] + s.acc_n[i])
            else:
                s.step_force[i] = s.acc_n[i]
        s.step_force[2] += s.gravity
        predict(s, r)
        if r.still:
            base.zero_velocity(s, r, 0)
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


class FootUkf(FootEstimator):
    """Unscented Kalman filter on the nine error states of ``foot.9iez``, with the same zero-velocity update.

    Source: Wan and van der Merwe 2000, "The unscented Kalman filter for nonlinear estimation", eqs 15–17,
    on the rotation group as in Brossard, Barrau, Bonnabel 2020, "A code for unscented Kalman filtering on
    manifolds". The sigma points are errors about the strapdown navigation; each is carried over the step
    with the exact rotation of the force, so P follows large attitude errors and the mean moves by their
    second-order effect. The measurement is linear in the error, so its update is the Kalman filter's.

    Departures: the process noise is added after the transform, as in ``foot.9iez``, not put through it; the
    turn of the axes over the reset after an update is neglected, as in ``foot.9iez``.
    """

    name: ClassVar[str] = "foot.ukf"
    title: ClassVar[str] = "unscented Kalman filter, 9 states, zero-velocity updates"
    source: ClassVar[str] = "Wan and van der Merwe 2000, eqs 15–17; Brossard et al. 2020"
    Params = FootUkfAllParams
    presets: ClassVar[dict[str, dict[str, Any]]] = base.PRESETS
    RECORD = RECORD
    kernel = staticmethod(kernel)
    run = staticmethod(run)
    flush_kernel = staticmethod(flush)

    def configure(self, record: Any, params: Any) -> None:
        """Write noise variances and the weights of the sigma points into the state."""
        base.configure(record, params)
        scale = params.alpha**2 * (N + params.kappa)
        record.spread = math.sqrt(scale)
        record.w_centre = 1.0 - N / scale + 1.0 - params.alpha**2 + params.beta
        record.w_other = 0.5 / scale
