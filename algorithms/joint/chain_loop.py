"""Messages through the filter of a chain (:mod:`.chain`), and what it gives out."""

from __future__ import annotations

import math
from typing import Any

from ..contract import FloatArray, IntArray
from ..numerics.compiled import compiled
from . import merge
from .chain import FREE, HINGE, measure_angles, step
from .chain_zero import angle_unknown, set_zero, stated_sd


@compiled
def quaternion(r: FloatArray, out: FloatArray, column: int) -> None:
    """Write the quaternion (wxyz, w ≥ 0) of a rotation; Shepperd's method."""
    a, b, c = r[0, 0], r[1, 1], r[2, 2]
    trace = a + b + c
    if trace > a and trace > b and trace > c:
        w, x, y, z = 1.0 + trace, r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
    elif a > b and a > c:
        w, x, y, z = r[2, 1] - r[1, 2], 1.0 + a - b - c, r[0, 1] + r[1, 0], r[0, 2] + r[2, 0]
    elif b > c:
        w, x, y, z = r[0, 2] - r[2, 0], r[0, 1] + r[1, 0], 1.0 - a + b - c, r[1, 2] + r[2, 1]
    else:
        w, x, y, z = r[1, 0] - r[0, 1], r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], 1.0 - a - b + c
    k = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)
    k = -k if w < 0.0 else k
    out[column], out[column + 1], out[column + 2], out[column + 3] = w * k, x * k, y * k, z * k


@compiled
def emit(s: Any, out: FloatArray) -> None:
    """Write: orientations, joint angles, standard deviations, biases, axes of the first joint."""
    for c in range(out.shape[0]):
        out[c] = math.nan
    measure_angles(s)
    set_zero(s)
    column = 0
    for i in range(s.n):
        if s.valid[i] == 1:
            quaternion(s.rot[i], out, column)
        column += 4
    defined = not angle_unknown(s)
    if defined and s.begin_ns == 0:
        s.begin_ns = s.now
    for j in range(s.n - 1):
        both = defined and s.valid[j] == 1 and s.valid[j + 1] == 1
        for k in range(1 if s.type[j] == HINGE else 3):
            if both:
                out[column] = s.angle[j, k]
                if k == 0:
                    out[column] -= s.zero_sum[j] / max(1, s.zero_count[j])
            column += 1
    for j in range(s.n - 1):
        if defined and s.valid[j] == 1 and s.valid[j + 1] == 1:
            out[column] = stated_sd(s, j)
        column += 1
    for i in range(s.n):
        if s.valid[i] == 1:
            out[column] = math.sqrt(max(0.0, 0.5 * (s.P[6 * i, 6 * i] + s.P[6 * i + 1, 6 * i + 1])))
        column += 1
    for i in range(s.n):
        for k in range(3):
            if s.valid[i] == 1:
                out[column] = s.bias[i, k]
            column += 1
    for j in range(s.n - 1):
        for i in range(2):
            for m in range(3):
                out[column] = s.j[j, i, m] if s.type[j] != FREE else math.nan
                column += 1


@compiled
def drain(s: Any, out: FloatArray) -> bool:
    """Filter the next sample that is due, if any; write its results."""
    while merge.advance(s):
        if step(s):
            emit(s, out)
            return True
    return False


@compiled
def run(
    state: Any,
    inputs: IntArray,
    channels: IntArray,
    t_ns: IntArray,
    values: FloatArray,
    out_message: IntArray,
    out_t_ns: IntArray,
    out_values: FloatArray,
) -> int:
    """Take merged messages; see :class:`..contract.KernelEstimator`."""
    s = state[0]
    count = 0
    for m in range(t_ns.shape[0]):
        merge.push(s, inputs[m], t_ns[m], values[m])
        for _ in range(2):
            if not drain(s, out_values[count]):
                break
            out_message[count] = m
            out_t_ns[count] = s.now
            count += 1
    return count


@compiled
def run_end(state: Any, out_t_ns: IntArray, out_values: FloatArray) -> int:
    """Give what is held back."""
    s = state[0]
    s.ending = 1
    count = 0
    while count < out_t_ns.shape[0] and drain(s, out_values[count]):
        out_t_ns[count] = s.now
        count += 1
    return count
