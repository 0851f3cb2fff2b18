"""Hinge between two sensors by the whole vectors: axes, positions and biases together, from several stretches.

Norms alone (:mod:`.axisfit`) have second minima and are misled by biases. Here the angle of the hinge is integrated
from the rates, α = α_0 + ∫(g_T·j_T − g_S·j_S) dt, and turns one sensor's vectors into the other's: across the axis the
rates, and in all directions the specific force of the joint's centre, are then the same for both,

    B_Tᵀ (g_T − b_T) = Rz(−α) B_Sᵀ (g_S − b_S),   B_Tᵀ ã_T = Rz(−α) B_Sᵀ ã_S,   ã = a − b_a − Γ(o).

Unknown: both axes (tangent planes), α_0 of every stretch, biases of gyroscopes and accelerometers, both positions o.
The misfit is low-passed: soft tissue moves a sensor with its own resonance (5 to 10 Hz), the joint moves slower. The
wrong pairing of the axes' signs turns α the wrong way, and its misfit is many times larger.

After Weygers and Kok (2020) and Olsson et al. (2020); least squares with Huber's loss by scipy.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ..contract import FloatArray

AXES, FIRST = slice(0, 4), 22
"""Places in the vector of unknowns: axes; gyroscope biases 4, accelerometer biases 10, positions 16; α_0 from here."""
GYR, ACC, POS = 4, 10, 16
SD_GYR_BIAS, SD_ACC_BIAS, SD_POSITION = 0.02, 0.1, 1.0
"""Priors: what the data do not show stays at zero (rad/s, m/s², m).

Those of biases are Gaussian: under Huber's loss, as that of the residuals, a knee's rotation with flexion became a bias
of 12 °/s about both long axes, and tissue one of 2 m/s².
"""
PRIORS, MOST_SD = 18, 3.0
"""Number of priors; a bias of more than so many of their standard deviations is none of a sensor's."""
MOST_S = 60.0
"""Of longer data the liveliest part is taken: the rest adds time, not information."""
TRIALS = 20
"""Evaluations of the misfit, with its derivatives, from each pairing's start."""
RATE_HZ = 40.0
"""Faster sensors are low-passed and thinned to about this."""


class Span(NamedTuple):
    """Samples of both sensors at the same times without a gap: time (s), force and rate (n, 6) of each."""

    t: FloatArray
    upper: FloatArray
    lower: FloatArray


class Hinge(NamedTuple):
    """What was found.

    ``axes``, ``positions`` (2, 3) in the sensors' frames, positions from the joint's centre to the sensor;
    ``axes_cov`` (2, 3, 3), ``axes_sd`` (2,) rad, ``position_sd`` and, of the upper sensor's alone, ``upper_sd`` m;
    ``pairing``: share of the worse pairing's cost in
    both, 0.5 … 1; ``biases`` of gyroscopes (rad/s) and ``acc_biases`` (m/s²), (2, 3); ``bounded``: whether one of them
    is at the largest that a sensor has, so that something else looks like a bias (tissue, a joint that is no hinge).
    """

    axes: FloatArray
    positions: FloatArray
    axes_cov: FloatArray
    axes_sd: FloatArray
    position_sd: float
    upper_sd: float
    pairing: float
    biases: FloatArray
    acc_biases: FloatArray
    bounded: bool = False


def basis(axis: FloatArray) -> FloatArray:
    """Return a rotation (3, 3) with columns x, y across ``axis`` and the axis."""
    x: FloatArray = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))]).astype(np.float64)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(axis, x), axis], axis=1)


def moved(base: FloatArray, a: float, b: float) -> FloatArray:
    """Return ``base`` with its axis moved by a, b in its tangent plane.

    Shapes: ``base`` and result (3, 3), the axis in the last column.
    """
    axis = base @ np.array([a, b, 1.0])
    axis /= np.linalg.norm(axis)
    x = base[:, 0] - axis * (base[:, 0] @ axis)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(axis, x), axis], axis=1)


