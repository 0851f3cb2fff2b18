"""What a metric looks at: the results of one run, the reference and the truth, as a whole or in parts.

A part is a set of stretches of time. It keeps the alignment of the whole walk, so that what is counted or summed
over parts that make up the walk is what the whole says.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ..algorithms.contract import FloatArray
from .alignment import IntArray, Matches, Transform, align, match, wrap, yaw_of
from .references import reference_of, references

if TYPE_CHECKING:
    from ..recording import Recording

POSITION = ("pos_x", "pos_y", "pos_z")
QUATERNION = ("quat_w", "quat_x", "quat_y", "quat_z")
VELOCITY = ("vel_x", "vel_y", "vel_z")
PLAN = "plan"
REST_NS = 500_000_000
"""How long beyond what was recorded a walker is taken to stay where he was."""
Loader = Callable[[str, "Sequence[str] | None"], "pl.DataFrame | None"]
Stream = Callable[[str], "tuple[int, Iterator[pl.DataFrame]] | None"]


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
        """Return what lies in stretches of time; None where nothing does."""
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
    quat = table.select(QUATERNION).to_numpy() if set(QUATERNION) <= set(table.columns) else None
    if quat is not None and not np.isfinite(quat).all():
        quat = None
    return Trajectory(table["t_ns"].to_numpy(), table.select(POSITION).to_numpy(order="c"), quat)


def track_of_stream(rows: int, tables: Iterator[pl.DataFrame], headings: bool) -> Trajectory | None:
    """Return what :func:`track_of` returns of pieces of a pose table, without having the table in memory.

    None also where the pieces are not in order.
    """
    names = (*POSITION, *QUATERNION) if headings else POSITION
    t_ns, values = np.empty(rows, np.int64), np.empty((rows, len(names)))
    n = 0
    for table in tables:
        if not set(POSITION) <= set(table.columns):
            return None
        if headings and not set(QUATERNION) <= set(table.columns):
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
class Truth:
    """What is known of a walk beside its reference.

    Attributes
    ----------
    closed : bool or None
        Whether it ends where it began; None where that is not known.
    length_m : float or None
        Its length.
    steps : float or None
        Number of its steps.
    """

    closed: bool | None = None
    length_m: float | None = None
    steps: float | None = None


@dataclass(frozen=True)
class Comparison:
    """An estimate beside a reference, after alignment.

    Attributes
    ----------
    t_ns : ndarray of int64, shape (n,)
        Stamps compared: the estimate's, or the reference's where that is the sparser one (surveyed points).
    estimate, reference : ndarray, shape (n, 3)
        Positions in metres in the reference's frame.
    yaw_error : ndarray, shape (n,), or None
        Heading of the estimate minus that of the reference, radians; None where one has no orientation.
    transform : Transform
        The alignment.
    matches : Matches
        What was matched and dropped.
    on_estimate : bool
        Whether the stamps are the estimate's.
    yaw_start : float
        ``yaw_error`` where the comparison of the whole walk begins.
    dropped_ns : ndarray of int64
        Stamps without a partner.
    """

    t_ns: IntArray
    estimate: FloatArray
    reference: FloatArray
    yaw_error: FloatArray | None
    transform: Transform
    matches: Matches
    on_estimate: bool
    yaw_start: float = 0.0
    dropped_ns: IntArray = field(default_factory=lambda: np.empty(0, np.int64))

    def within(self, spans: IntArray) -> Comparison | None:
        """Return what lies in stretches of time, under the same alignment; None where nothing does."""
        keep = inside(self.t_ns, spans)
        if not keep.any():
            return None
        lost = self.dropped_ns[inside(self.dropped_ns, spans)]
        m = self.matches
        return replace(
            self,
            t_ns=self.t_ns[keep],
            estimate=self.estimate[keep],
            reference=self.reference[keep],
            yaw_error=None if self.yaw_error is None else self.yaw_error[keep],
            matches=replace(
                m, index=m.index[keep], left=m.left[keep], weight=m.weight[keep], dropped=len(lost)
            ),
            dropped_ns=lost,
        )

    @property
    def error(self) -> FloatArray:
        """Estimate minus reference, shape (n, 3)."""
        return self.estimate - self.reference


@dataclass(frozen=True)
class RunView:
    """Everything that a metric may look at.

    Attributes
    ----------
    run, estimator : str
        Id and name.
    lineage : mapping
        The metadata record ``run/<id>``.
    output : callable
        ``output("pose", columns)`` is the table of that output with ``t_ns`` and those of ``columns``
        (None: all) that it has; None where the run does not have the output.
    stream : callable, optional
        ``stream("pose")`` is the number of rows of that output and an iterator over its pieces: with it a track
        is read without its table, so that a day of walking fits into memory.
    truth : Truth
        What is known of the walk.
    reference, reference_velocity : polars.DataFrame or None
        Tables of the reference track (poses or positions), in the recording's columns.
    recording : Recording or None
        For raw channels, further references, annotations and attachments: see :meth:`raw`,
        :meth:`reference_table`, :attr:`annotations`.
    chosen_reference : str or None
        Topic that the user named.
    alignment : str
        See :func:`marcha.replay.alignment.align`.
    max_gap_s : float
        Reference samples farther apart are not interpolated between.
    spans : ndarray of int64, shape (k, 2), or None
        Stretches of time that are looked at: half open, apart, in order. None: all.
    whole : RunView or None
        Of a part: the view of the whole walk, whose alignment holds.
    reference_frame : str
        Frame of the reference track's channel; on a ``plan`` heights say nothing.
    survey : polars.DataFrame or None
        Places (``lat_deg, lon_deg``) along the route from another recording, whose times say nothing here.
    """

    run: str
    estimator: str
    lineage: Mapping[str, str]
    output: Loader
    truth: Truth = Truth()
    reference: pl.DataFrame | None = None
    reference_velocity: pl.DataFrame | None = None
    recording: Recording | None = None
    chosen_reference: str | None = None
    alignment: str = "se3"
    max_gap_s: float = 0.1
    spans: IntArray | None = None
    whole: RunView | None = None
    reference_frame: str = ""
    survey: pl.DataFrame | None = None
    stream: Stream | None = None
    _cache: dict[Any, pl.DataFrame | None] = field(default_factory=dict, repr=False)
    _comparisons: dict[str, Comparison | None] = field(default_factory=dict, repr=False)

    def table(self, name: str, columns: tuple[str, ...] | None = None) -> pl.DataFrame | None:
        """Return an output's table within the interval; naming ``columns`` saves memory."""
        if (name, columns) not in self._cache:
            self._cache[name, columns] = self.output(name, columns)
        return self._within(self._cache[name, columns])

    def has(self, name: str) -> bool:
        """Whether the run has an output, without reading it."""
        return self.stream(name) is not None if self.stream is not None else self.table(name) is not None

    @property
    def inputs(self) -> dict[str, tuple[str, ...]]:
        """Topics by the name of the run's input."""
        found = json.loads(self.lineage.get("inputs", "{}"))
        return {name: tuple(topics) for name, topics in found.items()} if isinstance(found, dict) else {}

    @property
    def output_schemas(self) -> dict[str, str]:
        """Message types by the name of the run's output, where a recording holds them."""
        if self.recording is None:
            return {}
        start = f"/estimate/{self.run}/"
        channels = self.recording.channels.items()
        return {t.removeprefix(start): c.schema for t, c in channels if t.startswith(start)}

    def raw(self, topic: str) -> pl.DataFrame | None:
        """Return a channel of the recording within the interval; None where it is not there."""
        if self.recording is None or topic not in self.recording.channels:
            return None
        return self._within(self.recording.table(topic))

    def reference_table(self, kind: str) -> pl.DataFrame | None:
        """Return the run's reference of a kind (``pose``, ``position``, ``fix``, ``joint``, ``steps`` …) within
        the interval; None where there is none.
        """
        if self.recording is None:
            return self._within(self.reference) if kind == "pose" else None
        topic = reference_of(
            self.recording.channels,
            kind,
            self.lineage.get("input", ""),
            self.chosen_reference,
            str(self.recording.path),
        )
        return None if topic is None else self.raw(topic)

    def reference_tables(self, kind: str) -> dict[str, pl.DataFrame]:
        """Return all references of a kind within the interval, by topic (one a segment, say)."""
        if self.recording is None:
            return {}
        found = {t: self.raw(t) for t in references(self.recording.channels, kind)}
        return {t: table for t, table in found.items() if table is not None}

    @property
    def annotations(self) -> pl.DataFrame:
        """All annotations of the recording."""
        return self.recording.annotations if self.recording is not None else pl.DataFrame()

    def attachment(self, name: str) -> bytes | None:
        """Return an attachment of the recording; None where it is not there."""
        if self.recording is None or name not in [a.name for a in self.recording.attachments]:
            return None
        return self.recording.attachment(name)

    def _within(self, table: pl.DataFrame | None) -> pl.DataFrame | None:
        if table is None or self.spans is None:
            return table
        return table.filter(pl.Series(inside(table["t_ns"].to_numpy(), self.spans), dtype=pl.Boolean))

    def part(self, spans: IntArray) -> RunView:
        """Return the same view of stretches of time (k, 2), half open; those that overlap are joined.

        The alignment stays that of the whole walk. What is known of the walk (closed, its length) says nothing
        of a part of it.
        """
        return replace(self, spans=joined(spans), whole=self.whole or self, truth=Truth())

    @property
    def scattered(self) -> bool:
        """Whether several stretches are looked at, so that there is no first and last."""
        return self.spans is not None and len(self.spans) > 1

    @property
    def input_span(self) -> tuple[int | None, int | None]:
        """Log times of the first and last message of the run's first input; None where that is not known."""
        topic = self.lineage.get("input", "")
        if self.recording is None or topic not in self.recording.channels:
            return None, None
        channel = self.recording.channels[topic]
        return channel.start_ns, channel.end_ns

    @cached_property
    def track(self) -> Trajectory | None:
        """The estimated track: of the output ``pose``, else of ``position``."""
        headings = QUATERNION if self.reference is not None else ()
        if self.whole is not None and self.whole.stream is not None and self.spans is not None:
            whole = self.whole.track
            return None if whole is None else whole.within(self.spans)
        if self.stream is not None and (found := self.stream("pose")) is not None:
            track = track_of_stream(*found, bool(headings))
            if track is not None:
                return track
        track = track_of(self.table("pose", (*POSITION, *headings)))
        return track if track is not None else track_of(self.table("position", POSITION))

    @cached_property
    def reference_track(self) -> Trajectory | None:
        """The reference track."""
        return track_of(self._within(self.reference))

    @cached_property
    def comparison(self) -> Comparison | None:
        """The estimate beside the reference under the view's alignment; None where nothing matches."""
        return self.compared(self.alignment)

    def compared(self, alignment: str) -> Comparison | None:
        """Return the estimate beside the reference under an alignment of the whole walk."""
        if self.whole is not None:
            found = self.whole.compared(alignment)
            return None if found is None or self.spans is None else found.within(self.spans)
        if alignment not in self._comparisons:
            self._comparisons[alignment] = compare(self, alignment)
        return self._comparisons[alignment]

    @cached_property
    def stances(self) -> IntArray:
        """Stances as ``[first still, last still]`` times, shape (n, 2)."""
        if self.whole is None and self.stream is not None and (found := self.stream("stance")) is not None:
            return _stances(found[1])
        table = self.table("stance")
        return _stances(iter(() if table is None else (table,)))


