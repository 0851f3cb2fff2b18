"""What the axes that were found say of the sensors' mounting: long axes, common sign, doubts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..contract import FloatArray, Remark
from ..numerics import rotations
from ..numerics.compiled import compiled, inlined
from ..numerics.records import record_type
from . import axisfit, hingefit

NEAR = 0.7
"""Cosine (45°) between a found axis and the parameter's: beyond it the parameter says nothing of the sensor."""
SKEWED = 0.7
"""Skewness beyond which a knee's swings say which way it bends."""
GUESS_DEG = 30.0
"""How well the mean direction of gravity stands for a segment's long axis, standing or walking."""
BODY_DEG = 10.0
"""How well, a segment, a body's most extended posture is straight: no knee bends backward; a crouch gait has 20°."""
ALIKE, OFTEN = 0.87, 0.25
"""A long axis that is not stated is the convention's where the force is so near it (cosine, 30°) so often (share)."""
MAINLY = 0.8
"""Share of a sensor's squared rate about the convention's flexion axis above which it is taken where none is found."""
QUIET_RATE, QUIET_FORCE = 1.0, 0.1
"""Rates (rad/s) and share of gravity by which the force differs from it, up to which a force shows the vertical."""
PLACED = 0.4
"""Standard deviation of the joint's position over its distance above which it says nothing of the long axis."""
BINS = 72
"""Bins of the joint's angle, a turn."""
ENDS = 0.05
"""Share of the samples beyond each end of the joint's range."""
UPRIGHT, LEAST_QUIET = 0.3, 30
"""By so much the cosine of the upper segment to the vertical must differ between the ends of the joint's range, for the
lever points 20 to 30° off the long axis; fewest quiet samples."""
STATED, SWINGS, NOTHING, POSE = 0, 1, 2, 3
SIGNS = ("stated", "swings", "nothing", "pose")
"""What the sign of the axes is by."""

FIELDS: list[Any] = [
    ("given_axis", "f8", (2, 3)),
    ("given_up", "f8", (2, 3)),
    ("stated", "i8", (2,)),  # whether the user, the recording or a calibration says the flexion axis
    ("up_stated", "i8", (2,)),
    ("up", "f8", (2, 3)),  # the long axis of the segment in each sensor's frame
    ("guessed", "i8", (2,)),  # how the long axis is known: 0 stated, 1 guessed, 2 not at all
    ("mean_force", "f8", (3,)),
    ("pose", "f8"),  # sign of the bend by the upright pose: of angles against it; 0 where there is none
    ("swings", "f8", (BINS,)),  # samples by the joint's turn about its running mean
    ("quiet", "f8", (BINS,)),  # quiet samples by the joint's angle
    ("upright", "f8", (BINS,)),  # the sums of their upper segment's cosine to the vertical
    ("pose_up", "f8", (2, 3)),  # vertical in both sensors' frames in that pose, not normalized
    ("below", "f8", (2,)),  # 1 where the sensor sits above the joint, −1 below, 0 where that says nothing
    ("is_knee", "i8"),
    ("skew", "f8"),  # of the joint's swings
    ("sign_by", "i8"),
    # Share of each sensor's squared rate about the axis of the parameters; 1: axes are known.
    ("about", "f8", (2,)),
]
"""Fields of a packed record, beside those of :mod:`.axisfit`."""

RECORD = record_type(
    ("axis", "f8", (2, 3)), ("pos", "f8", (2, 3)), ("upper_sd", "f8"), ("gravity", "f8"), *FIELDS
)
"""What :func:`orient` reads and writes."""


