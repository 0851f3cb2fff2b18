"""``replay``: a recording through estimators in one call."""

from __future__ import annotations

import contextlib
import json
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from ..algorithms.calibration import Calibration
from ..recording import Recording
from ..recording import open as open_recording
from ..recording.errors import OutputExists, UsageError
from ..recording.files import require_other
from ..recording.names import is_estimate
from ..recording.provenance import hash_file
from ..recording.threads import give_back_memory
from .clock import Clock
from .engine import Engine, Progress
from .evaluate import evaluate, evaluate_run, recording_view, surveyed, truth_of
from .gaps import GapPolicy, Gaps
from .plan import EstimatorLike, plan_runs
from .results import ReplayResult, Run
from .sinks import RecordingSink, Sink, TableSink
from .sources import RecordingSource, Source, SourceFailed


def replay(
    recording: Recording | Source,
    estimators: Sequence[EstimatorLike],
    params: Mapping[str, Any] | None = None,
    *,
    inputs: Sequence[str] | None = None,
    speed: float | str = "max",
    start_ns: int | None = None,
    end_ns: int | None = None,
    out: Path | str | None = None,
    overwrite: bool = False,
    mode: Literal["block", "sample"] = "block",
    gap: Gaps | str | None = None,
    sinks: Sequence[Sink] = (),
    keep_tables: bool = True,
    metrics: bool = True,
    clock: Clock | None = None,
    progress: Progress | None = None,
    calibrations: Sequence[Calibration] = (),
    withhold: Mapping[str, Sequence[tuple[int, int]]] | None = None,
    survey: Recording | None = None,
    max_rows: int = 65_536,
) -> ReplayResult:
    """Feed a recording (or a live source) to estimators, as if it happened now, and keep what they say.

    Parameters
    ----------
    recording : Recording or Source
        As :func:`marcha.recording.open` gives it; or a :class:`LiveSource`.
    estimators : sequence
        Names (``foot.9iez``, ``slow=foot.9iez[sigma_acc=0.01]``), or classes or instances of one's own. All
        run in one pass.
    params : mapping, optional
        Parameters for every estimator that has them; those in the brackets of a name win.
    inputs : sequence of str, optional
        ``role=topic``, or topics alone; without it every raw channel of an estimator's kind, one run each.
    speed : "max" or float
        Factor of real time. The results have the same bits at any speed.
    start_ns, end_ns : int, optional
        Range of log times, half open.
    out : path, optional
        Recording to write: all that was in the input, the estimates, stance and step annotations, lineage.
    overwrite : bool
        Whether ``out`` may be replaced.
    mode : {"block", "sample"}
        Whole blocks through the estimators that take them, or one step a sample. Same bits.
    gap : GapPolicy or str
        What happens when a regular input of an estimator pauses: ``bridge`` (default), ``reset`` or ``stop``;
        or a mapping from the names of inputs to policies.
    sinks : sequence of Sink
        Further observers: a viewer, a file, a test.
    keep_tables : bool
        Keep the results in memory (``result.runs[i].tables``). Without it memory does not grow with the
        length, and metrics are measured only where ``out`` is given (from there).
    metrics : bool
        Measure the runs.
    clock : Clock, optional
        Paces the replay.
    progress : callable, optional
        Called with nanoseconds done and in all.
    calibrations : sequence of Calibration
        Handed to estimators, before those that the recording has.
    withhold : mapping of str to sequence of (int, int), optional
        Messages of a recording that no estimator is given, by topic: from when to when (log time in ns, half
        open). An artificial loss of a signal; metrics measure the track at its end (``loss_error_m``).
    survey : Recording, optional
        For the metrics; see :func:`evaluate`.
    max_rows : int
        Rows of a block.

    Returns
    -------
    ReplayResult

    Raises
    ------
    UsageError
        Unknown names, parameters or topics; a missing column; ``out`` is the input.
    SourceFailed
        A live source broke off; ``out`` holds what it delivered before.
    OutputExists
        ``out`` is there and ``overwrite`` is false.
    """
    rec = recording if isinstance(recording, Recording) else None
    source: Source = (
        RecordingSource(rec, max_rows, withhold) if rec is not None else recording  # type: ignore[assignment]
    )
    target = Path(out) if out is not None else None
    if target is not None:
        require_other(target, [rec.path] if rec is not None else [])
        if target.exists() and not overwrite:
            raise OutputExists(target)
    if rec is not None and metrics:
        if survey is not None:
            surveyed(survey)
        truth_of(rec.metadata)  # what cannot be measured against is said before anything is written
    taken = [n.removeprefix("run/") for n in rec.metadata if n.startswith("run/")] if rec is not None else []
    taken += {t.split("/")[2] for t in source.channels if is_estimate(t)}
    runs = plan_runs(source, estimators, params, inputs, taken, calibrations)
    tables = TableSink() if keep_tables else None
    own: list[Sink] = [
        s for s in (tables, RecordingSink(target, rec, overwrite) if target else None) if s is not None
    ]

    def complete(done: list[Run]) -> None:
        digest = hash_file(Path(rec.path)) if rec is not None and target is not None else ""
        for run in done:
            run.lineage["input_recording"] = source.name
            if digest:
                run.lineage["input_blake2b"] = digest
            if withhold:
                run.lineage["withheld"] = json.dumps(
                    {t: [list(p) for p in spans] for t, spans in withhold.items()}
                )
            if tables is not None:
                kept = {name: tables.table(topic) for name, topic in run.outputs.items()}
                run.tables = {name: t for name, t in kept.items() if t is not None}
                with _kept_unmeasured():
                    if metrics:
                        view = recording_view(rec, run.lineage, run.tables, start_ns, end_ns, survey=survey)
                        measured = evaluate_run(view)
                        run.metrics, run.alignment = measured.metrics, measured.alignment

    engine = Engine(
        source,
        runs,
        sinks=(*own, *sinks),
        mode=mode,
        speed=speed,
        gap=GapPolicy(gap) if isinstance(gap, str) else gap,  # type: ignore[arg-type]
        clock=clock,
        start_ns=start_ns,
        end_ns=end_ns,
        checkpoint_s=None,
        progress=progress,
    )
    failure: SourceFailed | None = None
    with engine:
        try:
            engine.play()
        except KeyboardInterrupt:  # the way to end a live session: keep what was heard
            if source.seekable:
                raise
        except SourceFailed as error:
            failure = error
        result = engine.finish(complete)
    if failure is not None:
        raise failure
    if target is not None and tables is None and metrics:
        del engine  # its buffers and what is in the file make room for the tracks
        for run in result.runs:
            run.annotations = run.annotations.clear()
        give_back_memory()
        with _kept_unmeasured(), open_recording(target) as written:
            evaluation = evaluate(written, runs=[r.run for r in result.runs], intervals=False, survey=survey)
            evaluated = {r.run: r for r in evaluation.runs}
            for run in result.runs:
                run.metrics, run.alignment = evaluated[run.run].metrics, evaluated[run.run].alignment
    return result


@contextlib.contextmanager
def _kept_unmeasured() -> Iterator[None]:
    """Keep a replay that cannot be measured without a choice of the user's: of several references, say."""
    try:
        yield
    except UsageError as error:
        warnings.warn(f"not measured: {error}; `marcha evaluate` takes it", stacklevel=4)
