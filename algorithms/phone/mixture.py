"""The track as a mixture of Gaussian hypotheses: steps carry it, fixes weigh and correct it.

State of a hypothesis: position east, north (m), heading correction (rad, added to the steps' headings),
logarithm of the length's scale, the slow error of the fixes (m), a Gauss–Markov process that begins anew where fixes
of another accuracy come from another source (:data:`OTHER_SOURCE`), and the rate at which the headings drift (rad/s:
the gyroscope's bias about the vertical). An unknown initial
heading is a ring of hypotheses, not a linearization. A fix is an inlier or an outlier with stated
probabilities; each hypothesis is corrected by its inlier's share (probabilistic data association, Bar-Shalom), so
that a fix far off moves nothing and a doubtful one a little, with the covariance to match. A receiver's own
velocity (Doppler) says in the same way how headings and lengths are to be corrected.
"""

from __future__ import annotations

import math
from typing import Any

from ..numerics.compiled import compiled, inlined
from .attitude import wrap

N = 7
HYPOTHESES = 12
OTHER_SOURCE = 3.0
"""Factor between stated accuracies from which on fixes come from another source (cells instead of satellites)."""

VELOCITY_TAU_S = 4.0
"""Receivers filter their velocity: readings closer in time than this say the same again."""
VELOCITY_OUTLIER = 1.0
"""Deviation an axis (m/s) that a wrong velocity has beside the stated one."""

FIELDS: list[tuple[Any, ...]] = [
    ("hyp", "i8"),  # number of hypotheses that are alive
    ("hx", "f8", (HYPOTHESES, N)),
    ("hP", "f8", (HYPOTHESES, N, N)),
    ("hw", "f8", (HYPOTHESES,)),
    ("work", "f8", (2, N)),
    ("ringed", "i8"),  # whether the hypotheses are the ring that they were at the start, none dropped
    ("before", "f8", (HYPOTHESES,)),
    ("located", "i8"),
    ("moved_ns", "i8"),
    ("q_length", "f8"),  # relative standard deviation of a step's length
    ("q_heading", "f8"),  # standard deviation of a step's heading (rad)
    ("q_turn", "f8"),  # growth of the heading's error, rad per √step
    ("q_scale", "f8"),  # growth of the scale's error, per √step
    ("q_drift", "f8"),  # growth of the drift, rad/s per √s
    ("gm_share", "f8"),  # share of the slow error in a fix's variance
    ("gm_tau", "f8"),
    ("gm_sd", "f8"),  # stationary standard deviation of the slow error now modelled (m)
    ("outlier", "f8"),
    ("velocity_ns", "i8"),  # when the last velocity was taken
    ("mean", "f8", (4,)),  # mixture: east, north, heading correction, scale
    ("cov", "f8", (4,)),  # east, east-north, north; variance of the heading correction
    ("fixes", "i8"),
    ("outliers", "f8"),
]


def configure(
    s: Any, *, heading_known: bool, sigma_heading: float, sigma_scale: float, sigma_drift: float
) -> None:
    """Start the hypotheses in record ``s``: one where the heading is known, else a ring of them."""
    count = 1 if heading_known else HYPOTHESES
    s["hyp"], s["ringed"] = count, 0 if heading_known else 1
    for h in range(count):
        turn = 2 * math.pi * h / count
        s["hx"][h, 2] = turn - 2 * math.pi if turn > math.pi else turn
        s["hP"][h, 2, 2] = sigma_heading**2 if heading_known else (math.pi / count) ** 2
        s["hP"][h, 3, 3] = sigma_scale**2
        s["hP"][h, 6, 6] = sigma_drift**2
        s["hw"][h] = 1.0 / count


def weigh(s: Any, center: float, sigma: float, share: float) -> None:
    """Weigh the ring by a heading known to ``sigma`` about ``center``, wrong altogether with ``share``."""
    total = 0.0
    for h in range(HYPOTHESES):
        d = wrap(s["hx"][h, 2] - center)
        s["hw"][h] = share / HYPOTHESES + (1 - share) * math.exp(-0.5 * (d / sigma) ** 2)
        total += s["hw"][h]
    s["hw"][:HYPOTHESES] /= total


