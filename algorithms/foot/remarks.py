"""What the user of a foot estimator's results must know about the run."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ..contract import Remark

IMU_COLUMNS = ("acc_x", "acc_y", "acc_z", "gyr_x", "gyr_y", "gyr_z")
RESTLESS = 0.03
"""rad/s: above this spread of the rate the rest at the start is remarked."""


def remarks(s: Any, p: Any, rate_hz: float, is_corrected: bool = True) -> list[Remark]:
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
                fatal=bool(share > 0.01),
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
    moved = s.rest.moved + s.rest.moved_before
    if s.rest.moved_before > rate_hz and s.rest.moved_before > 0.5 * moved:
        found.append(
            Remark(
                "late_start",
                f"the first rest begins at {start:.2f} s, after {100 * s.rest.moved_before / moved:.0f} % of "
                "the motion: what is estimated is not the walk; stand still at the start, or use "
                "init=adaptive, which starts in the first stance",
                fatal=True,
            )
        )
    elif start > 0.5:
        wanted = f"{p.init_s:g} s" if p.init == "fixed" else f"{min(p.init_min_s, p.init_s):g} s"
        found.append(
            Remark(
                "no_rest",
                f"no rest of {wanted} at the start; the first one begins at {start:.2f} s, and the "
                f"estimate starts "
                f"at its end, after {100 * (s.rest.index + 1) / taken:.0f} % of the rows"
                + ("; a shorter init_s may find one earlier" if p.init == "fixed" else ""),
            )
        )
    spread = math.sqrt(s.rest.spread / s.rest.count)
    if s.rest.adaptive and s.rest.quietest < math.inf:
        spread = math.sqrt(max(0.0, s.rest.quietest))
    elif s.rest.adaptive:
        found.append(
            Remark(
                "short_rest",
                f"the rest at {start:.2f} s lasts {s.rest.elapsed:.2f} s: too short to tell the gyroscope's "
                "bias from a turning foot; the heading may drift",
            )
        )
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
    found += verdict(s, p) if is_corrected else []
    position = s.pos
    if s.started and not (np.all(np.isfinite(position)) and np.all(np.abs(position) < 1e6)):
        found.append(Remark("diverged", f"the position ran away to {position} m", fatal=True))
    return found


FASTEST = 15.0
"""m/s: no foot swings faster, sprinters' apart."""
CLIPPED_SAMPLES = 5
LEAST_CEILING = (15.0, 15.0, 15.0, 3.0, 3.0, 3.0)
"""m/s², rad/s: the same extreme value many times is a ceiling only beyond what a rest reaches."""


def verdict(s: Any, p: Any) -> list[Remark]:
    """Return what speaks against the results being a walk."""
    v, found = s.verdict, []
    if v.fastest > FASTEST:
        found.append(
            Remark(
                "implausible_speed",
                f"the foot reaches {v.fastest:.1f} m/s (a runner's: up to {FASTEST:g}): stances were missed; try "
                "detector=gait",
                fatal=True,
            )
        )
    if v.n_long_strides:
        share = v.n_long_strides / max(1, v.n_landings)
        found.append(
            Remark(
                "implausible_stride",
                f"{v.n_long_strides} of {v.n_landings} strides are longer than 4 m (longest "
                f"{v.longest_stride:.1f} m): stances were missed; try detector=gait",
                fatal=bool(share > 0.1),
            )
        )
    if v.lost_s > 0.0:
        share = v.lost_s / v.navigated_s
        found.append(
            Remark(
                "lost_stances",
                f"for {v.lost_s:.1f} s ({100 * share:.0f} % of the time) no stance was found within 5 s: the "
                "position drifts there",
                fatal=bool(share > 0.2),
            )
        )
    if v.n_landings >= 20 and v.n_landings > 3 * s.steps.count:
        found.append(
            Remark(
                "not_gait",
                f"{v.n_landings} stances make only {s.steps.count} steps: this is no walk, or the detector "
                f"{p.detector} breaks its stances; the position between them is doubtful",
            )
        )
    for i, column in enumerate(IMU_COLUMNS):
        for value, count in ((s.lowest[i], v.at_lowest[i]), (s.highest[i], v.at_highest[i])):
            if count >= CLIPPED_SAMPLES and abs(value) > LEAST_CEILING[i]:
                found.append(
                    Remark(
                        "clipped",
                        f"{column} stands at its extreme {value:.4g} in {count} rows: the sensor's range is too "
                        "small for this walk, turns and speeds in the swing are underestimated",
                    )
                )
    return found
