"""Backward pass over the filter of a chain (:mod:`.chain`): Rauch, Tung and Striebel (1965) on its error states.

A sample's log holds the attitudes and biases before and after its measurements, with both covariances. Going back,

    C = P Fᵀ P⁻₊⁻¹,   δ = C (x^s₊ ⊟ x⁻₊),   P^s = P + C (P^s₊ − P⁻₊) Cᵀ,

₊ the next sample, ⁻ before its measurements, F of :func:`.chain.predict`; ⊟ of two attitudes is the rotation vector
about the navigation axes. Where a segment begins anew, or has no value, the pass begins anew too.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ..contract import FloatArray, IntArray
from ..numerics import cholesky
from ..numerics.compiled import compiled
from ..numerics.records import record_type
from . import merge
from .chain import measure_angles, step
from .chain_turn import square, turn

N = 12
"""Error states of two segments."""
PAIR = 2

LOG = record_type(
    ("t_ns", "i8"),
    ("joined", "i8"),  # whether the sample before leads here
    ("dt", "f8"),
    ("enc", "f8"),
    ("rot_before", "f8", (PAIR, 3, 3)),
    ("bias_before", "f8", (PAIR, 3)),
    ("P_before", "f8", (N, N)),
    ("rot", "f8", (PAIR, 3, 3)),
    ("bias", "f8", (PAIR, 3)),
    ("P", "f8", (N, N)),
)
WORK = record_type(
    ("on", "i8"),  # whether the next sample is known
    ("C", "f8", (N, N)),  # P Fᵀ, then the gain
    ("L", "f8", (N, N)),
    ("D", "f8", (N, N)),
    ("Ps", "f8", (N, N)),
    ("x", "f8", (N,)),
    ("rot", "f8", (PAIR, 3, 3)),  # smoothed, of the next sample
    ("bias", "f8", (PAIR, 3)),
    ("turn", "f8", (3,)),
)


@compiled
def forward(
    state: Any, inputs: IntArray, t_ns: IntArray, values: FloatArray, logs: Any, first: int
) -> tuple[int, int]:
    """Filter messages from ``first`` on until ``logs`` is full; return the next message and the samples logged.

    Behind the last message what is held back is filtered too.
    """
    s = state[0]
    count, m = 0, first
    while count < logs.shape[0]:
        while merge.advance(s):
            if step(s):
                count = note(s, logs, count)
                if count == logs.shape[0]:
                    return m, count
        if m >= t_ns.shape[0]:
            if s.ending == 1:
                break
            s.ending = 1
            continue
        merge.push(s, inputs[m], t_ns[m], values[m])
        m += 1
    return m, count


@compiled
def note(s: Any, logs: Any, count: int) -> int:
    """Write the sample to the log where both segments have a value; return the number of samples logged."""
    if s.valid[0] == 0 or s.valid[1] == 0:
        s.broken = 1
        return count
    log = logs[count]
    log.t_ns, log.dt, log.enc = s.now, s.dt, s.enc[0]
    log.joined = 1 if s.steps > 0 and s.broken == 0 and s.gap[0] <= 0.0 and s.gap[1] <= 0.0 else 0
    s.broken = 0
    for i in range(PAIR):
        for k in range(3):
            log.bias_before[i, k], log.bias[i, k] = s.bias_before[i, k], s.bias[i, k]
            for m in range(3):
                log.rot_before[i, k, m], log.rot[i, k, m] = s.rot_before[i, k, m], s.rot[i, k, m]
    for a in range(N):
        for b in range(N):
            log.P_before[a, b], log.P[a, b] = s.P_before[a, b], s.P[a, b]
    return count + 1


@compiled
def difference(a: FloatArray, b: FloatArray, out: FloatArray) -> None:
    """Write the rotation vector of a bᵀ (both sensor to navigation frame) to ``out``."""
    c00, c11, c22 = 0.0, 0.0, 0.0
    x, y, z = 0.0, 0.0, 0.0
    for k in range(3):
        c00 += a[0, k] * b[0, k]
        c11 += a[1, k] * b[1, k]
        c22 += a[2, k] * b[2, k]
        x += a[2, k] * b[1, k] - a[1, k] * b[2, k]
        y += a[0, k] * b[2, k] - a[2, k] * b[0, k]
        z += a[1, k] * b[0, k] - a[0, k] * b[1, k]
    size = math.sqrt(x * x + y * y + z * z)
    angle = math.atan2(size, c00 + c11 + c22 - 1.0)
    f = angle / size if size > 1e-12 else 0.5
    out[0], out[1], out[2] = f * x, f * y, f * z


@compiled
def gain(w: Any, log: Any, after: Any) -> bool:
    """Write C = P Fᵀ P⁻₊⁻¹ to ``w.C``."""
    for a in range(N):
        for b in range(N):
            w.C[a, b] = log.P[a, b]
            w.L[a, b] = after.P_before[a, b]
    for i in range(PAIR):
        p = 6 * i
        for a in range(N):
            for k in range(3):
                w.C[a, p + k] -= after.dt * (
                    after.rot_before[i, k, 0] * log.P[a, p + 3]
                    + after.rot_before[i, k, 1] * log.P[a, p + 4]
                    + after.rot_before[i, k, 2] * log.P[a, p + 5]
                )
    if not cholesky.factorize(w.L, N):
        return False
    for a in range(N):
        cholesky.solve(w.L, N, w.C[a])
    return True


@compiled
def backward(state: Any, logs: Any, count: int, after: Any, work: Any, out: FloatArray) -> None:
    """Smooth ``count`` logged samples from the last one back; write flexion and its sd to ``out`` (count, 2).

    ``after`` (1 log) is the sample behind the last, where ``work`` says that there is one; in the end it is the first.
    """
    s, w = state[0], work[0]
    for n in range(count - 1, -1, -1):
        log = logs[n]
        following = after[0] if n == count - 1 else logs[n + 1]
        use = w.on == 1 and following.joined == 1 and gain(w, log, following)
        if use:
            for i in range(PAIR):
                difference(w.rot[i], following.rot_before[i], w.turn)
                for k in range(3):
                    w.x[6 * i + k] = w.turn[k]
                    w.x[6 * i + 3 + k] = w.bias[i, k] - following.bias_before[i, k]
            for a in range(N):
                for b in range(N):
                    total = 0.0
                    for k in range(N):
                        total += w.C[a, k] * (w.Ps[k, b] - following.P_before[k, b])
                    w.D[a, b] = total
        for i in range(PAIR):
            for k in range(3):
                s.bias[i, k] = log.bias[i, k]
                for m in range(3):
                    s.rot[i, k, m] = log.rot[i, k, m]
        for a in range(N):
            for b in range(N):
                total = log.P[a, b]
                if use:
                    for k in range(N):
                        total += w.D[a, k] * w.C[b, k]
                s.P[a, b] = total
        if use:
            for i in range(PAIR):
                for k in range(3):
                    total, bias = 0.0, 0.0
                    for b in range(N):
                        total += w.C[6 * i + k, b] * w.x[b]
                        bias += w.C[6 * i + 3 + k, b] * w.x[b]
                    w.turn[k] = total
                    s.bias[i, k] += bias
                turn(s, i, w.turn[0], w.turn[1], w.turn[2], False)
                square(s, i)
        for i in range(PAIR):
            for k in range(3):
                w.bias[i, k] = s.bias[i, k]
                for m in range(3):
                    w.rot[i, k, m] = s.rot[i, k, m]
        for a in range(N):
            for b in range(N):
                w.Ps[a, b] = s.P[a, b]
        w.on = 1
        measure_angles(s)
        out[n, 0], out[n, 1] = s.angle[0, 0], s.angle_sd[0]
    if count > 0:
        first = logs[0]
        a0 = after[0]
        a0.joined, a0.dt = first.joined, first.dt
        for i in range(PAIR):
            for k in range(3):
                a0.bias_before[i, k] = first.bias_before[i, k]
                for m in range(3):
                    a0.rot_before[i, k, m] = first.rot_before[i, k, m]
        for a in range(N):
            for b in range(N):
                a0.P_before[a, b] = first.P_before[a, b]


def logs_of(count: int) -> np.ndarray[Any, Any]:
    """Return a log of ``count`` samples."""
    return np.zeros(count, LOG)
