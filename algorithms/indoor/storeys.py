"""The storeys of a building: their numbers and heights, and the one that each anchor is in.

They come from the anchor table (``floor``), from the plan (``floor`` of its features) or, where the height of a storey
is stated, from the heights of the anchors. Heights are above floor 0; one that lies in another storey than its anchor's
``floor`` is taken to be above that floor.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..contract import AlgorithmError, FloatArray, IntArray, Remark

PLAN = "plan.geojson"
USUAL_M = 3.4
"""Height of a storey, where floors are numbered and none is stated."""
BELOW_M = 0.5
"""So far below a floor is still that floor: heights are measured roughly."""
TALL_M = 3.0
"""Anchors whose heights differ by more may be in several storeys."""


@dataclass
class Storeys:
    """Floors of a building, from the lowest up.

    Attributes
    ----------
    numbers : list of int
        What they are called.
    levels : ndarray
        Heights of the floors (m), shape (n,).
    of_anchor : ndarray of int
        Index of each anchor's floor, shape (anchors,).
    above : ndarray
        Height of each anchor above its floor (m), NaN where it is not known, shape (anchors,).
    remarks : list of Remark
        What a user must know of them.
    """

    numbers: list[int]
    levels: FloatArray
    of_anchor: IntArray
    above: FloatArray
    remarks: list[Remark] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.numbers)

    def at(self, height_m: FloatArray) -> IntArray:
        """Return the index of the floor at heights (m), shape (m,); the lowest for those that are not known."""
        index = np.searchsorted(self.levels - BELOW_M, np.nan_to_num(height_m), side="right") - 1
        return np.clip(index, 0, len(self.numbers) - 1).astype(np.int64)


def storeys_of(
    height: FloatArray,
    floor: FloatArray,
    attachments: Mapping[str, bytes],
    metadata: Mapping[str, str],
    storey_m: float = 0.0,
) -> Storeys:
    """Return the storeys that anchors and plan tell of; one where they tell of none.

    Parameters
    ----------
    height, floor : ndarray
        Of the anchors: height (m) and number of the floor, NaN where not known, shape (n,).
    attachments : mapping
        With ``plan.geojson`` where there is one: its features' ``floor``, and ``storey_m``.
    metadata : mapping
        The record ``plan``: ``storey_m``.
    storey_m : float
        Height of a storey, 0: as the plan states it.
    """
    plan = _plan(attachments)
    stated = storey_m or _number(plan.get("storey_m", metadata.get("storey_m", 0.0)))
    drawn = {f for f in map(floor_of, plan.get("features", ())) if f is not None}
    told = {int(f) for f in floor[np.isfinite(floor)]}
    storey = stated or USUAL_M
    remarks: list[Remark] = []
    if stated and not told and np.isfinite(height).any():
        floor = np.where(np.isfinite(height), np.floor((height + 0.1) / stated), np.nan)
        told = {int(f) for f in floor[np.isfinite(floor)]}
    numbers = sorted(told | drawn)
    if len(numbers) < 2:
        level = storey * numbers[0] if numbers and told else 0.0
        tall = np.ptp(height[np.isfinite(height)]) if np.isfinite(height).any() else 0.0
        if tall > TALL_M and not numbers:
            detail = (
                f"heights of anchors differ by {tall:.1f} m, and nothing says floors: one floor is taken; give the "
                "anchor table a column floor, or state storey_m"
            )
            remarks.append(Remark("heights_without_floors", detail))
        base = _above(height, np.full(len(height), level), storey)
        return Storeys(
            [numbers[0] if numbers else 0], np.array([level]), np.zeros(len(height), np.int64), base, remarks
        )
    numbers = list(range(numbers[0], numbers[-1] + 1))  # a floor without anchors is walked through
    levels = storey * np.array(numbers, dtype=np.float64)
    if not stated:
        detail = f"{len(numbers)} floors of {USUAL_M:g} m a storey; state plan.storey_m where it differs"
        remarks.append(Remark("storey_height", detail))
    unknown = ~np.isfinite(floor)
    if unknown.any():
        remarks.append(
            Remark(
                "anchors_without_floor", f"{int(unknown.sum())} anchors say no floor: {numbers[0]} is taken"
            )
        )
    index = np.where(unknown, 0, np.nan_to_num(floor) - numbers[0]).astype(np.int64)
    return Storeys(numbers, levels, index, _above(height, levels[index], storey), remarks)


def floor_of(feature: Any) -> int | None:
    """Return the floor that a feature of a plan says that it is on; None for all floors."""
    value = (
        _number((feature.get("properties") or {}).get("floor", math.nan))
        if isinstance(feature, dict)
        else math.nan
    )
    return int(value) if math.isfinite(value) else None


def _above(height: FloatArray, level: FloatArray, storey: float) -> FloatArray:
    """Return heights above anchors' floors; those that are in another storey are above the floor already."""
    up = height - level
    elsewhere = (up < -BELOW_M) | (up >= storey + BELOW_M)
    return np.where(elsewhere & (height >= -BELOW_M) & (height < storey + BELOW_M), height, up)


def _plan(attachments: Mapping[str, bytes]) -> dict[str, Any]:
    if PLAN not in attachments:
        return {}
    try:
        plan = json.loads(attachments[PLAN])
    except ValueError as error:
        raise AlgorithmError(f"attachment {PLAN}: not JSON: {error}") from None
    return plan if isinstance(plan, dict) else {}


def _number(value: Any) -> float:
    try:
        return float(value)
    except (TypeError, ValueError):
        return math.nan
