"""MAG: magnitude of the force against gravity."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar

import msgspec

from ...numerics.compiled import compiled
from ...numerics.records import record_type
from ...parameters import meta
from .contract import SKOG, Detector


class Params(msgspec.Struct, frozen=True, kw_only=True):
    """Threshold."""

    mag_max: Annotated[
        float, meta("MAG: greatest mean (‖f‖ − g)² in the window", "m²/s⁴", f"{SKOG}: γσa²", gt=0.0)
    ] = 3.0


@compiled
def judge(d: Any, ring: Any, j: int, lo: int, hi: int) -> bool:
    """Still where the mean of (‖f‖ − g)² is below ``mag_max``."""
    mask = ring.shape[0] - 1
    total = 0.0
    for i in range(lo, hi + 1):
        deviation = ring[i & mask].acc_norm - d.gravity
        total += deviation * deviation
    value = total / (hi - lo + 1)
    ring[j & mask].statistic[0] = value
    return value < d.limit


class Mag(Detector):
    """Mean square of the distance of ‖f‖ from gravity."""

    name: ClassVar[str] = "mag"
    title: ClassVar[str] = "magnitude of the force against gravity"
    source: ClassVar[str] = SKOG
    Params = Params
    RECORD = record_type(("gravity", "f8"), ("limit", "f8"))
    statistics: ClassVar[tuple[str, ...]] = ("mag",)

    @classmethod
    def configure(cls, record: Any, params: Any) -> None:
        """Write the threshold and gravity."""
        record.gravity, record.limit = params.gravity, params.mag_max

    @classmethod
    def limits(cls, params: Any) -> dict[str, float]:
        """Return the threshold."""
        return {"mag": params.mag_max}
