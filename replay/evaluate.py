"""How good the estimates of a recording are: every metric, overall and per annotated interval."""

from __future__ import annotations

import json
import warnings
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any

import msgspec
import numpy as np
import polars as pl

from ..recording import Recording
from ..recording.errors import MarchaError, UsageError
from ..recording.names import is_estimate
from .alignment import IntArray, on_a_plan
from .gaitcycles import JointCycles, cycles
from .metrics import available_metrics
from .metrics_joint import doubts
from .references import KINDS, own_record, references, track_reference
from .trajectory import joined
from .view import RunView, Truth

NO_MARKS = pl.DataFrame(
    schema={"tier": pl.String, "start_ns": pl.Int64, "end_ns": pl.Int64, "label": pl.String}
)
"""No annotations, where they are not looked at: a day has hundreds of thousands."""


class IntervalEvaluation(msgspec.Struct):
    """Metrics of one annotated interval.

    Attributes
    ----------
    tier, label : str
        The annotation.
    start_ns, end_ns : int
        Its times, both included.
    metrics : dict of str to float
        As overall, but those that need the whole walk.
    matched, dropped : int
        As overall.
    """

    tier: str
    label: str
    start_ns: int
    end_ns: int
    metrics: dict[str, float]
    matched: int
    dropped: int


class GroupEvaluation(msgspec.Struct):
    """Metrics of all intervals of a tier that have one label, taken together.

    Attributes
    ----------
    label : str or None
        None: what none of the tier's intervals covers.
    intervals : int
        How many; for the rest, the stretches between them.
    duration_s : float
        Their time together; what several cover counts once.
    metrics : dict of str to float
        As overall, but those that need one stretch with a start and an end, or the whole walk.
    matched, dropped : int
        As overall. Over the groups of labels that do not overlap they add up to the walk's.
    """

    label: str | None
    intervals: int
    duration_s: float
    metrics: dict[str, float]
    matched: int
    dropped: int


class RunEvaluation(msgspec.Struct):
    """Metrics of one run.

    Attributes
    ----------
    run, estimator, input : str
        Id, name, topic of the first input.
    metrics : dict of str to float
        Empty where the run's results must not be used.
    matched, dropped : int
        Samples that were compared with the reference, and those that have no partner there.
    max_time_difference_s : float
        Largest distance in time between a compared sample and the nearest one of the other track.
    alignment : str
        Which alignment the errors are after; empty without a reference.
    time_base : str
        ``estimate`` or ``reference``: at whose stamps they were compared; empty without a reference.
    note : str
        Why there are no metrics, or what is odd about them.
    intervals : list of IntervalEvaluation
        Per annotated interval.
    groups : list of GroupEvaluation
        Per label of the tier that was asked for.
    cycles : list of JointCycles
        Joint angles over the gait cycle.
    """

    run: str
    estimator: str
    input: str
    metrics: dict[str, float] = {}
    matched: int = 0
    dropped: int = 0
    max_time_difference_s: float = 0.0
    alignment: str = ""
    time_base: str = ""
    note: str = ""
    intervals: list[IntervalEvaluation] = []
    groups: list[GroupEvaluation] = []
    cycles: list[JointCycles] = []


class Evaluation(msgspec.Struct):
    """Metrics of every run of a recording.

    Attributes
    ----------
    runs : list of RunEvaluation
        In the order of the recording.
    """

    runs: list[RunEvaluation]


class Missed(msgspec.Struct, frozen=True):
    """A bound that a run broke: ``value`` is None where the run does not have the metric."""

    run: str
    metric: str
    value: float | None
    bound: float
    kind: str


