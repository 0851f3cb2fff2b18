"""Hinge axes and joint position of two segments from their own sensors, by Gauss-Newton with several starts.

Axes (Seel et al. 2012, 2014; source eqs 68, 69): unit vectors j_T, j_S minimize
Σ ρ(‖g_T × j_T‖ − ‖g_S × j_S‖) + Σ ρ(ã_T·j_T − ã_S·j_S): the rate across the axis, and the specific force of the joint's
centre along it (Olsson et al. 2020), are the same for both segments. The second sum fixes which of the two signs
of j_S belongs to j_T; the first cannot. Steps are taken in the tangent planes of the two unit vectors (eq 69's
spherical coordinates are singular at φ = ±90°). ρ is Huber's loss.

Position (source eqs 70–72): Σ ρ(‖a_T − Γ_T(o_T)‖ − ‖a_S − Γ_S(o_S)‖), Γ(o) = g × (g × o) + ġ × o, o from the joint's
centre to the sensor; the part along the axis is not observable and is moved to zero by eq 72.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ..contract import FloatArray
from ..numerics import cholesky
from ..numerics.compiled import compiled, inlined
from ..numerics.rotations import near

# Columns of a sample, for each of two segments: rate, force, rate's derivative, integral of the rate.
GYR, ACC, DGYR, SUM = 0, 3, 6, 9
WIDTH = 12
COLUMNS = 2 * WIDTH

STILL = 0.03
"""Turn (rad) of both segments below which a span says nothing of the signs: a long rest would drown the motion."""

WORK: list[Any] = [
    ("axis", "f8", (2, 3)),
    ("pos", "f8", (2, 3)),
    ("best", "f8", (2, 3)),
    ("tangent", "f8", (2, 2, 3)),
    ("N", "f8", (10, 10)),
    ("L", "f8", (10, 10)),
    ("rhs", "f8", (10,)),
    ("jac", "f8", (10,)),
    ("cov", "f8", (10, 10)),
    ("force", "f8", (2, 3)),
    ("force_jac", "f8", (2, 3, 3)),
    ("cov_axes", "f8", (4, 4)),  # in the tangent planes
    ("cost", "f8"),
    ("axis_sd", "f8", (2,)),  # rad
    ("pos_sd", "f8"),  # m, across the axis, of both
    ("upper_sd", "f8"),  # of the upper sensor's alone
    ("pairing", "f8"),  # share of the better sign in the misfit of both, 0.5 … 1
    ("hand", "i8"),  # sensors whose axes are left-handed: 0 none, 1 the upper, 2 the lower, 3 both
    ("turn_rms", "f8"),  # rad/s, of the relative turn about the axis
    ("rate_rms", "f8", (2,)),
    ("level", "f8"),  # share of gravity across the axis, root mean square
]
"""Fields of a packed record that the fits use."""


@inlined
def write_sample(s: Any, row: FloatArray, i: int, turned: FloatArray) -> None:
    """Write the sample of sensor ``i`` that was given out, and the integral of its rate (3,), to a row of samples."""
    b = WIDTH * i
    for m in range(3):
        row[b + GYR + m] = s.gyr[i, m]
        row[b + ACC + m] = s.acc[i, m]
        row[b + DGYR + m] = s.dgyr[i, m]
        row[b + SUM + m] = turned[m]


@inlined
def huber(e: float, k: float) -> float:
    """Weight of residual ``e`` under Huber's loss with corner ``k``."""
    size = abs(e)
    return 1.0 if size <= k else k / size


@compiled
def solve(w: Any, n: int, damping: float) -> bool:
    """Solve (N + damping·diag N) x = rhs by Cholesky into ``w.rhs``; False where N is not definite."""
    for i in range(n):
        for j in range(i):
            w.L[i, j] = w.N[i, j]
        w.L[i, i] = w.N[i, i] + (damping * w.N[i, i] + 1e-12)
    if not cholesky.factorize(w.L, n):
        return False
    cholesky.solve(w.L, n, w.rhs)
    return True


