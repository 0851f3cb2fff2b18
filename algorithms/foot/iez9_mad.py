"""Nine-state zero-velocity filter whose orientation comes from a complementary filter: Madgwick's ("9IEZ+MAD") or
Mahony's.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, ClassVar, Literal

from ..contract import FloatArray
from ..numerics import strapdown
from ..numerics.compiled import compiled, inlined
from ..numerics.records import record_type
from ..numerics.rotations import quat_of, set_quat
from ..parameters import meta
from . import core, rest
from . import iez9 as base
from .estimator import FootEstimator
from .parameters import with_parts

RECORD = record_type(
    *base.FILTER,
    ("zupt_turns", "?"),
    ("beta", "f8"),
    ("is_mahony", "?"),
    ("gain_p", "f8"),
    ("gain_i", "f8"),
    ("correction", "f8", (3,)),  # Mahony's integral: minus the gyroscope bias as it sees it, rad/s
    ("quat", "f8", (4,)),  # wxyz, rot_nb
    *core.CORE,
)


class Foot9IezMadParams(base.Foot9IezParams, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Parameters of the nine-state filter with Madgwick's orientation."""

    beta: Annotated[
        float,
        meta(
            "Gain of the gradient step: trust in the accelerometer",
            "rad/s",
            "Madgwick 2010: 0.033 (IMU)",
            ge=0.0,
        ),
    ] = 0.033
    orientation: Annotated[
        Literal["madgwick", "mahony"],
        meta("Which filter gives the orientation", source="Madgwick 2010; Mahony et al. 2008"),
    ] = "madgwick"
    mahony_p: Annotated[
        float,
        meta(
            "Mahony: proportional gain, trust in the accelerometer",
            "rad/s",
            "ahrs: 1.0; ours: a walk's",
            ge=0.0,
        ),
    ] = 0.1
    mahony_i: Annotated[
        float,
        meta(
            "Mahony: integral gain, how fast the bias follows",
            "rad/s²",
            "ours: the rest has the bias",
            ge=0.0,
        ),
    ] = 0.0
    zupt_turns: Annotated[
        bool,
        meta(
            "Let the zero-velocity update correct this orientation too; the source leaves it to its own "
            "filter",
        ),
    ] = False


Foot9IezMadAllParams = with_parts(Foot9IezMadParams, "Foot9IezMadAllParams", __name__)


@inlined
def madgwick(
    q: FloatArray,
    ax: float,
    ay: float,
    az: float,
    wx: float,
    wy: float,
    wz: float,
    dt: float,
    beta: float,
) -> None:
    """Carry the quaternion (wxyz, rot_nb) ``q`` over ``dt``: Madgwick 2010, eqs 11–13, 20–21,
    25–34 (IMU).

    ``a`` is the specific force in any unit, ``w`` the angular rate in rad/s. A force of norm zero is left
    out.
    """
    a, b, c, d = q[0], q[1], q[2], q[3]
    da = 0.5 * (-b * wx - c * wy - d * wz)
    db = 0.5 * (a * wx + c * wz - d * wy)
    dc = 0.5 * (a * wy - b * wz + d * wx)
    dd = 0.5 * (a * wz + b * wy - c * wx)
    norm = math.sqrt(ax * ax + ay * ay + az * az)
    if norm > 0.0:
        # Objective: gravity as the quaternion predicts it minus as measured; its gradient is Jᵀf.
        f0 = 2.0 * (b * d - a * c) - ax / norm
        f1 = 2.0 * (a * b + c * d) - ay / norm
        f2 = 2.0 * (0.5 - b * b - c * c) - az / norm
        ga = -2.0 * c * f0 + 2.0 * b * f1
        gb = 2.0 * d * f0 + 2.0 * a * f1 - 4.0 * b * f2
        gc = -2.0 * a * f0 + 2.0 * d * f1 - 4.0 * c * f2
        gd = 2.0 * b * f0 + 2.0 * c * f1
        norm = math.sqrt(ga * ga + gb * gb + gc * gc + gd * gd)
        if norm > 0.0:
            da -= beta * (ga / norm)
            db -= beta * (gb / norm)
            dc -= beta * (gc / norm)
            dd -= beta * (gd / norm)
    a += da * dt
    b += db * dt
    c += dc * dt
    d += dd * dt
    norm = math.sqrt(a * a + b * b + c * c + d * d)
    q[0], q[1], q[2], q[3] = a / norm, b / norm, c / norm, d / norm


