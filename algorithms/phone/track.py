"""The kernel behind ``phone.pdr``, ``phone.pdr-source`` and ``phone.fused``: from messages to a track.

Every accelerometer sample goes to the attitude, the ring and the step detector. A step that is found gets its
length and heading from its own samples and moves the track. A fix waits until the steps up to its time are
known and is then taken between them, a step that it falls into being divided.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ..numerics.compiled import compiled
from . import attitude, direction, geodesy, lengths, mixture, ring, steps

GYR, ACC, MAG, PRESSURE, GNSS, VELOCITY = range(6)
"""Roles of inputs."""
WAITING = 64
PACE_S = 1.5
"""Time over which the steps' velocity is averaged before a receiver's is laid beside it; it lags about so much."""
EVENTS = 16
"""Steps and fixes that one message is answered with at most; what is more follows with the next."""

FIELDS: list[tuple[Any, ...]] = [
    ("role", "i8", (6,)),  # first: numba warns where one record begins as another one does
    *steps.FIELDS,
    *attitude.FIELDS,
    *direction.FIELDS,
    *lengths.FIELDS,
    *geodesy.ORIGIN,
    *mixture.FIELDS,
    ("fused", "i8"),
    ("has_gyr", "i8"),
    ("mag_prior", "f8", (2,)),  # sigma and share of wrong of the first magnetic heading; 0 none
    ("turned", "f8"),  # heading of the first step, where north is unknown (subtracted)
    ("first_step", "i8"),
    ("heading", "f8"),
    ("distance", "f8"),
    ("waiting", "i8"),
    ("wait_ns", "i8", (WAITING,)),
    (
        "wait",
        "f8",
        (WAITING, 5),
    ),  # latitude, longitude (rad), height, deviation (m), declination (rad); velocity
    ("wait_role", "i8", (WAITING,)),
    ("sd_velocity", "f8"),
    (
        "pace",
        "f8",
        (3,),
    ),  # velocity by steps and headings, east and north (m/s), and its mean square, over PACE_S
    ("pace_ns", "i8"),
    ("part", "f8"),  # share of the first step in the queue that has been walked
    ("part_on", "i8"),
    ("part_length", "f8"),
    ("part_heading", "f8"),
    ("lost_fixes", "i8"),
    ("tilted", "i8"),  # steps at which the screen did not look up
    # Walking direction found from the motion
    ("offset_now", "f8"),  # the offset of the newest step, 0 where the device's heading is taken
    ("offset_var", "f8"),  # its variance that the track's covariance has in it (rad²)
    ("doubted", "i8"),  # steps whose direction is found, or may be the opposite one
    ("doubt", "f8"),  # sum of their probabilities of being the opposite one
    ("turned_about", "i8"),
    ("away", "f8", (2,)),  # way walked in such directions (m)
    ("far_fixes", "i8"),
    ("relocated", "i8"),
    ("sd_default", "f8"),
    ("sd_min", "f8"),
    # Height
    ("pressure_n", "i8"),
    ("pressure_ns", "i8"),
    ("pressure_zero", "f8"),
    ("pressure_begin_ns", "i8"),
    ("height", "f8"),
    ("height_step", "f8"),
    ("alt_n", "f8"),
    ("alt_zero", "f8"),
]

# Columns of the result vector: step, pose, sigma, heading, detector, state, and of fused the fix.
O_STEP, O_POSE, O_SIGMA, O_HEADING, O_DETECTOR = 0, 5, 12, 18, 25
O_STATE = O_DETECTOR + ring.N_FEATURES
O_FIX = O_STATE + 6


@compiled
def take(s: Any, role: int, t_ns: int, v: Any) -> None:
    """Take one message."""
    if role == GYR:
        attitude.take_gyr(s, t_ns, v[0], v[1], v[2])
        direction.take_gyr(s, t_ns, v[2])
    elif role == ACC:
        attitude.take_acc(s, v[0], v[1], v[2])
        i = steps.take(s, t_ns, v[0], v[1], v[2])
        direction.describe(s, i, t_ns, v[0], v[1], v[2])
    elif role == MAG:
        for j in range(3):
            s.raw_mag[j] = v[j]
        attitude.take_mag(s, t_ns, v[0], v[1], v[2])
    elif role == PRESSURE:
        _take_pressure(s, t_ns, v[0])
    elif math.isfinite(v[0]) and math.isfinite(v[1]):
        if s.waiting >= WAITING:
            s.lost_fixes += 1
            return
        s.wait_ns[s.waiting], s.wait_role[s.waiting] = t_ns, role
        for j in range(5 if role == GNSS else 2):
            s.wait[s.waiting, j] = v[j]
        s.waiting += 1


@compiled
def _take_pressure(s: Any, t_ns: int, pascal: float) -> None:
    """Height above the first seconds' (m) by the standard atmosphere, over 1 s."""
    if not pascal > 1000.0:
        return
    if s.pressure_n == 0:
        s.pressure_begin_ns = t_ns
    dt = (t_ns - s.pressure_ns) * 1e-9 if s.pressure_n > 0 else 0.0
    s.pressure_n += 1
    if t_ns - s.pressure_begin_ns < 2_000_000_000:
        s.pressure_zero += (pascal - s.pressure_zero) / s.pressure_n
    up = 44330.77 * (1.0 - (pascal / s.pressure_zero) ** 0.190263)
    if s.pressure_n > 1:
        s.height += (1.0 - math.exp(-dt)) * (up - s.height)
    s.pressure_ns = t_ns


