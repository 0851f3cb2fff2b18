"""Kernel of the orientations of a chain of segments: error-state Kalman filter with the joints as measurements.

Per segment a rotation rot_nb (sensor to navigation frame, z up) and a gyroscope bias; error states φ (rotation
about the navigation axes, R_true = exp([φ]×) R) and δb. Attitude is carried by the turn since the sample before.

Measurements, every sample:

* gravity, each segment: R f = [0, 0, g] + a, f = a_sensor − Γ(o) at the joint's centre. The acceleration a is taken
  for coloured noise of standard deviation ``sd_force`` and correlation time ``tau_force``: as white noise at the
  sample time T its variance is 2 sd² τ / T, so the result does not depend on the rate. It grows with |‖f‖ − g|.
* connection, each joint with known position: R_u f_u = R_l f_l, the acceleration of the joint's centre is the same
  for both (Kok et al. 2014; Weygers and Kok 2020). This makes relative heading observable under motion.
* hinge: R_u j_u = R_l j_l; two axes: (R_u j_u)·(R_l j_l) = cos of their constant angle. Sway of soft tissue is
  coloured noise of ``sway`` and ``tau_sway``.
* rest: where force and rate are steady, the rate is the bias.

The common heading of all segments is not observable and is not corrected.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ..contract import FloatArray
from ..numerics.compiled import compiled
from ..numerics.rotations import near
from . import merge, selfaligned
from .chain_turn import square, turn
from .chain_zero import axis_unknown, spread_of_zero

HINGE, TWO, FREE = 0, 1, 2
FIRST_MISFITS, MISFITS = 300, 10_000
"""Innovations of the connection that the parameters are worth at the start, and over how many the mean runs."""
MOST = merge.MOST
STATES = 6 * MOST
JOINTS = MOST - 1

DTYPE = np.dtype(
    [
        *merge.FIELDS,
        *selfaligned.FIELDS,
        ("mount", "f8", (MOST, 3, 3)),
        ("type", "i8", (JOINTS,)),
        ("j", "f8", (JOINTS, 2, 3)),
        ("lever", "f8", (JOINTS, 2, 3)),
        ("placed", "i8", (JOINTS,)),
        ("cosine", "f8", (JOINTS,)),
        ("anchor", "f8", (3,)),
        ("anchored", "i8"),
        ("on_line", "i8"),
        ("first_ns", "i8"),  # time of the first sample, and of the first that had an angle
        ("begin_ns", "i8"),
        ("q_gyr", "f8"),
        ("k_gyr", "f8"),  # (s/√Hz)²: growth of q_gyr with the rate
        ("q_bias", "f8"),
        ("p_bias", "f8"),
        ("r_force", "f8"),  # 2 sd² τ
        ("k_force", "f8"),
        ("r_joint", "f8"),
        ("k_joint", "f8"),
        ("r_sway", "f8"),
        ("r_rest", "f8"),
        ("rot", "f8", (MOST, 3, 3)),
        ("bias", "f8", (MOST, 3)),
        ("f", "f8", (MOST, 3)),  # force of the gravity row in the navigation frame
        ("low", "f8", (MOST, 6)),  # mean force and rate over half a second
        ("smooth", "f8", (MOST, 3)),  # mean force over a fifth: a sensor's noise is no motion
        ("still", "f8", (MOST,)),
        ("moved", "i8", (MOST,)),  # whether the segment moved since it began
        ("x", "f8", (STATES,)),
        ("P", "f8", (STATES, STATES)),
        ("at", "i8", (6,)),
        ("h", "f8", (6,)),
        ("Ph", "f8", (STATES,)),
        ("u", "f8", (3,)),
        ("v", "f8", (3,)),
        ("dev", "f8", (2,)),
        ("angle", "f8", (JOINTS, 3)),
        ("angle_sd", "f8", (JOINTS,)),
        ("zero", "i8"),  # of the flexion: 0 by the mountings, 1 at the start, 2 by the encoder
        ("zero_s", "f8"),
        ("sd_mount", "f8"),
        ("mount_var", "f8"),  # of the zero by the mountings
        ("tilt_var", "f8"),  # of the accelerometers' constant error
        ("zero_sum", "f8", (JOINTS,)),
        ("zero_var", "f8", (JOINTS,)),  # sum of the angle's variance meanwhile
        ("zero_count", "i8", (JOINTS,)),
        ("zero_time", "f8"),
        ("steps", "i8"),
        # Before the measurements of the sample, for the smoother.
        ("keep", "i8"),
        ("broken", "i8"),
        ("rot_before", "f8", (MOST, 3, 3)),
        ("bias_before", "f8", (MOST, 3)),
        ("P_before", "f8", (STATES, STATES)),
        ("two_tau", "f8"),  # 2 τ of the connection's misfit
        (
            "misfit",
            "f8",
            (JOINTS,),
        ),  # running mean square of the connection's innovation over what sd_joint says
        ("misfits", "i8", (JOINTS,)),
    ]
)


@compiled
def face(s: Any, i: int) -> None:
    """Turn segment ``i`` about the vertical so that its joint's axis has the heading that its neighbour says."""
    other = i - 1 if i > 0 else 1
    k = min(i, other)
    if s.valid[other] == 0 or s.type[k] == TWO:
        return
    mine, its = (0, 1) if i == k else (1, 0)
    r, wx, wy, vx, vy = s.rot, 0.0, 0.0, 0.0, 0.0
    for m in range(3):
        wx += r[other, 0, m] * s.j[k, its, m]
        wy += r[other, 1, m] * s.j[k, its, m]
        vx += r[i, 0, m] * s.j[k, mine, m]
        vy += r[i, 1, m] * s.j[k, mine, m]
    turn(s, i, 0.0, 0.0, math.atan2(vx * wy - vy * wx, vx * wx + vy * wy), False)


