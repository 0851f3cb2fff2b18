"""Offline smoother over the fifteen-state zero-velocity filter: every sample knows the whole walk."""

from __future__ import annotations

import math
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from ..contract import AlgorithmError, FloatArray
from ..numerics import kalman, strapdown
from ..numerics.compiled import compiled
from ..numerics.records import kernel_view, record_type
from ..numerics.rotations import quat_of, set_quat, turn_nav
from . import core
from . import iez15_zaru as base
from .estimator import FootEstimator
from .iez9 import rolling_velocity, stance_variance
from .iez15_zaru import ATT, BIAS_ACC, BIAS_GYR, POS, VEL, N
from .parameters import with_parts

SEGMENT = 4096
"""Samples whose covariances are held at once; the forward pass is run again segment by segment, backwards."""

NOT_STARTED, START, NAVIGATED = 0, 1, 2
MOST_UPDATES = 6
ROUNDING = 1e-9
"""Share of a variance by which its root's square differs: more is what the filter considers, beside P."""

LOG = record_type(
    ("stage", "i8"),
    ("dt", "f8"),
    ("force", "f8", (3,)),
    ("rot", "f8", (3, 3)),  # rot_nb at the prediction
    ("n_updates", "i8"),
    ("index", "i8", (MOST_UPDATES,)),  # error state that each update measured
    ("residual", "f8", (MOST_UPDATES,)),
    ("variance", "f8", (MOST_UPDATES,)),  # of the innovation
    ("gain", "f8", (MOST_UPDATES, N)),
    ("P", "f8", (N, N)),  # covariance after the updates
)
"""What the backward pass must know of a sample."""

FootRtsParams = with_parts(base.Foot15IezZaruParams, "FootRtsParams", __name__)


@compiled
def _update(s: Any, log: Any, index: int, error: float, variance: float) -> None:
    k = log.n_updates
    log.n_updates += 1
    log.index[k] = index
    log.residual[k] = error - s.dx[index]
    log.variance[k] = s.P[index, index] + variance
    kalman.update(s, index, error, variance, 0)
    for i in range(N):
        log.gain[k, i] = s.gain[i]


@compiled
def _correct(s: Any, r: Any, log: Any) -> None:
    """Do what :func:`.iez15_zaru.correct` does, and note every update."""
    kalman.clear(s.dx)
    rolling_velocity(s, r, s.stance_vel)
    variance = stance_variance(s, r.dt)
    core.judge_innovation(s, r, VEL, variance)
    for i in range(3):
        _update(s, log, VEL + i, s.vel[i] - s.stance_vel[i], variance)
    if core.at_rest(s, r, s.zaru_after, s.zaru_rate):
        for i in range(3):
            _update(s, log, BIAS_GYR + i, s.bias_gyr[i] - r.gyr[i], s.r_zaru)
    base.feed_back(s)


@compiled
def _navigate(s: Any, ring: Any, out: FloatArray, log: Any) -> None:
    r = core.release(s, ring)
    log.stage = NOT_STARTED
    log.n_updates = 0
    if core.starts(s, r):
        log.stage = START
        base.believe_rest(s)
    elif s.started:
        log.stage = NAVIGATED
        strapdown.advance(s, r)
        log.dt = r.dt
        for i in range(3):
            log.force[i] = s.force[i]
            for j in range(3):
                log.rot[i, j] = s.rot[i, j]
        base.predict(s, r)
        if r.still:
            _correct(s, r, log)
    for i in range(N):
        for j in range(N):
            log.P[i, j] = s.P[i, j]
    core.emit(s, r, out)
    core.emit_sigma(s, POS, VEL, ATT, out)
    core.emit_detector(r, core.AFTER_SIGMA, out)


@compiled
def forward(state: Any, ring: Any, rows: FloatArray, out: FloatArray, logs: Any) -> int:
    """Filter until ``out`` is full or the rows have ended; note each sample in ``logs``; return how many."""
    s = state[0]
    done = 0
    while done < out.shape[0]:
        k = s.taken
        if k < rows.shape[0]:
            if not core.take(s, ring, rows[k]):
                continue
        elif not core.take_end(s, ring):
            break
        _navigate(s, ring, out[done], logs[done])
        done += 1
    return done


@compiled
def _step_back(a: FloatArray, log: Any) -> None:
    """Multiply the vector ``a`` (n) by Fᵀ of the sample in ``log``, in place."""
    dt = log.dt
    x, y, z = log.force[0] * dt, log.force[1] * dt, log.force[2] * dt
    u, v, w = a[VEL], a[VEL + 1], a[VEL + 2]
    for i in range(3):
        turned, pushed = 0.0, 0.0
        for j in range(3):
            turned += log.rot[j, i] * a[ATT + j]
            pushed += log.rot[j, i] * a[VEL + j]
        a[BIAS_GYR + i] -= dt * turned
        a[BIAS_ACC + i] -= dt * pushed
    for i in range(3):
        a[VEL + i] += dt * a[POS + i]
    a[ATT] += y * w - z * v
    a[ATT + 1] += z * u - x * w
    a[ATT + 2] += x * v - y * u


