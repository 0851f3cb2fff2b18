"""Angles of joints from the attitudes of two segments: Cardan angles, in a plane, and about one axis."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

STATIC_S = 1.0
"""Stretch at the start whose mean pose is zero where nothing else says it."""

FUNCTIONAL = (
    "functional: turn about the main axis of the relative turn, zero in the first second; where it turns farther is "
    "flexion"
)


def cardan(upper: FloatArray, lower: FloatArray) -> FloatArray:
    """Return flexion, abduction, rotation (n, 3), rad, of M = upperᵀ lower = Rx(−f) Ry(−a) Rz(−r)."""
    m = np.swapaxes(upper, -1, -2) @ lower
    return np.stack(
        [
            np.arctan2(m[..., 1, 2], m[..., 2, 2]),
            -np.arcsin(np.clip(m[..., 0, 2], -1.0, 1.0)),
            np.arctan2(m[..., 0, 1], m[..., 0, 0]),
        ],
        axis=-1,
    )


def planar(long_upper: FloatArray, long_lower: FloatArray, right: FloatArray) -> FloatArray:
    """Return the angle from the lower long axis to the upper one in the plane across ``right`` (n,), rad."""
    with np.errstate(invalid="ignore", divide="ignore"):
        right = right / np.linalg.norm(right, axis=1, keepdims=True)
    u, v = (a - np.sum(a * right, axis=1, keepdims=True) * right for a in (long_upper, long_lower))
    return np.arctan2(np.sum(right * np.cross(v, u), axis=1), np.sum(u * v, axis=1))


class AxisTurn:
    """The turn of an upper frame against a lower one about one axis, window by window (rad), without jumps.

    The first window that has a motion says what is constant: the axis, if it is not given, where zero is, the sign.

    Parameters
    ----------
    axis : ndarray (3,), optional
        In the frames as they are, whole turns left out. Without it the main axis of the relative turn is taken, zero
        in the first second.
    flexes : float
        Sign of the direction in which the joint turns farther, where the axis is not given.
    """

    def __init__(self, axis: FloatArray | None = None, flexes: float = 1.0) -> None:
        self._axis, self._flexes = axis, flexes
        self._fitted = axis is None
        self._start: Any = None  # a Rotation
        self._zero: float | None = None
        self._sign = 1.0
        self._last: float | None = None

    def angle(self, t: FloatArray, upper: FloatArray, lower: FloatArray) -> FloatArray | None:
        """Return the angle of a window (n,), NaN where an attitude is; None as long as there was no motion.

        Shapes: ``t`` (n,) in s, ``upper`` and ``lower`` (n, 3, 3).
        """
        from scipy.spatial.transform import Rotation

        m = np.swapaxes(lower, -1, -2) @ upper
        good = np.flatnonzero(np.isfinite(m).all(axis=(1, 2)))
        out = np.full(len(m), np.nan)
        if good.size:
            turned = Rotation.from_matrix(m[good])
            if self._axis is None:
                self._find_axis(t[good], turned)
            if self._axis is not None:
                out[good] = self._unrolled(turned)
        return None if self._axis is None else out

    def _find_axis(self, t: FloatArray, turned: Any) -> None:
        if len(turned) < 30:
            return
        start = turned[: int(np.searchsorted(t, t[0] + STATIC_S, side="right"))].mean()
        step = (turned[:-1].inv() * turned[1:]).as_rotvec()
        power, directions = np.linalg.eigh(step.T @ step)
        if power[2] < 1e-9:
            return
        self._start = start
        self._axis = start.apply(directions[:, 2])  # of the upper frame, seen from the lower one at the start

    def _unrolled(self, turned: Any) -> FloatArray:
        quat = (turned if self._start is None else turned * self._start.inv()).as_quat()
        angle = 2.0 * np.arctan2(quat[:, :3] @ self._axis, quat[:, 3])
        angle = np.unwrap(angle) if self._last is None else np.unwrap(np.r_[self._last, angle])[1:]
        self._last = float(angle[-1])
        if self._zero is None:
            first = angle[0] if self._fitted else np.median(angle)
            self._zero = float(2 * np.pi * np.round(first / (2 * np.pi)))
            if self._fitted:
                low, high = np.percentile(angle - self._zero, (2, 98))
                self._sign = self._flexes if high >= -low else -self._flexes
        return (angle - self._zero) * self._sign
