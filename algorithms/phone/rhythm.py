"""The step detector that holds in any placement: band-pass, peaks, rhythm.

‖f‖ is averaged into cells of 20 ms whatever the rate, so that the same filter and windows serve 10 and 500 Hz.
A symmetric band-pass (1.2 to 3 Hz) delays by a constant time that is taken off again: a step's time has no phase
error. Peaks count when they are as high, and as regular, as steps are: a bout of walking is one when four
peaks in a row keep time and the signal repeats itself; its first steps are then made known together, late. Peaks of a
bout that are much lower than its others are none (ringing of the filter at the ends, a swinging arm's second
wave).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ..numerics.compiled import compiled, inlined
from . import ring
from .ring import CELL_NS, KEPT

HALF = 30
TAPS = 2 * HALF + 1
RUN = 16

FIELDS: list[tuple[Any, ...]] = [
    ("taps", "f8", (TAPS,)),
    ("height_min", "f8"),
    ("height_share", "f8"),
    ("rest_gap_s", "f8"),
    ("longest_gap_s", "f8"),
    ("unlike_max", "f8"),
    ("repeat_min", "f8"),
    ("run_min", "i8"),
    ("band", "f8", (KEPT,)),
    # Peaks
    ("valley", "f8"),
    ("pending", "i8"),
    ("pending_ns", "i8"),
    ("pending_y", "f8"),
    ("pending_height", "f8"),
    # Runs
    ("run_n", "i8"),
    ("run_ns", "i8", (RUN,)),
    ("run_height", "f8", (RUN,)),
    ("walking", "i8"),
    ("typical", "f8"),
    ("period_s", "f8"),
]


def band_pass(low_hz: float, high_hz: float) -> np.ndarray:
    """Return the symmetric band-pass for cells of 20 ms: windowed sinc (Hamming), no gain at 0 Hz.

    Its gain is 1 at the middle of the band.
    """
    k = np.arange(-HALF, HALF + 1) * (CELL_NS * 1e-9)
    ideal = 2 * high_hz * np.sinc(2 * high_hz * k) - 2 * low_hz * np.sinc(2 * low_hz * k)
    window = np.hamming(TAPS)
    taps = ideal * window
    taps -= window * taps.sum() / window.sum()
    return taps / (taps @ np.cos(np.pi * (low_hz + high_hz) * k))


@compiled
def on_break(s: Any) -> None:
    """Forget the walk: the signal was interrupted."""
    s.run_n = 0
    s.walking = 0
    s.pending = 0
    s.valley = np.inf


@compiled
def on_cell(s: Any) -> None:
    """Look at the newest cell; the band-pass speaks of the cell ``HALF`` before it."""
    i = s.cell
    y = 0.0
    for k in range(TAPS):
        y += s.taps[k] * s.cells[(i - k) % KEPT]
    s.band[i % KEPT] = y
    if s.filled < 3:
        return
    before, middle = s.band[(i - 2) % KEPT], s.band[(i - 1) % KEPT]
    now_ns = s.cell_zero + (i - HALF) * CELL_NS + CELL_NS // 2
    if before < middle and middle >= y:
        bend = before - 2 * middle + y
        shift = 0.5 * (before - y) / bend if bend < 0.0 else 0.0
        _peak(s, now_ns - CELL_NS + np.int64(round(shift * CELL_NS)), middle)
    if y < s.valley:
        s.valley = y
    if s.pending == 1 and (now_ns - s.pending_ns) * 1e-9 > s.rest_gap_s:
        _accept(s)
    if s.run_n > 0 and (now_ns - s.run_ns[(s.run_n - 1) % RUN]) * 1e-9 > s.longest_gap_s + s.rest_gap_s:
        s.run_n, s.walking = 0, 0


@compiled
def _peak(s: Any, t_ns: int, y: float) -> None:
    """Note a peak; of two that are closer than steps can be the higher one counts."""
    height = y - s.valley
    if s.pending == 1:
        if y > s.pending_y:
            s.pending_ns, s.pending_y = t_ns, y
            s.pending_height = max(s.pending_height, height)
        return
    if height < s.height_min or y <= 0.0:
        return
    if s.walking == 1 and height < s.height_share * s.typical:
        return
    s.pending, s.pending_ns, s.pending_y, s.pending_height = 1, t_ns, y, height
    s.valley = y


@inlined
def _like(a: float, b: float, factor: float) -> bool:
    return a < factor * b and b < factor * a


@compiled
def _accept(s: Any) -> None:
    """Take the pending peak into the run."""
    s.pending = 0
    s.valley = np.inf
    t, height = s.pending_ns, s.pending_height
    for k in range(s.filled):  # the valley since that peak
        i = s.cell - k
        if s.cell_zero + (i - HALF) * CELL_NS + CELL_NS // 2 <= t or k >= KEPT:
            break
        s.valley = min(s.valley, s.band[i % KEPT])
    n = s.run_n
    if n > 0:
        gap = (t - s.run_ns[(n - 1) % RUN]) * 1e-9
        if gap > s.longest_gap_s or (s.walking == 1 and gap > 2.4 * s.period_s):
            n, s.walking = 0, 0
        elif s.walking == 0:
            even = _like(height, s.run_height[(n - 1) % RUN], s.unlike_max)
            if n > 1:  # left and right may differ; a stride is like the one before
                previous = (s.run_ns[(n - 1) % RUN] - s.run_ns[(n - 2) % RUN]) * 1e-9
                even = even and _like(gap, previous, 2.2)
            if n > 2:
                other = (s.run_ns[(n - 2) % RUN] - s.run_ns[(n - 3) % RUN]) * 1e-9
                even = even and _like(gap, other, 1.5)
            if not even:
                n = 0
    s.run_ns[n % RUN] = t
    s.run_height[n % RUN] = height
    n += 1
    s.run_n = n
    if s.walking == 1:
        gap = (t - s.run_ns[(n - 2) % RUN]) * 1e-9
        s.typical += 0.2 * (height - s.typical)
        s.period_s += 0.2 * (min(gap, 1.5 * s.period_s) - s.period_s)
        ring.emit(s, s.run_ns[(n - 2) % RUN], t, height)
    elif n >= s.run_min:
        if _repeats(s, t) < s.repeat_min:
            if n >= RUN:
                for k in range(RUN // 2):
                    s.run_ns[k] = s.run_ns[k + RUN // 2]
                    s.run_height[k] = s.run_height[k + RUN // 2]
                s.run_n = RUN // 2
            return
        _begin(s, n)


@compiled
def _begin(s: Any, n: int) -> None:
    """A bout is one: make its steps known."""
    total = 0.0
    for k in range(n):
        total += s.run_height[k]
    s.typical = total / n
    s.period_s = (s.run_ns[n - 1] - s.run_ns[0]) * 1e-9 / (n - 1)
    s.walking = 1
    last = s.run_ns[0] - np.int64(s.period_s * 1e9)
    for k in range(n):
        if s.run_height[k] >= s.height_share * s.typical:
            ring.emit(s, last, s.run_ns[k], s.run_height[k])
        last = s.run_ns[k]


@compiled
def _repeats(s: Any, t_ns: int) -> float:
    """Return the correlation of the last two steps with the two before (at the stride's lag)."""
    n = s.run_n
    lag_s = (t_ns - s.run_ns[(n - 3) % RUN]) * 1e-9
    last = (t_ns - s.cell_zero) // CELL_NS + HALF
    center = round(lag_s / (CELL_NS * 1e-9))
    length = center
    best = -1.0
    for lag in range(center - 3, center + 4):
        if lag + length >= min(KEPT, s.filled):
            continue
        xy, xx, yy = 0.0, 1e-12, 1e-12
        for k in range(length):
            x = s.band[(last - k) % KEPT]
            y = s.band[(last - k - lag) % KEPT]
            xy += x * y
            xx += x * x
            yy += y * y
        best = max(best, xy / np.sqrt(xx * yy))
    return best
