"""Soft tissue: how a sensor strapped to muscle and fat moves against the bone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from .legmotion import FloatArray, Pose

SWING_HZ, DAMPING = 7.0, 0.35
"""Natural frequency and damping ratio of the mass on its tissue: it rings twice or thrice."""
TURN_ARM_M = 0.08
"""A shift of this length turns the sensor by one radian."""
KNOT_S = 0.005
"""Spacing of the knots of the tissue's motion (s)."""


@dataclass(frozen=True)
class SoftTissue:
    """Motion of a sensor against its segment.

    Attributes
    ----------
    shift : callable or None
        Time (s) to displacement in the segment's frame (m), (n, 3); None: rigid.
    """

    shift: Callable[[FloatArray], FloatArray] | None

    def at(self, t: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return displacement (m), (n, 3), and rotation (n, 3, 3), both in the segment's frame."""
        if self.shift is None:
            return np.zeros((t.size, 3)), np.broadcast_to(np.eye(3), (t.size, 3, 3))
        from scipy.spatial.transform import Rotation

        shift = self.shift(t)
        # Skin that moves along or across the segment rocks the sensor about the other two axes.
        turn = np.column_stack((shift[:, 1] + shift[:, 2], -shift[:, 0], shift[:, 0])) / TURN_ARM_M
        return shift, Rotation.from_rotvec(turn).as_matrix()


def tissue(
    pose: Callable[[FloatArray], Pose], lever_s: FloatArray, amount: float, duration_s: float
) -> SoftTissue:
    """Return the motion of a mass on a spring and a damper that the segment's own acceleration drives.

    Parameters
    ----------
    pose : callable
        Pose of the segment at given times (s).
    lever_s : ndarray, shape (3,)
        Place of the sensor (m).
    amount : float
        Factor of the motion; 0: rigid.
    duration_s : float
        Length of the capture.
    """
    if not amount:
        return SoftTissue(None)
    from scipy.interpolate import CubicSpline
    from scipy.signal import bilinear, lfilter

    t = np.arange(-0.2, duration_s + 0.2 + KNOT_S, KNOT_S)
    h = KNOT_S
    before, now, after = (pose(t + k * h) for k in (-1, 0, 1))
    points = [p.pos + p.rot @ lever_s for p in (before, now, after)]
    acc_n = (points[0] - 2 * points[1] + points[2]) / h**2
    acc_s = np.einsum("nji,nj->ni", now.rot, acc_n)
    w = 2 * np.pi * SWING_HZ
    b, a = bilinear([-amount], [1.0, 2 * DAMPING * w, w * w], 1 / h)
    return SoftTissue(CubicSpline(t, lfilter(b, a, acc_s, axis=0)))