@compiled
def centre_force(w: Any, row: FloatArray, i: int) -> None:
    """Write ã = a − Γ(o) of segment ``i`` to ``w.force[i]`` and −∂ã/∂o to ``w.force_jac[i]``."""
    b = WIDTH * i
    gx, gy, gz = row[b + GYR], row[b + GYR + 1], row[b + GYR + 2]
    dx, dy, dz = row[b + DGYR], row[b + DGYR + 1], row[b + DGYR + 2]
    k = w.force_jac
    k[i, 0, 0] = -(gy * gy + gz * gz)
    k[i, 1, 1] = -(gx * gx + gz * gz)
    k[i, 2, 2] = -(gx * gx + gy * gy)
    k[i, 0, 1] = gx * gy - dz
    k[i, 1, 0] = gx * gy + dz
    k[i, 0, 2] = gx * gz + dy
    k[i, 2, 0] = gx * gz - dy
    k[i, 1, 2] = gy * gz - dx
    k[i, 2, 1] = gy * gz + dx
    for m in range(3):
        w.force[i, m] = row[b + ACC + m] - (
            k[i, m, 0] * w.pos[i, 0] + k[i, m, 1] * w.pos[i, 1] + k[i, m, 2] * w.pos[i, 2]
        )


@compiled
def set_tangent(w: Any, i: int) -> None:
    """Write two unit vectors across ``w.axis[i]`` to ``w.tangent[i]``."""
    x, y, z = w.axis[i, 0], w.axis[i, 1], w.axis[i, 2]
    ux, uy, uz = 0.0, 0.0, 0.0
    if abs(x) <= abs(y) and abs(x) <= abs(z):
        uy, uz = -z, y
    elif abs(y) <= abs(z):
        ux, uz = z, -x
    else:
        ux, uy = -y, x
    size = math.sqrt(ux * ux + uy * uy + uz * uz)
    ux, uy, uz = ux / size, uy / size, uz / size
    w.tangent[i, 0, 0], w.tangent[i, 0, 1], w.tangent[i, 0, 2] = ux, uy, uz
    w.tangent[i, 1, 0] = y * uz - z * uy
    w.tangent[i, 1, 1] = z * ux - x * uz
    w.tangent[i, 1, 2] = x * uy - y * ux


@compiled
def add_normal(w: Any, n: int, e: float, weight: float) -> None:
    """Add a residual with ``w.jac`` to the normal equations."""
    for i in range(n):
        w.rhs[i] -= weight * w.jac[i] * e
        for j in range(i + 1):
            w.N[i, j] += weight * w.jac[i] * w.jac[j]


@compiled
def axes_cost(
    w: Any, rows: FloatArray, count: int, sd_gyr: float, sd_acc: float, gravity: float, normal: bool
) -> float:
    """Return the cost at ``w.axis``; with ``normal`` also the normal equations (a force of 0 weight: sd_acc ≤ 0)."""
    total = 0.0
    if normal:
        set_tangent(w, 0)
        set_tangent(w, 1)
        for i in range(4):
            w.rhs[i] = 0.0
            for j in range(4):
                w.N[i, j] = 0.0
    for k in range(count):
        row = rows[k]
        e = 0.0
        for i in range(2):
            sign = 1.0 if i == 0 else -1.0
            b = WIDTH * i + GYR
            x, y, z = row[b], row[b + 1], row[b + 2]
            jx, jy, jz = w.axis[i, 0], w.axis[i, 1], w.axis[i, 2]
            along = x * jx + y * jy + z * jz
            across = math.sqrt(max(0.0, x * x + y * y + z * z - along * along))
            e += sign * across
            if normal:
                # ∂‖g × j‖/∂j on the tangent plane: −(g·j) g / ‖g × j‖.
                f = -sign * along / across if across > 1e-9 else 0.0
                for m in range(2):
                    t = w.tangent[i, m]
                    w.jac[2 * i + m] = f * (x * t[0] + y * t[1] + z * t[2])
        weight = huber(e, 2.0 * sd_gyr) / (sd_gyr * sd_gyr)
        total += weight * e * e
        if normal:
            add_normal(w, 4, e, weight)
        if sd_acc > 0.0:
            centre_force(w, row, 0)
            centre_force(w, row, 1)
            e = 0.0
            norm = 0.0
            for i in range(2):
                sign = 1.0 if i == 0 else -1.0
                for m in range(3):
                    e += sign * w.force[i, m] * w.axis[i, m]
                    norm += w.force[i, m] * w.force[i, m]
                if normal:
                    for m in range(2):
                        t = w.tangent[i, m]
                        w.jac[2 * i + m] = sign * (
                            w.force[i, 0] * t[0] + w.force[i, 1] * t[1] + w.force[i, 2] * t[2]
                        )
            # The faster it moves, the less the force of the joint's centre is known.
            sd = sd_acc + 0.3 * abs(math.sqrt(0.5 * norm) - gravity)
            weight = huber(e, 2.0 * sd) / (sd * sd)
            total += weight * e * e
            if normal:
                add_normal(w, 4, e, weight)
    return total