@compiled
def forget(s: Any, first: int, count: int) -> None:
    """Set rows and columns of P from state ``first`` on to zero."""
    for a in range(first, first + count):
        for b in range(6 * s.n):
            s.P[a, b] = 0.0
            s.P[b, a] = 0.0


@compiled
def restart(s: Any, i: int) -> None:
    """Begin segment ``i``: tilt by its accelerometer, flexion axis along x (or the neighbour's) of the frame."""
    a = s.acc[i]
    size = math.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])
    ux, uy, uz = s.mount[i, 2, 0], s.mount[i, 2, 1], s.mount[i, 2, 2]
    if size > 1e-3:  # a dead sensor feels no force
        ux, uy, uz = a[0] / size, a[1] / size, a[2] / size
    jx, jy, jz = s.mount[i, 0, 0], s.mount[i, 0, 1], s.mount[i, 0, 2]
    dot = ux * jx + uy * jy + uz * jz
    level = abs(dot) < 0.9
    if not level:  # flexion axis near the vertical: the long axis instead, forward
        jx, jy, jz = s.mount[i, 1, 0], s.mount[i, 1, 1], s.mount[i, 1, 2]
        dot = ux * jx + uy * jy + uz * jz
    jx, jy, jz = jx - dot * ux, jy - dot * uy, jz - dot * uz
    size = math.sqrt(jx * jx + jy * jy + jz * jz)
    jx, jy, jz = jx / size, jy / size, jz / size
    kx, ky, kz = uy * jz - uz * jy, uz * jx - ux * jz, ux * jy - uy * jx
    r = s.rot
    first = 0 if level else 1
    sign = 1.0 if level else -1.0
    r[i, first, 0], r[i, first, 1], r[i, first, 2] = jx, jy, jz
    r[i, 1 - first, 0], r[i, 1 - first, 1], r[i, 1 - first, 2] = sign * kx, sign * ky, sign * kz
    r[i, 2, 0], r[i, 2, 1], r[i, 2, 2] = ux, uy, uz
    if s.on_line == 1 and s.n > 1:
        face(s, i)
    forget(s, 6 * i, 6)
    for k in range(3):
        s.P[6 * i + k, 6 * i + k] = 0.02
        s.P[6 * i + 3 + k, 6 * i + 3 + k] = s.p_bias
        s.bias[i, k] = 0.0
    hinge = s.n > 1 and s.type[max(0, i - 1)] == HINGE
    s.P[6 * i + 2, 6 * i + 2] = 0.02 if hinge and level else 0.3
    s.still[i], s.moved[i] = -0.5, 0  # the means begin with one sample each
    for k in range(3):
        s.smooth[i, k] = s.low[i, k] = s.acc[i, k]
        s.low[i, 3 + k] = s.gyr[i, k]


