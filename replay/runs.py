"""One run: an estimator that is given messages or rows and gives tables."""

from __future__ import annotations

import copy
import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import islice, pairwise
from typing import Any

import numpy as np
import polars as pl

from ..algorithms.contract import (
    TIMES,
    FloatArray,
    IntArray,
    KernelEstimator,
    Message,
    Output,
    Result,
    RowKernel,
    input_columns,
    output_columns,
)
from ..recording.errors import Finding, MarchaError
from .blocks import Block, Columns, by_columns, joined_by_name
from .marking import NO_ANNOTATIONS, Marker
from .merging import AFTER_ALL
from .messages import MessageBlock, MessageFeed
from .plan import PlannedRun
from .result_columns import typed, with_swing_times
from .rows import RowBlock, RowFeed

_MESSAGES_A_CALL = 8192
"""Messages that a kernel takes at once: what it reads and writes stays in the processor's cache."""


_MESSAGES_A_TURN = 1024
"""Messages between which results are gathered: objects that die young cost the garbage collector nothing."""


@dataclass
class _State:
    """What a run remembers between two parts, beside the estimator's own state."""

    last_log_ns: int = 0
    samples: int = 0
    recent_ns: IntArray = field(default_factory=lambda: np.empty(0, np.int64))


class Runner:
    """Drives one estimator and names the time of each of its results; subclasses say how it is fed.

    Parameters
    ----------
    plan : PlannedRun
        The estimator, its channels and parameters.
    feed : RowFeed or MessageFeed
        Where its rows or messages come from.
    blocks : bool
        Hand over whole blocks to estimators that take them, else one step a sample.
    """

    def __init__(self, plan: PlannedRun, feed: Any, blocks: bool) -> None:
        self.plan = plan
        self.feed = feed
        self.estimator: Any = plan.estimator
        self.blocks = blocks
        self.loop_s = 0.0
        self.markers = {o.name: Marker(plan.run, o) for o in plan.estimator.outputs if o.annotate is not None}
        self._state = _State()
        warm_up(self.estimator, blocks)
        self._fresh = self._estimator_snapshot()

    # -- state ---------------------------------------------------------------------------------------

    def _estimator_snapshot(self) -> Any:
        if hasattr(self.estimator, "snapshot"):
            return self.estimator.snapshot()
        return copy.deepcopy(self.estimator.__dict__)

    def _restore_estimator(self, snapshot: Any) -> None:
        if hasattr(self.estimator, "restore"):
            self.estimator.restore(snapshot)
        else:
            self.estimator.__dict__.clear()
            self.estimator.__dict__.update(copy.deepcopy(snapshot))

    def snapshot(self) -> Any:
        """Return a copy of everything that later results depend on."""
        marks = {name: m.snapshot() for name, m in self.markers.items()}
        return self._estimator_snapshot(), copy.copy(self._state), marks

    def restore(self, snapshot: Any) -> None:
        """Go back to ``snapshot``."""
        estimator, state, marks = snapshot
        self._restore_estimator(estimator)
        self._state = copy.copy(state)
        for name, mark in marks.items():
            self.markers[name].restore(mark)

    # -- use -----------------------------------------------------------------------------------------

    def take(self, block: Any) -> dict[str, Block]:
        """Feed what the feed gave; return a block of every output that has something to say."""
        raise NotImplementedError

    def _held_back(self, key: int) -> dict[str, Block]:
        """Return the results that the estimator still holds, known at the newest message."""
        raise NotImplementedError

    def finish(self, end_ns: int) -> dict[str, Block]:
        """Return the results that the estimator still holds; ``end_ns`` is the log time of an offline one."""
        if self.plan.offline:
            self._state.last_log_ns = max(self._state.last_log_ns, end_ns)
        blocks = self._held_back(AFTER_ALL)
        self._close_marks()
        return blocks

    def _restart(self, key: int) -> dict[str, Block]:
        blocks = self._held_back(key)
        self._close_marks()
        self._restore_estimator(self._fresh)
        self._state.recent_ns = np.empty(0, np.int64)
        return blocks

    def annotations(self) -> pl.DataFrame:
        """Return what the outputs declare as annotations, by start, with the estimator as their source."""
        tables = [NO_ANNOTATIONS, *(m.table() for m in self.markers.values())]
        version = self.plan.version.rpartition(" ")[2]  # behind the distribution's name
        source = pl.lit(f"algorithm:{self.plan.name}@{version}").alias("source")
        return pl.concat(tables).sort("start_ns", maintain_order=True).with_columns(source)

    def _close_marks(self) -> None:
        for marker in self.markers.values():
            marker.close()

    def _block(self, output: Output, rows: Columns, keys: IntArray) -> Block:
        """Give the columns of an output their types and note its annotations."""
        data = {
            name: values if name in TIMES else typed(output, name, values) for name, values in rows.items()
        }
        if output.schema == "marcha_msgs/msg/Step":
            data = with_swing_times(data)
        if output.name in self.markers:
            self.markers[output.name].take(data)
        return Block(data, keys)

    def _by_output(
        self, columns: FloatArray, t_ns: IntArray, t_log_ns: IntArray, keys: IntArray
    ) -> dict[str, Block]:
        """Return a block an output; ``columns`` is (columns, rows), all outputs one after another."""
        blocks: dict[str, Block] = {}
        first = 0
        for output in self.estimator.outputs:
            part = columns[first : first + len(output.columns)]
            first += len(output.columns)
            spoken = ~np.isnan(part[0])
            if not output.event and not spoken.all():
                spoken = ~np.isnan(part).all(axis=0)
            if not spoken.any():
                continue
            pick = slice(None) if spoken.all() else spoken
            data: Columns = {"t_ns": t_ns[pick], "t_log_ns": t_log_ns[pick]}
            data |= {name: part[i][pick] for i, name in enumerate(output.columns)}
            blocks[output.name] = self._block(output, data, keys[pick])
        return blocks

    # -- what to say -----------------------------------------------------------------------------------

    @property
    def samples(self) -> int:
        """Rows or messages that the estimator was fed."""
        return self._state.samples

    def findings(self) -> tuple[list[Finding], bool]:
        """Return what the user must know about the run, and whether its results must not be used."""
        findings = [*self.plan.findings, *self.feed.findings()]
        fatal = False
        if not self.samples:
            columns = " ".join(self.plan.inputs[0].columns)
            detail = (
                f"{self.plan.input}: no message with a finite value in each of {columns} in the time "
                "that was played: nothing was computed"
            )
            findings.append(Finding("no_samples", 1, None, detail))
            fatal = True
        for remark in self.estimator.remarks() if hasattr(self.estimator, "remarks") else ():
            findings.append(Finding(remark.kind, 1, None, remark.detail))
            fatal |= remark.fatal
        return findings, fatal


