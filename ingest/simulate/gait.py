"""A foot that walks: an analytic trajectory whose ideal sensor readings are exact.

Every coordinate of the gait is a sum of smooth steps of time (degree 7, three continuous derivatives), so
position, velocity, acceleration, attitude, angular rate and angular acceleration all follow in closed form,
at any instant, without integration or differences.

Frames
    n: level, z up, x along the first stride, origin at the box at the start. f: the foot, x forward, y
    left, z up while the foot is flat. b: a sensor in the box, turned and shifted against f by a
    :class:`Mount`.
Phases of a stride
    heel-off (the foot rolls about the ball), swing (the ball leaves the ground, the heel arrives), slap
    (the foot rolls down about the heel), flat (the foot stands; velocity exactly zero unless
    ``stance_roll_deg`` or ``arch_mm`` is set).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
_Jet = FloatArray
"""A quantity with its first and second derivative by time: leading axis 3."""

BALL = np.array([0.12, 0.0, -0.08])
"""Ball of the foot against the box on the instep, in f (m): the foot rolls about it at heel-off."""
HEEL = np.array([-0.14, 0.0, -0.08])
"""Heel against the box, in f (m): the foot rolls about it after heel strike."""

DOORS_S = 1.0
"""s that the foot stands in the lift before and after it moves."""

STANCE_SHARE = 0.31
"""Share of a walking stride that the foot stands."""

_NonNegative = Annotated[float, msgspec.Meta(ge=0)]
_Positive = Annotated[float, msgspec.Meta(gt=0)]


class Style(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How the foot moves within a stride.

    Attributes
    ----------
    heel_toe_roll : bool
        Roll about the ball before, and about the heel after the swing. False: the box turns in the air only.
    toe_off_deg, heel_strike_deg : float
        Pitch (nose down) at toe-off and pitch (nose up) at heel strike (deg).
    roll_deg : float
        Greatest roll about the foot's long axis in mid-swing (deg).
    clearance_m : float
        Rise of the pivot in mid-swing (m).
    stance_roll_deg : float
        Slow forward roll about the ball while the foot stands (deg); real feet do about 5. The truth still
        calls these samples ``still``: it is what a zero-velocity filter takes them for. Default 0: velocity
        is exactly zero.
    stance_share : float
        Share of the stride that the foot stands.
    arch_mm : float
        The instep, and the box on it, sinks by so much from heel strike to the end of the stance, as the arch gives
        under the body's weight, and rises with the heel (mm). The navicular drop of a walking adult is 5.3 mm
        (median of 280 feet, 1.7 to 13.4; Nielsen et al. 2009). The truth calls these samples ``still``. Default 0.
    strike_mm, strike_hz, strike_s : float
        Heel-strike transient: a burst of vertical vibration of this amplitude, frequency and length.
        Default amplitude 0.
    """

    heel_toe_roll: bool = True
    toe_off_deg: _NonNegative = 45.0
    heel_strike_deg: _NonNegative = 20.0
    roll_deg: float = 8.0
    clearance_m: _NonNegative = 0.07
    stance_roll_deg: _NonNegative = 0.0
    stance_share: Annotated[float, msgspec.Meta(gt=0.02, lt=0.9)] = STANCE_SHARE
    arch_mm: _NonNegative = 0.0
    strike_mm: _NonNegative = 0.0
    strike_hz: _Positive = 40.0
    strike_s: _Positive = 0.04


