"""Strapdown mechanization and the rest from which it starts, over the packed state of a foot estimator.

Frames: b sensor, n local level with z up, yaw 0 at the start. At rest the accelerometer reads +g upwards.

Rest initialisation (dissertation, section 3.6): gyroscope bias = mean rate; roll = atan2(ay, az),
pitch = atan2(−ax, √(ay² + az²)) of the mean specific force, so any mounting is levelled, upside down too.
The rest is verified, not assumed: it is the first stretch of ``init_s`` in which every sample stays within
``rest_acc`` and ``rest_gyr`` of the running mean, and whose mean rate is small enough to be a bias.

Mechanization (eqs 3.19–3.27): C ← C (2I + [ω]×Δt)(2I − [ω]×Δt)⁻¹. ``trapezoid`` (the authors' program):
f_n = ½(C_old + C) f, v += ½(a_old + a)Δt, p += ½(v_old + v)Δt with a = f_n + g; ``euler`` (the text): f_n =
C f, v += aΔt, p += vΔt. Biases are subtracted from the measured rate and specific force.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..numerics.compiled import compiled, inlined
from ..numerics.rotations import rot_from_rpy, turn_body
from .layout import (
    ACC_N,
    ACC_OLD,
    BIAS_ACC,
    BIAS_GYR,
    GRAVITY,
    GRAVITY_FROM_REST,
    GRAVITY_PARAM,
    INIT_INDEX,
    INIT_MEAN,
    INIT_S,
    INIT_START,
    MOVED,
    POS,
    R_ACC,
    R_DT,
    R_GYR,
    REST_ACC,
    REST_BEST,
    REST_BIAS,
    REST_COUNT,
    REST_ELAPSED,
    REST_GYR,
    REST_MEAN,
    REST_SPREAD,
    REST_START,
    ROT,
    TIME,
    TRAPEZOID,
    VEL,
)

FloatArray = NDArray[np.float64]
LONGEST_PAUSE_S = 0.5
"""A longer time step interrupts a rest: nothing is known about what happened in it."""


@inlined
def _distance(s: FloatArray, a: int, b: int) -> float:
    x, y, z = s[a] - s[b], s[a + 1] - s[b + 1], s[a + 2] - s[b + 2]
    return math.sqrt(x * x + y * y + z * z)


@inlined
def watch_rest(s: FloatArray, r: int, k: int) -> bool:
    """Take sample ``k`` (record at ``r``) into the search for a rest; return True at the sample that
    completes it.
    """
    if s[INIT_INDEX] >= 0.0:
        if (
            _distance(s, r + R_ACC, INIT_MEAN) > s[REST_ACC]
            or _distance(s, r + R_GYR, INIT_MEAN + 3) > s[REST_GYR]
        ):
            s[MOVED] += 1.0
        return False
    dt = s[r + R_DT]
    if s[REST_COUNT] > 0.0 and (
        dt > LONGEST_PAUSE_S
        or _distance(s, r + R_ACC, REST_MEAN) > s[REST_ACC]
        or _distance(s, r + R_GYR, REST_MEAN + 3) > s[REST_GYR]
    ):
        s[REST_COUNT] = 0.0
    if s[REST_COUNT] == 0.0:
        s[REST_START] = s[TIME]
        s[REST_ELAPSED] = 0.0
        s[REST_SPREAD] = 0.0
        for i in range(6):
            s[REST_MEAN + i] = 0.0
        dt = 0.0
    s[REST_COUNT] += 1.0
    s[REST_ELAPSED] += dt
    for i in range(6):
        s[REST_MEAN + i] += (s[r + R_ACC + i] - s[REST_MEAN + i]) / s[REST_COUNT]
    spread = _distance(s, r + R_GYR, REST_MEAN + 3)
    s[REST_SPREAD] += spread * spread
    s[REST_BEST] = max(s[REST_BEST], s[REST_ELAPSED])
    # Half a nanosecond of grace: time steps are rounded differences.
    if s[REST_ELAPSED] + 5e-10 < s[INIT_S]:
        return False
    x, y, z = s[REST_MEAN + 3], s[REST_MEAN + 4], s[REST_MEAN + 5]
    if math.sqrt(x * x + y * y + z * z) > s[REST_BIAS]:
        s[REST_COUNT] = 0.0  # a steady turn, not a rest
        return False
    s[INIT_INDEX] = k
    s[INIT_START] = s[REST_START]
    for i in range(6):
        s[INIT_MEAN + i] = s[REST_MEAN + i]
    return True


@compiled
def start(s: FloatArray) -> None:
    """Level the rotation by the rest, zero velocity and position, take over bias and gravity."""
    x, y, z = s[INIT_MEAN], s[INIT_MEAN + 1], s[INIT_MEAN + 2]
    rot_from_rpy(s, ROT, math.atan2(y, z), math.atan2(-x, math.sqrt(y * y + z * z)), 0.0)
    s[GRAVITY] = math.sqrt(x * x + y * y + z * z) if s[GRAVITY_FROM_REST] > 0.5 else s[GRAVITY_PARAM]
    for i in range(3):
        s[VEL + i] = 0.0
        s[POS + i] = 0.0
        s[BIAS_GYR + i] = s[INIT_MEAN + 3 + i]
        s[BIAS_ACC + i] = 0.0
        s[ACC_N + i] = s[ROT + 3 * i] * x + s[ROT + 3 * i + 1] * y + s[ROT + 3 * i + 2] * z
        s[ACC_OLD + i] = s[ACC_N + i]
    s[ACC_OLD + 2] -= s[GRAVITY]


@inlined
def turn(s: FloatArray, r: int) -> None:
    """Turn the attitude by the sample at ``r``."""
    dt = s[r + R_DT]
    turn_body(
        s,
        ROT,
        (s[r + R_GYR] - s[BIAS_GYR]) * dt,
        (s[r + R_GYR + 1] - s[BIAS_GYR + 1]) * dt,
        (s[r + R_GYR + 2] - s[BIAS_GYR + 2]) * dt,
    )


@inlined
def resolve(s: FloatArray, r: int) -> None:
    """Write the bias-free specific force of the sample at ``r``, by the present attitude, to ``ACC_N``."""
    x = s[r + R_ACC] - s[BIAS_ACC]
    y = s[r + R_ACC + 1] - s[BIAS_ACC + 1]
    z = s[r + R_ACC + 2] - s[BIAS_ACC + 2]
    for i in range(3):
        s[ACC_N + i] = s[ROT + 3 * i] * x + s[ROT + 3 * i + 1] * y + s[ROT + 3 * i + 2] * z


@inlined
def move(s: FloatArray, dt: float) -> None:
    """Integrate velocity and position by the specific force in ``ACC_N``."""
    for i in range(3):
        a = s[ACC_N + i]
        if i == 2:
            a -= s[GRAVITY]
        v = s[VEL + i]
        if s[TRAPEZOID] > 0.5:
            s[VEL + i] = v + 0.5 * (s[ACC_OLD + i] + a) * dt
            s[POS + i] += 0.5 * (v + s[VEL + i]) * dt
        else:
            s[VEL + i] = v + a * dt
            s[POS + i] += s[VEL + i] * dt
        s[ACC_OLD + i] = a


@inlined
def average_force(s: FloatArray, x: float, y: float, z: float) -> None:
    """Replace ``ACC_N`` by its mean with (x, y, z), the force resolved before the turn (trapezoid only)."""
    if s[TRAPEZOID] > 0.5:
        s[ACC_N] = 0.5 * (s[ACC_N] + x)
        s[ACC_N + 1] = 0.5 * (s[ACC_N + 1] + y)
        s[ACC_N + 2] = 0.5 * (s[ACC_N + 2] + z)


@inlined
def advance(s: FloatArray, r: int) -> None:
    """Carry attitude, velocity and position over the time step of the sample at ``r``."""
    resolve(s, r)
    x, y, z = s[ACC_N], s[ACC_N + 1], s[ACC_N + 2]
    turn(s, r)
    resolve(s, r)
    average_force(s, x, y, z)
    move(s, s[r + R_DT])
