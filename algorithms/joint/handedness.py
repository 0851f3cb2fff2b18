"""Whether a sensor's gyroscope and accelerometer agree which way it turns, from this sensor alone.

With right-handed axes the force at a point whose vector to the sensor is o, turned by the integrated rate, is gravity
and the point's acceleration: R (f − Γ(o)), dR/dt = R [g]×, stays near a constant over some seconds. In left-handed axes
(one axis mirrored, or the gyroscope's sign wrong) that holds with −g in place of g, because a product of two vectors
changes its sign under a reflection. Both are tried: over windows of :data:`WINDOW_S` the constant is the window's mean,
o is found by least squares over all windows (a swinging lever may hide gravity's turn), and what is left is compared.

Fast walking decides little (what is left is the body's acceleration either way), slow movements decide it by far; in
doubt nothing is said. Where two neighbouring sensors span a hinge, :func:`.hingefit.find_hand` compares them as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ..contract import FloatArray
from ..numerics.compiled import compiled, inlined
from ..numerics.records import record_type
from ..numerics.rotations import turn_body
from . import axisfit, hingefit

WINDOW_S = 2.0
MOST_S = 60.0
"""So much motion is looked at."""
RATE = 0.22
"""Root mean square of the rate (rad/s) that a window must have."""
LEAST_WINDOWS = 3
REACH = 0.3
"""Prior of the lever (m)."""
LEAST_RMS = 0.7
"""What is left (m/s²) below which either is good enough: hardly any motion."""
BETTER = 0.6
"""Left with the rate reversed, over left with it as it is, below which the axes are called left-handed."""

SPACING_S, STORE = 0.05, 512
"""Samples in motion that are kept for the comparison of neighbours: the first half minute."""
LEAST_ROWS = 100

FIELDS: list[Any] = [
    ("hand_rows", "f8", (STORE, 4 * axisfit.WIDTH)),
    ("hand_valid", "i8", (STORE, 4)),
    ("hand_kept", "i8"),
    ("hand_wait", "f8"),
    ("hand_turned", "f8", (4, 3)),
    ("hand_rot", "f8", (4, 2, 3, 3)),
    ("hand_time", "f8", (4,)),  # of the present window
    ("hand_count", "i8", (4,)),
    ("hand_rate", "f8", (4,)),
    ("hand_force", "f8", (4, 2, 3)),  # sums of the window: R f, R G, fᵀf, Gᵀf, GᵀG
    ("hand_lever", "f8", (4, 2, 3, 3)),
    ("hand_ff", "f8", (4,)),
    ("hand_gf", "f8", (4, 2, 3)),
    ("hand_gg", "f8", (4, 2, 3, 3)),
    ("hand_N", "f8", (4, 2, 3, 3)),  # of all windows, their means taken out
    ("hand_b", "f8", (4, 2, 3)),
    ("hand_yy", "f8", (4, 2)),
    ("hand_samples", "i8", (4,)),
    ("hand_windows", "i8", (4,)),
]
"""Fields of a packed record, four sensors, rate as it is and reversed."""


PAIR = record_type(
    ("acc", "f8", (2, 3)),
    ("gyr", "f8", (2, 3)),
    ("dgyr", "f8", (2, 3)),
    ("turn", "f8", (2, 3)),
    ("dt", "f8"),
    ("slope", "i8", (2,)),
    ("gap", "f8", (2,)),
    *FIELDS,
)


@compiled
def begin(s: Any, i: int) -> None:
    """Begin a window of sensor ``i``."""
    s.hand_time[i], s.hand_rate[i], s.hand_ff[i] = 0.0, 0.0, 0.0
    s.hand_count[i] = 0
    for h in range(2):
        for a in range(3):
            s.hand_force[i, h, a], s.hand_gf[i, h, a] = 0.0, 0.0
            for b in range(3):
                s.hand_rot[i, h, a, b] = 1.0 if a == b else 0.0
                s.hand_lever[i, h, a, b], s.hand_gg[i, h, a, b] = 0.0, 0.0


@compiled
def close(s: Any, i: int) -> None:
    """Add a whole window of sensor ``i`` to all, if it turned."""
    n = s.hand_count[i]
    if n < 10 or s.hand_rate[i] < RATE * RATE * n:
        return
    for h in range(2):
        yy = s.hand_ff[i]
        for a in range(3):
            yy -= s.hand_force[i, h, a] ** 2 / n
            mean = 0.0
            for k in range(3):
                mean += s.hand_lever[i, h, k, a] * s.hand_force[i, h, k]
            s.hand_b[i, h, a] += s.hand_gf[i, h, a] - mean / n
            for b in range(3):
                mean = 0.0
                for k in range(3):
                    mean += s.hand_lever[i, h, k, a] * s.hand_lever[i, h, k, b]
                s.hand_N[i, h, a, b] += s.hand_gg[i, h, a, b] - mean / n
        s.hand_yy[i, h] += yy
    s.hand_samples[i] += n
    s.hand_windows[i] += 1


@inlined
def lever_column(g: FloatArray, d: FloatArray, sign: float, a: int) -> tuple[float, float, float]:
    """Return column ``a`` of Γ: g g_a − |g|² e_a + sign · ġ × e_a, of rates ``g`` and their derivatives ``d``, (3,)."""
    size = g[0] * g[0] + g[1] * g[1] + g[2] * g[2]
    x, y, z = g[0] * g[a], g[1] * g[a], g[2] * g[a]
    if a == 0:
        return x - size, y + sign * d[2], z - sign * d[1]
    if a == 1:
        return x - sign * d[2], y - size, z + sign * d[0]
    return x + sign * d[1], y - sign * d[0], z - size


@compiled
def look(s: Any, i: int) -> None:
    """Take sensor ``i`` of the sample given out (``acc``, ``gyr``, ``dgyr``, ``turn``, ``dt`` of ``s``)."""
    if s.hand_windows[i] * WINDOW_S >= MOST_S:
        return
    if s.slope[i] == 0 or s.gap[i] > 0.0:
        begin(s, i)
        return
    if s.hand_time[i] >= WINDOW_S or s.hand_count[i] == 0:
        close(s, i)
        begin(s, i)
    s.hand_time[i] += s.dt
    s.hand_count[i] += 1
    f, g, d = s.acc[i], s.gyr[i], s.dgyr[i]
    s.hand_rate[i] += g[0] * g[0] + g[1] * g[1] + g[2] * g[2]
    s.hand_ff[i] += f[0] * f[0] + f[1] * f[1] + f[2] * f[2]
    for h in range(2):
        sign = 1.0 if h == 0 else -1.0
        r = s.hand_rot[i, h]
        if s.hand_count[i] > 1:
            turn_body(r, sign * s.turn[i, 0], sign * s.turn[i, 1], sign * s.turn[i, 2])
        for a in range(3):
            c0, c1, c2 = lever_column(g, d, sign, a)
            s.hand_gf[i, h, a] += c0 * f[0] + c1 * f[1] + c2 * f[2]
            for b in range(3):
                e0, e1, e2 = lever_column(g, d, sign, b)
                s.hand_gg[i, h, a, b] += c0 * e0 + c1 * e1 + c2 * e2
            for k in range(3):
                s.hand_lever[i, h, k, a] += r[k, 0] * c0 + r[k, 1] * c1 + r[k, 2] * c2
        for k in range(3):
            s.hand_force[i, h, k] += r[k, 0] * f[0] + r[k, 1] * f[1] + r[k, 2] * f[2]


@compiled
def keep(s: Any) -> None:
    """Keep the sample given out of all sensors, columns of :mod:`.axisfit`."""
    k = s.hand_kept
    if k == STORE:
        return
    moves = False
    for i in range(s.n):
        if s.valid[i] == 1:
            size = 0.0
            for m in range(3):
                s.hand_turned[i, m] += s.turn[i, m]
                size += s.gyr[i, m] ** 2
            moves = moves or size > hingefit.STILL_RATE**2
    s.hand_wait += s.dt
    if not moves or s.hand_wait < SPACING_S:
        return
    s.hand_wait = 0.0
    for i in range(s.n):
        s.hand_valid[k, i] = s.valid[i] * s.slope[i]
        axisfit.write_sample(s, s.hand_rows[k], i, s.hand_turned[i])
    s.hand_kept = k + 1


@compiled
def look_through(s: Any, rows: FloatArray, dt: float) -> None:
    """Take all samples of two sensors, columns of :mod:`.axisfit`, ``dt`` apart."""
    s.dt = dt
    for k in range(1, rows.shape[0]):
        for i in range(2):
            b = axisfit.WIDTH * i
            for m in range(3):
                s.acc[i, m] = rows[k, b + axisfit.ACC + m]
                s.gyr[i, m] = rows[k, b + axisfit.GYR + m]
                s.dgyr[i, m] = rows[k, b + axisfit.DGYR + m]
                s.turn[i, m] = rows[k, b + axisfit.SUM + m] - rows[k - 1, b + axisfit.SUM + m]
            s.slope[i] = 1
            look(s, i)


def left_over(s: Any, i: int) -> tuple[float, float]:
    """Return what is left (m/s²) of sensor ``i`` with its rate as it is, and reversed; NaN without enough motion."""
    if s["hand_windows"][i] < LEAST_WINDOWS:
        return float("nan"), float("nan")
    count = 3.0 * float(s["hand_samples"][i])
    left = []
    for h in range(2):
        N, b, yy = s["hand_N"][i, h], s["hand_b"][i, h], float(s["hand_yy"][i, h])
        prior = float(s["hand_windows"][i]) * 5.0 * yy / count / REACH**2
        o = np.linalg.solve(N + prior * np.eye(3), b)
        left.append(float(np.sqrt(max(0.0, yy - 2.0 * b @ o + o @ N @ o) / count)))
    return left[0], left[1]


def left_handed(s: Any, i: int) -> bool:
    """Return whether the axes of sensor ``i`` are left-handed, or its gyroscope's sign wrong."""
    plain, reversed_rate = left_over(s, i)
    return plain > LEAST_RMS and reversed_rate < BETTER * plain


