"""Streaming zero-velocity detectors: one module each, all built alike (:mod:`.contract`).

Every detector turns a window of samples into one to three statistics and a raw decision, and the decisions
are then cleaned (:mod:`.cleaning`). Windows are ``centred`` on the sample that they speak of or ``trailing``
(only its past); at both ends of the data they are cut off. What a detector must look ahead is its latency:
half a centred window, the horizon of an adaptive detector, and the look-ahead of the cleaning. The estimator
holds its samples back by as much, so the decision about sample k meets sample k. Every length is in seconds
and becomes ``round(length · rate)`` samples.

==========  ==================================================  =============================================
detector    statistics (columns of the output ``detector``)     still where
==========  ==================================================  =============================================
``c1c2c3``  ``acc_norm`` m/s², ``acc_var`` m²/s⁴,               c1_min < ‖f‖ < c1_max, var ‖f‖ < c2_max and
            ``gyr_norm`` rad/s                                  ‖ω‖ < c3_max
``pitch``   ``pitch_dev`` deg, ``pitch_var`` deg²               both below their limits
``shoe``    ``shoe``: mean ‖f − g f̄/‖f̄‖‖²/σa² + ‖ω‖²/σω²       below shoe_max
``are``     ``are``: mean ‖ω‖², rad²/s²                         below are_max
``mv``      ``mv``: mean ‖f − f̄‖², m²/s⁴                        below mv_max
``mag``     ``mag``: mean (‖f‖ − g)², m²/s⁴                     below mag_max
``gait``    ``shoe``, ``threshold``: gait_ratio times the       shoe below threshold
            least shoe within gait_horizon_s
==========  ==================================================  =============================================

Sources: c1c2c3 and pitch from the foot-navigation dissertation (sections 4.4 and 4.4.1; after Jiménez et al.
2010); shoe, are, mv, mag from Skog, Händel, Nilsson, Rantakokko (2010), "Zero-velocity detection - an
algorithm evaluation", with the settings of their program (σa = 0.01 m/s², σω = 0.1 °/s, γ = 0.3·10⁵),
written here in physical units: γσω² = 0.0914 rad²/s², γσa² = 3 m²/s⁴.

A new detector is a module, its class in :data:`DETECTORS` and its line in :func:`judge`: compiled code cannot
call a function that it only meets at run time without losing numba's cache.
"""

from __future__ import annotations

from typing import Any

from ...numerics.compiled import inlined
from ...numerics.records import record_type
from . import are, c1c2c3, gait, mag, mv, pitch, shoe
from .cleaning import CLEANING, CLEANINGS, clean
from .contract import Detector

__all__ = ["BY_NAME", "DETECTOR", "DETECTORS", "configure", "decide", "judge", "limits"]

DETECTORS: tuple[type[Detector], ...] = (
    c1c2c3.C1C2C3,
    pitch.Pitch,
    shoe.Shoe,
    are.Are,
    mv.Mv,
    mag.Mag,
    gait.Gait,
)
NAMES = tuple(d.name for d in DETECTORS)
BY_NAME = dict(zip(NAMES, DETECTORS, strict=True))
C1C2C3, PITCH, SHOE, ARE, MV, MAG, GAIT = (
    NAMES.index(n) for n in ("c1c2c3", "pitch", "shoe", "are", "mv", "mag", "gait")
)

DETECTOR = record_type(
    ("kind", "i8"),  # index into DETECTORS
    ("before", "i8"),  # samples of the statistic's window before the sample that it speaks of
    ("after", "i8"),  # samples after it
    ("horizon", "i8"),  # look-ahead of the decision beyond the window, samples
    ("latency", "i8"),  # look-ahead of window, horizon and cleaning, samples
    ("cleaning", record_type(*CLEANING)),
    *((d.name, d.RECORD) for d in DETECTORS),
)


@inlined
def judge(d: Any, ring: Any, j: int, last: int) -> None:
    """Write the statistics and the raw decision of sample ``j``; ``last`` is the newest sample there is."""
    lo = max(0, j - d.before)
    hi = min(last, j + d.after)
    kind = d.kind
    if kind == C1C2C3:
        still = c1c2c3.judge(d.c1c2c3, ring, j, lo, hi)
    elif kind == PITCH:
        still = pitch.judge(d.pitch, ring, j, lo, hi)
    elif kind == SHOE:
        still = shoe.judge(d.shoe, ring, j, lo, hi)
    elif kind == ARE:
        still = are.judge(d.are, ring, j, lo, hi)
    elif kind == MV:
        still = mv.judge(d.mv, ring, j, lo, hi)
    elif kind == MAG:
        still = mag.judge(d.mag, ring, j, lo, hi)
    else:
        still = gait.judge(d.gait, ring, j, lo, hi)
    ring[j & (ring.shape[0] - 1)].raw = still


@inlined
def decide(d: Any, ring: Any, k: int, last: int) -> None:
    """Advance every stage as far as sample ``k`` allows; past the end (``k > last``) windows are cut off
    there.

    Afterwards the decision of sample ``k − latency`` stands in its record.
    """
    j = k - d.after
    if 0 <= j <= last:
        judge(d, ring, j, last)
    if d.horizon > 0:
        j -= d.horizon
        if 0 <= j <= last:
            ring[j & (ring.shape[0] - 1)].raw = gait.settle(d.gait, ring, j)
    clean(d.cleaning, ring, j, last)


def limits(params: Any) -> tuple[tuple[str, str], ...]:
    """Return the detector's limits as channel metadata: ``threshold.<statistic>``, ``.min`` for a floor."""
    chosen = BY_NAME[params.detector].limits(params)
    return tuple((f"threshold.{name}", f"{value:g}") for name, value in chosen.items())


def configure(record: Any, params: Any, rate_hz: float) -> int:
    """Write the detector's constants into its record (:data:`DETECTOR`).

    Returns
    -------
    int
        Samples that the ring must hold.
    """
    chosen = BY_NAME[params.detector]
    window = _samples(params.window_s or chosen.window_s, rate_hz)
    kind = chosen.cleaning if params.cleaning == "own" else params.cleaning
    length = _samples(params.cleaning_s, rate_hz) if kind != "none" else 1
    record.kind = NAMES.index(params.detector)
    record.before, record.after = _split(window, params.window_side)
    cleaning = record.cleaning
    cleaning.kind, cleaning.length = CLEANINGS.index(kind), length
    cleaning.before, cleaning.after = _split(length, params.window_side)
    if kind == "fill-burst":
        cleaning.before, cleaning.after = 0, 2 * (length - 1)
    cleaning.last_raw = -1
    horizon_s = chosen.horizon_s(params)
    record.horizon = _samples(horizon_s, rate_hz) if horizon_s else 0
    record.gait.horizon = record.horizon
    record.latency = record.after + record.horizon + cleaning.after
    for detector in DETECTORS:
        detector.configure(getattr(record, detector.name), params)
    return int(record.latency + record.before + record.horizon + cleaning.before)


def _samples(seconds: float, rate_hz: float) -> int:
    return max(1, round(seconds * rate_hz))


def _split(window: int, side: str) -> tuple[int, int]:
    """Return how many samples before and after its own a window of ``window`` samples takes."""
    before = window - 1 if side == "trailing" else window // 2
    return before, window - 1 - before