class RowRunner(Runner):
    """Feeds rows."""

    feed: RowFeed

    def __init__(self, plan: PlannedRun, feed: RowFeed, blocks: bool) -> None:
        self.columns = output_columns(plan.estimator)
        self.latency = plan.latency
        self._rows: list[tuple[FloatArray, IntArray]] = []  # of an offline estimator, the present segment
        super().__init__(plan, feed, blocks and not plan.offline and hasattr(plan.estimator, "run_block"))

    def snapshot(self) -> Any:
        """Return a copy of everything that later results depend on."""
        return super().snapshot(), list(self._rows)

    def restore(self, snapshot: Any) -> None:
        """Go back to ``snapshot``."""
        super().restore(snapshot[0])
        self._rows = list(snapshot[1])

    def take(self, block: RowBlock) -> dict[str, Block]:
        """Feed rows; return a block of every output that has something to say."""
        blocks: list[dict[str, Block]] = []
        bounds = [0, *block.resets, len(block)]
        for k, (a, b) in enumerate(pairwise(bounds)):
            if k and self._state.samples:
                blocks.append(self._restart(int(block.keys[a])))
            if b > a:
                blocks.append(
                    self._segment(block.values[a:b], block.t_ns[a:b], block.t_log_ns[a:b], block.keys[a:b])
                )
        return joined_by_name(blocks)

    def _segment(
        self, values: FloatArray, t_ns: IntArray, t_log_ns: IntArray, keys: IntArray
    ) -> dict[str, Block]:
        state = self._state
        state.samples += len(t_ns)
        state.last_log_ns = int(t_log_ns[-1])
        if self.plan.offline:
            self._rows.append((values, t_ns))
            return {}
        columns = self._results(values).T
        times = t_ns
        if self.latency:
            all_ns = np.concatenate((state.recent_ns, t_ns))
            state.recent_ns = all_ns[-self.latency :]
            early = self.latency - (len(all_ns) - len(t_ns))  # rows whose result would speak of none
            if early > 0:
                if not np.isnan(columns[:, :early]).all():
                    raise MarchaError(
                        f"estimator {self.plan.name} gave a result within its first {self.latency} rows, "
                        f"its declared latency: the result would have no time"
                    )
                columns, t_log_ns, keys = columns[:, early:], t_log_ns[early:], keys[early:]
            times = all_ns[: len(all_ns) - self.latency] if len(all_ns) > self.latency else all_ns[:0]
            times = times[len(times) - columns.shape[1] :]
        return self._by_output(columns, times, t_log_ns, keys)

    def _results(self, rows: FloatArray) -> FloatArray:
        """Return the result of every row, NaN where there is none."""
        out = by_columns(len(rows), len(self.columns))
        begin = time.perf_counter()
        if self.blocks:
            self.estimator.run_block(rows, out)
        else:
            out[:] = np.nan
            step = self.estimator.step
            for i, row in enumerate(np.ascontiguousarray(rows)):
                result = step(row)
                if result is not None:
                    out[i] = result
        self.loop_s += time.perf_counter() - begin
        return out

    def _held_back(self, key: int) -> dict[str, Block]:
        state = self._state
        if self.plan.offline:
            if not self._rows:
                return {}
            values = np.concatenate([v for v, _ in self._rows])
            times = np.concatenate([t for _, t in self._rows])
            self._rows = []
            begin = time.perf_counter()
            out = np.asarray(self.estimator.process(values), dtype=np.float64)
            self.loop_s += time.perf_counter() - begin
        else:
            if not self.latency or not hasattr(self.estimator, "flush"):
                return {}
            out = np.asarray(self.estimator.flush(), dtype=np.float64)
            times = state.recent_ns[len(state.recent_ns) - len(out) :]
        if out.shape != (len(times), len(self.columns)):
            raise MarchaError(
                f"estimator {self.plan.name} returned {out.shape} at its end, "
                f"expected ({len(times)}, {len(self.columns)})"
            )
        n = len(times)
        return self._by_output(
            np.ascontiguousarray(out.T), times, np.full(n, state.last_log_ns), np.full(n, key)
        )


