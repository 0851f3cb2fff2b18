"""The cloud of the particle filter behind ``indoor.fused``: its state, random numbers, resampling and means.

A particle is a position on a floor, a velocity, an offset of the heading, a scale of the step, an offset of the
receiver and a hypothesis on whether it turns about itself. What is linear and Gaussian given its path, it carries as
Kalman filters (Rao–Blackwellised particle filter, Doucet et al. 2000): one an anchor, of shadowing and of what P_d0 and
η differ from their expected values; one of how much stronger it hears along x and y; one of the barometer's zero.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..contract import FloatArray
from ..numerics.compiled import compiled, inlined
from .floorplan import CLOSED

(
    X,
    Y,
    VX,
    VY,
    FLOOR,
    OFFSET,
    SCALE,
    GAIN,
    PATH,
    LOGW,
    PATTERN,
    RATE,
    AHEAD_X,
    AHEAD_Y,
    V_XX,
    V_XY,
    V_YY,
    ZERO,
    V_ZERO,
    COLUMNS,
) = range(20)
"""Columns of a particle. FLOOR: index of its floor. GAIN: the receiver's offset (dB). PATH: distance that it has walked
(m). PATTERN: how much stronger it hears on one side, standard deviation along each axis (dB), 0: alike all round; RATE:
how fast that side turns (rad/s), 0: as it likes; AHEAD_X, AHEAD_Y and their covariance: what it is now (dB). ZERO,
V_ZERO: the barometer's zero (m) and its variance."""

(
    PATH_AT,
    SHADOW,
    SHADOW_VARIANCE,
    D_POWER,
    D_ETA,
    V_POWER,
    V_ETA,
    C_SHADOW_POWER,
    C_SHADOW_ETA,
    C_POWER_ETA,
    ERRORS,
) = range(11)
"""Slow errors of an anchor's power in a particle: distance walked at its last power (m); shadowing (dB), its variance;
what P_d0 (dB) and η differ from their expected values, their variances; covariances."""
(
    A_X,
    A_Y,
    A_UP,
    A_POWER,
    A_ETA,
    A_SHADOW,
    A_LENGTH,
    A_V_POWER,
    A_V_ETA,
    A_C_POWER_ETA,
    A_MAPPED,
    A_FLOOR,
    ANCHOR_COLUMNS,
) = range(13)
"""What an anchor is: place (m), height above a receiver on its own floor (m); P_d0 (dBm), η; standard deviation (dB)
and length (m) of the shadowing; variances of P_d0 and η and their covariance; 1 where the radio map has it; index of
its floor."""
UNHEARD_M = -1e9
"""Distance walked at the last power where there was none: all of the shadowing is forgotten by then."""
ANY_ZERO_M2 = 1e4
"""Variance of the barometer's zero before it was heard."""
SURE = 0.75
"""Probability that another floor needs before a change is stated."""
TURN_S = 2.0, 40.0
"""Shortest and longest turn of a carrier that turns steadily (s)."""

SHOWN, SHOWN_NS = 60, 1_000_000_000
"""So many particles, drawn by their weights, are handed out each so often: to be seen."""
O_SIGMA, O_PARTICLE, O_FLOOR, O_CHANGE, WIDTH = 3, 6, 8, 10, 12
"""Columns of a result: position; three sigmas; place of one particle; floor and its probability; floors of a change."""

SETTINGS = np.dtype(
    [
        ("t_ns", "i8"),  # up to which the particles have moved, −1 before the first message
        ("rng", "u8"),
        ("spare", "f8"),  # second normal of a pair, NaN where there is none
        ("walking", "i8"),  # whether steps are known: no free velocity then
        ("own_steps", "i8"),  # whether steps are detected here, not given
        ("known_start", "i8"),
        ("told_ns", "i8"),  # time of the newest result
        ("shown_ns", "i8"),  # time of the newest particles that were handed out
        ("x_axis", "f8"),
        ("mirrored", "i8"),
        ("low", "f8", 2),
        ("high", "f8", 2),
        ("cell", "f8"),  # of the raster of cells, 0 without one
        ("map_low", "f8", 2),
        ("map_cell", "f8"),
        ("speed", "f8"),
        ("speed_s", "f8"),
        ("drift", "f8"),  # random walk while steps are known, m/√s
        ("fast", "f8"),
        ("freedom", "f8"),
        ("offset", "f8"),  # doubt of the receiver's offset (dB), and share of the particles that have one
        ("offset_share", "f8"),
        ("pattern", "f8"),  # dB by direction, and the time (s) over which it stays
        ("pattern_s", "f8"),
        ("turning", "f8"),  # share of the particles that turn
        ("range_sd", "f8"),
        ("wall", "f8"),  # log-likelihood of a move through a wall
        ("step_m", "f8"),
        ("step_sd", "f8"),
        ("turn_sd", "f8"),
        ("turn_walk", "f8"),
        ("height", "f8"),
        ("slab", "f8"),  # dB of the first slab, of each further one, and their standard deviation
        ("further", "f8"),
        ("slab_sd", "f8"),
        ("change_hz", "f8"),  # how often floors are changed, where that can be done
        ("stairs", "i8"),  # whether the plan says where
        ("lowest", "i8"),  # number of the lowest floor
        ("start_floor", "i8"),  # index, −1: any
        ("floor", "i8"),  # index of the one that is stated, −1 before the first
        (
            "log_p",
            "f8",
        ),  # low-passed logarithm of the pressure, that of the first, times of the last and last used
        ("log_p0", "f8"),
        ("pressure_ns", "i8"),
        ("weighed_ns", "i8"),
        ("received", "i8"),
        ("resampled", "i8"),
        ("steps", "i8"),
    ]
)


