"""The filters of the dissertation in plain NumPy matrices, written from the equations and not from the
kernels.
"""

from __future__ import annotations

import numpy as np


def skew(v: np.ndarray) -> np.ndarray:
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def pade(v: np.ndarray) -> np.ndarray:
    return (2 * np.eye(3) + skew(v)) @ np.linalg.inv(2 * np.eye(3) - skew(v))


def level(f: np.ndarray) -> np.ndarray:
    roll, pitch = np.arctan2(f[1], f[2]), np.arctan2(-f[0], np.hypot(f[1], f[2]))
    ry = np.array([[np.cos(pitch), 0, np.sin(pitch)], [0, 1, 0], [-np.sin(pitch), 0, np.cos(pitch)]])
    rx = np.array([[1, 0, 0], [0, np.cos(roll), -np.sin(roll)], [0, np.sin(roll), np.cos(roll)]])
    return ry @ rx


class Mechanization:
    """State after a rest; ``step`` carries it over one sample by the trapezoidal rule or by Euler's."""

    def __init__(self, rest: np.ndarray, gravity: float = 9.81, trapezoid: bool = True) -> None:
        self.bias_gyr, self.bias_acc = rest[3:].copy(), np.zeros(3)
        self.c = level(rest[:3])
        self.v, self.p = np.zeros(3), np.zeros(3)
        self.g = np.array([0, 0, gravity])
        self.f_n = self.c @ rest[:3]
        self.a = self.f_n - self.g
        self.trapezoid = trapezoid

    def step(self, row: np.ndarray) -> None:
        dt, f, w = row[0], row[1:4] - self.bias_acc, row[4:7] - self.bias_gyr
        old = self.c
        self.c = old @ pade(w * dt)
        self.f_n = (0.5 * (old + self.c) if self.trapezoid else self.c) @ f
        a = self.f_n - self.g
        v = self.v
        self.v = v + (0.5 * (self.a + a) if self.trapezoid else a) * dt
        self.p = self.p + (0.5 * (v + self.v) if self.trapezoid else self.v) * dt
        self.a = a


def transition9(f_n: np.ndarray, dt: float) -> np.ndarray:
    f = np.eye(9)
    f[3:6, 6:9] = np.eye(3) * dt
    f[6:9, 0:3] = -skew(f_n) * dt
    return f


def transition15(f_n: np.ndarray, c: np.ndarray, dt: float) -> np.ndarray:
    f = np.eye(15)
    f[0:3, 3:6] = -c * dt
    f[6:9, 9:12] = np.eye(3) * dt
    f[9:12, 0:3] = -skew(f_n) * dt
    f[9:12, 12:15] = -c * dt
    return f


def joseph(p: np.ndarray, h: np.ndarray, r: np.ndarray, considered: int = 0) -> tuple[np.ndarray, np.ndarray]:
    k = p @ h.T @ np.linalg.inv(h @ p @ h.T + r)
    k[:considered] = 0
    i = np.eye(len(p)) - k @ h
    p = i @ p @ i.T + k @ r @ k.T
    return k, 0.5 * (p + p.T)


