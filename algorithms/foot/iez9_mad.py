"""Nine-state zero-velocity filter whose orientation comes from Madgwick's gradient filter ("9IEZ+MAD")."""

from __future__ import annotations

import math
from typing import Annotated, Any, ClassVar

from ..contract import FloatArray
from ..numerics.compiled import compiled, inlined
from ..numerics.rotations import quat_from_rot, rot_from_quat
from ..parameters import meta
from . import common as foot
from . import iez9 as base
from . import layout as la
from . import strapdown
from .layout import (
    ACC_N,
    BIAS_GYR,
    R_ACC,
    R_DT,
    R_GYR,
    R_STILL,
    ROT,
    STARTED,
)

_take = la.Allocator(base.SIZE)
FEEDBACK = _take()
BETA = _take()
QUAT = _take(4)
SIZE = _take.size


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
    zupt_turns: Annotated[
        bool,
        meta(
            "Let the zero-velocity update correct this orientation too; the source leaves it to its own "
            "filter",
        ),
    ] = False


@inlined
def madgwick(
    s: FloatArray,
    q: int,
    ax: float,
    ay: float,
    az: float,
    wx: float,
    wy: float,
    wz: float,
    dt: float,
    beta: float,
) -> None:
    """Carry the quaternion (wxyz, rot_nb) at ``s[q:q+4]`` over ``dt``: Madgwick 2010, eqs 11–13, 20–21,
    25–34 (IMU).

    ``a`` is the specific force in any unit, ``w`` the angular rate in rad/s. A force of norm zero is left
    out.
    """
    a, b, c, d = s[q], s[q + 1], s[q + 2], s[q + 3]
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
    s[q], s[q + 1], s[q + 2], s[q + 3] = a / norm, b / norm, c / norm, d / norm


@inlined
def _advance(s: FloatArray, r: int) -> None:
    strapdown.resolve(s, r)
    x, y, z = s[ACC_N], s[ACC_N + 1], s[ACC_N + 2]
    madgwick(
        s,
        QUAT,
        s[r + R_ACC],
        s[r + R_ACC + 1],
        s[r + R_ACC + 2],
        s[r + R_GYR] - s[BIAS_GYR],
        s[r + R_GYR + 1] - s[BIAS_GYR + 1],
        s[r + R_GYR + 2] - s[BIAS_GYR + 2],
        s[r + R_DT],
        s[BETA],
    )
    rot_from_quat(s, QUAT, s, ROT)
    strapdown.resolve(s, r)
    strapdown.average_force(s, x, y, z)
    strapdown.move(s, s[r + R_DT])


@compiled
def _navigate(s: FloatArray, out: FloatArray) -> None:
    r = foot.release(s)
    if foot.starts(s):
        quat_from_rot(s, ROT, s, QUAT)
    elif s[STARTED] > 0.5:
        _advance(s, r)
        base.predict(s, s[r + R_DT])
        if s[r + R_STILL] > 0.5:
            base.zero_velocity(s, 0 if s[FEEDBACK] > 0.5 else 3)
            if s[FEEDBACK] > 0.5:
                quat_from_rot(s, ROT, s, QUAT)
    foot.emit(s, r, out)
    foot.emit_sigma(s, base.P, base.N, base.XPOS, base.XVEL, base.ATT, out)
    foot.emit_detector(s, r, base.FIRST_DETECTOR, out)


@compiled
def kernel(state: FloatArray, row: FloatArray, out: FloatArray) -> bool:
    """Take one row; fill ``out`` and return True where a result is due."""
    if not foot.take(state, row):
        return False
    _navigate(state, out)
    return True


@compiled
def run(state: FloatArray, rows: FloatArray, out: FloatArray) -> int:
    """Take all rows; see :class:`..contract.RowKernel`."""
    results = 0
    for i in range(rows.shape[0]):
        if kernel(state, rows[i], out[i]):
            results += 1
        else:
            out[i, :] = float("nan")
    return results


@compiled
def flush(state: FloatArray, out: FloatArray) -> int:
    """Fill ``out`` with the results still held back, return their number."""
    results = 0
    while results < out.shape[0] and foot.take_end(state):
        _navigate(state, out[results])
        results += 1
    return results


class Foot9IezMad(foot.FootEstimator):
    """Position and velocity of the nine-state filter, orientation of Madgwick's gradient filter for IMU.

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
    Params = Foot9IezMadParams
    presets: ClassVar[dict[str, dict[str, Any]]] = base.PRESETS
    state_size: ClassVar[int] = SIZE
    kernel = staticmethod(kernel)
    run = staticmethod(run)
    flush_kernel = staticmethod(flush)

    def configure(self, params: Any) -> None:
        """Write the noise variances and the gain into the state."""
        base.configure(self.state, params)
        self.state[FEEDBACK] = params.zupt_turns
        self.state[BETA] = params.beta
