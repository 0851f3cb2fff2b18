"""Streaming zero-velocity detectors over the packed state of a foot estimator.

Every detector turns a window of samples into one to three statistics and a raw decision, and the decisions
are then cleaned. Windows are ``centred`` on the sample that they speak of or ``trailing`` (only its past);
at both ends of the data they are cut off. What a detector must look ahead is its latency: half a centred
window plus the look-ahead of the cleaning. The estimator holds its samples back by as much, so the decision
about sample k meets sample k.

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
==========  ==================================================  =============================================

Sources: c1c2c3 and pitch from the foot-navigation dissertation (sections 4.4 and 4.4.1; after Jiménez et al.
2010); shoe, are, mv, mag from Skog, Händel, Nilsson, Rantakokko (2010), "Zero-velocity detection - an
algorithm evaluation", with the settings of their program (σa = 0.01 m/s², σω = 0.1 °/s, γ = 0.3·10⁵),
written here in physical units: γσω² = 0.0914 rad²/s², γσa² = 3 m²/s⁴. Every length is in seconds and becomes
``round(length · rate)`` samples.

Cleaning, over ``cleaning_s`` (the source: 10 samples at 100 Hz):
``median`` takes the majority of the window, a tie is moving;
``fill-burst`` fills gaps between two still stretches that are shorter than the window, then removes still
stretches shorter than it (the authors' program; needs twice the window as look-ahead); ``none`` leaves the
raw decision.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..numerics.compiled import compiled, inlined
from . import layout as la
from .layout import (
    BURST_START,
    C_HI,
    C_LEN,
    C_LO,
    CLEANING,
    GRAVITY_PARAM,
    INIT_MEAN,
    KIND,
    LAST_ONE,
    LIMITS,
    PITCH_REF,
    R_ACC,
    R_DT,
    R_FILLED,
    R_GYR,
    R_NORM_ACC,
    R_NORM_GYR,
    R_PITCH,
    R_RAW,
    R_STAT,
    R_STILL,
    RAW_COUNT,
    RECORD,
    RING,
    RING_MASK,
    TILT,
    W_HI,
    W_LO,
    WEIGHT_ACC,
    WEIGHT_GYR,
)

FloatArray = NDArray[np.float64]

KINDS = ("c1c2c3", "pitch", "shoe", "are", "mv", "mag")
PITCH = KINDS.index("pitch")
CLEANINGS = ("median", "fill-burst", "none")
STATISTICS: dict[str, tuple[str, ...]] = {
    "c1c2c3": ("acc_norm", "acc_var", "gyr_norm"),
    "pitch": ("pitch_dev", "pitch_var"),
    "shoe": ("shoe",),
    "are": ("are",),
    "mv": ("mv",),
    "mag": ("mag",),
}
DEGREES = 180.0 / math.pi


@inlined
def record(s: FloatArray, j: int) -> int:
    """Return the offset of sample ``j``'s record in the ring."""
    return int(s[RING]) + (j & int(s[RING_MASK])) * RECORD


@compiled
def start_tilt(s: FloatArray) -> None:
    """Take the gravity direction and the reference pitch of the pitch detector from the rest at the start."""
    x, y, z = s[INIT_MEAN], s[INIT_MEAN + 1], s[INIT_MEAN + 2]
    norm = math.sqrt(x * x + y * y + z * z)
    if norm > 0.0:
        s[TILT], s[TILT + 1], s[TILT + 2] = x / norm, y / norm, z / norm
        s[PITCH_REF] = _pitch(s)


@compiled
def _pitch(s: FloatArray) -> float:
    return DEGREES * math.atan2(-s[TILT], math.sqrt(s[TILT + 1] * s[TILT + 1] + s[TILT + 2] * s[TILT + 2]))


