"""Heading from straight walking (``hdr``, ``ihde``)."""

from __future__ import annotations

import math
from typing import Any

from ...numerics import kalman
from ...numerics.compiled import compiled
from .parameters import MOST_STRIDES
from .record import IHDE


@compiled
def wrap(angle: float) -> float:
    """Return ``angle`` (rad) within ±π."""
    return angle - 2.0 * math.pi * math.floor((angle + math.pi) / (2.0 * math.pi))


@compiled
def _end(a: Any) -> None:
    """End the present straight; the first one long enough lays the building's directions."""
    if a.kind == IHDE and not a.grid_known and a.run >= a.wanted:
        a.grid = a.run_heading
        a.grid_known = True
    a.run = 0


@compiled
def measure_heading(s: Any, att: int) -> bool:
    """At a landing: note the stride's direction, and measure the heading if it is straight."""
    a = s.aids.straight
    x, y = s.pos[0] - s.aids.place[0], s.pos[1] - s.aids.place[1]
    if math.sqrt(x * x + y * y) < a.stride_min:
        a.n_strides = 0
        _end(a)
        return False
    heading = math.atan2(y, x)
    strides = a.n_strides
    a.headings[strides % MOST_STRIDES] = heading
    a.n_strides = strides + 1
    wanted = a.wanted
    if strides + 1 < wanted:
        return False
    centre = 0.0
    for i in range(wanted):
        centre += wrap(a.headings[(strides - i) % MOST_STRIDES] - heading)
    centre /= wanted
    spread = 0.0
    for i in range(wanted):
        spread = max(spread, abs(wrap(a.headings[(strides - i) % MOST_STRIDES] - heading) - centre))
    if a.run == 0:
        # The mean of the strides before the newest one.
        a.run = wanted - 1
        a.run_heading = heading + centre * wanted / (wanted - 1.0)
    deviation = wrap(heading - a.run_heading)
    if spread >= a.deviation_max or abs(deviation) >= a.deviation_max:
        if a.run >= wanted:
            _end(a)
        a.run = 0
        return False
    used = True
    if a.kind == IHDE and a.grid_known:
        away = heading - a.grid
        deviation = away - a.sector * math.floor(away / a.sector + 0.5)
        used = abs(deviation) < a.gate
    before = s.dx[att + 2]
    if used:
        trust = 1.0 - spread / a.deviation_max
        kalman.update(s, att + 2, deviation, a.variance / (trust * trust), 0)
        a.used += 1
    a.run += 1
    corrected = heading - (s.dx[att + 2] - before)
    a.run_heading += wrap(corrected - a.run_heading) / a.run
    return used
