"""Attitude of a phone from gyroscope, accelerometer and magnetometer, each when it arrives.

VQF (Laidig and Seel 2023, "VQF: Highly accurate IMU orientation estimation with bias estimation and magnetic
disturbance rejection") as a kernel over a state record: strapdown integration, inclination from the specific
force low-passed in an almost inertial frame, heading from the magnetic field in the level frame, gyroscope bias
at rest and in motion by a Kalman filter. Frames: ``rot_nb``, x east, y (magnetic) north, z up.

Departures: sensors have times of their own (the interval of a gyroscope sample is measured, not nominal);
the field's disturbance is judged against a reference norm and dip that are learned slowly, or given. Without a
gyroscope the low-passed force and the field are the attitude (:func:`without_gyroscope`). Rest is
judged four times as strictly, because somebody who stands and holds a phone is not at rest.
"""

from __future__ import annotations

import math
from typing import Any

from ..numerics.compiled import compiled, inlined

FIELDS: list[tuple[Any, ...]] = [
    ("gyr_quat", "f8", (4,)),
    ("acc_quat", "f8", (4,)),
    ("delta", "f8"),  # heading of the almost level frame's y axis, by the magnetometer (rad)
    ("att_ready", "i8"),
    ("gyr_ns", "i8"),
    ("gyr_last", "f8", (3,)),
    ("acc_dt", "f8"),  # nominal interval of the accelerometer (s)
    ("acc_b", "f8", (3,)),  # b, a of the low-pass
    ("acc_a", "f8", (2,)),
    ("tau_acc", "f8"),
    ("lp_n", "i8", (3,)),
    ("lp_sum", "f8", (14,)),
    ("lp_state", "f8", (14, 2)),
    ("lp_out", "f8", (14,)),
    # Bias of the gyroscope
    ("bias", "f8", (3,)),
    ("bias_P", "f8", (3, 3)),
    ("bias_P0", "f8"),
    ("bias_V", "f8"),
    ("motion_W", "f8"),
    ("vertical_W", "f8"),
    ("rest_W", "f8"),
    ("bias_clip", "f8"),
    ("rest_s", "f8"),
    ("rest_gyr", "f8", (3,)),
    ("rest_acc", "f8", (3,)),
    ("rest_gyr_max", "f8"),
    ("rest_acc_max", "f8"),
    # Magnetic field
    ("mag_ns", "i8"),
    ("mag_n", "i8"),
    ("tau_mag", "f8"),
    ("mag_gain", "f8"),
    ("mag_alone", "i8"),  # without a gyroscope the field is the heading, disturbed or not
    ("ref_norm", "f8"),
    ("ref_dip", "f8"),
    ("ref_fixed", "i8"),
    ("mag_norm", "f8"),
    ("mag_dip", "f8"),
    ("mag_yaw", "f8"),
    ("disturbed", "i8"),
    ("disturbed_s", "f8"),
    ("undisturbed_s", "f8"),
    ("dis_norm", "f8"),
    ("dis_dip", "f8"),
]
ALONE_ACC_S, ALONE_MAG_S = 1.5, 0.5
"""Time constants without a gyroscope (s): above a step's time for the force, below a turn's for the field."""
REST_MIN_S = 1.5
REST_TAU_S = 0.5


def configure(
    s: Any, acc_hz: float, *, tau_acc: float = 3.0, tau_mag: float = 9.0, rest_deg_s: float = 0.5
) -> None:
    """Set the filter's constants in record ``s`` for an accelerometer of ``acc_hz``."""
    dt = 1.0 / acc_hz
    s["acc_dt"], s["tau_acc"], s["tau_mag"] = dt, tau_acc, tau_mag
    # Second-order Butterworth low-pass, 1/e of its step response after tau (VQF, appendix).
    fc = math.sqrt(2) / (2 * math.pi * tau_acc)
    c = math.tan(math.pi * min(fc * dt, 0.49))
    d = c * c + math.sqrt(2) * c + 1
    b0 = c * c / d
    s["acc_b"][:] = b0, 2 * b0, b0
    s["acc_a"][:] = 2 * (c * c - 1) / d, (1 - math.sqrt(2) * c + c * c) / d
    s["gyr_quat"][:] = s["acc_quat"][:] = (1.0, 0.0, 0.0, 0.0)
    s["bias_P0"] = (0.5 * 100) ** 2  # standard deviations in 0.01 deg/s, as VQF's own
    for i in range(3):
        s["bias_P"][i, i] = s["bias_P0"]
    s["bias_V"] = (0.1 * 100) ** 2 * dt / 100.0
    p_motion, p_rest = (0.1 * 100) ** 2, (0.03 * 100) ** 2
    s["motion_W"] = p_motion**2 / s["bias_V"] + p_motion
    s["vertical_W"] = s["motion_W"] / 1e-4
    s["rest_W"] = p_rest**2 / s["bias_V"] + p_rest
    s["bias_clip"] = math.radians(2.0)
    s["rest_gyr_max"], s["rest_acc_max"] = math.radians(rest_deg_s), 0.5 * rest_deg_s / 2.0
    s["mag_gain"] = 1.0
    s["mag_alone"] = 0
    s["dis_norm"], s["dis_dip"] = 0.15, math.radians(12.0)