@compiled
def track_tilt(s: FloatArray, r: int) -> None:
    """Carry the gravity direction on by the angular rate of the sample at ``r``, and write its pitch (deg).

    The direction turns against the sensor (ġ = −ω × g, by Cayley's rotation) and is pulled towards the
    accelerometer with the time constant ``pitch_tau_s`` while C1 and C3 hold, so that the gyroscope's
    residual bias cannot pile up.
    """
    dt = s[r + R_DT]
    a = -0.5 * dt * (s[r + R_GYR] - s[INIT_MEAN + 3])
    b = -0.5 * dt * (s[r + R_GYR + 1] - s[INIT_MEAN + 4])
    c = -0.5 * dt * (s[r + R_GYR + 2] - s[INIT_MEAN + 5])
    x, y, z = s[TILT], s[TILT + 1], s[TILT + 2]
    k = 2.0 / (1.0 + a * a + b * b + c * c)
    u, v, w = b * z - c * y, c * x - a * z, a * y - b * x
    x += k * (u + b * w - c * v)
    y += k * (v + c * u - a * w)
    z += k * (w + a * v - b * u)
    norm = s[r + R_NORM_ACC]
    if 9.0 < norm < 11.0 and s[r + R_NORM_GYR] < 0.6:
        pull = dt / (s[la.PITCH_TAU] + dt)
        x += pull * (s[r + R_ACC] / norm - x)
        y += pull * (s[r + R_ACC + 1] / norm - y)
        z += pull * (s[r + R_ACC + 2] / norm - z)
    norm = math.sqrt(x * x + y * y + z * z)
    s[TILT], s[TILT + 1], s[TILT + 2] = x / norm, y / norm, z / norm
    s[r + R_PITCH] = _pitch(s)


@inlined
def _variance(s: FloatArray, field: int, lo: int, hi: int) -> float:
    base, mask = int(s[RING]) + field, int(s[RING_MASK])
    n = hi - lo + 1
    total = 0.0
    for i in range(lo, hi + 1):
        total += s[base + (i & mask) * RECORD]
    mean = total / n
    total = 0.0
    for i in range(lo, hi + 1):
        d = s[base + (i & mask) * RECORD] - mean
        total += d * d
    return total / n


@compiled
def _shoe(s: FloatArray, lo: int, hi: int) -> float:
    base, mask = int(s[RING]), int(s[RING_MASK])
    n = hi - lo + 1
    mx, my, mz = 0.0, 0.0, 0.0
    for i in range(lo, hi + 1):
        r = base + (i & mask) * RECORD + R_ACC
        mx += s[r]
        my += s[r + 1]
        mz += s[r + 2]
    norm = math.sqrt(mx * mx + my * my + mz * mz)
    k = s[GRAVITY_PARAM] / norm if norm > 0.0 else 0.0
    mx *= k
    my *= k
    mz *= k
    total = 0.0
    for i in range(lo, hi + 1):
        r = base + (i & mask) * RECORD
        x, y, z = s[r + R_ACC] - mx, s[r + R_ACC + 1] - my, s[r + R_ACC + 2] - mz
        w = s[r + R_NORM_GYR]
        total += (x * x + y * y + z * z) * s[WEIGHT_ACC] + w * w * s[WEIGHT_GYR]
    return total / n


@compiled
def _moving_variance(s: FloatArray, lo: int, hi: int) -> float:
    base, mask = int(s[RING]), int(s[RING_MASK])
    n = hi - lo + 1
    mx, my, mz = 0.0, 0.0, 0.0
    for i in range(lo, hi + 1):
        r = base + (i & mask) * RECORD + R_ACC
        mx += s[r]
        my += s[r + 1]
        mz += s[r + 2]
    mx /= n
    my /= n
    mz /= n
    total = 0.0
    for i in range(lo, hi + 1):
        r = base + (i & mask) * RECORD + R_ACC
        x, y, z = s[r] - mx, s[r + 1] - my, s[r + 2] - mz
        total += x * x + y * y + z * z
    return total / n


@compiled
def _energy(s: FloatArray, field: int, level: float, lo: int, hi: int) -> float:
    base, mask = int(s[RING]) + field, int(s[RING_MASK])
    total = 0.0
    for i in range(lo, hi + 1):
        d = s[base + (i & mask) * RECORD] - level
        total += d * d
    return total / (hi - lo + 1)


