"""What the axes that were found say of the sensors' mounting: long axes, common sign, doubts."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ..contract import FloatArray, Remark
from ..numerics.compiled import compiled, inlined
from . import axisfit

NEAR = 0.7
"""Cosine (45°) between a found axis and the parameter's: beyond it the parameter says nothing of the sensor."""
SKEWED = 0.7
"""Skewness beyond which a knee's swings say which way it bends."""
GUESS_DEG = 30.0
"""How well the mean direction of gravity stands for a segment's long axis, standing or walking."""


@compiled
def long_axis(
    axis: FloatArray, given_axis: FloatArray, given_up: FloatArray, force: FloatArray, up: FloatArray
) -> bool:
    """Write a sensor's long axis, upwards, to ``up``; return whether it is guessed.

    Where the axis that was found lies far off the parameter's, this says nothing of the sensor: the mean force does, as
    if the segment were upright on average.

    Parameters
    ----------
    axis : ndarray, shape (3,)
        Flexion axis that was found.
    given_axis, given_up : ndarray, shape (3,)
        Flexion axis and long axis as the parameters say.
    force : ndarray, shape (3,)
        Mean specific force of the sensor.
    up : ndarray, shape (3,)
        Written.
    """
    cosine, along, size = 0.0, 0.0, 0.0
    for m in range(3):
        cosine += axis[m] * given_axis[m]
        along += force[m] * axis[m]
    guessed = abs(cosine) < NEAR
    least = 0
    for m in range(3):
        up[m] = force[m] - along * axis[m]
        size += up[m] ** 2
        if abs(axis[m]) < abs(axis[least]):
            least = m
    for m in range(3):
        if not guessed:
            up[m] = given_up[m]
        elif size > 1.0:
            up[m] /= math.sqrt(size)
        else:
            up[m] = 1.0 if m == least else 0.0
    return guessed


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

    A knee that walks swings far to one side of its mean (about 1.1 in flexion); without strides it says little.
    """
    wide = 8 * lag
    square, cube = 0.0, 0.0
    for k in range(count):
        first = max(0, k - wide)
        last = min(count - 1, k + wide)
        mean = 0.0
        for n in range(first, last + 1, lag):
            mean += turned(w, rows, n)
        e = turned(w, rows, k) - mean / ((last - first) // lag + 1)
        square += e * e
        cube += e * e * e
    square /= count
    return cube / count / max(1e-12, square * math.sqrt(square))


@compiled
def orient(s: Any, lag: int) -> None:
    """Set the long axes ``s.up`` (:func:`long_axis`), and the sign of axes that lie far off the given one."""
    s.skew = skewness(s, s.rows, s.kept, lag)
    far = 0.0
    for m in range(3):
        far += s.axis[0, m] * s.given_axis[0, m]
    if s.is_knee == 1 and abs(far) < NEAR and s.skew < -SKEWED:
        s.skew = -s.skew
        for i in range(2):
            for m in range(3):
                s.axis[i, m] = -s.axis[i, m]
    for i in range(2):
        for m in range(3):
            s.mean_force[m] = 0.0
            for k in range(s.kept):
                s.mean_force[m] += s.rows[k, axisfit.WIDTH * i + axisfit.ACC + m] / s.kept
        s.guessed[i] = 1 if long_axis(s.axis[i], s.given_axis[i], s.given_up[i], s.mean_force, s.up[i]) else 0


def mounting_remarks(s: Any, segments: tuple[str, ...]) -> list[Remark]:
    """Say where what was found contradicts ``axis`` and ``up``, or where these say nothing of the sensors."""
    guessed = [n for n, g in zip(segments, s["guessed"], strict=False) if g]
    if guessed:
        return [
            Remark(
                "mounting_guessed",
                f"{' and '.join(guessed)}: the axis found lies more than 45° off the parameter axis: zero and sign of "
                f"the angle are guesses (long axis ± {GUESS_DEG:.0f}°); give axis and up, or calibrate with a static "
                "span",
            )
        ]
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
