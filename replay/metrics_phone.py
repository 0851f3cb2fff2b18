"""Figures of steps beside a reference of steps: how many, which of them are right, which were found."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .alignment import IntArray

if TYPE_CHECKING:
    import polars as pl

    from .metrics import RunView

TOLERANCE_NS = 150_000_000
"""A step is right within this of one of the reference, once a constant offset is taken off."""


def phone(view: RunView) -> dict[str, float]:
    """Errors of steps: number (where the recording does not state it), precision and recall.

    A detector's end of a step is another instant of the gait than the reference's; the offset between them is
    told and taken off. A step of one matches one of the other at most.
    """
    ours, truth = view.table("step"), view.reference_table("steps")
    if ours is None or truth is None or truth.is_empty():
        return {}
    found: dict[str, float] = {}
    if not view.truth.steps:  # else it is measured against what the recording states
        found["steps_error_percent"] = 100.0 * abs(ours.height - truth.height) / truth.height
    mine, theirs = _ends(ours), _ends(truth)
    offset = constant_offset(mine, theirs)
    right = matched(mine - offset, theirs)
    found["steps_recall"] = right / theirs.size
    if mine.size:
        found["steps_precision"] = right / mine.size
        found["steps_offset_s"] = offset * 1e-9
    return found


def _ends(table: pl.DataFrame) -> IntArray:
    return np.sort(table["end_ns" if "end_ns" in table.columns else "t_ns"].to_numpy().astype(np.int64))


def constant_offset(mine: IntArray, theirs: IntArray, tolerance_ns: int = TOLERANCE_NS) -> int:
    """Return by how much most steps lag the reference's (ns); 0 where there are none.

    The offset, at most half a step, under which most pairs lie within the tolerance: the median of those pairs.
    """
    if not mine.size or not theirs.size:
        return 0
    half = int(np.median(np.diff(theirs))) // 2 if theirs.size > 1 else tolerance_ns
    low, high = np.searchsorted(theirs, mine - 2 * half), np.searchsorted(theirs, mine + 2 * half, "right")
    pairs = np.sort(
        np.concatenate([t - theirs[a:b] for t, a, b in zip(mine, low, high, strict=True)] or [mine[:0]])
    )
    centres = pairs[np.abs(pairs) <= half]
    if not centres.size:
        return 0
    first = np.searchsorted(pairs, centres - tolerance_ns)
    last = np.searchsorted(pairs, centres + tolerance_ns, "right")
    best = np.flatnonzero(last - first == (last - first).max())
    k = best[np.argmin(np.abs(centres[best]))]  # of equals the nearest: a whole step aside fits as well
    return int(np.median(pairs[first[k] : last[k]]))


def matched(mine: IntArray, theirs: IntArray, tolerance_ns: int = TOLERANCE_NS) -> int:
    """Return how many pairs of one and one lie within the tolerance, the most that there can be.

    Both in the order of time: the earliest partner that is left is never a worse choice than a later one.
    """
    i = j = count = 0
    while i < mine.size and j < theirs.size:
        if abs(int(mine[i]) - int(theirs[j])) <= tolerance_ns:
            i, j, count = i + 1, j + 1, count + 1
        elif mine[i] < theirs[j]:
            i += 1
        else:
            j += 1
    return count
