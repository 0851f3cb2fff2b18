"""A track kept small enough for any length, and its comparison with a reference."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..replay.alignment import (
    Transform,
    align,
    match,
    yaw_of,
)

Floats = NDArray[np.float64]
Times = NDArray[np.int64]

LIMIT = 65536
"""Points kept of a track; beyond it every second one goes, so memory stays bounded at any length."""

LARGER = 1.5
"""A track so many times larger than the smallest one has run away."""

ASTRAY = 0.2
"""And so has one that is farther from its reference than this share of its own size: filters drift a
hundredth of it."""

SPARSE_S = 0.3
"""Points farther apart in time are places."""

STANDING_M = 0.5
"""A track smaller than this has not walked."""


class Track:
    """Times and positions of one pose channel, thinned evenly once they exceed :data:`LIMIT`.

    Attributes
    ----------
    owner, color : str
        What a legend calls it, and its colour.
    seen, count : int
        Points taken and points kept so far.
    place : Transform
        How the positions are turned and moved before they are shown.
    worst_m : float
        Largest distance to the reference; 0 without one.
    """

    def __init__(self, owner: str, color: str) -> None:
        self.owner, self.color = owner, color
        self.place = Transform(np.eye(3), np.zeros(3))
        self.worst_m = 0.0
        self._t: list[Times] = []
        self._p: list[Floats] = []
        self._yaw: list[Floats] = []
        self._stride, self.seen, self.count = 1, 0, 0

    def add(self, t_ns: Times, positions: Floats, quat_wxyz: Floats | None = None) -> None:
        """Append positions (n, 3) in metres and orientations (n, 4); rows without a position are left out."""
        keep = np.isfinite(positions).all(axis=1)
        t_ns, positions = t_ns[keep], positions[keep]
        yaw = np.full(len(t_ns), np.nan) if quat_wxyz is None else yaw_of(quat_wxyz[keep])
        first = -self.seen % self._stride
        self.seen += len(t_ns)
        self._t.append(t_ns[first :: self._stride])
        self._p.append(positions[first :: self._stride])
        self._yaw.append(yaw[first :: self._stride])
        self.count += len(self._t[-1])
        while self.count > LIMIT:
            self._t, self._p, self._yaw = [self.t_ns[::2]], [self.positions[::2]], [self.yaw[::2]]
            self._stride *= 2
            self.count = len(self._t[0])

    @property
    def yaw(self) -> Floats:
        """Headings (n,), rad; NaN where the orientation is not known."""
        return np.concatenate(self._yaw) if self._yaw else np.empty(0)

    @property
    def shown(self) -> Floats:
        """Positions (n, 3) as they are shown, m."""
        return self.place.points(self.positions)

    @property
    def sparse(self) -> bool:
        """Whether these are single places (surveyed footprints) rather than a motion."""
        return self.count > 1 and float(np.median(np.diff(self.t_ns))) > SPARSE_S * 1e9

    @property
    def size_m(self) -> float:
        """Diagonal of the box around all positions, m."""
        p = self.positions
        return float(np.linalg.norm(p.max(axis=0) - p.min(axis=0))) if len(p) else 0.0

    @property
    def last_ns(self) -> int:
        """Time of the newest point."""
        return int(self._t[-1][-1]) if self._t and self._t[-1].size else int(self.t_ns[-1])

    def at(self, t_ns: Times) -> Floats:
        """Return positions (n, 3) at other times, interpolated linearly and held beyond the ends."""
        zero = self.t_ns[0]
        t, own = (t_ns - zero) / 1e9, (self.t_ns - zero) / 1e9
        return np.column_stack([np.interp(t, own, p) for p in self.positions.T])

    @property
    def t_ns(self) -> Times:
        """Times (n,)."""
        return np.concatenate(self._t) if self._t else np.empty(0, dtype=np.int64)

    @property
    def positions(self) -> Floats:
        """Positions (n, 3), m."""
        return np.concatenate(self._p) if self._p else np.empty((0, 3))


def framed(tracks: Sequence[Track]) -> list[Track]:
    """Return the tracks that a view should be zoomed to.

    One that has run away (an uncorrected mechanization falls through the floor) must not hide the others.
    """
    walked = [t.size_m for t in tracks if t.size_m > STANDING_M]
    limit = LARGER * min(walked, default=np.inf)
    near = [t for t in tracks if t.size_m <= limit and t.worst_m <= max(ASTRAY * t.size_m, STANDING_M)]
    return near or list(tracks)


def reference_of(run: str, references: Sequence[str]) -> str | None:
    """Return the topic of a run's truth, as the evaluation does: that of its own sensor, else the common one.

    Parameters
    ----------
    run : str
        Id of the run, which ends with the parts of its input's topic (``foot_9iez_foot_imu2``).
    references : sequence of str
        Topics of poses (``/reference/pose``, ``/reference/imu2/pose``, ``/reference/footprints``).
    """
    sensors = {t: "_".join(t.split("/")[2:-1]) for t in references}
    own = [t for t, sensor in sensors.items() if sensor and f"_{sensor}_" in f"_{run}_"]
    if own:
        return max(own, key=len)
    return "/reference/pose" if "/reference/pose" in references else next(iter(references), None)


@dataclass(frozen=True)
class Compared:
    """A track laid upon a reference.

    Attributes
    ----------
    place : Transform
        From the track's coordinates to the reference's.
    t_ns : ndarray
        Times (n,) of the track, or of a sparser reference, that have a partner.
    error : ndarray
        (n, 3), m: aligned track minus reference, in the track's own axes (those of its sigma).
    """

    place: Transform
    t_ns: Times
    error: Floats

    @property
    def distance(self) -> Floats:
        """Distances (n,) to the reference, m."""
        return np.sqrt(np.sum(self.error**2, axis=1))

    @property
    def worst_m(self) -> float:
        """Largest distance."""
        return float(self.distance.max())


def compare(track: Track, reference: Track, alignment: str, max_gap_s: float = 0.1) -> Compared | None:
    """Match a track with a reference in time, align it, and return its error.

    Parameters
    ----------
    track, reference : Track
        Positions in metres.
    alignment : str
        See :func:`marcha.replay.alignment.align`.
    max_gap_s : float
        Positions are not interpolated over longer gaps. Where the reference itself is sparser
        (footprints), it is compared at its own times.

    Returns
    -------
    Compared or None
        None where fewer than two times have a partner.
    """
    t_ns, once = np.unique(track.t_ns, return_index=True)
    p, yaw = track.positions[once], track.yaw[once]
    t_ref, once = np.unique(reference.t_ns, return_index=True)
    q, yaw_ref = reference.positions[once], reference.yaw[once]
    # positions are interpolated in the denser track, at the times of the sparser one
    sparse = len(t_ref) > 1 and float(np.median(np.diff(t_ref))) > max_gap_s * 1e9
    found = match(t_ref, t_ns, max_gap_s) if sparse else match(t_ns, t_ref, max_gap_s)
    if len(found.index) < 2:
        return None
    if sparse:
        t_ns, p, q = t_ref[found.index], found.linear(p), q[found.index]
        yaw, yaw_ref = found.angle(yaw), yaw_ref[found.index]
    else:
        t_ns, p, q = t_ns[found.index], p[found.index], found.linear(q)
        yaw, yaw_ref = yaw[found.index], found.angle(yaw_ref)
    start = (float(yaw[0]), float(yaw_ref[0])) if np.isfinite([yaw[0], yaw_ref[0]]).all() else (None, None)
    place = align(p, q, alignment, *start)
    return Compared(place, t_ns, (place.points(p) - q) @ place.rotation)
