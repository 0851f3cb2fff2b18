"""The particle filter behind ``indoor.fused``: each power as it comes, steps, walls; one compiled kernel.

A particle is a position, a velocity, an offset of the heading, a scale of the step and an offset of the receiver.
Given its path the slow errors of the powers are linear and Gaussian, so that each particle carries one Kalman filter an
anchor of three states: shadowing that is forgotten with the distance walked (Gauss–Markov, Gudmundson 1991), and what
the anchor's P_d0 and η differ from their expected values, which stay (Rao–Blackwellised particle filter, Doucet et al.
2000). Fast fading is Student's t (robust to blocked paths).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..contract import FloatArray
from ..numerics.compiled import compiled, inlined
from .steps import take_acceleration

X, Y, VX, VY, OFFSET, SCALE, GAIN, PATH, LOGW, AHEAD_X, AHEAD_Y, COLUMNS = range(12)
"""Columns of a particle; PATH is the distance that it has walked (m), GAIN the receiver's offset (dB), AHEAD how
much stronger it hears anchors along x and y (dB): antenna and body, which turn."""

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
UNHEARD_M = -1e9
"""Distance walked at the last power where there was none: all of the shadowing is forgotten by then."""

SHOWN, SHOWN_NS = 60, 1_000_000_000
"""So many particles, drawn by their weights, are handed out each so often: to be seen."""
WIDTH = 8
"""Columns of a result: position, three sigmas, and the place of one particle."""
QUIET_NS = 50_000_000
"""A position is stated this long after the last one also where no power and no step came."""

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
        ("cell", "f8"),  # of the raster of open cells, 0 without one
        ("map_low", "f8", 2),
        ("map_cell", "f8"),
        ("speed", "f8"),
        ("speed_s", "f8"),
        ("drift", "f8"),  # random walk while steps are known, m/√s
        ("fast", "f8"),
        ("freedom", "f8"),
        ("pattern", "f8"),  # dB by direction, and the time (s) over which it stays
        ("pattern_s", "f8"),
        ("range_sd", "f8"),
        ("wall", "f8"),  # log-likelihood of a move through a wall
        ("step_m", "f8"),
        ("step_sd", "f8"),
        ("turn_sd", "f8"),
        ("turn_walk", "f8"),
        ("height", "f8"),
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
    a : ndarray (anchors, 11)
        x, y, height above the receiver, P_d0, η, standard deviation (dB) and length (m) of the shadowing, variances
        of P_d0 and η and their covariance, 1 where the radio map has the anchor.
    mean, sd : ndarray (anchors or 0, nx, ny)
        Radio map.
    open : uint8 ndarray (nx, ny)
        Cells that can be walked.
    """

    s: NDArray[Any]
    walk: NDArray[Any]
    p: FloatArray
    p2: FloatArray
    b: FloatArray
    b2: FloatArray
    a: FloatArray
    mean: FloatArray
    sd: FloatArray
    open: NDArray[np.uint8]


@inlined
def _uniform(s: Any) -> float:
    """Return a number in (0, 1): xorshift64*, Vigna 2016."""
    z = s.rng
    z ^= z >> np.uint64(12)
    z ^= z << np.uint64(25)
    z ^= z >> np.uint64(27)
    s.rng = z
    return (float((z * np.uint64(2685821657736338717)) >> np.uint64(11)) + 0.5) * (1.0 / 9007199254740992.0)


@compiled
def _normal(s: Any) -> float:
    """Return a standard normal number (Box and Muller 1958)."""
    if not math.isnan(s.spare):
        second = s.spare
        s.spare = math.nan
        return second
    radius = math.sqrt(-2.0 * math.log(_uniform(s)))
    angle = 2.0 * math.pi * _uniform(s)
    s.spare = radius * math.sin(angle)
    return radius * math.cos(angle)


@compiled
def _blocked(c: Any, x0: float, y0: float, x1: float, y1: float) -> bool:
    """Return whether a straight move leaves the open cells; one that starts in a closed cell is free."""
    s = c.s[0]
    if s.cell <= 0.0:
        return False
    nx, ny = c.open.shape
    n = int(max(abs(x1 - x0), abs(y1 - y0)) / (0.7 * s.cell)) + 1
    for k in range(n + 1):
        i = math.floor((x0 + (x1 - x0) * k / n - s.low[0]) / s.cell)
        j = math.floor((y0 + (y1 - y0) * k / n - s.low[1]) / s.cell)
        closed = i < 0 or j < 0 or i >= nx or j >= ny or c.open[i, j] == 0
        if k == 0 and closed:
            return False
        if closed:
            return True
    return False


