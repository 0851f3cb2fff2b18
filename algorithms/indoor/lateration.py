"""A position from ranges to anchors of known position, and how good it can be.

Sources: hybrid indoor positioning, eqs 3.7–3.21 (linearized circles; the printed signs of d1² and d3² in 3.17 and
3.20 are wrong and corrected here), 4.3–4.4 (correction by vote), 4.6 (mean of all triples). Least squares and
the Cramér–Rao bound of received power: Patwari et al. 2003, eqs 11–14.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import combinations
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from ..contract import FloatArray

VOTE = 1.25
"""Factor of the other anchor's range in the vote (eq 4.3)."""
NEAREST_M = 0.3
"""Ranges below this are taken for this: the model has a pole at the anchor."""

Correction = Literal["none", "votes", "both"]


def solve_triple(anchors: ArrayLike, ranges: ArrayLike) -> FloatArray:
    """Return the position (2,) from three circles, the third subtracted from the others.

    Two equations in two unknowns: their exact solution, NaN where the anchors are on a line.
    """
    a, d = np.asarray(anchors, dtype=np.float64), np.asarray(ranges, dtype=np.float64)
    matrix = 2.0 * (a[:2] - a[2])
    right = (a[:2] ** 2 - a[2] ** 2).sum(axis=1) - d[:2] ** 2 + d[2] ** 2
    det = matrix[0, 0] * matrix[1, 1] - matrix[0, 1] * matrix[1, 0]
    if abs(det) < 1e-12:
        return np.full(2, np.nan)
    return np.linalg.solve(matrix, right)


def flatness(anchors: ArrayLike) -> float:
    """Return how far anchors (n, 2) are from lying on a line: smallest by largest extent, 0 on a line, ≤ 1.

    Of three anchors on an equilateral triangle it is 1.
    """
    a = np.asarray(anchors, dtype=np.float64)
    if len(a) < 3:
        return 0.0
    extent = np.linalg.svd(a - a.mean(axis=0), compute_uv=False)
    return float(extent[1] / extent[0]) if extent[0] > 0 else 0.0


def triples(anchors: ArrayLike, ranges: ArrayLike, *, least_flatness: float = 0.01) -> FloatArray:
    """Return the solution of each three anchors, shape (m, 2), m, without those on a line.

    Parameters
    ----------
    anchors : array_like (n, 2)
        Positions, m.
    ranges : array_like (n,)
        Ranges in the plane, m.
    least_flatness : float
        Triples of a :func:`flatness` below this are left out.
    """
    a, d = np.asarray(anchors, dtype=np.float64), np.asarray(ranges, dtype=np.float64)
    positions = [
        solve_triple(a[list(three)], d[list(three)])
        for three in combinations(range(len(d)), 3)
        if flatness(a[list(three)]) >= least_flatness
    ]
    return np.array(positions).reshape(-1, 2)


def mean_of_triples(anchors: ArrayLike, ranges: ArrayLike, *, least_flatness: float = 0.01) -> FloatArray:
    """Return the mean of the :func:`triples` (eq 4.6), NaN where every triple is on a line."""
    solutions = triples(anchors, ranges, least_flatness=least_flatness)
    return solutions.mean(axis=0) if len(solutions) else np.full(2, np.nan)


def votes(anchors: ArrayLike, ranges: ArrayLike, *, both: bool = False) -> FloatArray:
    """Return how many other anchors contradict each range (eq 4.3).

    Anchor n gets a vote from I where the distance between them minus its range exceeds 1.25 times that of
    I; with ``both`` also where its range exceeds their distance by more than 1.25 times that of I.
    """
    a, d = np.asarray(anchors, dtype=np.float64), np.asarray(ranges, dtype=np.float64)
    between = np.linalg.norm(a[:, None] - a[None], axis=2)
    against = between - d[:, None] > VOTE * d[None, :]
    if both:
        against |= d[:, None] - between > VOTE * d[None, :]
    np.fill_diagonal(against, False)
    return against.sum(axis=1).astype(np.float64)


