"""The angle of a hinge from two sensors alone: axes and position found on the way, angle by eqs 72–77.

Of samples with both sensors valid, in motion, every ``stride``-th is kept; when the store is full, every second is
thrown away and the stride doubles, so that it always covers the whole run. The axes are identified anew
(:mod:`.axisfit`) after 2 s of motion and then each time the motion is a quarter longer.
"""

from __future__ import annotations

import math
from typing import Any

from ..numerics.compiled import compiled, inlined
from ..numerics.rotations import near
from . import axisfit, hingefit, mounting, turnfit

STORE = 1024
SETTLED_S = 8.0
"""Motion (s), some strides, from which on the zero that it shows is kept."""

FIELDS: list[Any] = [
    *axisfit.WORK,
    *turnfit.WORK,
    *mounting.FIELDS,
    ("base", "f8", (2, 2, 3)),  # x_i, y_i of eq 74 in each sensor's frame
    ("rows", "f8", (STORE, axisfit.COLUMNS)),
    ("whole", "f8", (2, 3)),  # integral of each rate
    ("kept", "i8"),
    ("stride", "i8"),
    ("skip", "i8"),
    ("learn", "i8"),  # 0: axes are given; 1: axes; 2: axes and position
    ("elapsed", "f8"),  # in motion
    ("fit_at", "f8"),
    ("fits", "i8"),
    ("held", "i8"),  # whether sign and zero were shown by a body's motion; then how, long axes, the last axes
    ("held_by", "i8"),
    ("held_up", "f8", (2, 3)),
    ("held_axis", "f8", (2, 3)),
    ("known", "i8"),  # whether the axes are usable: given, or identified with a good verdict
    ("sd_gyr", "f8"),
    ("sd_acc", "f8"),
    ("gravity", "f8"),
    # The angle.
    ("alpha_acc", "f8"),
    ("alpha_gyr", "f8"),
    ("alpha_spread", "f8"),  # factor of the variance of alpha_acc, 1 where gravity lies across the axis
    ("alpha", "f8"),
    ("alpha_var", "f8"),
    ("alpha_on", "i8"),
    ("alpha_seel", "i8"),
    ("alpha_lambda", "f8"),
    ("alpha_r", "f8"),
    ("alpha_q", "f8", (2,)),
    ("alpha_decay", "f8"),
    ("ax", "f8", (2,)),
    ("aP", "f8", (2, 2)),
]


@compiled
def set_base(s: Any) -> None:
    """Write the bases across the axes: x_i = j_i × c_i normalized, y_i = j_i × x_i."""
    for i in range(2):
        jx, jy, jz = s.axis[i, 0], s.axis[i, 1], s.axis[i, 2]
        x = jy * s.up[i, 2] - jz * s.up[i, 1]
        y = jz * s.up[i, 0] - jx * s.up[i, 2]
        z = jx * s.up[i, 1] - jy * s.up[i, 0]
        size = math.sqrt(x * x + y * y + z * z)
        if size < 0.1:  # c along the axis: any other direction, the same for both sensors
            u0, u1, u2 = 0.0, 0.0, 1.0
            if abs(jz) > 0.8:
                u1, u2 = 1.0, 0.0
            x, y, z = jy * u2 - jz * u1, jz * u0 - jx * u2, jx * u1 - jy * u0
            size = math.sqrt(x * x + y * y + z * z)
        x, y, z = x / size, y / size, z / size
        s.base[i, 0, 0], s.base[i, 0, 1], s.base[i, 0, 2] = x, y, z
        s.base[i, 1, 0] = jy * z - jz * y
        s.base[i, 1, 1] = jz * x - jx * z
        s.base[i, 1, 2] = jx * y - jy * x


@compiled
def reset_axes(s: Any) -> None:
    """Begin with the axes of the parameters."""
    for i in range(2):
        for m in range(3):
            s.axis[i, m] = s.given_axis[i, m]