class MessageRunner(Runner):
    """Feeds every message of every input."""

    feed: MessageFeed

    def __init__(self, plan: PlannedRun, feed: MessageFeed, blocks: bool) -> None:
        self.outputs = {o.name: o for o in plan.estimator.outputs}
        self.kernel = isinstance(plan.estimator, KernelEstimator)
        super().__init__(plan, feed, blocks and self.kernel)

    def take(self, block: MessageBlock) -> dict[str, Block]:
        """Feed messages; return a block of every output that has something to say."""
        blocks: list[dict[str, Block]] = []
        messages = None if self.kernel else block.messages()
        values = self._encoded(block) if self.kernel else None
        for k, (a, b) in enumerate(pairwise([0, *block.resets, len(block)])):
            if k and self._state.samples:
                blocks.append(self._restart(int(block.keys[min(a, len(block) - 1)])))
            if b == a:
                continue
            self._state.samples += b - a
            self._state.last_log_ns = int(block.t_log_ns[b - 1])
            if messages is not None:
                for first in range(a, b, _MESSAGES_A_TURN):
                    last = min(first + _MESSAGES_A_TURN, b)
                    logs, keys = block.t_log_ns[first:last], block.keys[first:last]
                    blocks.append(self._one_by_one(islice(messages, last - first), logs, keys))
            else:
                assert values is not None
                blocks.append(self._through_kernel(block, values, a, b))
        return joined_by_name(blocks)

    def _encoded(self, block: MessageBlock) -> FloatArray:
        """Return the values of all messages as the kernel takes them."""
        encoded = [
            (p.places, self.estimator.encode(p.channel.index, p.channel.number, p.table))
            for p in block.pieces
        ]
        width = max((len(c.columns) for c in self.feed.channels), default=0)
        values = np.full((len(block), max(1, width, *(e.shape[1] for _, e in encoded))), np.nan)
        for places, numbers in encoded:
            values[places, : numbers.shape[1]] = numbers
        return values

    def _through_kernel(
        self, block: MessageBlock, values: FloatArray, first: int, last: int
    ) -> dict[str, Block]:
        estimator: KernelEstimator = self.estimator
        step = _MESSAGES_A_CALL if self.blocks else 1
        whose: list[IntArray] = []
        times: list[IntArray] = []
        rows: list[FloatArray] = []
        for a in range(first, last, step):
            b = min(a + step, last)
            capacity = (b - a) * estimator.max_results
            message, t_ns = np.empty(capacity, np.int64), np.empty(capacity, np.int64)
            out = np.empty((capacity, estimator.width))
            begin = time.perf_counter()
            n = int(
                estimator.run(
                    estimator.state,
                    block.inputs[a:b],
                    block.channels[a:b],
                    block.t_ns[a:b],
                    values[a:b],
                    message,
                    t_ns,
                    out,
                )
            )
            self.loop_s += time.perf_counter() - begin
            if n:
                whose.append(message[:n] + a)
                times.append(t_ns[:n])
                rows.append(out[:n])
        if not whose:
            return {}
        cause = np.concatenate(whose)
        columns = np.ascontiguousarray(np.concatenate(rows).T)
        return self._by_output(columns, np.concatenate(times), block.t_log_ns[cause], block.keys[cause])

    def _one_by_one(self, messages: Iterable[Message], logs: IntArray, keys: IntArray) -> dict[str, Block]:
        whose: list[int] = []
        answers: list[Result] = []
        take = self.estimator.take
        begin = time.perf_counter()
        for i, message in enumerate(messages):
            results = take(message)
            if results:
                if type(results) is Result:
                    answers.append(results)
                    whose.append(i)
                else:
                    for result in results:
                        answers.append(result)
                        whose.append(i)
        self.loop_s += time.perf_counter() - begin
        return self._blocks_of(answers, whose, logs, keys)

    def _held_back(self, key: int) -> dict[str, Block]:
        state = self._state
        if not hasattr(self.estimator, "finish"):
            return {}
        begin = time.perf_counter()
        if self.kernel:
            t_ns, values = self.estimator.held()
            self.loop_s += time.perf_counter() - begin
            n = len(t_ns)
            columns = np.ascontiguousarray(values.T)
            return self._by_output(columns, t_ns, np.full(n, state.last_log_ns), np.full(n, key)) if n else {}
        held: Iterable[Result] = self.estimator.finish() or ()
        answers = list(held)
        self.loop_s += time.perf_counter() - begin
        return self._blocks_of(answers, [0] * len(answers), np.array([state.last_log_ns]), np.array([key]))

    def _blocks_of(
        self, answers: list[Result], whose: list[int], logs: IntArray, keys: IntArray
    ) -> dict[str, Block]:
        """Return single results as one block an output; ``whose[k]`` is the message that caused result k."""
        if not answers:
            return {}
        names, times, rows = zip(*answers, strict=True)
        cause, t_ns = np.array(whose), np.array(times, np.int64)
        places: dict[str, IntArray] = {}
        if len(different := dict.fromkeys(names)) > 1:
            number = {name: k for k, name in enumerate(different)}
            numbers = np.fromiter(map(number.__getitem__, names), np.int64, len(names))
            places = {name: np.flatnonzero(numbers == k) for name, k in number.items()}
        blocks: dict[str, Block] = {}
        for name in different:
            output = self.outputs.get(name)
            if output is None:
                raise MarchaError(
                    f"estimator {self.plan.name} gave a result for {name!r}; it declares {', '.join(self.outputs)}"
                )
            chosen = places.get(name)
            mine = rows if chosen is None else [rows[k] for k in chosen.tolist()]
            width = len(output.columns)
            if set(map(len, mine)) != {width}:
                bad = next(r for r in mine if len(r) != width)
                raise MarchaError(
                    f"estimator {self.plan.name}: a result of {name!r} has {len(bad)} values, "
                    f"its output has {width} columns: {', '.join(output.columns)}"
                )
            caused, when = (cause, t_ns) if chosen is None else (cause[chosen], t_ns[chosen])
            data: Columns = {"t_ns": when, "t_log_ns": logs[caused]}
            for column, values in zip(output.columns, zip(*mine, strict=True), strict=True):
                data[column] = np.array(values)
            blocks[name] = self._block(output, data, keys[caused])
        return blocks