class Neighbours(NamedTuple):
    """What the hinge between two sensors shows: axes (2, 3) in the sensors' frames, which are left-handed (a bit each).

    ``sharp``: whether the axes are known to 6°, so that it is a hinge and moves.
    """

    axes: FloatArray
    hand: int
    sharp: bool


def neighbours(rows: FloatArray, lag: int, gravity: float) -> Neighbours:
    """Return what two sensors show of the hinge between them.

    Parameters
    ----------
    rows : ndarray, shape (n, 24)
        Samples in the order of time, columns of :mod:`.axisfit`.
    lag : int
        Rows that lie about 0.3 s apart.
    gravity : float
        m/s².
    """
    work = np.zeros(1, axisfit.WORK_DTYPE)
    w = work[0]
    w["axis"] = np.eye(3)[0]
    about = rows, len(rows), lag, hingefit.SD_GYR, hingefit.SD_ACC, gravity
    paired = hingefit.fit(work[0], *about, True)
    axes = w["axis"].copy()
    sharp = bool(paired and w["pairing"] > hingefit.PAIRED and w["axis_sd"].max() < hingefit.SHARP)
    if w["pairing"] < hingefit.DOUBTFUL:
        hingefit.find_hand(work[0], *about)
    return Neighbours(axes, int(w["hand"]), sharp)


