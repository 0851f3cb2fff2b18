"""Positions over time: read from tables or piece by piece, cut to stretches of time, completed where nothing moved."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ..algorithms.contract import FloatArray
from ..recording.rotations import QUAT
from .alignment import IntArray, yaw_of

POSITION = ("pos_x", "pos_y", "pos_z")
REST_NS = 500_000_000
"""How long beyond what was recorded a walker is taken to stay where he was."""


def joined(spans: IntArray) -> IntArray:
    """Return stretches (k, 2) in order, those that overlap or touch as one."""
    spans = np.asarray(spans, np.int64).reshape(-1, 2)
    spans = spans[np.argsort(spans[:, 0], kind="stable")]
    if not len(spans):
        return spans
    last = np.maximum.accumulate(spans[:, 1])
    new = np.r_[True, spans[1:, 0] > last[:-1]]
    return np.column_stack((spans[new, 0], last[np.r_[np.flatnonzero(new)[1:] - 1, len(spans) - 1]]))


def inside(t_ns: IntArray, spans: IntArray) -> NDArray[np.bool_]:
    """Return which times (n,) lie in stretches (k, 2) that are half open, apart and in order."""
    if not len(spans):
        return np.zeros(len(t_ns), bool)
    k = np.searchsorted(spans[:, 0], t_ns, side="right") - 1
    return (k >= 0) & (t_ns < spans[np.maximum(k, 0), 1])


@dataclass(frozen=True)
class Trajectory:
    """Positions over time, with orientation where it is known.

    Attributes
    ----------
    t_ns : ndarray of int64, shape (n,)
        Strictly ascending.
    position : ndarray, shape (n, 3)
        Metres, finite.
    quat_wxyz : ndarray, shape (n, 4), or None
        Body to navigation frame.
    """

    t_ns: IntArray
    position: FloatArray
    quat_wxyz: FloatArray | None = None

    def __len__(self) -> int:
        return len(self.t_ns)

    def within(self, spans: IntArray) -> Trajectory | None:
        """Return what lies in stretches of time; None where nothing does.

        Shape of ``spans``: (k, 2), ns, half open.
        """
        keep = inside(self.t_ns, spans)
        if not keep.any():
            return None
        quat = None if self.quat_wxyz is None else self.quat_wxyz[keep]
        return Trajectory(self.t_ns[keep], self.position[keep], quat)

    @cached_property
    def yaw(self) -> FloatArray | None:
        """Heading in radians, shape (n,)."""
        return None if self.quat_wxyz is None else yaw_of(self.quat_wxyz)


def track_of(table: pl.DataFrame | None) -> Trajectory | None:
    """Return the usable rows of a pose table, in time order, or None where there are none."""
    if table is None or not set(POSITION) <= set(table.columns):
        return None
    finite = pl.all_horizontal(pl.col(POSITION).is_finite())
    if not table.select(finite.all()).item():
        table = table.filter(finite)
    if not (np.diff(table["t_ns"].to_numpy()) > 0).all():
        table = table.sort("t_ns", maintain_order=True).unique("t_ns", keep="first", maintain_order=True)
    if table.is_empty():
        return None
    quat = table.select(QUAT).to_numpy() if set(QUAT) <= set(table.columns) else None
    if quat is not None and not np.isfinite(quat).all():
        quat = None
    return Trajectory(table["t_ns"].to_numpy(), table.select(POSITION).to_numpy(order="c"), quat)


def track_of_stream(rows: int, tables: Iterator[pl.DataFrame], headings: bool) -> Trajectory | None:
    """Return what :func:`track_of` returns of pieces of a pose table, without having the table in memory.

    None also where the pieces are not in order.
    """
    names = (*POSITION, *QUAT) if headings else POSITION
    t_ns, values = np.empty(rows, np.int64), np.empty((rows, len(names)))
    n = 0
    for table in tables:
        if not set(POSITION) <= set(table.columns):
            return None
        if headings and not set(QUAT) <= set(table.columns):
            names, values, headings = POSITION, np.ascontiguousarray(values[:, :3]), False
        columns = [table[name].to_numpy() for name in names]
        good = np.logical_and.reduce([np.isfinite(c) for c in columns[:3]])
        end = min(rows, n + int(np.count_nonzero(good)))
        t_ns[n:end] = table["t_ns"].to_numpy()[good][: end - n]
        if not (np.diff(t_ns[max(0, n - 1) : end]) > 0).all():
            return None
        for k, column in enumerate(columns):
            values[n:end, k] = column[good][: end - n]
        n = end
    if not n:
        return None
    quat = values[:n, 3:] if headings and np.isfinite(values[:n, 3:]).all() else None
    return Trajectory(t_ns[:n], values[:n, :3], quat)


@dataclass(frozen=True)
class Way:
    """What a track is measured by where nothing is compared with it: a few numbers instead of every sample.

    Attributes
    ----------
    ends : ndarray, shape (2, 3)
        First and last position (m).
    length_m : float
        Horizontal length along every sample.
    stances_m : float or None
        Horizontal length from the middle of each stance to that of the next; None where there is no stance.
    """

    ends: FloatArray
    length_m: float
    stances_m: float | None


def way_of(
    pieces: Iterable[Trajectory], stances: IntArray, last_ns: int | None = None, spans: IntArray | None = None
) -> Way | None:
    """Return the way of a track that comes piece by piece, in order.

    Parameters
    ----------
    pieces : iterable of Trajectory
        Pieces with at least a sample each.
    stances : ndarray of int64, shape (n, 2)
        First and last still time (ns). The track begins within the rest at the start: that stance counts from
        where there is a track.
    last_ns : int, optional
        Time at the end of the track, where a stance that goes on beyond it ends. Without it there is no way
        where one does.
    spans : ndarray of int64, shape (k, 2), optional
        Stretches of time (ns, half open): only sides of the polygon whose middle is in one are counted.
    """
    first = last = None
    middles, places, length, n = np.empty(0, np.int64), [], 0.0, 0
    for piece in pieces:
        t, position = piece.t_ns, piece.position
        if first is None:
            first = piece
            stances = stances[stances[:, 1] >= t[0]]
            if last_ns is not None:
                stances = stances[stances[:, 0] <= last_ns]
            middles = np.clip(stances, t[0], last_ns).mean(axis=1).astype(np.int64)
        if last is not None:
            t, position = np.r_[last.t_ns[-1:], t], np.vstack((last.position[-1:], position))
        length += polygon_m(t, position, spans)
        upto = n + int(np.searchsorted(middles[n:], t[-1], side="right"))
        places.append(position[np.searchsorted(t, middles[n:upto])])
        n, last = upto, piece
    if first is None or last is None:
        return None
    if last_ns is None:
        if (stances[stances[:, 0] <= last.t_ns[-1], 1] > last.t_ns[-1]).any():
            return None
        middles = middles[:n]
    stood = np.concatenate(places)
    return Way(
        np.vstack((first.position[0], last.position[-1])),
        length,
        polygon_m(middles, stood, spans) if len(stood) else None,
    )


def polygon_m(t_ns: IntArray, position: FloatArray, spans: IntArray | None) -> float:
    """Return the horizontal length of a polygon; in stretches of time, of the sides whose middle is in them.

    Shapes: ``t_ns`` (n,), ``position`` (n, 3), ``spans`` (k, 2).
    """
    block = 1 << 17  # the differences of a long walk need not lie in memory together
    total = 0.0
    for i in range(0, max(1, len(position) - 1), block):
        side = np.hypot(*np.diff(position[i : i + block + 1, :2], axis=0).T)
        if spans is not None:
            before, after = t_ns[i : i + len(side)], t_ns[i + 1 : i + 1 + len(side)]
            side = side[inside(before + (after - before) // 2, spans)]
        total += float(side.sum())
    return total


def in_order(tables: Iterable[pl.DataFrame]) -> Iterator[Trajectory]:
    """Yield the usable rows of pieces of a pose table; :class:`OutOfOrderError` where they are not in order."""
    before = -(2**63)
    for table in tables:
        t_ns = table["t_ns"].to_numpy()
        if not set(POSITION) <= set(table.columns):
            raise OutOfOrderError
        position = table.select(POSITION).to_numpy(order="c")
        good = np.isfinite(position).all(axis=1)
        if not good.all():
            t_ns, position = t_ns[good], position[good]
        if not len(t_ns):
            continue
        if t_ns[0] <= before or not (np.diff(t_ns) > 0).all():
            raise OutOfOrderError
        before = int(t_ns[-1])
        yield Trajectory(t_ns, position)


class OutOfOrderError(ValueError):
    """A track cannot be read in pieces: times that repeat or go back, or no positions."""


def with_stays(reference: Trajectory, max_gap_s: float) -> Trajectory:
    """Return a reference with samples within its stays: between two equal positions nothing needs interpolation.

    A surveyor who stands at a point from one time to another states just these two.
    """
    t, p = reference.t_ns, reference.position
    held = np.flatnonzero((np.diff(p, axis=0) == 0).all(axis=1) & (np.diff(t) > max_gap_s * 1e9))
    if not held.size or reference.quat_wxyz is not None:
        return reference
    step = round(0.5e9 * max_gap_s)
    within = [np.arange(t[k] + step, t[k + 1], step) for k in held]
    times = np.concatenate([t, *within])
    places = np.concatenate(
        [p, *(np.repeat(p[k : k + 1], len(w), axis=0) for k, w in zip(held, within, strict=True))]
    )
    order = np.argsort(times, kind="stable")
    return Trajectory(times[order], places[order])


def is_sparse(track: Trajectory, max_gap_s: float) -> bool:
    """Whether most samples are farther apart than is interpolated between."""
    return len(track) > 1 and float(np.median(np.diff(track.t_ns))) > max_gap_s * 1e9


def flat(track: Trajectory) -> Trajectory:
    """Return a track at height 0."""
    return replace(track, position=track.position * (1.0, 1.0, 0.0))


def stepwise(track: Trajectory, steps: pl.DataFrame, first_ns: int | None, last_ns: int | None) -> Trajectory:
    """Return a track that is known at the ends of steps, as a walk that stands still between them.

    Parameters
    ----------
    track : Trajectory
        Positions at the ends of steps, and in between.
    steps : polars.DataFrame
        ``start_ns, end_ns, length_m, heading_rad`` of every step, in order.
    first_ns, last_ns : int or None
        From when to when the walker was watched: there is a place before the first step and after the last,
        and for :data:`REST_NS` beyond, in which nobody gets far.
    """
    t, place = track.t_ns, track.position
    start = steps["start_ns"].to_numpy() if "start_ns" in steps.columns else np.empty(0, np.int64)
    if not len(start):
        return track
    before = np.searchsorted(t, start, "right") - 1  # where the walker stood when the step began
    rests = np.flatnonzero((before >= 0) & (t[before] < start))
    times, places = [t, start[rests]], [place, place[before[rests]]]
    if start[0] < t[0] <= steps["end_ns"][0]:
        length, heading = steps["length_m"][0], steps["heading_rad"][0]
        origin = place[0] - length * np.array([np.cos(heading), np.sin(heading), 0.0])
        times.append(start[:1])
        places.append(origin[None])
    t, index = np.unique(np.concatenate(times), return_index=True)
    place = np.concatenate(places)[index]
    if last_ns is not None and last_ns + REST_NS > t[-1]:
        t, place = np.append(t, last_ns + REST_NS), np.vstack((place, place[-1:]))
    if first_ns is not None and first_ns - REST_NS < t[0]:
        t, place = np.insert(t, 0, first_ns - REST_NS), np.vstack((place[:1], place))
    return Trajectory(t, place)


def stances_of(tables: Iterator[pl.DataFrame]) -> IntArray:
    """Return first and last still time of every stance, from pieces of the output ``stance`` in order."""
    first: list[IntArray] = []
    last: list[IntArray] = []
    before, before_ns = 0, 0
    for table in tables:
        if table.is_empty():
            continue
        t_ns, still = table["t_ns"].to_numpy(), table["still"].cast(pl.Int8).to_numpy()
        edges = np.diff(still, prepend=np.int8(before))
        ends = np.flatnonzero(edges == -1)
        first.append(t_ns[edges == 1])
        last.append(np.where(ends > 0, t_ns[ends - 1], before_ns))
        before, before_ns = int(still[-1]), int(t_ns[-1])
    if before:
        last.append(np.array([before_ns], np.int64))
    if not first:
        return np.empty((0, 2), np.int64)
    return np.column_stack((np.concatenate(first), np.concatenate(last)))