class Mount(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Where a sensor sits in the box.

    Attributes
    ----------
    lever_m : tuple of float
        Position against the box's origin, in f (m).
    roll_deg, pitch_deg, yaw_deg : float
        Attitude of b against f: ``rot_fb = Rz(yaw) Ry(pitch) Rx(roll)`` (deg).
    """

    lever_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    roll_deg: float = 0.0
    pitch_deg: float = 0.0
    yaw_deg: float = 0.0


@dataclass(frozen=True)
class Motion:
    """What one sensor does and ideally feels.

    Attributes
    ----------
    t : ndarray
        Time since the start of the simulation (s), shape (n,).
    pos, vel : ndarray
        Position (m) and velocity (m/s) of the sensor in n, shape (n, 3).
    quat_wxyz : ndarray
        Attitude ``rot_nb``, shape (n, 4), continuous in sign.
    acc_b, gyr_b : ndarray
        Ideal specific force (m/s²) and angular rate (rad/s) in b, shape (n, 3).
    still : ndarray
        Whether the foot stands on ground that does not move, shape (n,), bool.
    """

    t: FloatArray
    pos: FloatArray
    vel: FloatArray
    quat_wxyz: FloatArray
    acc_b: FloatArray
    gyr_b: FloatArray
    still: NDArray[np.bool_]


class GaitModel:
    """Footfalls, their timing and the foot's motion between them.

    Parameters
    ----------
    footfalls : ndarray
        Where the box stands, one row a footfall: x, y, z (m) and heading (rad, unwrapped), shape (m + 1, 4).
    durations : ndarray
        Length of each of the m strides (s).
    rest_s : float
        Rest before the first and after the last stride (s).
    gravity : float
        Local gravity (m/s²).
    rides : ndarray, optional
        Climb of the lift in which the foot stands after each stride (m, 0: none), shape (m,).
    ride_s : float
        Time of a ride (s).
    """

    SHARES = (0.14, 0.46, 0.09)
    """Heel-off, swing and slap as shares of the stride; the rest of it the foot stands."""

    def __init__(
        self,
        footfalls: FloatArray,
        durations: FloatArray,
        rest_s: float,
        gravity: float,
        style: Style,
        rides: FloatArray | None = None,
        ride_s: float = 8.0,
    ) -> None:
        self.footfalls = footfalls
        self.durations = durations
        self.gravity = gravity
        self.style = style
        moving = sum(self.SHARES)
        stretch = 1.0 if style.stance_share == STANCE_SHARE else (1.0 - style.stance_share) / moving
        shares = tuple(stretch * share for share in self.SHARES)
        off, swing, slap = shares if style.heel_toe_roll else (0.0, sum(shares), 0.0)
        self._off, self._swing, self._moving = off, swing, off + swing + slap
        rides = np.zeros(len(durations)) if rides is None else rides
        waits = np.where(rides != 0.0, ride_s + 2 * DOORS_S, 0.0)
        self.lift_s = (
            rest_s + np.concatenate(([0.0], np.cumsum(durations + waits)[:-1]))
            if len(durations)
            else durations
        )
        self.land_s = self.lift_s + self._moving * durations
        self.end_s = float(self.land_s[-1] + waits[-1] + rest_s) if len(durations) else 2 * rest_s
        self._rides = [
            (float(start), float(climb))
            for start, climb in zip(self.land_s + DOORS_S, rides, strict=True)
            if climb
        ]
        self._ride_s = ride_s

    def motion(self, t: FloatArray, mount: Mount) -> Motion:
        """Return what a sensor at ``mount`` does at the times ``t`` (s, ascending).

        Shape of ``t``: (n,).
        """
        still, angles, pivot, arm = self._foot(t, np.asarray(mount.lever_m))
        rot, omega, alpha = _attitude(*angles)
        r, r1, r2 = arm
        turn = np.cross(omega, r)
        vel_f = turn + r1
        acc_f = np.cross(alpha, r) + np.cross(omega, turn) + 2 * np.cross(omega, r1) + r2
        up = pivot[2] + np.array([0.0, 0.0, self.gravity])
        force_f = np.einsum("nji,nj->ni", rot, up) + acc_f
        turned = np.radians([mount.roll_deg, mount.pitch_deg, mount.yaw_deg])
        mounting = _rotation(*(np.array([a]) for a in turned))[0]
        (psi, *_), (theta, *_), (phi, *_) = angles
        quat = _multiply(_quaternion(phi, theta, psi), _quaternion(*turned))
        return Motion(
            t=t,
            pos=pivot[0] + np.einsum("nij,nj->ni", rot, r),
            vel=pivot[1] + np.einsum("nij,nj->ni", rot, vel_f),
            quat_wxyz=quat,
            acc_b=force_f @ mounting,
            gyr_b=omega @ mounting,
            still=still,
        )

    def _foot(
        self, t: FloatArray, lever: FloatArray
    ) -> tuple[NDArray[np.bool_], tuple[_Jet, _Jet, _Jet], _Jet, _Jet]:
        """Return still, angles (yaw, pitch, roll), pivot in n, arm from pivot to sensor in f.

        Each but the first with two derivatives by time.
        """
        style, n = self.style, len(t)
        if not len(self.durations):
            yaw, zero = np.zeros((2, 3, n))
            pivot, arm = np.zeros((2, 3, n, 3))
            yaw[0], pivot[0], arm[0] = self.footfalls[0, 3], self.footfalls[0, :3], lever
            return np.ones(n, bool), (yaw, zero, zero), pivot, arm
        i = np.clip(np.searchsorted(self.lift_s, t, side="right") - 1, 0, len(self.durations) - 1)
        length = self.durations[i]
        u = np.maximum((t - self.lift_s[i]) / length, 0.0)
        off, swing, moving = self._off, self._swing, self._moving
        air, strike = off, off + swing
        here, there = self.footfalls[i], self.footfalls[i + 1]

        def step(start: float, end: float) -> _Jet:
            """Smooth step from 0 to 1 between two phases of the stride, with its time derivatives."""
            return _smooth_step((u - start) / (end - start), (end - start) * length)

        # Pitch: up to toe-off, through the swing to heel strike, down to the ground; yaw and roll in the air.
        top, low = np.radians(style.toe_off_deg), np.radians(style.heel_strike_deg)
        slow = np.radians(style.stance_roll_deg)
        before = np.where(i > 0, slow, 0.0)
        after = np.where(i < len(self.durations) - 1, slow, 0.0)
        down = (strike - 0.1 * swing, moving) if style.heel_toe_roll else (air + 0.75 * swing, moving)
        terms = [
            (top - before, step(0.0, air + 0.3 * swing)),
            (-(top + low), step(air + 0.15 * swing, air + 0.85 * swing)),
            (low, step(*down)),
        ]
        if style.stance_roll_deg:
            terms.append((after, step(moving, 1.0)))
        theta = _combine(before, terms)
        span = step(air, strike)
        psi = _combine(here[:, 3], [(there[:, 3] - here[:, 3], span)])
        rise = step(air, air + 0.5 * swing)
        fall = step(air + 0.5 * swing, strike)
        roll = np.radians(style.roll_deg)
        phi = _combine(np.zeros(n), [(roll, rise), (-roll, fall)])

        # The pivot goes from the ball of the old footfall to the heel of the new one, and wanders from ball
        # to heel in the foot. While the foot stands it may be either; the slow roll of stance is about the
        # ball.
        ball, heel = (BALL, HEEL) if style.heel_toe_roll else (np.zeros(3), np.zeros(3))
        standing = u >= moving
        wander = np.where(standing, 0.0, step(air, strike))
        begin = here[:, :3] + _turn(here[:, 3], ball)
        finish = there[:, :3] + _turn(there[:, 3], heel)
        travel = finish - begin
        climb = there[:, 2] - here[:, 2]
        early, late = step(air, air + 0.75 * swing), step(air + 0.25 * swing, strike)
        level = np.where(climb > 0, early, late)
        shake = self._strike(u, strike, length)
        pivot = span[:, :, None] * travel
        pivot[:, :, 2] = climb * level + style.clearance_m * (rise - fall) + shake
        pivot[0] += begin
        # Not by the sum above but to the bit: a standing foot stands on its footfall.
        pivot[0][standing] = (there[:, :3] + _turn(there[:, 3], ball))[standing]
        if style.arch_mm:
            give = 1e-3 * style.arch_mm
            sunk = np.where(i > 0, give, 0.0)
            sinks = np.where(i < len(self.durations) - 1, give, 0.0)
            pivot[:, :, 2] += _combine(
                -sunk, [(sunk, step(0.0, air + 0.3 * swing)), (-sinks, step(strike, 1.0))]
            )
        riding = np.zeros(n, bool)
        for start, climb in self._rides:
            part = (t - start) / self._ride_s
            pivot[:, :, 2] += climb * _smooth_step(part, np.full(n, self._ride_s))
            riding |= (part > 0.0) & (part < 1.0)
        arm = wander[:, :, None] * (ball - heel)
        arm[0] += lever - ball
        return ((u == 0) | standing) & ~riding, (psi, theta, phi), pivot, arm

    def _strike(self, u: FloatArray, strike: float, length: FloatArray) -> _Jet:
        """Return the heel-strike vibration (m) and its derivatives: a sine under a bump of degree 6."""
        style = self.style
        if not style.strike_mm:
            return np.zeros((3, len(u)))
        d, w = style.strike_s, 2 * np.pi * style.strike_hz
        start = np.minimum(strike * length, self._moving * length - d)  # it is over before the foot stands
        tau = u * length - start
        x = np.clip(tau / d, 0.0, 1.0)
        b = 64 * x**3 * (1 - x) ** 3
        b1 = 192 * x**2 * (1 - x) ** 2 * (1 - 2 * x) / d
        b2 = 384 * x * (1 - x) * (1 - 5 * x + 5 * x * x) / d**2
        s, c = np.sin(w * tau), np.cos(w * tau)
        size = style.strike_mm * 1e-3
        return size * np.stack((b * s, b1 * s + b * w * c, b2 * s + 2 * b1 * w * c - b * w * w * s))


def _smooth_step(x: FloatArray, scale: FloatArray) -> _Jet:
    """Return 35x⁴ − 84x⁵ + 70x⁶ − 20x⁷, held outside 0…1, and its first two derivatives by ``x * scale``."""
    x = np.clip(x, 0.0, 1.0)
    y = 1.0 - x
    x2, y2 = x * x, y * y
    value = x2 * x2 * (35.0 + x * (-84.0 + x * (70.0 - 20.0 * x)))
    return np.stack((value, 140.0 * x2 * x * y2 * y / scale, 420.0 * x2 * y2 * (y - x) / scale**2))


def _combine(start: FloatArray, terms: list[tuple[FloatArray | float, _Jet]]) -> _Jet:
    """Return start + Σ weight · step, with derivatives."""
    out = np.zeros((3, len(start)))
    out[0] = start
    for weight, step in terms:
        out += weight * step
    return out


def _turn(heading: FloatArray, v: FloatArray) -> FloatArray:
    """Turn the vector ``v`` about z by every heading."""
    c, s = np.cos(heading), np.sin(heading)
    return np.stack((c * v[0] - s * v[1], s * v[0] + c * v[1], np.full_like(c, v[2])), axis=1)


def _rotation(phi: FloatArray, theta: FloatArray, psi: FloatArray) -> FloatArray:
    """Return Rz(psi) Ry(theta) Rx(phi), shape (n, 3, 3)."""
    cf, sf, ct, st, cp, sp = np.cos(phi), np.sin(phi), np.cos(theta), np.sin(theta), np.cos(psi), np.sin(psi)
    rot = np.empty((len(phi), 3, 3))
    rot[:, 0, 0], rot[:, 0, 1], rot[:, 0, 2] = cp * ct, cp * st * sf - sp * cf, cp * st * cf + sp * sf
    rot[:, 1, 0], rot[:, 1, 1], rot[:, 1, 2] = sp * ct, sp * st * sf + cp * cf, sp * st * cf - cp * sf
    rot[:, 2, 0], rot[:, 2, 1], rot[:, 2, 2] = -st, ct * sf, ct * cf
    return rot


def _attitude(yaw: _Jet, pitch: _Jet, roll: _Jet) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return rot_nf, angular rate (rad/s) and angular acceleration (rad/s²) in f from z-y-x angles."""
    psi, psi1, psi2 = yaw
    theta, theta1, theta2 = pitch
    phi, phi1, phi2 = roll
    ct, st, cf, sf = np.cos(theta), np.sin(theta), np.cos(phi), np.sin(phi)
    omega = np.stack((phi1 - psi1 * st, theta1 * cf + psi1 * ct * sf, -theta1 * sf + psi1 * ct * cf), axis=1)
    alpha = np.stack(
        (
            phi2 - psi2 * st - psi1 * theta1 * ct,
            theta2 * cf
            - theta1 * phi1 * sf
            + psi2 * ct * sf
            - psi1 * theta1 * st * sf
            + psi1 * phi1 * ct * cf,
            -theta2 * sf
            - theta1 * phi1 * cf
            + psi2 * ct * cf
            - psi1 * theta1 * st * cf
            - psi1 * phi1 * ct * sf,
        ),
        axis=1,
    )
    return _rotation(phi, theta, psi), omega, alpha


def _quaternion(phi: FloatArray, theta: FloatArray, psi: FloatArray) -> FloatArray:
    """Return the unit quaternion (w, x, y, z) of Rz(psi) Ry(theta) Rx(phi), last axis 4."""
    (cf, ct, cp), (sf, st, sp) = ([f(a / 2) for a in (phi, theta, psi)] for f in (np.cos, np.sin))
    return np.stack(
        (
            cf * ct * cp + sf * st * sp,
            sf * ct * cp - cf * st * sp,
            cf * st * cp + sf * ct * sp,
            cf * ct * sp - sf * st * cp,
        ),
        axis=-1,
    )


def _multiply(q: FloatArray, p: FloatArray) -> FloatArray:
    """Return the quaternion products q ⊗ p, (n, 4) by (4,)."""
    w, x, y, z = q.T
    a, b, c, d = p
    return np.stack(
        (
            w * a - x * b - y * c - z * d,
            w * b + x * a + y * d - z * c,
            w * c - x * d + y * a + z * b,
            w * d + x * c - y * b + z * a,
        ),
        axis=1,
    )
