"""Rotations as numba kernels on stretches of a packed buffer.

``rot_nb`` takes coordinates from the body frame b to the navigation frame n and lies row by row in nine
consecutive entries. Quaternions are ``wxyz``, Hamilton, of the same rotation. Angles: ``C = Rz(yaw)
Ry(pitch) Rx(roll)``.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from .compiled import compiled, inlined

FloatArray = NDArray[np.float64]


@compiled
def rot_from_rpy(s: FloatArray, at: int, roll: float, pitch: float, yaw: float) -> None:
    """Write ``Rz(yaw) Ry(pitch) Rx(roll)`` (rad) to ``s[at:at+9]``."""
    cr, sr = math.cos(roll), math.sin(roll)
    cp, sp = math.cos(pitch), math.sin(pitch)
    cy, sy = math.cos(yaw), math.sin(yaw)
    s[at] = cy * cp
    s[at + 1] = cy * sp * sr - sy * cr
    s[at + 2] = cy * sp * cr + sy * sr
    s[at + 3] = sy * cp
    s[at + 4] = sy * sp * sr + cy * cr
    s[at + 5] = sy * sp * cr - cy * sr
    s[at + 6] = -sp
    s[at + 7] = cp * sr
    s[at + 8] = cp * cr


@inlined
def quat_from_rot(s: FloatArray, at: int, out: FloatArray, to: int) -> None:
    """Write the unit quaternion (wxyz, w ≥ 0) of the rotation at ``s[at:at+9]`` to ``out[to:to+4]``.

    Shepperd's method: the largest of the four components is the divisor, so no rotation loses digits.
    """
    a, b, c = s[at], s[at + 4], s[at + 8]
    trace = a + b + c
    if trace > a and trace > b and trace > c:
        w = 1.0 + trace
        x = s[at + 7] - s[at + 5]
        y = s[at + 2] - s[at + 6]
        z = s[at + 3] - s[at + 1]
    elif a > b and a > c:
        w = s[at + 7] - s[at + 5]
        x = 1.0 + a - b - c
        y = s[at + 1] + s[at + 3]
        z = s[at + 2] + s[at + 6]
    elif b > c:
        w = s[at + 2] - s[at + 6]
        x = s[at + 1] + s[at + 3]
        y = 1.0 - a + b - c
        z = s[at + 5] + s[at + 7]
    else:
        w = s[at + 3] - s[at + 1]
        x = s[at + 2] + s[at + 6]
        y = s[at + 5] + s[at + 7]
        z = 1.0 - a - b + c
    scale = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)
    if w < 0.0:
        scale = -scale
    out[to] = w * scale
    out[to + 1] = x * scale
    out[to + 2] = y * scale
    out[to + 3] = z * scale


@inlined
def rot_from_quat(q: FloatArray, at: int, s: FloatArray, to: int) -> None:
    """Write the rotation of the unit quaternion (wxyz) at ``q[at:at+4]`` to ``s[to:to+9]``."""
    w, x, y, z = q[at], q[at + 1], q[at + 2], q[at + 3]
    s[to] = 1.0 - 2.0 * (y * y + z * z)
    s[to + 1] = 2.0 * (x * y - w * z)
    s[to + 2] = 2.0 * (x * z + w * y)
    s[to + 3] = 2.0 * (x * y + w * z)
    s[to + 4] = 1.0 - 2.0 * (x * x + z * z)
    s[to + 5] = 2.0 * (y * z - w * x)
    s[to + 6] = 2.0 * (x * z - w * y)
    s[to + 7] = 2.0 * (y * z + w * x)
    s[to + 8] = 1.0 - 2.0 * (x * x + y * y)


@inlined
def turn_body(s: FloatArray, at: int, x: float, y: float, z: float) -> None:
    """Multiply the rotation at ``s[at:at+9]`` from the right by ``(2I + [θ]×)(2I − [θ]×)⁻¹``, θ = (x, y, z)
    in rad.

    The Padé form of ``exp([θ]×)`` is Cayley's transform: with a = θ/2 it equals ``I + 2([a]× + [a]×²)/(1 +
    a·a)``, which is exactly orthonormal.
    """
    a, b, c = 0.5 * x, 0.5 * y, 0.5 * z
    k = 2.0 / (1.0 + a * a + b * b + c * c)
    m00 = 1.0 - k * (b * b + c * c)
    m01 = k * (a * b - c)
    m02 = k * (a * c + b)
    m10 = k * (a * b + c)
    m11 = 1.0 - k * (a * a + c * c)
    m12 = k * (b * c - a)
    m20 = k * (a * c - b)
    m21 = k * (b * c + a)
    m22 = 1.0 - k * (a * a + b * b)
    for i in range(at, at + 9, 3):
        u, v, w = s[i], s[i + 1], s[i + 2]
        s[i] = u * m00 + v * m10 + w * m20
        s[i + 1] = u * m01 + v * m11 + w * m21
        s[i + 2] = u * m02 + v * m12 + w * m22


@inlined
def turn_nav(s: FloatArray, at: int, x: float, y: float, z: float) -> None:
    """Multiply the rotation at ``s[at:at+9]`` from the left by ``(2I + [θ]×)(2I − [θ]×)⁻¹``, θ = (x, y, z)
    in rad.
    """
    a, b, c = 0.5 * x, 0.5 * y, 0.5 * z
    k = 2.0 / (1.0 + a * a + b * b + c * c)
    m00 = 1.0 - k * (b * b + c * c)
    m01 = k * (a * b - c)
    m02 = k * (a * c + b)
    m10 = k * (a * b + c)
    m11 = 1.0 - k * (a * a + c * c)
    m12 = k * (b * c - a)
    m20 = k * (a * c - b)
    m21 = k * (b * c + a)
    m22 = 1.0 - k * (a * a + b * b)
    for j in range(at, at + 3):
        u, v, w = s[j], s[j + 3], s[j + 6]
        s[j] = m00 * u + m01 * v + m02 * w
        s[j + 3] = m10 * u + m11 * v + m12 * w
        s[j + 6] = m20 * u + m21 * v + m22 * w


@inlined
def orthonormalize(s: FloatArray, at: int) -> None:
    """Take rounding out of a rotation: ``C ← C (3I − CᵀC)/2``, the symmetric correction to first order."""
    c00, c01, c02 = s[at], s[at + 1], s[at + 2]
    c10, c11, c12 = s[at + 3], s[at + 4], s[at + 5]
    c20, c21, c22 = s[at + 6], s[at + 7], s[at + 8]
    m00 = 1.5 - 0.5 * (c00 * c00 + c10 * c10 + c20 * c20)
    m11 = 1.5 - 0.5 * (c01 * c01 + c11 * c11 + c21 * c21)
    m22 = 1.5 - 0.5 * (c02 * c02 + c12 * c12 + c22 * c22)
    m01 = -0.5 * (c00 * c01 + c10 * c11 + c20 * c21)
    m02 = -0.5 * (c00 * c02 + c10 * c12 + c20 * c22)
    m12 = -0.5 * (c01 * c02 + c11 * c12 + c21 * c22)
    for i in range(at, at + 9, 3):
        u, v, w = s[i], s[i + 1], s[i + 2]
        s[i] = u * m00 + v * m01 + w * m02
        s[i + 1] = u * m01 + v * m11 + w * m12
        s[i + 2] = u * m02 + v * m12 + w * m22
