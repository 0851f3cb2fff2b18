"""Figures of steps beside a reference of steps: how many, which of them are right, which were found."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .alignment import IntArray
from .trajectory import inside

if TYPE_CHECKING:
    import polars as pl

    from .view import RunView

TOLERANCE_NS = 150_000_000
"""A step is right within this of one of the reference, once a constant offset is taken off."""


def phone(view: RunView) -> dict[str, float]:
    """Errors of steps: number (where the recording does not state it), precision and recall.

    A detector's end of a step is another instant of the gait than the reference's; the offset between them is
    told and taken off. A step of one matches one of the other at most.
    """
    base = view.whole or view
    ours, truth = base.table("step"), base.reference_table("steps")
    if ours is None or truth is None or truth.is_empty():
        return {}
    metrics: dict[str, float] = {}
    mine, theirs = _ends(ours), _ends(truth)
    offset = constant_offset(mine, theirs)
    here, there = matched(mine - offset, theirs)
    if view.spans is not None:  # partners are found in the whole walk; each side counts where it lies itself
        own, theirs_inside = inside(mine, view.spans), inside(theirs, view.spans)
        here, there = here[own[here]], there[theirs_inside[there]]
        mine, theirs = mine[own], theirs[theirs_inside]
    if not theirs.size:
        return {}
    if not view.truth.steps:  # else it is measured against what the recording states
        metrics["steps_error_percent"] = 100.0 * abs(mine.size - theirs.size) / theirs.size
    metrics["steps_recall"] = there.size / theirs.size
    if mine.size:
        metrics["steps_precision"] = here.size / mine.size
        metrics["steps_offset_s"] = offset * 1e-9
    return metrics


def _ends(table: pl.DataFrame) -> IntArray:
    return np.sort(table["end_ns" if "end_ns" in table.columns else "t_ns"].to_numpy().astype(np.int64))


def constant_offset(mine: IntArray, theirs: IntArray, tolerance_ns: int = TOLERANCE_NS) -> int:
    """Return by how much most steps lag the reference's (ns); 0 where there are none.

    Shapes: (n,) and (m,), ns.

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


def matched(mine: IntArray, theirs: IntArray, tolerance_ns: int = TOLERANCE_NS) -> tuple[IntArray, IntArray]:
    """Return the indices of pairs of one and one within the tolerance, as many as there can be.

    Shapes: (n,) and (m,) in ns, results (k,).

    Both in the order of time: the earliest partner that is left is never a worse choice than a later one.
    """
    i = j = 0
    pairs: list[tuple[int, int]] = []
    while i < mine.size and j < theirs.size:
        if abs(int(mine[i]) - int(theirs[j])) <= tolerance_ns:
            pairs.append((i, j))
            i, j = i + 1, j + 1
        elif mine[i] < theirs[j]:
            i += 1
        else:
            j += 1
    matches = np.array(pairs, np.int64).reshape(-1, 2)
    return matches[:, 0], matches[:, 1]
