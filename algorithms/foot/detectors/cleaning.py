"""Cleaning of a detector's raw decisions, sample by sample.

Over ``cleaning_s`` (the source: 10 samples at 100 Hz): ``median`` takes the majority of the window, a tie is
moving; ``fill-burst`` fills gaps between two still stretches that are shorter than the window, then removes
still stretches shorter than it (the authors' program; needs twice the window as look-ahead); ``none`` leaves
the raw decision.
"""

from __future__ import annotations

from typing import Any

from ...numerics.compiled import compiled, inlined
from ...numerics.records import Fields

CLEANINGS = ("median", "fill-burst", "none")
MEDIAN, FILL_BURST, NONE = 0, 1, 2

CLEANING: Fields = [
    ("kind", "i8"),  # index into CLEANINGS
    ("length", "i8"),  # samples
    ("before", "i8"),  # samples of the window before the sample it speaks of
    ("after", "i8"),  # look-ahead, samples
    ("raw_count", "i8"),  # raw "still" in the median's window, counted as samples enter and leave it
    ("last_raw", "i8"),  # newest raw "still" at or before the sample being filled, −1 none
    ("first_filled", "i8"),  # first sample of the run of filled "still" that is being cleaned
]


@compiled
def _fill(c: Any, ring: Any, j: int, last: int) -> None:
    """Close a gap at ``j`` that is shorter than the cleaning window and has still samples on both sides."""
    mask = ring.shape[0] - 1
    still = ring[j & mask].raw
    if still:
        c.last_raw = j
    elif c.last_raw >= 0:
        for i in range(j + 1, min(c.last_raw + c.length, last) + 1):
            if ring[i & mask].raw:
                still = True
                break
    ring[j & mask].filled = still


@compiled
def _keep(c: Any, ring: Any, j: int, last: int) -> None:
    """Drop a still stretch around ``j`` that is shorter than the cleaning window."""
    mask = ring.shape[0] - 1
    if not ring[j & mask].filled:
        c.first_filled = j + 1
        ring[j & mask].still = False
        return
    length = j - c.first_filled + 1
    i = j + 1
    while length < c.length and i <= last and ring[i & mask].filled:
        length += 1
        i += 1
    ring[j & mask].still = length >= c.length


@inlined
def clean(c: Any, ring: Any, j: int, last: int) -> None:
    """Advance the cleaning when sample ``j`` has its raw decision; past the end (``j > last``) windows are
    cut off there.
    """
    mask = ring.shape[0] - 1
    if c.kind == MEDIAN:
        if 0 <= j <= last and ring[j & mask].raw:
            c.raw_count += 1
        j -= c.after
        if 0 <= j <= last:
            first = j - c.before
            n = min(last, j + c.after) - max(0, first) + 1
            ring[j & mask].still = 2 * c.raw_count > n
            if first >= 0 and ring[first & mask].raw:
                c.raw_count -= 1
    elif c.kind == FILL_BURST:
        j -= c.length - 1
        if 0 <= j <= last:
            _fill(c, ring, j, last)
        j -= c.length - 1
        if 0 <= j <= last:
            _keep(c, ring, j, last)
    elif 0 <= j <= last:
        ring[j & mask].still = ring[j & mask].raw