class Cloud(NamedTuple):
    """State of the filter.

    Attributes
    ----------
    s : structured array (1,)
        Settings and scalars, :data:`SETTINGS`.
    walk : structured array (1,)
        The step detector.
    p, p2 : ndarray (n, COLUMNS)
        Particles, and room for resampling.
    b, b2 : ndarray (n, anchors, ERRORS)
        Slow errors of each anchor's power.
    a : ndarray (anchors, ANCHOR_COLUMNS)
        The anchors.
    levels : ndarray (floors,)
        Heights of the floors (m).
    mean, sd : ndarray (floors or 0, anchors, nx, ny)
        Radio map.
    cells : uint8 ndarray (floors, nx, ny)
        What can be walked: :data:`.floorplan.CLOSED` …
    """

    s: NDArray[Any]
    walk: NDArray[Any]
    p: FloatArray
    p2: FloatArray
    b: FloatArray
    b2: FloatArray
    a: FloatArray
    levels: FloatArray
    mean: FloatArray
    sd: FloatArray
    cells: NDArray[np.uint8]


@inlined
def uniform(s: Any) -> float:
    """Return a number in (0, 1): xorshift64*, Vigna 2016."""
    z = s.rng
    z ^= z >> np.uint64(12)
    z ^= z << np.uint64(25)
    z ^= z >> np.uint64(27)
    s.rng = z
    return (float((z * np.uint64(2685821657736338717)) >> np.uint64(11)) + 0.5) * (1.0 / 9007199254740992.0)


@compiled
def normal(s: Any) -> float:
    """Return a standard normal number (Box and Muller 1958)."""
    if not math.isnan(s.spare):
        second = s.spare
        s.spare = math.nan
        return second
    radius = math.sqrt(-2.0 * math.log(uniform(s)))
    angle = 2.0 * math.pi * uniform(s)
    s.spare = radius * math.sin(angle)
    return radius * math.cos(angle)


@inlined
def cell_of(c: Any, floor: int, x: float, y: float) -> int:
    """Return what the cell at a place (m) of a floor is; closed outside of the raster."""
    s = c.s[0]
    i, j = math.floor((x - s.low[0]) / s.cell), math.floor((y - s.low[1]) / s.cell)
    if i < 0 or j < 0 or i >= c.cells.shape[1] or j >= c.cells.shape[2]:
        return CLOSED
    return c.cells[floor, i, j]


@compiled
def draw_turning(c: Any, i: int) -> None:
    """Draw a particle's hypothesis: alike all round; turning as it likes; or steadily, one way or the other."""
    s = c.s[0]
    p = c.p[i]
    p[PATTERN] = s.pattern if uniform(s) < s.turning else 0.0
    p[RATE] = 0.0
    if p[PATTERN] > 0.0 and uniform(s) < 0.5:
        turn_s = TURN_S[0] * (TURN_S[1] / TURN_S[0]) ** uniform(s)
        p[RATE] = 2.0 * math.pi / turn_s if uniform(s) < 0.5 else -2.0 * math.pi / turn_s
    p[AHEAD_X] = p[AHEAD_Y] = p[V_XY] = 0.0
    p[V_XX] = p[V_YY] = p[PATTERN] * p[PATTERN]