def thinned(spans: Sequence[Span]) -> list[Span]:
    """Return the liveliest :data:`MOST_S` of the spans, thinned to about :data:`RATE_HZ`."""
    from scipy.signal import butter, sosfiltfilt

    kept, left = [], MOST_S
    for span in spans:
        step = float(np.median(np.diff(span.t)))
        rows = min(len(span.t), round(left / step))
        if rows * step < 2.0:
            break
        left -= rows * step
        energy = np.cumsum(np.sum(span.upper[:, 3:] ** 2 + span.lower[:, 3:] ** 2, axis=1))
        first = int(np.argmax(energy[rows - 1 :] - np.r_[0.0, energy[: len(energy) - rows]]))
        part = slice(first, first + rows)
        t, both = span.t[part], np.hstack([span.upper, span.lower])[part]
        every = int(1.0 / (step * RATE_HZ))
        if every > 1:
            both = sosfiltfilt(butter(4, 0.8 / every, output="sos"), both, axis=0)[::every]
            t = t[::every]
        kept.append(Span(t, both[:, :6], both[:, 6:]))
    return kept


def loss(z: FloatArray) -> FloatArray:
    """Return Huber's loss of squared residuals with its derivatives (3, n), of the priors (the last) the square's."""
    rho = np.stack([z, np.ones_like(z), np.zeros_like(z)])
    far = np.flatnonzero(z[:-PRIORS] > 1.0)
    root = np.sqrt(z[far])
    rho[:, far] = 2.0 * root - 1.0, 1.0 / root, -0.5 / (root * z[far])
    return rho


