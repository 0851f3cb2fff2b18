"""The particle filter behind ``indoor.fused``: each power as it comes, steps, walls, floors; one compiled kernel.

What a particle is: :mod:`.cloud`. Shadowing is forgotten with the distance walked (Gauss–Markov, Gudmundson 1991),
fast fading is Student's t (robust to blocked paths). A carrier that turns hears anchors ahead stronger than behind, dB
by the cosine of the direction; whether it turns is a hypothesis of each particle, which the powers decide. Floors are
changed by a jump process: powers (each slab costs some dB) and the barometer say when.
"""

from __future__ import annotations

import math
from typing import Any

from ..numerics.compiled import compiled
from .cloud import (
    A_ETA,
    A_FLOOR,
    A_LENGTH,
    A_MAPPED,
    A_POWER,
    A_SHADOW,
    A_UP,
    A_X,
    A_Y,
    AHEAD_X,
    AHEAD_Y,
    C_POWER_ETA,
    C_SHADOW_ETA,
    C_SHADOW_POWER,
    D_ETA,
    D_POWER,
    FLOOR,
    GAIN,
    LOGW,
    OFFSET,
    PATH,
    PATH_AT,
    PATTERN,
    RATE,
    SCALE,
    SHADOW,
    SHADOW_VARIANCE,
    SHOWN,
    SHOWN_NS,
    V_ETA,
    V_POWER,
    V_XX,
    V_XY,
    V_YY,
    V_ZERO,
    VX,
    VY,
    WIDTH,
    ZERO,
    X,
    Y,
    cell_of,
    draw_turning,
    mean_of,
    normal,
    resample,
    show,
    uniform,
)
from .floorplan import CLOSED, STAIRS
from .floors import SCALE_M
from .steps import take_acceleration

QUIET_NS = 50_000_000
"""A position is stated this long after the last one also where no power and no step came."""
STEADY_S = 30.0
"""Time over which a steady turn keeps its side and amplitude."""
DOUBT_S = 30.0
"""Mean time after which a particle draws anew whether its carrier turns."""
ELSEWHERE = 0.02
"""How much rarer floors are changed away from stairs, where the plan says where they are."""
NEW_FLOOR_M = 100.0
"""Distance after which the shadowing of another floor is forgotten."""
PRESSURE_S, WEATHER_M2_S, PRESSURE_SD_M = 1.0, 1e-3, 0.7
"""The barometer: time constant and time between two readings that count (s); variance that its zero gains by weather
(m²/s: 1.9 m in an hour); standard deviation of a height (m), between two floors on the stairs too."""


@compiled
def _blocked(c: Any, floor: int, x0: float, y0: float, x1: float, y1: float) -> bool:
    """Return whether a straight move leaves the open cells; one that starts in a closed cell is free."""
    s = c.s[0]
    if s.cell <= 0.0:
        return False
    n = int(max(abs(x1 - x0), abs(y1 - y0)) / (0.7 * s.cell)) + 1
    for k in range(n + 1):
        closed = cell_of(c, floor, x0 + (x1 - x0) * k / n, y0 + (y1 - y0) * k / n) == CLOSED
        if k == 0 and closed:
            return False
        if closed:
            return True
    return False


@compiled
def _shift(c: Any, i: int, dx: float, dy: float) -> None:
    """Move a particle; through a wall it goes on with little weight, at the rectangle's edge it turns back."""
    s = c.s[0]
    p = c.p[i]
    if _blocked(c, int(p[FLOOR]), p[X], p[Y], p[X] + dx, p[Y] + dy):
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
def _turn(c: Any, i: int, dt: float, likes: float, steady: float) -> None:
    """Let the side on which a carrier hears stronger turn; the share ``likes`` or ``steady`` of it is not forgotten."""
    s = c.s[0]
    p = c.p[i]
    if uniform(s) < dt / DOUBT_S:
        draw_turning(c, i)
    if p[PATTERN] <= 0.0:
        return
    keep = likes if p[RATE] == 0.0 else steady
    x, y, xx, xy, yy = p[AHEAD_X], p[AHEAD_Y], p[V_XX], p[V_XY], p[V_YY]
    if p[RATE] != 0.0:
        p[RATE] += 0.02 * math.sqrt(dt) * normal(s)
        cos, sin = math.cos(p[RATE] * dt), math.sin(p[RATE] * dt)
        x, y = cos * x - sin * y, sin * x + cos * y
        twist = 2.0 * cos * sin * xy
        xx, yy, xy = (
            cos * cos * xx - twist + sin * sin * yy,
            sin * sin * xx + twist + cos * cos * yy,
            cos * sin * (xx - yy) + (cos * cos - sin * sin) * xy,
        )
    new = (1.0 - keep * keep) * p[PATTERN] * p[PATTERN]
    p[AHEAD_X], p[AHEAD_Y] = keep * x, keep * y
    p[V_XX], p[V_XY], p[V_YY] = keep * keep * xx + new, keep * keep * xy, keep * keep * yy + new