def evaluate(
    rec: Recording,
    *,
    runs: list[str] | None = None,
    alignment: str | None = None,
    max_gap_s: float = 0.1,
    reference: str | None = None,
    intervals: bool = True,
    truth: Mapping[str, str] | None = None,
    by: str | None = None,
    annotations: pl.DataFrame | None = None,
    survey: Recording | None = None,
) -> Evaluation:
    """Measure every run of a replayed recording.

    Parameters
    ----------
    rec : Recording
        With estimates, as :func:`replay` writes it.
    runs : list of str, optional
        Ids; all without it.
    alignment : {"none", "origin", "origin-yaw", "se2", "sim2", "se3"}, optional
        How a track is laid upon the reference; see :func:`marcha.replay.alignment.align`. Without it
        :func:`usual_alignment` decides.
    max_gap_s : float
        Reference samples farther apart are not interpolated between.
    reference : str, optional
        Topic of a reference. Without it the one named like the run's input (``/reference/imu2/pose``
        for ``/foot/imu2``), else ``/reference/pose``, else the only one of its kind below ``/reference/``.
    intervals : bool
        Whether annotated intervals are measured too.
    truth : mapping, optional
        What is known of the walk beside what the recording says: ``closed``, ``length_m``, ``steps``.
    by : str, optional
        Tier whose labels are measured one beside the other, with what lies between. A run's own tier
        (``turn`` for ``<run>/turn``) comes before one of this name.
    annotations : polars.DataFrame, optional
        To be used instead of those of the recording.
    survey : Recording, optional
        Of the same route walked another time (``/reference/fix``, else its only fixes): tracks are measured by
        their distance to its line.

    Returns
    -------
    Evaluation

    Raises
    ------
    MarchaError
        Where the recording has no estimates.
    UsageError
        An unknown run, alignment, reference or tier.
    """
    lineages = {n.removeprefix("run/"): m for n, m in rec.metadata.items() if n.startswith("run/")}
    for topic in rec.channels:  # estimates of others' tools have no record
        if is_estimate(topic):
            lineages.setdefault(topic.split("/")[2], {})
    if not lineages:
        raise MarchaError(f"{rec.path}: has no estimates; run `marcha replay` first")
    for run in runs or ():
        if run not in lineages:
            raise UsageError(f"{rec.path}: no run {run}; there are {', '.join(lineages)}")
    chosen = {run: lineage for run, lineage in lineages.items() if runs is None or run in runs}
    marks = annotations if annotations is not None else rec.annotations if intervals or by else NO_MARKS
    if by is not None and not marks["tier"].is_in([by, *(f"{run}/{by}" for run in chosen)]).any():
        raise UsageError(
            f"{rec.path}: no tier {by!r}; there are {', '.join(marks['tier'].unique(maintain_order=True)) or 'none'} "
            "(`marcha annotate rules` adds turns, stairs and the like)"
        )
    marked = _intervals(marks, lineages) if intervals else pl.DataFrame()
    measured = []
    for run, lineage in chosen.items():  # one at a time: each holds its track
        view = recording_view(
            rec,
            {"run": run, **lineage},
            None,
            alignment=alignment,
            max_gap_s=max_gap_s,
            reference=reference,
            truth=truth,
            survey=survey,
        )
        measured.append(evaluate_run(view, marked, _tier(marks, run, by) if by else None))
    return Evaluation(measured)


def recording_view(
    rec: Recording | None,
    lineage: Mapping[str, str],
    tables: Mapping[str, pl.DataFrame] | None,
    start_ns: int | None = None,
    end_ns: int | None = None,
    *,
    alignment: str | None = None,
    max_gap_s: float = 0.1,
    reference: str | None = None,
    truth: Mapping[str, str] | None = None,
    survey: Recording | None = None,
) -> RunView:
    """Return what the metrics of one run look at: its tables in memory, or those of the recording.

    Parameters
    ----------
    rec : Recording or None
        Holds the reference, the truth, and the estimates where ``tables`` is None.
    lineage : mapping
        The record ``run/<id>``.
    tables : mapping or None
        Results by output.
    start_ns, end_ns : int, optional
        Range of the replay; a walk's length says nothing of a part of it.
    alignment, max_gap_s, reference, truth, survey
        As in :func:`evaluate`.
    """
    run = lineage["run"]

    def output(name: str, columns: Sequence[str] | None) -> pl.DataFrame | None:
        if tables is not None:
            table = tables.get(name)
            return table if columns is None or table is None else _some(table, columns)
        topic = f"/estimate/{run}/{name}"
        if rec is None or topic not in rec.channels:
            return None
        if columns is None or not rec.channels[topic].count:
            return rec.table(topic)
        parts = [_some(w.tables[topic], columns) for w in rec.windows([topic])]
        return pl.concat(parts) if parts else rec.table(topic)

    def stream(name: str) -> tuple[int, Iterator[pl.DataFrame]] | None:
        topic = f"/estimate/{run}/{name}"
        if rec is None or topic not in rec.channels:
            return None
        return rec.channels[topic].count, (w.tables[topic] for w in rec.windows([topic]))

    start_ns = start_ns if start_ns is not None else _number(lineage.get("range.start_ns"))
    end_ns = end_ns if end_ns is not None else _number(lineage.get("range.end_ns"))
    whole = start_ns is None and end_ns is None
    stated = rec.metadata.get(own_record(lineage, "truth"), {}) if rec is not None else {}
    facts = {**stated, **(truth or {})}
    topics = _track_references(rec, lineage.get("input", ""), reference) if rec is not None else (None, None)
    track, velocity = topics
    return RunView(
        run=run,
        estimator=lineage.get("estimator", ""),
        lineage=lineage,
        output=output,
        truth=truth_of({"truth": facts}) if whole else Truth(),
        reference=rec.table(track) if rec is not None and track is not None else None,
        reference_velocity=rec.table(velocity) if rec is not None and velocity is not None else None,
        recording=rec,
        chosen_reference=reference,
        alignment=alignment or usual_alignment(rec, lineage, track),
        max_gap_s=max_gap_s,
        reference_frame=rec.channels[track].frame_id if rec is not None and track is not None else "",
        survey=None if survey is None else surveyed(survey),
        stream=stream if tables is None else None,
    )


