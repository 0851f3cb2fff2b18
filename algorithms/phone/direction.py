"""Which way a person walks: the phone's own heading, or the axis in which it is shaken where it is not aligned.

The heading of the device is that of its y axis, or of the back of its screen where it stands upright. In a
hand, screen up, that is the walking direction. Elsewhere it is found (Kourogi and Kurata 2014; Steinhoff and
Schiele 2010): the horizontal force has most of its power along the walking direction, and is positive while the
vertical force rises (the trunk is pushed forward before a contact and braked after it), which tells fore from aft.
Only what two steps in a row have in common is looked at: the body sways sideways once in two steps, and is pushed
forward once a step. The elongation of the power says how sure the axis is, the correlation with the push how sure
its sign is.
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
    ("fore", "f8", (2,)),  # its covariance with the push that the vertical force tells of
    ("pushed", "f8"),  # variance of that push
    ("fore_r", "f8"),  # correlation of the force along the offset with the push
    ("offset", "f8"),
    ("offset_used", "i8"),  # whether the offset is added to the device's heading
    ("opposite", "f8"),  # probability that fore is taken for aft
    ("offset_sd", "f8"),  # standard deviation of the offset otherwise (rad)
    ("elongation", "f8"),
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
ABOUT_FACE = 0.3
"""Least correlation with a push to the other side that is clear."""
LEAD = math.radians(75.0)
"""Phase by which the push forward leads the vertical force: 90° by the rule, 15 to 160° on five real walks."""
CLEAR, ASIDE, ALIGNED, ENOUGH = 0.75, math.radians(40.0), math.radians(25.0), 8
"""A phone with its screen up is not held ahead when the axis of the shaking is so elongated and so far aside, over
so many steps; it is again when the axis is as near as ``ALIGNED``."""
REVERSED_R = 0.55
"""Correlation with the push from which on a phone with its screen up is believed to point backwards."""
SIGN_KAPPA = 1.6
"""Concentration (von Mises) of the push's lead over people and placements: standard deviation about 50°."""
NOT_HELD = 0.1
"""Share of phones with their screen up that are not held ahead."""
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
    upright = 1 if abs(s.level_y) > (0.7 if s.upright == 1 else 0.85) else 0
    by_y, by_z = math.atan2(yn, ye), math.atan2(-zn, -ze)
    if upright != s.upright and s.mode <= WALKING:
        _change_axis(s, by_z - by_y if upright == 1 else by_y - by_z)
    s.upright = upright
    yaw = by_z if upright == 1 else by_y
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


@compiled
def _change_axis(s: Any, turn: float) -> None:
    """Turn what is kept in the frame of the device's heading: that heading is now that of another axis."""
    c, w = math.cos(turn), math.sin(turn)
    for k in range(max(0, s.taken - RING), s.taken):
        i = k % RING
        x, y = s.ring[i, EAST], s.ring[i, NORTH]
        s.ring[i, EAST], s.ring[i, NORTH] = c * x + w * y, c * y - w * x
        if s.mode != DEVICE:
            s.ring[i, YAW] += turn
            s.ring[i, MAG_YAW] += turn
    x, y = s.smooth_f[0], s.smooth_f[1]
    s.smooth_f[0], s.smooth_f[1] = c * x + w * y, c * y - w * x
    x, y = s.fore[0], s.fore[1]
    s.fore[0], s.fore[1] = c * x + w * y, c * y - w * x
    xx, xy, yy = s.power[0], s.power[1], s.power[2]
    s.power[0] = c * c * xx + 2.0 * c * w * xy + w * w * yy
    s.power[1] = (c * c - w * w) * xy + c * w * (yy - xx)
    s.power[2] = w * w * xx - 2.0 * c * w * xy + c * c * yy
    s.offset = attitude.wrap(s.offset - turn)


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
    _choose(s)
    return attitude.wrap(heading + s.offset if s.offset_used == 1 else heading)


