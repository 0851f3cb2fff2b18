"""Turns that a gyroscope cut off, put back from the slopes on both sides.

A sensor whose range is too small for a swing stands at its ceiling while the foot turns on; a swing loses up to half a
radian there, and a track its direction, height and length. At both ends of the plateau the rate still rises and falls:
a cubic with these slopes (Hermite's) over the plateau is what a smooth turn does in between. A whole peak is its own
cubic, so that a turn below the ceiling is left as it is: what tells a plateau from a peak is that the cubic rises by
several times what the samples themselves do, and that the axis reaches the same ceiling again.

Measured on real swings that were cut off at 4.4, 6 and 7.5 rad/s, where the truth is known (3182 plateaus of 25 inputs
of four devices at 100 to 512 Hz): the cubic's area is right on average up to 0.1 s (0.9 of what was lost) and grows too
large beyond, because long turns have two humps: its height grows no more from :data:`LONGEST_PEAK_S` on. What is left
has 0.45 of the root mean square of what was put back: that goes into P, about the axis that was cut.

Nothing here knows the sensor's range. A plateau must have ended before its correction is known: that takes the
look-ahead of the detector, and reaches as far back.
"""

from __future__ import annotations

from typing import Any

from ..numerics.compiled import compiled, inlined
from ..numerics.records import record_type

LEAST_CEILING = 3.0
"""rad/s: no gyroscope has a ceiling below 170 °/s."""
BAND = 0.015
"""Share of the ceiling within which a plateau's readings stay: some are blurred by the sensor's filter."""
FEWEST = 3
"""Samples of a plateau, at least."""
EDGE_S = 0.01
"""s: the slopes are taken over so long (two samples at least)."""
RISE, SHORT_RISE = 3.0, 16.0
"""A plateau: the cubic rises by more than so many times what the samples do (so many through their number, if few).

A parabola's peak of 3, 4, 5 samples gives 4.3, 3.1, 2.1.
"""
LEAST_RISE = 0.01
"""Share of the ceiling: less is nothing to put back."""
LONGEST_S = 0.4
"""s: no swing is longer beyond a ceiling."""
LONGEST_PEAK_S = 0.1
"""s: a longer plateau has more than one peak."""
AT_EXTREME = 0.96
"""A ceiling is the axis' own extreme: lower plateaus are turns at a constant rate."""
AGREES = 0.025
"""A ceiling is met again: so near to the one before, unless the readings are all one (a whole number's end)."""
UNSURE = 0.45
"""Standard deviation of the area put back, as a share of it."""

AXIS = record_type(
    ("first", "i8"),  # sample at which the present run begins
    ("side", "i8"),  # its sign, 0 before the first sample
    ("high", "f8"),  # its extremes, absolute
    ("low", "f8"),
    ("pending", "i8", (2,)),  # first and last sample of a run that waits for its slope behind; −1 none
    ("pending_high", "f8"),
    ("pending_low", "f8"),
    ("extreme", "f8", (2,)),  # greatest reading so far, of either sign, absolute
    ("level", "f8", (2,)),  # of the newest plateau, rad/s
    ("count", "i8", (2,)),  # plateaus put back at that extreme
    ("angle", "f8", (2,)),  # rad, put back in all
)

CEILING = record_type(("on", "?"), ("edge", "i8"), ("axes", AXIS, (3,)))


@compiled
def watch(c: Any, ring: Any, k: int, released: int) -> None:
    """Take the rates of sample ``k``; correct the samples from ``released`` on where a plateau has ended."""
    mask = ring.shape[0] - 1
    value = ring[k & mask].gyr
    for axis in range(3):
        a = c.axes[axis]
        _follow(a, value[axis], k)
        if a.pending[0] >= 0 and k == a.pending[1] + 1 + c.edge:
            if a.pending[0] > c.edge + 1 and k - a.pending[0] + c.edge + 2 < ring.shape[0]:
                _put_back(a, ring, axis, c.edge, released)
            a.pending[0] = -1