@compiled
def predict(s: Any) -> None:
    """Carry attitudes and P: φ ← φ − R δb T."""
    n, t = 6 * s.n, s.dt
    for i in range(s.n):
        if s.valid[i] == 1:
            b = s.bias[i]
            turn(s, i, s.turn[i, 0] - t * b[0], s.turn[i, 1] - t * b[1], s.turn[i, 2] - t * b[2], True)
        a = 6 * i
        for c in range(n):
            x, y, z = s.P[a + 3, c], s.P[a + 4, c], s.P[a + 5, c]
            for k in range(3):
                s.P[a + k, c] -= t * (s.rot[i, k, 0] * x + s.rot[i, k, 1] * y + s.rot[i, k, 2] * z)
        for c in range(n):
            x, y, z = s.P[c, a + 3], s.P[c, a + 4], s.P[c, a + 5]
            for k in range(3):
                s.P[c, a + k] -= t * (s.rot[i, k, 0] * x + s.rot[i, k, 1] * y + s.rot[i, k, 2] * z)
        rate2 = s.gyr[i, 0] ** 2 + s.gyr[i, 1] ** 2 + s.gyr[i, 2] ** 2
        for k in range(3):
            s.P[a + k, a + k] += (s.q_gyr + s.k_gyr * rate2) * t
            s.P[a + 3 + k, a + 3 + k] += s.q_bias * t


@compiled
def take(s: Any, count: int, e: float, r: float) -> None:
    """Take one scalar measurement: residual ``e`` before any of this sample's, entries ``s.h`` at ``s.at``."""
    n = 6 * s.n
    total = r
    for a in range(n):
        p = 0.0
        for k in range(count):
            p += s.P[a, s.at[k]] * s.h[k]
        s.Ph[a] = p
    for k in range(count):
        total += s.h[k] * s.Ph[s.at[k]]
        e -= s.h[k] * s.x[s.at[k]]
    for a in range(n):
        g = s.Ph[a] / total
        s.x[a] += g * e
        for b in range(a, n):
            p = s.P[a, b] - g * s.Ph[b]
            s.P[a, b] = p
            s.P[b, a] = p


@compiled
def to_nav(s: Any, i: int, x: float, y: float, z: float, out: FloatArray) -> None:
    """Write ``rot[i] @ [x, y, z]`` to ``out``."""
    for k in range(3):
        out[k] = s.rot[i, k, 0] * x + s.rot[i, k, 1] * y + s.rot[i, k, 2] * z


@compiled
def force_at(s: Any, i: int, o: FloatArray, out: FloatArray) -> float:
    """Write the force at the point whose vector to the sensor is ``o``, in the navigation frame; return ‖Γ‖."""
    gx = s.gyr[i, 0] - s.bias[i, 0]
    gy = s.gyr[i, 1] - s.bias[i, 1]
    gz = s.gyr[i, 2] - s.bias[i, 2]
    along = gx * o[0] + gy * o[1] + gz * o[2]
    size = gx * gx + gy * gy + gz * gz
    cx = gx * along - o[0] * size + s.dgyr[i, 1] * o[2] - s.dgyr[i, 2] * o[1]
    cy = gy * along - o[1] * size + s.dgyr[i, 2] * o[0] - s.dgyr[i, 0] * o[2]
    cz = gz * along - o[2] * size + s.dgyr[i, 0] * o[1] - s.dgyr[i, 1] * o[0]
    to_nav(s, i, s.acc[i, 0] - cx, s.acc[i, 1] - cy, s.acc[i, 2] - cz, out)
    return math.sqrt(cx * cx + cy * cy + cz * cz)


