"""The rest from which a foot estimator starts.

Dissertation, section 3.6: gyroscope bias and level from the mean of a rest. It is verified, not assumed: it
is the first stretch of ``init_s`` in which every sample stays within ``rest_acc`` and ``rest_gyr`` of the
running mean, and whose mean rate is small enough to be a bias.
"""

from __future__ import annotations

import math
from typing import Any

from ..numerics.compiled import compiled, inlined
from ..numerics.records import record_type
from ..numerics.strapdown import level

LONGEST_PAUSE_S = 0.5
"""A longer time step interrupts a rest: nothing is known about what happened in it."""

REST = record_type(
    ("length", "f8"),  # wanted, s
    ("acc_max", "f8"),
    ("gyr_max", "f8"),
    ("bias_max", "f8"),
    ("gravity", "f8"),  # the parameter
    ("gravity_from_rest", "?"),
    ("count", "i8"),
    ("begin", "f8"),  # s since the first row
    ("elapsed", "f8"),  # s
    ("acc", "f8", (3,)),  # mean force, b
    ("gyr", "f8", (3,)),  # mean rate, b
    ("spread", "f8"),  # sum of ‖ω − running mean‖²
    ("longest", "f8"),  # longest rest seen, s
    ("index", "i8"),  # sample that completed the rest, −1 not yet
    ("moved", "i8"),  # samples after the rest that are not at rest
)


@inlined
def _distance(a: Any, b: Any) -> float:
    x, y, z = a[0] - b[0], a[1] - b[1], a[2] - b[2]
    return math.sqrt(x * x + y * y + z * z)


@inlined
def _is_near(rest: Any, r: Any) -> bool:
    """Return whether a sample is within the limits of the rest's mean."""
    return _distance(r.acc, rest.acc) <= rest.acc_max and _distance(r.gyr, rest.gyr) <= rest.gyr_max


@inlined
def watch(rest: Any, r: Any, k: int, time: float) -> bool:
    """Take sample ``k`` at ``time`` into the search for a rest; return True where it completes it."""
    if rest.index >= 0:
        if not _is_near(rest, r):
            rest.moved += 1
        return False
    dt = r.dt
    if rest.count > 0 and (dt > LONGEST_PAUSE_S or not _is_near(rest, r)):
        rest.count = 0
    if rest.count == 0:
        rest.begin = time
        rest.elapsed = 0.0
        rest.spread = 0.0
        for i in range(3):
            rest.acc[i] = 0.0
            rest.gyr[i] = 0.0
        dt = 0.0
    rest.count += 1
    rest.elapsed += dt
    for i in range(3):
        rest.acc[i] += (r.acc[i] - rest.acc[i]) / rest.count
        rest.gyr[i] += (r.gyr[i] - rest.gyr[i]) / rest.count
    spread = _distance(r.gyr, rest.gyr)
    rest.spread += spread * spread
    rest.longest = max(rest.longest, rest.elapsed)
    # Half a nanosecond of grace: time steps are rounded differences.
    if rest.elapsed + 5e-10 < rest.length:
        return False
    x, y, z = rest.gyr[0], rest.gyr[1], rest.gyr[2]
    if math.sqrt(x * x + y * y + z * z) > rest.bias_max:
        rest.count = 0  # a steady turn, not a rest
        return False
    rest.index = k
    return True


@compiled
def start(s: Any) -> None:
    """Level the navigation of ``s`` by its rest, take over bias and gravity."""
    rest = s.rest
    x, y, z = rest.acc[0], rest.acc[1], rest.acc[2]
    gravity = math.sqrt(x * x + y * y + z * z) if rest.gravity_from_rest else rest.gravity
    level(s, rest.acc, rest.gyr, gravity)
