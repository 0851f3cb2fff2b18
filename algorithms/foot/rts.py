"""Offline smoother over the fifteen-state zero-velocity filter: every sample knows the whole walk."""

from __future__ import annotations

import math
from typing import Any, ClassVar

import numpy as np
from numba import njit

from ..contract import AlgorithmError, FloatArray
from ..numerics import kalman
from ..numerics.compiled import compiled
from ..numerics.rotations import quat_from_rot, rot_from_quat, turn_nav
from . import common as foot
from . import iez15_zaru as base
from . import layout as la
from . import strapdown
from .iez15_zaru import (
    ATT,
    BACC,
    BGYR,
    DX,
    WORK,
    XPOS,
    XVEL,
    N,
    P,
)
from .layout import (
    ACC_N,
    BIAS_GYR,
    O_POSE,
    O_REST,
    O_STILL,
    O_VEL,
    POS,
    R_DT,
    R_GYR,
    R_STILL,
    ROT,
    STARTED,
    STEP_WAS_STILL,
    TAKEN,
    VEL,
)

SEGMENT = 4096
"""Samples whose covariances are held at once; the forward pass is run again segment by segment, backwards."""

# What the backward pass must know of a sample
_take = la.Allocator()
L_ACTIVE = _take()  # 0 not started, 1 the start itself, 2 navigated
L_DT = _take()
L_FORCE = _take(3)
L_ROT_PRIOR = _take(9)  # rot_nb at the prediction
L_UPDATES = _take()
L_UPDATE = _take(6 * (3 + N))  # each: error state, innovation, its variance, gain
L_P = _take(N * N)  # covariance after the updates
LOG = _take.size


@compiled
def _update(s: FloatArray, log: FloatArray, index: int, seen: float, variance: float) -> None:
    at = L_UPDATE + int(log[L_UPDATES]) * (3 + N)
    log[L_UPDATES] += 1.0
    log[at] = index
    log[at + 1] = seen - s[DX + index]
    log[at + 2] = s[P + index * (N + 1)] + variance
    kalman.update(s, P, N, DX, WORK, index, seen, variance, 0)
    for i in range(N):
        log[at + 3 + i] = s[WORK + i]


@compiled
def _correct(s: FloatArray, r: int, log: FloatArray) -> None:
    """Do what :func:`.foot_15iez_zaru.correct` does, and note every update."""
    kalman.clear(s, DX, N)
    for i in range(3):
        _update(s, log, XVEL + i, s[VEL + i], s[base.R_VEL])
    if foot.at_rest(s, r, s[base.ZARU_AFTER], s[base.ZARU_RATE]):
        for i in range(3):
            _update(s, log, BGYR + i, s[BIAS_GYR + i] - s[r + R_GYR + i], s[base.R_ZARU])
    base.feed_back(s)


@compiled
def _navigate(s: FloatArray, out: FloatArray, log: FloatArray) -> None:
    r = foot.release(s)
    log[L_ACTIVE] = 0.0
    log[L_UPDATES] = 0.0
    if foot.starts(s):
        log[L_ACTIVE] = 1.0
    elif s[STARTED] > 0.5:
        log[L_ACTIVE] = 2.0
        strapdown.advance(s, r)
        log[L_DT] = s[r + R_DT]
        for i in range(3):
            log[L_FORCE + i] = s[ACC_N + i]
        for i in range(9):
            log[L_ROT_PRIOR + i] = s[ROT + i]
        base.predict(s, s[r + R_DT])
        if s[r + R_STILL] > 0.5:
            _correct(s, r, log)
    for i in range(N * N):
        log[L_P + i] = s[P + i]
    foot.emit(s, r, out)
    foot.emit_sigma(s, P, N, XPOS, XVEL, ATT, out)
    foot.emit_detector(s, r, base.base.FIRST_DETECTOR, out)


@compiled
def forward(s: FloatArray, rows: FloatArray, out: FloatArray, logs: FloatArray) -> int:
    """Filter until ``out`` is full or the rows have ended; note each sample in ``logs``; return how many."""
    done = 0
    while done < out.shape[0]:
        k = int(s[TAKEN])
        if k < rows.shape[0]:
            if not foot.take(s, rows[k]):
                continue
        elif not foot.take_end(s):
            break
        _navigate(s, out[done], logs[done])
        done += 1
    return done