@compiled
def cross_row(s: Any, first: int, i: int, v: FloatArray, k: int, sign: float) -> None:
    """Write the entries of ∂(sign·v)_k/∂φ_i, v turned by φ: −sign [v]× row k, to places ``first`` … + 2."""
    a, b = (k + 1) % 3, (k + 2) % 3
    # (φ × v)_k = φ_a v_b − φ_b v_a
    s.at[first], s.at[first + 1], s.at[first + 2] = 6 * i + k, 6 * i + a, 6 * i + b
    s.h[first], s.h[first + 1], s.h[first + 2] = 0.0, sign * v[b], -sign * v[a]


@compiled
def gravity(s: Any) -> None:
    """Rows of gravity, one pair a segment."""
    for i in range(s.n):
        if s.valid[i] == 0:
            continue
        if i == 0 and s.anchored == 1:
            moved = force_at(s, i, s.anchor, s.u)
        elif s.n > 1:
            k, side = (i - 1, 1) if i > 0 else (0, 0)
            moved = force_at(s, i, s.lever[k, side], s.u)
        else:
            to_nav(s, i, s.acc[i, 0], s.acc[i, 1], s.acc[i, 2], s.u)
            moved = 0.0
        off = abs(math.sqrt(s.u[0] ** 2 + s.u[1] ** 2 + s.u[2] ** 2) - s.gravity)
        r = s.r_force
        if i == 0 and s.anchored == 1:  # the point does not move
            r = s.r_joint + s.k_joint * moved * moved
        else:
            r = (r + s.k_force * off * off) * s.n
        r /= max(1e-4, s.dt)
        for k in range(2):
            cross_row(s, 0, i, s.u, k, 1.0)
            take(s, 3, -s.u[k], r)


@compiled
def connect(s: Any, j: int) -> None:
    """Rows of joint ``j``: the centre's acceleration and the axes."""
    if s.placed[j] == 1 and s.slope[j] == 1 and s.slope[j + 1] == 1:
        moved = force_at(s, j, s.lever[j, 0], s.u) + force_at(s, j + 1, s.lever[j, 1], s.v)
        r = (s.r_joint + s.k_joint * moved * moved) / max(1e-4, s.dt)
        for k in range(3):
            cross_row(s, 0, j, s.u, k, 1.0)
            cross_row(s, 3, j + 1, s.v, k, -1.0)
            e = s.v[k] - s.u[k]
            s.misfits[j] = min(MISFITS, s.misfits[j] + 1)
            s.misfit[j] += (s.two_tau * e * e / (r * max(1e-4, s.dt)) - s.misfit[j]) / s.misfits[j]
            take(s, 6, e, r)
    r = s.r_sway / max(1e-4, s.dt)
    if s.type[j] == FREE or axis_unknown(s):
        return
    a, b = s.j[j, 0], s.j[j, 1]
    to_nav(s, j, a[0], a[1], a[2], s.u)
    to_nav(s, j + 1, b[0], b[1], b[2], s.v)
    if s.type[j] == HINGE:
        for k in range(3):
            cross_row(s, 0, j, s.u, k, 1.0)
            cross_row(s, 3, j + 1, s.v, k, -1.0)
            take(s, 6, s.v[k] - s.u[k], r)
        return
    # u·v = cosine: ∂/∂φ_u = u × v, ∂/∂φ_l = −u × v.
    u, v = s.u, s.v
    dot = u[0] * v[0] + u[1] * v[1] + u[2] * v[2]
    for k in range(3):
        a0, b0 = (k + 1) % 3, (k + 2) % 3
        c = u[a0] * v[b0] - u[b0] * v[a0]
        s.at[k], s.h[k] = 6 * j + k, c
        s.at[3 + k], s.h[3 + k] = 6 * (j + 1) + k, -c
    take(s, 6, s.cosine[j] - dot, r)


