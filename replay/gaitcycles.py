"""Joint angles over the gait cycle, 0 to 100 %: estimate, reference and error, mean and band over the cycles.

Cycles begin at annotated events (a label such as ``heel strike``, ``initial contact``, ``HS``; with ``left`` or
``right`` for one leg), else at the main maxima of the reference itself.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import msgspec
import numpy as np
import polars as pl

from ..algorithms.contract import FloatArray
from .alignment import IntArray
from .metrics_joint import (
    LEAST_EVENTS,
    angles_beside,
    cycles_of,
    events_of,
    starts_from_signal,
    wrapped_deg,
)

if TYPE_CHECKING:
    from .view import RunView


class JointCycles(msgspec.Struct, frozen=True):
    """One joint over the gait cycle, in degrees; lists have a value a percent, 0 … 100.

    Attributes
    ----------
    joint : str
        The joint.
    count : int
        Cycles in which both are known throughout.
    starts : str
        ``events`` or ``signal``: where the cycles begin.
    estimate_mean, estimate_sd, reference_mean, reference_sd, error_mean, error_sd : list of float
        Over the cycles; standard deviations have n − 1 below.
    rmse : list of float
        Of every cycle, in the order of time.
    """

    joint: str
    count: int
    starts: Literal["events", "signal"]
    estimate_mean: list[float]
    estimate_sd: list[float]
    reference_mean: list[float]
    reference_sd: list[float]
    error_mean: list[float]
    error_sd: list[float]
    rmse: list[float]


def cycle_starts(
    annotations: pl.DataFrame, joint: str, t_ns: IntArray, reference: FloatArray
) -> tuple[IntArray, Literal["events", "signal"]]:
    """Return where a joint's cycles begin, and by what.

    Shapes: ``t_ns`` and ``reference`` (rad) (n,), result (cycles,) in ns.
    """
    events = events_of(annotations, joint)
    if len(events) >= LEAST_EVENTS:
        return events, "events"
    return starts_from_signal(t_ns, reference), "signal"


def cycles(view: RunView) -> list[JointCycles]:
    """Return every joint of a run that has a reference, over its cycles; two cycles at least."""
    result = []
    for joint, t_ns, estimate, reference in angles_beside(view):
        starts, by = cycle_starts(view.annotations, joint, t_ns, reference)
        ours, theirs = cycles_of(t_ns, estimate, starts), cycles_of(t_ns, reference, starts)
        whole = np.isfinite(ours).all(axis=1) & np.isfinite(theirs).all(axis=1)
        if whole.sum() < 2:
            continue
        ours, theirs = ours[whole], theirs[whole]
        error = wrapped_deg(ours, theirs)
        bands = {"estimate": np.degrees(ours), "reference": np.degrees(theirs), "error": error}
        result.append(
            JointCycles(
                joint=joint,
                count=int(whole.sum()),
                starts=by,
                rmse=np.sqrt(np.mean(error**2, axis=1)).round(4).tolist(),
                **{f"{name}_mean": c.mean(axis=0).round(4).tolist() for name, c in bands.items()},
                **{f"{name}_sd": c.std(axis=0, ddof=1).round(4).tolist() for name, c in bands.items()},
            )
        )
    return result
