"""From messages to rows: merging in log-time order, time differences, joins, missing values and gaps."""

from __future__ import annotations

import copy
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ..algorithms.contract import FloatArray
from ..recording.errors import Finding, UsageError
from .blocks import by_columns
from .sources import Batch

IntArray = NDArray[np.int64]
JITTER = 1.5
"""Intervals longer than this many sample intervals (and shorter than a gap) are reported as jitter."""


@dataclass(frozen=True)
class GapPolicy:
    """What happens when the first input of an estimator pauses.

    Attributes
    ----------
    policy : {"bridge", "reset", "stop"}
        ``bridge`` feeds the next sample with its true time difference: the estimator integrates across.
        ``reset`` starts the estimator anew after the gap, in a new segment. ``stop`` ends the run before the
        gap. Every gap is a finding of the run, whatever the policy.
    max_gap_s : float or None
        Longest interval in seconds that is no gap. None: 0.2 s or five sample intervals, whichever is longer.
    """

    policy: Literal["bridge", "reset", "stop"] = "bridge"
    max_gap_s: float | None = None

    def __post_init__(self) -> None:
        if self.policy not in ("bridge", "reset", "stop"):
            raise UsageError(f"gap policy {self.policy!r} is unknown; choose bridge, reset or stop")
        if self.max_gap_s is not None and not self.max_gap_s > 0:
            raise UsageError(f"max_gap_s must be above 0 s, not {self.max_gap_s}")

    def limit_s(self, rate_hz: float) -> float:
        """Return the longest interval that is no gap, in seconds, for a channel of this rate."""
        if self.max_gap_s is not None:
            return self.max_gap_s
        return max(0.2, 5.0 / rate_hz) if rate_hz > 0 else 0.2


class Merged:
    """A batch with the order of its messages: by log time, ties by channel order.

    Attributes
    ----------
    batch : Batch
        The messages.
    log_ns : ndarray of int64, shape (n,)
        Log times of all messages in their order.
    positions : dict of str to ndarray of int64
        For every topic, the places of its messages in that order.
    """

    def __init__(self, batch: Batch) -> None:
        self.batch = batch
        logs = [t["t_log_ns"].to_numpy() for t in batch.tables.values()]
        if len(logs) == 1:
            self.log_ns = logs[0]
            self.positions = {next(iter(batch.tables)): np.arange(len(logs[0]))}
            return
        joined = np.concatenate(logs) if logs else np.empty(0, np.int64)
        order = np.argsort(joined, kind="stable")  # stable: ties stay in channel order
        place = np.empty(order.size, np.int64)
        place[order] = np.arange(order.size)
        self.log_ns = joined[order]
        bounds = np.cumsum([0, *(len(a) for a in logs)])
        self.positions = {
            topic: place[a:b] for topic, a, b in zip(batch.tables, bounds[:-1], bounds[1:], strict=True)
        }

    def __len__(self) -> int:
        return self.log_ns.size

    def part(self, first: int, last: int) -> Part:
        """Return the messages at places [first, last)."""
        tables, positions = {}, {}
        for topic, places in self.positions.items():
            lo, hi = np.searchsorted(places, (first, last))
            if hi > lo:
                whole = hi - lo == len(places)
                tables[topic] = (
                    self.batch.tables[topic] if whole else self.batch.tables[topic][int(lo) : int(hi)]
                )
                positions[topic] = places[lo:hi]
        return Part(tables, positions)


@dataclass(frozen=True)
class Part:
    """Consecutive messages: tables by topic and their places in the merged order."""

    tables: dict[str, pl.DataFrame]
    positions: dict[str, IntArray]


@dataclass(frozen=True)
class Rows:
    """Rows for estimators.

    Attributes
    ----------
    values : ndarray, shape (n, 1 + columns)
        ``dt_s`` and the inputs' columns, made :func:`.blocks.by_columns`; estimators must not write to it.
    t_ns, t_log_ns : ndarray of int64, shape (n,)
        Time of every row and when it was known.
    resets : tuple of int
        Rows before which the estimator starts anew.
    """

    values: FloatArray
    t_ns: IntArray
    t_log_ns: IntArray
    resets: tuple[int, ...] = ()

    def __len__(self) -> int:
        return len(self.t_ns)