@compiled
def identify(s: Any, lag: int) -> None:
    """Find the axes, and the position, from the store; judge them (see :func:`observable`)."""
    n = s.kept
    reset_axes(s)
    paired = hingefit.fit(s, s.rows, n, lag, s.sd_gyr, s.sd_acc, s.gravity, s.learn == 2)
    s.hand = 0
    if s.pairing < hingefit.DOUBTFUL:
        reset_axes(s)
        hingefit.find_hand(s, s.rows, n, lag, s.sd_gyr, s.sd_acc, s.gravity)
        reset_axes(s)
        paired = hingefit.fit(s, s.rows, n, lag, s.sd_gyr, s.sd_acc, s.gravity, s.learn == 2)
    s.fits += 1
    s.block_cost = 0.0
    if s.hand == 0 and moves(s) and not (paired and observable(s)):
        turnfit.fit(s, s.rows, n, lag, s.sd_gyr, s.sd_acc)
        paired = s.block_cost < turnfit.FITS
    s.known = 1 if paired and s.hand == 0 and observable(s) else 0
    if s.known == 1:
        mounting.orient(s, s.rows, n, lag)
        hold_mounting(s)
        # Not asked for, or not observable: no lever rather than a wrong one.
        if s.learn != 2 or s.pos_sd > 0.05:
            drop_positions(s)
        return
    drop_positions(s)
    s.pos_sd = 1.0
    if s.held == 1 and s.hand == 0:  # what was found stays; the remark says that it does not hold any more
        for i in range(2):
            for m in range(3):
                s.axis[i, m] = s.held_axis[i, m]
    else:
        reset_axes(s)
        mounting.suppose(s, s.rows, n, lag)


@compiled
def drop_positions(s: Any) -> None:
    """Set the vectors from the joint's centre to zero."""
    for i in range(2):
        for m in range(3):
            s.pos[i, m] = 0.0


@compiled
def hold_mounting(s: Any) -> None:
    """Keep the sign and the zero that a body's motion has shown, so that neither jumps as the data grow.

    Later data may show the sign no longer; the zero is kept from :data:`SETTLED_S` of motion on.
    """
    shown = s.sign_by == mounting.SWINGS or s.sign_by == mounting.POSE
    dot = 0.0
    for m in range(3):
        dot += s.axis[0, m] * s.held_axis[0, m]
    if shown and (s.held == 0 or dot < 0.0 or s.elapsed < SETTLED_S):
        s.held, s.held_by = 1, s.sign_by
        for i in range(2):
            for m in range(3):
                s.held_up[i, m] = s.up[i, m]
    elif s.held == 1 and (shown or s.sign_by == mounting.NOTHING):
        s.sign_by = s.held_by
        s.skew = -s.skew if dot < 0.0 else s.skew
        for i in range(2):
            for m in range(3):
                s.up[i, m] = s.held_up[i, m]
                s.axis[i, m] = -s.axis[i, m] if dot < 0.0 else s.axis[i, m]
    for i in range(2):
        for m in range(3):
            s.held_axis[i, m] = s.axis[i, m]


@compiled
def moves(s: Any) -> bool:
    """Return whether both sensors turn, and against each other."""
    return s.turn_rms > 0.1 and min(s.rate_rms[0], s.rate_rms[1]) > hingefit.STILL_RATE


@compiled
def observable(s: Any) -> bool:
    """Return whether the identified axes may be used."""
    return moves(s) and s.axis_sd[0] < 0.05 and s.axis_sd[1] < 0.05 and s.pairing > hingefit.PAIRED


@inlined
def at_rest(s: Any) -> bool:
    """Return whether neither sensor turns."""
    size = 0.0
    for i in range(2):
        size = max(size, s.gyr[i, 0] ** 2 + s.gyr[i, 1] ** 2 + s.gyr[i, 2] ** 2)
    return size < hingefit.STILL_RATE**2