@compiled
def _step_back(a: FloatArray, at: int, stride: int, log: FloatArray) -> None:
    """Multiply the vector at ``a[at + i stride]`` by Fᵀ of the sample in ``log``, in place."""
    dt = log[L_DT]
    x, y, z = log[L_FORCE] * dt, log[L_FORCE + 1] * dt, log[L_FORCE + 2] * dt
    att, vel = at + ATT * stride, at + XVEL * stride
    pos, bgyr, bacc = at + XPOS * stride, at + BGYR * stride, at + BACC * stride
    u, v, w = a[vel], a[vel + stride], a[vel + 2 * stride]
    for i in range(3):
        turned, pushed = 0.0, 0.0
        for j in range(3):
            turned += log[L_ROT_PRIOR + 3 * j + i] * a[att + j * stride]
            pushed += log[L_ROT_PRIOR + 3 * j + i] * a[vel + j * stride]
        a[bgyr + i * stride] -= dt * turned
        a[bacc + i * stride] -= dt * pushed
    for i in range(3):
        a[vel + i * stride] += dt * a[pos + i * stride]
    a[att] += y * w - z * v
    a[att + stride] += z * u - x * w
    a[att + 2 * stride] += x * v - y * u


@njit(cache=True, nogil=True)
def backward(logs: FloatArray, out: FloatArray, adjoint: FloatArray, information: FloatArray) -> None:
    """Smooth the samples of ``logs`` and write them over the filter's pose, velocity and sigma in ``out``.

    ``adjoint`` (15) and ``information`` (225) are λ and Λ of Bierman 1973, zero at the end of the walk, and
    are carried from segment to segment.
    """
    gain = np.empty(N)
    shift = np.empty(N)
    left = np.empty(N * N)
    rot = np.empty(9)
    for k in range(logs.shape[0] - 1, -1, -1):
        log = logs[k]
        if log[L_ACTIVE] == 0.0:
            continue
        for i in range(N):
            shift[i] = 0.0
            for j in range(N):
                shift[i] -= log[L_P + i * N + j] * adjoint[j]
        rot_from_quat(out[k], O_POSE + 3, rot, 0)
        turn_nav(rot, 0, shift[ATT], shift[ATT + 1], shift[ATT + 2])
        quat_from_rot(rot, 0, out[k], O_POSE + 3)
        for i in range(3):
            out[k, O_POSE + i] += shift[XPOS + i]
            out[k, O_VEL + i] += shift[XVEL + i]
        for i in range(N):
            for j in range(N):
                total = 0.0
                for m in range(N):
                    total += log[L_P + i * N + m] * information[m * N + j]
                left[i * N + j] = total
        for block in range(3):
            first = XPOS if block == 0 else XVEL if block == 1 else ATT
            for i in range(first, first + 3):
                variance = log[L_P + i * (N + 1)]
                for m in range(N):
                    variance -= left[i * N + m] * log[L_P + m * N + i]
                out[k, O_REST + 3 * block + i - first] = math.sqrt(max(0.0, variance))
        for u in range(int(log[L_UPDATES]) - 1, -1, -1):
            at = L_UPDATE + u * (3 + N)
            index = int(log[at])
            seen = log[at + 1] / log[at + 2]
            for i in range(N):
                gain[i] = log[at + 3 + i]
                seen -= gain[i] * adjoint[i]
            adjoint[index] += seen
            # Λ ← (I − K hᵀ)ᵀ Λ (I − K hᵀ) + h hᵀ / total, h = e_index
            square = 0.0
            for i in range(N):
                left[i] = 0.0
                for j in range(N):
                    left[i] += information[i * N + j] * gain[j]
            for i in range(N):
                square += gain[i] * left[i]
            for i in range(N):
                information[i * N + index] -= left[i]
                information[index * N + i] -= left[i]
            information[index * (N + 1)] += square + 1.0 / log[at + 2]
        if log[L_ACTIVE] > 1.5:
            _step_back(adjoint, 0, 1, log)
            for j in range(N):
                _step_back(information, j, N, log)
            for i in range(N):
                _step_back(information, i * N, 1, log)