@compiled
def _climb(c: Any, i: int, dt: float) -> None:
    """Let a particle change its floor: anywhere, or where the plan has stairs."""
    s = c.s[0]
    p = c.p[i]
    rate = s.change_hz
    if s.stairs == 1:
        rate *= 1.0 if cell_of(c, int(p[FLOOR]), p[X], p[Y]) == STAIRS else ELSEWHERE
    if uniform(s) >= rate * dt:
        return
    to = int(p[FLOOR]) + (1 if uniform(s) < 0.5 else -1)
    if 0 <= to < c.levels.size and (s.cell <= 0.0 or cell_of(c, to, p[X], p[Y]) != CLOSED):
        p[FLOOR] = to
        p[PATH] += NEW_FLOOR_M


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
    gain = 0.005 * math.sqrt(dt)
    likes, steady = math.exp(-dt / s.pattern_s), math.exp(-dt / STEADY_S)
    for i in range(c.p.shape[0]):
        p = c.p[i]
        if p[GAIN] != 0.0:
            p[GAIN] += gain * normal(s)
        if s.turning > 0.0:
            _turn(c, i, dt, likes, steady)
        if c.levels.size > 1:
            _climb(c, i, dt)
        if s.walking == 1:
            # not part of PATH: the length of a random walk depends on how finely it is cut, and a person who
            # stands keeps the same shadowing
            _shift(c, i, walk * normal(s), walk * normal(s))
        else:
            p[VX] = keep * p[VX] + draw * normal(s)
            p[VY] = keep * p[VY] + draw * normal(s)
            _shift(c, i, p[VX] * dt, p[VY] * dt)
            p[PATH] += math.hypot(p[VX], p[VY]) * dt


@compiled
def _step(c: Any, length: float, heading: float) -> None:
    """Take a step."""
    s = c.s[0]
    s.steps += 1
    for i in range(c.p.shape[0]):
        p = c.p[i]
        p[OFFSET] += s.turn_walk * normal(s)
        reach = length * p[SCALE] * (1.0 + s.step_sd * normal(s))
        angle = heading + p[OFFSET] + s.turn_sd * normal(s)
        _shift(c, i, reach * math.cos(angle), reach * math.sin(angle))
        p[PATH] += abs(reach)