@compiled
def watch(s: Any) -> bool:
    """Keep the sample given out; return True where the axes were identified anew with it."""
    if s.valid[0] == 0 or s.valid[1] == 0:
        return False
    for i in range(2):
        for m in range(3):
            s.whole[i, m] += s.turn[i, m]
    if at_rest(s):
        return False
    s.elapsed += s.dt
    s.skip += 1
    if s.slope[0] == 0 or s.slope[1] == 0 or s.skip < s.stride:
        return False
    s.skip = 0
    k = s.kept
    for i in range(2):
        axisfit.write_sample(s, s.rows[k], i, s.whole[i])
    s.kept = k + 1
    if s.kept == STORE:
        for k in range(STORE // 2):
            for m in range(axisfit.COLUMNS):
                s.rows[k, m] = s.rows[2 * k, m]
        s.kept = STORE // 2
        s.stride *= 2
    if s.elapsed < s.fit_at or s.kept < 60:
        return False
    if s.known == 1 and s.block_cost > 0.0 and s.stride * s.dt > turnfit.DENSE_S:
        return False  # what was found with denser samples stays
    s.fit_at = max(1.25 * s.elapsed, s.elapsed + 1.0)
    lag = max(1, int(0.3 / (s.stride * max(1e-4, s.dt)) + 0.5))
    identify(s, lag)
    set_base(s)
    return True


@compiled
def joint_angle(s: Any) -> None:
    """Carry ``s.alpha`` over one sample (eqs 73, 74, 77, or Seel's form) with its variance."""
    turn = 0.0
    for m in range(3):
        turn += s.turn[0, m] * s.axis[0, m] - s.turn[1, m] * s.axis[1, m]
    s.alpha_gyr += turn
    ux, uy, vx, vy = 0.0, 0.0, 0.0, 0.0
    for i in range(2):
        gx, gy, gz = s.gyr[i, 0], s.gyr[i, 1], s.gyr[i, 2]
        ox, oy, oz = s.pos[i, 0], s.pos[i, 1], s.pos[i, 2]
        along = gx * ox + gy * oy + gz * oz
        size = gx * gx + gy * gy + gz * gz
        fx = s.acc[i, 0] - (gx * along - ox * size) - (s.dgyr[i, 1] * oz - s.dgyr[i, 2] * oy)
        fy = s.acc[i, 1] - (gy * along - oy * size) - (s.dgyr[i, 2] * ox - s.dgyr[i, 0] * oz)
        fz = s.acc[i, 2] - (gz * along - oz * size) - (s.dgyr[i, 0] * oy - s.dgyr[i, 1] * ox)
        a = fx * s.base[i, 0, 0] + fy * s.base[i, 0, 1] + fz * s.base[i, 0, 2]
        b = fx * s.base[i, 1, 0] + fy * s.base[i, 1, 1] + fz * s.base[i, 1, 2]
        if i == 0:
            ux, uy = a, b
        else:
            vx, vy = a, b
    uu, vv = ux * ux + uy * uy, vx * vx + vy * vy
    g2 = s.gravity * s.gravity
    s.alpha_spread = 0.5 * (g2 / max(uu, 1e-6 * g2) + g2 / max(vv, 1e-6 * g2))
    s.alpha_acc = near(math.atan2(ux * vy - uy * vx, ux * vx + uy * vy), s.alpha)
    if s.alpha_on == 0:
        s.alpha_gyr = s.alpha_acc
        s.alpha = s.alpha_acc
        s.alpha_on = 1
        s.ax[0], s.ax[1] = 0.0, 0.0
        s.aP[0, 0], s.aP[0, 1], s.aP[1, 0], s.aP[1, 1] = 1.0, 0.0, 0.0, 1.0
        s.alpha_var = s.alpha_r
        return
    r = s.alpha_r * max(1.0, s.alpha_spread)
    if s.alpha_seel == 1:
        weight = s.alpha_lambda / max(1.0, s.alpha_spread)
        s.alpha = weight * near(s.alpha_acc, s.alpha) + (1.0 - weight) * (s.alpha + turn)
        s.alpha_var = weight * weight * r + (1.0 - weight) ** 2 * s.alpha_var
        return
    # FKC, eqs 9–24, with z = α_acc − α_gyr.
    t, d = s.dt, 1.0 - s.dt * s.alpha_decay
    s.ax[0] += t * s.ax[1]
    s.ax[1] *= d
    p00 = s.aP[0, 0] + t * (s.aP[0, 1] + s.aP[1, 0]) + t * t * s.aP[1, 1] + t * t * s.alpha_q[0]
    p01 = d * (s.aP[0, 1] + t * s.aP[1, 1])
    p11 = d * d * s.aP[1, 1] + t * t * s.alpha_q[1]
    total = p00 + r
    k0, k1 = p00 / total, p01 / total
    nu = near(s.alpha_acc - s.alpha_gyr, s.ax[0]) - s.ax[0]
    s.ax[0] += k0 * nu
    s.ax[1] += k1 * nu
    s.aP[0, 0] = (1.0 - k0) ** 2 * p00 + k0 * k0 * r
    s.aP[0, 1] = (1.0 - k0) * (p01 - k1 * p00) + k0 * k1 * r
    s.aP[1, 0] = s.aP[0, 1]
    s.aP[1, 1] = p11 - 2.0 * k1 * p01 + k1 * k1 * total
    s.alpha = s.alpha_gyr + s.ax[0]
    s.alpha_var = s.aP[0, 0]
