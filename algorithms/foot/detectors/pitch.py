"""Pitch detector: distance from the pitch at rest, and variance of pitch in a window."""

from __future__ import annotations

import math
from typing import Annotated, Any, ClassVar

import msgspec

from ...numerics.compiled import compiled
from ...numerics.records import record_type
from ...parameters import meta
from .contract import Detector

DEGREES = 180.0 / math.pi
_SOURCE = "dissertation, section 4.4.1"


class Params(msgspec.Struct, frozen=True, kw_only=True):
    """Thresholds of the two conditions, and the tilt's time constant."""

    pitch_dev_max_deg: Annotated[
        float, meta("C1pitch: greatest distance from the pitch at rest", "deg", _SOURCE, gt=0.0)
    ] = 6.0
    pitch_var_max_deg2: Annotated[
        float, meta("C2pitch: greatest variance of pitch in the window", "deg²", _SOURCE, gt=0.0)
    ] = 6.0
    pitch_tau_s: Annotated[
        float,
        meta(
            "Time constant that pulls the pitch detector's own tilt to the accelerometer at rest",
            "s",
            "ours",
            gt=0.0,
        ),
    ] = 0.5


@compiled
def start_tilt(d: Any, acc: Any) -> None:
    """Take the gravity direction and the reference pitch from the mean force of the rest at the start."""
    x, y, z = acc[0], acc[1], acc[2]
    norm = math.sqrt(x * x + y * y + z * z)
    if norm > 0.0:
        d.down[0], d.down[1], d.down[2] = x / norm, y / norm, z / norm
        d.reference = _pitch(d)


@compiled
def _pitch(d: Any) -> float:
    return DEGREES * math.atan2(-d.down[0], math.sqrt(d.down[1] * d.down[1] + d.down[2] * d.down[2]))


@compiled
def track_tilt(d: Any, bias: Any, r: Any) -> None:
    """Carry the gravity direction on by the angular rate of the sample ``r``, and write its pitch (deg).

    The direction turns against the sensor (ġ = −ω × g, by Cayley's rotation) and is pulled towards the
    accelerometer with the time constant ``pitch_tau_s`` while C1 and C3 hold, so that the gyroscope's
    residual bias cannot pile up.
    """
    a = -0.5 * r.dt * (r.gyr[0] - bias[0])
    b = -0.5 * r.dt * (r.gyr[1] - bias[1])
    c = -0.5 * r.dt * (r.gyr[2] - bias[2])
    x, y, z = d.down[0], d.down[1], d.down[2]
    k = 2.0 / (1.0 + a * a + b * b + c * c)
    u, v, w = b * z - c * y, c * x - a * z, a * y - b * x
    x += k * (u + b * w - c * v)
    y += k * (v + c * u - a * w)
    z += k * (w + a * v - b * u)
    norm = r.acc_norm
    if 9.0 < norm < 11.0 and r.gyr_norm < 0.6:
        pull = r.dt / (d.tau + r.dt)
        x += pull * (r.acc[0] / norm - x)
        y += pull * (r.acc[1] / norm - y)
        z += pull * (r.acc[2] / norm - z)
    norm = math.sqrt(x * x + y * y + z * z)
    d.down[0], d.down[1], d.down[2] = x / norm, y / norm, z / norm
    r.pitch = _pitch(d)


@compiled
def judge(d: Any, ring: Any, j: int, lo: int, hi: int) -> bool:
    """Still where pitch is near that of the rest and steady."""
    mask = ring.shape[0] - 1
    n = hi - lo + 1
    total = 0.0
    for i in range(lo, hi + 1):
        total += ring[i & mask].pitch
    mean = total / n
    total = 0.0
    for i in range(lo, hi + 1):
        deviation = ring[i & mask].pitch - mean
        total += deviation * deviation
    r = ring[j & mask]
    r.statistic[0] = abs(r.pitch - d.reference)
    r.statistic[1] = total / n
    return r.statistic[0] < d.dev_max and r.statistic[1] < d.var_max


class Pitch(Detector):
    """Two conditions on the pitch of the shoe; it needs the rest at the start."""

    name: ClassVar[str] = "pitch"
    title: ClassVar[str] = "distance from the pitch at rest, variance of pitch"
    source: ClassVar[str] = _SOURCE
    Params = Params
    RECORD = record_type(
        ("down", "f8", (3,)),  # direction of the force at rest in b
        ("reference", "f8"),  # pitch at rest, deg
        ("dev_max", "f8"),
        ("var_max", "f8"),
        ("tau", "f8"),
    )
    statistics: ClassVar[tuple[str, ...]] = ("pitch_dev", "pitch_var")
    window_s: ClassVar[float] = 0.2

    @classmethod
    def configure(cls, record: Any, params: Any) -> None:
        """Write the thresholds."""
        record.dev_max, record.var_max = params.pitch_dev_max_deg, params.pitch_var_max_deg2
        record.tau = params.pitch_tau_s

    @classmethod
    def limits(cls, params: Any) -> dict[str, float]:
        """Return the thresholds by statistic."""
        return {"pitch_dev": params.pitch_dev_max_deg, "pitch_var": params.pitch_var_max_deg2}
