"""Figures of merit of one run. Each is a function ``metric(view) -> {name: value}``, an entry point
``marcha.metrics``.

Names carry their units. A metric that does not apply (no reference, length not known) leaves its names out; a
metric that applies but has no value is NaN. ``docs/replay.md`` lists every name with its formula.
"""

from __future__ import annotations

import json
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from importlib import metadata
from typing import TYPE_CHECKING, Any

import numpy as np
import polars as pl

from ..algorithms.contract import FloatArray
from .alignment import IntArray, Matches, Transform, align, match, wrap, yaw_of
from .references import reference_of, references

if TYPE_CHECKING:
    from ..recording import Recording

POSITION = ("pos_x", "pos_y", "pos_z")
QUATERNION = ("quat_w", "quat_x", "quat_y", "quat_z")
VELOCITY = ("vel_x", "vel_y", "vel_z")
Metric = Callable[["RunView"], Mapping[str, float]]
Loader = Callable[[str, "Sequence[str] | None"], "pl.DataFrame | None"]


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
    """

    t_ns: IntArray
    estimate: FloatArray
    reference: FloatArray
    yaw_error: FloatArray | None
    transform: Transform
    matches: Matches
    on_estimate: bool

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
    start_ns, end_ns : int or None
        Interval that is looked at, half open.
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
    start_ns: int | None = None
    end_ns: int | None = None
    _cache: dict[Any, pl.DataFrame | None] = field(default_factory=dict, repr=False)

    def table(self, name: str, columns: tuple[str, ...] | None = None) -> pl.DataFrame | None:
        """Return an output's table within the interval; naming ``columns`` saves memory."""
        if (name, columns) not in self._cache:
            self._cache[name, columns] = self.output(name, columns)
        return self._within(self._cache[name, columns])

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
        if table is None or (self.start_ns is None and self.end_ns is None):
            return table
        low, high = self.start_ns, self.end_ns
        return table.filter(
            (pl.col("t_ns") >= low if low is not None else True)
            & (pl.col("t_ns") < high if high is not None else True)
        )

    def interval(self, start_ns: int, end_ns: int) -> RunView:
        """Return the same view of an interval. A closed walk's length says nothing of a part of it."""
        return replace(self, start_ns=start_ns, end_ns=end_ns, truth=Truth())

    @cached_property
    def track(self) -> Trajectory | None:
        """The estimated track: of the output ``pose``, else of ``position``."""
        headings = QUATERNION if self.reference is not None else ()
        track = track_of(self.table("pose", (*POSITION, *headings)))
        return track if track is not None else track_of(self.table("position", POSITION))

    @cached_property
    def reference_track(self) -> Trajectory | None:
        """The reference track."""
        return track_of(self._within(self.reference))

    @cached_property
    def comparison(self) -> Comparison | None:
        """The estimate beside the reference under the view's alignment; None where nothing matches."""
        return compare(self, self.alignment)

    @cached_property
    def stances(self) -> IntArray:
        """Stances as ``[first still, last still]`` times, shape (n, 2)."""
        table = self.table("stance")
        if table is None or table.is_empty():
            return np.empty((0, 2), np.int64)
        t_ns, still = table["t_ns"].to_numpy(), table["still"].cast(pl.Int8).to_numpy()
        edges = np.diff(still, prepend=np.int8(0), append=np.int8(0))
        first, last = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1) - 1
        return np.column_stack((t_ns[first], t_ns[last]))


def compare(view: RunView, alignment: str) -> Comparison | None:
    """Match a run's track with the reference and align it."""
    track, reference = view.track, view.reference_track
    if track is None or reference is None:
        return None
    sparse = len(reference) > 1 and float(np.median(np.diff(reference.t_ns))) > view.max_gap_s * 1e9
    kept, other = (reference, track) if sparse else (track, reference)
    found = match(kept.t_ns, other.t_ns, view.max_gap_s)
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
        kept.t_ns[found.index], transform.points(estimate), truth, yaw_error, transform, found, not sparse
    )


