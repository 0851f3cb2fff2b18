"""Hinge by whole vectors inside a filter's kernel: axes, pairing and positions where norms do not show them.

The misfit of :mod:`.vectorfit` in a form that a filter can afford: means over blocks take the place of its low-pass,
the angle at the start of every window of blocks is found in closed form, and biases are left out, for a window is
short. Gauss-Newton with differences. Sit-to-stand needs it: the shank hardly turns, so that norms of rates say little
of its axis, while the thigh's turn takes the force from one direction to the other.
"""

from __future__ import annotations

import math
from typing import Any

from ..contract import FloatArray
from ..numerics.compiled import compiled
from .axisfit import (
    GYR,
    SUM,
    WIDTH,
    add_normal,
    centre_force,
    huber,
    invert,
    set_tangent,
    settle_positions,
    solve,
)

UNKNOWNS = 10
"""Both axes in their tangent planes, both positions."""
BLOCKS = 7
"""Blocks of a window: 2 s with blocks of 0.3 s."""
STEP = 1e-4
"""Of the differences (rad, m)."""
STEPS = 20
FITS = 0.7
"""Mean cost of a block's misfit above which the joint is no hinge: 0.1 to 0.6 in simulated sit-to-stand and squats with
soft tissue, 1.0 in a leg that is lifted in several directions, whose axes then look sharper than they are."""
DENSE_S = 0.15
"""Time between samples above which a block averages nothing any more."""
SD_POSITION = 1.0
"""Prior (m): what the data do not show stays at zero."""

WORK: list[Any] = [
    ("from_axis", "f8", (2, 3)),  # where the differences start
    ("from_pos", "f8", (2, 3)),
    ("across", "f8", (2, 2, 3)),  # two directions across each axis
    ("sums", "f8", (BLOCKS, 10)),  # of a block: force and rate across of both, force along apart, count
    ("residuals", "f8", (UNKNOWNS + 1, BLOCKS, 5)),
    ("best_pos", "f8", (2, 3)),
    ("start_axis", "f8", (2, 3)),
    ("end_axis", "f8", (2, 2, 3)),  # of either pairing
    ("end_pos", "f8", (2, 2, 3)),
    ("pair_cost", "f8", (2,)),
    ("block_cost", "f8"),  # mean, at the better end; 0 where norms were enough
]


@compiled
def vary(w: Any, v: int, step: float) -> None:
    """Set axes and positions to where the differences start, unknown ``v`` moved by ``step``; bases across."""
    for i in range(2):
        size, along = 0.0, 0.0
        for m in range(3):
            w.axis[i, m] = w.from_axis[i, m]
            w.pos[i, m] = w.from_pos[i, m]
            if v // 2 == i and v < 4:
                w.axis[i, m] += step * w.tangent[i, v % 2, m]
            size += w.axis[i, m] ** 2
        if v >= 4 and (v - 4) // 3 == i:
            w.pos[i, (v - 4) % 3] += step
        size = math.sqrt(size)
        for m in range(3):
            w.axis[i, m] /= size
            along += w.axis[i, m] * w.tangent[i, 0, m]
        size = 0.0
        for m in range(3):
            w.across[i, 0, m] = w.tangent[i, 0, m] - along * w.axis[i, m]
            size += w.across[i, 0, m] ** 2
        size = math.sqrt(size)
        for m in range(3):
            w.across[i, 0, m] /= size
        for m in range(3):
            n, o = (m + 1) % 3, (m + 2) % 3
            w.across[i, 1, m] = w.axis[i, n] * w.across[i, 0, o] - w.axis[i, o] * w.across[i, 0, n]


