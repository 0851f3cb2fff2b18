"""The work of one task: get the recording, replay it through its methods in one pass, keep the figures.

Runs in a worker process. Nothing here knows the study as a whole.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence
from fnmatch import fnmatchcase
from functools import lru_cache
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import polars as pl

from ..algorithms import make
from ..export.rules import RULES, by_rules
from ..recording import MarchaError, OutputExists, Recording, UsageError
from ..recording import create as create_recording
from ..recording import open as open_recording
from ..recording.scratch import scratch_folder
from ..recording.selection import Selection
from ..replay.api import replay
from ..replay.attachment import NOT_RAW
from ..replay.evaluate import evaluate
from ..replay.metrics import BETWEEN
from ..replay.results import Run
from ..replay.runs import warm_up
from ..replay.specs import EstimatorSpec
from .plan import Job, StudyRecording, StudyTask
from .withheld import stretches

#: Points that are kept of a track: enough for a figure, small enough for hundreds of walks.
TRACK_POINTS = 400


class StudyCell(msgspec.Struct, frozen=True):
    """What one method made of one input of one recording.

    Attributes
    ----------
    key : str
        Key of the job.
    recording, configuration, input : str
        Recording's name, its configuration, topic; the topic is empty where the job failed before it had one.
    estimator, label, preset, params : str
        The method; ``params`` as JSON.
    levels : dict of str to str
        Its level of every factor.
    status : str
        ``ok`` or ``failed``.
    error : str
        Why it failed, in one line.
    clipped : bool
        Whether the input reached its full scale.
    clipped_readings : int
        How many readings of single axes.
    findings : list of str
        What the conversion and the run remarked.
    samples : int
        Samples fed.
    run_time_s : float
        Run time of the loop over the samples; NaN where it failed.
    metrics : dict of str to float
        Every metric of the run.
    track : bytes
        Thinned positions, float32 (n, 3), in metres.
    by_label : dict of str to dict of str to float
        Every metric by the labels of the study's tier.
    """

    key: str
    recording: str
    input: str
    estimator: str
    label: str
    configuration: str = ""
    levels: dict[str, str] = {}
    preset: str = ""
    params: str = "{}"
    status: str = "ok"
    error: str = ""
    clipped: bool = False
    clipped_readings: int = 0
    findings: list[str] = []
    samples: int = 0
    run_time_s: float = math.nan
    metrics: dict[str, float] = {}
    track: bytes = b""
    by_label: dict[str, dict[str, float]] = {}

    @property
    def positions(self) -> np.ndarray:
        """Thinned track, shape (n, 3), m."""
        return np.frombuffer(self.track, np.float32).reshape(-1, 3)


def cached(source: StudyRecording, folder: Path) -> Path:
    """Return where the recording of ``source`` is, or will be once it is converted."""
    if source.kind == "mcap" and not source.truth:
        return Path(source.path)
    return folder / f"{source.name.replace('/', '__')}-{source.digest[:8]}.mcap"


def run_task(task: StudyTask) -> list[StudyCell]:
    """Do one task: prepare the recording and, unless there are no jobs, replay and evaluate it."""
    path = prepare(task.source, Path(task.folder))
    if not task.jobs:
        return []
    rec = open_recording(path)
    topics = chosen(rec, task.inputs)
    try:
        return _run(rec, task, task.jobs, topics)
    except Exception as error:
        if len(task.jobs) == 1:
            return failed(task, error)
    # One of the methods cannot run on this recording: find out which, and keep the others.
    cells: list[StudyCell] = []
    for job in task.jobs:
        try:
            cells += _run(rec, task, [job], topics)
        except Exception as error:
            cells += failed(msgspec.structs.replace(task, jobs=[job]), error)
    return cells


def failed(task: StudyTask, error: Exception) -> list[StudyCell]:
    """Return the cells of a task that ended in an error."""
    text = " ".join(str(error).split()) or type(error).__name__
    expected = isinstance(error, MarchaError | ValueError | OSError)
    reason = text if expected else f"{type(error).__name__}: {text}"
    return [_cell(job, task.source, status="failed", error=reason) for job in task.jobs]


def _cell(job: Job, source: StudyRecording, **values: Any) -> StudyCell:
    method = job.method
    return StudyCell(
        key=job.key,
        recording=source.name,
        input=values.pop("input", ""),
        estimator=method.estimator,
        label=method.label,
        levels=method.levels,
        preset=method.preset,
        params=values.pop("params", msgspec.json.encode(method.params).decode()),
        **values,
    )


def prepare(source: StudyRecording, folder: Path) -> Path:
    """Return the recording of ``source``: converted, simulated, or the file itself."""
    path = cached(source, folder)
    if path.exists():
        return path
    folder.mkdir(parents=True, exist_ok=True)
    with contextlib.suppress(OutputExists):  # another process was quicker
        if source.kind == "mcap":
            _with_truth(source, path)
        elif source.kind == "raw":
            from ..ingest import convert

            convert([source.path], path, format=source.format, options=source.options, truth=source.truth)
        else:
            _simulate(source, path)
    return path


def _survey(source: StudyRecording, folder: Path) -> Recording | None:
    """Return the survey of a recording's route, converted once where it is a raw log."""
    if not source.survey:
        return None
    path = Path(source.survey)
    if path.suffix == ".mcap":
        return open_recording(path)
    name = f"survey-{path.stem}"
    return open_recording(prepare(StudyRecording(name, "raw", source.digest, str(path)), folder))


