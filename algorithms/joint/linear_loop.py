"""Messages through the source's filters (:mod:`.linear`), and what they give out."""

from __future__ import annotations

import math
from typing import Any

from ..contract import FloatArray, IntArray
from ..numerics.compiled import compiled
from . import merge
from .linear import SELF, step


@compiled
def share(s: Any, a: int, i: int, weighted: bool) -> float:
    """Return the part of state ``a``'s correction that comes from rows other than segment ``i``'s accelerometer."""
    own, other = 0.0, 0.0
    for m in range(s.n * s.axes + s.n - 1):
        k = abs(s.K[a, m] * s.nu[m]) if weighted else abs(s.K[a, m])
        if m < s.n * s.axes and m // s.axes == i:
            own += k
        else:
            other += k
    return other / (own + other) if own + other > 0.0 else math.nan


@compiled
def emit(s: Any, out: FloatArray) -> None:
    """Write the results in the order of :func:`..joint.source.outputs_of`."""
    axes, flex = s.axes, s.flex if s.axes == 3 else 0
    shown = axes if axes == 1 or s.yaw == 1 else 2
    joints = s.n * axes
    for c in range(out.shape[0]):
        out[c] = math.nan
    column = 0
    for j in range(s.n - 1):
        a, b = j * axes + flex, (j + 1) * axes + flex
        if s.valid[j] == 1 and s.valid[j + 1] == 1:
            out[column] = s.theta_g[j, flex] + s.x[2 * a] - s.theta_g[j + 1, flex] - s.x[2 * b]
        column += 1
    for part in range(3):  # angles, standard deviations, biases
        if part == 1:
            for j in range(s.n - 1):
                a, b = 2 * (j * axes + flex), 2 * ((j + 1) * axes + flex)
                if s.valid[j] == 1 and s.valid[j + 1] == 1:
                    out[column] = math.sqrt(max(0.0, s.P[a, a] + s.P[b, b] - 2.0 * s.P[a, b]))
                column += 1
        for i in range(s.n):
            for k in range(shown):
                a = 2 * (i * axes + k)
                if s.valid[i] == 1:
                    if part == 0:
                        out[column] = s.theta_g[i, k] + s.x[a]
                    elif part == 1:
                        out[column] = math.sqrt(max(0.0, s.P[a, a]))
                    else:
                        out[column] = -s.x[a + 1]
                column += 1
    out[column] = s.jump
    column += 1
    for i in range(s.n):
        if s.valid[i] == 1:
            out[column] = s.rho[i]
        column += 1
    for i in range(s.n):
        used = 0
        for k in range(axes):
            used = max(used, s.use[i * axes + k])
        out[column] = used
        column += 1
    for j in range(s.n - 1):
        out[column] = s.use[joints + j]
        column += 1
    for i in range(s.n):  # gains of the flexion angles
        a = 2 * (i * axes + flex)
        for h in range(s.n):
            out[column] = s.K[a, h * axes + flex]
            column += 1
        for j in range(s.n - 1):
            out[column] = s.K[a, joints + j]
            column += 1
    for i in range(s.n):
        for k in range(shown):
            a = 2 * (i * axes + k)
            out[column] = share(s, a, i, False)
            out[column + 1] = share(s, a, i, True)
            column += 2
    if s.kind == SELF:
        if s.alpha_on == 1:
            out[column], out[column + 1], out[column + 2] = s.alpha, s.alpha_acc, s.alpha_gyr
            out[column + 3] = math.sqrt(s.alpha_var)
        column += 4
        for i in range(2):
            for m in range(3):
                if s.known == 1:
                    out[column] = s.axis[i, m]
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