@inlined
def _follow(a: Any, value: float, k: int) -> None:
    """Continue the present run with the reading ``value``, or close it and begin another one."""
    side = 1 if value > 0.0 else -1
    size = abs(value)
    where = 0 if side > 0 else 1
    if size > a.extreme[where]:
        if size * AT_EXTREME > a.extreme[where]:
            a.count[where] = 0
            a.angle[where] = 0.0
        a.extreme[where] = size
    high, low = max(a.high, size), min(a.low, size)
    if side == a.side and high - low <= BAND * high:
        a.high, a.low = high, low
        return
    if a.side != 0 and a.high >= LEAST_CEILING and k - a.first >= FEWEST and a.pending[0] < 0:
        a.pending[0], a.pending[1] = a.first, k - 1
        a.pending_high, a.pending_low = a.high, a.low
    a.first, a.side = k, side
    a.high, a.low = size, size


@compiled
def _put_back(a: Any, ring: Any, axis: int, edge: int, released: int) -> None:
    """Replace the pending plateau by the cubic of its edges' slopes, where it is one."""
    mask = ring.shape[0] - 1
    first, last = a.pending[0], a.pending[1]
    side = 1.0 if ring[first & mask].gyr[axis] > 0.0 else -1.0
    where = 0 if side > 0.0 else 1
    if a.pending_high < AT_EXTREME * a.extreme[where]:
        return
    before, after = side * ring[(first - 1) & mask].gyr[axis], side * ring[(last + 1) & mask].gyr[axis]
    up, down, length = 0.0, 0.0, 0.0
    for i in range(edge):
        up += ring[(first - 1 - i) & mask].dt
        down += ring[(last + 2 + i) & mask].dt
    for i in range(first + 1, last + 1):
        length += ring[i & mask].dt
    if up <= 0.0 or down <= 0.0 or before >= a.pending_low or after >= a.pending_low or length > LONGEST_S:
        return
    rising = (before - side * ring[(first - 1 - edge) & mask].gyr[axis]) / up
    falling = (after - side * ring[(last + 1 + edge) & mask].gyr[axis]) / down
    if rising <= 0.0 or falling <= 0.0:
        return
    # Where the slopes reach the ceiling, between the last sample below it and the first one at it
    ceiling = 0.5 * (a.pending_high + a.pending_low)
    early = max(0.0, ring[first & mask].dt - (ceiling - before) / rising)
    late = max(0.0, ring[(last + 1) & mask].dt - (ceiling - after) / falling)
    length += early + late
    rise = length * (rising + falling) / 8.0
    least = max(RISE, SHORT_RISE / (last - first + 1)) * (a.pending_high - a.pending_low)
    if rise <= max(least, LEAST_RISE * ceiling):
        return
    is_met_again = a.pending_high == a.pending_low or abs(ceiling - a.level[where]) <= AGREES * ceiling
    a.level[where] = ceiling
    if not is_met_again:
        return
    share = min(1.0, LONGEST_PEAK_S / length)
    elapsed = early
    for i in range(first, last + 1):
        r = ring[i & mask]
        if i > first:
            elapsed += r.dt
        u = elapsed / length
        more = share * length * (rising * u * (1.0 - u) * (1.0 - u) + falling * u * u * (1.0 - u))
        if i < released or ceiling + more <= side * r.gyr[axis]:
            continue
        a.angle[where] += (ceiling + more - side * r.gyr[axis]) * r.dt
        r.gyr[axis] = side * (ceiling + more)
        x, y, z = r.gyr[0], r.gyr[1], r.gyr[2]
        r.gyr_norm = (x * x + y * y + z * z) ** 0.5
        # The error has one sign all along: its variance grows with the square of the time.
        r.doubt[axis] = (UNSURE * more) * (UNSURE * more) * length
    a.count[where] += 1