@compiled
def descend_axes(
    w: Any, rows: FloatArray, count: int, sd_gyr: float, sd_acc: float, gravity: float, steps: int
) -> float:
    """Improve ``w.axis`` by damped Gauss-Newton steps; return the cost."""
    damping = 1e-3
    cost = axes_cost(w, rows, count, sd_gyr, sd_acc, gravity, True)
    for _ in range(steps):
        before00, before01, before02 = w.axis[0, 0], w.axis[0, 1], w.axis[0, 2]
        before10, before11, before12 = w.axis[1, 0], w.axis[1, 1], w.axis[1, 2]
        if not solve(w, 4, damping):
            break
        step = 0.0
        for i in range(2):
            size = 0.0
            for m in range(3):
                w.axis[i, m] += w.rhs[2 * i] * w.tangent[i, 0, m] + w.rhs[2 * i + 1] * w.tangent[i, 1, m]
                size += w.axis[i, m] * w.axis[i, m]
            size = math.sqrt(size)
            step += w.rhs[2 * i] ** 2 + w.rhs[2 * i + 1] ** 2
            for m in range(3):
                w.axis[i, m] /= size
        tried = axes_cost(w, rows, count, sd_gyr, sd_acc, gravity, False)
        if tried <= cost:
            damping = max(1e-7, 0.2 * damping)
        else:
            w.axis[0, 0], w.axis[0, 1], w.axis[0, 2] = before00, before01, before02
            w.axis[1, 0], w.axis[1, 1], w.axis[1, 2] = before10, before11, before12
            damping *= 20.0
            if damping > 1e6:
                break
        cost = axes_cost(w, rows, count, sd_gyr, sd_acc, gravity, True)
        if step < 1e-14 and tried <= cost * (1.0 + 1e-12):
            break
    return cost


@compiled
def angle_across(w: Any, row: FloatArray, sign: float) -> float:
    """Return the angle of u to v (source eq 74, atan2 form) with j_S times ``sign``, or NaN near the vertical."""
    centre_force(w, row, 0)
    centre_force(w, row, 1)
    ux = (
        w.force[0, 0] * w.tangent[0, 0, 0]
        + w.force[0, 1] * w.tangent[0, 0, 1]
        + w.force[0, 2] * w.tangent[0, 0, 2]
    )
    uy = (
        w.force[0, 0] * w.tangent[0, 1, 0]
        + w.force[0, 1] * w.tangent[0, 1, 1]
        + w.force[0, 2] * w.tangent[0, 1, 2]
    )
    vx = (
        w.force[1, 0] * w.tangent[1, 0, 0]
        + w.force[1, 1] * w.tangent[1, 0, 1]
        + w.force[1, 2] * w.tangent[1, 0, 2]
    )
    vy = (
        w.force[1, 0] * w.tangent[1, 1, 0]
        + w.force[1, 1] * w.tangent[1, 1, 1]
        + w.force[1, 2] * w.tangent[1, 1, 2]
    )
    vy *= sign
    if ux * ux + uy * uy < 4.0 or vx * vx + vy * vy < 4.0:
        return math.nan
    return math.atan2(ux * vy - uy * vx, ux * vx + uy * vy)


@compiled
def pairing_misfit(w: Any, rows: FloatArray, count: int, lag: int, sign: float) -> float:
    """Return the mean square misfit of eq 73 with eq 74 over ``lag`` samples, j_S times ``sign``; NaN if unknown."""
    set_tangent(w, 0)
    set_tangent(w, 1)
    total, used = 0.0, 0
    for k in range(lag, count):
        a = angle_across(w, rows[k - lag], sign)
        b = angle_across(w, rows[k], sign)
        if math.isfinite(a) and math.isfinite(b):
            upper, lower = 0.0, 0.0
            for m in range(3):
                upper += (rows[k, SUM + m] - rows[k - lag, SUM + m]) * w.axis[0, m]
                lower += (rows[k, WIDTH + SUM + m] - rows[k - lag, WIDTH + SUM + m]) * w.axis[1, m]
            if abs(upper) + abs(lower) < STILL:
                continue
            e = b - a - upper + sign * lower
            e = near(e, 0.0)
            total += min(e * e, 0.25)
            used += 1
    return total / used if used > 20 else math.nan


