"""Axes and position of a hinge by turns, and which of its two sensors are left-handed."""

from __future__ import annotations

import math
from typing import Any

from ..contract import FloatArray
from ..numerics.compiled import compiled
from .axisfit import DGYR, GYR, SUM, WIDTH, fit_axes, fit_position, pairing_misfit

STILL_RATE = 0.05
"""Rate (rad/s) below which a sensor does not turn: a long rest would crowd the motion out of a store."""
PAIRED = 0.55
"""Share of the worse pairing's misfit in both above which the axes' signs belong together."""
DOUBTFUL = 0.7
"""The same, below which it is looked whether a sensor is mirrored."""
SD_GYR, SD_ACC = 0.05, 0.5
"""Misfits of rates across (rad/s) and forces along the axes (m/s²) where no parameter says them."""
SHARP = 0.1
"""Standard deviation of the axes (rad) above which that says nothing: a hip, or hardly any motion."""
MIRRORED = 0.6
"""Misfit with a sensor's rates reversed, over that with the rates as they are, below which it is mirrored."""


@compiled
def fit(
    w: Any,
    rows: FloatArray,
    count: int,
    lag: int,
    sd_gyr: float,
    sd_acc: float,
    gravity: float,
    position: bool,
) -> bool:
    """Find ``w.axis`` and, with ``position``, ``w.pos`` by turns; return whether the signs could be compared."""
    paired = fit_axes(w, rows, count, lag, sd_gyr, sd_acc, gravity)
    if position:
        fit_position(w, rows, count, 0.5)
        paired = fit_axes(w, rows, count, lag, sd_gyr, sd_acc, gravity)
        fit_position(w, rows, count, 0.5)
    return paired


@compiled
def reverse_rates(rows: FloatArray, count: int, i: int) -> None:
    """Turn the sign of all rates of segment ``i``, in place: those of right-handed axes where it is left-handed."""
    for k in range(count):
        for first in (GYR, DGYR, SUM):
            for m in range(3):
                rows[k, WIDTH * i + first + m] = -rows[k, WIDTH * i + first + m]


@compiled
def find_hand(
    w: Any, rows: FloatArray, count: int, lag: int, sd_gyr: float, sd_acc: float, gravity: float
) -> None:
    """Set ``w.hand``: which sensors are left-handed, by the misfit of eq 73 with eq 74 under each assumption.

    Under the right one the force of the joint's centre turns as the rates say (misfit .005 rad² in simulated walking,
    .07 with soft tissue), under the others it does not (.18 to .20). Axes and positions are overwritten.
    """
    x, y, z = w.axis[0, 0], w.axis[0, 1], w.axis[0, 2]
    plain, least = math.inf, math.inf
    w.hand = 0
    for hand in range(4):
        for i in range(2):
            if (hand >> i) & 1:
                reverse_rates(rows, count, i)
            for m in range(3):
                w.pos[i, m] = 0.0
        w.axis[0, 0], w.axis[0, 1], w.axis[0, 2] = x, y, z
        decided = fit(w, rows, count, lag, sd_gyr, sd_acc, gravity, True)
        misfit = min(
            pairing_misfit(w, rows, count, lag, 1.0),
            pairing_misfit(w, rows, count, lag, -1.0),
        )
        for i in range(2):
            if (hand >> i) & 1:
                reverse_rates(rows, count, i)
        if not decided:
            continue
        if hand == 0:
            plain = misfit
        elif (
            misfit < least
            and misfit < MIRRORED * plain
            and w.pairing > PAIRED
            and max(w.axis_sd[0], w.axis_sd[1]) < SHARP
        ):
            least = misfit
            w.hand = hand
    w.axis[0, 0], w.axis[0, 1], w.axis[0, 2] = x, y, z