@compiled
def scatter(c: Any, x: float, y: float, sd: float, offset_sd: float, scale_sd: float, gain_sd: float) -> None:
    """Draw the particles: about (x, y), or over the open rectangle where x is NaN."""
    s = c.s[0]
    for i in range(c.p.shape[0]):
        p = c.p[i]
        for _ in range(200):
            if math.isnan(x):
                p[X] = s.low[0] + (s.high[0] - s.low[0]) * _uniform(s)
                p[Y] = s.low[1] + (s.high[1] - s.low[1]) * _uniform(s)
            else:
                p[X] = x + sd * _normal(s)
                p[Y] = y + sd * _normal(s)
            if s.cell <= 0.0:
                break
            k = math.floor((p[X] - s.low[0]) / s.cell)
            j = math.floor((p[Y] - s.low[1]) / s.cell)
            if 0 <= k < c.open.shape[0] and 0 <= j < c.open.shape[1] and c.open[k, j] == 1:
                break
        p[VX] = s.speed * _normal(s)
        p[VY] = s.speed * _normal(s)
        p[OFFSET] = offset_sd * _normal(s) if offset_sd < 3.0 else 2.0 * math.pi * _uniform(s)
        p[SCALE] = 1.0 + scale_sd * _normal(s)
        p[GAIN] = gain_sd * _normal(s)
        p[PATH] = 0.0
        p[LOGW] = 0.0
        p[AHEAD_X] = s.pattern * _normal(s) if s.pattern > 0.0 else 0.0
        p[AHEAD_Y] = s.pattern * _normal(s) if s.pattern > 0.0 else 0.0
        for k in range(c.a.shape[0]):
            b = c.b[i, k]
            b[:] = 0.0
            b[PATH_AT] = UNHEARD_M
            b[V_POWER], b[V_ETA], b[C_POWER_ETA] = c.a[k, 7], c.a[k, 8], c.a[k, 9]


@compiled
def _shift(c: Any, i: int, dx: float, dy: float) -> None:
    """Move a particle; through a wall it goes on with little weight, at the rectangle's edge it turns back."""
    s = c.s[0]
    p = c.p[i]
    if _blocked(c, p[X], p[Y], p[X] + dx, p[Y] + dy):
        p[LOGW] += s.wall
    p[X] += dx
    p[Y] += dy
    for k in range(2):
        if p[k] < s.low[k]:
            p[k] = min(2.0 * s.low[k] - p[k], s.high[k])
            p[VX + k] = -p[VX + k]
        elif p[k] > s.high[k]:
            p[k] = max(2.0 * s.high[k] - p[k], s.low[k])
            p[VX + k] = -p[VX + k]


@compiled
def _drift(c: Any, t_ns: int) -> None:
    """Let time pass: velocities that forget themselves, or a slow drift where steps say how one moves."""
    s = c.s[0]
    if s.t_ns < 0:
        s.t_ns = t_ns
    dt = (t_ns - s.t_ns) * 1e-9
    if dt < 0.05:
        return
    s.t_ns = t_ns
    keep = math.exp(-dt / s.speed_s)
    draw = s.speed * math.sqrt(1.0 - keep * keep)
    walk = s.drift * math.sqrt(dt)
    gain = 0.05 * math.sqrt(dt)
    stays = math.exp(-dt / s.pattern_s)
    turn = s.pattern * math.sqrt(1.0 - stays * stays)
    for i in range(c.p.shape[0]):
        p = c.p[i]
        p[GAIN] += gain * 0.1 * _normal(s) if p[GAIN] != 0.0 else 0.0
        if s.pattern > 0.0:
            p[AHEAD_X] = stays * p[AHEAD_X] + turn * _normal(s)
            p[AHEAD_Y] = stays * p[AHEAD_Y] + turn * _normal(s)
        if s.walking == 1:
            # not part of PATH: the length of a random walk depends on how finely it is cut, and a person who
            # stands keeps the same shadowing
            _shift(c, i, walk * _normal(s), walk * _normal(s))
        else:
            p[VX] = keep * p[VX] + draw * _normal(s)
            p[VY] = keep * p[VY] + draw * _normal(s)
            _shift(c, i, p[VX] * dt, p[VY] * dt)
            p[PATH] += math.hypot(p[VX], p[VY]) * dt


