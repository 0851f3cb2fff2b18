"""C1 & C2 & C3: norm of the force, its variance in a window, norm of the rate."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar

import msgspec

from ...contract import AlgorithmError
from ...numerics.compiled import inlined
from ...numerics.records import record_type
from ...parameters import meta
from .contract import DISSERTATION, Detector


class Params(msgspec.Struct, frozen=True, kw_only=True):
    """Thresholds of the three conditions."""

    c1_min: Annotated[float, meta("C1: least ‖f‖ at rest", "m/s²", DISSERTATION, ge=0.0)] = 9.0
    c1_max: Annotated[float, meta("C1: greatest ‖f‖ at rest", "m/s²", DISSERTATION, gt=0.0)] = 11.0
    c2_max: Annotated[
        float,
        meta(
            "C2: greatest variance of ‖f‖ in the window",
            "m²/s⁴",
            f"{DISSERTATION}; literature 3, 15, 20",
            gt=0.0,
        ),
    ] = 3.0
    c3_max: Annotated[float, meta("C3: greatest ‖ω‖ at rest", "rad/s", DISSERTATION, gt=0.0)] = 0.6


@inlined
def judge(d: Any, ring: Any, j: int, lo: int, hi: int) -> bool:
    """Still where c1_min < ‖f‖ < c1_max, var ‖f‖ < c2_max and ‖ω‖ < c3_max."""
    mask = ring.shape[0] - 1
    n = hi - lo + 1
    total = 0.0
    for i in range(lo, hi + 1):
        total += ring[i & mask].acc_norm
    mean = total / n
    total = 0.0
    for i in range(lo, hi + 1):
        deviation = ring[i & mask].acc_norm - mean
        total += deviation * deviation
    variance = total / n
    r = ring[j & mask]
    r.statistic[0] = r.acc_norm
    r.statistic[1] = variance
    r.statistic[2] = r.gyr_norm
    return d.c1_min < r.acc_norm < d.c1_max and variance < d.c2_max and r.gyr_norm < d.c3_max


class C1C2C3(Detector):
    """Three conditions on force and rate (after Jiménez et al. 2010)."""

    name: ClassVar[str] = "c1c2c3"
    title: ClassVar[str] = "norm of the force, its variance, norm of the rate"
    source: ClassVar[str] = f"{DISSERTATION}; Jiménez et al. 2010"
    Params = Params
    RECORD = record_type(("c1_min", "f8"), ("c1_max", "f8"), ("c2_max", "f8"), ("c3_max", "f8"))
    statistics: ClassVar[tuple[str, ...]] = ("acc_norm", "acc_var", "gyr_norm")
    window_s: ClassVar[float] = 0.1

    @classmethod
    def configure(cls, record: Any, params: Any) -> None:
        """Write the thresholds."""
        if params.c1_min >= params.c1_max:
            raise AlgorithmError(f"c1_min = {params.c1_min:g} must be below c1_max = {params.c1_max:g}")
        record.c1_min, record.c1_max = params.c1_min, params.c1_max
        record.c2_max, record.c3_max = params.c2_max, params.c3_max

    @classmethod
    def limits(cls, params: Any) -> dict[str, float]:
        """Return the thresholds by statistic."""
        return {
            "acc_norm.min": params.c1_min,
            "acc_norm": params.c1_max,
            "acc_var": params.c2_max,
            "gyr_norm": params.c3_max,
        }