def surveyed(rec: Recording) -> pl.DataFrame:
    """Return the places of a survey."""
    fixes = [
        t for t, c in rec.channels.items() if c.schema in KINDS["fix"] and not t.startswith("/estimate/")
    ]
    own = references(rec.channels, "fix") or fixes
    if len(own) != 1:
        raise UsageError(f"{rec.path}: is no survey: it has {len(own)} channels of fixes, a survey has one")
    return rec.table(own[0])


def usual_alignment(rec: Recording | None, lineage: Mapping[str, str], track: str | None) -> str:
    """Return how a run is laid upon its reference where the user does not say.

    On a floor plan as :func:`on_a_plan` says, else ``se3``: the frames are not the same.
    """
    frame = "" if rec is None or track is None else rec.channels[track].frame_id
    return on_a_plan(lineage.get("frame", ""), frame) or "se3"


def _track_references(rec: Recording, input_topic: str, chosen: str | None) -> tuple[str | None, str | None]:
    """Return the topics of the reference track (poses before positions) and of the velocity beside it."""
    track = track_reference(rec.channels, input_topic, chosen, str(rec.path))
    if track is None:
        return None, None
    beside = track.rpartition("/")[0] + "/velocity"
    return track, beside if beside in rec.channels else None


def evaluate_run(
    view: RunView, intervals: pl.DataFrame | None = None, tier: pl.DataFrame | None = None
) -> RunEvaluation:
    """Measure one run; a run that is fatal or was restarted in between is said so, not measured.

    Parameters
    ----------
    view : RunView
        The run.
    intervals : polars.DataFrame, optional
        Annotated intervals (``tier, start_ns, end_ns, label``) to measure as well.
    tier : polars.DataFrame, optional
        Intervals to measure together by label.
    """
    done = RunEvaluation(view.run, view.estimator, view.lineage.get("input", ""))
    if view.lineage.get("fatal") == "true":
        details = [d for _, _, d in json.loads(view.lineage.get("findings", "[]"))]
        done.note = f"results must not be used: {details[-1] if details else 'see the findings'}"
        return done
    if int(view.lineage.get("segments", 1)) > 1:
        done.note = "the estimator was restarted at gaps (policy reset): segments do not share an origin"
        return done
    done.metrics = _measure(view)
    done.cycles = cycles(view)
    done.note = "; ".join(doubts(view))
    if "loop_s" in view.lineage:
        done.metrics["run_time_s"] = float(view.lineage["loop_s"])
    done.matched, done.dropped = _matched(view)
    if view.comparison is not None:
        done.alignment = view.alignment
        done.time_base = "estimate" if view.comparison.on_estimate else "reference"
        done.max_time_difference_s = view.comparison.matches.max_distance_s
    for row in intervals.iter_rows(named=True) if intervals is not None else ():
        part = view.part(_spans([row["start_ns"]], [row["end_ns"]]))
        done.intervals.append(
            IntervalEvaluation(
                row["tier"], row["label"], row["start_ns"], row["end_ns"], _measure(part), *_matched(part)
            )
        )
    if tier is not None:
        done.groups = _groups(view, tier)
    return done


def _groups(view: RunView, tier: pl.DataFrame) -> list[GroupEvaluation]:
    """Measure the intervals of each label together, and what no interval covers."""
    by_label = tier.partition_by("label", as_dict=True, maintain_order=True)
    parts: list[tuple[str | None, int, IntArray]] = [
        (str(label), rows.height, _spans(rows["start_ns"], rows["end_ns"]))
        for (label,), rows in by_label.items()
    ]
    covered = joined(_spans(tier["start_ns"], tier["end_ns"]))
    limits = np.iinfo(np.int64)
    edges = np.r_[limits.min, covered.ravel(), limits.max].reshape(-1, 2)
    first, last = _extent(view)
    parts.append((None, int(((edges[:, 1] > first) & (edges[:, 0] <= last)).sum()), edges))
    groups = []
    for label, count, spans in parts:
        part = view.part(spans)
        assert part.spans is not None
        inner = np.clip(part.spans, first, last)
        seconds = float((inner[:, 1] - inner[:, 0]).sum()) * 1e-9
        groups.append(GroupEvaluation(label, count, seconds, _measure(part), *_matched(part)))
    return groups


