"""Bring an estimated track onto a reference: matching in time, then a named rigid alignment."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from ..algorithms.contract import FloatArray
from ..recording.errors import UsageError

IntArray = NDArray[np.int64]
Alignment = Literal["none", "origin", "origin-yaw", "se2", "sim2", "se3"]
ALIGNMENTS: tuple[str, ...] = get_args(Alignment)
HEADING_M = 2.0
"""Horizontal way from the start that gives the heading where a track has no orientation."""


def on_a_plan(estimate_frame: str, reference_frame: str) -> Alignment | None:
    """Return how an estimate is laid upon a reference on a floor plan; None where one of them is not on one.

    ``none`` where both are positions on the plan: there an alignment would hide the error. ``origin`` where the
    estimate has the plan's axes and starts at an unknown place of it.
    """
    if reference_frame != "plan":
        return None
    return {"plan": "none", "plan-axes": "origin"}.get(estimate_frame)  # type: ignore[return-value]


@dataclass(frozen=True)
class Transform:
    """Takes the estimate's coordinates to the reference's: ``p_ref = scale · rotation @ p_est + translation``.

    Attributes
    ----------
    rotation : ndarray, shape (3, 3)
        Proper rotation.
    translation : ndarray, shape (3,)
        Metres.
    scale : float
        1 but for ``sim2``.
    """

    rotation: FloatArray
    translation: FloatArray
    scale: float = 1.0

    def points(self, p: FloatArray) -> FloatArray:
        """Transform positions, shape (n, 3)."""
        return self.scale * p @ self.rotation.T + self.translation

    def vectors(self, v: FloatArray) -> FloatArray:
        """Transform vectors (velocities), shape (n, 3)."""
        return self.scale * v @ self.rotation.T

    @property
    def yaw(self) -> float:
        """Turn about the vertical, in radians."""
        return float(np.arctan2(self.rotation[1, 0], self.rotation[0, 0]))


def yaw_of(quat_wxyz: FloatArray) -> FloatArray:
    """Return the heading of body x in the navigation frame, in radians, for quaternions of shape (n, 4)."""
    w, x, y, z = np.asarray(quat_wxyz, dtype=np.float64).T
    return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def wrap(angle: FloatArray) -> FloatArray:
    """Return angles in [−π, π).

    Any shape; rad.
    """
    return (np.asarray(angle) + np.pi) % (2 * np.pi) - np.pi


def about_z(yaw: float) -> FloatArray:
    """Return the rotation by ``yaw`` about z, shape (3, 3)."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def align(
    estimate: FloatArray,
    reference: FloatArray,
    kind: str,
    estimate_yaw: float | None = None,
    reference_yaw: float | None = None,
) -> Transform:
    """Find the transform of the named kind that takes ``estimate`` to ``reference``.

    Parameters
    ----------
    estimate, reference : ndarray, shape (n, 3)
        Matched positions in metres, n ≥ 1.
    kind : {"none", "origin", "origin-yaw", "se2", "sim2", "se3"}
        ``none``: coordinates as they are. ``origin``: first positions laid upon each other. ``origin-yaw``:
        that, and the heading at the start, from the orientations given or else from the way of the first 2 m.
        ``se2``: least squares over a turn about z and a translation. ``sim2``: that, and a scale. ``se3``: least
        squares over all rotations and a translation, without scale (Horn 1987; Umeyama 1991).
    estimate_yaw, reference_yaw : float, optional
        Headings at the start in radians, where both tracks have an orientation.

    Returns
    -------
    Transform

    Raises
    ------
    UsageError
        An unknown kind.
    """
    if kind not in ALIGNMENTS:
        raise UsageError(f"alignment {kind!r} is unknown; choose {', '.join(ALIGNMENTS)}")
    if kind == "none":
        return Transform(np.eye(3), np.zeros(3))
    if kind in ("origin", "origin-yaw"):
        rotation = np.eye(3)
        if kind == "origin-yaw":
            if estimate_yaw is None or reference_yaw is None:
                estimate_yaw, reference_yaw = _start_headings(estimate, reference)
            rotation = about_z(reference_yaw - estimate_yaw)
        return Transform(rotation, reference[0] - rotation @ estimate[0])
    centre_e, centre_r = estimate.mean(axis=0), reference.mean(axis=0)
    cross = (reference - centre_r).T @ (estimate - centre_e)
    if kind in ("se2", "sim2"):
        rotation = about_z(float(np.arctan2(cross[1, 0] - cross[0, 1], cross[0, 0] + cross[1, 1])))
    elif not np.isfinite(cross).all():  # LAPACK may work for ever on what overflowed
        rotation = np.full((3, 3), np.nan)
    else:
        u, _, vt = np.linalg.svd(cross)
        rotation = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))]) @ vt
    scale = 1.0
    if kind == "sim2":
        spread = float(np.sum((estimate - centre_e)[:, :2] ** 2))
        scale = float(np.trace(rotation[:2, :2].T @ cross[:2, :2])) / spread if spread > 0 else 1.0
    return Transform(rotation, centre_r - scale * rotation @ centre_e, scale)


