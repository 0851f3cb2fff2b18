"""GAIT: the likelihood ratio of SHOE against a threshold that follows the gait itself."""

from __future__ import annotations

import math
from typing import Annotated, Any, ClassVar

import msgspec

from ...numerics.compiled import inlined
from ...numerics.records import record_type
from ...parameters import meta
from . import shoe
from .contract import Detector

_SOURCE = "ours, measured on walks, running, stairs and creeping"


class Params(msgspec.Struct, frozen=True, kw_only=True):
    """How the threshold follows the gait."""

    gait_horizon_s: Annotated[
        float,
        meta(
            "Quietest moment is looked for so long before and after a sample: half a slow stride",
            "s",
            _SOURCE,
            gt=0.0,
            le=5.0,
        ),
    ] = 0.5
    gait_ratio: Annotated[
        float,
        meta("Still: statistic at most so many times that of the quietest moment", "1", _SOURCE, gt=1.0),
    ] = 2.5
    gait_min: Annotated[
        float, meta("Statistic below which a foot is still in any gait", "1", _SOURCE, gt=0.0)
    ] = 5.6e4
    gait_max: Annotated[float, meta("Statistic above which a foot is never still", "1", _SOURCE, gt=0.0)] = (
        3.2e6
    )


@inlined
def judge(d: Any, ring: Any, j: int, lo: int, hi: int) -> bool:
    """Write the statistic of sample ``j`` and queue it for the quietest moment; :func:`settle` decides.

    The queue holds the samples of the horizon whose statistic no later one undercuts, the quietest first; it
    lies in the ring, so that each sample enters and leaves it once.
    """
    mask = ring.shape[0] - 1
    value = shoe.statistic(d, ring, lo, hi)
    ring[j & mask].statistic[0] = value
    while d.tail > d.head and ring[ring[(d.tail - 1) & mask].queue & mask].statistic[0] >= value:
        d.tail -= 1
    ring[d.tail & mask].queue = j
    d.tail += 1
    return False


@inlined
def settle(d: Any, ring: Any, j: int) -> bool:
    """Write the threshold of sample ``j`` and return the raw decision."""
    mask = ring.shape[0] - 1
    while ring[d.head & mask].queue < j - d.horizon:
        d.head += 1
    quietest = ring[ring[d.head & mask].queue & mask].statistic[0]
    r = ring[j & mask]
    r.statistic[1] = min(max(d.ratio * quietest, d.least), d.greatest)
    return r.statistic[0] < r.statistic[1]


class Gait(Detector):
    """SHOE with a threshold for each stance: a multiple of the quietest moment within half a stride.

    In slow walking a foot rests at 1e3 … 1e4 of SHOE's statistic, in running its quietest moment has 1e6,
    which is a swing in slow walking: no fixed threshold serves both. The quietest moment within
    ``gait_horizon_s`` is the middle of a stance in any gait; what is at most ``gait_ratio`` times as restless
    belongs to it, within a floor (rest) and a ceiling (never still).
    """

    name: ClassVar[str] = "gait"
    title: ClassVar[str] = "likelihood ratio against the quietest moment of the stride"
    source: ClassVar[str] = "ours; statistic of Skog et al. 2010"
    Params = Params
    RECORD = record_type(
        ("weight_acc", "f8"),
        ("weight_gyr", "f8"),
        ("gravity", "f8"),
        ("ratio", "f8"),
        ("least", "f8"),
        ("greatest", "f8"),
        ("horizon", "i8"),  # samples
        ("head", "i8"),  # of the queue
        ("tail", "i8"),
    )
    statistics: ClassVar[tuple[str, ...]] = ("shoe", "threshold")
    window_s: ClassVar[float] = 0.075
    cleaning: ClassVar[str] = "none"

    @classmethod
    def horizon_s(cls, params: Any) -> float:
        """Return the look-ahead of the decision beyond the window."""
        return params.gait_horizon_s

    @classmethod
    def configure(cls, record: Any, params: Any) -> None:
        """Write the thresholds and the weights."""
        record.weight_acc, record.weight_gyr = 1.0 / 0.01**2, 1.0 / math.radians(0.1) ** 2
        record.gravity, record.ratio = params.gravity, params.gait_ratio
        record.least, record.greatest = params.gait_min, params.gait_max

    @classmethod
    def limits(cls, params: Any) -> dict[str, float]:
        """Return floor and ceiling of the threshold."""
        return {"threshold.min": params.gait_min, "threshold": params.gait_max}
