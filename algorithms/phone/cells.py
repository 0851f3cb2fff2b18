"""Even cells of 20 ms out of samples at any rate, for the detectors that look at rhythm, period or spectrum."""

from __future__ import annotations

from typing import Any

from ..numerics.compiled import compiled
from . import periodic, rhythm
from .ring import CELL_NS, KEPT

FIELDS: list[tuple[Any, ...]] = [
    ("method", "i8"),
    ("cell", "i8"),  # number of the cell that is filled, from the first sample on
    ("cell_zero", "i8"),
    ("cell_sum", "f8"),
    ("at_ns", "i8"),
    ("at_norm", "f8"),
    ("begun", "i8"),
    ("cells", "f8", (KEPT,)),
    ("filled", "i8"),  # cells since the last gap
    *rhythm.FIELDS,
    *periodic.FIELDS,
]

RHYTHM, AUTOCORRELATION, SPECTRAL = 0, 1, 2
GAP_NS = 1_000_000_000
"""A longer silence ends the walk."""


@compiled
def take(s: Any, t_ns: int, norm: float) -> None:
    """Take a sample of ‖f‖; steps go into the queue. Between samples ‖f‖ is taken for linear."""
    if s.begun == 0 or t_ns - s.at_ns > GAP_NS:
        if s.begun == 1:
            settle(s)
        s.begun = 1
        s.filled = 0
        rhythm.on_break(s)
        periodic.on_break(s)
        s.cell_zero, s.cell, s.cell_sum = t_ns, 0, 0.0
        s.at_ns, s.at_norm = t_ns, norm
        return
    a, b = s.at_ns, s.at_norm
    while True:
        edge = s.cell_zero + (s.cell + 1) * CELL_NS
        if t_ns < edge:
            s.cell_sum += 0.5 * (b + norm) * (t_ns - a)
            break
        at_edge = b + (norm - b) * ((edge - a) / (t_ns - a))
        _cell(s, (s.cell_sum + 0.5 * (b + at_edge) * (edge - a)) / CELL_NS)
        s.cell_sum = 0.0
        a, b = edge, at_edge
    s.at_ns, s.at_norm = t_ns, norm


@compiled
def _cell(s: Any, value: float) -> None:
    i = s.cell
    s.cells[i % KEPT] = value
    if s.filled == 0:  # as if the first value had always been there
        for k in range(1, rhythm.TAPS):
            s.cells[(i - k) % KEPT] = value
    s.filled += 1
    if s.method == RHYTHM:
        rhythm.on_cell(s)
    else:
        periodic.on_cell(s, s.method == SPECTRAL)
    s.cell += 1


@compiled
def settle(s: Any) -> None:
    """At the end, or before a gap: hold the last value for as long as the filter looks ahead."""
    if s.begun == 0 or s.method != RHYTHM:
        return
    for _ in range(rhythm.HALF + int(s.rest_gap_s * 1e9 / CELL_NS) + 2):
        _cell(s, s.at_norm)