@compiled
def window_misfit(
    w: Any, rows: FloatArray, first: int, last: int, block: int, v: int, sd_gyr: float, sd_acc: float
) -> int:
    """Write the misfits of one window's blocks to ``w.residuals[v]``; return how many blocks it has."""
    blocks = 0
    dot, cross = 0.0, 0.0
    for start in range(first, last, block):
        t = w.sums[blocks]
        for m in range(10):
            t[m] = 0.0
        for k in range(start, min(last, start + block)):
            turn = 0.0
            for m in range(3):
                turn += (rows[k, SUM + m] - rows[first, SUM + m]) * w.axis[0, m]
                turn -= (rows[k, WIDTH + SUM + m] - rows[first, WIDTH + SUM + m]) * w.axis[1, m]
            c, s = math.cos(turn), math.sin(turn)
            for i in range(2):
                centre_force(w, rows[k], i)
                fx, fy, fz, gx, gy = 0.0, 0.0, 0.0, 0.0, 0.0
                for m in range(3):
                    rate = rows[k, WIDTH * i + GYR + m]
                    fx += w.force[i, m] * w.across[i, 0, m]
                    fy += w.force[i, m] * w.across[i, 1, m]
                    fz += w.force[i, m] * w.axis[i, m]
                    gx += rate * w.across[i, 0, m]
                    gy += rate * w.across[i, 1, m]
                if i == 0:
                    t[0] += fx
                    t[1] += fy
                    t[2] += gx
                    t[3] += gy
                    t[8] += fz
                else:  # turned back by what the joint has turned since the window's start
                    t[4] += c * fx + s * fy
                    t[5] += c * fy - s * fx
                    t[6] += c * gx + s * gy
                    t[7] += c * gy - s * gx
                    t[8] -= fz
            t[9] += 1.0
        dot += t[4] * t[0] + t[5] * t[1]
        cross += t[4] * t[1] - t[5] * t[0]
        blocks += 1
    size = max(1e-12, math.sqrt(dot * dot + cross * cross))
    c, s = dot / size, -cross / size  # of the angle at the window's start
    for b in range(blocks):
        t, e = w.sums[b], w.residuals[v, b]
        e[0] = (t[0] - c * t[4] - s * t[5]) / (t[9] * sd_acc)
        e[1] = (t[1] + s * t[4] - c * t[5]) / (t[9] * sd_acc)
        e[2] = (t[2] - c * t[6] - s * t[7]) / (t[9] * sd_gyr)
        e[3] = (t[3] + s * t[6] - c * t[7]) / (t[9] * sd_gyr)
        e[4] = t[8] / (t[9] * sd_acc)
    return blocks


