"""The kernel of the source's Kalman filters: FKC, FKL, FKG, SMp, SMe and SMeA are one filter with different rows.

State x = [Δθ, Δb] per segment and axis, Δθ = θ − θ_g; F = I + Ā T, G = T I (spec of eqs 9–93). Printed
G = A⁻¹(F − I)B cannot be computed: A has a zero column for every τ; F − I = A T exactly, hence G = T I. Rows are
uncorrelated (R is diagonal), so they are taken one after another in Joseph's form, which equals taking them
together; the gain of all together is K = P⁺ Hᵀ R⁻¹.

Order of the rows: accelerometer rows by segment and axis (``segment * axes + axis``), then joint rows
(``n * axes + joint``), each +1 on the upper and −1 on the lower segment's Δθ of the flexion axis (z is
α − (θ_g,upper − θ_g,lower); the printed [−r r] has the wrong sign).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ..numerics.compiled import compiled
from ..numerics.rotations import near
from . import merge, selfaligned

LOCAL, GLOBAL, ONE, SELF = 0, 1, 2, 3  # kinds: FKL; FKG; SMp and SMe; SMeA
DROP, ZERO, HOLD = 0, 1, 2
AXIS, EULER, QUATERNION = 0, 1, 2
STATES = 24
ROWS = 15

DTYPE = np.dtype(
    [
        *merge.FIELDS,
        *selfaligned.FIELDS,
        ("kind", "i8"),
        ("axes", "i8"),  # 1 planar, 3 spatial
        ("flex", "i8"),  # place of the flexion axis among the axes
        ("yaw", "i8"),  # 1: the angle called acc-tilt stands in the yaw row
        ("arcsine", "i8"),
        ("integration", "i8"),
        ("unusable", "i8"),
        ("dynamic", "i8"),  # rule of FKL and FKG: 1 by |a_x|, |a_y|, |a_z| below 0.5 g
        ("zeta", "f8"),
        ("decay", "f8"),
        ("q", "f8", (2,)),
        ("r", "f8", (ROWS,)),
        ("r_self", "f8", (2,)),  # joint row of SMeA in T and S, and in TS
        ("mount", "f8", (merge.MOST, 3, 3)),  # sensor to segment
        ("average", "f8"),  # s; 0: every sample's force by itself
        ("measured", "f8", (merge.MOST, 3)),  # force in the segment's frame
        ("levelled", "f8", (merge.MOST, 3)),  # its average, levelled by the filter's own angles
        ("averaged", "f8", (merge.MOST,)),  # s
        ("swing", "f8", (merge.MOST,)),  # mean square of the levelled force about its average, (m/s²)²
        ("grow", "f8"),  # growth of σ_a² with it
        ("sigma2", "f8", (ROWS,)),  # σ² of the rows at rest
        ("p_bias", "f8"),
        ("on_line", "i8"),
        ("started", "i8", (merge.MOST,)),
        ("theta_g", "f8", (merge.MOST, 3)),
        ("theta_a", "f8", (merge.MOST, 3)),
        ("rho", "f8", (merge.MOST,)),
        ("usable", "i8", (merge.MOST,)),
        ("use", "i8", (ROWS,)),
        ("jump", "i8"),
        ("z", "f8", (ROWS,)),
        ("nu", "f8", (ROWS,)),
        ("x", "f8", (STATES,)),
        ("P", "f8", (STATES, STATES)),
        ("Ph", "f8", (STATES,)),
        ("gain", "f8", (STATES,)),
        ("K", "f8", (STATES, ROWS)),
        ("steps", "i8"),
        ("jumped_turns", "i8"),  # encoder readings moved by whole turns
        ("blind", "i8"),  # steps without any accelerometer
    ]
)


@compiled
def measure(s: Any, i: int) -> None:
    """Turn segment ``i``'s sample into its segment's frame; angles from the accelerometer (eq 8) and ρ (eq 28)."""
    m = s.mount
    ax, ay, az = s.acc[i, 0], s.acc[i, 1], s.acc[i, 2]
    x = m[i, 0, 0] * ax + m[i, 0, 1] * ay + m[i, 0, 2] * az
    y = m[i, 1, 0] * ax + m[i, 1, 1] * ay + m[i, 1, 2] * az
    z = m[i, 2, 0] * ax + m[i, 2, 1] * ay + m[i, 2, 2] * az
    s.measured[i, 0], s.measured[i, 1], s.measured[i, 2] = x, y, z
    angles_of_force(s, i, x, y, z)


@compiled
def average(s: Any, i: int) -> None:
    """Put the average of the levelled force in place of this sample's: what comes and goes over a stride is gone.

    The force is turned by the filter's own roll and pitch, averaged over ``s.average`` s, and turned back: linear,
    so that accelerations without a mean leave no error in the angles (not in the source; after Laidig and Seel
    2023). The variance about that average says how far the accelerometer can be trusted now.
    """
    a, b = 0.0, 0.0
    if s.axes == 3:
        a, b = s.theta_g[i, 0] + s.x[6 * i], s.theta_g[i, 1] + s.x[6 * i + 2]
    elif s.flex == 0:
        a = s.theta_g[i, 0] + s.x[2 * i]
    else:
        b = s.theta_g[i, 0] + s.x[2 * i]
    ca, sa, cb, sb = math.cos(a), math.sin(a), math.cos(b), math.sin(b)
    x, y, z = s.measured[i, 0], s.measured[i, 1], s.measured[i, 2]
    up = sa * y + ca * z
    lx, ly, lz = cb * x + sb * up, ca * y - sa * z, cb * up - sb * x
    s.averaged[i] += s.dt
    w = min(1.0, s.dt / max(1e-9, min(s.average, s.averaged[i])))
    s.levelled[i, 0] += w * (lx - s.levelled[i, 0])
    s.levelled[i, 1] += w * (ly - s.levelled[i, 1])
    s.levelled[i, 2] += w * (lz - s.levelled[i, 2])
    off = (lx - s.levelled[i, 0]) ** 2 + (ly - s.levelled[i, 1]) ** 2 + (lz - s.levelled[i, 2]) ** 2
    s.swing[i] += w * (off - s.swing[i])
    for k in range(s.axes):
        m = i * s.axes + k
        s.r[m] = s.sigma2[m] + s.grow * s.swing[i] / (s.gravity * s.gravity)
    lx, ly, lz = s.levelled[i, 0], s.levelled[i, 1], s.levelled[i, 2]
    up = sb * lx + cb * lz
    angles_of_force(s, i, cb * lx - sb * lz, ca * ly + sa * up, ca * up - sa * ly)


@compiled
def angles_of_force(s: Any, i: int, x: float, y: float, z: float) -> None:
    """Write θ_a, ρ and whether it is usable for a force in the segment's frame (eqs 8, 28)."""
    size = math.sqrt(x * x + y * y + z * z)
    s.rho[i] = abs(size - s.gravity)
    s.usable[i] = 1 if s.rho[i] <= s.zeta else 0
    roll = math.atan2(y, z)
    pitch = math.atan2(-x, math.sqrt(y * y + z * z))
    if s.arcsine == 1:
        roll = math.asin(max(-1.0, min(1.0, y / s.gravity)))
        pitch = -math.asin(max(-1.0, min(1.0, x / s.gravity)))
    if s.axes == 1:
        s.theta_a[i, 0] = roll if s.flex == 0 else pitch
    else:
        s.theta_a[i, 0], s.theta_a[i, 1] = roll, pitch
        s.theta_a[i, 2] = math.atan2(math.sqrt(x * x + y * y), z) if s.yaw == 1 else 0.0
    if s.dynamic == 1:
        # Dynamic acceleration by the filter's own tilt; a planar filter knows one angle of it.
        a = s.theta_g[i, 0] + s.x[2 * i * s.axes] if s.started[i] == 1 else roll
        b = s.theta_g[i, 1] + s.x[2 * i * s.axes + 2] if s.axes == 3 and s.started[i] == 1 else pitch
        if s.axes == 1 and s.flex == 1:
            a, b = roll, a
        g = s.gravity
        dx, dy, dz = x + g * math.sin(b), y - g * math.sin(a) * math.cos(b), z - g * math.cos(a) * math.cos(b)
        s.usable[i] = 1 if max(abs(dx), max(abs(dy), abs(dz))) < 0.5 * g else 0


