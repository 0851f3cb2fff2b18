"""Rotations as numba kernels.

``rot_nb`` (3, 3) takes coordinates from the body frame b to the navigation frame n. Quaternions are ``wxyz``,
Hamilton, of the same rotation. Angles: ``C = Rz(yaw) Ry(pitch) Rx(roll)``, rad.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from .compiled import compiled, inlined

FloatArray = NDArray[np.float64]


@inlined
def near(angle: float, other: float) -> float:
    """Return ``angle`` moved by whole turns to within half a turn of ``other``."""
    return angle - 2.0 * math.pi * math.floor((angle - other) / (2.0 * math.pi) + 0.5)


@compiled
def set_rpy(rot: FloatArray, roll: float, pitch: float, yaw: float) -> None:
    """Set ``rot`` to ``Rz(yaw) Ry(pitch) Rx(roll)``."""
    cr, sr = math.cos(roll), math.sin(roll)
    cp, sp = math.cos(pitch), math.sin(pitch)
    cy, sy = math.cos(yaw), math.sin(yaw)
    rot[0, 0] = cy * cp
    rot[0, 1] = cy * sp * sr - sy * cr
    rot[0, 2] = cy * sp * cr + sy * sr
    rot[1, 0] = sy * cp
    rot[1, 1] = sy * sp * sr + cy * cr
    rot[1, 2] = sy * sp * cr - cy * sr
    rot[2, 0] = -sp
    rot[2, 1] = cp * sr
    rot[2, 2] = cp * cr


@inlined
def quat_of(rot: FloatArray) -> tuple[float, float, float, float]:
    """Return the unit quaternion (wxyz, w ≥ 0) of ``rot``.

    Shepperd's method: the largest of the four components is the divisor, so no rotation loses digits.
    """
    a, b, c = rot[0, 0], rot[1, 1], rot[2, 2]
    trace = a + b + c
    if trace > a and trace > b and trace > c:
        w = 1.0 + trace
        x = rot[2, 1] - rot[1, 2]
        y = rot[0, 2] - rot[2, 0]
        z = rot[1, 0] - rot[0, 1]
    elif a > b and a > c:
        w = rot[2, 1] - rot[1, 2]
        x = 1.0 + a - b - c
        y = rot[0, 1] + rot[1, 0]
        z = rot[0, 2] + rot[2, 0]
    elif b > c:
        w = rot[0, 2] - rot[2, 0]
        x = rot[0, 1] + rot[1, 0]
        y = 1.0 - a + b - c
        z = rot[1, 2] + rot[2, 1]
    else:
        w = rot[1, 0] - rot[0, 1]
        x = rot[0, 2] + rot[2, 0]
        y = rot[1, 2] + rot[2, 1]
        z = 1.0 - a - b + c
    scale = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)
    if w < 0.0:
        scale = -scale
    return w * scale, x * scale, y * scale, z * scale


@inlined
def set_quat(rot: FloatArray, w: float, x: float, y: float, z: float) -> None:
    """Set ``rot`` to the rotation of a unit quaternion."""
    rot[0, 0] = 1.0 - 2.0 * (y * y + z * z)
    rot[0, 1] = 2.0 * (x * y - w * z)
    rot[0, 2] = 2.0 * (x * z + w * y)
    rot[1, 0] = 2.0 * (x * y + w * z)
    rot[1, 1] = 1.0 - 2.0 * (x * x + z * z)
    rot[1, 2] = 2.0 * (y * z - w * x)
    rot[2, 0] = 2.0 * (x * z - w * y)
    rot[2, 1] = 2.0 * (y * z + w * x)
    rot[2, 2] = 1.0 - 2.0 * (x * x + y * y)


@inlined
def turn_body(rot: FloatArray, x: float, y: float, z: float) -> None:
    """Turn ``rot`` about body axes: ``C ← C (2I + [θ]×)(2I − [θ]×)⁻¹``, θ = (x, y, z) in rad.

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
    for i in range(3):
        u, v, w = rot[i, 0], rot[i, 1], rot[i, 2]
        rot[i, 0] = u * m00 + v * m10 + w * m20
        rot[i, 1] = u * m01 + v * m11 + w * m21
        rot[i, 2] = u * m02 + v * m12 + w * m22


@inlined
def turn_nav(rot: FloatArray, x: float, y: float, z: float) -> None:
    """Turn ``rot`` about navigation axes: ``C ← (2I + [θ]×)(2I − [θ]×)⁻¹ C``, θ = (x, y, z) in rad."""
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
    for j in range(3):
        u, v, w = rot[0, j], rot[1, j], rot[2, j]
        rot[0, j] = m00 * u + m01 * v + m02 * w
        rot[1, j] = m10 * u + m11 * v + m12 * w
        rot[2, j] = m20 * u + m21 * v + m22 * w


@inlined
def orthonormalize(rot: FloatArray) -> None:
    """Take rounding out of a rotation: ``C ← C (3I − CᵀC)/2``, the symmetric correction to first order."""
    c00, c01, c02 = rot[0, 0], rot[0, 1], rot[0, 2]
    c10, c11, c12 = rot[1, 0], rot[1, 1], rot[1, 2]
    c20, c21, c22 = rot[2, 0], rot[2, 1], rot[2, 2]
    m00 = 1.5 - 0.5 * (c00 * c00 + c10 * c10 + c20 * c20)
    m11 = 1.5 - 0.5 * (c01 * c01 + c11 * c11 + c21 * c21)
    m22 = 1.5 - 0.5 * (c02 * c02 + c12 * c12 + c22 * c22)
    m01 = -0.5 * (c00 * c01 + c10 * c11 + c20 * c21)
    m02 = -0.5 * (c00 * c02 + c10 * c12 + c20 * c22)
    m12 = -0.5 * (c01 * c02 + c11 * c12 + c21 * c22)
    for i in range(3):
        u, v, w = rot[i, 0], rot[i, 1], rot[i, 2]
        rot[i, 0] = u * m00 + v * m01 + w * m02
        rot[i, 1] = u * m01 + v * m11 + w * m12
        rot[i, 2] = u * m02 + v * m12 + w * m22
