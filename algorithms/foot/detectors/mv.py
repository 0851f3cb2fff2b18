"""MV: moving variance of the force."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar

import msgspec

from ...numerics.compiled import compiled
from ...numerics.records import record_type
from ...parameters import meta
from .contract import SKOG, Detector


class Params(msgspec.Struct, frozen=True, kw_only=True):
    """Threshold."""

    mv_max: Annotated[
        float, meta("MV: greatest variance of f in the window", "m²/s⁴", f"{SKOG}: γσa²", gt=0.0)
    ] = 3.0


@compiled
def judge(d: Any, ring: Any, j: int, lo: int, hi: int) -> bool:
    """Still where the mean of ‖f − f̄‖² is below ``mv_max``."""
    mask = ring.shape[0] - 1
    n = hi - lo + 1
    mx, my, mz = 0.0, 0.0, 0.0
    for i in range(lo, hi + 1):
        r = ring[i & mask]
        mx += r.acc[0]
        my += r.acc[1]
        mz += r.acc[2]
    mx /= n
    my /= n
    mz /= n
    total = 0.0
    for i in range(lo, hi + 1):
        r = ring[i & mask]
        x, y, z = r.acc[0] - mx, r.acc[1] - my, r.acc[2] - mz
        total += x * x + y * y + z * z
    value = total / n
    ring[j & mask].statistic[0] = value
    return value < d.limit


class Mv(Detector):
    """Variance of the specific force in the window."""

    name: ClassVar[str] = "mv"
    title: ClassVar[str] = "moving variance of the force"
    source: ClassVar[str] = SKOG
    Params = Params
    RECORD = record_type(("limit", "f8"))
    statistics: ClassVar[tuple[str, ...]] = ("mv",)

    @classmethod
    def configure(cls, record: Any, params: Any) -> None:
        """Write the threshold."""
        record.limit = params.mv_max

    @classmethod
    def limits(cls, params: Any) -> dict[str, float]:
        """Return the threshold."""
        return {"mv": params.mv_max}
