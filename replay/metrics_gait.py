"""Gait parameters as figures of a run: of the whole walk, of an interval, of all intervals with a label."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .epochs import gait_of

if TYPE_CHECKING:
    from .view import RunView


def gait(view: RunView) -> dict[str, float]:
    """Cadence, time and length of strides (of steps for a sensor on the body), stance share, variation.

    A run that states stances is that of a foot. Distance and number of steps are figures of their own.
    """
    base = view.whole or view
    steps = base.table("step")
    if steps is None or not {"start_ns", "end_ns", "length_m"} <= set(steps.columns) or steps.is_empty():
        return {}
    metrics = gait_of(steps, view.spans, one_foot=base.has("stance"))
    return {k: v for k, v in metrics.items() if k not in ("steps", "distance_m")}
