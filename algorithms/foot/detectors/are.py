"""ARE: angular rate energy."""

from __future__ import annotations

import math
from typing import Annotated, Any, ClassVar

import msgspec

from ...numerics.compiled import compiled
from ...numerics.records import record_type
from ...parameters import meta
from .contract import SKOG, Detector


class Params(msgspec.Struct, frozen=True, kw_only=True):
    """Threshold."""

    are_max: Annotated[
        float, meta("ARE: greatest mean ‖ω‖² in the window", "rad²/s²", f"{SKOG}: γσω²", gt=0.0)
    ] = 0.3e5 * math.radians(0.1) ** 2


@compiled
def judge(d: Any, ring: Any, j: int, lo: int, hi: int) -> bool:
    """Still where the mean of ‖ω‖² is below ``are_max``."""
    mask = ring.shape[0] - 1
    total = 0.0
    for i in range(lo, hi + 1):
        w = ring[i & mask].gyr_norm
        total += w * w
    value = total / (hi - lo + 1)
    ring[j & mask].statistic[0] = value
    return value < d.limit


class Are(Detector):
    """Mean square of the angular rate."""

    name: ClassVar[str] = "are"
    title: ClassVar[str] = "angular rate energy"
    source: ClassVar[str] = SKOG
    Params = Params
    RECORD = record_type(("limit", "f8"))
    statistics: ClassVar[tuple[str, ...]] = ("are",)

    @classmethod
    def configure(cls, record: Any, params: Any) -> None:
        """Write the threshold."""
        record.limit = params.are_max

    @classmethod
    def limits(cls, params: Any) -> dict[str, float]:
        """Return the threshold."""
        return {"are": params.are_max}