def warm_up(estimator: Any, blocks: bool) -> None:
    """Let a kernel compile (or load from its cache) before a clock runs; its state stays as it is.

    A kernel whose state is laid out by the context alone has none yet where it has not been started.
    """
    if isinstance(estimator, KernelEstimator) and hasattr(estimator, "state"):
        none, width = np.empty(0, np.int64), max(len(i.columns) for i in estimator.inputs)
        values, out = np.empty((0, max(1, width))), np.empty((0, estimator.width))
        estimator.run(estimator.state, none, none, none, values, none.copy(), none.copy(), out)
    if not isinstance(estimator, RowKernel):
        return
    before = estimator.snapshot()
    zeros = np.zeros((2, len(input_columns(estimator))))
    if blocks:
        rows = by_columns(*zeros.shape)
        rows[:] = zeros
        estimator.run_block(rows, by_columns(2, len(output_columns(estimator))))
    elif estimator.offline:
        estimator.process(zeros)  # type: ignore[attr-defined]
    else:
        estimator.step(zeros[0])
    estimator.restore(before)


def runner_of(plan: PlannedRun, feed: RowFeed | MessageFeed, blocks: bool) -> Runner:
    """Return the runner that fits the feed."""
    return RowRunner(plan, feed, blocks) if isinstance(feed, RowFeed) else MessageRunner(plan, feed, blocks)