@compiled
def steps_again(s: FloatArray, rows: FloatArray, out: FloatArray) -> None:
    """Find the steps anew on the smoothed track; ``s`` is a fresh state."""
    r = int(s[la.RING])
    for k in range(rows.shape[0]):
        if not math.isfinite(out[k, O_POSE]):
            continue
        if s[STARTED] < 0.5:
            s[STARTED] = 1.0
            s[STEP_WAS_STILL] = 1.0
        s[r + R_DT] = rows[k, 0]
        s[r + R_STILL] = out[k, O_STILL]
        for i in range(3):
            s[POS + i] = out[k, O_POSE + i]
            s[VEL + i] = out[k, O_VEL + i]
        rot_from_quat(out[k], O_POSE + 3, s, ROT)
        foot.emit(s, r, out[k])


class FootRts(foot.FootEstimator):
    """Fixed-interval smoother over ``foot.15iez-zaru``: offline, for records, not for live use.

    Source: the Rauch–Tung–Striebel smoother (1965) in the form of Bierman 1973, "Fixed interval smoothing
    with discrete measurements" (modified Bryson–Frazier), which needs no inverse of P: P is singular at the
    start. For zero-velocity-aided navigation see Colomar, Nilsson, Händel 2012, "Smoothing for ZUPT-aided
    INSs". The filter runs forward; backwards, λ collects what later updates say of each sample's error, and
    the error P λ is taken off. Positions no longer jump at the start of a stance.

    Departures: linearized once, about the filter's own track; the segments of ``SEGMENT`` samples bound the
    memory of the covariances and change no bit.
    """

    name: ClassVar[str] = "foot.rts"
    title: ClassVar[str] = "offline smoother (RTS) over the 15-state filter"
    source: ClassVar[str] = "Rauch, Tung, Striebel 1965; Bierman 1973; Colomar et al. 2012"
    offline: ClassVar[bool] = True
    Params = base.Foot15IezZaruParams
    presets: ClassVar[dict[str, dict[str, Any]]] = base.Foot15IezZaru.presets
    state_size: ClassVar[int] = base.SIZE

    def __init__(self, params: Any = None) -> None:
        super().__init__(params)
        self._fresh = self.state.copy()
        self.latency = 0  # everything is known at once, at the end

    def configure(self, params: Any) -> None:
        """Write the constants of ``foot.15iez-zaru`` into the state."""
        base.Foot15IezZaru.configure(self, params)  # type: ignore[arg-type]

    def step(self, row: FloatArray) -> FloatArray | None:
        """Refuse: a smoother needs the whole recording."""
        raise AlgorithmError(f"{self.name} is offline: it needs the whole recording, call process(rows)")

    def flush(self) -> FloatArray:
        """Return nothing: there is nothing held back."""
        return np.empty((0, self.width))

    def process(self, rows: FloatArray, segment: int = SEGMENT) -> FloatArray:
        """Smooth a whole recording.

        Parameters
        ----------
        rows : array, shape (n, inputs)
            All rows.
        segment : int
            Samples whose covariances are held at once (3 kB each).

        Returns
        -------
        array, shape (n, outputs)
            One result a row.
        """
        rows = np.ascontiguousarray(rows, dtype=np.float64)
        n = len(rows)
        out = np.empty((n, self.width))
        logs = np.zeros((min(segment, max(n, 1)), LOG))
        state = self._fresh.copy()
        kept: list[FloatArray] = []
        for first in range(0, n, segment):
            kept.append(state.copy())
            forward(state, rows, out[first : first + segment], logs)
        self.state[:] = state
        adjoint, information = np.zeros(N), np.zeros(N * N)
        for first, snapshot in zip(range(0, n, segment)[::-1], kept[::-1], strict=True):
            piece = out[first : first + segment]
            count = forward(snapshot, rows, piece, logs)
            backward(logs[:count], piece, adjoint, information)
        steps_again(self._fresh.copy(), rows, out)
        return out
