"""Which way a person walks: the phone's own heading, or the axis in which it is shaken where it is not aligned.

The heading of the device is that of its y axis, or of the back of its screen where it stands upright. In a
hand, screen up, that is the walking direction. Elsewhere it is found (Kourogi and Kurata 2014; Steinhoff and
Schiele 2010): the horizontal force has most of its power along the walking direction, and is positive while the
vertical force rises (the trunk is pushed forward before a contact and braked after it), which tells fore from aft.
"""

from __future__ import annotations

import math
from typing import Any

from ..numerics.compiled import compiled, inlined
from . import attitude, ring
from .ring import DISTURBED, EAST, MAG_YAW, NORTH, RING, UP, YAW

MODES = ("auto", "device", "walking", "magnetometer", "tilt-compensated", "gyroscope")
AUTO, DEVICE, WALKING, MAGNETOMETER, TILT, GYROSCOPE = range(len(MODES))

FIELDS: list[tuple[Any, ...]] = [
    ("mode", "i8"),
    ("declination", "f8"),
    ("has_mag", "i8"),
    ("upright", "i8"),  # whether the heading is that of −z
    ("level_up", "f8"),  # smoothed up component of the phone's z axis
    ("level_y", "f8"),
    ("smooth_f", "f8", (3,)),
    ("smooth_ns", "i8"),
    ("power", "f8", (3,)),  # xx, xy, yy of the horizontal force in the device's heading frame
    ("fore", "f8", (2,)),  # correlation with the rise of the vertical force
    ("offset", "f8"),
    ("offset_n", "i8"),
    ("gyro_yaw", "f8"),
    ("gyro_ns", "i8"),
    ("raw_mag", "f8", (3,)),
    ("median", "f8", (64,)),
    ("median_n", "i8"),
    ("median_w", "i8"),
]
SMOOTH_S = 0.06
FADE = 0.15
"""Weight of a step in the running power: a memory of six to seven steps."""
SETTLED = 12
"""Steps after which fore and aft change places only on clear evidence: people do not often walk backwards."""
ABOUT_FACE = 0.8
"""Least cosine between the evidence of fore and the axis that is clear."""
SCREEN_UP = 0.5
"""Least up component of the z axis of a phone that is held before the body (tilt up to 60°)."""


@inlined
def take_gyr(s: Any, t_ns: int, z: float) -> None:
    """Integrate the rate about the phone's own z axis (the source's gyroscope heading)."""
    if s.gyro_ns != 0 and t_ns - s.gyro_ns < 1_000_000_000:
        s.gyro_yaw += z * (t_ns - s.gyro_ns) * 1e-9
    s.gyro_ns = t_ns


@compiled
def describe(s: Any, i: int, t_ns: int, x: float, y: float, z: float) -> None:
    """Fill place ``i`` of the ring: force in the heading frame of the device, its heading."""
    e, n, u = attitude.level(s, x, y, z)
    ye, yn, yu = attitude.level(s, 0.0, 1.0, 0.0)
    ze, zn, zu = attitude.level(s, 0.0, 0.0, 1.0)
    dt = (t_ns - s.smooth_ns) * 1e-9 if s.smooth_ns != 0 else 10.0
    k = 1.0 - math.exp(-dt / 2.0)
    s.level_up += k * (zu - s.level_up)
    s.level_y += k * (yu - s.level_y)
    if s.upright == 0 and abs(s.level_y) > 0.85:
        s.upright, s.offset_n = 1, 0
    elif s.upright == 1 and abs(s.level_y) < 0.7:
        s.upright, s.offset_n = 0, 0
    yaw = math.atan2(-zn, -ze) if s.upright == 1 else math.atan2(yn, ye)
    k = 1.0 - math.exp(-dt / SMOOTH_S)
    c, w = math.cos(yaw), math.sin(yaw)
    s.smooth_f[0] += k * (c * e + w * n - s.smooth_f[0])
    s.smooth_f[1] += k * (c * n - w * e - s.smooth_f[1])
    s.smooth_f[2] += k * (u - s.smooth_f[2])
    s.smooth_ns = t_ns
    s.ring[i, EAST], s.ring[i, NORTH], s.ring[i, UP] = s.smooth_f[0], s.smooth_f[1], s.smooth_f[2]
    s.ring[i, DISTURBED] = s.disturbed
    if s.mode == MAGNETOMETER:
        s.ring[i, MAG_YAW] = 0.5 * math.pi - _median_heading(s)
    else:
        s.ring[i, MAG_YAW] = yaw + s.mag_yaw
    if s.mode == GYROSCOPE:
        s.ring[i, YAW] = s.gyro_yaw
    elif s.mode == TILT or s.mode == MAGNETOMETER:
        s.ring[i, YAW] = s.ring[i, MAG_YAW] - s.declination
    else:
        s.ring[i, YAW] = yaw + (s.delta - s.declination if s.has_mag == 1 else 0.0)