def _spans(start_ns: Any, end_ns: Any) -> IntArray:
    """Return half-open stretches (k, 2) of annotations, which include their end."""
    return np.column_stack((np.asarray(start_ns, np.int64), np.asarray(end_ns, np.int64) + 1))


def _extent(view: RunView) -> tuple[int, int]:
    """Return the first and the last time that the run, or its recording, speaks of."""
    if view.recording is not None and view.recording.channels:
        return view.recording.start_ns, view.recording.end_ns
    return (int(view.track.t_ns[0]), int(view.track.t_ns[-1])) if view.track is not None else (0, 0)


def _tier(annotations: pl.DataFrame, run: str, tier: str) -> pl.DataFrame:
    """Return the intervals of a run's own tier, else of the tier of this name."""
    lasting = annotations.filter(pl.col("end_ns") > pl.col("start_ns"))
    own = lasting.filter(pl.col("tier") == f"{run}/{tier}")
    return own if own.height else lasting.filter(pl.col("tier") == tier)


def check_thresholds(
    evaluation: Evaluation,
    maximum: Mapping[str, float] | None = None,
    minimum: Mapping[str, float] | None = None,
) -> list[Missed]:
    """Return every bound that a run breaks. A run without the metric, or with NaN, breaks it.

    Raises
    ------
    UsageError
        A metric that no run has: a misspelt bound must not pass.
    """
    names = list(dict.fromkeys(m for r in evaluation.runs for m in r.metrics))
    missed = []
    for kind, bounds in (("max", maximum or {}), ("min", minimum or {})):
        for metric, bound in bounds.items():
            if metric not in names:
                raise UsageError(
                    f"--{kind} {metric}: no run has this metric; there are {', '.join(names) or 'none'}"
                )
            for run in evaluation.runs:
                value = run.metrics.get(metric)
                if value is None or not (value <= bound if kind == "max" else value >= bound):
                    missed.append(Missed(run.run, metric, value, bound, kind))
    return missed


def truth_of(records: Mapping[str, Mapping[str, str]]) -> Truth:
    """Return what a recording's metadata record ``truth`` knows of the walk."""
    record = records.get("truth", {})
    closed = record.get("closed", "").lower()
    return Truth(
        {"true": True, "false": False}.get(closed),
        _truth_number(record, "length_m"),
        _truth_number(record, "steps"),
    )


def _truth_number(record: Mapping[str, str], name: str) -> float | None:
    try:
        value = float(record[name]) if record.get(name) else None
    except ValueError:
        value = float("nan")
    if value is not None and not value > 0:
        raise MarchaError(f"metadata record truth: {name} {record[name]!r} is no number above 0")
    return value


def _some(table: pl.DataFrame, columns: Sequence[str]) -> pl.DataFrame:
    return table.select("t_ns", *(c for c in columns if c in table.columns))


def _measure(view: RunView) -> dict[str, float]:
    metrics: dict[str, float] = {}
    for name, metric in available_metrics().items():
        try:
            metrics |= {k: float(v) for k, v in metric(view).items()}
        except MarchaError:
            raise
        except Exception as error:
            if (getattr(metric, "__module__", "") or "").startswith("marcha."):
                raise
            warnings.warn(f"metric plug-in {name} failed on run {view.run}: {error}", stacklevel=2)
    return metrics


def _matched(view: RunView) -> tuple[int, int]:
    compared = view.comparison
    if compared is None:
        return 0, len(view.track) if view.reference is not None and view.track is not None else 0
    return len(compared.matches.index), compared.matches.dropped


def _intervals(annotations: pl.DataFrame, runs: Collection[str]) -> pl.DataFrame:
    """Return the annotations that are intervals and that no run wrote (``<run>/<tier>``)."""
    own = pl.col("tier").str.split("/").list.first().is_in(list(runs))
    return annotations.filter((pl.col("end_ns") > pl.col("start_ns")) & ~own)


def _number(text: str | None) -> int | None:
    return int(text) if text else None
