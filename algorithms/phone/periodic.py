"""Steps by period: autocorrelation (Rai et al. 2012) or spectrum (Ookura et al. 2012) of ‖f‖.

Both say how long a step takes while somebody walks; one step is counted each period. They count well over a
long walk and say little about single steps.
"""

from __future__ import annotations

import math
from typing import Any

from ..numerics.compiled import compiled
from . import ring
from .ring import CELL_NS, KEPT

FIELDS: list[tuple[Any, ...]] = [
    ("window_cells", "i8"),
    ("swing_min", "f8"),  # least standard deviation of ‖f‖ of a walk
    ("share_min", "f8"),  # least autocorrelation, or share of the power
    ("shortest_s", "f8"),
    ("longest_s", "f8"),
    ("paced", "i8"),  # whether somebody walks
    ("pace_s", "f8"),
    ("paced_ns", "i8"),  # time of the newest step
]
WAIT_CELLS = 10
"""Cells between two looks while nobody walks: 0.2 s."""


@compiled
def on_break(s: Any) -> None:
    """Forget the walk: the signal was interrupted."""
    s.paced = 0


@compiled
def on_cell(s: Any, spectral: bool) -> None:
    """Look whether a step is due."""
    now_ns = s.cell_zero + (s.cell + 1) * CELL_NS
    if s.filled < s.window_cells:
        return
    if s.paced == 1:
        due_ns = s.paced_ns + int(s.pace_s * 1e9)
        if now_ns < due_ns:
            return
    elif s.filled % WAIT_CELLS != 0:
        return
    pace = _by_spectrum(s) if spectral else _by_autocorrelation(s)
    if pace <= 0.0:
        s.paced = 0
        return
    if s.paced == 0:  # the window was walked through: its steps are made known now
        n = int(0.5 * s.window_cells * CELL_NS * 1e-9 / pace)
        s.paced_ns = now_ns - n * int(pace * 1e9)
        s.paced = 1
        for _ in range(n):
            ring.emit(s, s.paced_ns, s.paced_ns + int(pace * 1e9), 1.0)
            s.paced_ns += int(pace * 1e9)
    else:
        due_ns = s.paced_ns + int(s.pace_s * 1e9)
        ring.emit(s, s.paced_ns, due_ns, 1.0)
        s.paced_ns = due_ns
    s.pace_s = pace


@compiled
def _mean(s: Any) -> float:
    total = 0.0
    for k in range(s.window_cells):
        total += s.cells[(s.cell - k) % KEPT]
    return total / s.window_cells


@compiled
def _by_autocorrelation(s: Any) -> float:
    """Return the shortest lag whose correlation is close to the best one's, 0 where nobody walks."""
    n, mean = s.window_cells, _mean(s)
    power = 0.0
    for k in range(n):
        power += (s.cells[(s.cell - k) % KEPT] - mean) ** 2
    if power / n < s.swing_min**2:
        return 0.0
    first, last = int(s.shortest_s * 1e9 / CELL_NS), int(s.longest_s * 1e9 / CELL_NS)
    best = 0.0
    for lag in range(first, last + 1):
        best = max(best, _correlation(s, lag, mean))
    if best < s.share_min:
        return 0.0
    before = _correlation(s, first - 1, mean)
    here = _correlation(s, first, mean)
    for lag in range(first, last + 1):
        after = _correlation(s, lag + 1, mean)
        if here >= 0.7 * best and here >= before and here >= after:
            bend = before - 2.0 * here + after
            shift = 0.5 * (before - after) / bend if bend < 0.0 else 0.0
            return (lag + shift) * CELL_NS * 1e-9
        before, here = here, after
    return 0.0


@compiled
def _correlation(s: Any, lag: int, mean: float) -> float:
    n = s.window_cells - lag
    xy, xx, yy = 0.0, 1e-12, 1e-12
    for k in range(n):
        x = s.cells[(s.cell - k) % KEPT] - mean
        y = s.cells[(s.cell - k - lag) % KEPT] - mean
        xy += x * y
        xx += x * x
        yy += y * y
    return xy / math.sqrt(xx * yy)


@compiled
def _by_spectrum(s: Any) -> float:
    """Return the period of the strongest line of the Hann-windowed DFT, 0 where nobody walks."""
    n, mean = s.window_cells, _mean(s)
    power = 0.0
    for k in range(n):
        power += (s.cells[(s.cell - k) % KEPT] - mean) ** 2
    if power / n < s.swing_min**2:
        return 0.0
    best, best_hz = 0.0, 0.0
    low, high = 1.0 / s.longest_s, 1.0 / s.shortest_s
    lines = int((high - low) / 0.05) + 1
    for j in range(lines):
        hz = low + 0.05 * j
        re, im = 0.0, 0.0
        for k in range(n):
            weight = 0.5 - 0.5 * math.cos(2.0 * math.pi * (k + 0.5) / n)
            phase = 2.0 * math.pi * hz * k * CELL_NS * 1e-9
            value = weight * (s.cells[(s.cell - k) % KEPT] - mean)
            re += value * math.cos(phase)
            im += value * math.sin(phase)
        size = re * re + im * im
        if size > best:
            best, best_hz = size, hz
    # A sine that is all of the signal has 4/3 of this; the Hann window's gains are 1/2 and 3/8.
    share = 2.0 * best / (0.375 * n * power) if power > 0.0 else 0.0
    return 1.0 / best_hz if share >= s.share_min and best_hz > 0.0 else 0.0
