"""Samples and events that the stages of a phone share within one state record.

Every stage is a list of fields; an estimator's record is the concatenation of the stages that it runs. The
ring keeps the newest accelerometer samples, so that a step which is known late is still described by its own
samples. The queue holds steps that were found and not yet handed on.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ..numerics.compiled import compiled, inlined

RING = 4096
"""Samples kept: 40 s at 100 Hz, 8 s at 500 Hz."""
QUEUE = 32
"""Steps that one message can make known at most."""
CELL_NS, KEPT = 20_000_000, 512
"""Length of a cell, over which ‖f‖ is averaged whatever the rate, and cells kept."""

NORM, UP, EAST, NORTH, YAW, MAG_YAW, DISTURBED = range(7)
"""Columns of the ring: ‖f‖; f along up, east and north of the level frame less gravity (m/s²); heading of the
device (rad, from x to y); the same by the magnetometer alone; 1 where the field is disturbed."""

FIELDS: list[tuple[Any, ...]] = [
    ("taken", "i8"),
    ("ring_t", "i8", (RING,)),
    ("ring", "f8", (RING, 7)),
    ("queued", "i8"),
    ("queue_start", "i8", (QUEUE,)),
    ("queue_end", "i8", (QUEUE,)),
    ("queue_quality", "f8", (QUEUE,)),
    ("dropped", "i8"),
]

N_FEATURES = 9
F_MAX, F_MIN, F_MEAN_ABS, F_MEAN, F_VAR, F_COUNT, F_PERIOD, F_MAX_LOW, F_MIN_LOW = range(N_FEATURES)
"""What a step's samples say: greatest and least ‖f‖, mean |‖f‖ − g|, mean ‖f‖, variance, number of samples,
time of the step (s), and greatest and least of ‖f‖ smoothed by a moving mean of 0.1 s."""


@inlined
def push(s: Any, t_ns: int, norm: float) -> int:
    """Put a sample into the ring; return its place."""
    i = s.taken % RING
    s.ring_t[i] = t_ns
    for j in range(7):
        s.ring[i, j] = np.nan
    s.ring[i, NORM] = norm
    s.taken += 1
    return i


@inlined
def emit(s: Any, start_ns: int, end_ns: int, quality: float) -> None:
    """Put a step into the queue."""
    if s.queued >= QUEUE:
        s.dropped += 1
        return
    s.queue_start[s.queued] = start_ns
    s.queue_end[s.queued] = end_ns
    s.queue_quality[s.queued] = quality
    s.queued += 1


@compiled
def first_after(s: Any, t_ns: int) -> int:
    """Return the number (as ``taken`` counts) of the oldest kept sample later than ``t_ns``."""
    low = s.taken - RING
    if low < 0:
        low = 0
    high = s.taken
    while low < high:
        middle = (low + high) // 2
        if s.ring_t[middle % RING] <= t_ns:
            low = middle + 1
        else:
            high = middle
    return low


@compiled
def features(s: Any, start_ns: int, end_ns: int, gravity: float, out: Any) -> None:
    """Fill ``out`` with what the samples after ``start_ns`` and up to ``end_ns`` say."""
    for j in range(out.shape[0]):
        out[j] = np.nan
    first, last = first_after(s, start_ns), first_after(s, end_ns)
    n = last - first
    out[F_COUNT] = n
    out[F_PERIOD] = (end_ns - start_ns) * 1e-9
    if n <= 0:
        return
    top, bottom, total, absolute = -np.inf, np.inf, 0.0, 0.0
    for k in range(first, last):
        a = s.ring[k % RING, NORM]
        top, bottom = max(top, a), min(bottom, a)
        total += a
        absolute += abs(a - gravity)
    mean = total / n
    square = 0.0
    for k in range(first, last):
        square += (s.ring[k % RING, NORM] - mean) ** 2
    out[F_MAX], out[F_MIN], out[F_MEAN_ABS] = top, bottom, absolute / n
    out[F_MEAN], out[F_VAR] = mean, square / n
    _low_passed(s, first, last, out)


@compiled
def _low_passed(s: Any, first: int, last: int, out: Any) -> None:
    """Extremes of the moving mean over 0.1 s (trailing; at low rates the sample itself)."""
    top, bottom, window, total = -np.inf, np.inf, first, 0.0
    oldest = max(0, s.taken - RING)
    while window > oldest and s.ring_t[first % RING] - s.ring_t[(window - 1) % RING] < 100_000_000:
        window -= 1
        total += s.ring[window % RING, NORM]
    for k in range(first, last):
        total += s.ring[k % RING, NORM]
        while s.ring_t[k % RING] - s.ring_t[window % RING] >= 100_000_000:
            total -= s.ring[window % RING, NORM]
            window += 1
        value = total / (k - window + 1)
        top, bottom = max(top, value), min(bottom, value)
    out[F_MAX_LOW], out[F_MIN_LOW] = top, bottom