@compiled
def fit_axes(
    w: Any, rows: FloatArray, count: int, lag: int, sd_gyr: float, sd_acc: float, gravity: float
) -> bool:
    """Find ``w.axis`` from several starts and resolve the pairing; keeps j_T's sign near the one it had.

    Also fills the standard deviations (inflated by the residuals' correlation) and how observable it was.
    """
    ox, oy, oz = w.axis[0, 0], w.axis[0, 1], w.axis[0, 2]
    least = math.inf
    for start in range(10):
        for i in range(2):
            for m in range(3):
                w.axis[i, m] = w.axis[i, m] if start == 9 else 0.05
        if start < 9:
            w.axis[0, start % 3] = 1.0
            w.axis[1, start // 3] = 1.0
        else:
            for m in range(3):
                w.axis[0, m] = w.best[0, m]
                w.axis[1, m] = w.best[1, m]
        for i in range(2):
            size = math.sqrt(w.axis[i, 0] ** 2 + w.axis[i, 1] ** 2 + w.axis[i, 2] ** 2)
            for m in range(3):
                w.axis[i, m] /= size
        cost = descend_axes(w, rows, count, sd_gyr, 0.0, gravity, 6 if start < 9 else 25)
        if cost < least:
            least = cost
            for i in range(2):
                for m in range(3):
                    w.best[i, m] = w.axis[i, m]
    for i in range(2):
        for m in range(3):
            w.axis[i, m] = w.best[i, m]
    # The pairing whose angles agree better (eqs 73, 74) is carried to the end of the joint cost; there the two
    # are compared again, now with better axes.
    decided = False
    for again in range(2):
        plus = pairing_misfit(w, rows, count, lag, 1.0)
        minus = pairing_misfit(w, rows, count, lag, -1.0)
        decided = math.isfinite(plus) and math.isfinite(minus)
        if decided and minus < plus:
            for m in range(3):
                w.axis[1, m] = -w.axis[1, m]
        w.pairing = max(plus, minus) / (plus + minus) if decided else 0.5
        if again == 0 and sd_acc > 0.0:
            descend_axes(w, rows, count, sd_gyr, sd_acc, gravity, 25)
    sign = 1.0 if w.axis[0, 0] * ox + w.axis[0, 1] * oy + w.axis[0, 2] * oz >= 0.0 else -1.0
    for i in range(2):
        for m in range(3):
            w.axis[i, m] *= sign
    w.cost = axes_cost(w, rows, count, sd_gyr, sd_acc, gravity, True)
    spread(w, rows, count)
    return decided


@compiled
def spread(w: Any, rows: FloatArray, count: int) -> None:
    """Fill the axes' standard deviations from ``w.N`` and the motion that the data had."""
    e0, ee, e1, before = 0.0, 0.0, 0.0, 0.0
    turn, level = 0.0, 0.0
    w.rate_rms[0], w.rate_rms[1] = 0.0, 0.0
    for k in range(count):
        e = 0.0
        rate = 0.0
        for i in range(2):
            sign = 1.0 if i == 0 else -1.0
            b = WIDTH * i
            along, total, up, force = 0.0, 0.0, 0.0, 0.0
            for m in range(3):
                along += rows[k, b + GYR + m] * w.axis[i, m]
                total += rows[k, b + GYR + m] ** 2
                up += rows[k, b + ACC + m] * w.axis[i, m]
                force += rows[k, b + ACC + m] ** 2
            e += sign * math.sqrt(max(0.0, total - along * along))
            rate += sign * along
            w.rate_rms[i] += total
            level += max(0.0, 1.0 - up * up / max(1e-9, force))
        turn += rate * rate
        ee += e * e
        e1 += e * before
        e0 += e
        before = e
    w.turn_rms = math.sqrt(turn / count)
    w.level = math.sqrt(level / (2 * count))
    w.rate_rms[0] = math.sqrt(w.rate_rms[0] / count)
    w.rate_rms[1] = math.sqrt(w.rate_rms[1] / count)
    lag1 = min(0.99, max(0.0, e1 / ee)) if ee > 0.0 else 0.0
    scale = max(1.0, w.cost / count) * (1.0 + lag1) / (1.0 - lag1)
    invert(w, 4)
    for i in range(2):
        a = w.cov[2 * i, 2 * i] + w.cov[2 * i + 1, 2 * i + 1]
        w.axis_sd[i] = min(math.pi / 2.0, math.sqrt(scale * max(0.0, a)))
    for m in range(4):
        for n in range(4):
            w.cov_axes[m, n] = scale * w.cov[m, n]


@compiled
def invert(w: Any, n: int) -> None:
    """Write the inverse of N (damped by 1e-9 of its trace) to ``w.cov``; large where it is singular."""
    trace = 0.0
    for i in range(n):
        trace += w.N[i, i]
    floor = 1e-9 * trace / n + 1e-12
    for i in range(n):
        w.N[i, i] += floor
        for j in range(i):
            w.N[j, i] = w.N[i, j]
    for c in range(n):
        for i in range(n):
            w.rhs[i] = 1.0 if i == c else 0.0
        if not solve(w, n, 0.0):
            for i in range(n):
                w.cov[i, c] = 1e12 if i == c else 0.0
        else:
            for i in range(n):
                w.cov[i, c] = w.rhs[i]


@compiled
def position_cost(w: Any, rows: FloatArray, count: int, sd: float, normal: bool) -> float:
    """Return the cost of ``w.pos`` (eq 70); with ``normal`` also the normal equations."""
    total = 0.0
    if normal:
        for i in range(6):
            w.rhs[i] = 0.0
            for j in range(6):
                w.N[i, j] = 0.0
    for k in range(count):
        e = 0.0
        for i in range(2):
            sign = 1.0 if i == 0 else -1.0
            centre_force(w, rows[k], i)
            size = math.sqrt(w.force[i, 0] ** 2 + w.force[i, 1] ** 2 + w.force[i, 2] ** 2)
            e += sign * size
            if normal and size > 1e-9:
                for m in range(3):
                    w.jac[3 * i + m] = (
                        -sign
                        * (
                            w.force[i, 0] * w.force_jac[i, 0, m]
                            + w.force[i, 1] * w.force_jac[i, 1, m]
                            + w.force[i, 2] * w.force_jac[i, 2, m]
                        )
                        / size
                    )
        weight = huber(e, 2.0 * sd) / (sd * sd)
        total += weight * e * e
        if normal:
            add_normal(w, 6, e, weight)
    return total


@compiled
def fit_position(w: Any, rows: FloatArray, count: int, sd: float) -> None:
    """Find ``w.pos`` from ``w.pos`` by Gauss-Newton; the part along the axes is then moved by eq 72."""
    damping = 1e-4
    cost = position_cost(w, rows, count, sd, True)
    for _ in range(20):
        # A weak prior of 1 m holds what the data do not show (along the axis, or a resting segment).
        for i in range(6):
            w.N[i, i] += 1.0
            w.rhs[i] -= w.pos[i // 3, i % 3]
        if not solve(w, 6, damping):
            break
        step = 0.0
        for i in range(6):
            w.pos[i // 3, i % 3] += w.rhs[i]
            step += w.rhs[i] ** 2
        tried = position_cost(w, rows, count, sd, False)
        if tried <= cost:
            damping = max(1e-8, 0.2 * damping)
        else:
            for i in range(6):
                w.pos[i // 3, i % 3] -= w.rhs[i]
            damping *= 20.0
            if damping > 1e4:
                break
        cost = position_cost(w, rows, count, sd, True)
        if step < 1e-12:
            break
    for i in range(6):
        w.N[i, i] += 1.0
    invert(w, 6)
    settle_positions(w, 0, max(1.0, cost / count))


@compiled
def settle_positions(w: Any, first: int, scale: float) -> None:
    """Fill the positions' deviations across the axes; move the part along them by eq 72.

    Their covariance over ``scale`` stands in ``w.cov`` from row ``first`` on.
    """
    total, along = 0.0, 0.0
    for i in range(2):
        for m in range(3):
            row = first + 3 * i + m
            total += scale * w.cov[row, row]
            along += 0.5 * w.pos[i, m] * w.axis[i, m]
            for k in range(3):
                total -= scale * w.axis[i, m] * w.cov[row, first + 3 * i + k] * w.axis[i, k]
        if i == 0:
            w.upper_sd = math.sqrt(max(0.0, total))
    w.pos_sd = math.sqrt(max(0.0, 0.5 * total))
    for i in range(2):
        for m in range(3):
            w.pos[i, m] -= along * w.axis[i, m]


WORK_DTYPE = np.dtype(WORK)
