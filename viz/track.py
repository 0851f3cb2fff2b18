"""A track kept small enough for any length, and its rigid alignment with a reference."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Times = NDArray[np.int64]

LIMIT = 65536
"""Points kept of a track; beyond it every second one goes, so memory stays bounded at any length."""


class Track:
    """Times and positions of one pose channel, thinned evenly once they exceed :data:`LIMIT`.

    Attributes
    ----------
    owner, color : str
        What a legend calls it, and its colour.
    seen, count : int
        Points taken and points kept so far.
    rotation, translation : ndarray
        (3, 3) and (3,): how the positions are turned and moved before they are shown.
    """

    def __init__(self, owner: str, color: str) -> None:
        self.owner, self.color = owner, color
        self.rotation, self.translation = np.eye(3), np.zeros(3)
        self._t: list[Times] = []
        self._p: list[Floats] = []
        self._stride, self.seen, self.count = 1, 0, 0

    def add(self, t_ns: Times, positions: Floats) -> None:
        """Append positions (n, 3) in metres; rows that are not finite are left out."""
        keep = np.isfinite(positions).all(axis=1)
        t_ns, positions = t_ns[keep], positions[keep]
        first = -self.seen % self._stride
        self.seen += len(t_ns)
        self._t.append(t_ns[first :: self._stride])
        self._p.append(positions[first :: self._stride])
        self.count += len(self._t[-1])
        while self.count > LIMIT:
            self._t, self._p = [self.t_ns[::2]], [self.positions[::2]]
            self._stride *= 2
            self.count = len(self._t[0])

    @property
    def shown(self) -> Floats:
        """Positions (n, 3) as they are shown, m."""
        return self.positions @ self.rotation.T + self.translation

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


@dataclass(frozen=True)
class Aligned:
    """A track turned about the vertical and moved onto a reference.

    Attributes
    ----------
    rotation, translation : ndarray
        (3, 3) and (3,): ``reference ≈ rotation @ track + translation``.
    t_ns : ndarray
        Times (n,) of the track within the reference.
    error : ndarray
        (n, 3), m: aligned track minus reference, in the track's own axes (those of its sigma).
    """

    rotation: Floats
    translation: Floats
    t_ns: Times
    error: Floats


def align(track: Track, reference: Track) -> Aligned | None:
    """Return the least-squares rotation about the vertical and translation onto the reference.

    A strapdown estimate knows the vertical but neither its first heading nor its place: those four degrees of freedom, and
    no others, are taken out (Horn 1987, closed form for one axis). The reference is interpolated linearly at
    the track's times.

    Returns
    -------
    Aligned or None
        None where fewer than two points overlap in time.
    """
    t_ref, t_ns = reference.t_ns, track.t_ns
    inside = (t_ns >= t_ref[0]) & (t_ns <= t_ref[-1])
    t_ns, p = t_ns[inside], track.positions[inside]
    if len(t_ns) < 2:
        return None
    q = reference.at(t_ns)
    p0, q0 = p - p.mean(axis=0), q - q.mean(axis=0)
    yaw = np.arctan2(
        np.sum(p0[:, 0] * q0[:, 1] - p0[:, 1] * q0[:, 0]), np.sum(p0[:, 0] * q0[:, 0] + p0[:, 1] * q0[:, 1])
    )
    c, s = np.cos(yaw), np.sin(yaw)
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    translation = q.mean(axis=0) - rotation @ p.mean(axis=0)
    return Aligned(rotation, translation, t_ns, (p @ rotation.T + translation - q) @ rotation)
