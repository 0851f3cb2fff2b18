"""Rows of several channels in the order of log time: joined, cut into windows, merged into messages."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Any, Self

import numpy as np
import polars as pl

from .codec import (
    Columns,
    Messages,
)
from .model import RecordedMessage, Window
from .threads import helpers, threads

TIME_TYPES = {"t_ns": pl.Int64, "t_log_ns": pl.Int64}


class OrderedPool:
    """Threads, for at most this many tasks at a time, that keep order and run only a few tasks ahead."""

    def __init__(self, tasks: int) -> None:
        self._workers = min(threads(), tasks)

    def __enter__(self) -> Self:
        self._pool = helpers("read", self._workers)
        return self

    def __exit__(self, *error: object) -> None:
        self._pool.shutdown(wait=True, cancel_futures=True)

    def map(self, task: Any, items: Sequence[Any]) -> Iterator[Any]:
        """Yield the result of every item in order."""
        from collections import deque

        jobs: deque[Any] = deque()
        for item in items:
            jobs.append(self._pool.submit(task, item))
            if len(jobs) > self._workers:
                yield jobs.popleft().result()
        while jobs:
            yield jobs.popleft().result()


def between(messages: Messages, start_ns: int | None, end_ns: int | None) -> Any:
    """Return which messages lie in a half-open range of log time; None where it has no ends."""
    if start_ns is None and end_ns is None:
        return None
    keep = np.ones(len(messages.log), bool)
    if start_ns is not None:
        keep &= messages.log >= start_ns
    if end_ns is not None:
        keep &= messages.log < end_ns
    return keep


def joined(parts: Sequence[Columns]) -> pl.DataFrame:
    """Return the parts as one table in log-time order (stable)."""
    if all(p.keys() == parts[0].keys() and all(isinstance(v, np.ndarray) for v in p.values()) for p in parts):
        table = pl.DataFrame({k: np.concatenate([p[k] for p in parts]) for k in parts[0]})
    else:
        table = pl.concat([pl.DataFrame(p) for p in parts], how="diagonal_relaxed", rechunk=True)
    return _in_order(table)


def _columns(table: pl.DataFrame) -> Columns:
    """Return a table's columns, as arrays where they are no other than these."""
    return {
        s.name: s.to_numpy() if (s.dtype.is_numeric() or s.dtype == pl.Boolean) and not s.null_count() else s
        for s in table.get_columns()
    }


def _in_order(table: pl.DataFrame) -> pl.DataFrame:
    return table if table["t_log_ns"].is_sorted() else table.sort("t_log_ns", maintain_order=True)


def complete(held: dict[str, list[Columns]], horizon: int) -> int:
    """Return how many rows lie before ``horizon``, of columns in log-time order by topic."""
    logs = (np.asarray(columns["t_log_ns"]) for parts in held.values() for columns in parts)
    return sum(len(log) if log[-1] < horizon else int(np.searchsorted(log, horizon)) for log in logs)


def messages_of(
    topic: str, order: int, table: pl.DataFrame
) -> Iterator[tuple[int, int, int, RecordedMessage]]:
    """Yield (log time, ``order``, row, message) of each row of a channel's window, to be merged."""
    names = [c for c in table.columns if c not in TIME_TYPES]
    values = table.select(names).rows() if names else [()] * table.height
    times = zip(table["t_ns"].to_list(), table["t_log_ns"].to_list(), values, strict=True)
    for i, (t_ns, log, row) in enumerate(times):
        yield log, order, i, RecordedMessage(topic, t_ns, log, dict(zip(names, row, strict=True)))


def cut(held: dict[str, list[Columns]], horizon: int | None, max_rows: int) -> Iterator[Window]:
    """Yield windows of ``max_rows`` of what lies before ``horizon``; keep the rest (None: nothing)."""
    tables = {topic: joined(parts) for topic, parts in held.items() if parts}
    logs = {topic: table["t_log_ns"].to_numpy() for topic, table in tables.items()}
    if not logs:
        return
    # stable: each channel is in order already, and merging runs takes a fifth of the time of sorting
    times = np.sort(np.concatenate(list(logs.values())), kind="stable")
    if horizon is not None:
        times = times[: np.searchsorted(times, horizon)]
    if not len(times):
        return
    cuts = [int(times[0])]
    row = 0
    while row < len(times) and (horizon is None or row + max_rows <= len(times)):
        row = min(row + max_rows, len(times))
        if row < len(times):  # a window ends before a log time, never amid rows that share it
            left = int(np.searchsorted(times, times[row], side="left"))
            row = left if times[row] > cuts[-1] else int(np.searchsorted(times, times[row], side="right"))
        cuts.append(int(times[row]) if row < len(times) else int(times[-1]) + 1)
    for topic, table in tables.items():
        row = int(np.searchsorted(logs[topic], cuts[-1]))
        held[topic] = [_columns(table.slice(row))] if row < table.height else []
    for start, end in pairwise(cuts):
        window: dict[str, pl.DataFrame] = {}
        for topic, table in tables.items():
            i, j = np.searchsorted(logs[topic], (start, end)).tolist()
            if j > i:
                window[topic] = table.slice(i, j - i)
        yield Window(start, end, window)