@compiled
def cost_of(
    w: Any, rows: FloatArray, count: int, block: int, sd_gyr: float, sd_acc: float, normal: bool
) -> float:
    """Return the cost at ``w.from_axis``, ``w.from_pos``; with ``normal`` also tangents and normal equations."""
    total = 0.0
    if normal:
        for i in range(2):
            for m in range(3):
                w.axis[i, m] = w.from_axis[i, m]
            set_tangent(w, i)
    for a in range(UNKNOWNS):
        w.rhs[a] = 0.0
        for b in range(UNKNOWNS):
            w.N[a, b] = 0.0
    for i in range(6):
        w.rhs[4 + i] = -w.from_pos[i // 3, i % 3] / SD_POSITION**2
        w.N[4 + i, 4 + i] = 1.0 / SD_POSITION**2
        total += (w.from_pos[i // 3, i % 3] / SD_POSITION) ** 2
    for first in range(0, count - block, BLOCKS * block):
        last = min(count, first + BLOCKS * block)
        blocks = 0
        for v in range(UNKNOWNS + 1 if normal else 1):
            vary(w, v - 1, 0.0 if v == 0 else STEP)
            blocks = window_misfit(w, rows, first, last, block, v, sd_gyr, sd_acc)
        for b in range(blocks):
            for m in range(5):
                e = w.residuals[0, b, m]
                weight = huber(e, 1.0)
                total += weight * e * e
                if normal:
                    for v in range(UNKNOWNS):
                        w.jac[v] = (w.residuals[v + 1, b, m] - e) / STEP
                    add_normal(w, UNKNOWNS, e, weight)
    return total


@compiled
def descend(w: Any, rows: FloatArray, count: int, block: int, sd_gyr: float, sd_acc: float) -> float:
    """Improve ``w.from_axis`` and ``w.from_pos`` by damped Gauss-Newton steps; return the cost."""
    damping = 1e-3
    cost = cost_of(w, rows, count, block, sd_gyr, sd_acc, True)
    for _ in range(STEPS):
        if not solve(w, UNKNOWNS, damping):
            break
        step = 0.0
        for a in range(UNKNOWNS):
            step += w.rhs[a] ** 2
        for i in range(2):
            for m in range(3):
                w.best[i, m] = w.from_axis[i, m]
                w.best_pos[i, m] = w.from_pos[i, m]
                w.from_axis[i, m] += w.rhs[2 * i] * w.tangent[i, 0, m] + w.rhs[2 * i + 1] * w.tangent[i, 1, m]
                w.from_pos[i, m] += w.rhs[4 + 3 * i + m]
            size = math.sqrt(w.from_axis[i, 0] ** 2 + w.from_axis[i, 1] ** 2 + w.from_axis[i, 2] ** 2)
            for m in range(3):
                w.from_axis[i, m] /= size
        tried = cost_of(w, rows, count, block, sd_gyr, sd_acc, False)
        if tried <= cost:
            damping = max(1e-7, 0.2 * damping)
        else:
            for i in range(2):
                for m in range(3):
                    w.from_axis[i, m] = w.best[i, m]
                    w.from_pos[i, m] = w.best_pos[i, m]
            damping *= 20.0
            if damping > 1e6:
                break
        cost = cost_of(w, rows, count, block, sd_gyr, sd_acc, True)
        if step < 1e-10 and tried <= cost * (1.0 + 1e-12):
            break
    return cost


@compiled
def fit(w: Any, rows: FloatArray, count: int, block: int, sd_gyr: float, sd_acc: float) -> None:
    """Find ``w.axis``, ``w.pos`` and ``w.pairing`` from the axes that are there, with either pairing.

    Also fills their standard deviations and ``w.block_cost``.
    """
    costs = w.pair_cost
    for turned in range(2):
        for i in range(2):
            for m in range(3):
                if turned == 0:
                    w.start_axis[i, m] = w.axis[i, m]
                w.from_axis[i, m] = -w.start_axis[i, m] if turned == 1 and i == 1 else w.start_axis[i, m]
                w.from_pos[i, m] = 0.0
        costs[turned] = descend(w, rows, count, block, sd_gyr, sd_acc)
        for i in range(2):
            for m in range(3):
                w.end_axis[turned, i, m] = w.from_axis[i, m]
                w.end_pos[turned, i, m] = w.from_pos[i, m]
    better = 1 if costs[1] < costs[0] else 0
    # Where both starts end in one place the other pairing is no minimum at all.
    upper, lower = 0.0, 0.0
    for m in range(3):
        upper += w.end_axis[0, 0, m] * w.end_axis[1, 0, m]
        lower += w.end_axis[0, 1, m] * w.end_axis[1, 1, m]
    w.pairing = costs[1 - better] / (costs[0] + costs[1]) if upper * lower < 0.0 else 1.0
    for i in range(2):
        for m in range(3):
            w.from_axis[i, m] = w.end_axis[better, i, m]
            w.from_pos[i, m] = w.end_pos[better, i, m]
    w.cost = cost_of(w, rows, count, block, sd_gyr, sd_acc, True)
    vary(w, -1, 0.0)
    w.block_cost = w.cost / (5.0 * count / block)
    invert(w, UNKNOWNS)
    scale = max(1.0, w.block_cost)
    for i in range(2):
        w.axis_sd[i] = math.sqrt(scale * max(0.0, w.cov[2 * i, 2 * i] + w.cov[2 * i + 1, 2 * i + 1]))
    settle_positions(w, 4, scale)