def without_gyroscope(s: Any, acc_hz: float) -> None:
    """Configure record ``s`` so that inclination and heading follow force and field alone."""
    configure(s, acc_hz, tau_acc=ALONE_ACC_S, tau_mag=ALONE_MAG_S)
    s["mag_alone"] = 1


@compiled
def _turn(q: Any, x: float, y: float, z: float) -> None:
    """Multiply the quaternion ``q`` from the right by the rotation vector (x, y, z)."""
    angle = math.sqrt(x * x + y * y + z * z)
    c = math.cos(0.5 * angle)
    k = math.sin(0.5 * angle) / angle if angle > 1e-12 else 0.5
    x, y, z = k * x, k * y, k * z
    a, b, d, e = q[0], q[1], q[2], q[3]
    q[0] = a * c - b * x - d * y - e * z
    q[1] = a * x + b * c + d * z - e * y
    q[2] = a * y - b * z + d * c + e * x
    q[3] = a * z + b * y - d * x + e * c
    _unit(q)


@inlined
def _unit(q: Any) -> None:
    k = 1.0 / math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    for i in range(4):
        q[i] *= k


@inlined
def _rotate(q: Any, x: float, y: float, z: float) -> tuple[float, float, float]:
    a, b, c, d = q[0], q[1], q[2], q[3]
    u = 2.0 * (c * z - d * y)
    v = 2.0 * (d * x - b * z)
    w = 2.0 * (b * y - c * x)
    return x + a * u + c * w - d * v, y + a * v + d * u - b * w, z + a * w + b * v - c * u