def _start_headings(estimate: FloatArray, reference: FloatArray) -> tuple[float, float]:
    """Return the headings of both tracks over the reference's first 2 m (all the way where it is shorter)."""
    way = np.hypot(*(reference[:, :2] - reference[0, :2]).T)
    far = np.flatnonzero(way >= HEADING_M)
    k = int(far[0]) if far.size else int(np.argmax(way))
    e, r = estimate[k] - estimate[0], reference[k] - reference[0]
    return float(np.arctan2(e[1], e[0])), float(np.arctan2(r[1], r[0]))


@dataclass(frozen=True)
class Matches:
    """Which stamps of one track were found in the other.

    Attributes
    ----------
    index : ndarray of int64
        Stamps (of the track whose time is kept) that have a partner.
    left, weight : ndarray
        The partner lies between samples ``left`` and ``left + 1`` of the other track, at ``weight`` in [0,
        1].
    dropped : int
        Stamps without a partner.
    max_distance_s : float
        Largest distance in time between a kept stamp and the nearest sample of the other track.
    """

    index: IntArray
    left: IntArray
    weight: FloatArray
    dropped: int
    max_distance_s: float

    def linear(self, values: FloatArray) -> FloatArray:
        """Interpolate values of the other track at the kept stamps, shape (n, k)."""
        right = np.minimum(self.left + 1, len(values) - 1)
        w = self.weight[:, None]
        return np.where(w == 0.0, values[self.left], values[self.left] * (1 - w) + values[right] * w)

    def angle(self, values: FloatArray) -> FloatArray:
        """Interpolate angles in radians along the shorter way, shape (n,)."""
        right = np.minimum(self.left + 1, len(values) - 1)
        return values[self.left] + self.weight * wrap(values[right] - values[self.left])


def match(times_ns: IntArray, other_ns: IntArray, max_gap_s: float) -> Matches:
    """Find for each time the samples of another track around it.

    Parameters
    ----------
    times_ns : ndarray of int64, shape (n,)
        Stamps at which values are wanted, ascending.
    other_ns : ndarray of int64, shape (m,)
        Stamps of the other track, strictly ascending.
    max_gap_s : float
        Neighbouring samples farther apart are not interpolated between. A stamp that is equal to a sample's
        always has it as its partner.

    Returns
    -------
    Matches
    """
    if not len(times_ns) or not len(other_ns):
        none = np.empty(0, np.int64)
        return Matches(none, none, np.empty(0), len(times_ns), 0.0)
    left = np.searchsorted(other_ns, times_ns, side="right") - 1
    safe = np.clip(left, 0, len(other_ns) - 1)
    right = np.minimum(safe + 1, len(other_ns) - 1)
    span = other_ns[right] - other_ns[safe]
    since = times_ns - other_ns[safe]
    exact = (left >= 0) & (since == 0)
    inside = (left >= 0) & (left < len(other_ns) - 1) & (span <= max_gap_s * 1e9)
    kept = np.flatnonzero(exact | inside)
    weight = np.where(exact[kept], 0.0, since[kept] / np.maximum(span[kept], 1))
    distance = np.where(exact[kept], 0, np.minimum(since[kept], span[kept] - since[kept]))
    return Matches(
        kept, safe[kept], weight, len(times_ns) - len(kept), float(distance.max() / 1e9) if len(kept) else 0.0
    )