@compiled
def branch(s: Any, turn: float, share: float) -> None:
    """Let every hypothesis be wrong by ``turn`` (rad) with probability ``share``, as far as there is room.

    A whole ring of hypotheses has one near that turn already: then the weights are shared out.
    """
    if s.ringed == 1:
        by = round(turn / (2.0 * math.pi / HYPOTHESES))
        for h in range(HYPOTHESES):
            s.before[h] = s.hw[h]
        for h in range(HYPOTHESES):
            s.hw[h] = (1.0 - share) * s.before[h] + share * s.before[(h - by) % HYPOTHESES]
        return
    for h in range(s.hyp):
        if s.hyp < HYPOTHESES:
            new = s.hyp
            _copy(s, h, new)
            s.hx[new, 2] = wrap(s.hx[new, 2] + turn)
            s.hw[new], s.hw[h] = share * s.hw[h], (1.0 - share) * s.hw[h]
            s.hyp = new + 1


@compiled
def step(s: Any, t_ns: int, length: float, heading: float, share: float) -> None:
    """Move all hypotheses by ``share`` of a step (length in m, heading in rad)."""
    age(s, t_ns)
    for h in range(s.hyp):
        d = s.hx[h, 2]
        r = length * share * math.exp(s.hx[h, 3])
        c, w = math.cos(heading + d), math.sin(heading + d)
        s.hx[h, 0] += r * c
        s.hx[h, 1] += r * w
        # P ← F P Fᵀ, rows then columns; F has −r w, r c for the heading and r c, r w for the scale.
        for j in range(N):
            a, b = s.hP[h, 2, j], s.hP[h, 3, j]
            s.hP[h, 0, j] += -r * w * a + r * c * b
            s.hP[h, 1, j] += r * c * a + r * w * b
        for i in range(N):
            a, b = s.hP[h, i, 2], s.hP[h, i, 3]
            s.hP[h, i, 0] += -r * w * a + r * c * b
            s.hP[h, i, 1] += r * c * a + r * w * b
        along, across = (s.q_length * r) ** 2 / share, (s.q_heading * r) ** 2 / share
        s.hP[h, 0, 0] += along * c * c + across * w * w
        s.hP[h, 1, 1] += along * w * w + across * c * c
        s.hP[h, 0, 1] += (along - across) * c * w
        s.hP[h, 1, 0] = s.hP[h, 0, 1]
        s.hP[h, 2, 2] += share * s.q_turn**2
        s.hP[h, 3, 3] += share * s.q_scale**2
    summarize(s)


@compiled
def age(s: Any, t_ns: int) -> None:
    """Let the headings drift and the fixes' slow error fade since the last event."""
    dt = (t_ns - s.moved_ns) * 1e-9 if s.moved_ns != 0 else 0.0
    s.moved_ns = max(t_ns, s.moved_ns)
    if dt <= 0.0:
        return
    for h in range(s.hyp):
        s.hx[h, 2] += s.hx[h, 6] * dt
        for j in range(N):
            s.hP[h, 2, j] += dt * s.hP[h, 6, j]
        for j in range(N):
            s.hP[h, j, 2] += dt * s.hP[h, j, 6]
        s.hP[h, 6, 6] += dt * s.q_drift**2
    if s.gm_sd == 0.0:
        return
    keep = math.exp(-dt / s.gm_tau)
    add = s.gm_sd**2 * (1.0 - keep * keep)
    for h in range(s.hyp):
        for i in range(4, 6):
            s.hx[h, i] *= keep
            for j in range(N):
                s.hP[h, i, j] *= keep
            for j in range(N):
                s.hP[h, j, i] *= keep
            s.hP[h, i, i] += add


@compiled
def fix(s: Any, t_ns: int, east: float, north: float, sd: float) -> None:
    """Take a fix (m) whose stated standard deviation an axis is ``sd`` (m)."""
    age(s, t_ns)
    s.fixes += 1
    slow, white = sd * math.sqrt(s.gm_share), sd * sd * (1.0 - s.gm_share)
    if s.located == 0 or slow > OTHER_SOURCE * s.gm_sd or slow * OTHER_SOURCE < s.gm_sd:
        s.gm_sd = slow
        for h in range(s.hyp):
            for i in range(4, 6):
                s.hx[h, i] = 0.0
                for j in range(N):
                    s.hP[h, i, j] = s.hP[h, j, i] = 0.0
                s.hP[h, i, i] = slow * slow
    else:
        s.gm_sd += 0.2 * (slow - s.gm_sd)
    if s.located == 0:
        s.located = 1
        for h in range(s.hyp):  # the walked way so far is about an unknown origin
            s.hP[h, 0, 0] += 1e8
            s.hP[h, 1, 1] += 1e8
        for h in range(s.hyp):
            a, b, c = _innovation(s, h, white)
            _place_gain(s, h)
            _correct(s, h, east - s.hx[h, 0] - s.hx[h, 4], north - s.hx[h, 1] - s.hx[h, 5], a, b, c, 1.0)
        summarize(s)
        return
    total, outside = 0.0, 0.0
    for h in range(s.hyp):
        x, y = east - s.hx[h, 0] - s.hx[h, 4], north - s.hx[h, 1] - s.hx[h, 5]
        a, b, c = _innovation(s, h, white)
        share = _weigh(s, h, x, y, a, b, c, 2500.0)  # an outlier has 50 m more an axis
        total += s.hw[h]
        outside += s.hw[h] * (1.0 - share)
        _place_gain(s, h)
        _correct(s, h, x, y, a, b, c, share)
    s.outliers += outside / total if total > 0.0 else 1.0
    _judge(s, total)


