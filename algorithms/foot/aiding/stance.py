"""The aids over a stance: collect readings, compare with the first stance, measure."""

from __future__ import annotations

import math
from typing import Any

from ...numerics import kalman
from ...numerics.compiled import compiled
from .record import NO_HEADING
from .straight import measure_heading, wrap

LAPSE_K_M = 0.0065
BARO_EXPONENT = 8.314462618 * LAPSE_K_M / (9.80665 * 0.0289644)


@compiled
def pressure_height(pressure: float, reference: float, scale: float) -> float:
    """Return the height (m) over the place where the pressure is ``reference``; ``scale`` = T/Λ in m."""
    return scale * (1.0 - (pressure / reference) ** BARO_EXPONENT)


@compiled
def _collect(s: Any, r: Any) -> None:
    """Add the readings that arrived with the sample ``r``: field (in n once started) and pressure."""
    m, b = s.aids.magnetometer, s.aids.barometer
    if m.on:
        x, y, z = r.extra[0], r.extra[1], r.extra[2]
        if math.isfinite(x + y + z):
            m.seen += 1
            m.count += 1
            if s.aids.begun:
                for i in range(3):
                    m.total[i] += s.rot[i, 0] * x + s.rot[i, 1] * y + s.rot[i, 2] * z
            else:
                m.total[0] += x
                m.total[1] += y
                m.total[2] += z
    if b.on:
        pressure = r.extra[b.column]
        if math.isfinite(pressure) and pressure > 0.0:
            b.seen += 1
            b.count += 1
            b.total += pressure


@compiled
def _forget_field(m: Any) -> None:
    kalman.clear(m.total)
    m.count = 0


@compiled
def _forget_pressure(b: Any) -> None:
    b.total = 0.0
    b.count = 0


@compiled
def _begin(s: Any) -> None:
    """Turn the field collected in the rest into n; the start is the first stance and the first level."""
    a = s.aids
    m = a.magnetometer
    x, y, z = m.total[0], m.total[1], m.total[2]
    for i in range(3):
        m.total[i] = s.rot[i, 0] * x + s.rot[i, 1] * y + s.rot[i, 2] * z
        a.place[i] = s.pos[i]
    a.height.level = s.pos[2]
    a.begun = True
    a.settled = True


@compiled
def _lift(a: Any) -> None:
    """End the stance: what the first one with readings saw is what later ones are compared with."""
    a.settled = False
    m, b = a.magnetometer, a.barometer
    if not m.known and m.count > 0:
        for i in range(3):
            m.reference[i] = m.total[i] / m.count
        m.known = True
    if not b.known and b.count > 0:
        # Where nothing arrived in the rest, the first reading stands for the height of its own stance.
        b.reference = b.total / b.count
        height = a.place[2] / b.scale
        b.reference /= (1.0 - height) ** (1.0 / BARO_EXPONENT)
        b.known = True
    _forget_field(m)
    _forget_pressure(b)


@compiled
def _flat(s: Any, pos: int) -> bool:
    """Height update of a landing."""
    h = s.aids.height
    if abs(s.pos[2] - s.aids.place[2]) >= h.change_max:
        h.level = s.pos[2]
        return False
    kalman.update(s, pos + 2, s.pos[2] - h.level, h.variance, pos)
    h.used += 1
    return True


@compiled
def _magnetic(s: Any, att: int) -> bool:
    """Heading from the mean field since the last such measurement."""
    m = s.aids.magnetometer
    x, y, z = m.total[0] / m.count, m.total[1] / m.count, m.total[2] / m.count
    u, v, w = m.reference[0], m.reference[1], m.reference[2]
    flat, flat_ref = math.sqrt(x * x + y * y), math.sqrt(u * u + v * v)
    norm, norm_ref = math.sqrt(flat * flat + z * z), math.sqrt(flat_ref * flat_ref + w * w)
    _forget_field(m)
    m.wait = 0.0
    dip = math.atan2(-z, flat) - math.atan2(-w, flat_ref)
    if flat == 0.0 or abs(norm - norm_ref) >= m.norm_max * norm_ref or abs(dip) >= m.dip_max:
        m.refused += 1
        return False
    kalman.update(s, att + 2, wrap(math.atan2(y, x) - math.atan2(v, u)), m.variance, 0)
    m.used += 1
    return True


@compiled
def _barometric(s: Any, pos: int) -> None:
    """Height from the mean pressure since the last such measurement; the level moves along."""
    b = s.aids.barometer
    height = pressure_height(b.total / b.count, b.reference, b.scale)
    _forget_pressure(b)
    b.wait = 0.0
    before = s.dx[pos + 2]
    kalman.update(s, pos + 2, s.pos[2] - height, b.variance, pos)
    s.aids.height.level -= s.dx[pos + 2] - before
    b.used += 1


@compiled
def aid(s: Any, r: Any, att: int, pos: int) -> bool:
    """Take what the aids know at the sample ``r`` into covariance and correction of ``s``; return whether
    there is a correction, which the filter then feeds back.

    Call it for every released sample, after the zero-velocity update has been fed back, where ``s.aids.on``.
    ``att`` and ``pos`` are the first error states of attitude and position (in n); what comes before ``pos``
    (attitude, gyroscope bias) is considered by the heights.
    """
    a = s.aids
    m, b = a.magnetometer, a.barometer
    if not s.started:
        if r.still:
            _collect(s, r)
        else:
            _forget_field(m)
            _forget_pressure(b)
        return False
    if not a.begun:
        _begin(s)
    m.wait += r.dt
    b.wait += r.dt
    if not r.still:
        _lift(a)
        return False
    _collect(s, r)
    kalman.clear(s.dx)
    used = False
    if not a.settled and s.stance_s >= a.after_s:
        a.settled = True
        x, y, z = s.pos[0] - a.place[0], s.pos[1] - a.place[1], s.pos[2] - a.place[2]
        # Less than a step is a break in one stance, not a new one.
        if math.sqrt(x * x + y * y + z * z) >= s.steps.min_m:
            a.landings += 1
            if a.height.on and _flat(s, pos):
                used = True
            if a.straight.kind > NO_HEADING and measure_heading(s, att):
                used = True
    if a.settled:
        if m.known and m.count > 0 and m.wait >= a.every_s and _magnetic(s, att):
            used = True
        if b.known and b.count > 0 and b.wait >= a.every_s:
            _barometric(s, pos)
            used = True
        for i in range(3):
            a.place[i] = s.pos[i] - s.dx[pos + i]
    return used
