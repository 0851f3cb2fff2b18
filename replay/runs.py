"""One run: an estimator that takes rows and gives tables."""

from __future__ import annotations

import copy
import time
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ..algorithms.contract import (
    FloatArray,
    RowKernel,
    input_columns,
    output_columns,
)
from ..recording.errors import Finding, MarchaError
from .blocks import (
    Block,
    Columns,
    by_columns,
    joined,
)
from .feed import Feed, IntArray, Rows
from .plan import PlannedRun


@dataclass
class _State:
    """What a run remembers between two parts, beside the estimator's own state."""

    recent_ns: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    last_log_ns: int = 0
    samples: int = 0
    still_since: int | None = None
    still_until: int = 0
    stances: int = 0
    steps: int = 0


class Runner:
    """Drives one estimator and names the time of each of its results.

    Parameters
    ----------
    plan : PlannedRun
        The estimator, its channels and parameters.
    feed : Feed
        Where its rows come from.
    blocks : bool
        Hand over whole blocks to estimators that take them (``run_block``), else one step a sample.
    """

    def __init__(self, plan: PlannedRun, feed: Feed, blocks: bool) -> None:
        self.plan = plan
        self.feed = feed
        self.estimator: Any = plan.estimator
        self.columns = output_columns(plan.estimator)
        self.latency = plan.latency
        self.blocks = blocks and not plan.offline and hasattr(self.estimator, "run_block")
        self.loop_s = 0.0
        self._stances: list[IntArray] = []  # from, to
        self._steps: list[Columns] = []
        self._state = _State()
        warm_up(self.estimator, self.blocks)
        self._fresh = self._estimator_snapshot()
        self._rows: list[tuple[FloatArray, IntArray]] = []  # of an offline estimator, the present segment

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
        return (
            self._estimator_snapshot(),
            copy.copy(self._state),
            len(self._stances),
            len(self._steps),
            list(self._rows),
        )

    def restore(self, snapshot: Any) -> None:
        """Go back to ``snapshot``."""
        estimator, state, stances, steps, rows = snapshot
        self._restore_estimator(estimator)
        self._state = copy.copy(state)
        del self._stances[stances:], self._steps[steps:]
        self._rows = list(rows)

    # -- rows in, blocks out -------------------------------------------------------------------------

    def take(self, rows: Rows) -> dict[str, Block]:
        """Feed rows; return a block of every output that has something to say."""
        blocks: list[dict[str, Block]] = []
        bounds = [0, *rows.resets, len(rows)]
        for k, (a, b) in enumerate(pairwise(bounds)):
            if k and self._state.samples:
                blocks.append(self._restart())
            if b > a:
                blocks.append(self._segment(rows.values[a:b], rows.t_ns[a:b], rows.t_log_ns[a:b]))
        if len(blocks) == 1:
            return blocks[0]
        names = dict.fromkeys(n for given in blocks for n in given)
        return {n: joined([given[n] for given in blocks if n in given]) for n in names}

    def finish(self, end_ns: int) -> dict[str, Block]:
        """Return the results that the estimator still holds; ``end_ns`` is the log time of an offline one."""
        if self.plan.offline:
            self._state.last_log_ns = max(self._state.last_log_ns, end_ns)
        blocks = self._flush()
        self._close_stance()
        return blocks

    def _restart(self) -> dict[str, Block]:
        blocks = self._flush()
        self._close_stance()
        self._restore_estimator(self._fresh)
        self._state.recent_ns = np.empty(0, np.int64)
        return blocks

    def _segment(self, values: FloatArray, t_ns: IntArray, t_log_ns: IntArray) -> dict[str, Block]:
        state = self._state
        state.samples += len(t_ns)
        state.last_log_ns = int(t_log_ns[-1])
        if self.plan.offline:
            self._rows.append((values, t_ns))
            return {}
        columns = self._results(values).T
        times = t_ns
        if self.latency:
            known = np.concatenate((state.recent_ns, t_ns))
            state.recent_ns = known[-self.latency :]
            early = self.latency - (len(known) - len(t_ns))  # rows whose result would speak of none
            if early > 0:
                if not np.isnan(columns[:, :early]).all():
                    raise MarchaError(
                        f"estimator {self.plan.name} gave a result within its first {self.latency} rows, "
                        f"its declared latency: the result would have no time"
                    )
                columns, t_log_ns = columns[:, early:], t_log_ns[early:]
            times = known[: len(known) - self.latency] if len(known) > self.latency else known[:0]
            times = times[len(times) - columns.shape[1] :]
        return self._by_output(columns, times, t_log_ns)

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

    def _flush(self) -> dict[str, Block]:
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
        return self._by_output(np.ascontiguousarray(out.T), times, np.full(len(times), state.last_log_ns))

    def _by_output(self, columns: FloatArray, t_ns: IntArray, t_log_ns: IntArray) -> dict[str, Block]:
        """Return a block an output; ``columns`` is (columns, rows)."""
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
            if output.schema == "marcha_msgs/msg/Stance":
                data["still"] = data["still"] > 0.5
                self._note_stances(data["t_ns"], data["still"])
            if output.schema == "marcha_msgs/msg/Step":
                data = _with_swing_times(data)
                self._steps.append(data)
            blocks[output.name] = Block(data)
        return blocks

    # -- annotations ---------------------------------------------------------------------------------

    def _note_stances(self, t_ns: IntArray, still: NDArray[np.bool_]) -> None:
        """Join still samples to intervals: first to last still sample."""
        state = self._state
        edges = np.flatnonzero(np.diff(still, prepend=state.still_since is not None))
        begins, after = edges[still[edges]], edges[~still[edges]]
        since, until = t_ns[begins], t_ns[after - 1]
        if state.still_since is not None:
            since = np.append(np.int64(state.still_since), since)
        if len(after) and after[0] == 0:
            until[0] = state.still_until
        self._stances.append(np.column_stack((since[: len(until)], until)))
        state.still_since = int(since[-1]) if len(since) > len(until) else None
        state.still_until = int(t_ns[-1])

    def _close_stance(self) -> None:
        state = self._state
        if state.still_since is not None:
            self._stances.append(np.array([[state.still_since, state.still_until]]))
            state.still_since = None

    def annotation_table(self) -> pl.DataFrame:
        """Return stances and steps as annotations of the tiers ``<run>/stance`` and ``<run>/step``."""
        run = self.plan.run
        bounds = np.concatenate([np.empty((0, 2), np.int64), *self._stances])
        stances = pl.DataFrame({"start_ns": bounds[:, 0], "end_ns": bounds[:, 1]}).select(
            pl.lit(f"{run}/stance").alias("tier"),
            "start_ns",
            "end_ns",
            pl.lit("stance").alias("label"),
            pl.lit("{}").alias("metadata"),
        )
        tables = [stances]
        if self._steps:
            steps = {name: np.concatenate([s[name] for s in self._steps]) for name in self._steps[0]}
            tables.append(_step_annotations(pl.DataFrame(steps), run))
        return pl.concat(tables).sort("start_ns", maintain_order=True)

    # -- what to say -----------------------------------------------------------------------------------

    @property
    def samples(self) -> int:
        """Rows that the estimator was fed."""
        return self._state.samples

    def findings(self) -> tuple[list[Finding], bool]:
        """Return what the user must know about the run, and whether its results must not be used."""
        found = [*self.plan.findings, *self.feed.findings()]
        fatal = False
        if not self.samples:
            columns = " ".join(self.plan.inputs[0][1])
            found.append(
                Finding(
                    "no_samples",
                    1,
                    None,
                    f"{self.plan.input}: no message with a finite value in each of {columns} in the time "
                    "that was played: nothing was computed",
                )
            )
            fatal = True
        for remark in self.estimator.remarks() if hasattr(self.estimator, "remarks") else ():
            found.append(Finding(remark.kind, 1, None, remark.detail))
            fatal |= remark.fatal
        return found, fatal


