"""The engine: messages in log-time order through many estimators, at any speed, forward and back."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import msgspec
import numpy as np

from ..recording.errors import UsageError
from ..recording.provenance import environment
from ..recording.threads import Prefetch
from .blocks import Block, joined_by_name
from .calibrations import corrections
from .clock import Clock, SystemClock
from .gaps import GapPolicy, Gaps, policy_of
from .merging import LEVELS, Merged, MergedPart
from .messages import MessageFeed
from .plan import Plan, PlannedRun
from .results import ReplayResult, Run
from .rows import RowFeed
from .runs import Runner, runner_of
from .sinks import RecordingSink, Sink
from .sources import Batch, Source

Progress = Callable[[int, int], object]
"""Called with nanoseconds done and nanoseconds in all (0 where the end is not known)."""

TICK_S = 0.02
"""Beat of a paced replay: what became due since the last one goes through, and a pause is noticed."""


@dataclass(frozen=True)
class _Checkpoint:
    """Everything at one log time: all messages before it are through, none from it on."""

    log_ns: int
    feeds: tuple[Any, ...]
    runners: tuple[Any, ...]
    written: dict[str, int]


class Engine:
    """Feeds the messages of a source to runs.

    Parameters
    ----------
    source : Source
        Where messages come from.
    runs : sequence of PlannedRun
        See :func:`plan_runs`.
    sinks : sequence of Sink
        Take raw messages and results.
    mode : {"block", "sample"}
        ``block`` hands whole blocks to estimators that take them, ``sample`` steps sample by sample. Same
        bits.
    speed : "max" or float
        Factor of real time.
    gap : GapPolicy or mapping of str to GapPolicy
        What happens when a regular input of an estimator pauses; by the name of the input where they differ.
    clock : Clock
        Paces the replay.
    start_ns, end_ns : int, optional
        Range of log times, half open.
    checkpoint_s : float or None
        Keep the state about every so many seconds of the recording, to seek back to; None keeps only the
        start.
    progress : callable, optional
        Called with nanoseconds done and in all.

    Notes
    -----
    Use it as a context manager, or call :meth:`finish` (results) or :meth:`abort` (nothing remains).
    One thread drives it; only :meth:`pause` may be called from another.
    """

    def __init__(
        self,
        source: Source,
        runs: Sequence[PlannedRun],
        *,
        sinks: Sequence[Sink] = (),
        mode: Literal["block", "sample"] = "block",
        speed: float | str = "max",
        gap: Gaps | None = None,
        clock: Clock | None = None,
        start_ns: int | None = None,
        end_ns: int | None = None,
        checkpoint_s: float | None = 10.0,
        progress: Progress | None = None,
    ) -> None:
        if mode not in ("block", "sample"):
            raise UsageError(f"mode {mode!r} is unknown; choose block or sample")
        if start_ns is not None and end_ns is not None and end_ns <= start_ns:
            raise UsageError(f"the range ends at {end_ns} ns, not after its start {start_ns} ns")
        self.source = source
        self.mode: Literal["block", "sample"] = mode
        self.speed = speed_factor(speed)
        self.gap = gap or GapPolicy()
        self.clock: Clock = clock or SystemClock()
        self.sinks = tuple(sinks)
        self.finished = False
        self._start_ns, self._end_ns = start_ns, end_ns
        self._checkpoint_ns = None if checkpoint_s is None else int(checkpoint_s * 1e9)
        self._progress = progress
        self._paused = threading.Event()

        feeds: dict[Any, RowFeed | MessageFeed] = {}
        self.runners: list[Runner] = []
        for run in runs:
            if (key := (run.takes_rows, run.inputs)) not in feeds:
                feeds[key] = (
                    RowFeed(run.row_inputs, policy_of(self.gap, run.inputs[0].input), run.rate_hz)
                    if run.takes_rows
                    else MessageFeed(run.inputs, self.gap)
                )
            self.runners.append(runner_of(run, feeds[key], blocks=mode == "block"))
        self._feeds = list(feeds.values())
        served = {c.topic for r in runs for c in r.inputs}
        self._read_by_runs = {c.topic for r in runs for c in r.outputs.values() if c.topic in served}
        chosen = {(c.kind, c.subject): c for r in runs for c in r.calibrations}
        self._corrections, self._corrected = corrections(list(chosen.values()), source.channels)

        raw = any(s.raw for s in self.sinks)
        self._topics = [t for t in source.channels if raw or t in served]
        self._raw_topics = set(source.channels) if raw else set()
        estimates = {c.topic: c for r in runs for c in r.outputs.values()}
        self.plan = Plan(source.name, {t: source.channels[t] for t in self._topics} | estimates, tuple(runs))

        self._written: dict[str, int] = {}
        self._most_written: dict[
            str, int
        ] = {}  # by topic, before any rewind: sinks without rewind have those
        self._position_ns = self._begin_ns = start_ns if start_ns is not None else source.start_ns
        self._newest_ns = 0
        self._merged: Merged | None = None
        self._cursor = 0
        self._batches: Iterator[Batch] | None = None
        self._exhausted = False
        self._checkpoints = [self._checkpoint(self._position_ns)]
        if self.source.seekable:
            self._batches = self._reading()  # while the sinks copy what they are given
        try:
            for sink in self.sinks:
                sink.open(self.plan)
        except BaseException:
            self._stop_reading()
            self._close_sinks(None)
            raise

    # -- use -----------------------------------------------------------------------------------------

    def __enter__(self) -> Engine:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if self.finished:
            return
        if kind is None:
            self.finish()
        else:
            self.abort()

    @property
    def position_ns(self) -> int:
        """Log time up to which messages are through."""
        return self._position_ns

    @property
    def at_end(self) -> bool:
        """Whether all messages are through."""
        return self._exhausted

    def pause(self) -> None:
        """Make :meth:`play` return before its next messages; may be called from a sink or another thread."""
        self._paused.set()

    def play(self, until_ns: int | None = None) -> bool:
        """Go on at the engine's speed until the end, a pause, or log time ``until_ns`` (exclusive).

        Returns
        -------
        bool
            True where the end of the source was reached.
        """
        self._paused.clear()
        if self.speed is None or not self.source.seekable:  # a live source paces itself
            return self._run_free(until_ns)
        return self._run_paced(until_ns, self.speed)

    def step(self) -> tuple[str, int] | None:
        """Take exactly one message; return its topic and log time, None at the end."""
        merged = self._window()
        if merged is None:
            return None
        place, log_ns = self._cursor, int(merged.log_ns[self._cursor])
        topic = next(
            t for t, p in merged.positions.items() if p[min(np.searchsorted(p, place), len(p) - 1)] == place
        )
        self._advance(merged, place + 1)
        return topic, log_ns

    def seek(self, t_ns: int) -> None:
        """Go to log time ``t_ns``: every message before it is through, none from it on.

        The state is the same as after playing there from the start.

        Raises
        ------
        UsageError
            Where the source cannot go back (a live one).
        """
        if self.finished:
            raise UsageError("the replay is finished; start a new one to seek")
        if not self.source.seekable:
            raise UsageError(f"{self.source.name}: a live source cannot seek")
        if t_ns < self._position_ns:
            before = [c for c in self._checkpoints if c.log_ns <= t_ns]
            self._restore(before[-1] if before else self._checkpoints[0])
        self._run_free(t_ns, interruptible=False)

    def finish(self, complete: Callable[[list[Run]], None] | None = None) -> ReplayResult:
        """Take the results that estimators still hold and close the sinks.

        Parameters
        ----------
        complete : callable, optional
            Called with the runs before the sinks are closed: adds metrics and lineage.
        """
        self._stop_reading()
        end_ns = max(self._newest_ns, self.source.end_ns if self._end_ns is None else self._newest_ns)
        self._drive(MergedPart({}, {}), end_ns)
        output = next((s.path for s in self.sinks if isinstance(s, RecordingSink)), None)
        result = ReplayResult(output, [self._result(r) for r in self.runners])
        if complete is not None:
            complete(result.runs)
        self.finished = True
        self._close_sinks(result)
        return result

    def abort(self) -> None:
        """Stop; sinks drop what they have."""
        self._stop_reading()
        self.finished = True
        self._close_sinks(None)

    def _close_sinks(self, result: ReplayResult | None) -> None:
        errors: list[Exception] = []
        for sink in self.sinks:
            try:
                sink.close(result)
            except Exception as error:
                errors.append(error)
        if errors and result is not None:
            raise errors[0]

    # -- time ----------------------------------------------------------------------------------------

    def _run_free(self, until_ns: int | None, interruptible: bool = True) -> bool:
        while not (interruptible and self._paused.is_set()):
            merged = self._window()
            if merged is None:
                return True
            last = len(merged) if until_ns is None else int(np.searchsorted(merged.log_ns, until_ns))
            if last > self._cursor:
                self._advance(merged, last)
            if last < len(merged):
                assert until_ns is not None
                self._position_ns = max(self._position_ns, until_ns)
                return False
        return False

    def _run_paced(self, until_ns: int | None, speed: float) -> bool:
        began = self.clock.now_ns()
        merged = self._window()
        if merged is None:
            return True
        origin = int(merged.log_ns[self._cursor])
        while not self._paused.is_set():
            merged = self._window()
            if merged is None:
                return True
            due = origin + int((self.clock.now_ns() - began) * speed)
            limit = due + 1 if until_ns is None else min(due + 1, until_ns)
            last = int(np.searchsorted(merged.log_ns, limit))
            if last > self._cursor:
                self._advance(merged, last)
                continue
            if until_ns is not None and merged.log_ns[self._cursor] >= until_ns:
                return False
            self.clock.sleep(TICK_S)
        return False

    # -- messages ------------------------------------------------------------------------------------

    def _window(self) -> Merged | None:
        """Return the present batch with messages left in it, None at the end."""
        while self._merged is None or self._cursor >= len(self._merged):
            if self._exhausted:
                return None
            if self._batches is None:
                self._batches = self._reading()
            batch = next(self._batches, None)
            if batch is None:
                self._exhausted = True
                return None
            self._merged, self._cursor = Merged(batch), 0
        return self._merged

    def _reading(self) -> Iterator[Batch]:
        batches = self.source.batches(self._topics, self._position_start(), self._end_ns)
        return Prefetch(batches, "replay", 2) if self.source.seekable else batches  # live: has its own queue

    def _position_start(self) -> int | None:
        return self._position_ns if self._position_ns != self._begin_ns else self._start_ns

    def _advance(self, merged: Merged, last: int) -> None:
        """Take the messages of the present batch up to place ``last``."""
        part = merged.part(self._cursor, last)
        for topic, table in part.tables.items():
            if topic in self._raw_topics:
                self._emit(topic, Block(table), raw=True)
            if topic in self._corrections:
                part.tables[topic] = self._corrections[topic](table)
        self._drive(part)
        self._cursor = last
        self._newest_ns = max(self._newest_ns, int(merged.log_ns[last - 1]))
        whole = last == len(merged)
        newest = int(merged.log_ns[last - 1])
        following = max(merged.batch.end_ns, newest + 1) if whole else int(merged.log_ns[last])
        self._position_ns = following
        keep = following > newest and self._checkpoint_ns is not None and self.source.seekable
        if keep and following >= self._checkpoints[-1].log_ns + (self._checkpoint_ns or 0):
            self._checkpoints.append(self._checkpoint(following))
        if self._progress is not None:
            begin, end = self._begin_ns, self._end_ns if self._end_ns is not None else self.source.end_ns
            self._progress(min(newest, end) - begin if end > begin else newest, max(0, end - begin))

    def _drive(self, part: MergedPart, end_ns: int | None = None) -> None:
        """Take the messages of a part through all runs, each behind those whose outputs it reads.

        ``end_ns``: these are the last ones; estimators give what they hold.
        """
        taken: dict[int, Any] = {}
        for level, runner in enumerate(self.runners, 1):
            feed = runner.feed
            if id(feed) not in taken:
                taken[id(feed)] = feed.take(part)
            ready = taken[id(feed)]
            blocks = runner.take(ready) if len(ready) else {}
            if end_ns is not None:
                blocks = joined_by_name([blocks, runner.finish(end_ns)])
            for name, block in blocks.items():
                topic = runner.plan.outputs[name].topic
                self._emit(topic, block)
                if topic in self._read_by_runs:
                    assert block.keys is not None
                    part.add(topic, block.table, block.keys // LEVELS * LEVELS + level)

    def _emit(self, topic: str, block: Block, raw: bool = False) -> None:
        before = self._written.get(topic, 0)
        after = self._written[topic] = before + len(block)
        most = self._most_written.get(topic, 0)
        self._most_written[topic] = max(most, after)
        for sink in self.sinks:
            if raw and not sink.raw:
                continue
            fresh = block if sink.rewinds else block.since(max(0, most - before))
            if len(fresh):
                sink.write_block(topic, fresh)

    # -- going back ----------------------------------------------------------------------------------

    def _checkpoint(self, log_ns: int) -> _Checkpoint:
        return _Checkpoint(
            log_ns,
            tuple(f.snapshot() for f in self._feeds),
            tuple(r.snapshot() for r in self.runners),
            dict(self._written),
        )

    def _restore(self, checkpoint: _Checkpoint) -> None:
        self._stop_reading()
        for feed, snapshot in zip(self._feeds, checkpoint.feeds, strict=True):
            feed.restore(snapshot)
        for runner, snapshot in zip(self.runners, checkpoint.runners, strict=True):
            runner.restore(snapshot)
        self._written = dict(checkpoint.written)
        self._position_ns = checkpoint.log_ns
        self._merged, self._cursor, self._exhausted = None, 0, False
        for sink in self.sinks:
            sink.rewind(checkpoint.log_ns)

    def _stop_reading(self) -> None:
        close = getattr(self._batches, "close", None)
        if close is not None:
            close()
        self._batches = None

    # -- results -------------------------------------------------------------------------------------

    def _result(self, runner: Runner) -> Run:
        plan, feed = runner.plan, runner.feed
        findings, fatal = runner.findings()
        outputs = {name: c.topic for name, c in plan.outputs.items()}
        gap = policy_of(self.gap, plan.inputs[0].input)
        read = dict.fromkeys(c.topic for c in plan.inputs)
        findings = [*findings, *(f for topic in read for f in self._corrected.get(topic, ()))]
        lineage = {
            "run": plan.run,
            "estimator": plan.name,
            "version": plan.version,
            "environment": environment(),
            "source": str(getattr(plan.estimator, "source", "")),
            "input": plan.input,
            "inputs": json.dumps(plan.topics),
            "params": json.dumps(plan.params),
            **{f"param.{k}": v if isinstance(v, str) else json.dumps(v) for k, v in plan.params.items()},
            "outputs": json.dumps(outputs),
            "frame": next((plan.outputs[n].frame_id for n in ("pose", "position") if n in plan.outputs), ""),
            "latency": str(plan.latency),
            "offline": json.dumps(plan.offline),
            "rate_hz": f"{plan.rate_hz:.6g}",
            "mode": self.mode,
            "gap.policy": gap.policy,
            "gap.max_gap_s": f"{gap.limit_s(plan.rate_hz):g}",
            **{f"gap.policy.{i}": p.policy for i in plan.topics if (p := policy_of(self.gap, i)) != gap},
            "range.start_ns": "" if self._start_ns is None else str(self._start_ns),
            "range.end_ns": "" if self._end_ns is None else str(self._end_ns),
            "samples": str(runner.samples),
            "segments": str(1 + feed.restarts),
            **{f"calibration.{c.kind}": msgspec.json.encode(c).decode() for c in plan.calibrations},
            "loop_s": f"{runner.loop_s:.6f}",
            "fatal": json.dumps(fatal),
            "findings": json.dumps([[f.kind, f.count, f.detail] for f in findings]),
        }
        return Run(
            plan.run,
            plan.name,
            plan.version,
            plan.input,
            plan.topics,
            plan.params,
            runner.samples,
            runner.loop_s,
            1 + feed.restarts,
            outputs,
            findings,
            fatal,
            annotations=runner.annotations(),
            lineage=lineage,
        )


def speed_factor(speed: float | str) -> float | None:
    """Return a speed as a factor of real time, None for ``max``.

    Raises
    ------
    UsageError
        Where it is neither ``max`` nor a number above 0.
    """
    if speed == "max":
        return None
    try:
        factor = float(speed)
    except ValueError:
        factor = float("nan")
    if not 0 < factor < float("inf"):
        raise UsageError(f"speed {speed!r}: expected max or a factor of real time above 0")
    return factor
