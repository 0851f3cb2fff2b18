"""A track as it is drawn: kept small enough for any length, and compared with a reference by replay's rules."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ..recording.rotations import QUAT
from ..replay.alignment import Transform
from ..replay.trajectory import POSITION
from ..replay.view import Comparison, RunView, compare

Floats = NDArray[np.float64]
Times = NDArray[np.int64]

ALIGNMENT = "origin-yaw"
"""Tracks start together and in one direction, so that what is seen (and what sigma speaks of) is the drift
since then."""

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


class Trace:
    """Times and positions of one channel, thinned evenly once they exceed :data:`LIMIT`.

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
        self._q: list[Floats] = []
        self._stride, self.seen, self.count = 1, 0, 0

    def add(self, t_ns: Times, positions: Floats, quat_wxyz: Floats | None = None) -> None:
        """Append positions (n, 3) in metres and orientations (n, 4); rows without a position are left out."""
        keep = np.isfinite(positions).all(axis=1)
        t_ns, positions = t_ns[keep], positions[keep]
        turn = np.full((len(t_ns), 4), np.nan) if quat_wxyz is None else quat_wxyz[keep]
        first = -self.seen % self._stride
        self.seen += len(t_ns)
        kept = slice(first, None, self._stride)
        # Copies: a view would keep every row of its piece in memory.
        self._t.append(t_ns[kept].copy())
        self._p.append(positions[kept].copy())
        self._q.append(turn[kept].copy())
        self.count += len(self._t[-1])
        while self.count > LIMIT:
            self._t, self._p, self._q = [self.t_ns[::2]], [self.positions[::2]], [self.quat_wxyz[::2]]
            self._stride *= 2
            self.count = len(self._t[0])

    @property
    def t_ns(self) -> Times:
        """Times (n,)."""
        return np.concatenate(self._t) if self._t else np.empty(0, dtype=np.int64)

    @property
    def positions(self) -> Floats:
        """Positions (n, 3), m."""
        return np.concatenate(self._p) if self._p else np.empty((0, 3))

    @property
    def quat_wxyz(self) -> Floats:
        """Orientations (n, 4), body to navigation frame; NaN where they are not known."""
        return np.concatenate(self._q) if self._q else np.empty((0, 4))

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

    def table(self) -> pl.DataFrame:
        """Return the points as a table of poses, without orientation where it is not known throughout."""
        columns: dict[str, NDArray] = {"t_ns": self.t_ns}
        columns |= dict(zip(POSITION, self.positions.T, strict=True))
        if np.isfinite(self.quat_wxyz).all():
            columns |= dict(zip(QUAT, self.quat_wxyz.T, strict=True))
        return pl.DataFrame(columns)


def framed(traces: Sequence[Trace]) -> list[Trace]:
    """Return the traces that a view should be zoomed to.

    One that has run away (an uncorrected mechanization falls through the floor) must not hide the others, nor one
    that is too short: the lower median is the measure.
    """
    walked = sorted(t.size_m for t in traces if t.size_m > STANDING_M)
    limit = LARGER * walked[(len(walked) - 1) // 2] if walked else np.inf
    near = [t for t in traces if t.size_m <= limit and t.worst_m <= max(ASTRAY * t.size_m, STANDING_M)]
    return near or list(traces)


def compared(trace: Trace, reference: Trace, alignment: str) -> Comparison | None:
    """Lay a trace upon a reference by :func:`marcha.replay.view.compare`, as the evaluation does.

    Returns
    -------
    Comparison or None
        None where fewer than two times have a partner.
    """
    if not trace.count or not reference.count:
        return None
    own = trace.table()
    view = RunView(
        run=trace.owner,
        estimator="",
        lineage={},
        output=lambda name, columns: own if name == "pose" else None,
        reference=reference.table(),
        alignment=alignment,
    )
    comparison = compare(view, alignment)
    return comparison if comparison is not None and len(comparison.t_ns) > 1 else None


def axes_error(comparison: Comparison) -> Floats:
    """Return the error (n, 3), m, in the track's own axes: those in which its sigma is stated."""
    return comparison.error @ comparison.transform.rotation


def distance(comparison: Comparison) -> Floats:
    """Return distances (n,) to the reference, m."""
    return np.sqrt(np.sum(comparison.error**2, axis=1))