def warm_up(estimator: Any, blocks: bool) -> None:
    """Let a kernel compile (or load from its cache) before a clock runs; its state stays as it is."""
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


def _step_annotations(steps: pl.DataFrame, run: str) -> pl.DataFrame:
    """Return steps as annotations; their numbers, rounded to six digits, are the metadata (JSON text)."""
    about = sorted(c for c in steps.columns if c not in ("t_ns", "t_log_ns", "start_ns", "end_ns"))
    texts = [pl.Series(c, [f"{v:.6g}" for v in steps[c].to_list()], dtype=pl.String) for c in about]
    form = "{{" + ", ".join(f'"{c}": "{{}}"' for c in about) + "}}"
    number = pl.col("index") if "index" in about else pl.int_range(pl.len())
    return steps.select(
        pl.lit(f"{run}/step").alias("tier"),
        "start_ns",
        "end_ns",
        pl.format("step {}", number).alias("label"),
        pl.format(form, *texts).alias("metadata"),
    )


def _with_swing_times(steps: Columns) -> Columns:
    """Turn the swing's length of a step, which ends at the row's time, into its two times."""
    if "swing_s" not in steps:
        return steps
    t_ns = steps["t_ns"]
    times = {"start_ns": t_ns - np.round(steps["swing_s"] * 1e9).astype(np.int64), "end_ns": t_ns}
    rest = {name: values for name, values in steps.items() if name not in ("t_ns", "t_log_ns", "swing_s")}
    return {
        "t_ns": t_ns,
        "t_log_ns": steps["t_log_ns"],
        **times,
        **rest,
        "index": rest["index"].astype(np.uint32),
    }