def closure(view: RunView) -> dict[str, float]:
    """Distance from start to end, horizontal (the source's EP, eq 4.3, times the length)."""
    if view.track is None:
        return {}
    way = view.track.position[-1] - view.track.position[0]
    metres = float(np.hypot(way[0], way[1]))
    found = {"closure_m": metres}
    if view.truth.closed and view.truth.length_m:
        found["closure_percent"] = 100.0 * metres / view.truth.length_m
    return found


def distance(view: RunView) -> dict[str, float]:
    """Way walked, horizontal: from stance to stance, and along the raw track (the source's ED, eq 4.4)."""
    track = view.track
    if track is None:
        return {}
    found: dict[str, float] = {}
    first, last = track.t_ns[0], track.t_ns[-1]
    stances = view.stances[(view.stances[:, 1] >= first) & (view.stances[:, 0] <= last)]
    # The track begins within the rest at the start: that stance counts from where there is a track.
    middles = np.clip(stances, first, last).mean(axis=1).astype(np.int64)
    at = np.searchsorted(track.t_ns, middles)
    if at.size:
        found["distance_m"] = _length(track.position[at])
    found["path_m"] = _length(track.position)
    steps = view.table("step")
    if steps is not None:
        found["steps"] = float(steps.height)
        if view.truth.steps:
            found["steps_error_percent"] = 100.0 * abs(steps.height - view.truth.steps) / view.truth.steps
    if (length := view.truth.length_m) is not None:
        for name, metres in (
            ("distance_error_percent", found.get("distance_m")),
            ("path_error_percent", found["path_m"]),
        ):
            if metres is not None:
                found[name] = 100.0 * abs(metres - length) / length
    return found


def _length(position: FloatArray) -> float:
    """Return the horizontal length of a polygon."""
    block = 1_000_000  # the differences of a long walk need not lie in memory together
    starts = range(0, max(1, len(position) - 1), block)
    return float(sum(np.hypot(*np.diff(position[i : i + block + 1, :2], axis=0).T).sum() for i in starts))


def height(view: RunView) -> dict[str, float]:
    """Height at the end over the start, signed (the source's EA, eq 4.5, is its absolute value)."""
    if view.track is None:
        return {}
    z = view.track.position[:, 2]
    found = {"height_end_m": float(z[-1] - z[0])}
    if view.truth.closed:
        found["height_error_m"] = abs(found["height_end_m"])
    return found


def reference(view: RunView) -> dict[str, float]:
    """Errors of position, velocity and heading against the reference, after the view's alignment."""
    compared = view.comparison
    if compared is None:
        return {}
    error = np.linalg.norm(compared.error, axis=1)
    found = {
        "ate_rmse_m": float(np.sqrt(np.mean(error**2))),
        "position_error_mean_m": float(error.mean()),
        "position_error_median_m": float(np.median(error)),
        "position_error_p75_m": float(np.percentile(error, 75)),
        "position_error_p95_m": float(np.percentile(error, 95)),
        "position_error_max_m": float(error.max()),
        "position_error_end_m": float(error[-1]),
    }
    if compared.yaw_error is not None:
        drift = np.degrees(wrap(compared.yaw_error - compared.yaw_error[0]))
        found["heading_rmse_deg"] = float(np.sqrt(np.mean(drift**2)))
        found["heading_error_end_deg"] = float(drift[-1])
    velocity = _velocity_error(view, compared.transform)
    if velocity is not None:
        found["velocity_rmse_m_s"] = float(np.sqrt(np.mean(np.sum(velocity[1] ** 2, axis=1))))
    return found