@compiled
def scatter(c: Any, x: float, y: float, sd: float, offset_sd: float, scale_sd: float) -> None:
    """Draw the particles: about (x, y), or over the open rectangle where x is NaN."""
    s = c.s[0]
    for i in range(c.p.shape[0]):
        p = c.p[i]
        for _ in range(200):
            p[FLOOR] = s.start_floor if s.start_floor >= 0 else math.floor(c.levels.size * uniform(s))
            if math.isnan(x):
                p[X] = s.low[0] + (s.high[0] - s.low[0]) * uniform(s)
                p[Y] = s.low[1] + (s.high[1] - s.low[1]) * uniform(s)
            else:
                p[X] = x + sd * normal(s)
                p[Y] = y + sd * normal(s)
            if s.cell <= 0.0 or cell_of(c, int(p[FLOOR]), p[X], p[Y]) != CLOSED:
                break
        p[VX] = s.speed * normal(s)
        p[VY] = s.speed * normal(s)
        p[OFFSET] = offset_sd * normal(s) if offset_sd < 3.0 else 2.0 * math.pi * uniform(s)
        p[SCALE] = 1.0 + scale_sd * normal(s)
        p[GAIN] = s.offset * normal(s) if uniform(s) < s.offset_share else 0.0
        p[PATH] = p[LOGW] = 0.0
        p[ZERO], p[V_ZERO] = 0.0, ANY_ZERO_M2
        draw_turning(c, i)
        for k in range(c.a.shape[0]):
            b = c.b[i, k]
            b[:] = 0.0
            b[PATH_AT] = UNHEARD_M
            b[V_POWER], b[V_ETA] = c.a[k, A_V_POWER], c.a[k, A_V_ETA]
            b[C_POWER_ETA] = c.a[k, A_C_POWER_ETA]


@compiled
def mean_of(c: Any, out: FloatArray) -> float:
    """Fill ``out`` with position, sigmas and floor; make the weights' maximum 0; return their effective number."""
    s = c.s[0]
    n = c.p.shape[0]
    top = -1e300
    for i in range(n):
        top = max(top, c.p[i, LOGW])
    total, square, x, y = 0.0, 0.0, 0.0, 0.0
    for i in range(n):
        c.p[i, LOGW] -= top
        w = math.exp(c.p[i, LOGW])
        total += w
        square += w * w
        x += w * c.p[i, X]
        y += w * c.p[i, Y]
    x, y = x / total, y / total
    xx, yy = 0.0, 0.0
    for i in range(n):
        w = math.exp(c.p[i, LOGW])
        xx += w * (c.p[i, X] - x) ** 2
        yy += w * (c.p[i, Y] - y) ** 2
    floor, most = 0, 1.0
    if c.levels.size > 1:
        floor, most = 0, -1.0
        for k in range(c.levels.size):
            share = 0.0
            for i in range(n):
                share += math.exp(c.p[i, LOGW]) if c.p[i, FLOOR] == k else 0.0
            if share > most:
                floor, most = k, share
        most /= total
        if s.floor < 0 or (floor != s.floor and most >= SURE):
            if out.size == WIDTH and s.floor >= 0:
                out[O_CHANGE], out[O_CHANGE + 1] = s.lowest + s.floor, s.lowest + floor
            s.floor = floor
        if out.size == WIDTH:
            out[O_FLOOR], out[O_FLOOR + 1] = s.lowest + floor, most
    out[0], out[1], out[2] = x, y, c.levels[floor] + s.height
    out[O_SIGMA], out[O_SIGMA + 1] = math.sqrt(xx / total), math.sqrt(yy / total)
    return total * total / square


@compiled
def resample(c: Any) -> None:
    """Systematic resampling (Kitagawa 1996)."""
    s = c.s[0]
    s.resampled += 1
    n, anchors = c.p.shape[0], c.a.shape[0]
    total = 0.0
    for i in range(n):
        total += math.exp(c.p[i, LOGW])
    u = uniform(s) / n
    j, reached = 0, math.exp(c.p[0, LOGW]) / total
    for i in range(n):
        while reached < u and j < n - 1:
            j += 1
            reached += math.exp(c.p[j, LOGW]) / total
        u += 1.0 / n
        for k in range(COLUMNS):
            c.p2[i, k] = c.p[j, k]
        for k in range(anchors):
            for m in range(ERRORS):
                c.b2[i, k, m] = c.b[j, k, m]
    for i in range(n):
        for k in range(COLUMNS):
            c.p[i, k] = c.p2[i, k]
        c.p[i, LOGW] = 0.0
        for k in range(anchors):
            for m in range(ERRORS):
                c.b[i, k, m] = c.b2[i, k, m]


@compiled
def show(c: Any, out_values: FloatArray, count: int) -> None:
    """Fill rows from ``count`` on with the places of particles: systematic sampling, without random numbers."""
    n = c.p.shape[0]
    total = 0.0
    for i in range(n):
        total += math.exp(c.p[i, LOGW])
    j, reached = 0, math.exp(c.p[0, LOGW]) / total
    for i in range(SHOWN):
        while reached < (i + 0.5) / SHOWN and j < n - 1:
            j += 1
            reached += math.exp(c.p[j, LOGW]) / total
        out = out_values[count + i]
        for k in range(out.size):
            out[k] = math.nan
        out[O_PARTICLE], out[O_PARTICLE + 1] = c.p[j, X], c.p[j, Y]