@inlined
def mahony(
    q: FloatArray,
    correction: FloatArray,
    ax: float,
    ay: float,
    az: float,
    wx: float,
    wy: float,
    wz: float,
    dt: float,
    gain_p: float,
    gain_i: float,
) -> None:
    """Carry the quaternion (wxyz, rot_nb) ``q`` over ``dt``: Mahony, Hamel, Pflimlin 2008, eqs 32 and 48.

    ``a`` is the specific force in any unit, ``w`` the angular rate in rad/s; ``correction`` collects the integral
    term. A force of norm zero is left out.
    """
    a, b, c, d = q[0], q[1], q[2], q[3]
    norm = math.sqrt(ax * ax + ay * ay + az * az)
    if norm > 0.0:
        # Upwards as the quaternion has it, in b; the cross product turns it towards the measured one.
        ux, uy, uz = 2.0 * (b * d - a * c), 2.0 * (a * b + c * d), a * a - b * b - c * c + d * d
        ex, ey, ez = (ay * uz - az * uy) / norm, (az * ux - ax * uz) / norm, (ax * uy - ay * ux) / norm
        correction[0] += gain_i * ex * dt
        correction[1] += gain_i * ey * dt
        correction[2] += gain_i * ez * dt
        wx += correction[0] + gain_p * ex
        wy += correction[1] + gain_p * ey
        wz += correction[2] + gain_p * ez
    q[0] = a + 0.5 * dt * (-b * wx - c * wy - d * wz)
    q[1] = b + 0.5 * dt * (a * wx + c * wz - d * wy)
    q[2] = c + 0.5 * dt * (a * wy - b * wz + d * wx)
    q[3] = d + 0.5 * dt * (a * wz + b * wy - c * wx)
    norm = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    for i in range(4):
        q[i] /= norm


@inlined
def _advance(s: Any, r: Any) -> None:
    strapdown.resolve(s, r)
    x, y, z = s.force[0], s.force[1], s.force[2]
    wx, wy, wz = r.gyr[0] - s.bias_gyr[0], r.gyr[1] - s.bias_gyr[1], r.gyr[2] - s.bias_gyr[2]
    if s.is_mahony:
        mahony(s.quat, s.correction, r.acc[0], r.acc[1], r.acc[2], wx, wy, wz, r.dt, s.gain_p, s.gain_i)
    else:
        madgwick(s.quat, r.acc[0], r.acc[1], r.acc[2], wx, wy, wz, r.dt, s.beta)
    set_quat(s.rot, s.quat[0], s.quat[1], s.quat[2], s.quat[3])
    strapdown.resolve(s, r)
    strapdown.average_force(s, x, y, z)
    strapdown.move(s, r.dt)


@inlined
def _take_over(s: Any) -> None:
    """Set the quaternion to the rotation."""
    s.quat[0], s.quat[1], s.quat[2], s.quat[3] = quat_of(s.rot)


@compiled
def _navigate(s: Any, ring: Any, out: FloatArray) -> None:
    r = core.release(s, ring)
    if core.starts(s, r):
        _take_over(s)
        base.believe_rest(s, base.ATT, base.VEL)
        s.unknown_bias = s.rest.bias_variance
    elif s.started:
        if s.rest.heard_out:
            rest.hear_out(s)
        _advance(s, r)
        base.predict(s, r)
        if r.still:
            base.zero_velocity(s, r, 0 if s.zupt_turns else base.POS)
            if s.zupt_turns:
                _take_over(s)
    core.emit(s, r, out)
    core.emit_sigma(s, base.POS, base.VEL, base.ATT, out)
    core.emit_detector(r, core.AFTER_SIGMA, out)


@compiled
def kernel(state: Any, ring: Any, row: FloatArray, out: FloatArray) -> bool:
    """Take one row; fill ``out`` and return True where a result is due."""
    s = state[0]
    if not core.take(s, ring, row):
        return False
    _navigate(s, ring, out)
    return True


@compiled
def run(state: Any, ring: Any, rows: FloatArray, out: FloatArray) -> int:
    """Take all rows; a row without a result is NaN. Return the number of results."""
    results = 0
    for i in range(rows.shape[0]):
        if kernel(state, ring, rows[i], out[i]):
            results += 1
        else:
            out[i, :] = math.nan
    return results


@compiled
def flush(state: Any, ring: Any, out: FloatArray) -> int:
    """Fill ``out`` with the results still held back, return their number."""
    s = state[0]
    results = 0
    while results < out.shape[0] and core.take_end(s, ring):
        _navigate(s, ring, out[results])
        results += 1
    return results


class Foot9IezMad(FootEstimator):
    """Position and velocity of the nine-state filter, orientation of Madgwick's gradient filter for IMU, or of
    Mahony's complementary filter beside it (``orientation``).

    Source: foot-navigation dissertation, eq 3.18 and section 3.6; Madgwick (2010), "An efficient orientation
    filter for inertial and inertial/magnetic sensor arrays". The initial orientation and the gyroscope bias
    come from the rest.

    Departure: the zero-velocity update never touches the orientation, so its error is "considered"
    (Schmidt): it counts in P but gets no gain; dropping the attitude part of an ordinary update, as a
    cascade does, would make P too small.
    """

    name: ClassVar[str] = "foot.9iez-mad"
    title: ClassVar[str] = "9 states, zero-velocity updates, orientation by Madgwick"
    source: ClassVar[str] = "foot-navigation dissertation, eq 3.18; Madgwick 2010"
    Params = Foot9IezMadAllParams
    presets: ClassVar[dict[str, dict[str, Any]]] = base.PRESETS
    RECORD = RECORD
    kernel = staticmethod(kernel)
    run = staticmethod(run)
    flush_kernel = staticmethod(flush)

    def configure(self, record: Any, params: Any) -> None:
        """Write the noise variances and the gain into the state."""
        base.configure(record, params)
        record.zupt_turns, record.beta = params.zupt_turns, params.beta
        record.is_mahony = params.orientation == "mahony"
        record.gain_p, record.gain_i = params.mahony_p, params.mahony_i