def _with_truth(source: StudyRecording, path: Path) -> None:
    """Copy a recording and add what the study knows about its walk."""
    rec = open_recording(source.path)
    truth = {k: str(v).lower() if isinstance(v, bool) else str(v) for k, v in source.truth.items()}
    with create_recording(path) as out:
        out.copy_from(rec)
        out.add_metadata("truth", {**truth, **rec.metadata.get("truth", {})})


def _simulate(source: StudyRecording, path: Path) -> None:
    from ..ingest import convert
    from ..ingest.simulate import simulate

    with scratch_folder(path.parent) as raw:
        walk = simulate(source.scenario, raw, seed=source.seed, **source.options)
        convert(walk.paths, path)


def chosen(rec: Recording, inputs: Sequence[str]) -> list[str] | None:
    """Return the raw topics that match the study's globs; None where all do."""
    if list(inputs) == ["*"]:
        return None
    topics = [t for t in rec.channels if not t.startswith(NOT_RAW) and any(fnmatchcase(t, g) for g in inputs)]
    if not topics:
        raise MarchaError(
            f"{rec.path}: no channel matches {', '.join(inputs)}; there are "
            f"{', '.join(rec.channels) or 'none'}"
        )
    return topics


@lru_cache(maxsize=64)
def warm(name: str) -> None:
    """Compile an estimator or load it from numba's cache, so that no run time contains it."""
    estimator: Any = make(name)
    warm_up(estimator, blocks=not getattr(estimator, "offline", False))


def _run(rec: Recording, task: StudyTask, jobs: Sequence[Job], topics: list[str] | None) -> list[StudyCell]:
    """Replay one recording through all methods in one pass."""
    source = task.source
    for job in jobs:
        warm(job.method.estimator)
    specs = [
        EstimatorSpec(
            job.method.estimator,
            {**job.method.params, **({"preset": job.method.preset} if job.method.preset else {})},
            label=f"m{number}",
        )
        for number, job in enumerate(jobs)
    ]
    kept_back = stretches(task.withhold, rec)
    survey = _survey(source, Path(task.folder))
    if task.by:
        with scratch_folder() as folder:
            out = folder / "done.mcap"
            result = replay(rec, specs, inputs=topics, out=out, withhold=kept_back, survey=survey)
            by_label = _by_label(open_recording(folder / "done.mcap"), task.by)
    else:
        result, by_label = replay(rec, specs, inputs=topics, withhold=kept_back, survey=survey), {}
    imported = _import_findings(rec)
    cells: list[StudyCell] = []
    for run in result.runs:
        job = jobs[int(run.run.partition("_")[0].removeprefix("m"))]
        own = [f for f in imported if _concerns(f, run.input, rec)]
        clipped = sum(f["count"] for f in own if f["kind"] == "clipped")
        fatal = [f.detail for f in run.findings if run.fatal]
        cells.append(
            _cell(
                job,
                source,
                input=run.input,
                params=msgspec.json.encode(run.params).decode(),
                status="failed" if run.fatal else "ok",
                error="; ".join(fatal) or ("the estimator gave up" if run.fatal else ""),
                clipped=clipped > 0,
                clipped_readings=clipped,
                findings=[
                    *(f"{f['kind']} ({f['count']}): {f['detail']}" for f in own),
                    *(f"{f.kind} ({f.count}): {f.detail}" for f in run.findings),
                ],
                samples=run.samples,
                run_time_s=run.loop_s,
                metrics={k: float(v) for k, v in run.metrics.items() if isinstance(v, int | float)},
                track=_track(run),
                by_label=by_label.get(run.run, {}),
            )
        )
    return cells


def _by_label(rec: Recording, tier: str) -> dict[str, dict[str, dict[str, float]]]:
    """Return every run's metrics by the labels of a tier; none where there is neither tier nor rule."""
    marks = rec.annotations
    of_tier = (marks["tier"] == tier) | marks["tier"].str.ends_with(f"/{tier}")
    if tier in RULES and not of_tier.any():
        marks = pl.concat([marks, by_rules(rec, [tier], Selection()).select(marks.columns)])
    try:
        runs = evaluate(rec, intervals=False, by=tier, annotations=marks).runs
    except UsageError:  # a walk without this tier has no labels
        return {}
    return {
        r.run: {BETWEEN if g.label is None else g.label or "(no label)": g.metrics for g in r.groups}
        for r in runs
    }


def _import_findings(rec: Recording) -> list[dict[str, Any]]:
    return msgspec.json.decode(rec.metadata.get("import_report", {}).get("findings", "[]"))


def _concerns(finding: dict[str, Any], topic: str, rec: Recording) -> bool:
    """Tell whether a finding is about this input: it names its topic first, or no topic at all."""
    first = str(finding["detail"]).partition(" ")[0].rstrip(":")
    return first == topic or first not in rec.channels


def _track(run: Run) -> bytes:
    table = run.tables.get("pose", run.tables.get("position"))
    if table is None or not {"pos_x", "pos_y", "pos_z"} <= set(table.columns) or not table.height:
        return b""
    rows = np.unique(np.linspace(0, table.height - 1, TRACK_POINTS).round().astype(int))
    return table.select("pos_x", "pos_y", "pos_z")[rows].to_numpy().astype(np.float32).tobytes()