@compiled
def _open_step(s: Any) -> None:
    """Give the first step of the queue its length and heading."""
    start, end = s.queue_start[0], s.queue_end[0]
    ring.features(s, start, end, s.gravity, s.features)
    length = lengths.length_of(s, s.features)
    if s.offset_n == 0:
        direction.look_ahead(s)
    heading = direction.heading_of(s, start, end)
    if not math.isfinite(length):
        length = 0.0
    if not math.isfinite(heading):
        heading = s.part_heading
    elif s.first_step == 0:
        s.first_step = 1
        if s.tau_mag > 1e4:  # an uncalibrated field says where north is once, and then bends nothing
            s.mag_gain = 0.0
        # Where north is unknown the first step's direction is x.
        s.turned = heading if s.has_mag == 0 and s.mode < direction.MAGNETOMETER else 0.0
        if s.mode == direction.GYROSCOPE:
            s.turned = heading
        heading = attitude.wrap(heading - s.turned)
    else:
        heading = attitude.wrap(heading - s.turned)
    _doubt(s)
    s.part_on, s.part = 1, 0.0
    s.part_length, s.part_heading = length, heading


@compiled
def _doubt(s: Any) -> None:
    """Take into the track how sure the walking direction is: its variance, and the opposite one."""
    change = s.offset_sd**2 - s.offset_var
    if change > 0.0:
        s.offset_var += change
        for h in range(s.hyp):
            s.hP[h, 2, 2] += change
    offset = s.offset if s.offset_used == 1 else 0.0
    jump = attitude.wrap(offset - s.offset_now)
    turned = s.steps > 0 and abs(jump) > 0.35 * math.pi
    s.offset_now = offset
    if turned:
        s.turned_about += 1
    if s.fused == 1 and turned:  # the new direction, the old one, the opposite one
        mixture.branch(s, -jump, 0.3)
    if s.fused == 1 and (turned or s.steps == 0) and s.opposite > 0.0:
        mixture.branch(s, math.pi, s.opposite)
    if s.opposite > 0.0:
        s.doubted += 1
        s.doubt += s.opposite


@compiled
def _covariance(s: Any) -> tuple[float, float, float, float]:
    """Return east, east-north, north and heading variance about the pose given.

    Dead reckoning gives the more probable of two opposite directions: the other track is where it would have
    gone from the same start, twice the way in doubt off.
    """
    p = s.doubt / s.doubted if s.doubted > 0 and s.fused == 0 else 0.0
    k = 4.0 * p
    x, y = s.away[0], s.away[1]
    return s.cov[0] + k * x * x, s.cov[1] + k * x * y, s.cov[2] + k * y * y, s.cov[3] + p * math.pi**2


@compiled
def _write_track(s: Any, t_ns: int, cause: int, out_message: Any, out_t_ns: Any, out: Any, k: int) -> None:
    for j in range(out.shape[1]):
        out[k, j] = np.nan
    out_message[k], out_t_ns[k] = cause, t_ns
    heading = attitude.wrap(s.part_heading + s.mean[2])
    s.heading = heading
    out[k, O_POSE], out[k, O_POSE + 1], out[k, O_POSE + 2] = s.mean[0], s.mean[1], s.height
    out[k, O_POSE + 3], out[k, O_POSE + 4] = math.cos(0.5 * heading), 0.0
    out[k, O_POSE + 5], out[k, O_POSE + 6] = 0.0, math.sin(0.5 * heading)
    xx, xy, yy, turn = _covariance(s)
    out[k, O_SIGMA], out[k, O_SIGMA + 1] = math.sqrt(xx), math.sqrt(yy)
    if s.pressure_n > 0:  # weather: about 0.03 m per root second
        out[k, O_SIGMA + 2] = math.sqrt(0.09 + 0.0009 * (t_ns - s.pressure_begin_ns) * 1e-9)
    out[k, O_SIGMA + 5] = min(math.sqrt(turn), math.pi)
    if s.fused == 1 and s.located == 1:
        lat, lon, _alt = geodesy.from_enu(s, s.mean[0], s.mean[1], 0.0)
        out[k, O_FIX], out[k, O_FIX + 1] = math.degrees(lat), math.degrees(lon)
        if s.alt_n > 0:
            out[k, O_FIX + 2] = s.alt_zero + s.height
            out[k, O_FIX + 5] = 10.0
        out[k, O_FIX + 3], out[k, O_FIX + 4] = out[k, O_SIGMA], out[k, O_SIGMA + 1]
    out[k, O_STATE], out[k, O_STATE + 1] = s.mean[2], math.exp(s.mean[3])
    out[k, O_STATE + 2] = s.hyp
    out[k, O_STATE + 3] = xy / math.sqrt(max(xx * yy, 1e-12))
    out[k, O_STATE + 4], out[k, O_STATE + 5] = s.fixes, s.outliers