@compiled
def backward(
    logs: Any,
    out: FloatArray,
    adjoint: FloatArray,
    information: FloatArray,
    gain: FloatArray,
    shift: FloatArray,
    left: FloatArray,
    rot: FloatArray,
) -> None:
    """Smooth the samples of ``logs`` and write them over the filter's pose, velocity and sigma in ``out``.

    ``adjoint`` (n) and ``information`` (n, n) are λ and Λ of Bierman 1973, zero at the end of the walk, and
    are carried from segment to segment; the last four are work space: (n), (n), (n, n), (3, 3).
    """
    for k in range(logs.shape[0] - 1, -1, -1):
        log = logs[k]
        if log.stage == NOT_STARTED:
            continue
        for i in range(N):
            shift[i] = 0.0
            for j in range(N):
                shift[i] -= log.P[i, j] * adjoint[j]
        q = core.POSE + 3
        set_quat(rot, out[k, q], out[k, q + 1], out[k, q + 2], out[k, q + 3])
        turn_nav(rot, shift[ATT], shift[ATT + 1], shift[ATT + 2])
        out[k, q], out[k, q + 1], out[k, q + 2], out[k, q + 3] = quat_of(rot)
        for i in range(3):
            out[k, core.POSE + i] += shift[POS + i]
            out[k, core.VELOCITY + i] += shift[VEL + i]
        for i in range(N):
            for j in range(N):
                total = 0.0
                for m in range(N):
                    total += log.P[i, m] * information[m, j]
                left[i, j] = total
        for block in range(3):
            first = POS if block == 0 else VEL if block == 1 else ATT
            for i in range(first, first + 3):
                variance = log.P[i, i]
                considered = out[k, core.SIGMA + 3 * block + i - first] ** 2 - variance
                if considered > ROUNDING * variance:
                    variance += considered
                for m in range(N):
                    variance -= left[i, m] * log.P[m, i]
                out[k, core.SIGMA + 3 * block + i - first] = math.sqrt(max(0.0, variance))
        for u in range(log.n_updates - 1, -1, -1):
            index = log.index[u]
            residual = log.residual[u] / log.variance[u]
            for i in range(N):
                gain[i] = log.gain[u, i]
                residual -= gain[i] * adjoint[i]
            adjoint[index] += residual
            # Λ ← (I − K hᵀ)ᵀ Λ (I − K hᵀ) + h hᵀ / variance, h = e_index
            square = 0.0
            for i in range(N):
                shift[i] = 0.0
                for j in range(N):
                    shift[i] += information[i, j] * gain[j]
            for i in range(N):
                square += gain[i] * shift[i]
            for i in range(N):
                information[i, index] -= shift[i]
                information[index, i] -= shift[i]
            information[index, index] += square + 1.0 / log.variance[u]
        if log.stage == NAVIGATED:
            _step_back(adjoint, log)
            for j in range(N):
                _step_back(information[:, j], log)
            for i in range(N):
                _step_back(information[i], log)


@compiled
def steps_again(state: Any, ring: Any, rows: FloatArray, out: FloatArray) -> None:
    """Find the steps anew on the smoothed track; ``state`` is a fresh one."""
    s = state[0]
    r = ring[0]
    for k in range(rows.shape[0]):
        if not math.isfinite(out[k, core.POSE]):
            continue
        if not s.started:
            s.started = True
            s.steps.was_still = True
        r.dt = rows[k, 0]
        r.still = out[k, core.STILL] > 0.5
        for i in range(3):
            s.pos[i] = out[k, core.POSE + i]
            s.vel[i] = out[k, core.VELOCITY + i]
        q = core.POSE + 3
        set_quat(s.rot, out[k, q], out[k, q + 1], out[k, q + 2], out[k, q + 3])
        core.emit(s, r, out[k])


class FootRts(FootEstimator):
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
    Params = FootRtsParams
    presets: ClassVar[dict[str, dict[str, Any]]] = base.Foot15IezZaru.presets
    RECORD = base.RECORD

    def __init__(self, params: Any = None) -> None:
        super().__init__(params)
        self._fresh = self.state.copy()
        self.latency = 0  # everything is known at once, at the end

    def configure(self, record: Any, params: Any) -> None:
        """Write the constants of ``foot.15iez-zaru`` into the state."""
        base.configure(record, params)

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
        logs = kernel_view(
            np.zeros(min(segment, max(n, 1)) * LOG.itemsize, np.uint8), LOG, 0, min(segment, max(n, 1))
        )
        state = self._fresh.copy()
        kept: list[NDArray[np.uint8]] = []
        for first in range(0, n, segment):
            kept.append(state.copy())
            forward(*self.views(state), rows, out[first : first + segment], logs)
        self.state[:] = state
        work = np.zeros(N), np.zeros(N), np.zeros((N, N)), np.zeros((3, 3))
        adjoint, information = np.zeros(N), np.zeros((N, N))
        for first, snapshot in zip(range(0, n, segment)[::-1], kept[::-1], strict=True):
            piece = out[first : first + segment]
            count = forward(*self.views(snapshot), rows, piece, logs)
            backward(logs[:count], piece, adjoint, information, *work)
        steps_again(*self.views(self._fresh.copy()), rows, out)
        return out