@compiled
def force_across(s: Any, rows: FloatArray, count: int, i: int) -> float:
    """Write the mean force across the axis to ``s.mean_force``; return how often it is near ``s.given_up`` (share)."""
    often = 0
    for m in range(3):
        s.mean_force[m] = 0.0
    for k in range(count):
        f = rows[k, axisfit.WIDTH * i + axisfit.ACC : axisfit.WIDTH * i + axisfit.ACC + 3]
        along = f[0] * s.axis[i, 0] + f[1] * s.axis[i, 1] + f[2] * s.axis[i, 2]
        size, near = 1e-9, 0.0
        for m in range(3):
            across = f[m] - along * s.axis[i, m]
            size += across * across
            near += across * s.given_up[i, m]
            s.mean_force[m] += across / count
        often += 1 if near > ALIKE * math.sqrt(size) else 0
    return often / count


@compiled
def lean(s: Any, rows: FloatArray, k: int, i: int) -> float:
    """Return the angle of sensor ``i``'s lever to the vertical, about the axis; NaN where the sample is not quiet.

    The lever, made upward, stands for the long axis: the thigh's sensor sits above the knee, the shank's below.
    """
    g = rows[k, axisfit.WIDTH * i + axisfit.GYR : axisfit.WIDTH * i + axisfit.GYR + 3]
    f = rows[k, axisfit.WIDTH * i + axisfit.ACC : axisfit.WIDTH * i + axisfit.ACC + 3]
    j, upward = s.axis[i], 1.0 if i == 0 else -1.0
    size = math.sqrt(f[0] * f[0] + f[1] * f[1] + f[2] * f[2])
    rate = g[0] * g[0] + g[1] * g[1] + g[2] * g[2]
    if rate > QUIET_RATE * QUIET_RATE or abs(size - s.gravity) > QUIET_FORCE * s.gravity:
        return math.nan
    force_along, lever_along = 0.0, 0.0
    for m in range(3):
        force_along += f[m] * j[m]
        lever_along += s.pos[i, m] * j[m]
    across, dot = 0.0, 0.0
    for m in range(3):
        n, o = (m + 1) % 3, (m + 2) % 3
        dot += (s.pos[i, m] - lever_along * j[m]) * (f[m] - force_along * j[m])
        across += j[m] * (f[n] * s.pos[i, o] - f[o] * s.pos[i, n])
    return math.atan2(upward * across, upward * dot)


@inlined
def bin_of(angle: float) -> int:
    """Return the bin of an angle, whole turns left out."""
    return min(BINS - 1, int((rotations.near(angle, 0.0) + math.pi) / (2.0 * math.pi) * BINS))


@compiled
def find_pose(s: Any, rows: FloatArray, count: int) -> None:
    """Write to ``s.pose`` which way a knee bends from its upright pose, to ``s.pose_up`` the vertical in that pose.

    In standing the lever from the knee's centre to the thigh's sensor is upright, in sitting or squatting it is not,
    and a knee bends one way only from there. Of the two ends of the joint's range among quiet samples that with the
    more upright thigh is that pose; where they differ little (walking) nothing is said. The shank hardly turns, so its
    lever is hardly known: it only counts the joint's angle.
    """
    s.pose = 0.0
    for i in range(2):
        size = math.sqrt(s.pos[i, 0] ** 2 + s.pos[i, 1] ** 2 + s.pos[i, 2] ** 2)
        if size < 0.05 or (i == 0 and s.upper_sd > PLACED * size):
            return
    for b in range(BINS):
        s.quiet[b], s.upright[b] = 0.0, 0.0
    total = 0.0
    for k in range(count):
        upper, lower = lean(s, rows, k, 0), lean(s, rows, k, 1)
        if math.isfinite(upper) and math.isfinite(lower):
            b = bin_of(upper - lower)
            s.quiet[b] += 1.0
            s.upright[b] += math.cos(upper)
            total += 1.0
    if total < LEAST_QUIET:
        return
    low, high = int(end_of(s.quiet, ENDS)), min(BINS - 1, int(end_of(s.quiet, 1.0 - ENDS)))
    apart = upright_near(s, low) - upright_near(s, high)
    if abs(apart) < UPRIGHT:
        return
    s.pose = 1.0 if apart > 0.0 else -1.0
    straight = low if apart > 0.0 else high
    for i in range(2):
        for m in range(3):
            s.pose_up[i, m] = 0.0
    for k in range(count):
        upper, lower = lean(s, rows, k, 0), lean(s, rows, k, 1)
        quiet = math.isfinite(upper) and math.isfinite(lower)
        if quiet and abs(bin_of(upper - lower) - straight) <= 2:
            for i in range(2):
                for m in range(3):
                    s.pose_up[i, m] += rows[k, axisfit.WIDTH * i + axisfit.ACC + m]


