"""Results on their way from an estimator to the sinks and to other estimators."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ..algorithms.contract import FloatArray, IntArray

Columns = dict[str, NDArray[Any]]

_PAGE, _LINE = 512, 8
"""Doubles in a page of memory and in a line of the processor's cache."""


def by_columns(rows: int, columns: int) -> FloatArray:
    """Return an empty array (rows, columns) whose columns, not its rows, lie in one piece.

    What comes and goes as columns is then copied once and not turned over. No column starts a whole number
    of pages behind another: rows of those would drive each other out of the processor's cache.
    """
    length = -(-rows // _PAGE) * _PAGE + _LINE
    return np.empty((columns, length)).T[:rows]


class Block:
    """Rows of one topic, as arrays or as a table: whoever needs the other form makes it.

    Parameters
    ----------
    rows : dict of str to ndarray, or polars.DataFrame
        ``t_ns``, ``t_log_ns`` and columns.
    keys : ndarray of int64, optional
        Of a run's results: places in the order of messages of those that caused them.
    """

    def __init__(self, rows: Columns | pl.DataFrame, keys: IntArray | None = None) -> None:
        self.rows = rows
        self.keys = keys

    def __len__(self) -> int:
        return self.rows.height if isinstance(self.rows, pl.DataFrame) else len(self.rows["t_ns"])

    def since(self, first: int) -> Block:
        """Return the rows from ``first`` on."""
        if first == 0:
            return self
        if isinstance(self.rows, pl.DataFrame):
            return Block(self.rows[first:])
        return Block({name: values[first:] for name, values in self.rows.items()})

    @cached_property
    def table(self) -> pl.DataFrame:
        """The rows as a table."""
        return self.rows if isinstance(self.rows, pl.DataFrame) else pl.DataFrame(self.rows)


def joined(blocks: list[Block]) -> Block:
    """Return the blocks of one topic as one; at least one."""
    if len(blocks) == 1:
        return blocks[0]
    keys = [b.keys for b in blocks if b.keys is not None]
    return Block(pl.concat([b.table for b in blocks]), np.concatenate(keys) if keys else None)


def joined_by_name(parts: list[dict[str, Block]]) -> dict[str, Block]:
    """Return the blocks of several parts, one by name."""
    if len(parts) == 1:
        return parts[0]
    names = dict.fromkeys(n for part in parts for n in part)
    return {n: joined([part[n] for part in parts if n in part]) for n in names}