@compiled
def _walk(s: Any, t_ns: int, share: float) -> None:
    """Go a share of the step that is open."""
    mixture.step(s, t_ns, s.part_length, s.part_heading, share)
    period = (s.queue_end[0] - s.queue_start[0]) * 1e-9
    rate = s.part_length / max(period, 0.1)
    keep = math.exp(-share * period / PACE_S)
    if (t_ns - s.pace_ns) * 1e-9 > 2.0 * period + PACE_S:  # after a stand
        keep = 0.0
    s.pace[0] = keep * s.pace[0] + (1.0 - keep) * rate * math.cos(s.part_heading)
    s.pace[1] = keep * s.pace[1] + (1.0 - keep) * rate * math.sin(s.part_heading)
    s.pace[2] = keep * s.pace[2] + (1.0 - keep) * rate * rate
    s.pace_ns = t_ns


@compiled
def _close_step(s: Any, cause: int, out_message: Any, out_t_ns: Any, out: Any, k: int) -> None:
    start, end = s.queue_start[0], s.queue_end[0]
    _walk(s, end, 1.0 - s.part)
    length = s.part_length * math.exp(s.mean[3])
    s.distance += length
    if s.opposite > 0.0:
        s.away[0] += s.part_length * math.cos(s.part_heading)
        s.away[1] += s.part_length * math.sin(s.part_heading)
    _write_track(s, end, cause, out_message, out_t_ns, out, k)
    out[k, O_STEP], out[k, O_STEP + 1], out[k, O_STEP + 2] = (end - start) * 1e-9, s.steps, length
    out[k, O_STEP + 3] = s.height - s.height_step if s.pressure_n > 0 else np.nan
    out[k, O_STEP + 4] = s.heading
    s.height_step = s.height
    last = (ring.first_after(s, end) - 1) % ring.RING
    out[k, O_HEADING] = s.ring[last, ring.YAW]
    out[k, O_HEADING + 1] = s.heading
    out[k, O_HEADING + 2] = s.ring[last, ring.MAG_YAW] if s.mag_n > 0 else np.nan
    out[k, O_HEADING + 3] = s.ring[last, ring.DISTURBED]
    out[k, O_HEADING + 4], out[k, O_HEADING + 5] = s.offset, s.offset_used
    out[k, O_HEADING + 6] = s.opposite
    for j in range(ring.N_FEATURES):
        out[k, O_DETECTOR + j] = s.features[j]
    s.steps += 1
    if s.level_up < direction.SCREEN_UP:
        s.tilted += 1
    s.part_on = 0
    steps.shift_queue(s, 1)


@compiled
def _drop_first(s: Any) -> None:
    """Take the first one out of what waits."""
    for k in range(1, s.waiting):
        s.wait_ns[k - 1], s.wait_role[k - 1] = s.wait_ns[k], s.wait_role[k]
        for j in range(5):
            s.wait[k - 1, j] = s.wait[k, j]
    s.waiting -= 1


@compiled
def _use_velocity(s: Any, t_ns: int) -> None:
    """Take the first waiting velocity into the mixture; while nobody walks it says nothing of headings."""
    east, north = s.wait[0, 0], s.wait[0, 1]
    _drop_first(s)
    if abs(t_ns - s.pace_ns) < 1_000_000_000 and s.pace[2] > 0.0 and s.first_step == 1:
        mixture.velocity(s, t_ns, s.pace, east, north, s.sd_velocity)