@compiled
def end_of(counts: FloatArray, share: float) -> float:
    """Return where in a histogram (bins,), in bins, ``share`` of the samples lies below."""
    wanted, below = share * counts.sum(), 0.0
    for b in range(counts.shape[0]):
        if counts[b] > 0.0 and below + counts[b] >= wanted:
            return b + (wanted - below) / counts[b]
        below += counts[b]
    return float(counts.shape[0])


@compiled
def upright_near(s: Any, b: int) -> float:
    """Return the mean cosine of the upper segment to the vertical in bin ``b`` and its neighbours."""
    total, weight = 0.0, 0.0
    for c in range(max(0, b - 2), min(BINS, b + 3)):
        total += s.upright[c]
        weight += s.quiet[c]
    return total / weight


@compiled
def set_long_axes(s: Any, rows: FloatArray, count: int) -> None:
    """Write the long axes, upwards, to ``s.up`` and whether they are guessed to ``s.guessed``.

    What is stated is taken. Where the axis that was found lies far off the stated one, or nothing is stated and the
    sensors contradict the convention, the force in the upright pose stands for it, or else the mean force, as if the
    segment were upright on average.
    """
    for i in range(2):
        near, beside = 0.0, 0.0
        for m in range(3):
            near += s.axis[i, m] * s.given_axis[i, m]
            beside += s.axis[i, m] * s.given_up[i, m]
        often = force_across(s, rows, count, i)
        usual = abs(near) > NEAR and (s.stated[i] == 1 or often > OFTEN)
        s.guessed[i] = 0 if (abs(beside) < 0.9 if s.up_stated[i] == 1 else usual) else 1
        size, least = 0.0, 0
        for m in range(3):
            s.up[i, m] = s.pose_up[i, m] if s.pose != 0.0 else s.mean_force[m]
            size += s.up[i, m] ** 2
            if abs(s.axis[i, m]) < abs(s.axis[i, least]):
                least = m
        for m in range(3):
            if size > 1.0:
                s.up[i, m] /= math.sqrt(size)
            else:
                s.up[i, m] = 1.0 if m == least else 0.0
    # One sensor that happens to lie by the convention beside one that does not proves nothing.
    if s.guessed[0] == 1 or s.guessed[1] == 1:
        for i in range(2):
            if s.stated[i] == 0 and s.up_stated[i] == 0:
                s.guessed[i] = 1
    for i in range(2):
        if s.guessed[i] == 0:
            for m in range(3):
                s.up[i, m] = s.given_up[i, m]


@inlined
def turned(w: Any, rows: FloatArray, k: int) -> float:
    """Return the relative turn about the axes (eq 73) at sample ``k``."""
    turn = 0.0
    for m in range(3):
        turn += (
            rows[k, axisfit.SUM + m] * w.axis[0, m] - rows[k, axisfit.WIDTH + axisfit.SUM + m] * w.axis[1, m]
        )
    return turn