def _velocity_error(view: RunView, transform: Transform) -> tuple[IntArray, FloatArray] | None:
    """Return stamps and velocity errors in the reference's frame where both have velocities."""
    table, reference = view.table("velocity"), view.reference_velocity
    if table is None or reference is None or table.is_empty() or reference.is_empty():
        return None
    reference = reference.unique("t_ns", keep="first", maintain_order=True)
    t_ns = table["t_ns"].to_numpy()
    found = match(t_ns, reference["t_ns"].to_numpy(), view.max_gap_s)
    if not len(found.index):
        return None
    ours = transform.vectors(table.select(VELOCITY).to_numpy()[found.index])
    return t_ns[found.index], ours - found.linear(reference.select(VELOCITY).to_numpy())


def consistency(view: RunView) -> dict[str, float]:
    """Whether the errors are as large as the filter says: normalized errors from its own standard deviations.

    The track is laid upon the reference at the start (``origin-yaw``), as the filter itself begins with
    certainty there; a fitted alignment would take part of the error away. Samples whose sigma is still 0 are
    left out.
    """
    sigma = view.table("sigma")
    compared = compare(view, "origin-yaw")
    if sigma is None or compared is None or not compared.on_estimate:
        return {}
    found = _normalized(sigma, "pos", "position", compared.t_ns, compared.error @ compared.transform.rotation)
    velocity = _velocity_error(view, compared.transform)
    if velocity is not None:
        t_ns, error = velocity
        found |= _normalized(sigma, "vel", "velocity", t_ns, error @ compared.transform.rotation)
    return found


def _normalized(
    sigma: pl.DataFrame, part: str, name: str, t_ns: IntArray, error: FloatArray
) -> dict[str, float]:
    """Return normalized squared errors; ``error`` is in the estimate's own axes, where sigma is given."""
    columns = [f"sigma_{part}_{a}" for a in "xyz"]
    if not set(columns) <= set(sigma.columns):
        return {}
    _, mine, theirs = np.intersect1d(t_ns, sigma["t_ns"].to_numpy(), return_indices=True)
    sd = sigma.select(columns).to_numpy()[theirs]
    known = np.isfinite(sd).all(axis=1) & (sd > 0).all(axis=1)
    if not known.any():
        return {}
    ratio = error[mine][known] / sd[known]
    squared = np.sum(ratio**2, axis=1)
    return {
        f"nees_{name}": float(squared.mean()),
        f"nees_{name}_end": float(squared[-1]),
        f"within95_{name}_percent": float(100.0 * np.mean(np.abs(ratio) <= 1.959964)),
    }


def nees_bounds(runs: int, dof: int = 3, confidence: float = 0.95) -> tuple[float, float]:
    """Return the interval in which the mean normalized squared error of a consistent filter lies.

    Parameters
    ----------
    runs : int
        Number of independent errors that are averaged: runs, not samples of one run (those are correlated).
    dof : int
        Dimension of one error.
    confidence : float
        Probability of the interval, two-sided.

    Returns
    -------
    tuple of float
        From the chi-square distribution with ``runs * dof`` degrees of freedom (Bar-Shalom 2001, eq 5.4.2-4).
    """
    from scipy.stats import chi2

    tail = (1 - confidence) / 2
    low, high = chi2.ppf([tail, 1 - tail], runs * dof) / runs
    return float(low), float(high)


def available_metrics() -> dict[str, Metric]:
    """Return every registered metric by name; a plug-in that does not load is a warning with its name."""
    return dict(_metrics(metadata.entry_points, tuple(sys.path)))


@lru_cache(maxsize=8)
def _metrics(scan: Callable[..., metadata.EntryPoints], path: tuple[str, ...]) -> dict[str, Metric]:
    """Load the metrics: a scan of what is installed takes 10 ms, so one a ``sys.path``, not one a run."""
    found: dict[str, Metric] = {}
    for entry in scan(group="marcha.metrics"):
        try:
            found[entry.name] = entry.load()
        except Exception as error:
            warnings.warn(f"metric plug-in {entry.name} ({entry.value}) does not load: {error}", stacklevel=2)
    return found