@compiled
def integrate(s: Any, i: int) -> None:
    """Carry θ_g of segment ``i`` over its turn since the sample before (eq 7)."""
    m = s.mount
    a, b, c = s.turn[i, 0], s.turn[i, 1], s.turn[i, 2]
    x = m[i, 0, 0] * a + m[i, 0, 1] * b + m[i, 0, 2] * c
    y = m[i, 1, 0] * a + m[i, 1, 1] * b + m[i, 1, 2] * c
    z = m[i, 2, 0] * a + m[i, 2, 1] * b + m[i, 2, 2] * c
    if s.axes == 1:
        s.theta_g[i, 0] += x if s.flex == 0 else y
        return
    if s.integration == AXIS:
        s.theta_g[i, 0] += x
        s.theta_g[i, 1] += y
        s.theta_g[i, 2] += z
        return
    k = 6 * i
    roll, pitch = s.theta_g[i, 0] + s.x[k], s.theta_g[i, 1] + s.x[k + 2]
    sr, cr, sp, cp = math.sin(roll), math.cos(roll), math.sin(pitch), math.cos(pitch)
    if s.integration == EULER:
        cp = cp if abs(cp) > 0.02 else math.copysign(0.02, cp)  # singular at ±90°
        w = (sr * y + cr * z) / cp
        s.theta_g[i, 0] += x + sp * w
        s.theta_g[i, 1] += cr * y - sr * z
        s.theta_g[i, 2] += w
        return
    # C = Ry(pitch) Rx(roll) turned by exp([x y z]×); the angles' difference is exact for a constant rate.
    size = math.sqrt(x * x + y * y + z * z)
    f = math.sin(size) / size if size > 1e-9 else 1.0
    h = (1.0 - math.cos(size)) / (size * size) if size > 1e-9 else 0.5
    e00, e10, e20 = 1.0 - h * (y * y + z * z), h * x * y + f * z, h * x * z - f * y
    e01, e11, e21 = h * x * y - f * z, 1.0 - h * (x * x + z * z), h * y * z + f * x
    e02, e12, e22 = h * x * z + f * y, h * y * z - f * x, 1.0 - h * (x * x + y * y)
    c00 = cp * e00 + sp * sr * e10 + sp * cr * e20
    c10 = cr * e10 - sr * e20
    c20 = -sp * e00 + cp * sr * e10 + cp * cr * e20
    c21 = -sp * e01 + cp * sr * e11 + cp * cr * e21
    c22 = -sp * e02 + cp * sr * e12 + cp * cr * e22
    s.theta_g[i, 0] += near(math.atan2(c21, c22), roll) - roll
    s.theta_g[i, 1] += math.asin(max(-1.0, min(1.0, -c20))) - math.atan2(sp, cp)
    s.theta_g[i, 2] += math.atan2(c10, c00)