def pairs_of(s: Any, segments: Sequence[str], gravity: float) -> list[Neighbours | None]:
    """Return of all neighbouring segments what the kept samples show; None where these are too few."""
    pairs: list[Neighbours | None] = []
    for i in range(len(segments) - 1):
        good = s["hand_valid"][: s["hand_kept"], i : i + 2].all(axis=1)
        columns = slice(axisfit.WIDTH * i, axisfit.WIDTH * (i + 2))
        rows = np.ascontiguousarray(s["hand_rows"][: s["hand_kept"], columns][good])
        enough = len(rows) >= LEAST_ROWS
        pairs.append(neighbours(rows, round(0.3 / SPACING_S), gravity) if enough else None)
    return pairs


def left_handed_neighbours(pairs: Sequence[Neighbours | None], segments: Sequence[str]) -> list[str]:
    """Return the segments whose sensors are left-handed by the joints with their neighbours, where these are hinges."""
    hands = [pair.hand if pair else 0 for pair in pairs]
    before = [0, *hands]
    return [n for i, n in enumerate(segments) if before[i] & 2 or (i < len(hands) and hands[i] & 1)]


def left_handed_of(s: Any, segments: Sequence[str], hand: int) -> list[str]:
    """Return the segments whose sensors are left-handed, by themselves, else by the pair (``hand``, a bit each)."""
    alone = [name for i, name in enumerate(segments) if left_handed(s, i)]
    return alone or [name for i, name in enumerate(segments) if hand >> i & 1]