@dataclass
class Tally:
    """How often something happened, when first, and its largest value."""

    count: int = 0
    first_ns: int | None = None
    largest: float = 0.0

    def add(self, times_ns: IntArray, values: FloatArray | None = None) -> None:
        """Count these."""
        if not len(times_ns):
            return
        self.count += len(times_ns)
        if self.first_ns is None:
            self.first_ns = int(times_ns[0])
        if values is not None:
            self.largest = max(self.largest, float(values.max()))


@dataclass
class _State:
    """Everything that a feed remembers between two parts."""

    last_ns: int | None = None
    pending: list[FloatArray | None] = field(default_factory=list)
    stopped: bool = False
    rows: int = 0
    missing: Tally = field(default_factory=Tally)
    duplicate: Tally = field(default_factory=Tally)
    backwards: Tally = field(default_factory=Tally)
    gaps: Tally = field(default_factory=Tally)
    jitter: Tally = field(default_factory=Tally)
    after_stop: int = 0
    superseded: list[int] = field(default_factory=list)


class Feed:
    """Builds the rows of one set of inputs; runs with the same inputs share it.

    Parameters
    ----------
    inputs : sequence of (str or None, tuple of str)
        Topic and columns of every input; a topic of None is an optional input that is not there.
    gap : GapPolicy
        What happens when the first input pauses.
    rate_hz : float
        Rate of the first input; 0 where it is not known.
    """

    def __init__(
        self, inputs: tuple[tuple[str | None, tuple[str, ...]], ...], gap: GapPolicy, rate_hz: float
    ) -> None:
        self.inputs = inputs
        self.gap = gap
        self.rate_hz = rate_hz
        self.limit_s = gap.limit_s(rate_hz)
        self.width = 1 + sum(len(columns) for _, columns in inputs)
        self._state = _State(pending=[None] * len(inputs), superseded=[0] * len(inputs))

    def snapshot(self) -> _State:
        """Return a copy of what the feed remembers."""
        return copy.deepcopy(self._state)

    def restore(self, snapshot: _State) -> None:
        """Go back to ``snapshot``."""
        self._state = copy.deepcopy(snapshot)

    @property
    def segments(self) -> int:
        """Number of stretches between restarts."""
        return 1 + (self._state.gaps.count if self.gap.policy == "reset" else 0)

    def take(self, part: Part) -> Rows:
        """Return the rows that these messages complete."""
        topic, columns = self.inputs[0]
        assert topic is not None
        table = part.tables.get(topic)
        finite = np.ones(0 if table is None else table.height, bool)
        if table is None:
            times = logs = places = np.empty(0, np.int64)
            values = by_columns(0, self.width)
        else:
            times, logs, places = (
                table["t_ns"].to_numpy(),
                table["t_log_ns"].to_numpy(),
                part.positions[topic],
            )
            values = by_columns(len(times), self.width)
            values[:, 1 + len(columns) :] = np.nan
            for i, column in enumerate(columns, 1):
                values[:, i] = given = table[column].to_numpy()
                finite &= np.isfinite(given)
        keep, dt_s, resets = self._usable(times, finite)
        if keep is not None:
            times, logs, places, given = times[keep], logs[keep], places[keep], values
            values = by_columns(len(times), self.width)
            for i in range(1, self.width):
                values[:, i] = given[keep, i]
        values[:, 0] = dt_s
        self._state.rows += len(times)
        first = 1 + len(columns)
        for i, (other, names) in enumerate(self.inputs[1:], 1):
            if other is not None:
                self._join(i, part, other, names, places, values[:, first : first + len(names)])
            first += len(names)
        return Rows(values, times, logs, resets)

    def _usable(
        self, times: IntArray, finite: NDArray[np.bool_]
    ) -> tuple[NDArray[np.bool_] | None, FloatArray, tuple[int, ...]]:
        """Return which rows are fed (None: all), their time differences in seconds, and where to restart.

        ``finite`` says which have all their values.
        """
        state = self._state
        if state.stopped:
            state.after_stop += len(times)
            return np.zeros(len(times), bool), np.empty(0), ()
        kept, known = finite, times
        if not finite.all():
            state.missing.add(times[~finite])
            known = times[finite]
        last = state.last_ns if state.last_ns is not None else np.iinfo(np.int64).min
        if known.size and (known[0] <= last or (known[1:] <= known[:-1]).any()):
            latest = np.maximum.accumulate(np.concatenate(([last], known)))[:-1]
            state.duplicate.add(known[known == latest])
            state.backwards.add(known[known < latest])
            later = known > latest
            kept = finite.copy()
            kept[np.flatnonzero(finite)[~later]] = False
            known = known[later]
        if not known.size:
            return kept, np.empty(0), ()
        before = known[0] if state.last_ns is None else state.last_ns
        dt_s = np.diff(known, prepend=before) / 1e9
        gap = dt_s > self.limit_s
        resets: tuple[int, ...] = ()
        if gap.any():
            if self.gap.policy == "stop":
                first = int(np.argmax(gap))
                state.gaps.add(known[first : first + 1], dt_s[first : first + 1])
                state.after_stop += len(known) - first
                state.stopped = True
                kept = kept.copy()
                kept[np.flatnonzero(kept)[first:]] = False
                known, dt_s, gap = known[:first], dt_s[:first], gap[:first]
            else:
                state.gaps.add(known[gap], dt_s[gap])
                if self.gap.policy == "reset":
                    resets = tuple(np.flatnonzero(gap).tolist())
                    dt_s[gap] = 0.0
        if self.rate_hz > 0:
            uneven = (dt_s > JITTER / self.rate_hz) & ~gap
            state.jitter.add(known[uneven], dt_s[uneven])
        if known.size:
            state.last_ns = int(known[-1])
        return None if kept.all() else kept, dt_s, resets

    def _join(
        self, index: int, part: Part, topic: str, names: tuple[str, ...], places: IntArray, into: FloatArray
    ) -> None:
        """Put the newest message before each row into it; what no row has taken yet waits."""
        state, n = self._state, len(places)
        table = part.tables.get(topic)
        news = np.empty((0, len(names)))
        target = np.empty(0, np.int64)
        if table is not None:
            news = np.column_stack([table[c].to_numpy().astype(np.float64, copy=False) for c in names])
            spoken = ~np.isnan(news).all(axis=1)
            news = news[spoken]
            target = np.searchsorted(places, part.positions[topic][spoken])
        if (waiting := state.pending[index]) is not None:
            news = np.vstack((waiting, news))
            target = np.concatenate(([0], target))
        newest = np.diff(target, append=n + 1) > 0  # the last of all that wait for the same row
        state.superseded[index] += int((~newest).sum())
        news, target = news[newest], target[newest]
        state.pending[index] = news[-1:].copy() if target.size and target[-1] == n else None
        taken = target < n
        into[target[taken]] = news[taken]

    def findings(self) -> list[Finding]:
        """Return what was not fed and what was uneven, one line a kind."""
        state, topic = self._state, self.inputs[0][0]
        found: list[Finding] = []

        def say(kind: str, tally: Tally, detail: str) -> None:
            if tally.count:
                found.append(Finding(kind, tally.count, None, f"{topic}: {tally.count} {detail}"))

        columns = " ".join(self.inputs[0][1])
        for kind, tally, rule in (
            ("missing_value", state.missing, f"without a finite value in each of {columns}"),
            ("duplicate_time", state.duplicate, "with the time of the message before"),
            ("backwards_time", state.backwards, "with a time before the message before"),
        ):
            say(kind, tally, f"messages {rule} were not fed, the first at t_ns {tally.first_ns}")
        done = {
            "bridge": "the estimator integrated across",
            "reset": "the estimator started anew after each",
            "stop": f"the run ended before it, {state.after_stop} messages were not fed",
        }[self.gap.policy]
        say(
            "gap",
            state.gaps,
            f"intervals above {self.limit_s:g} s, the longest {state.gaps.largest:.3f} s, the first ends at "
            f"t_ns {state.gaps.first_ns}: {done} (gap policy {self.gap.policy})",
        )
        say(
            "jitter",
            state.jitter,
            f"intervals above {JITTER:g} usual ones ({1e3 / (self.rate_hz or np.inf):.4g} ms), the longest "
            f"{1e3 * state.jitter.largest:.4g} ms: fed with their true time difference",
        )
        for (other, _), count in zip(self.inputs[1:], state.superseded[1:], strict=True):
            if count:
                detail = (
                    f"{other}: {count} messages were overtaken by a newer one before the next row of {topic}"
                )
                found.append(Finding("superseded", count, None, detail))
        return found