@compiled
def restart(s: Any, i: int) -> None:
    """Begin segment ``i``: θ_g from its accelerometer, x = 0, P = I (of the bias: ``p_bias``)."""
    n = 2 * s.n * s.axes
    s.averaged[i], s.swing[i] = 0.0, 0.0
    for k in range(s.axes):
        s.theta_g[i, k] = s.theta_a[i, k]
    for a in range(2 * i * s.axes, 2 * (i + 1) * s.axes):
        s.x[a] = 0.0
        for b in range(n):
            s.P[a, b] = 0.0
            s.P[b, a] = 0.0
        s.P[a, a] = 1.0 if a % 2 == 0 else s.p_bias
    s.started[i] = 1


@compiled
def predict(s: Any) -> None:
    """Carry x and P: F = I + Ā T, G Q Gᵀ = T² Q."""
    n = 2 * s.n * s.axes
    t, d = s.dt, 1.0 - s.dt * s.decay
    for a in range(0, n, 2):
        s.x[a] += t * s.x[a + 1]
        s.x[a + 1] *= d
        for b in range(n):
            s.P[a, b] += t * s.P[a + 1, b]
            s.P[a + 1, b] *= d
    for b in range(0, n, 2):
        for a in range(n):
            s.P[a, b] += t * s.P[a, b + 1]
            s.P[a, b + 1] *= d
        s.P[b, b] += t * t * s.q[0]
        s.P[b + 1, b + 1] += t * t * s.q[1]