@compiled
def velocity(s: Any, t_ns: int, walked: Any, east: float, north: float, sd: float) -> None:
    """Take a receiver's velocity (m/s, standard deviation an axis ``sd``) beside that of the steps.

    ``walked``: velocity by steps and headings before correction (east, north), its mean square (m²/s²). Where
    their mean over a turn is short, the readings lag behind in an unknown way: that is noise, too.
    """
    age(s, t_ns)
    pace = walked[0] ** 2 + walked[1] ** 2
    more = 1.0
    if s.velocity_ns != 0:
        more = max(1.0, VELOCITY_TAU_S / max((t_ns - s.velocity_ns) * 1e-9, 0.1))
    s.velocity_ns = t_ns
    total = 0.0
    for h in range(s.hyp):
        k = math.exp(s.hx[h, 3])
        c, w = k * math.cos(s.hx[h, 2]), k * math.sin(s.hx[h, 2])
        e, n = c * walked[0] - w * walked[1], w * walked[0] + c * walked[1]
        noise = more * sd * sd + k * k * max(walked[2] - pace, 0.0)
        noise += 0.5 * k * k * pace * max(s.q_length**2, s.q_heading**2)
        # H has (−n, e) for the heading and (e, n) for the scale.
        tt, ts, ss = s.hP[h, 2, 2], s.hP[h, 2, 3], s.hP[h, 3, 3]
        a = n * n * tt - 2.0 * n * e * ts + e * e * ss + noise
        b = -n * e * tt + (e * e - n * n) * ts + e * n * ss
        d = e * e * tt + 2.0 * e * n * ts + n * n * ss + noise
        share = _weigh(s, h, east - e, north - n, a, b, d, VELOCITY_OUTLIER**2)
        total += s.hw[h]
        for i in range(N):
            turn, scale = s.hP[h, i, 2], s.hP[h, i, 3]
            s.work[0, i], s.work[1, i] = -n * turn + e * scale, e * turn + n * scale
        _correct(s, h, east - e, north - n, a, b, d, share)
    _judge(s, total)


@compiled
def _judge(s: Any, total: float) -> None:
    """Let the weights, whose sum is ``total``, add up to one, and drop what does not count."""
    for h in range(s.hyp):
        s.hw[h] = s.hw[h] / total if total > 0.0 else 1.0 / s.hyp
    _prune(s)
    summarize(s)


@compiled
def _innovation(s: Any, h: int, white: float) -> tuple[float, float, float]:
    a = s.hP[h, 0, 0] + 2.0 * s.hP[h, 0, 4] + s.hP[h, 4, 4] + white
    b = s.hP[h, 0, 1] + s.hP[h, 0, 5] + s.hP[h, 4, 1] + s.hP[h, 4, 5]
    c = s.hP[h, 1, 1] + 2.0 * s.hP[h, 1, 5] + s.hP[h, 5, 5] + white
    return a, b, c


@compiled
def _place_gain(s: Any, h: int) -> None:
    """Write P Hᵀ of a fix into ``work``: place and slow error add up to it."""
    for i in range(N):
        s.work[0, i], s.work[1, i] = s.hP[h, i, 0] + s.hP[h, i, 4], s.hP[h, i, 1] + s.hP[h, i, 5]


@inlined
def _density(x: float, y: float, a: float, b: float, c: float) -> float:
    det = a * c - b * b
    m = (c * x * x - 2.0 * b * x * y + a * y * y) / det
    return math.exp(-0.5 * m) / (2.0 * math.pi * math.sqrt(det))


