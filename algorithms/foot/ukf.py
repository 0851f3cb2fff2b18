"""Foot-mounted unscented Kalman filter with nine states and zero-velocity updates."""

from __future__ import annotations

import math
from typing import Annotated, Any, ClassVar

from ..contract import FloatArray
from ..numerics import kalman
from ..numerics.compiled import compiled
from ..parameters import meta
from . import common as foot
from . import iez9 as base
from . import layout as la
from . import strapdown
from .iez9 import (
    ATT,
    XPOS,
    XVEL,
    N,
    P,
)
from .layout import (
    ACC_OLD,
    GRAVITY,
    POS,
    R_DT,
    R_STILL,
    STARTED,
    TRAPEZOID,
    VEL,
)

POINTS = 2 * N + 1

_take = la.Allocator(base.SIZE)
SPREAD = _take()  # √(n + λ)
W_CENTRE_COV = _take()
W_OTHER = _take()
FORCE = _take(3)  # specific force in n that acts over the step
ROOT = _take(N * N)
DEVIATION = _take(POINTS * N)
MEAN = _take(N)
SIZE = _take.size


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


@compiled
def semidefinite_root(s: FloatArray, p: int, root: int, n: int) -> None:
    """Write the lower L with L Lᵀ = the n×n matrix at ``s[p]`` to ``s[root]``.

    Cholesky's columns, where a pivot within rounding of zero makes a column of zeros: P starts at zero.
    """
    greatest = 0.0
    for i in range(n):
        greatest = max(greatest, s[p + i * (n + 1)])
    kalman.clear(s, root, n * n)
    for j in range(n):
        pivot = s[p + j * (n + 1)]
        for k in range(j):
            pivot -= s[root + j * n + k] * s[root + j * n + k]
        if pivot <= 1e-15 * greatest:
            continue
        pivot = math.sqrt(pivot)
        s[root + j * n + j] = pivot
        for i in range(j + 1, n):
            value = s[p + i * n + j]
            for k in range(j):
                value -= s[root + i * n + k] * s[root + j * n + k]
            s[root + i * n + j] = value / pivot


@compiled
def _spread(s: FloatArray, d: int, dt: float) -> None:
    """Carry one deviation from the nominal navigation, at ``s[d]``, over the time step, without linearizing.

    The attitude error turns about n-axes (true C = exp([−δφ]×) C) and the body's own turn multiplies from the
    other side: it stays as it is. The estimate's force is off by (I − exp([−δφ]×)) f_n, the rotation exact.
    """
    x, y, z = s[d + ATT], s[d + ATT + 1], s[d + ATT + 2]
    square = x * x + y * y + z * z
    if square < 1e-8:
        a, b = 1.0 - square / 6.0, 0.5 - square / 24.0
    else:
        angle = math.sqrt(square)
        a, b = math.sin(angle) / angle, (1.0 - math.cos(angle)) / square
    u, v, w = s[FORCE], s[FORCE + 1], s[FORCE + 2]
    cx, cy, cz = y * w - z * v, z * u - x * w, x * v - y * u
    for i in range(3):
        if i == 0:
            change = a * cx - b * (y * cz - z * cy)
        elif i == 1:
            change = a * cy - b * (z * cx - x * cz)
        else:
            change = a * cz - b * (x * cy - y * cx)
        old = s[d + XVEL + i]
        new = old + change * dt
        s[d + XVEL + i] = new
        s[d + XPOS + i] += (0.5 * (old + new) if s[TRAPEZOID] > 0.5 else new) * dt


@compiled
def predict(s: FloatArray, dt: float) -> None:
    """Carry P, and the second-order part of the mean, over one time step by the unscented transform.

    Runs after :func:`.strapdown.advance`, which has carried the nominal navigation; ``s[FORCE]`` is set.
    Attitude deviations have no mean of their own, so only velocity and position move.
    """
    semidefinite_root(s, P, ROOT, N)
    kalman.clear(s, DEVIATION, N)
    for k in range(N):
        for i in range(N):
            value = s[SPREAD] * s[ROOT + i * N + k]
            s[DEVIATION + (1 + k) * N + i] = value
            s[DEVIATION + (1 + N + k) * N + i] = -value
    for k in range(1, POINTS):
        _spread(s, DEVIATION + k * N, dt)
    for i in range(N):
        total = 0.0
        for k in range(1, POINTS):
            total += s[DEVIATION + k * N + i]
        s[MEAN + i] = s[W_OTHER] * total
    for i in range(N):
        for j in range(i, N):
            total = s[W_CENTRE_COV] * s[MEAN + i] * s[MEAN + j]
            for k in range(1, POINTS):
                d = DEVIATION + k * N
                total += s[W_OTHER] * (s[d + i] - s[MEAN + i]) * (s[d + j] - s[MEAN + j])
            s[P + i * N + j] = total
    # Error = estimate − truth: the mean of the errors is what the estimate has too much.
    for i in range(3):
        s[VEL + i] -= s[MEAN + XVEL + i]
        s[POS + i] -= s[MEAN + XPOS + i]
    kalman.add_noise(s, P, N, ATT, s[base.Q_GYR] * dt * dt)
    kalman.add_noise(s, P, N, XVEL, s[base.Q_ACC] * dt * dt)
    kalman.mirror(s, P, N)


@compiled
def _navigate(s: FloatArray, out: FloatArray) -> None:
    r = foot.release(s)
    if not foot.starts(s) and s[STARTED] > 0.5:
        for i in range(3):
            s[FORCE + i] = s[ACC_OLD + i]
        strapdown.advance(s, r)
        for i in range(3):
            if s[TRAPEZOID] > 0.5:
                s[FORCE + i] = 0.5 * (s[FORCE + i] + s[ACC_OLD + i])
            else:
                s[FORCE + i] = s[ACC_OLD + i]
        s[FORCE + 2] += s[GRAVITY]
        predict(s, s[r + R_DT])
        if s[r + R_STILL] > 0.5:
            base.zero_velocity(s, 0)
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


class FootUkf(foot.FootEstimator):
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
    Params = FootUkfParams
    presets: ClassVar[dict[str, dict[str, Any]]] = base.PRESETS
    state_size: ClassVar[int] = SIZE
    kernel = staticmethod(kernel)
    run = staticmethod(run)
    flush_kernel = staticmethod(flush)

    def configure(self, params: Any) -> None:
        """Write noise variances and the weights of the sigma points into the state."""
        s = self.state
        s[base.Q_GYR], s[base.Q_ACC] = params.sigma_gyr**2, params.sigma_acc**2
        s[base.R_VEL] = params.sigma_zupt**2
        scale = params.alpha**2 * (N + params.kappa)
        s[SPREAD] = math.sqrt(scale)
        s[W_CENTRE_COV] = 1.0 - N / scale + 1.0 - params.alpha**2 + params.beta
        s[W_OTHER] = 0.5 / scale
