"""Quaternions, Hamilton: real part first in tables and NumPy, last in ROS messages and Rerun.

Three operations on whole columns are here although SciPy has them: its ``spatial`` takes as long to import as
the rest of a command that needs nothing else of it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

QUAT = ("quat_w", "quat_x", "quat_y", "quat_z")
"""Columns of a rotation, in the order of tables."""


def xyzw_from_wxyz(quat: ArrayLike) -> NDArray[Any]:
    """Return quaternions ``(…, 4)`` with the real part last, given it first."""
    return np.roll(np.asarray(quat), -1, axis=-1)


def wxyz_from_xyzw(quat: ArrayLike) -> NDArray[Any]:
    """Return quaternions ``(…, 4)`` with the real part first, given it last."""
    return np.roll(np.asarray(quat), 1, axis=-1)


def product(a: ArrayLike, b: ArrayLike) -> NDArray[np.float64]:
    """Return the quaternions ``(…, 4)`` (wxyz) of the rotations ``b``, then ``a``; shapes broadcast."""
    (aw, ax, ay, az), (bw, bx, by, bz) = (np.moveaxis(np.asarray(q, float), -1, 0) for q in (a, b))
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


def inverse(quat: ArrayLike) -> NDArray[np.float64]:
    """Return the inverse rotations of unit quaternions ``(…, 4)`` (wxyz)."""
    return np.asarray(quat, float) * (1.0, -1.0, -1.0, -1.0)


def rotation_vector(quat: ArrayLike) -> NDArray[np.float64]:
    """Return axis times angle, rad, angle at most π, shape ``(…, 3)``, of quaternions ``(…, 4)`` (wxyz)."""
    quat = np.asarray(quat, float)
    vector = np.where(quat[..., :1] < 0, -quat[..., 1:], quat[..., 1:])
    sine = np.linalg.norm(vector, axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, np.abs(quat[..., :1]))
    return vector * np.divide(angle, sine, out=np.full_like(sine, 2.0), where=sine > 0)


def from_matrix(rot: ArrayLike) -> NDArray[np.float64]:
    """Return the unit quaternion (wxyz) of the rotation nearest to ``rot``, shape (3, 3) (Bar-Itzhack 2000)."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = np.asarray(rot, float)
    symmetric = np.array(
        [
            [xx + yy + zz, zy - yz, xz - zx, yx - xy],
            [zy - yz, xx - yy - zz, xy + yx, xz + zx],
            [xz - zx, xy + yx, yy - xx - zz, yz + zy],
            [yx - xy, xz + zx, yz + zy, zz - xx - yy],
        ]
    )
    return np.linalg.eigh(symmetric).eigenvectors[:, -1]
