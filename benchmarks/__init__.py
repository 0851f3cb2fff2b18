"""Speed and memory as ratios against peers measured in the same run: ``python -m benchmarks``."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass
class Row:
    """One line of the table.

    Attributes
    ----------
    name : str
        What was measured.
    ours : float
        Our figure, in ``unit``.
    unit : str
        ``s``, ``samples/s``, ``rows/s``, ``MB`` …
    peer : str
        What it is compared with; empty where the target is absolute.
    theirs : float or None
        The peer's figure, in ``unit``, measured in the same run.
    ratio : float or None
        How many times better than the peer (or times its cost, as the name says).
    target : str
        What we promise, as text.
    met : bool
        Whether this run kept the promise.
    """

    name: str
    ours: float
    unit: str
    peer: str
    theirs: float | None
    ratio: float | None
    target: str
    met: bool