@inlined
def source_heading(mag_x: float, mag_y: float) -> float:
    """Return H = atan2(−m_x, m_y) in Android's axes, clockwise from magnetic north (eq 3.17)."""
    return math.atan2(-mag_x, mag_y)


@compiled
def _median_heading(s: Any) -> float:
    """Take the newest field; return the median of the unwrapped headings of the last second (eq 3.18)."""
    h = source_heading(s.raw_mag[0], s.raw_mag[1])
    n, w = s.median_n, s.median_w
    if n > 0:
        last = s.median[(n - 1) % 64]
        h = last + attitude.wrap(h - last)
    s.median[n % 64] = h
    s.median_n = n + 1
    count = min(n + 1, w)
    # The middle one is that with as many below as above; windows are short.
    low, high = 0.0, 0.0
    for a in range(count):
        x = s.median[(n - a) % 64]
        below = 0
        for b in range(count):
            y = s.median[(n - b) % 64]
            if y < x or (y == x and b < a):
                below += 1
        if below == (count - 1) // 2:
            low = x
        if below == count // 2:
            high = x
    return 0.5 * (low + high)


@compiled
def heading_of(s: Any, start_ns: int, end_ns: int) -> float:
    """Return the walking direction of a step (rad, from x to y), unwrapped within it; NaN without samples.

    The mean over the step and the one before, so that the sway from side to side leaves it.
    """
    first, last = ring.first_after(s, start_ns), ring.first_after(s, end_ns)
    if last <= first:
        return math.nan
    _shaken(s, first, last)
    start = first
    if s.mode == AUTO or s.mode == WALKING or s.mode == DEVICE:
        start = max(ring.first_after(s, start_ns - (end_ns - start_ns)), s.taken - RING, 0)
    c, w = 0.0, 0.0
    for k in range(start, last):
        yaw = s.ring[k % RING, YAW]
        c += math.cos(yaw)
        w += math.sin(yaw)
    heading = math.atan2(w, c)
    if s.mode == WALKING or (s.mode == AUTO and s.level_up < SCREEN_UP):
        heading += s.offset
    return attitude.wrap(heading)


@compiled
def look_ahead(s: Any) -> None:
    """At the begin of a walk: take all steps that are known already into the running power."""
    for k in range(s.queued):
        first, last = ring.first_after(s, s.queue_start[k]), ring.first_after(s, s.queue_end[k])
        if last > first:
            _shaken(s, first, last)


@compiled
def _shaken(s: Any, first: int, last: int) -> None:
    """Take a step's samples into the running power and find the offset of the walking direction."""
    n, mx, my = last - first, 0.0, 0.0
    for k in range(first, last):
        mx += s.ring[k % RING, EAST]
        my += s.ring[k % RING, NORTH]
    mx, my = mx / n, my / n
    xx, xy, yy, fx, fy = 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(first, last):
        x, y = s.ring[k % RING, EAST] - mx, s.ring[k % RING, NORTH] - my
        rise = s.ring[k % RING, UP] - s.ring[(k - 1) % RING, UP] if k > 0 else 0.0
        xx, xy, yy = xx + x * x, xy + x * y, yy + y * y
        fx, fy = fx + x * rise, fy + y * rise
    s.offset_n += 1
    k = max(FADE, 1.0 / s.offset_n)
    s.power[0] += k * (xx / n - s.power[0])
    s.power[1] += k * (xy / n - s.power[1])
    s.power[2] += k * (yy / n - s.power[2])
    k = max(0.3 * FADE, 1.0 / s.offset_n)
    s.fore[0] += k * (fx / n - s.fore[0])
    s.fore[1] += k * (fy / n - s.fore[1])
    axis = 0.5 * math.atan2(2.0 * s.power[1], s.power[0] - s.power[2])
    if s.offset_n > SETTLED and math.cos(axis - s.offset) < 0.0:  # the end of the axis that was fore before
        axis += math.pi
    fore = (math.cos(axis) * s.fore[0] + math.sin(axis) * s.fore[1]) / max(
        math.hypot(s.fore[0], s.fore[1]), 1e-300
    )
    if fore < (-ABOUT_FACE if s.offset_n > SETTLED else 0.0):
        axis += math.pi
    s.offset = attitude.wrap(axis)