@compiled
def _power(c: Any, k: int, rssi: float) -> None:
    """Weigh the particles by a power of anchor ``k``, and update its slow errors in each."""
    s = c.s[0]
    s.received += 1
    fast2 = s.fast * s.fast
    mapped = c.a[k, A_MAPPED] > 0.0
    own = int(c.a[k, A_FLOOR])
    for i in range(c.p.shape[0]):
        p = c.p[i]
        b = c.b[i, k]
        floor = int(p[FLOOR])
        slabs = abs(floor - own)
        slow2 = c.a[k, A_SHADOW] ** 2
        log10d = 0.0
        if mapped:
            fx = (p[X] - s.map_low[0]) / s.map_cell
            fy = (p[Y] - s.map_low[1]) / s.map_cell
            m = min(max(int(fx), 0), c.mean.shape[2] - 2)
            n = min(max(int(fy), 0), c.mean.shape[3] - 2)
            fx = min(max(fx - m, 0.0), 1.0)
            fy = min(max(fy - n, 0.0), 1.0)
            expected = (1.0 - fx) * (
                (1.0 - fy) * c.mean[floor, k, m, n] + fy * c.mean[floor, k, m, n + 1]
            ) + fx * ((1.0 - fy) * c.mean[floor, k, m + 1, n] + fy * c.mean[floor, k, m + 1, n + 1])
            slow2 = c.sd[floor, k, m, n] ** 2
        else:
            dx, dy = p[X] - c.a[k, A_X], p[Y] - c.a[k, A_Y]
            dz = c.a[k, A_UP] + c.levels[own] - c.levels[floor]
            log10d = 0.5 * math.log10(max(dx * dx + dy * dy + dz * dz, 0.09))
            expected = c.a[k, A_POWER] - 10.0 * c.a[k, A_ETA] * log10d
            if slabs > 0:
                expected -= s.slab + s.further * (slabs - 1)
                slow2 += s.slab_sd * s.slab_sd
        keep = math.exp(-(p[PATH] - b[PATH_AT]) / c.a[k, A_LENGTH])
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
        pattern, ph_x, ph_y = 0.0, 0.0, 0.0
        if p[PATTERN] > 0.0:
            ux, uy = c.a[k, A_X] - p[X], c.a[k, A_Y] - p[Y]
            far = max(math.sqrt(ux * ux + uy * uy), 0.3)
            ux, uy = ux / far, uy / far
            expected += p[AHEAD_X] * ux + p[AHEAD_Y] * uy
            ph_x, ph_y = p[V_XX] * ux + p[V_XY] * uy, p[V_XY] * ux + p[V_YY] * uy
            pattern = ux * ph_x + uy * ph_y
        variance = slow + pattern + fast2
        e = rssi - expected - p[GAIN] - b[SHADOW] - b[D_POWER] - h * b[D_ETA]
        nu = s.freedom
        p[LOGW] -= 0.5 * math.log(variance) + 0.5 * (nu + 1.0) * math.log(1.0 + e * e / (nu * variance))
        trust = min((nu + 1.0) / (nu + e * e / variance), 1.0)
        gain = 1.0 / (slow + pattern + fast2 / trust)
        if p[PATTERN] > 0.0:
            # what shadowing and pattern then share is left out: the pattern turns, the shadowing stays
            p[AHEAD_X] += gain * ph_x * e
            p[AHEAD_Y] += gain * ph_y * e
            p[V_XX] -= gain * ph_x * ph_x
            p[V_XY] -= gain * ph_x * ph_y
            p[V_YY] -= gain * ph_y * ph_y
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
        dx, dy = p[X] - c.a[k, A_X], p[Y] - c.a[k, A_Y]
        dz = c.a[k, A_UP] + c.levels[int(c.a[k, A_FLOOR])] - c.levels[int(p[FLOOR])]
        e = (distance - math.sqrt(dx * dx + dy * dy + dz * dz)) / s.range_sd
        p[LOGW] -= 0.5 * (s.freedom + 1.0) * math.log(1.0 + e * e / s.freedom)


@compiled
def _pressure(c: Any, t_ns: int, pressure_pa: float) -> bool:
    """Weigh the particles by the barometer's height, once in a while; return whether that was done."""
    s = c.s[0]
    now = math.log(pressure_pa)
    if s.pressure_ns < 0:
        s.log_p = s.log_p0 = now
        s.pressure_ns = s.weighed_ns = t_ns
    dt = max((t_ns - s.pressure_ns) * 1e-9, 0.0)
    s.pressure_ns = t_ns
    s.log_p += (1.0 - math.exp(-dt / PRESSURE_S)) * (now - s.log_p)
    since = (t_ns - s.weighed_ns) * 1e-9
    if 0.0 < since < PRESSURE_S:
        return False
    s.weighed_ns = t_ns
    height = SCALE_M * (s.log_p0 - s.log_p)
    r = PRESSURE_SD_M * PRESSURE_SD_M
    for i in range(c.p.shape[0]):
        p = c.p[i]
        p[V_ZERO] += WEATHER_M2_S * since
        e = height - c.levels[int(p[FLOOR])] - p[ZERO]
        variance = p[V_ZERO] + r
        nu = s.freedom
        p[LOGW] -= 0.5 * math.log(variance) + 0.5 * (nu + 1.0) * math.log(1.0 + e * e / (nu * variance))
        trust = min((nu + 1.0) / (nu + e * e / variance), 1.0)
        gain = p[V_ZERO] / (p[V_ZERO] + r / trust)
        p[ZERO] += gain * e
        p[V_ZERO] *= 1.0 - gain
    return True


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
    """Take messages: 0 powers, 1 ranges, 2 steps, 3 accelerations, 4 orientations, 5 pressures."""
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
        elif kind == 5:
            if c.levels.size > 1 and math.isfinite(values[m, 0]) and values[m, 0] > 0.0:
                _drift(c, t_ns[m])
                answered = _pressure(c, t_ns[m], values[m, 0]) and s.received + s.known_start > 0
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
            if mean_of(c, out) < 0.5 * c.p.shape[0]:
                resample(c)
            out_message[count] = m
            out_t_ns[count] = t_ns[m]
            count += 1
            if out_values.shape[1] == WIDTH and t_ns[m] - s.shown_ns >= SHOWN_NS:
                s.shown_ns = t_ns[m]
                show(c, out_values, count)
                for _ in range(SHOWN):
                    out_message[count] = m
                    out_t_ns[count] = t_ns[m]
                    count += 1
    return count