@compiled
def select(s: Any) -> None:
    """Decide the jump state and which accelerometers are used (eqs 29, 47, 60, 75)."""
    count, best = 0, -1
    for i in range(s.n):
        if s.valid[i] == 0:
            s.usable[i] = 0
            continue
        count += s.usable[i]
        if best < 0 or s.rho[i] < s.rho[best]:
            best = i
    s.jump = best
    if s.kind == LOCAL or s.kind == GLOBAL or (s.kind == SELF and count == s.n):
        s.jump = s.n  # all


@compiled
def form(s: Any) -> None:
    """Form the rows of this sample: which are used, z, R."""
    axes, flex = s.axes, s.flex if s.axes == 3 else 0
    joints = s.n * axes
    for m in range(ROWS):
        s.use[m] = 0
    for i in range(s.n):
        if s.valid[i] == 0 or (s.jump < s.n and s.jump != i):
            continue
        for k in range(axes):
            if k == 2 and s.yaw == 0:
                continue
            m = i * axes + k
            if s.usable[i] == 1:
                s.z[m] = near(s.theta_a[i, k] - s.theta_g[i, k], s.x[2 * m])
            elif s.unusable == DROP:
                continue
            elif s.unusable == ZERO:
                s.z[m] = 0.0
            s.use[m] = 1
    if s.kind == LOCAL:
        return
    for j in range(s.n - 1):
        if s.valid[j] == 0 or s.valid[j + 1] == 0:
            continue
        m = joints + j
        a, b = j * axes + flex, (j + 1) * axes + flex
        gyr = s.theta_g[j, flex] - s.theta_g[j + 1, flex]
        predicted = s.x[2 * a] - s.x[2 * b]
        if s.kind == GLOBAL:
            if s.usable[j] == 1 and s.usable[j + 1] == 1:
                s.z[m] = near(s.theta_a[j, flex] - s.theta_a[j + 1, flex] - gyr, predicted)
            elif s.unusable == DROP:
                continue
            elif s.unusable == ZERO:
                s.z[m] = 0.0
            s.use[m] = 1
        elif s.kind == ONE:
            if math.isfinite(s.enc[j]):
                s.z[m] = near(s.enc[j] - gyr, predicted)
                if abs(s.z[m] - (s.enc[j] - gyr)) > 1.0:
                    s.jumped_turns += 1
                s.use[m] = 1
        elif s.alpha_on == 1:
            s.z[m] = near(s.alpha - gyr, predicted)
            s.r[m] = s.r_self[1] if s.jump == s.n else s.r_self[0]
            s.use[m] = 1


