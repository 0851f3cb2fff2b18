"""What the user of a foot estimator's results must know about the run."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ..contract import Remark
from .rest import BIAS_CHANGE

IMU_COLUMNS = ("acc_x", "acc_y", "acc_z", "gyr_x", "gyr_y", "gyr_z")
RESTLESS = 0.03
"""rad/s: above this spread of the rate the rest at the start is remarked."""


def remarks(s: Any, p: Any, rate_hz: float, is_corrected: bool = True) -> list[Remark]:
    """Return the remarks of a run whose state's record is ``s``, by its parameters ``p``."""
    taken, elapsed = int(s.taken), s.time
    if taken == 0:
        return [Remark("no_data", "no row was given; nothing was estimated", fatal=True)]
    result: list[Remark] = []
    if s.repaired > 0:
        share = s.repaired / taken
        result.append(
            Remark(
                "not_finite",
                f"{s.repaired} of {taken} rows held a value that is not finite; the previous one was kept",
                fatal=bool(share > 0.01),
            )
        )
    for i, column in enumerate(IMU_COLUMNS):
        low, high = s.lowest[i], s.highest[i]
        if low == high and taken >= 10:
            result.append(
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
            result.append(
                Remark(
                    "rate_mismatch",
                    f"windows were laid out for {rate_hz:g} Hz but rows come at {measured:.1f} Hz, so they "
                    f"last {rate_hz / measured:.2f} times as long as asked; give rate_hz={measured:.0f}",
                )
            )
    if s.rest.index < 0:
        result.append(
            Remark(
                "no_rest",
                f"no rest of {p.init_s:g} s anywhere in {elapsed:.1f} s (longest {s.rest.longest:.2f} "
                f"s): bias and "
                "level are unknown, nothing was estimated; stand still at the start, or give a shorter "
                "init_s (preset=short-rest: 0.3 s)",
                fatal=True,
            )
        )
        return result
    start = s.rest.begin
    moved = s.rest.moved + s.rest.moved_before
    if s.rest.moved_before > rate_hz and s.rest.moved_before > 0.5 * moved:
        result.append(
            Remark(
                "late_start",
                f"the first rest begins at {start:.2f} s, after {100 * s.rest.moved_before / moved:.0f} % of "
                "the motion: what is estimated is not the walk; stand still at the start, or use "
                "init=adaptive, which starts in the first stance",
                fatal=True,
            )
        )
    elif s.rest.stance:
        result.append(
            Remark(
                "moving_start",
                f"it begins in motion: started in the stance at {start:.2f} s and levelled by the "
                f"{s.rest.elapsed:.2f} s of it; the gyroscope's bias is not known, the heading may drift",
            )
        )
    elif start > 0.5:
        wanted = f"{p.init_s:g} s" if p.init == "fixed" else f"{min(p.init_min_s, p.init_s):g} s"
        result.append(
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
    elif s.rest.adaptive and not s.rest.stance:
        result.append(
            Remark(
                "short_rest",
                f"the rest at {start:.2f} s lasts {s.rest.elapsed:.2f} s: too short to tell the gyroscope's "
                "bias from a turning foot; the heading may drift",
            )
        )
    if spread > RESTLESS:
        result.append(
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
        result.append(
            Remark(
                "unit_doubt",
                f"‖f‖ at rest is {norm:.3f} m/s², gravity {p.gravity:g}: are the values in g or in counts?",
                fatal=True,
            )
        )
    elif abs(norm - p.gravity) > 0.02 * p.gravity and not s.rest.stance:
        result.append(
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
        result.append(
            Remark(
                "upside_down",
                f"the sensor's z axis points down at rest (roll {roll:.0f}°, pitch {pitch:.0f}°); it was "
                f"levelled fully",
            )
        )
    if s.rest.moved == 0:
        result.append(
            Remark(
                "never_moved",
                f"nothing moved after the rest ({elapsed:.1f} s in all): there is no walk in it",
            )
        )
    elif s.started and s.n_still == 0 and taken > s.rest.index + 2 * s.detector.latency + 10:
        result.append(
            Remark(
                "never_still",
                f"the detector {p.detector} never found the foot still: nothing was corrected; check its "
                f"thresholds",
                fatal=True,
            )
        )
    elif s.steps.count == 0 and s.rest.moved <= rate_hz:
        result.append(
            Remark(
                "no_step",
                f"after the rest it moved for {s.rest.moved / rate_hz:.2f} s only: there is no step in it",
            )
        )
    elif s.steps.count == 0:
        result.append(
            Remark("no_step", "the sensor moved, but no step was found: wrong detector or wrong mounting?")
        )
    result += verdict(s, p) if is_corrected else []
    position = s.pos
    if s.started and not (np.all(np.isfinite(position)) and np.all(np.abs(position) < 1e6)):
        result.append(Remark("diverged", f"the position ran away to {position} m", fatal=True))
    return result


FASTEST = 15.0
"""m/s: no foot swings faster, sprinters' apart."""
CLIPPED_SAMPLES = 5
LEAST_JUDGED = 10
"""Strides or stances, fewer of which prove nothing."""
SURPRISING = 0.3
"""Share of the stances outside what the filter expects of 999 in 1000 (good walks: below 0.2)."""
FEWEST_STEPS = 0.6
"""Steps to one swing, or swings to one step; a slow swing may turn twice (good walks: above 0.75; stairs: 0.63)."""
WAY_IN_STEPS = 1.5, 4.0
"""Way of the track to the sum of the steps (walks: 0.9 to 1.3): doubtful from the first on, lost from the second."""
BIAS_MOVED = 5.0, 10.0
"""Standard deviations of the rest's bias by which it may move: doubtful, and taken for something else."""
LEAST_BIAS_MOVED = 0.02
"""rad/s: no gyroscope's bias moves so far within a walk."""
UNSURE_M = 1.0
LEAST_CEILING = (15.0, 15.0, 15.0, 3.0, 3.0, 3.0)
"""m/s², rad/s: the same extreme value many times is a ceiling only beyond what a rest reaches."""


def verdict(s: Any, p: Any) -> list[Remark]:
    """Return what speaks against the results being a walk."""
    v, result = s.verdict, []
    if v.fastest > FASTEST:
        result.append(
            Remark(
                "implausible_speed",
                f"the foot reaches {v.fastest:.1f} m/s (a runner's: up to {FASTEST:g}): stances were missed; try "
                "detector=gait",
                fatal=True,
            )
        )
    if v.n_long_strides:
        share = v.n_long_strides / max(1, v.n_landings)
        result.append(
            Remark(
                "implausible_stride",
                f"{v.n_long_strides} of {v.n_landings} strides are longer than 4 m (longest "
                f"{v.longest_stride:.1f} m): stances were missed; try detector=gait",
                fatal=bool(share > 0.1),
            )
        )
    if v.lost_s > 0.0:
        share = v.lost_s / v.navigated_s
        result.append(
            Remark(
                "lost_stances",
                f"for {v.lost_s:.1f} s ({100 * share:.0f} % of the time) no stance was found within 5 s: the "
                "position drifts there",
                fatal=bool(share > 0.2),
            )
        )
    if v.n_landings >= 20 and v.n_landings > 3 * s.steps.count:
        result.append(
            Remark(
                "not_gait",
                f"{v.n_landings} stances make only {s.steps.count} steps: this is no walk, or the detector "
                f"{p.detector} breaks its stances; the position between them is doubtful",
            )
        )
    if v.carried_at > 0.0:
        result.append(
            Remark(
                "carried",
                f"at {v.carried_at:.1f} s the foot stood without turning, and ‖f‖ was off by {v.carried_by:.2f} "
                "m/s² for more than half a second: a lift, or another floor that moves; its way is not in the "
                "estimate (barometer=true measures the height)",
            )
        )
    result += _against_the_gait(s)
    result += _against_the_filter(s)
    return result + _clipped(s)


def _clipped(s: Any) -> list[Remark]:
    """Return which columns stand at their extreme, or flatten below it, and what was put back of a turn."""
    v, result = s.verdict, []
    swing_rows = max(1, s.taken - s.n_still)
    for i, column in enumerate(IMU_COLUMNS):
        for side, (value, count) in enumerate(
            ((s.highest[i], v.at_highest[i]), (s.lowest[i], v.at_lowest[i]))
        ):
            axis = s.ceiling.axes[i - 3] if i >= 3 else None
            turns = int(axis["count"][side]) if axis is not None else 0
            where = ""
            if count >= CLIPPED_SAMPLES and abs(value) > LEAST_CEILING[i]:
                share = f"{count / swing_rows:.1%} of those in swings"
                where = f"{column} stands at its extreme {value:.4g} in {count} rows ({share})"
            elif axis is not None and turns >= CLIPPED_SAMPLES:
                where = f"{column} flattens near {math.copysign(axis['level'][side], value):.3g} rad/s in {turns} turns"
            if not where:
                continue
            what = "turns and speeds in the swing are underestimated"
            if axis is not None and turns > 0:
                what = (
                    f"{axis['angle'][side]:.2f} rad of {turns} turns were put back from the slopes on both sides, "
                    "right to about 45 %"
                )
            result.append(
                Remark("clipped", f"{where}: the sensor's range is too small for this walk, {what}")
            )
    return result


def _against_the_gait(s: Any) -> list[Remark]:
    """Return what disagrees between steps, track and the swings that the gyroscope alone counts."""
    v, steps, result = s.verdict, int(s.steps.count), []
    if max(steps, v.swings) >= LEAST_JUDGED and min(steps, v.swings) < FEWEST_STEPS * max(steps, v.swings):
        result.append(
            Remark(
                "steps_against_swings",
                f"{steps} steps were found, but the gyroscope tells of {v.swings} swings: "
                f"{'stances were missed' if steps < v.swings else 'a stride was cut in pieces, or this is no walk'}",
            )
        )
    way = v.path_m / v.steps_m if v.steps_m > 0.0 else math.inf
    if v.path_m > 10.0 and way > WAY_IN_STEPS[0]:
        result.append(
            Remark(
                "path_against_steps",
                f"the track is {v.path_m:.1f} m long, the steps together {v.steps_m:.1f} m: it moves between the steps",
                fatal=bool(way > WAY_IN_STEPS[1]),
            )
        )
    return result


def _against_the_filter(s: Any) -> list[Remark]:
    """Return where the filter contradicts itself: innovations, bias, its own standard deviation."""
    v, result = s.verdict, []
    share = v.n_surprising / max(1, v.n_judged)
    if v.n_judged >= LEAST_JUDGED and share > SURPRISING:
        result.append(
            Remark(
                "inconsistent",
                f"in {v.n_surprising} of {v.n_judged} stances the velocity is farther from zero than the filter "
                f"expects of 999 in 1000: errors that it does not know of (scale, range, stances), and its standard "
                f"deviations are too small",
            )
        )
    moved = max(abs(s.bias_gyr[i] - v.first_bias[i]) for i in range(3))
    doubt = math.sqrt(max(s.rest.bias_variance, BIAS_CHANGE * BIAS_CHANGE))
    if moved > BIAS_MOVED[0] * doubt:
        # A rest of a fixed length does not say how well it knows the bias.
        fatal = s.rest.adaptive and moved > max(BIAS_MOVED[1] * doubt, LEAST_BIAS_MOVED)
        result.append(
            Remark(
                "bias_moved",
                f"the gyroscope's bias moved by {moved:.4f} rad/s, {moved / doubt:.0f} times what the rest leaves "
                f"open: other errors (scale, a range too small) are taken for it; foot.9iez estimates none",
                fatal=bool(fatal),
            )
        )
    if v.unsure_m > UNSURE_M:
        result.append(
            Remark(
                "unsure",
                f"the filter's own standard deviation of the horizontal position is {v.unsure_m:.1f} m at the end: "
                f"the rest says too little about the gyroscope's bias; stand still for longer",
            )
        )
    return result
