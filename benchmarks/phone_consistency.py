"""Phones: whether the position that ``phone.fused`` states lies as far off as it says, over simulated walks."""

from __future__ import annotations

import numpy as np
from marcha.replay import nees_bounds
from marcha.replay.metrics_place import squared

from tests.phone_runs import carried

from . import Row

WALKS = 100
INSIDE = 5.99  # chi², 2 degrees of freedom, 95 %


def rows(scale: float) -> list[Row]:
    """Measure; ``scale`` 1 takes a hundred walks of 100 m in six placements."""
    count = max(6, int(WALKS * scale))
    return [row for velocity in (False, True) for row in _rows(count, velocity)]


def _rows(count: int, velocity: bool) -> list[Row]:
    walks = [carried(seed, velocity=velocity) for seed in range(count)]
    what = "phone.fused, with the receiver's velocity:" if velocity else "phone.fused:"
    end = float(np.mean([squared(e[-1:], cov[-1:])[0] for _, e, cov in walks]))
    inside = float(np.mean([np.mean(squared(e, cov) <= INSIDE) for _, e, cov in walks]))
    low, high = nees_bounds(count, dof=2)
    return [
        Row(
            f"{what} NEES of the last position, mean of {count} walks", end, "", "", None, None,
            f"{low:.2f} … {high:.2f} (95 % of χ²)", low < end < high,
        ),
        Row(
            f"{what} positions inside their 95 % ellipse, {count} walks", inside, "", "", None, None,
            "≥ 0.9", inside >= 0.9,
        ),
    ]  # fmt: skip