def corrected(anchors: ArrayLike, ranges: ArrayLike, correction: Correction = "votes") -> FloatArray:
    """Return the ranges after the correction by vote (section 4.4.3, eqs 4.3–4.4).

    The anchor with fewest votes is the reference r (of several the one with the shortest range). Anchors with
    at least half of the possible votes (those of the other anchors heard) get d(A_r, A_I) − d_r, never
    negative. ``both`` also counts ranges that are too long and brings those to d(A_r, A_I) + d_r.
    """
    a, d = np.asarray(anchors, dtype=np.float64), np.array(ranges, dtype=np.float64)
    if correction == "none" or d.size < 2:
        return d
    count = votes(a, d, both=correction == "both")
    reference = min(range(d.size), key=lambda i: (count[i], d[i]))
    for i in np.flatnonzero(count >= (d.size - 1) / 2).tolist():
        if i == reference:
            continue
        between = float(np.linalg.norm(a[i] - a[reference]))
        if correction == "both" and d[i] > between + d[reference]:
            d[i] = between + d[reference]
        else:
            d[i] = max(between - d[reference], 0.0)
    return d


@dataclass(frozen=True)
class PositionFix:
    """A position with its uncertainty.

    Attributes
    ----------
    position : ndarray
        x, y (m).
    covariance : ndarray
        Of the position, m², shape (2, 2).
    chi2 : float
        Weighted sum of squared residuals by degree of freedom; about 1 where sigmas are true.
    """

    position: FloatArray
    covariance: FloatArray
    chi2: float


def least_squares(
    anchors: ArrayLike,
    ranges: ArrayLike,
    relative_sigma: ArrayLike,
    *,
    heights: ArrayLike | None = None,
    margin_m: float = 10.0,
    steps: int = 30,
) -> PositionFix | None:
    """Return the weighted nonlinear least-squares position of all anchors; None where there is none.

    The residual is that of the logarithm of the range, in which errors of received power are additive:
    (ln ‖p − a‖ − ln d) / σ with σ = ln 10 σ_dB / (10 η), a range's error by its length. Levenberg–Marquardt
    from the best point of a coarse grid, so that it does not end in the mirror image.

    Parameters
    ----------
    anchors : array_like (n, 2)
        Positions, m.
    ranges : array_like (n,)
        Ranges along the slope, m.
    relative_sigma : array_like (n,)
        Their standard deviation by their length.
    heights : array_like (n,), optional
        Height of each anchor above the receiver, m.
    margin_m : float
        How far outside of the anchors' rectangle a position is believed.
    steps : int
        Most iterations.
    """
    a, d = np.asarray(anchors, dtype=np.float64), np.maximum(np.asarray(ranges, dtype=np.float64), NEAREST_M)
    sigma = np.broadcast_to(np.asarray(relative_sigma, dtype=np.float64), d.shape)
    up = np.zeros(d.size) if heights is None else np.asarray(heights, dtype=np.float64)
    low, high = a.min(axis=0) - margin_m, a.max(axis=0) + margin_m
    axes = [np.linspace(low[k], high[k], max(2, min(60, math.ceil(high[k] - low[k]) + 1))) for k in (0, 1)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)

    def residual(p: FloatArray) -> tuple[FloatArray, FloatArray]:
        delta = p[..., None, :] - a
        length2 = (delta**2).sum(axis=-1) + up**2
        length2 = np.maximum(length2, NEAREST_M**2)
        return (0.5 * np.log(length2) - np.log(d)) / sigma, delta / length2[..., None] / sigma[:, None]

    cost = (residual(grid)[0] ** 2).sum(axis=-1)
    p, damping = grid[int(cost.argmin())], 1e-3
    r, jacobian = residual(p)
    best = float(r @ r)
    for _ in range(steps):
        normal = jacobian.T @ jacobian
        move = np.linalg.solve(normal + damping * np.diag(np.diag(normal) + 1e-12), -jacobian.T @ r)
        r_new, jacobian_new = residual(p + move)
        if float(r_new @ r_new) <= best:
            p, r, jacobian, damping = p + move, r_new, jacobian_new, damping / 5
            best = float(r @ r)
            if float(move @ move) < 1e-20:
                break
        else:
            damping *= 10
            if damping > 1e12:
                break
    normal = jacobian.T @ jacobian
    if not np.isfinite(p).all() or np.linalg.cond(normal) > 1e9:
        return None
    freedom = d.size - 2
    chi2 = best / freedom if freedom > 0 else math.nan
    return PositionFix(p, np.asarray(np.linalg.inv(normal), dtype=np.float64), chi2)


