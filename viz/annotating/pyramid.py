"""Signals of any length on a screen: smallest and largest values over blocks of rows, level by level.

Level 0 are the rows themselves, read from the file when they are asked for; a block of level 1 has
:data:`BLOCK` rows, one of every further level :data:`FACTOR` blocks of the level below, up to a level of at most
:data:`TOP` blocks. What is held in memory is about a fifth of the channel.
"""

from __future__ import annotations

import threading
from typing import NamedTuple

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ...recording import Recording
from ...recording.reader import Channel

BLOCK = 16
"""Rows of a block of level 1; a power of two."""
FACTOR = 4
"""Blocks that become one of the next level; a power of two."""
TOP = 4096
"""Most blocks of the last level: about two a pixel of a wide screen."""
TILE = 4096
"""Rows or blocks that are handed out at a time."""

Times = NDArray[np.int64]
Values = NDArray[np.float32]


class Tile(NamedTuple):
    """Consecutive blocks (of level 0: rows, where ``low`` and ``high`` are the same).

    Attributes
    ----------
    first_ns, last_ns : ndarray of int64, shape (n,)
        Times of the first and last row of each.
    low, high : ndarray of float32, shape (columns, n)
        Smallest and largest value less the column's origin; NaN where there is none.
    """

    first_ns: Times
    last_ns: Times
    low: Values
    high: Values

    def part(self, start: int, stop: int) -> Tile:
        """Return blocks from ``start`` up to, not with, ``stop``."""
        cut = slice(start, stop)
        return Tile(self.first_ns[cut], self.last_ns[cut], self.low[:, cut], self.high[:, cut])


class Pyramid:
    """One channel of a recording over time.

    Parameters
    ----------
    rec : Recording
        Where it is read from.
    channel : Channel
        Which one.
    columns : sequence of str
        Columns of numbers or flags.

    Attributes
    ----------
    origin : ndarray of float64, shape (columns,)
        First value of each column; what is handed out is the difference to it, so that single precision is enough
        for geographic coordinates too.
    complete : bool
        Whether all rows are in.
    """

    def __init__(self, rec: Recording, channel: Channel, columns: list[str]) -> None:
        self._rec, self.channel, self.columns = rec, channel, columns
        self._lock = threading.Lock()
        self._parts: list[Tile] = []  # level 1 as far as it is read
        self._sketch: list[Tile] = []  # the same, coarse: what is shown meanwhile
        self._coarse = 1
        while -(-channel.count // BLOCK) > TOP * self._coarse:
            self._coarse *= FACTOR
        self._logs: list[Times] = []  # log time of each block's first row
        self._levels: list[Tile] = []
        self.origin = np.zeros(len(columns))
        self._known = np.zeros(len(columns), bool)
        self.complete = False

    def build(self) -> None:
        """Read the channel; other threads may ask for what is there meanwhile."""
        held: list[pl.DataFrame] = []
        rows = 0
        for window in self._rec.windows([self.channel.topic], ahead=False):
            held.append(window.tables[self.channel.topic])
            rows += held[-1].height
            if rows >= BLOCK:
                table = pl.concat(held) if len(held) > 1 else held[0]
                whole = rows // BLOCK * BLOCK
                self._append(table[:whole])
                held, rows = [table[whole:]], rows - whole
        if rows:
            self._append(pl.concat(held))
        level = joined(self._parts, len(self.columns))
        levels = [level]
        while len(level.first_ns) > TOP:
            level = coarser(level, FACTOR)
            levels.append(level)
        with self._lock:
            self._levels, self.complete = levels, True
            self._parts, self._sketch = [], []
            self._log = np.concatenate(self._logs) if self._logs else np.zeros(0, np.int64)

    def _append(self, table: pl.DataFrame) -> None:
        values = self._values(table)
        t_ns = table["t_ns"].to_numpy()
        part = coarser(Tile(t_ns, t_ns, values, values), BLOCK)
        sketch = coarser(part, self._coarse)
        with self._lock:
            self._parts.append(part)
            self._sketch.append(sketch)
            self._logs.append(table["t_log_ns"].to_numpy()[::BLOCK])

    def _values(self, table: pl.DataFrame) -> Values:
        """Return the columns less their origins, which the first values set."""
        out = np.empty((len(self.columns), table.height), np.float32)
        for row, name in enumerate(self.columns):
            values = table[name].cast(pl.Float64).to_numpy()
            if not self._known[row]:
                finite = values[np.isfinite(values)]
                if len(finite):
                    self.origin[row], self._known[row] = finite[0], True
            np.subtract(values, self.origin[row], out=out[row], casting="same_kind")
        return out

    @property
    def sizes(self) -> list[int]:
        """Blocks a level, from level 1 on; empty while the channel is read."""
        return [len(level.first_ns) for level in self._levels]

    def overview(self) -> Tile:
        """Return the last level, or while the channel is read as much of it as is known."""
        if self.complete:
            return self._levels[-1]
        with self._lock:
            parts = list(self._sketch)
        return joined(parts, len(self.columns))

    def tile(self, level: int, index: int) -> Tile:
        """Return tile ``index`` of a level; an empty one beyond the end.

        Only of a complete pyramid.
        """
        start = index * TILE
        return self._rows(start) if level == 0 else self._levels[level - 1].part(start, start + TILE)

    def _rows(self, start: int) -> Tile:
        first, stop = start // BLOCK, (start + TILE) // BLOCK
        if first >= len(self._log):
            return self._levels[0].part(0, 0)
        end_ns = int(self._log[stop]) if stop < len(self._log) else None
        table = self._rec.table(self.channel.topic, int(self._log[first]), end_ns).sort("t_ns")
        values = self._values(table)
        t_ns = table["t_ns"].to_numpy()
        return Tile(t_ns, t_ns, values, values)


def joined(parts: list[Tile], columns: int) -> Tile:
    """Return tiles one behind the other."""
    if not parts:
        nothing = np.zeros((columns, 0), np.float32)
        return Tile(np.zeros(0, np.int64), np.zeros(0, np.int64), nothing, nothing)
    return Tile(*(np.concatenate(p, axis=-1) for p in zip(*parts, strict=True)))


def coarser(tile: Tile, factor: int) -> Tile:
    """Return blocks of ``factor`` blocks each; the last may have fewer.

    Halving again and again is three times as fast as a reduction over short rows.
    """
    count = len(tile.first_ns)
    blocks = -(-count // factor)
    extra = blocks * factor - count
    low, high = (np.pad(v, ((0, 0), (0, extra)), mode="edge") if extra else v for v in tile[2:])
    first, last = (np.pad(t, (0, extra), mode="edge") if extra else t for t in tile[:2])
    while factor > 1:
        low = np.fmin(low[:, ::2], low[:, 1::2])
        high = np.fmax(high[:, ::2], high[:, 1::2])
        first, last = np.minimum(first[::2], first[1::2]), np.maximum(last[::2], last[1::2])
        factor //= 2
    return Tile(first, last, low, high)