@compiled
def _use_fix(s: Any, t_ns: int) -> None:
    """Take the first waiting fix into the mixture."""
    lat, lon, alt, sd = s.wait[0, 0], s.wait[0, 1], s.wait[0, 2], s.wait[0, 3]
    turn = s.wait[0, 4]
    _drop_first(s)
    sd = max(sd, s.sd_min) if math.isfinite(sd) and sd > 0.0 else s.sd_default
    if s.origin_set == 0:
        geodesy.set_origin(s, lat, lon, alt if math.isfinite(alt) else 0.0)
        if s.has_mag == 1 and math.isfinite(turn):
            _decline(s, turn)
    e, n, _ = geodesy.to_enu(s, lat, lon, s.alt_zero if s.alt_n > 0 else (alt if math.isfinite(alt) else 0.0))
    if math.isfinite(alt):
        s.alt_n += 1.0
        s.alt_zero += (alt - s.height - s.alt_zero) / min(s.alt_n, 200.0)
    before = s.outliers
    mixture.fix(s, t_ns, e, n, sd)
    s.far_fixes = s.far_fixes + 1 if s.outliers - before > 0.9 else 0
    if s.far_fixes >= 10:  # ten in a row: it is the track that is wrong
        s.far_fixes, s.relocated = 0, s.relocated + 1
        s.hyp, s.ringed = mixture.HYPOTHESES, 1
        for h in range(s.hyp):
            for i in range(mixture.N):
                s.hx[h, i] = 0.0
                for j in range(mixture.N):
                    s.hP[h, i, j] = 0.0
            s.hx[h, 2] = attitude.wrap(2.0 * math.pi * h / s.hyp)
            s.hP[h, 2, 2], s.hP[h, 3, 3] = (math.pi / s.hyp) ** 2, 0.01
            s.hP[h, 6, 6] = 1e-5
            s.hw[h] = 1.0 / s.hyp
        s.located = 0
        mixture.fix(s, t_ns, e, n, sd)


@compiled
def _decline(s: Any, turn: float) -> None:
    """Turn everything so far from magnetic to true north, now that the place is known."""
    change = turn - s.declination
    s.declination = turn
    c, w = math.cos(-change), math.sin(-change)
    for h in range(s.hyp):
        x, y = s.hx[h, 0], s.hx[h, 1]
        s.hx[h, 0], s.hx[h, 1] = c * x - w * y, w * x + c * y
    s.part_heading -= change
    s.pace[0], s.pace[1] = c * s.pace[0] - w * s.pace[1], w * s.pace[0] + c * s.pace[1]
    for k in range(max(0, s.taken - ring.RING), s.taken):
        s.ring[k % ring.RING, ring.YAW] -= change


@compiled
def drain(
    s: Any,
    now_ns: int,
    all_of_it: bool,
    cause: int,
    out_message: Any,
    out_t_ns: Any,
    out: Any,
    count: int,
    capacity: int,
) -> int:
    """Process what is known by now, in the order of its times."""
    while capacity > 0:
        if s.queued > 0:
            if s.part_on == 0:
                _open_step(s)
            start, end = s.queue_start[0], s.queue_end[0]
            if s.waiting > 0 and s.wait_ns[0] <= end:
                t = s.wait_ns[0]
                share = min(max((t - start) / max(end - start, 1), s.part), 1.0)
                if share > s.part:
                    _walk(s, t, share - s.part)
                    s.part = share
            else:
                if s.part < 1.0:
                    _close_step(s, cause, out_message, out_t_ns, out, count)
                else:
                    s.part = 1.0 - 1e-9
                    continue
                count, capacity = count + 1, capacity - 1
                continue
        elif s.waiting > 0:
            # No step is known yet that could cover the fix.
            hold = 5.0 if s.run_n > 0 and s.walking == 0 and s.local == 0 else 2.4
            if not all_of_it and s.waiting < WAITING - 2 and (now_ns - s.wait_ns[0]) * 1e-9 < hold:
                break
        else:
            break
        t = s.wait_ns[0]
        if s.wait_role[0] == VELOCITY:
            _use_velocity(s, t)
            continue
        _use_fix(s, t)
        _write_track(s, t, cause, out_message, out_t_ns, out, count)
        count, capacity = count + 1, capacity - 1
    return count


@compiled
def run(
    state: Any, inputs: Any, channels: Any, t_ns: Any, values: Any, out_message: Any, out_t_ns: Any, out: Any
) -> int:
    """Take messages; see :class:`..contract.KernelEstimator`."""
    s, count = state[0], 0
    for i in range(t_ns.shape[0]):
        take(s, s.role[inputs[i]], t_ns[i], values[i])
        if s.queued > 0 or s.waiting > 0:
            count = drain(s, t_ns[i], False, i, out_message, out_t_ns, out, count, EVENTS)
    return count


@compiled
def run_end(state: Any, out_t_ns: Any, out: Any) -> int:
    """Give what is still held back."""
    s = state[0]
    if s.local == 0:
        steps.cells.settle(s)
    return drain(s, 0, True, 0, out_t_ns, out_t_ns, out, 0, ring.QUEUE + WAITING)
