"""The order of messages: by log time, ties by channel order, results directly after what caused them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import polars as pl

from ..algorithms.contract import IntArray
from .sources import Batch

LEVELS = 1 << 12
"""Keys between two messages of the source: room for the results of so many runs, one after another."""

AFTER_ALL = 1 << 50
"""Key behind all messages of a batch."""


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

    def part(self, first: int, last: int) -> MergedPart:
        """Return the messages at places [first, last)."""
        tables, keys = {}, {}
        for topic, places in self.positions.items():
            lo, hi = np.searchsorted(places, (first, last))
            if hi > lo:
                whole = hi - lo == len(places)
                tables[topic] = (
                    self.batch.tables[topic] if whole else self.batch.tables[topic][int(lo) : int(hi)]
                )
                keys[topic] = places[lo:hi] * LEVELS
        return MergedPart(tables, keys)


@dataclass
class MergedPart:
    """Consecutive messages of the source and, as they come, the results of runs that others read.

    Attributes
    ----------
    tables : dict of str to polars.DataFrame
        By topic: ``t_ns``, ``t_log_ns`` and columns.
    keys : dict of str to ndarray of int64
        Their places in the order: ascending within a topic, comparable between topics. A message of the source
        has a multiple of :data:`LEVELS`; a result has the key of the message that caused it plus its run's
        number, so that the order is the same however the messages are cut into parts.
    """

    tables: dict[str, pl.DataFrame]
    keys: dict[str, IntArray]

    def add(self, topic: str, table: pl.DataFrame, keys: IntArray) -> None:
        """Put the results of a run beside the messages that caused them.

        Shape of ``keys``: (n,), one a row of ``table``; see :class:`Merged`.
        """
        self.tables[topic] = table
        self.keys[topic] = keys
