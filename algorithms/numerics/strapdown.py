"""Strapdown mechanization on a record with the fields of :data:`NAVIGATION`.

Frames: b sensor, n local level with z up, yaw 0 at the start. At rest the accelerometer reads +g upwards. A
sample ``r`` is any record with ``dt`` (s), ``acc`` (specific force in b, m/s²) and ``gyr`` (rad/s).

C ← C (2I + [ω]×Δt)(2I − [ω]×Δt)⁻¹ (foot-navigation dissertation, eqs 3.19–3.27). ``trapezoid`` (the authors'
program): f_n = ½(C_old + C) f, v += ½(a_old + a)Δt, p += ½(v_old + v)Δt with a = f_n + g; else Euler's rule
(the text): f_n = C f, v += aΔt, p += vΔt. Biases are subtracted from the measured rate and specific force.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .compiled import compiled, inlined
from .records import Fields
from .rotations import set_rpy, turn_body

FloatArray = NDArray[np.float64]

NAVIGATION: Fields = [
    ("rot", "f8", (3, 3)),  # rot_nb
    ("vel", "f8", (3,)),  # m/s, n
    ("pos", "f8", (3,)),  # m, n
    ("force", "f8", (3,)),  # specific force in n over the newest interval, m/s²
    ("acc_n", "f8", (3,)),  # acceleration in n at the newest sample, m/s²
    ("bias_gyr", "f8", (3,)),  # rad/s, b
    ("bias_acc", "f8", (3,)),  # m/s², b
    ("gravity", "f8"),  # m/s²
    ("trapezoid", "?"),
]


@compiled
def level(s: Any, acc: FloatArray, gyr: FloatArray, gravity: float) -> None:
    """Start at rest at the origin: roll and pitch from the mean specific force, bias = mean rate.

    roll = atan2(ay, az), pitch = atan2(−ax, √(ay² + az²)): any mounting is levelled, upside down too.
    """
    x, y, z = acc[0], acc[1], acc[2]
    set_rpy(s.rot, math.atan2(y, z), math.atan2(-x, math.sqrt(y * y + z * z)), 0.0)
    s.gravity = gravity
    for i in range(3):
        s.vel[i] = 0.0
        s.pos[i] = 0.0
        s.bias_gyr[i] = gyr[i]
        s.bias_acc[i] = 0.0
        s.force[i] = s.rot[i, 0] * x + s.rot[i, 1] * y + s.rot[i, 2] * z
        s.acc_n[i] = s.force[i]
    s.acc_n[2] -= gravity


@inlined
def turn(s: Any, r: Any) -> None:
    """Turn the attitude by the sample ``r``."""
    turn_body(
        s.rot,
        (r.gyr[0] - s.bias_gyr[0]) * r.dt,
        (r.gyr[1] - s.bias_gyr[1]) * r.dt,
        (r.gyr[2] - s.bias_gyr[2]) * r.dt,
    )


@inlined
def resolve(s: Any, r: Any) -> None:
    """Write the bias-free specific force of the sample ``r``, by the present attitude, to ``s.force``."""
    x, y, z = r.acc[0] - s.bias_acc[0], r.acc[1] - s.bias_acc[1], r.acc[2] - s.bias_acc[2]
    for i in range(3):
        s.force[i] = s.rot[i, 0] * x + s.rot[i, 1] * y + s.rot[i, 2] * z


@inlined
def move(s: Any, dt: float) -> None:
    """Integrate velocity and position by the specific force in ``s.force``."""
    for i in range(3):
        a = s.force[i]
        if i == 2:
            a -= s.gravity
        v = s.vel[i]
        if s.trapezoid:
            s.vel[i] = v + 0.5 * (s.acc_n[i] + a) * dt
            s.pos[i] += 0.5 * (v + s.vel[i]) * dt
        else:
            s.vel[i] = v + a * dt
            s.pos[i] += s.vel[i] * dt
        s.acc_n[i] = a


@inlined
def average_force(s: Any, x: float, y: float, z: float) -> None:
    """Replace ``s.force`` by its mean with (x, y, z), the force resolved before the turn (trapezoid only)."""
    if s.trapezoid:
        s.force[0] = 0.5 * (s.force[0] + x)
        s.force[1] = 0.5 * (s.force[1] + y)
        s.force[2] = 0.5 * (s.force[2] + z)


@inlined
def advance(s: Any, r: Any) -> None:
    """Carry attitude, velocity and position over the time step of the sample ``r``."""
    resolve(s, r)
    x, y, z = s.force[0], s.force[1], s.force[2]
    turn(s, r)
    resolve(s, r)
    average_force(s, x, y, z)
    move(s, r.dt)