@compiled
def _choose(s: Any) -> None:
    """Decide whether the device points where the person walks, and how doubtful the direction is."""
    aside = 0.5 * abs(attitude.wrap(2.0 * s.offset))  # of the axis, whichever end is fore
    backwards = abs(s.offset) > 0.5 * math.pi
    if s.mode == WALKING:
        s.offset_used = 1
    elif s.mode != AUTO:
        s.offset_used = 0
    elif s.level_up < SCREEN_UP:
        s.offset_used = 1
    elif s.offset_n >= ENOUGH and s.elongation > CLEAR:
        if aside > ASIDE or (backwards and s.fore_r > REVERSED_R):
            s.offset_used = 1
        elif aside < ALIGNED:
            s.offset_used = 0
    s.opposite, s.offset_sd = 0.0, 0.0
    other = math.exp(-2.0 * SIGN_KAPPA * s.fore_r)  # odds that the end taken for fore is aft
    if s.offset_used == 0 and backwards and s.mode == AUTO:
        s.opposite = NOT_HELD / (NOT_HELD + other)
    if s.offset_used == 1:
        s.opposite = other / (1.0 + other)
        s.offset_sd = 0.5 * math.sqrt(-2.0 * math.log(min(max(s.elongation, 0.02), 1.0)))


@compiled
def look_ahead(s: Any) -> None:
    """At the begin of a walk: take all steps that are known already into the running power."""
    for k in range(s.queued):
        first, last = ring.first_after(s, s.queue_start[k]), ring.first_after(s, s.queue_end[k])
        if last > first:
            _shaken(s, first, last)


@inlined
def _even(s: Any, k: int, lag: int, column: int) -> float:
    """Return what sample ``k`` and the one a step before have in common."""
    return 0.5 * (s.ring[k % RING, column] + s.ring[(k - lag) % RING, column])


@compiled
def _shaken(s: Any, first: int, last: int) -> None:
    """Take a step's samples into the running power; find the walking direction and how doubtful it is."""
    n, oldest = last - first, max(s.taken - RING, 0) + 2
    lag = n if first - n >= oldest else 0
    if first < oldest or n < 3:
        return
    mx, my, mu = 0.0, 0.0, 0.0
    for k in range(first - 1, last - 1):
        mx += _even(s, k, lag, EAST)
        my += _even(s, k, lag, NORTH)
        mu += _even(s, k, lag, UP)
    mx, my, mu = mx / n, my / n, mu / n
    c, w = math.cos(LEAD), math.sin(LEAD) * n / (4.0 * math.pi)  # rise over the step's angular frequency
    xx, xy, yy, fx, fy, rr = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(first - 1, last - 1):
        x, y = _even(s, k, lag, EAST) - mx, _even(s, k, lag, NORTH) - my
        r = c * (_even(s, k, lag, UP) - mu)
        r += w * (_even(s, k + 1, lag, UP) - _even(s, k - 1, lag, UP))
        xx, xy, yy = xx + x * x, xy + x * y, yy + y * y
        fx, fy, rr = fx + x * r, fy + y * r, rr + r * r
    s.offset_n += 1
    k = max(FADE, 1.0 / s.offset_n)
    s.power[0] += k * (xx / n - s.power[0])
    s.power[1] += k * (xy / n - s.power[1])
    s.power[2] += k * (yy / n - s.power[2])
    k = max(0.3 * FADE, 1.0 / s.offset_n)
    s.fore[0] += k * (fx / n - s.fore[0])
    s.fore[1] += k * (fy / n - s.fore[1])
    s.pushed += k * (rr / n - s.pushed)
    axis = 0.5 * math.atan2(2.0 * s.power[1], s.power[0] - s.power[2])
    total = max(s.power[0] + s.power[2], 1e-12)
    spread = math.sqrt((s.power[0] - s.power[2]) ** 2 + 4.0 * s.power[1] ** 2)
    s.elongation = spread / total
    if s.offset_n > SETTLED and math.cos(axis - s.offset) < 0.0:  # the end of the axis that was fore before
        axis += math.pi
    fore = (math.cos(axis) * s.fore[0] + math.sin(axis) * s.fore[1]) / math.sqrt(
        max(0.5 * (total + spread) * s.pushed, 1e-300)
    )
    if fore < (-ABOUT_FACE if s.offset_n > SETTLED else 0.0):
        axis, fore = axis + math.pi, -fore
    s.offset = attitude.wrap(axis)
    s.fore_r = min(max(fore, -1.0), 1.0)
