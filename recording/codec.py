"""What the encoder and the decoder of messages share: a record's prefix, times, columns bound to fields."""

from __future__ import annotations

import struct
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .cdr import (
    Bytes,
)
from .errors import MarchaError

PREFIX = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log", "<u8"),
        ("publish", "<u8"),
    ]
)
"""What stands before the message in an MCAP message record: 31 bytes."""

RECORD_HEAD = struct.Struct("<BQ")
"""Opcode and length: what stands before every record."""
INDEX_HEAD = struct.Struct("<BQHI")
"""The same, channel and length of the entries: what stands before those of a message index."""

SECOND = 1_000_000_000
MAX_TIME_NS = 2**31 * SECOND - 1
"""The last moment that ``builtin_interfaces/Time`` can hold."""


class Binding(NamedTuple):
    """One column and the message field behind it."""

    column: str
    kind: str
    path: str


def check_times(values: NDArray[Any], where: str) -> NDArray[np.int64]:
    """Return times as int64, refusing what ``builtin_interfaces/Time`` cannot hold.

    Shapes: ``values`` and result (n,), ns.

    Raises
    ------
    MarchaError
        A time is negative or beyond :data:`MAX_TIME_NS`.
    """
    # Without a sign, a negative time is a late one: one pass instead of two.
    if len(values) and values.astype(np.int64, copy=False).view(np.uint64).max() > MAX_TIME_NS:
        bad = int(np.argmax((values < 0) | (values > MAX_TIME_NS)))
        raise MarchaError(
            f"{where}: row {bad}: time {values[bad] / SECOND:.10g} s; a recording holds 0 to {MAX_TIME_NS // SECOND} s "
            "(1970 to 2038): add a constant to the times of the log"
        )
    return values.astype(np.int64, copy=False)


def index_of(log: NDArray[np.int64], sizes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the index of records of these sizes, one behind the other; see :attr:`Chunk.index`.

    Shapes: ``log`` (ns) and ``sizes`` (bytes) (n,), result (n, 2).
    """
    return np.column_stack((log, np.cumsum(sizes) - sizes))


Columns = dict[str, Any]
"""Column name to array or series, all of one length."""


class Messages(NamedTuple):
    """The messages of one channel within one chunk.

    Attributes
    ----------
    data : ndarray of uint8
        The decompressed chunk.
    offsets, sizes : ndarray of int64
        First byte and length of every message (behind the record's prefix).
    log, publish : ndarray of int64
        Log time and publish time (ns).
    """

    data: Bytes
    offsets: NDArray[np.int64]
    sizes: NDArray[np.int64]
    log: NDArray[np.int64]
    publish: NDArray[np.int64]

    def take(self, keep: NDArray[Any] | slice) -> Messages:
        """Return the messages that ``keep`` (mask, slice or indices) picks."""
        return Messages(self.data, self.offsets[keep], self.sizes[keep], self.log[keep], self.publish[keep])

    def message(self, i: int) -> memoryview:
        """Return the bytes of message ``i``."""
        start = int(self.offsets[i])
        return self.data.data[start : start + int(self.sizes[i])]