@compiled
def _step(c: Any, length: float, heading: float) -> None:
    """Take a step."""
    s = c.s[0]
    s.steps += 1
    for i in range(c.p.shape[0]):
        p = c.p[i]
        p[OFFSET] += s.turn_walk * _normal(s)
        reach = length * p[SCALE] * (1.0 + s.step_sd * _normal(s))
        angle = heading + p[OFFSET] + s.turn_sd * _normal(s)
        _shift(c, i, reach * math.cos(angle), reach * math.sin(angle))
        p[PATH] += abs(reach)


@compiled
def _power(c: Any, k: int, rssi: float) -> None:
    """Weigh the particles by a power of anchor ``k``, and update its slow errors in each."""
    s = c.s[0]
    s.received += 1
    fast2 = s.fast * s.fast
    mapped = c.a[k, 10] > 0.0
    for i in range(c.p.shape[0]):
        p = c.p[i]
        b = c.b[i, k]
        slow2 = c.a[k, 5] ** 2
        log10d = 0.0
        if mapped:
            fx = (p[X] - s.map_low[0]) / s.map_cell
            fy = (p[Y] - s.map_low[1]) / s.map_cell
            m = min(max(int(fx), 0), c.mean.shape[1] - 2)
            n = min(max(int(fy), 0), c.mean.shape[2] - 2)
            fx = min(max(fx - m, 0.0), 1.0)
            fy = min(max(fy - n, 0.0), 1.0)
            expected = (1.0 - fx) * ((1.0 - fy) * c.mean[k, m, n] + fy * c.mean[k, m, n + 1]) + fx * (
                (1.0 - fy) * c.mean[k, m + 1, n] + fy * c.mean[k, m + 1, n + 1]
            )
            slow2 = c.sd[k, m, n] ** 2
        else:
            dx, dy, dz = p[X] - c.a[k, 0], p[Y] - c.a[k, 1], c.a[k, 2]
            log10d = 0.5 * math.log10(max(dx * dx + dy * dy + dz * dz, 0.09))
            expected = c.a[k, 3] - 10.0 * c.a[k, 4] * log10d
        keep = math.exp(-(p[PATH] - b[PATH_AT]) / c.a[k, 6])
        b[PATH_AT] = p[PATH]
        b[SHADOW] *= keep
        b[SHADOW_VARIANCE] = keep * keep * b[SHADOW_VARIANCE] + (1.0 - keep * keep) * slow2
        b[C_SHADOW_POWER] *= keep
        b[C_SHADOW_ETA] *= keep
        # the power's own row: 1 of the shadowing, 1 of P_d0, h of η
        h = -10.0 * log10d
        ph_shadow = b[SHADOW_VARIANCE] + b[C_SHADOW_POWER] + h * b[C_SHADOW_ETA]
        ph_power = b[C_SHADOW_POWER] + b[V_POWER] + h * b[C_POWER_ETA]
        ph_eta = b[C_SHADOW_ETA] + b[C_POWER_ETA] + h * b[V_ETA]
        slow = ph_shadow + ph_power + h * ph_eta
        variance = slow + fast2
        if s.pattern > 0.0:
            ax, ay = c.a[k, 0] - p[X], c.a[k, 1] - p[Y]
            expected += (p[AHEAD_X] * ax + p[AHEAD_Y] * ay) / max(math.sqrt(ax * ax + ay * ay), 0.3)
        e = rssi - expected - p[GAIN] - b[SHADOW] - b[D_POWER] - h * b[D_ETA]
        nu = s.freedom
        p[LOGW] -= 0.5 * math.log(variance) + 0.5 * (nu + 1.0) * math.log(1.0 + e * e / (nu * variance))
        trust = min((nu + 1.0) / (nu + e * e / variance), 1.0)
        gain = 1.0 / (slow + fast2 / trust)
        b[SHADOW] += gain * ph_shadow * e
        b[D_POWER] += gain * ph_power * e
        b[D_ETA] += gain * ph_eta * e
        b[SHADOW_VARIANCE] -= gain * ph_shadow * ph_shadow
        b[V_POWER] -= gain * ph_power * ph_power
        b[V_ETA] -= gain * ph_eta * ph_eta
        b[C_SHADOW_POWER] -= gain * ph_shadow * ph_power
        b[C_SHADOW_ETA] -= gain * ph_shadow * ph_eta
        b[C_POWER_ETA] -= gain * ph_power * ph_eta