@compiled
def skewness(w: Any, rows: FloatArray, count: int, lag: int) -> float:
    """Return the skewness of the joint's turn about its running mean over ∓ 8 ``lag`` samples.

    A knee that walks swings far to one side of its mean (about 1.1 in flexion); without strides it says little. Also
    counts the turns in ``w.swings``.
    """
    wide = 8 * lag
    square, cube = 0.0, 0.0
    for b in range(BINS):
        w.swings[b] = 0.0
    for k in range(count):
        first = max(0, k - wide)
        last = min(count - 1, k + wide)
        mean = 0.0
        for n in range(first, last + 1, lag):
            mean += turned(w, rows, n)
        e = turned(w, rows, k) - mean / ((last - first) // lag + 1)
        w.swings[bin_of(e)] += 1.0
        square += e * e
        cube += e * e * e
    square /= count
    return cube / count / max(1e-12, square * math.sqrt(square))


@compiled
def orient(s: Any, rows: FloatArray, count: int, lag: int) -> None:
    """Set the common sign of the axes ``s.axis`` and what it is by, and the long axes ``s.up``.

    A stated axis decides. Where none is stated a walking knee's swings do, or the side to which a knee bends from its
    upright pose; else the sign is not known.
    """
    s.skew = skewness(s, rows, count, lag)
    s.pose = 0.0
    if s.is_knee == 1:
        find_pose(s, rows, count)
    s.about[0], s.about[1] = 1.0, 1.0
    near, default = 0.0, 0.0
    for i in range(2):
        dot = 0.0
        for m in range(3):
            dot += s.axis[i, m] * s.given_axis[i, m]
        if s.stated[i] == 1 and abs(dot) > abs(near):
            near = dot
        if i == 0:
            default = dot
    shown, by = default, NOTHING
    bends, bends_by = s.pose, POSE
    if s.is_knee == 1 and abs(s.skew) > SKEWED:
        bends, bends_by = s.skew, SWINGS
    if near != 0.0:
        # Far off the stated axis its sign is taken, but believed only where the knee says the same.
        shown, by = near, STATED if abs(near) > NEAR or near * bends > 0.0 else NOTHING
    elif bends != 0.0:
        shown, by = bends, bends_by
    s.sign_by = by
    if shown < 0.0:
        s.skew = -s.skew
        for b in range(BINS // 2):
            s.swings[b], s.swings[BINS - 1 - b] = s.swings[BINS - 1 - b], s.swings[b]
        for i in range(2):
            for m in range(3):
                s.axis[i, m] = -s.axis[i, m]
    set_long_axes(s, rows, count)
    if by == SWINGS and s.guessed[0] == 1 and s.guessed[1] == 1:
        extend(s)


@compiled
def extend(s: Any) -> None:
    """Turn the lower long axis so that a walking knee's most extended posture is zero.

    The mean forces alone made zero the mean posture, which is flexed by some 20°.
    """
    flexed = math.pi - 2.0 * math.pi / BINS * end_of(s.swings, ENDS)  # of the mean, against the extended end
    j, up = s.axis[1], s.up[1]
    c, t = math.cos(flexed), math.sin(flexed)
    x = c * up[0] - t * (j[1] * up[2] - j[2] * up[1])
    y = c * up[1] - t * (j[2] * up[0] - j[0] * up[2])
    z = c * up[2] - t * (j[0] * up[1] - j[1] * up[0])
    up[0], up[1], up[2] = x, y, z


@compiled
def suppose(s: Any, rows: FloatArray, count: int, lag: int) -> None:
    """Judge the axes of the parameters, in ``s.axis``, where none can be found.

    Stated ones are taken, and ``s.about`` says how much each sensor turns about them. Others are where both sensors
    turn mainly about them and gravity lies as by the convention; else the mounting is not known (``s.guessed`` 2).
    """
    stated = s.stated[0] == 1 and s.stated[1] == 1
    if stated:
        for i in range(2):
            s.guessed[i] = 0
            for m in range(3):
                s.up[i, m] = s.given_up[i, m]
    else:
        orient(s, rows, count, lag)
    usual = s.guessed[0] == 0 and s.guessed[1] == 0
    for i in range(2):
        about, total = 0.0, 1e-9
        for k in range(count):
            along = 0.0
            for m in range(3):
                rate = rows[k, axisfit.WIDTH * i + axisfit.GYR + m]
                along += rate * s.axis[i, m]
                total += rate * rate
            about += along * along
        s.about[i] = about / total if total > count * hingefit.STILL_RATE**2 else 1.0
        usual = usual and (s.stated[i] == 1 or s.about[i] > MAINLY)
    if not usual and not stated:
        s.guessed[0], s.guessed[1] = 2, 2


FAR, UNSTATED = "the axis found lies more than 45° off the stated one", "axis is not stated"


@inlined
def guess_deg(sign_by: int, both: bool) -> float:
    """Return how well a guessed long axis is known, by what the sign is by and whether both are guessed."""
    return BODY_DEG if both and sign_by in (SWINGS, POSE) else GUESS_DEG


def guess_remarks(s: Any, segments: Sequence[str], fatal: bool = False) -> list[Remark]:
    """Say what of the mounting is guessed, and by what; ``fatal`` where the stated uncertainty does not hold it."""
    guessed = [n for n, g in zip(segments, s["guessed"], strict=False) if g]
    by = int(s["sign_by"])
    why = FAR if any(s["stated"]) else UNSTATED
    if by == NOTHING:
        return [
            Remark(
                "sign_unknown",
                f"{' and '.join(segments[:2])}: {why}, and nothing measured says which way the joint bends: its angle "
                "may have the wrong sign; give axis"
                + (
                    " and up: the long axes are guesses too"
                    if guessed
                    else " (the stated uncertainty holds both)"
                ),
                fatal=fatal or bool(guessed),
            )
        ]
    if guessed:
        return [
            Remark(
                "mounting_guessed",
                f"{' and '.join(guessed)}: {why}: the long axis is a guess (± {guess_deg(by, len(guessed) > 1):.0f}°)"
                + {
                    SWINGS: ", the sign of the knee that of its swings, zero their straight end "
                    f"(skewness {s['skew']:.1f})",
                    POSE: ", the sign of the knee that of its bend from the upright pose, which is zero",
                }.get(by, "")
                + "; give axis and up, or calibrate with a static span",
                fatal=fatal,
            )
        ]
    return []


def mounting_remarks(s: Any, segments: tuple[str, ...], fatal: bool = False) -> list[Remark]:
    """Say where what was found contradicts ``axis`` and ``up``, or where these say nothing of the sensors.

    ``fatal`` where the stated uncertainty does not hold what is guessed.
    """
    remarks = guess_remarks(s, segments, fatal)
    if remarks:
        return remarks
    # Share of the long axis in the direction from the joint's centre, + where the sensor sits on the right side.
    sides = [
        side * float(o @ up) / max(1e-9, float(np.linalg.norm(o)))
        for side, o, up in zip(s["below"], s["pos"], s["up"], strict=True)
    ]
    far = bool(np.linalg.norm(s["pos"], axis=1).min() > 0.05 and s["pos_sd"] < 0.03 and s["below"].all())
    if far and max(sides) < -0.5:
        return [
            Remark(
                "segments_doubtful",
                f"the joint lies above the sensor of the {segments[0]} and below that of the {segments[1]}: "
                "the segments are swapped, or up is wrong for both",
            )
        ]
    if far and min(sides) < -0.5:
        wrong = segments[int(np.argmin(sides))]
        return [
            Remark(
                "mounting_doubtful",
                f"the joint lies on the wrong side of the {wrong}'s sensor: it is upside down, or up is wrong",
            )
        ]
    if s["is_knee"] and s["skew"] < -SKEWED:
        return [
            Remark(
                "sign_doubtful",
                f"the knee swings backward (skewness {s['skew']:.1f}; a walking knee has about 1): the sign of axis is "
                "wrong, or the segments are swapped",
            )
        ]
    return []