@compiled
def level(s: Any, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Take a vector from the phone to the level frame whose heading the gyroscope alone carries."""
    u, v, w = _rotate(s.gyr_quat, x, y, z)
    return _rotate(s.acc_quat, u, v, w)


@compiled
def quat6(s: Any) -> tuple[float, float, float, float]:
    """Return ``rot_nb`` of that level frame as a quaternion."""
    a, b, c, d = s.acc_quat[0], s.acc_quat[1], s.acc_quat[2], s.acc_quat[3]
    e, f, g, h = s.gyr_quat[0], s.gyr_quat[1], s.gyr_quat[2], s.gyr_quat[3]
    return (
        a * e - b * f - c * g - d * h,
        a * f + b * e + c * h - d * g,
        a * g - b * h + c * e + d * f,
        a * h + b * g - c * f + d * e,
    )


@inlined
def _low_pass(s: Any, i: int, group: int, value: float) -> float:
    """Filter channel ``i``; the mean over the first ``tau_acc`` starts it (VQF's ``filterVec``)."""
    n = s.lp_n[group]
    if n * s.acc_dt < s.tau_acc:
        s.lp_sum[i] += value
        mean = s.lp_sum[i] / (n + 1)
        s.lp_state[i, 0] = mean * (1.0 - s.acc_b[0])
        s.lp_state[i, 1] = mean * (s.acc_b[2] - s.acc_a[1])
        s.lp_out[i] = mean
        return mean
    y = s.acc_b[0] * value + s.lp_state[i, 0]
    s.lp_state[i, 0] = s.acc_b[1] * value - s.acc_a[0] * y + s.lp_state[i, 1]
    s.lp_state[i, 1] = s.acc_b[2] * value - s.acc_a[1] * y
    s.lp_out[i] = y
    return y


@compiled
def take_gyr(s: Any, t_ns: int, x: float, y: float, z: float) -> None:
    """Take an angular rate (rad/s). A gap above 1 s is not integrated."""
    dt = (t_ns - s.gyr_ns) * 1e-9 if s.gyr_ns != 0 else s.acc_dt
    s.gyr_ns = t_ns
    s.gyr_last[0], s.gyr_last[1], s.gyr_last[2] = x, y, z
    if dt > 1.0:
        return
    k = 1.0 - math.exp(-dt / REST_TAU_S)
    away = 0.0
    for i in range(3):
        d = s.gyr_last[i] - s.rest_gyr[i]
        s.rest_gyr[i] += k * d
        away = max(away, abs(d))
        away = max(away, abs(s.rest_gyr[i]) - s.bias_clip + s.rest_gyr_max)
    s.rest_s = 0.0 if away >= s.rest_gyr_max else s.rest_s + dt
    _turn(s.gyr_quat, (x - s.bias[0]) * dt, (y - s.bias[1]) * dt, (z - s.bias[2]) * dt)


@compiled
def take_acc(s: Any, x: float, y: float, z: float) -> None:
    """Take a specific force (m/s²): inclination and bias."""
    if x == 0.0 and y == 0.0 and z == 0.0:
        return
    away, k = 0.0, 1.0 - math.exp(-s.acc_dt / REST_TAU_S)
    for i in range(3):
        d = (x if i == 0 else y if i == 1 else z) - s.rest_acc[i]
        s.rest_acc[i] += k * d
        away = max(away, abs(d))
    if away >= s.rest_acc_max:
        s.rest_s = 0.0
    u, v, w = _rotate(s.gyr_quat, x, y, z)
    u, v, w = _low_pass(s, 0, 0, u), _low_pass(s, 1, 0, v), _low_pass(s, 2, 0, w)
    s.lp_n[0] += 1
    u, v, w = _rotate(s.acc_quat, u, v, w)
    k = 1.0 / math.sqrt(u * u + v * v + w * w)
    u, v, w = k * u, k * v, k * w
    c = math.sqrt(max(0.0, 0.5 * (w + 1.0)))
    if c > 1e-6:
        p, q = 0.5 * v / c, -0.5 * u / c
    else:
        c, p, q = 0.0, 1.0, 0.0
    a, b, d, e = s.acc_quat[0], s.acc_quat[1], s.acc_quat[2], s.acc_quat[3]
    s.acc_quat[0] = c * a - p * b - q * d
    s.acc_quat[1] = c * b + p * a + q * e
    s.acc_quat[2] = c * d - p * e + q * a
    s.acc_quat[3] = c * e + p * d - q * b
    _unit(s.acc_quat)
    s.att_ready = 1
    if s.gyr_ns != 0:
        _bias(s, u, v)


@compiled
def _bias(s: Any, force_x: float, force_y: float) -> None:
    """Kalman filter of the bias: at rest by the rate itself, in motion by the inclination's correction.

    ``force_x``, ``force_y``: the level components of the low-passed force before the correction.
    """
    a, b, c, d = quat6(s)
    rot = (
        (1 - 2 * c * c - 2 * d * d, 2 * (b * c - a * d), 2 * (b * d + a * c)),
        (2 * (b * c + a * d), 1 - 2 * b * b - 2 * d * d, 2 * (c * d - a * b)),
        (2 * (b * d - a * c), 2 * (c * d + a * b), 1 - 2 * b * b - 2 * c * c),
    )
    bias = (s.bias[0], s.bias[1], s.bias[2])
    for i in range(3):
        for j in range(3):
            _low_pass(s, 3 + 3 * i + j, 1, rot[i][j])
    for i in range(2):
        _low_pass(s, 12 + i, 1, rot[i][0] * bias[0] + rot[i][1] * bias[1] + rot[i][2] * bias[2])
    s.lp_n[1] += 1
    for i in range(3):
        if s.bias_P[i, i] < s.bias_P0:
            s.bias_P[i, i] += s.bias_V
    rest = s.rest_s >= REST_MIN_S
    # The three measurements are independent: one after another equals all at once.
    dx, dy, dz = 0.0, 0.0, 0.0
    for i in range(3):
        if rest:
            hx, hy, hz = 1.0 if i == 0 else 0.0, 1.0 if i == 1 else 0.0, 1.0 if i == 2 else 0.0
            e = s.rest_gyr[i] - bias[i]
            variance = s.rest_W
        else:
            hx, hy, hz = s.lp_out[3 + 3 * i], s.lp_out[4 + 3 * i], s.lp_out[5 + 3 * i]
            e = -(hx * bias[0] + hy * bias[1] + hz * bias[2])
            if i == 0:
                e += -force_y / s.acc_dt + s.lp_out[12]
            elif i == 1:
                e += force_x / s.acc_dt + s.lp_out[13]
            variance = s.vertical_W if i == 2 else s.motion_W
        e = min(max(e, -s.bias_clip), s.bias_clip)
        px = s.bias_P[0, 0] * hx + s.bias_P[0, 1] * hy + s.bias_P[0, 2] * hz
        py = s.bias_P[1, 0] * hx + s.bias_P[1, 1] * hy + s.bias_P[1, 2] * hz
        pz = s.bias_P[2, 0] * hx + s.bias_P[2, 1] * hy + s.bias_P[2, 2] * hz
        total = hx * px + hy * py + hz * pz + variance
        residual = (e - hx * dx - hy * dy - hz * dz) / total
        dx, dy, dz = dx + px * residual, dy + py * residual, dz + pz * residual
        p = (px, py, pz)
        for m in range(3):
            for n in range(3):
                s.bias_P[m, n] -= p[m] * p[n] / total
    s.bias[0] = min(max(bias[0] + dx, -s.bias_clip), s.bias_clip)
    s.bias[1] = min(max(bias[1] + dy, -s.bias_clip), s.bias_clip)
    s.bias[2] = min(max(bias[2] + dz, -s.bias_clip), s.bias_clip)


@inlined
def wrap(angle: float) -> float:
    """Return the angle in (−π, π]."""
    return angle - 2.0 * math.pi * math.ceil((angle - math.pi) / (2.0 * math.pi))


@compiled
def take_mag(s: Any, t_ns: int, x: float, y: float, z: float) -> None:
    """Take a magnetic field (T) after hard and soft iron: heading, norm, dip, disturbance."""
    dt = (t_ns - s.mag_ns) * 1e-9 if s.mag_ns != 0 else s.acc_dt
    s.mag_ns = t_ns
    if s.att_ready == 0:
        return
    e, n, up = level(s, x, y, z)
    across = math.sqrt(e * e + n * n)
    norm = math.sqrt(across * across + up * up)
    if across < 1e-9:
        return
    s.mag_yaw = math.atan2(e, n)  # angle of the level frame's y axis from magnetic north, to the left
    k = 1.0 - math.exp(-dt / 0.5)  # norm and dip over half a second
    dip = math.atan2(-up, across)
    s.mag_norm = norm if s.mag_n == 0 else s.mag_norm + k * (norm - s.mag_norm)
    s.mag_dip = dip if s.mag_n == 0 else s.mag_dip + k * (dip - s.mag_dip)
    s.mag_n += 1
    if s.mag_n == 1:
        s.ref_dip = dip
        if s.ref_norm == 0.0:  # a calibration knows the norm beforehand, never the dip
            s.ref_norm = norm
    odd = abs(s.mag_norm / s.ref_norm - 1.0) > s.dis_norm or abs(s.mag_dip - s.ref_dip) > s.dis_dip
    s.undisturbed_s = 0.0 if odd else s.undisturbed_s + dt
    s.disturbed_s = s.disturbed_s + dt if odd else 0.0
    s.disturbed = 1 if odd or (s.undisturbed_s < 0.5 and s.mag_n * dt > 2.0) else 0
    if s.ref_fixed == 0:  # a field that is another one for long is the new reference
        slow = 1.0 - math.exp(-dt / (20.0 if s.disturbed == 0 or s.disturbed_s > 20.0 else 1e9))
        s.ref_norm += slow * (s.mag_norm - s.ref_norm)
        s.ref_dip += slow * (s.mag_dip - s.ref_dip)
    gain = 1.0 - math.exp(-dt / s.tau_mag)
    if s.mag_gain > gain:
        gain = s.mag_gain
        s.mag_gain = s.mag_gain / (s.mag_gain + 1.0)
    elif s.disturbed == 1 and s.mag_alone == 0:
        gain = 0.0
    s.delta = wrap(s.delta + gain * wrap(s.mag_yaw - s.delta))