def turned(c: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Take the attitude error out: (2I − [δφ]×)(2I + [δφ]×)⁻¹ C, made orthonormal."""
    u, _, vt = np.linalg.svd(pade(-error) @ c)
    return u @ vt


def filter9(
    rows: np.ndarray, still: np.ndarray, first: int, gyr: float = 0.01, acc: float = 0.1, vel: float = 0.01
) -> np.ndarray:
    """Return position, velocity, sigmas (pos, vel, att) and rotation from sample ``first`` on."""
    m = Mechanization(rows[: first + 1, 1:7].mean(axis=0))
    p = np.zeros((9, 9))
    h = np.hstack([np.zeros((3, 6)), np.eye(3)])
    out = [_state(m, p, 3, 6)]
    for row, zero in zip(rows[first + 1 :], still[first + 1 :], strict=True):
        m.step(row)
        dt = row[0]
        f = transition9(m.f_n, dt)
        p = f @ p @ f.T + np.diag([gyr**2] * 3 + [0] * 3 + [acc**2] * 3) * dt**2
        if zero:
            k, p = joseph(p, h, np.eye(3) * vel**2)
            dx = k @ m.v
            m.p, m.v, m.c = m.p - dx[3:6], m.v - dx[6:9], turned(m.c, dx[0:3])
        out.append(_state(m, p, 3, 6))
    return np.array(out)


def filter15(
    rows: np.ndarray,
    still: np.ndarray,
    first: int,
    *,
    gyr: float = 0.01,
    acc: float = 0.1,
    vel: float = 0.01,
    bias_gyr: float,
    bias_acc: float,
    walk_gyr: float,
    walk_acc: float,
    zaru: float,
    after_s: float,
    rate: float,
) -> np.ndarray:
    """Return the same columns as :func:`filter9`."""
    m = Mechanization(rows[: first + 1, 1:7].mean(axis=0))
    p = np.diag([0.0] * 3 + [bias_gyr**2] * 3 + [0.0] * 6 + [bias_acc**2] * 3)
    stance = 0.0
    h_v = np.zeros((3, 15))
    h_v[:, 9:12] = np.eye(3)
    h_w = np.zeros((3, 15))
    h_w[:, 3:6] = np.eye(3)
    out = [_state(m, p, 6, 9)]
    for i, (row, zero) in enumerate(zip(rows, still, strict=True)):
        stance = stance + row[0] if zero else 0.0
        if i <= first:
            continue
        m.step(row)
        dt = row[0]
        f = transition15(m.f_n, m.c, dt)
        q = np.array([gyr**2 * dt**2] * 3 + [walk_gyr**2 * dt] * 3 + [0.0] * 3)
        p = f @ p @ f.T + np.diag([*q, *[acc**2 * dt**2] * 3, *[walk_acc**2 * dt] * 3])
        if zero:
            h, z, r = h_v, m.v, [vel**2] * 3
            if stance >= after_s and np.linalg.norm(row[4:7] - m.bias_gyr) < rate:
                h, r = np.vstack([h_v, h_w]), [vel**2] * 3 + [zaru**2] * 3
                z = np.concatenate([m.v, m.bias_gyr - row[4:7]])
            k, p = joseph(p, h, np.diag(r))
            dx = k @ z
            m.c = turned(m.c, dx[0:3])
            m.bias_gyr, m.bias_acc = m.bias_gyr - dx[3:6], m.bias_acc - dx[12:15]
            m.p, m.v = m.p - dx[6:9], m.v - dx[9:12]
        out.append(_state(m, p, 6, 9))
    return np.array(out)


def _state(m: Mechanization, p: np.ndarray, pos: int, vel: int) -> np.ndarray:
    sd = np.sqrt(np.diag(p))
    return np.concatenate([m.p, m.v, sd[pos : pos + 3], sd[vel : vel + 3], sd[:3], m.c.ravel()])


def madgwick(q: np.ndarray, f: np.ndarray, w: np.ndarray, dt: float, beta: float) -> np.ndarray:
    """One step of Madgwick 2010 for IMU, published matrices: f_g (25), J_g (26), gradient Jᵀf (34)."""
    q1, q2, q3, q4 = q
    ax, ay, az = f / np.linalg.norm(f)
    objective = np.array(
        [2 * (q2 * q4 - q1 * q3) - ax, 2 * (q1 * q2 + q3 * q4) - ay, 2 * (0.5 - q2**2 - q3**2) - az]
    )
    jacobian = np.array(
        [
            [-2 * q3, 2 * q4, -2 * q1, 2 * q2],
            [2 * q2, 2 * q1, 2 * q4, 2 * q3],
            [0, -4 * q2, -4 * q3, 0],
        ]
    )
    gradient = jacobian.T @ objective
    wx, wy, wz = w
    omega = np.array([[0, -wx, -wy, -wz], [wx, 0, wz, -wy], [wy, -wz, 0, wx], [wz, wy, -wx, 0]])
    rate = 0.5 * omega @ q
    norm = np.linalg.norm(gradient)
    if norm > 0:
        rate = rate - beta * gradient / norm
    q = q + rate * dt
    return q / np.linalg.norm(q)
