"""The adaptor for estimators that take rows: a sample of the first input, the newest of all others."""

from __future__ import annotations

import copy
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..algorithms.contract import FloatArray, IntArray
from ..recording.errors import Finding
from .blocks import by_columns
from .gaps import ChannelGuard, GapPolicy
from .merging import MergedPart


@dataclass(frozen=True)
class RowBlock:
    """Rows for estimators.

    Attributes
    ----------
    values : ndarray, shape (n, 1 + columns)
        ``dt_s`` and the inputs' columns, made :func:`.blocks.by_columns`; estimators must not write to it.
    t_ns, t_log_ns, keys : ndarray of int64, shape (n,)
        Time of every row, when it was known, and its place in the order of messages.
    resets : tuple of int
        Rows before which the estimator starts anew.
    """

    values: FloatArray
    t_ns: IntArray
    t_log_ns: IntArray
    keys: IntArray
    resets: tuple[int, ...] = ()

    def __len__(self) -> int:
        return len(self.t_ns)


@dataclass
class _State:
    """Everything that a feed remembers between two parts, beside its guard's."""

    pending: list[FloatArray | None] = field(default_factory=list)
    superseded: list[int] = field(default_factory=list)


class RowFeed:
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
        topic, columns = inputs[0]
        assert topic is not None
        self.guard = ChannelGuard(topic, columns, gap, rate_hz)
        self.width = 1 + sum(len(columns) for _, columns in inputs)
        self._state = _State([None] * len(inputs), [0] * len(inputs))

    def snapshot(self) -> Any:
        """Return a copy of what the feed remembers."""
        return self.guard.snapshot(), copy.deepcopy(self._state)

    def restore(self, snapshot: Any) -> None:
        """Go back to ``snapshot``."""
        self.guard.restore(snapshot[0])
        self._state = copy.deepcopy(snapshot[1])

    @property
    def restarts(self) -> int:
        """Number of restarts so far."""
        return self.guard.restarts

    def take(self, part: MergedPart) -> RowBlock:
        """Return the rows that these messages complete."""
        topic, columns = self.inputs[0]
        assert topic is not None
        table = part.tables.get(topic)
        finite = np.ones(0 if table is None else table.height, bool)
        if table is None:
            times = logs = keys = np.empty(0, np.int64)
            values = by_columns(0, self.width)
        else:
            times, logs, keys = table["t_ns"].to_numpy(), table["t_log_ns"].to_numpy(), part.keys[topic]
            values = by_columns(len(times), self.width)
            values[:, 1 + len(columns) :] = np.nan
            for i, column in enumerate(columns, 1):
                values[:, i] = column_values = table[column].to_numpy()
                finite &= np.isfinite(column_values)
        keep, dt_s, resets = self.guard.take(times, finite)
        if keep is not None:
            times, logs, keys, column_values = times[keep], logs[keep], keys[keep], values
            values = by_columns(len(times), self.width)
            for i in range(1, self.width):
                values[:, i] = column_values[keep, i]
        values[:, 0] = dt_s
        first = 1 + len(columns)
        for i, (other, names) in enumerate(self.inputs[1:], 1):
            if other is not None:
                self._join(i, part, other, names, keys, values[:, first : first + len(names)])
            first += len(names)
        return RowBlock(values, times, logs, keys, resets)

    def _join(
        self,
        index: int,
        part: MergedPart,
        topic: str,
        names: tuple[str, ...],
        keys: IntArray,
        into: FloatArray,
    ) -> None:
        """Put the newest message before each row into it; what no row has taken yet waits."""
        state, n = self._state, len(keys)
        table = part.tables.get(topic)
        news = np.empty((0, len(names)))
        target = np.empty(0, np.int64)
        if table is not None:
            news = np.column_stack([table[c].to_numpy().astype(np.float64, copy=False) for c in names])
            spoken = ~np.isnan(news).all(axis=1)
            news = news[spoken]
            target = np.searchsorted(keys, part.keys[topic][spoken])
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
        findings = self.guard.findings()
        for (other, _), count in zip(self.inputs[1:], self._state.superseded[1:], strict=True):
            if count:
                detail = (
                    f"{other}: {count} messages were overtaken by a newer one before the next row of "
                    f"{self.guard.topic}"
                )
                findings.append(Finding("superseded", count, None, detail))
        return findings
