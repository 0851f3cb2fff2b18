"""The source's detector and the ones that it surveys, sample by sample on ‖f‖ at the device's own rate.

``peaks``: local peaks above mean + σ and valleys below mean − σ of a centred window, thinned by the least
interval mean − σ of the intervals seen so far (phone dissertation, eqs 3.1–3.9). The others: see :data:`METHODS`.
"""

from __future__ import annotations

import math
from typing import Any

from ..numerics.compiled import compiled, inlined
from . import ring
from .ring import NORM, RING

METHODS = ("peaks", "gates", "tied", "zero-crossing", "threshold")
PEAKS, GATES, TIED, ZERO, THRESHOLD = range(5)
MAX_HALF = 1000
"""Longest half window in samples, so that what is looked at is still in the ring."""

FIELDS: list[tuple[Any, ...]] = [
    ("kind", "i8"),
    ("half", "i8"),  # w: samples on either side
    ("printed", "i8"),  # σ by eq 3.3 as printed
    ("least_s", "f8"),
    ("most_s", "f8"),
    ("level", "f8"),  # threshold above gravity, or the constant of the tied limits
    ("smooth", "i8"),  # samples of the threshold's moving mean
    ("gravity", "f8"),
    ("extreme_ns", "i8", (2,)),  # newest peak, valley that was kept; 0 none
    ("candidate_ns", "i8", (2,)),  # newest that passed the magnitude filter
    ("gap_n", "i8", (2,)),
    ("gap_mean", "f8", (2,)),
    ("gap_m2", "f8", (2,)),
    ("open_ns", "i8"),  # a peak that waits for its valley
    ("last_ns", "i8"),  # end of the newest step
    ("tied_peak", "f8"),
    ("tied_valley", "f8"),
    ("crossed_ns", "i8"),
    ("crossings", "i8"),
    ("above", "i8"),
]
FIRST_S = 0.5
"""Length of the first step of a walk, whose begin no peak marks."""


@inlined
def _norm(s: Any, i: int) -> float:
    return s.ring[i % RING, NORM]


@inlined
def _time(s: Any, i: int) -> int:
    return s.ring_t[i % RING]


@compiled
def _step(s: Any, t_ns: int) -> None:
    """A step ends at ``t_ns``."""
    start = s.last_ns
    if start == 0 or t_ns - start > 2_000_000_000:
        start = t_ns - int(FIRST_S * 1e9)
    ring.emit(s, start, t_ns, 1.0)
    s.last_ns = t_ns


@compiled
def _extreme(s: Any, i: int) -> int:
    """Return 1 at a peak, −1 at a valley, 0 elsewhere. A plateau counts once, at its first sample."""
    a = _norm(s, i)
    before = _norm(s, i - 1)
    if a == before:
        return 0
    k = i + 1
    while k < s.taken and k <= i + s.half and _norm(s, k) == a:
        k += 1
    if k >= s.taken or k > i + s.half:
        return 0
    after = _norm(s, k)
    if before < a and after < a:
        return 1
    return -1 if before > a and after > a else 0


@compiled
def _mean(s: Any, i: int) -> float:
    total = 0.0
    for k in range(i - s.half, i + s.half + 1):
        total += _norm(s, k)
    return total / (2 * s.half + 1)


@compiled
def _passes(s: Any, i: int, side: int) -> bool:
    """Magnitude filter (eqs 3.2–3.5)."""
    mean, total = _mean(s, i), 0.0
    for k in range(i - s.half, i + s.half + 1):
        total += (_norm(s, k) - (_mean(s, k) if s.printed == 1 else mean)) ** 2
    sigma = math.sqrt(total / (2 * s.half + 1))
    return _norm(s, i) > mean + sigma if side > 0 else _norm(s, i) < mean - sigma


@compiled
def _keeps_time(s: Any, t_ns: int, which: int) -> bool:
    """Temporal filter with the intervals' mean and σ so far (eqs 3.6–3.9)."""
    keep = s.extreme_ns[which] == 0
    if not keep:
        n = s.gap_n[which]
        least = s.gap_mean[which] - math.sqrt(s.gap_m2[which] / n) if n >= 2 else 0.0
        keep = (t_ns - s.extreme_ns[which]) * 1e-9 > least
    if s.candidate_ns[which] != 0:
        gap = (t_ns - s.candidate_ns[which]) * 1e-9
        s.gap_n[which] += 1
        d = gap - s.gap_mean[which]
        s.gap_mean[which] += d / s.gap_n[which]
        s.gap_m2[which] += d * (gap - s.gap_mean[which])
    s.candidate_ns[which] = t_ns
    if keep:
        s.extreme_ns[which] = t_ns
    return keep


