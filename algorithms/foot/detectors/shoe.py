"""SHOE: generalized likelihood ratio of rest, from force and rate."""

from __future__ import annotations

import math
from typing import Annotated, Any, ClassVar

import msgspec

from ...numerics.compiled import compiled
from ...numerics.records import record_type
from ...parameters import meta
from .contract import SKOG, Detector


class Params(msgspec.Struct, frozen=True, kw_only=True):
    """Threshold and noise."""

    shoe_max: Annotated[float, meta("SHOE: greatest statistic at rest", "1", SKOG, gt=0.0)] = 0.3e5
    shoe_sigma_acc: Annotated[float, meta("SHOE: noise of the accelerometer", "m/s²", SKOG, gt=0.0)] = 0.01
    shoe_sigma_gyr: Annotated[float, meta("SHOE: noise of the gyroscope", "rad/s", SKOG, gt=0.0)] = (
        math.radians(0.1)
    )


@compiled
def statistic(d: Any, ring: Any, lo: int, hi: int) -> float:
    """Return the mean of ‖f − g f̄/‖f̄‖‖²/σa² + ‖ω‖²/σω² over the samples ``lo`` to ``hi``."""
    mask = ring.shape[0] - 1
    n = hi - lo + 1
    mx, my, mz = 0.0, 0.0, 0.0
    for i in range(lo, hi + 1):
        r = ring[i & mask]
        mx += r.acc[0]
        my += r.acc[1]
        mz += r.acc[2]
    norm = math.sqrt(mx * mx + my * my + mz * mz)
    k = d.gravity / norm if norm > 0.0 else 0.0
    mx *= k
    my *= k
    mz *= k
    total = 0.0
    for i in range(lo, hi + 1):
        r = ring[i & mask]
        x, y, z = r.acc[0] - mx, r.acc[1] - my, r.acc[2] - mz
        w = r.gyr_norm
        total += (x * x + y * y + z * z) * d.weight_acc + w * w * d.weight_gyr
    return total / n


@compiled
def judge(d: Any, ring: Any, j: int, lo: int, hi: int) -> bool:
    """Still where the statistic is below ``shoe_max``."""
    value = statistic(d, ring, lo, hi)
    ring[j & (ring.shape[0] - 1)].statistic[0] = value
    return value < d.limit


class Shoe(Detector):
    """Generalized likelihood ratio test of a foot at rest."""

    name: ClassVar[str] = "shoe"
    title: ClassVar[str] = "generalized likelihood ratio of force and rate"
    source: ClassVar[str] = SKOG
    Params = Params
    RECORD = record_type(("weight_acc", "f8"), ("weight_gyr", "f8"), ("gravity", "f8"), ("limit", "f8"))
    statistics: ClassVar[tuple[str, ...]] = ("shoe",)

    @classmethod
    def configure(cls, record: Any, params: Any) -> None:
        """Write the threshold and the weights."""
        record.weight_acc, record.weight_gyr = 1.0 / params.shoe_sigma_acc**2, 1.0 / params.shoe_sigma_gyr**2
        record.gravity, record.limit = params.gravity, params.shoe_max

    @classmethod
    def limits(cls, params: Any) -> dict[str, float]:
        """Return the threshold."""
        return {"shoe": params.shoe_max}