def _stances(tables: Iterator[pl.DataFrame]) -> IntArray:
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


def compare(view: RunView, alignment: str) -> Comparison | None:
    """Match a run's track with the reference and align it."""
    track, reference = view.track, view.reference_track
    if track is None or reference is None:
        return None
    if view.reference_frame == PLAN:
        track, reference = _flat(track), _flat(reference)
    reference = with_stays(reference, view.max_gap_s)
    sparse = _is_sparse(reference, view.max_gap_s)
    max_gap_s = view.max_gap_s
    if sparse and _is_sparse(track, max_gap_s) and (steps := view.table("step")) is not None:
        track, max_gap_s = stepwise(track, steps, *view.input_span), np.inf
    kept, other = (reference, track) if sparse else (track, reference)
    found = match(kept.t_ns, other.t_ns, max_gap_s)
    if not len(found.index):
        return None
    here, there = kept.position[found.index], found.linear(other.position)
    yaw_error = None
    yaws: tuple[FloatArray, FloatArray] | None = None
    if kept.yaw is not None and other.yaw is not None:
        pair = (kept.yaw[found.index], found.angle(other.yaw))
        yaws = (pair[1], pair[0]) if sparse else pair
    estimate, truth = (there, here) if sparse else (here, there)
    start = (float(yaws[0][0]), float(yaws[1][0])) if yaws is not None else (None, None)
    transform = align(estimate, truth, alignment, *start)
    if yaws is not None:
        yaw_error = wrap(yaws[0] + transform.yaw - yaws[1])
    return Comparison(
        kept.t_ns[found.index],
        transform.points(estimate),
        truth,
        yaw_error,
        transform,
        found,
        not sparse,
        float(yaw_error[0]) if yaw_error is not None else 0.0,
        np.delete(kept.t_ns, found.index),
    )


def _is_sparse(track: Trajectory, max_gap_s: float) -> bool:
    return len(track) > 1 and float(np.median(np.diff(track.t_ns))) > max_gap_s * 1e9


def _flat(track: Trajectory) -> Trajectory:
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
        at = place[0] - length * np.array([np.cos(heading), np.sin(heading), 0.0])
        times.append(start[:1])
        places.append(at[None])
    t, index = np.unique(np.concatenate(times), return_index=True)
    place = np.concatenate(places)[index]
    if last_ns is not None and last_ns + REST_NS > t[-1]:
        t, place = np.append(t, last_ns + REST_NS), np.vstack((place, place[-1:]))
    if first_ns is not None and first_ns - REST_NS < t[0]:
        t, place = np.insert(t, 0, first_ns - REST_NS), np.vstack((place[:1], place))
    return Trajectory(t, place)