class _Problem:
    def __init__(self, spans: Sequence[Span], band_hz: float, sd_gyr: float, sd_acc: float) -> None:
        from scipy.signal import butter

        self.sd_gyr, self.sd_acc = sd_gyr, sd_acc
        self.parts: list[
            tuple[FloatArray, list[FloatArray], list[FloatArray], list[FloatArray], Any, slice]
        ] = []
        for span in thinned(spans):
            dt = np.diff(span.t, prepend=2 * span.t[0] - span.t[1])
            step = float(np.median(dt))
            rates = [span.upper[:, 3:], span.lower[:, 3:]]
            slopes = []
            for g in rates:
                d = np.gradient(g, span.t, axis=0)
                d[2:-2] = (g[:-4] - 8 * g[1:-3] + 8 * g[3:-1] - g[4:]) / (
                    3 * (span.t[4:] - span.t[:-4])[:, None]
                )
                slopes.append(d)
            forces = [span.upper[:, :3], span.lower[:, :3]]
            sos = butter(2, min(0.9, 2 * band_hz * step), output="sos")
            edge = min(len(span.t) // 4, round(0.5 / (band_hz * step)))
            every = max(1, round(1 / (6 * band_hz * step)))
            self.parts.append((dt, rates, slopes, forces, sos, slice(edge, len(span.t) - edge, every)))

    def misfit(self, p: FloatArray, bases: Sequence[FloatArray]) -> FloatArray:
        """Return all residuals over their standard deviations, priors behind."""
        from scipy.signal import sosfiltfilt

        b = [moved(bases[i], p[2 * i], p[2 * i + 1]) for i in (0, 1)]
        out = []
        for k, (dt, rates, slopes, forces, sos, some) in enumerate(self.parts):
            own = [rates[i] - p[GYR + 3 * i : GYR + 3 * i + 3] for i in (0, 1)]
            turn = own[0] @ b[0][:, 2] - own[1] @ b[1][:, 2]
            alpha = p[FIRST + k] + np.cumsum(dt * turn) - 0.5 * dt * turn
            across, force = [], []
            for i in (0, 1):
                o = p[POS + 3 * i : POS + 3 * i + 3]
                g = own[i]
                along, size = g @ o, np.sum(g * g, axis=1)
                centre = g * along[:, None] - o * size[:, None] + np.cross(slopes[i], o)
                force.append((forces[i] - p[ACC + 3 * i : ACC + 3 * i + 3] - centre) @ b[i])
                across.append(g @ b[i])
            c, s = np.cos(alpha), np.sin(alpha)
            both = np.empty((len(dt), 5))
            for column, pair, scale in ((0, across, self.sd_gyr), (2, force, self.sd_acc)):
                u, v = pair
                both[:, column] = (u[:, 0] - c * v[:, 0] - s * v[:, 1]) / scale
                both[:, column + 1] = (u[:, 1] + s * v[:, 0] - c * v[:, 1]) / scale
            both[:, 4] = (force[0][:, 2] - force[1][:, 2]) / self.sd_acc
            out.append(sosfiltfilt(sos, both, axis=0)[some].ravel())
        priors = [p[GYR:ACC] / SD_GYR_BIAS, p[ACC:POS] / SD_ACC_BIAS, p[POS:FIRST] / SD_POSITION]
        return np.concatenate([*out, *priors])

    def solve(self, axes: FloatArray) -> tuple[float, list[FloatArray], FloatArray, FloatArray]:
        """Return cost, both bases, the unknowns and their covariance, from these axes on."""
        from scipy.optimize import least_squares

        bases = [basis(a) for a in axes]
        p = np.zeros(FIRST + len(self.parts))
        grid = np.arange(0.0, 2 * np.pi, np.pi / 6)
        for k in range(len(self.parts)):
            costs = []
            for start in grid:
                p[FIRST + k] = start
                costs.append(np.sum(np.minimum(self.misfit(p, bases) ** 2, 9.0)))
            p[FIRST + k] = grid[int(np.argmin(costs))]
        scale = np.r_[[0.05] * 4, [0.005] * 6, [0.05] * 6, [0.1] * 6, [0.1] * len(self.parts)]
        most = np.full(len(p), np.inf)
        most[GYR:ACC], most[ACC:POS] = MOST_SD * SD_GYR_BIAS, MOST_SD * SD_ACC_BIAS
        rho: Any = loss  # the stubs of scipy know names only
        solution = least_squares(
            self.misfit, p, args=(bases,), loss=rho, bounds=(-most, most), x_scale=scale, max_nfev=TRIALS
        )
        normal = solution.jac.T @ solution.jac
        spread = max(1.0, 2.0 * float(solution.cost) / max(1, len(solution.fun)))
        cov = spread * np.linalg.pinv(normal)
        x = np.asarray(solution.x)
        return float(solution.cost), [moved(bases[i], x[2 * i], x[2 * i + 1]) for i in (0, 1)], x, cov


def fit(spans: Sequence[Span], axes: FloatArray, band_hz: float, sd_gyr: float, sd_acc: float) -> Hinge:
    """Return the hinge from stretches of both sensors, beginning at ``axes`` (2, 3) with either pairing.

    Parameters
    ----------
    spans : sequence of Span
        Stretches without gaps; all are used together.
    axes : ndarray, shape (2, 3)
        Axes to begin with, in the sensors' frames; the sign of the first is kept.
    band_hz : float
        Misfits are low-passed here.
    sd_gyr, sd_acc : float
        Their standard deviations (rad/s, m/s²).
    """
    problem = _Problem(spans, band_hz, sd_gyr, sd_acc)
    # Both are carried to their ends: half-way the right one may cost more (sit-to-stand, where the shank hardly turns).
    tries = [problem.solve(np.array([axes[0], sign * axes[1]])) for sign in (1.0, -1.0)]
    tries.sort(key=lambda attempt: attempt[0])
    first, second = ([b[:, 2] for b in attempt[1]] for attempt in tries)
    apart = (first[0] @ second[0]) * (first[1] @ second[1]) < 0.0
    # Where both starts end in one place the other pairing is no minimum at all.
    pairing = tries[1][0] / (tries[1][0] + tries[0][0]) if apart else 1.0
    _, bases, p, cov = tries[0]
    sign = 1.0 if bases[0][:, 2] @ axes[0] >= 0.0 else -1.0
    best_axes = np.array([sign * b[:, 2] for b in bases])
    positions = p[POS:FIRST].reshape(2, 3)
    positions = positions - best_axes * 0.5 * float(np.sum(positions * best_axes))
    axes_cov = np.array(
        [bases[i][:, :2] @ cov[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] @ bases[i][:, :2].T for i in (0, 1)]
    )
    across = [np.eye(3) - np.outer(a, a) for a in best_axes]
    spread = [across[i] @ cov[POS + 3 * i : POS + 3 * i + 3, POS + 3 * i : POS + 3 * i + 3] for i in (0, 1)]
    return Hinge(
        axes=best_axes,
        positions=positions,
        axes_cov=axes_cov,
        axes_sd=np.sqrt(np.trace(axes_cov, axis1=1, axis2=2)),
        position_sd=float(np.sqrt(max(0.0, 0.5 * sum(float(np.trace(s)) for s in spread)))),
        upper_sd=float(np.sqrt(max(0.0, float(np.trace(spread[0]))))),
        pairing=pairing,
        biases=p[GYR:ACC].reshape(2, 3),
        acc_biases=p[ACC:POS].reshape(2, 3),
        bounded=bool(
            np.abs(p[GYR:ACC]).max() > 0.99 * MOST_SD * SD_GYR_BIAS
            or np.abs(p[ACC:POS]).max() > 0.99 * MOST_SD * SD_ACC_BIAS
        ),
    )
