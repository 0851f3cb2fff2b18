"""What a metric looks at: the results of one run, the reference and the truth, as a whole or in parts.

A part is a set of stretches of time. It keeps the alignment of the whole walk, so that what is counted or summed
over parts that make up the walk is what the whole says.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import polars as pl

from ..algorithms.contract import FloatArray
from ..recording.rotations import QUAT
from .alignment import IntArray, Matches, Transform, align, match, wrap
from .references import own_record, reference_of, references
from .trajectory import (
    POSITION,
    OutOfOrderError,
    Trajectory,
    Way,
    flat,
    in_order,
    inside,
    is_sparse,
    joined,
    stances_of,
    stepwise,
    track_of,
    track_of_stream,
    way_of,
    with_stays,
)

if TYPE_CHECKING:
    from ..recording import Recording

VELOCITY = ("vel_x", "vel_y", "vel_z")
PLAN = "plan"
WALKED_S = 1.0
"""On a plan a reference is of somebody who walks: so far between its samples it is a straight line to a decimetre."""
Loader = Callable[[str, "Sequence[str] | None"], "pl.DataFrame | None"]
Stream = Callable[[str], "tuple[int, Iterator[pl.DataFrame]] | None"]


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
        """Return what lies in stretches of time, under the same alignment; None where nothing does.

        Shape of ``spans``: (k, 2), ns, half open.
        """
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
        topics_of = json.loads(self.lineage.get("inputs", "{}"))
        return (
            {name: tuple(topics) for name, topics in topics_of.items()} if isinstance(topics_of, dict) else {}
        )

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
        tables = {t: self.raw(t) for t in references(self.recording.channels, kind)}
        return {t: table for t, table in tables.items() if table is not None}

    @property
    def annotations(self) -> pl.DataFrame:
        """All annotations of the recording."""
        return self.recording.annotations if self.recording is not None else pl.DataFrame()

    def attachment(self, name: str) -> bytes | None:
        """Return an attachment of the recording; None where it is not there."""
        name = own_record(self.lineage, name)
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
        headings = QUAT if self.reference is not None else ()
        if self.whole is not None and self.whole.stream is not None and self.spans is not None:
            whole = self.whole.track
            return None if whole is None else whole.within(self.spans)
        if self.stream is not None and (arrays := self.stream("pose")) is not None:
            track = track_of_stream(*arrays, bool(headings))
            if track is not None:
                return track
        track = track_of(self.table("pose", (*POSITION, *headings)))
        return track if track is not None else track_of(self.table("position", POSITION))

    @cached_property
    def way(self) -> Way | None:
        """Ends and length of the track; read in pieces where nothing is to be compared with the track itself."""
        if (
            self.whole is None
            and self.reference is None
            and self.stream is not None
            and "track" not in vars(self)
        ):
            arrays = self.stream("pose")
            with contextlib.suppress(OutOfOrderError):
                if arrays is not None and (way := way_of(in_order(arrays[1]), self.stances)) is not None:
                    return way
        track = (self.whole or self).track
        if track is None:
            return None
        block = 1 << 17
        pieces = (
            Trajectory(track.t_ns[i : i + block], track.position[i : i + block])
            for i in range(0, len(track), block)
        )
        return way_of(pieces, (self.whole or self).stances, int(track.t_ns[-1]), self.spans)

    @property
    def ends(self) -> FloatArray | None:
        """First and last position (m), shape (2, 3); None without a track, or where several stretches are looked at."""
        if self.scattered:
            return None
        if self.whole is None:
            return None if self.way is None else self.way.ends
        return None if self.track is None else self.track.position[[0, -1]]

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
            comparison = self.whole.compared(alignment)
            return None if comparison is None or self.spans is None else comparison.within(self.spans)
        if alignment not in self._comparisons:
            self._comparisons[alignment] = compare(self, alignment)
        return self._comparisons[alignment]

    @cached_property
    def stances(self) -> IntArray:
        """Stances as ``[first still, last still]`` times, shape (n, 2)."""
        if self.whole is None and self.stream is not None and (arrays := self.stream("stance")) is not None:
            return stances_of(arrays[1])
        table = self.table("stance")
        return stances_of(iter(() if table is None else (table,)))


def compare(view: RunView, alignment: str) -> Comparison | None:
    """Match a run's track with the reference and align it."""
    reference = view.reference_track
    track = None if reference is None else view.track
    if track is None or reference is None:
        return None
    if view.reference_frame == PLAN:
        track, reference = flat(track), flat(reference)
    reference = with_stays(reference, view.max_gap_s)
    sparse = is_sparse(reference, view.max_gap_s)
    max_gap_s = view.max_gap_s
    if view.reference_frame == PLAN and not sparse:
        max_gap_s = max(max_gap_s, WALKED_S)
    if sparse and is_sparse(track, max_gap_s) and (steps := view.table("step")) is not None:
        track, max_gap_s = stepwise(track, steps, *view.input_span), np.inf
    kept, other = (reference, track) if sparse else (track, reference)
    pairs = match(kept.t_ns, other.t_ns, max_gap_s)
    if not len(pairs.index):
        return None
    here, there = kept.position[pairs.index], pairs.linear(other.position)
    yaw_error = None
    yaws: tuple[FloatArray, FloatArray] | None = None
    if kept.yaw is not None and other.yaw is not None:
        pair = (kept.yaw[pairs.index], pairs.angle(other.yaw))
        yaws = (pair[1], pair[0]) if sparse else pair
    estimate, truth = (there, here) if sparse else (here, there)
    start = (float(yaws[0][0]), float(yaws[1][0])) if yaws is not None else (None, None)
    transform = align(estimate, truth, alignment, *start)
    if yaws is not None:
        yaw_error = wrap(yaws[0] + transform.yaw - yaws[1])
    return Comparison(
        kept.t_ns[pairs.index],
        transform.points(estimate),
        truth,
        yaw_error,
        transform,
        pairs,
        not sparse,
        float(yaw_error[0]) if yaw_error is not None else 0.0,
        np.delete(kept.t_ns, pairs.index),
    )
