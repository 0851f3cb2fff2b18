"""Foot-mounted strapdown without any correction ("naive"): what the others are better than."""

from __future__ import annotations

from typing import ClassVar

from ..contract import FloatArray
from ..numerics.compiled import compiled
from . import common as foot
from . import strapdown
from .layout import O_REST, STARTED


@compiled
def _navigate(s: FloatArray, out: FloatArray) -> None:
    r = foot.release(s)
    if not foot.starts(s) and s[STARTED] > 0.5:
        strapdown.advance(s, r)
    foot.emit(s, r, out)
    foot.emit_detector(s, r, O_REST, out)


@compiled
def kernel(state: FloatArray, row: FloatArray, out: FloatArray) -> bool:
    """Take one row; fill ``out`` and return True where a result is due."""
    if not foot.take(state, row):
        return False
    _navigate(state, out)
    return True


@compiled
def run(state: FloatArray, rows: FloatArray, out: FloatArray) -> int:
    """Take all rows; see :class:`..contract.RowKernel`."""
    results = 0
    for i in range(rows.shape[0]):
        if kernel(state, rows[i], out[i]):
            results += 1
        else:
            out[i, :] = float("nan")
    return results


@compiled
def flush(state: FloatArray, out: FloatArray) -> int:
    """Fill ``out`` with the results still held back, return their number."""
    results = 0
    while results < out.shape[0] and foot.take_end(state):
        _navigate(state, out[results])
        results += 1
    return results


class FootNaive(foot.FootEstimator):
    """Strapdown mechanization from the rest at the start, never corrected; the detector only watches.

    Source: foot-navigation dissertation, eqs 3.19–3.27 (see :mod:`.strapdown`); the default is the authors'
    program (trapezoids), ``integration="euler"`` is the text.
    """

    name: ClassVar[str] = "foot.naive"
    title: ClassVar[str] = "strapdown without correction"
    source: ClassVar[str] = "foot-navigation dissertation, eqs 3.19–3.27"
    has_sigma: ClassVar[bool] = False
    kernel = staticmethod(kernel)
    run = staticmethod(run)
    flush_kernel = staticmethod(flush)