@compiled
def rest(s: Any, i: int) -> None:
    """Where segment ``i`` has been steady for a second, its rate is the bias."""
    w, v = min(1.0, s.dt / 0.5), min(1.0, s.dt / 0.2)
    da, dg, size = 0.0, 0.0, 0.0
    for k in range(3):
        s.smooth[i, k] += v * (s.acc[i, k] - s.smooth[i, k])
        da += (s.smooth[i, k] - s.low[i, k]) ** 2
        dg += (s.gyr[i, k] - s.low[i, 3 + k]) ** 2
        s.low[i, k] += w * (s.acc[i, k] - s.low[i, k])
        s.low[i, 3 + k] += w * (s.gyr[i, k] - s.low[i, 3 + k])
        size += (s.low[i, 3 + k] - s.bias[i, k]) ** 2
    quiet = s.still[i] < 0.0 or (da < 0.09 and dg < 0.0012)
    # Who has not moved yet stands; later a slow turn about the vertical, which no force shows, would be a bias.
    most = 0.04 if s.moved[i] == 0 else 0.0025 + 4.0 * s.p_bias
    steady = quiet and size < most
    if s.still[i] >= 0.0 and (da > 0.36 or dg > 0.0012):  # four times the noise that may be taken for quiet
        s.moved[i] = 1
    s.still[i] = s.still[i] + s.dt if steady else 0.0
    if s.still[i] < 1.0:
        return
    for k in range(3):
        s.at[0], s.h[0] = 6 * i + 3 + k, 1.0
        take(s, 1, s.low[i, 3 + k] - s.bias[i, k], s.r_rest / max(1e-4, s.dt))


@compiled
def feed_back(s: Any) -> None:
    """Take the corrections into attitudes and biases."""
    for i in range(s.n):
        a = 6 * i
        turn(s, i, s.x[a], s.x[a + 1], s.x[a + 2], False)
        square(s, i)
        for k in range(3):
            s.bias[i, k] += s.x[a + 3 + k]
    for a in range(6 * s.n):
        s.x[a] = 0.0


@compiled
def measure_angles(s: Any) -> None:
    """Write the angles of every joint and the standard deviation of its flexion.

    M, the lower segment seen from the upper one, is Rx(−flexion) Ry(−abduction) Rz(−rotation) (Grood and Suntay 1983).
    """
    for j in range(s.n - 1):
        u, w = s.rot[j], s.rot[j + 1]
        m, o = s.mount[j], s.mount[j + 1]
        c00, c01, c02, c12, c22 = 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(3):
            # Axes of both segments in the navigation frame, component k.
            ux = u[k, 0] * m[0, 0] + u[k, 1] * m[0, 1] + u[k, 2] * m[0, 2]
            uy = u[k, 0] * m[1, 0] + u[k, 1] * m[1, 1] + u[k, 2] * m[1, 2]
            uz = u[k, 0] * m[2, 0] + u[k, 1] * m[2, 1] + u[k, 2] * m[2, 2]
            lx = w[k, 0] * o[0, 0] + w[k, 1] * o[0, 1] + w[k, 2] * o[0, 2]
            ly = w[k, 0] * o[1, 0] + w[k, 1] * o[1, 1] + w[k, 2] * o[1, 2]
            lz = w[k, 0] * o[2, 0] + w[k, 1] * o[2, 1] + w[k, 2] * o[2, 2]
            c00 += lx * ux
            c01 += ux * ly
            c02 += ux * lz
            c12 += uy * lz
            c22 += lz * uz
        s.angle[j, 0] = near(math.atan2(c12, c22), s.angle[j, 0])
        s.angle[j, 1] = -math.asin(max(-1.0, min(1.0, c02)))
        s.angle[j, 2] = math.atan2(c01, c00)
        to_nav(s, j, m[0, 0], m[0, 1], m[0, 2], s.u)
        total = 0.0
        for a in range(3):
            for b in range(3):
                p, q = 6 * j, 6 * j + 6
                v = s.P[p + a, p + b] + s.P[q + a, q + b] - s.P[p + a, q + b] - s.P[q + a, p + b]
                total += s.u[a] * s.u[b] * v
        s.angle_sd[j] = math.sqrt(max(0.0, total))


