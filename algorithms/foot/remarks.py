"""What the user of a foot estimator's results must know about the run."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ..contract import Remark

IMU_COLUMNS = ("acc_x", "acc_y", "acc_z", "gyr_x", "gyr_y", "gyr_z")
RESTLESS = 0.03
"""rad/s: above this spread of the rate the rest at the start is remarked."""


def remarks(s: Any, p: Any, rate_hz: float) -> list[Remark]:
    """Return the remarks of a run whose state's record is ``s``, by its parameters ``p``."""
    taken, elapsed = int(s.taken), s.time
    if taken == 0:
        return [Remark("no_data", "no row was given; nothing was estimated", fatal=True)]
    found: list[Remark] = []
    if s.repaired > 0:
        share = s.repaired / taken
        found.append(
            Remark(
                "not_finite",
                f"{s.repaired} of {taken} rows held a value that is not finite; the previous one was kept",
                fatal=share > 0.01,
            )
        )
    for i, column in enumerate(IMU_COLUMNS):
        low, high = s.lowest[i], s.highest[i]
        if low == high and taken >= 10:
            found.append(
                Remark(
                    "dead_axis",
                    f"{column} is {low:g} in all {taken} rows: that axis is missing or broken; "
                    "an estimate without it is wrong, repair the sensor or its mapping",
                    fatal=True,
                )
            )
    if elapsed > 0 and taken > 10:
        measured = (taken - 1) / elapsed
        if not 0.8 < measured / rate_hz < 1.25:
            found.append(
                Remark(
                    "rate_mismatch",
                    f"windows were laid out for {rate_hz:g} Hz but rows come at {measured:.1f} Hz, so they "
                    f"last {rate_hz / measured:.2f} times as long as asked; give rate_hz={measured:.0f}",
                )
            )
    if s.rest.index < 0:
        found.append(
            Remark(
                "no_rest",
                f"no rest of {p.init_s:g} s anywhere in {elapsed:.1f} s (longest {s.rest.longest:.2f} "
                f"s): bias and "
                "level are unknown, nothing was estimated; stand still at the start, or give a shorter "
                "init_s (preset=short-rest: 0.3 s)",
                fatal=True,
            )
        )
        return found
    start = s.rest.begin
    if start > 0.5:
        found.append(
            Remark(
                "no_rest",
                f"no rest of {p.init_s:g} s at the start; the first one begins at {start:.2f} s, and the "
                f"estimate starts "
                f"at its end, after {100 * (s.rest.index + 1) / taken:.0f} % of the rows; a shorter "
                f"init_s may find one "
                "earlier",
            )
        )
    spread = math.sqrt(s.rest.spread / s.rest.count)
    if spread > RESTLESS:
        found.append(
            Remark(
                "restless",
                f"in the rest at {start:.2f} s the angular rate spreads by {spread:.3f} rad/s (a sensor "
                f"that lies still: "
                f"below {RESTLESS:g}): the bias taken from it is uncertain; hold still longer, or give a "
                f"shorter init_s",
            )
        )
    ax, ay, az = s.rest.acc
    norm = math.sqrt(ax * ax + ay * ay + az * az)
    if abs(norm - p.gravity) > 0.3 * p.gravity:
        found.append(
            Remark(
                "unit_doubt",
                f"‖f‖ at rest is {norm:.3f} m/s², gravity {p.gravity:g}: are the values in g or in counts?",
                fatal=True,
            )
        )
    elif abs(norm - p.gravity) > 0.02 * p.gravity:
        found.append(
            Remark(
                "gravity_norm",
                f"‖f‖ at rest is {norm:.3f} m/s², {100 * (norm / p.gravity - 1):+.1f} % off gravity "
                f"{p.gravity:g}: "
                "the accelerometer's scale or bias is off; calibrate it, or try gravity_from_rest",
            )
        )
    if az < 0:
        roll = math.degrees(math.atan2(ay, az))
        pitch = math.degrees(math.atan2(-ax, math.hypot(ay, az)))
        found.append(
            Remark(
                "upside_down",
                f"the sensor's z axis points down at rest (roll {roll:.0f}°, pitch {pitch:.0f}°); it was "
                f"levelled fully",
            )
        )
    if s.rest.moved == 0:
        found.append(
            Remark(
                "never_moved",
                f"nothing moved after the rest ({elapsed:.1f} s in all): there is no walk in it",
            )
        )
    elif s.started and s.n_still == 0 and taken > s.rest.index + 2 * s.detector.latency + 10:
        found.append(
            Remark(
                "never_still",
                f"the detector {p.detector} never found the foot still: nothing was corrected; check its "
                f"thresholds",
                fatal=True,
            )
        )
    elif s.steps.count == 0 and s.rest.moved <= rate_hz:
        found.append(
            Remark(
                "no_step",
                f"after the rest it moved for {s.rest.moved / rate_hz:.2f} s only: there is no step in it",
            )
        )
    elif s.steps.count == 0:
        found.append(
            Remark("no_step", "the sensor moved, but no step was found: wrong detector or wrong mounting?")
        )
    position = s.pos
    if s.started and not (np.all(np.isfinite(position)) and np.all(np.abs(position) < 1e6)):
        found.append(Remark("diverged", f"the position ran away to {position} m", fatal=True))
    return found