@compiled
def _weigh(s: Any, h: int, x: float, y: float, a: float, b: float, c: float, more: float) -> float:
    """Weigh a hypothesis by a residual (x, y) of covariance (a, b; b, c); return the inlier's share.

    An outlier's residual has ``more`` variance an axis.
    """
    p_in = (1.0 - s.outlier) * _density(x, y, a, b, c)
    p_out = s.outlier * (_density(x, y, a + more, b, c + more) + 1e-30)
    s.hw[h] *= p_in + p_out
    return p_in / (p_in + p_out)


@compiled
def _correct(s: Any, h: int, x: float, y: float, a: float, b: float, c: float, share: float) -> None:
    """Kalman update by the inlier's share β: x + β K ν, P − β K S Kᵀ + β (1 − β) K ν νᵀ Kᵀ.

    ν = (x, y), S = (a, b; b, c), and ``work`` holds P Hᵀ by columns.
    """
    det = a * c - b * b
    for i in range(N):
        u, v = s.work[0, i], s.work[1, i]
        s.work[0, i], s.work[1, i] = (u * c - v * b) / det, (v * a - u * b) / det
    for i in range(N):
        s.hx[h, i] += share * (s.work[0, i] * x + s.work[1, i] * y)
    for i in range(N):
        ki, li = s.work[0, i], s.work[1, i]
        for j in range(i, N):
            kj, lj = s.work[0, j], s.work[1, j]
            taken = ki * (a * kj + b * lj) + li * (b * kj + c * lj)
            spread = (ki * x + li * y) * (kj * x + lj * y)
            s.hP[h, i, j] += share * ((1.0 - share) * spread - taken)
            s.hP[h, j, i] = s.hP[h, i, j]
    s.hx[h, 2] = wrap(s.hx[h, 2])
    s.hx[h, 3] = min(max(s.hx[h, 3], -0.7), 0.7)


@compiled
def _prune(s: Any) -> None:
    """Drop hypotheses below 1e-5, and the lighter of two that have become the same."""
    kept = 0
    for h in range(s.hyp):
        keep = s.hw[h] > 1e-5
        for g in range(kept):
            if keep:
                d = wrap(s.hx[h, 2] - s.hx[g, 2])
                if d * d < 0.05 * s.hP[g, 2, 2] and abs(s.hx[h, 0] - s.hx[g, 0]) + abs(
                    s.hx[h, 1] - s.hx[g, 1]
                ) < 0.2 * math.sqrt(s.hP[g, 0, 0] + s.hP[g, 1, 1]):
                    if s.hw[h] > s.hw[g]:
                        weight = s.hw[g] + s.hw[h]
                        _copy(s, h, g)
                        s.hw[g] = weight
                    else:
                        s.hw[g] += s.hw[h]
                    keep = False
        if keep:
            if kept != h:
                _copy(s, h, kept)
            kept += 1
    s.hyp = max(kept, 1)
    if s.hyp < HYPOTHESES:
        s.ringed = 0
    total = 0.0
    for h in range(s.hyp):
        total += s.hw[h]
    for h in range(s.hyp):
        s.hw[h] /= total


@inlined
def _copy(s: Any, a: int, b: int) -> None:
    s.hw[b] = s.hw[a]
    for i in range(N):
        s.hx[b, i] = s.hx[a, i]
        for j in range(N):
            s.hP[b, i, j] = s.hP[a, i, j]


@compiled
def summarize(s: Any) -> None:
    """Write mean and covariance of the mixture."""
    x, y, c, w, k = 0.0, 0.0, 0.0, 0.0, 0.0
    for h in range(s.hyp):
        x += s.hw[h] * s.hx[h, 0]
        y += s.hw[h] * s.hx[h, 1]
        c += s.hw[h] * math.cos(s.hx[h, 2])
        w += s.hw[h] * math.sin(s.hx[h, 2])
        k += s.hw[h] * s.hx[h, 3]
    turn = math.atan2(w, c)
    xx, xy, yy, tt = 0.0, 0.0, 0.0, 0.0
    for h in range(s.hyp):
        dx, dy, dt = s.hx[h, 0] - x, s.hx[h, 1] - y, wrap(s.hx[h, 2] - turn)
        xx += s.hw[h] * (s.hP[h, 0, 0] + dx * dx)
        xy += s.hw[h] * (s.hP[h, 0, 1] + dx * dy)
        yy += s.hw[h] * (s.hP[h, 1, 1] + dy * dy)
        tt += s.hw[h] * (s.hP[h, 2, 2] + dt * dt)
    s.mean[0], s.mean[1], s.mean[2], s.mean[3] = x, y, turn, k
    s.cov[0], s.cov[1], s.cov[2], s.cov[3] = xx, xy, yy, tt