@compiled
def _range(c: Any, k: int, distance: float) -> None:
    """Weigh the particles by a range to anchor ``k``."""
    s = c.s[0]
    s.received += 1
    for i in range(c.p.shape[0]):
        p = c.p[i]
        dx, dy, dz = p[X] - c.a[k, 0], p[Y] - c.a[k, 1], c.a[k, 2]
        e = (distance - math.sqrt(dx * dx + dy * dy + dz * dz)) / s.range_sd
        p[LOGW] -= 0.5 * (s.freedom + 1.0) * math.log(1.0 + e * e / s.freedom)


@compiled
def _mean(c: Any, out: FloatArray) -> float:
    """Fill ``out`` with x, y, height, three sigmas; make the weights' maximum 0; return their effective number."""
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
    out[0], out[1], out[2] = x, y, c.s[0].height
    out[3], out[4] = math.sqrt(xx / total), math.sqrt(yy / total)
    return total * total / square


@compiled
def _resample(c: Any) -> None:
    """Systematic resampling (Kitagawa 1996)."""
    s = c.s[0]
    s.resampled += 1
    n, anchors = c.p.shape[0], c.a.shape[0]
    total = 0.0
    for i in range(n):
        total += math.exp(c.p[i, LOGW])
    u = _uniform(s) / n
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
def _show(c: Any, out_values: FloatArray, count: int) -> None:
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
        out[6], out[7] = c.p[j, X], c.p[j, Y]


@compiled
def _heading(c: Any, azimuth: float) -> float:
    s = c.s[0]
    return azimuth - s.x_axis if s.mirrored == 1 else s.x_axis - azimuth


@compiled
def run(
    c: Any,
    inputs: Any,
    channels: Any,
    t_ns: Any,
    values: Any,
    out_message: Any,
    out_t_ns: Any,
    out_values: Any,
) -> int:
    """Take messages: 0 powers, 1 ranges, 2 steps, 3 accelerations, 4 orientations."""
    s = c.s[0]
    walk = c.walk[0]
    count = 0
    for m in range(inputs.size):
        kind = inputs[m]
        answered = False
        if kind <= 1:
            anchor = int(values[m, 0])
            value = values[m, 1]
            _drift(c, t_ns[m])
            if anchor >= 0 and math.isfinite(value):
                if kind == 0 and value < 0.0:
                    _power(c, anchor, value)
                    answered = True
                elif kind == 1 and value >= 0.0:
                    _range(c, anchor, value)
                    answered = True
        elif kind == 2:
            _drift(c, t_ns[m])
            if math.isfinite(values[m, 0]) and math.isfinite(values[m, 1]):
                _step(c, values[m, 0], values[m, 1])
                answered = True
        elif kind == 3:
            if (
                s.own_steps == 1
                and take_acceleration(walk, t_ns[m], values[m, 0], values[m, 1], values[m, 2])
                and not math.isnan(walk.azimuth)
            ):
                _drift(c, t_ns[m])
                _step(c, s.step_m, _heading(c, walk.azimuth))
                answered = True
        else:
            qw, qx, qy, qz = values[m, 0], values[m, 1], values[m, 2], values[m, 3]
            walk.azimuth = math.atan2(2.0 * (qx * qy - qw * qz), 1.0 - 2.0 * (qx * qx + qz * qz))
        if not answered and s.received + s.steps + s.known_start > 0 and t_ns[m] - s.told_ns >= QUIET_NS:
            _drift(c, t_ns[m])  # nothing was heard for a while: where it may be by now
            answered = True
        if answered:
            s.told_ns = t_ns[m]
            out = out_values[count]
            for k in range(out.size):
                out[k] = math.nan
            if _mean(c, out) < 0.5 * c.p.shape[0]:
                _resample(c)
            out_message[count] = m
            out_t_ns[count] = t_ns[m]
            count += 1
            if out_values.shape[1] == WIDTH and t_ns[m] - s.shown_ns >= SHOWN_NS:
                s.shown_ns = t_ns[m]
                _show(c, out_values, count)
                for _ in range(SHOWN):
                    out_message[count] = m
                    out_t_ns[count] = t_ns[m]
                    count += 1
    return count
