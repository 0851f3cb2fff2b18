"""Merged messages of several inputs, for estimators that take every message."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import polars as pl

from ..algorithms.contract import IntArray, Message
from ..recording.errors import Finding
from .gaps import ChannelGuard, Gaps, policy_of
from .merging import MergedPart


@dataclass(frozen=True)
class AttachedChannel:
    """One channel at one input of a run.

    Attributes
    ----------
    input : str
        Name of the input.
    index, number : int
        Place of the input among the estimator's, and of the channel among those of the input.
    topic : str
        Where its messages come from.
    columns : tuple of str
        What is read of them.
    regular : bool
        Whether a guard watches it.
    rate_hz : float
        Its rate; 0 where it is not known.
    """

    input: str
    index: int
    number: int
    topic: str
    columns: tuple[str, ...]
    regular: bool
    rate_hz: float


@dataclass(frozen=True)
class Piece:
    """Messages of one channel within a block: their table and their places there."""

    channel: AttachedChannel
    table: pl.DataFrame
    places: IntArray


@dataclass(frozen=True)
class MessageBlock:
    """Consecutive messages of all inputs in their order.

    Attributes
    ----------
    inputs, channels : ndarray of int64, shape (n,)
        Indices of input and channel of every message.
    t_ns, t_log_ns, keys : ndarray of int64, shape (n,)
        Time of every message, when it was known, and its place in the order.
    pieces : tuple of Piece
        The tables that the messages lie in.
    resets : tuple of int
        Messages before which the estimator starts anew.
    """

    inputs: IntArray
    channels: IntArray
    t_ns: IntArray
    t_log_ns: IntArray
    keys: IntArray
    pieces: tuple[Piece, ...]
    resets: tuple[int, ...] = ()

    def __len__(self) -> int:
        return len(self.t_ns)

    def messages(self) -> Iterator[Message]:
        """Yield the messages one by one."""
        rows = [row for p in self.pieces for row in p.table.select(p.channel.columns).rows()]
        if len(self.pieces) > 1:
            order = np.argsort(np.concatenate([p.places for p in self.pieces]))
            rows = list(map(rows.__getitem__, order.tolist()))
        whose = np.empty(len(self), np.int64)
        for number, piece in enumerate(self.pieces):
            whose[piece.places] = number
        names = np.array([p.channel.input for p in self.pieces], object)[whose].tolist()
        topics = np.array([p.channel.topic for p in self.pieces], object)[whose].tolist()
        return map(Message, names, self.t_ns.tolist(), rows, self.t_log_ns.tolist(), topics)


class MessageFeed:
    """Merges the messages of one set of channels.

    Parameters
    ----------
    channels : tuple of AttachedChannel
        In the order of the inputs.
    gaps : GapPolicy or mapping
        What happens when a regular input pauses.
    """

    def __init__(self, channels: tuple[AttachedChannel, ...], gaps: Gaps) -> None:
        self.channels = channels
        self.guards = [
            ChannelGuard(c.topic, c.columns, policy_of(gaps, c.input), c.rate_hz) if c.regular else None
            for c in channels
        ]
        self._stopped = False

    def snapshot(self) -> Any:
        """Return a copy of what the feed remembers."""
        return self._stopped, [None if g is None else g.snapshot() for g in self.guards]

    def restore(self, snapshot: Any) -> None:
        """Go back to ``snapshot``."""
        self._stopped, states = snapshot
        for guard, state in zip(self.guards, states, strict=True):
            if guard is not None:
                guard.restore(state)

    @property
    def restarts(self) -> int:
        """Number of restarts so far."""
        return sum(g.restarts for g in self.guards if g is not None)

    def take(self, part: MergedPart) -> MessageBlock:
        """Return the messages of this part that the estimator is given, in their order."""
        tables: list[pl.DataFrame] = []
        keys: list[IntArray] = []
        used: list[AttachedChannel] = []
        resets: list[int] = []
        end: int | None = -1 if self._stopped else None
        for channel, guard in zip(self.channels, self.guards, strict=True):
            table = part.tables.get(channel.topic)
            if table is None or not table.height:
                continue
            places = part.keys[channel.topic]
            if guard is not None:
                times = table["t_ns"].to_numpy()
                finite = np.ones(len(times), bool)
                for column in channel.columns:
                    finite &= np.isfinite(table[column].to_numpy())
                before = guard.stopped
                keep, _, restart = guard.take(times, finite)
                if (
                    guard.stopped and not before
                ):  # the first message behind the gap, and all that follow, are out
                    gone = np.flatnonzero(~keep) if keep is not None else np.empty(0, np.int64)
                    later = gone[
                        times[gone] > (times[keep].max() if keep is not None and keep.any() else -(2**63))
                    ]
                    cut = int(places[later[0]]) if len(later) else int(places[0])
                    end = cut if end is None else min(end, cut)
                if keep is not None:
                    table, places = table.filter(pl.Series(keep)), places[keep]
                resets += places[list(restart)].tolist()
            if table.height:
                tables.append(table)
                keys.append(places)
                used.append(channel)
        if end is not None:
            self._stopped = True
            for i, places in enumerate(keys):
                n = int(np.searchsorted(places, end))
                tables[i], keys[i] = tables[i][:n], places[:n]
            kept = [i for i, k in enumerate(keys) if len(k)]
            tables, keys, used = [tables[i] for i in kept], [keys[i] for i in kept], [used[i] for i in kept]
        return _merged(used, tables, keys, sorted(set(resets)))

    def findings(self) -> list[Finding]:
        """Return what was not fed and what was uneven, one line a kind."""
        return [f for g in self.guards if g is not None for f in g.findings()]


def _merged(
    channels: list[AttachedChannel], tables: list[pl.DataFrame], keys: list[IntArray], resets: list[int]
) -> MessageBlock:
    if not tables:
        empty = np.empty(0, np.int64)
        return MessageBlock(empty, empty, empty, empty, empty, ())
    joined = np.concatenate(keys)
    order = np.argsort(
        joined, kind="stable"
    )  # stable: one channel at two inputs goes by the order of the inputs
    place = np.empty(order.size, np.int64)
    place[order] = np.arange(order.size)
    bounds = np.cumsum([0, *(len(k) for k in keys)])
    pieces = tuple(
        Piece(c, t, place[a:b]) for c, t, a, b in zip(channels, tables, bounds[:-1], bounds[1:], strict=True)
    )
    lengths = [len(k) for k in keys]
    merged = joined[order]
    return MessageBlock(
        np.repeat([c.index for c in channels], lengths)[order],
        np.repeat([c.number for c in channels], lengths)[order],
        np.concatenate([t["t_ns"].to_numpy() for t in tables])[order],
        np.concatenate([t["t_log_ns"].to_numpy() for t in tables])[order],
        merged,
        pieces,
        tuple(int(i) for i in np.searchsorted(merged, resets)),
    )