@compiled
def correct(s: Any) -> None:
    """Take the rows into x and P; fill ν (before any of them) and K (of all together)."""
    axes, flex = s.axes, s.flex if s.axes == 3 else 0
    n, joints = 2 * s.n * axes, s.n * axes
    rows = joints + s.n - 1
    for m in range(rows):
        s.nu[m] = 0.0
        if s.use[m] == 1:
            up = 2 * m if m < joints else 2 * ((m - joints) * axes + flex)
            s.nu[m] = s.z[m] - s.x[up]
            if m >= joints:
                s.nu[m] += s.x[up + 2 * axes]
    for m in range(rows):
        if s.use[m] == 0:
            continue
        joint = m >= joints
        up = 2 * ((m - joints) * axes + flex) if joint else 2 * m
        low = up + 2 * axes if joint else up
        for a in range(n):
            s.Ph[a] = s.P[a, up] - s.P[a, low] if joint else s.P[a, up]
        total = (s.Ph[up] - s.Ph[low] if joint else s.Ph[up]) + s.r[m]
        e = s.z[m] - (s.x[up] - s.x[low] if joint else s.x[up])
        for a in range(n):
            s.gain[a] = s.Ph[a] / total
            s.x[a] += s.gain[a] * e
        for a in range(n):
            for b in range(a, n):
                p = s.P[a, b] - s.gain[a] * s.Ph[b] - s.Ph[a] * s.gain[b] + s.gain[a] * total * s.gain[b]
                s.P[a, b] = p
                s.P[b, a] = p
    for m in range(rows):
        joint = m >= joints
        up = 2 * ((m - joints) * axes + flex) if joint else 2 * m
        for a in range(n):
            k = 0.0
            if s.use[m] == 1:
                k = (s.P[a, up] - s.P[a, up + 2 * axes] if joint else s.P[a, up]) / s.r[m]
            s.K[a, m] = k


@compiled
def align_mounts(s: Any) -> None:
    """Turn both mountings to the identified axes and their long axes."""
    k = s.flex
    up = 2
    for i in range(2):
        dot, size = 0.0, 0.0
        for m in range(3):
            dot += s.up[i, m] * s.axis[i, m]
        for m in range(3):
            s.mount[i, k, m] = s.axis[i, m]
            s.mount[i, up, m] = s.up[i, m] - dot * s.axis[i, m]
            size += s.mount[i, up, m] ** 2
        size = math.sqrt(size)
        for m in range(3):
            s.mount[i, up, m] /= size
        # Right-handed: the third row is up × flexion with the sign of the order of axes.
        o = 1 - k
        a, b = (2, 0) if k == 0 else (1, 2)
        for m in range(3):
            p, q = (m + 1) % 3, (m + 2) % 3
            s.mount[i, o, m] = s.mount[i, a, p] * s.mount[i, b, q] - s.mount[i, a, q] * s.mount[i, b, p]


@compiled
def step(s: Any) -> bool:
    """Filter the sample given out; False before every segment was seen once."""
    for i in range(s.n):
        if s.valid[i] == 1:
            measure(s, i)
    if s.on_line == 0:
        for i in range(s.n):
            if s.valid[i] == 0:
                return False
        s.on_line = 1
        for i in range(s.n):
            restart(s, i)
        if s.kind == SELF:
            begin_alpha(s)
        return True
    if s.kind == SELF:
        begin_alpha(s)
    for i in range(s.n):
        if s.valid[i] == 1 and s.gap[i] > 0.0:
            restart(s, i)
        elif s.valid[i] == 1:
            integrate(s, i)
    predict(s)
    if s.average > 0.0:
        for i in range(s.n):
            if s.valid[i] == 1:
                average(s, i)
    select(s)
    form(s)
    correct(s)
    used = 0
    for m in range(s.n * s.axes):
        used += s.use[m]
    s.blind += 1 if used == 0 else 0
    s.steps += 1
    return True


@compiled
def begin_alpha(s: Any) -> None:
    """Carry the self-aligned angle; it begins anew where a sensor was lost."""
    if s.learn > 0 and selfaligned.watch(s) and s.known == 1:
        align_mounts(s)
        s.aP[0, 0] += 0.01  # the angle about the new axes may differ by some degrees
    if s.valid[0] == 0 or s.valid[1] == 0 or s.known == 0:
        s.alpha_on = 0
        return
    if s.gap[0] > 0.0 or s.gap[1] > 0.0:
        s.alpha_on = 0
    selfaligned.joint_angle(s)