@compiled
def _in_gates(s: Any, t_ns: int, which: int) -> bool:
    """Fixed time gates; an extreme later than the longest gap begins anew and is not counted."""
    previous = s.extreme_ns[which]
    gap = (t_ns - previous) * 1e-9
    if previous != 0 and gap < s.least_s:
        return False
    s.extreme_ns[which] = t_ns
    return previous != 0 and gap <= s.most_s


@compiled
def _peaks(s: Any) -> None:
    i = s.taken - 1 - (2 * s.half if s.printed == 1 else s.half)
    if i < (2 * s.half if s.printed == 1 else s.half) or i < 1:
        return
    side = _extreme(s, i)
    if side == 0 or not _passes(s, i, side):
        return
    t_ns = _time(s, i)
    which = 0 if side > 0 else 1
    if not (_keeps_time(s, t_ns, which) if s.kind == PEAKS else _in_gates(s, t_ns, which)):
        return
    if side > 0:
        if s.open_ns == 0:
            s.open_ns = t_ns
    elif s.open_ns != 0:
        _step(s, s.open_ns)
        s.open_ns = 0


@compiled
def _tied(s: Any) -> None:
    """Limits tied to the last valley and peak (Pratama et al. 2012)."""
    i = s.taken - 1 - s.half
    if i < 1:
        return
    side = _extreme(s, i)
    a = _norm(s, i)
    if i == 1:
        s.tied_peak, s.tied_valley, s.above = s.gravity, s.gravity, 0
    if side > 0:
        if s.above == 0 and a > s.tied_valley + s.level:
            s.tied_peak, s.above = a, 1
            if s.last_ns == 0 or (_time(s, i) - s.last_ns) * 1e-9 >= s.least_s:
                _step(s, _time(s, i))
        elif s.above == 1 and a > s.tied_peak:
            s.tied_peak = a
    elif side < 0:
        if s.above == 1 and a < s.tied_peak - s.level:
            s.tied_valley, s.above = a, 0
        elif s.above == 0 and a < s.tied_valley:
            s.tied_valley = a


@compiled
def _zero(s: Any) -> None:
    """Crossings of the mean-free signal divided by two, with a least and a longest interval."""
    i = s.taken - 1 - s.half
    if i < s.half + 1:
        return
    mean = _mean(s, i)
    above = 1 if _norm(s, i) >= mean else 0
    if above == s.above:
        return
    t_ns = _time(s, i)
    if s.crossed_ns != 0 and (t_ns - s.crossed_ns) * 1e-9 < s.least_s:
        return
    s.above = above
    late = s.crossed_ns == 0 or (t_ns - s.crossed_ns) * 1e-9 > s.most_s
    s.crossed_ns = t_ns
    if late:
        s.crossings = 0
        return
    s.crossings += 1
    if s.crossings % 2 == 0:
        _step(s, t_ns)


@compiled
def _threshold(s: Any) -> None:
    """Fixed threshold on the raw or low-passed norm."""
    k = s.taken - 1
    if k < s.smooth - 1:
        return
    total = 0.0
    for j in range(k - s.smooth + 1, k + 1):
        total += _norm(s, j)
    value = total / s.smooth - s.gravity
    if s.above == 0 and value > s.level:
        s.above = 1
        t_ns = _time(s, k)
        if s.last_ns == 0 or (t_ns - s.last_ns) * 1e-9 >= s.least_s:
            _step(s, t_ns)
    elif s.above == 1 and value < 0.0:
        s.above = 0


@compiled
def take(s: Any) -> None:
    """Look at the newest sample in the ring; steps go into the queue."""
    if s.kind <= GATES:
        _peaks(s)
    elif s.kind == TIED:
        _tied(s)
    elif s.kind == ZERO:
        _zero(s)
    else:
        _threshold(s)
