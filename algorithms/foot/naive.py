"""Foot-mounted strapdown without any correction ("naive"): what the others are better than."""

from __future__ import annotations

import math
from typing import Any, ClassVar

from ..contract import FloatArray
from ..numerics import strapdown
from ..numerics.compiled import compiled
from ..numerics.records import record_type
from . import core
from .estimator import FootEstimator
from .parameters import FootParams, with_parts

FootNaiveParams = with_parts(FootParams, "FootNaiveParams", __name__)


@compiled
def _navigate(s: Any, ring: Any, out: FloatArray) -> None:
    r = core.release(s, ring)
    if not core.starts(s, r) and s.started:
        strapdown.advance(s, r)
    core.emit(s, r, out)
    core.emit_detector(r, core.SIGMA, out)


@compiled
def kernel(state: Any, ring: Any, row: FloatArray, out: FloatArray) -> bool:
    """Take one row; fill ``out`` and return True where a result is due."""
    s = state[0]
    if not core.take(s, ring, row):
        return False
    _navigate(s, ring, out)
    return True


@compiled
def run(state: Any, ring: Any, rows: FloatArray, out: FloatArray) -> int:
    """Take all rows; a row without a result is NaN. Return the number of results."""
    results = 0
    for i in range(rows.shape[0]):
        if kernel(state, ring, rows[i], out[i]):
            results += 1
        else:
            out[i, :] = math.nan
    return results


@compiled
def flush(state: Any, ring: Any, out: FloatArray) -> int:
    """Fill ``out`` with the results still held back, return their number."""
    s = state[0]
    results = 0
    while results < out.shape[0] and core.take_end(s, ring):
        _navigate(s, ring, out[results])
        results += 1
    return results


class FootNaive(FootEstimator):
    """Strapdown mechanization from the rest at the start, never corrected; the detector only watches.

    Source: foot-navigation dissertation, eqs 3.19–3.27 (see :mod:`..numerics.strapdown`); the default is the
    authors' program (trapezoids), ``integration="euler"`` is the text.
    """

    name: ClassVar[str] = "foot.naive"
    title: ClassVar[str] = "strapdown without correction"
    source: ClassVar[str] = "foot-navigation dissertation, eqs 3.19–3.27"
    Params = FootNaiveParams
    RECORD = record_type(*core.CORE)
    has_sigma: ClassVar[bool] = False
    kernel = staticmethod(kernel)
    run = staticmethod(run)
    flush_kernel = staticmethod(flush)