def information(
    positions: ArrayLike, anchors: ArrayLike, relative_sigma: ArrayLike, *, heights: ArrayLike | None = None
) -> FloatArray:
    """Return the Fisher information of received powers about positions (m, 2): (m, 2, 2), 1/m²."""
    p, a = np.atleast_2d(np.asarray(positions, dtype=np.float64)), np.asarray(anchors, dtype=np.float64)
    delta = p[:, None, :] - a[None]
    up = np.zeros(len(a)) if heights is None else np.asarray(heights, dtype=np.float64)
    length2 = np.maximum((delta**2).sum(axis=2) + up**2, NEAREST_M**2)
    slope = delta / length2[..., None] / np.broadcast_to(np.asarray(relative_sigma), len(a))[None, :, None]
    return np.einsum("mni,mnj->mij", slope, slope)


def cramer_rao_m(
    positions: ArrayLike, anchors: ArrayLike, relative_sigma: ArrayLike, *, heights: ArrayLike | None = None
) -> FloatArray:
    """Return the least standard deviation (m) of an unbiased position from one power of each anchor.

    √(trace of the inverse information), Patwari et al. 2003, eq 14; infinite where the anchors are on a line
    with the position. n independent powers of each divide it by √n.
    """
    return _trace_of_inverse(information(positions, anchors, relative_sigma, heights=heights))


def dilution(positions: ArrayLike, anchors: ArrayLike) -> FloatArray:
    """Return the horizontal dilution of precision: error of a position by that of a range, all ranges alike."""
    p, a = np.atleast_2d(np.asarray(positions, dtype=np.float64)), np.asarray(anchors, dtype=np.float64)
    delta = p[:, None, :] - a[None]
    unit = delta / np.maximum(np.linalg.norm(delta, axis=2, keepdims=True), 1e-9)
    return _trace_of_inverse(np.einsum("mni,mnj->mij", unit, unit))


def geometry_map(
    anchors: ArrayLike,
    relative_sigma: ArrayLike,
    *,
    low: tuple[float, float],
    high: tuple[float, float],
    cell_m: float = 0.5,
    reach_m: float = math.inf,
    heights: ArrayLike | None = None,
) -> dict[str, FloatArray]:
    """Return what the anchors' geometry allows over a rectangle of the plan.

    Parameters
    ----------
    anchors : array_like (n, 2)
        Positions, m. Append a planned anchor to see what it would bring.
    relative_sigma : array_like (n,) or float
        Standard deviation of a range by its length.
    low, high : tuple of float
        Corners of the rectangle, m.
    cell_m : float
        Side of a cell, m.
    reach_m : float
        Anchors farther than this do not count.
    heights : array_like (n,), optional
        Height of each anchor above the receiver, m.

    Returns
    -------
    dict of str to ndarray
        ``x`` (nx,), ``y`` (ny,) centres; ``bound_m`` (nx, ny) Cramér–Rao bound of one power of each anchor,
        ``dilution`` and ``heard`` (number of anchors in reach).
    """
    a = np.asarray(anchors, dtype=np.float64)
    sigma = np.broadcast_to(np.asarray(relative_sigma, dtype=np.float64), len(a))
    up = np.zeros(len(a)) if heights is None else np.asarray(heights, dtype=np.float64)
    x = np.arange(low[0] + cell_m / 2, high[0], cell_m)
    y = np.arange(low[1] + cell_m / 2, high[1], cell_m)
    points = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    near = np.linalg.norm(points[:, None] - a[None], axis=2) <= reach_m
    delta = points[:, None] - a[None]
    plane2 = np.maximum((delta**2).sum(axis=2), 1e-18)
    length2 = np.maximum(plane2 + up**2, NEAREST_M**2)
    slope = np.where(near[..., None], delta / length2[..., None] / sigma[None, :, None], 0.0)
    unit = np.where(near[..., None], delta / np.sqrt(plane2)[..., None], 0.0)
    shape = (x.size, y.size)
    return {
        "x": x,
        "y": y,
        "bound_m": _trace_of_inverse(np.einsum("mni,mnj->mij", slope, slope)).reshape(shape),
        "dilution": _trace_of_inverse(np.einsum("mni,mnj->mij", unit, unit)).reshape(shape),
        "heard": near.sum(axis=1).reshape(shape).astype(np.float64),
    }


def _trace_of_inverse(matrices: FloatArray) -> FloatArray:
    """Return √trace(M⁻¹) of symmetric 2 × 2 matrices, infinite where singular."""
    det = matrices[:, 0, 0] * matrices[:, 1, 1] - matrices[:, 0, 1] ** 2
    trace = matrices[:, 0, 0] + matrices[:, 1, 1]
    singular = det <= 1e-12 * trace**2
    return np.where(singular, np.inf, np.sqrt(trace / np.where(singular, 1.0, det)))