@inlined
def _judge(s: FloatArray, j: int, last: int) -> None:
    """Write the statistics and the raw decision of sample ``j``; ``last`` is the newest sample there is."""
    lo = max(0, j - int(s[W_LO]))
    hi = min(last, j + int(s[W_HI]))
    r = record(s, j)
    kind = int(s[KIND])
    still = False
    if kind == 0:
        norm, rate = s[r + R_NORM_ACC], s[r + R_NORM_GYR]
        var = _variance(s, R_NORM_ACC, lo, hi)
        s[r + R_STAT], s[r + R_STAT + 1], s[r + R_STAT + 2] = norm, var, rate
        still = s[LIMITS] < norm < s[LIMITS + 1] and var < s[LIMITS + 2] and rate < s[LIMITS + 3]
    elif kind == 1:
        dev = abs(s[r + R_PITCH] - s[PITCH_REF])
        var = _variance(s, R_PITCH, lo, hi)
        s[r + R_STAT], s[r + R_STAT + 1] = dev, var
        still = dev < s[LIMITS] and var < s[LIMITS + 1]
    else:
        if kind == 2:
            stat = _shoe(s, lo, hi)
        elif kind == 3:
            stat = _energy(s, R_NORM_GYR, 0.0, lo, hi)
        elif kind == 4:
            stat = _moving_variance(s, lo, hi)
        else:
            stat = _energy(s, R_NORM_ACC, s[GRAVITY_PARAM], lo, hi)
        s[r + R_STAT] = stat
        still = stat < s[LIMITS]
    s[r + R_RAW] = 1.0 if still else 0.0


@compiled
def _fill(s: FloatArray, j: int, last: int) -> None:
    """Close a gap at ``j`` that is shorter than the cleaning window and has still samples on both sides."""
    m = int(s[C_LEN])
    r = record(s, j)
    still = s[r + R_RAW] > 0.5
    if still:
        s[LAST_ONE] = j
    elif s[LAST_ONE] >= 0.0:
        for i in range(j + 1, min(int(s[LAST_ONE]) + m, last) + 1):
            if s[record(s, i) + R_RAW] > 0.5:
                still = True
                break
    s[r + R_FILLED] = 1.0 if still else 0.0


@compiled
def _keep(s: FloatArray, j: int, last: int) -> None:
    """Drop a still stretch around ``j`` that is shorter than the cleaning window."""
    m = int(s[C_LEN])
    r = record(s, j)
    if s[r + R_FILLED] < 0.5:
        s[BURST_START] = j + 1
        s[r + R_STILL] = 0.0
        return
    first = int(s[BURST_START])
    length = j - first + 1
    i = j + 1
    while length < m and i <= last and s[record(s, i) + R_FILLED] > 0.5:
        length += 1
        i += 1
    s[r + R_STILL] = 1.0 if length >= m else 0.0


@inlined
def decide(s: FloatArray, k: int, last: int) -> None:
    """Advance every stage as far as sample ``k`` allows; past the end (``k > last``) windows are cut off
    there.

    Afterwards the decision of sample ``k − latency`` stands in its record.
    """
    j = k - int(s[W_HI])
    if 0 <= j <= last:
        _judge(s, j, last)
    cleaning = int(s[CLEANING])
    if cleaning == 0:
        if 0 <= j <= last:
            s[RAW_COUNT] += s[record(s, j) + R_RAW]
        j -= int(s[C_HI])
        if 0 <= j <= last:
            first = j - int(s[C_LO])
            n = min(last, j + int(s[C_HI])) - max(0, first) + 1
            s[record(s, j) + R_STILL] = 1.0 if 2.0 * s[RAW_COUNT] > n else 0.0
            if first >= 0:
                s[RAW_COUNT] -= s[record(s, first) + R_RAW]
    elif cleaning == 1:
        j -= int(s[C_LEN]) - 1
        if 0 <= j <= last:
            _fill(s, j, last)
        j -= int(s[C_LEN]) - 1
        if 0 <= j <= last:
            _keep(s, j, last)
    elif 0 <= j <= last:
        r = record(s, j)
        s[r + R_STILL] = s[r + R_RAW]