@compiled
def set_axes(s: Any) -> None:
    """Take the identified axes and position of the first joint; turn both mountings to the axes."""
    for i in range(2):
        dot, size = 0.0, 0.0
        for m in range(3):
            s.j[0, i, m] = s.axis[i, m]
            s.lever[0, i, m] = s.pos[i, m]
            dot += s.up[i, m] * s.axis[i, m]
        for m in range(3):
            s.mount[i, 0, m] = s.axis[i, m]
            s.mount[i, 2, m] = s.up[i, m] - dot * s.axis[i, m]
            size += s.mount[i, 2, m] ** 2
        size = math.sqrt(size)
        for m in range(3):
            s.mount[i, 2, m] /= size
        for m in range(3):
            p, q = (m + 1) % 3, (m + 2) % 3
            s.mount[i, 1, m] = s.mount[i, 2, p] * s.mount[i, 0, q] - s.mount[i, 2, q] * s.mount[i, 0, p]
    s.placed[0] = 1 if s.learn == 2 and s.pos_sd < 0.05 else 0
    spread_of_zero(s)


@compiled
def begin_anew(s: Any) -> None:
    """Take axes that are known from now on: until then both segments had their tilt, not their common heading."""
    face(s, 1)
    forget(s, 8, 1)
    s.P[8, 8] = 0.1
    s.zero_sum[0], s.zero_var[0], s.zero_count[0] = 0.0, 0.0, 0
    if s.zero == 2:  # the encoder is there later too, the pose at the start is not
        s.zero_time = 0.0


@compiled
def remember(s: Any) -> None:
    """Keep attitudes, biases and P before the measurements."""
    for i in range(s.n):
        for k in range(3):
            s.bias_before[i, k] = s.bias[i, k]
            for m in range(3):
                s.rot_before[i, k, m] = s.rot[i, k, m]
    for a in range(6 * s.n):
        for b in range(6 * s.n):
            s.P_before[a, b] = s.P[a, b]


@compiled
def step(s: Any) -> bool:
    """Filter the sample given out; False before every segment was seen once."""
    if s.on_line == 0:
        for i in range(s.n):
            if s.valid[i] == 0:
                return False
        for i in range(s.n):
            restart(s, i)
        s.on_line = 1
        s.first_ns = s.now
        return True
    unknown = axis_unknown(s)
    if unknown:
        s.angle[0, 0] = 0.0  # whole turns about no axis are not counted
    if s.learn > 0 and s.n > 1 and selfaligned.watch(s) and (s.known == 1 or unknown) and not axis_unknown(s):
        set_axes(s)
        if unknown:
            begin_anew(s)
    predict(s)
    for i in range(s.n):
        if s.valid[i] == 1 and s.gap[i] > 0.0:
            restart(s, i)
    if s.keep == 1:
        remember(s)
    gravity(s)
    for j in range(s.n - 1):
        if s.valid[j] == 1 and s.valid[j + 1] == 1:
            connect(s, j)
    for i in range(s.n):
        if s.valid[i] == 1:
            rest(s, i)
    feed_back(s)
    s.steps += 1
    return True
