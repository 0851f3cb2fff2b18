"""Offline smoother: the whole walk at once, steps and fixes before and after every instant."""

from __future__ import annotations

import itertools
import math
from typing import Any, ClassVar, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from ..contract import ALL_COLUMNS, Context, FloatArray, IntArray, Message, PlainEstimator, Remark, Result
from ..numerics.compiled import compiled
from . import geodesy
from .mixture import OTHER_SOURCE, VELOCITY_OUTLIER, VELOCITY_TAU_S
from .pdr import FIX, POSE, SIGMA, STATE, PhoneFused, PhoneFusedParams, drift_sd
from .steps import STEP
from .track import PACE_S

N = 7
"""East, north, heading correction, log scale, slow error of fixes (2), drift; as in :mod:`.mixture`."""


class WalkEvents(NamedTuple):
    """Steps and fixes of a walk in the order of time.

    Attributes
    ----------
    t_ns : ndarray
        Time of each event, (n,).
    move : ndarray
        Length (m) and heading (rad, from x to y) walked since the event before, (n, 2).
    fix : ndarray
        East, north (m) and standard deviation an axis (m); NaN at steps, (n, 3).
    velocity : ndarray
        Velocity of the receiver, east and north (m/s), NaN where it says none; that of the steps before
        correction, and its mean square (m²/s²), as :func:`.mixture.velocity` takes them, (n, 5).
    """

    t_ns: IntArray
    move: FloatArray
    fix: FloatArray
    velocity: FloatArray


class Smoothed(NamedTuple):
    """States and covariances at the events, (n, 7), (n, 7, 7); share of being an inlier of each fix, (n,)."""

    state: FloatArray
    cov: FloatArray
    inlier: FloatArray


def smooth(walk: WalkEvents, heading0: float, p: PhoneFusedParams, rounds: int = 8) -> Smoothed:
    """Return the most probable track: Gauss–Newton as iterated linear smoothers, outliers by reweighting.

    Parameters
    ----------
    walk : WalkEvents
        Steps and fixes.
    heading0 : float
        Heading correction to begin with (rad); should be right within 60°.
    p : PhoneFusedParams
        Standard deviations.
    rounds : int
        Rounds of linearization at most; it ends when no position moves by more than 1 cm.

    Notes
    -----
    Rauch, Tung and Striebel 1965; iterated: Bell 1994. The weight of a fix is its probability of being an
    inlier under the mixture of :mod:`.mixture`, at the smoothed track without it being counted twice.
    """
    n = len(walk.t_ns)
    dt = np.diff(walk.t_ns, prepend=walk.t_ns[:1]) * 1e-9
    ref = np.zeros((n, N))
    ref[:, 2] = heading0
    moved = np.zeros(2)
    has_fix = np.isfinite(walk.fix[:, 0])
    for k in range(n):
        moved += walk.move[k, 0] * np.array(
            [math.cos(walk.move[k, 1] + heading0), math.sin(walk.move[k, 1] + heading0)]
        )
        ref[k, :2] = moved
    if has_fix.any():
        ref[:, :2] += np.median(walk.fix[has_fix, :2] - ref[has_fix, :2], axis=0)
    inlier = np.where(has_fix, 1.0, 0.0)
    cov = np.zeros((n, N, N))
    for _ in range(rounds):
        state, cov = _pass(walk, dt, ref, inlier, p)
        if has_fix.any():
            inlier = _inliers(walk, state, cov, inlier, p)
        change = np.abs(state[:, :2] - ref[:, :2]).max()
        ref = state
        if change < 0.01:
            break
    return Smoothed(ref, cov, inlier)


def _pass(
    walk: WalkEvents, dt: FloatArray, ref: FloatArray, inlier: FloatArray, p: PhoneFusedParams
) -> tuple[FloatArray, FloatArray]:
    """Return one linear smoother about ``ref``."""
    n = len(dt)
    pulled = _velocity_noise(walk, ref, p)
    slow, anew = _sources(walk.fix[:, 2] * math.sqrt(p.gnss_slow_share))
    x = ref[0].copy()
    x[3:] = 0.0
    P = np.diag([1e8, 1e8, 2.0, p.sigma_scale**2, slow[0] ** 2, slow[0] ** 2, p.sigma_drift**2])
    xs, Ps = np.zeros((n, N)), np.zeros((n, N, N))
    xp, Pp, Fs = np.zeros((n, N)), np.zeros((n, N, N)), np.zeros((n, N, N))
    H = np.zeros((2, N))
    H[0, 0] = H[1, 1] = H[0, 4] = H[1, 5] = 1.0
    for k in range(n):
        F, Q, f = _model(walk.move[k], dt[k], ref[k - 1] if k else ref[0], slow[k], p)
        if anew[k]:  # another source of fixes: its slow error has nothing to do with the one before
            F[4:6], f[4:6] = 0.0, 0.0
            Q[4, 4] = Q[5, 5] = slow[k] ** 2
        if k:
            x = f + F @ (x - ref[k - 1])
            P = F @ P @ F.T + Q
        xp[k], Pp[k], Fs[k] = x, P, F
        if inlier[k] > 1e-6:
            sd = walk.fix[k, 2]
            R = np.eye(2) * (sd * sd * (1 - p.gnss_slow_share) / inlier[k])
            S = H @ P @ H.T + R
            K = np.linalg.solve(S, H @ P).T
            x = x + K @ (walk.fix[k, :2] - H @ x)
            A = np.eye(N) - K @ H
            P = A @ P @ A.T + K @ R @ K.T
        if np.isfinite(pulled[k, 0]):
            x, P = _pull(x, P, ref[k], walk.velocity[k], pulled[k])
        xs[k], Ps[k] = x, P
    for k in range(n - 2, -1, -1):
        G = np.linalg.solve(Pp[k + 1] + 1e-12 * np.eye(N), Fs[k + 1] @ Ps[k]).T
        xs[k] = xs[k] + G @ (xs[k + 1] - xp[k + 1])
        Ps[k] = Ps[k] + G @ (Ps[k + 1] - Pp[k + 1]) @ G.T
        Ps[k] = (Ps[k] + Ps[k].T) / 2
    return xs, Ps


def _velocity_noise(walk: WalkEvents, ref: FloatArray, p: PhoneFusedParams) -> FloatArray:
    """Return residual (m/s) and variance an axis of the receiver's velocities at ``ref``, (n, 3); NaN at others.

    The variance of a doubtful one is divided by its probability of being none that is wrong.
    """
    out = np.full((len(ref), 3), np.nan)
    there = np.flatnonzero(np.isfinite(walk.velocity[:, 0]))
    if not len(there):
        return out
    seen, steps = walk.velocity[there, :2], walk.velocity[there, 2:4]
    c, w, k = np.cos(ref[there, 2]), np.sin(ref[there, 2]), np.exp(ref[there, 3])
    walked = k[:, None] * np.column_stack(
        (c * steps[:, 0] - w * steps[:, 1], w * steps[:, 0] + c * steps[:, 1])
    )
    apart = np.diff(walk.t_ns[there], prepend=walk.t_ns[0] - 10**10) * 1e-9
    pace = (steps**2).sum(axis=1)
    spread = max(p.sigma_length, math.radians(p.sigma_step_deg)) ** 2
    variance = np.maximum(1.0, VELOCITY_TAU_S / np.maximum(apart, 0.1)) * p.gnss_velocity_sd**2
    variance += k**2 * (np.maximum(walk.velocity[there, 4] - pace, 0.0) + 0.5 * spread * pace)
    residual = seen - walked
    size = (residual**2).sum(axis=1)
    wide = variance + VELOCITY_OUTLIER**2
    right = (1 - p.outlier) * np.exp(-0.5 * size / variance) / variance
    wrong = p.outlier * np.exp(-0.5 * size / wide) / wide + 1e-300
    out[there] = np.column_stack((residual, variance * (right + wrong) / np.maximum(right, 1e-300)))
    return out


def _pull(
    x: FloatArray, P: FloatArray, ref: FloatArray, velocity: FloatArray, noise: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return state and covariance after a velocity of the receiver, linearized at ``ref``."""
    c, w, k = math.cos(ref[2]), math.sin(ref[2]), math.exp(ref[3])
    east, north = k * (c * velocity[2] - w * velocity[3]), k * (w * velocity[2] + c * velocity[3])
    H = np.zeros((2, N))
    H[:, 2], H[:, 3] = (-north, east), (east, north)
    R = np.eye(2) * noise[2]
    K = np.linalg.solve(H @ P @ H.T + R, H @ P).T
    x = x + K @ (noise[:2] - H[:, 2:4] @ (x - ref)[2:4])
    A = np.eye(N) - K @ H
    return x, A @ P @ A.T + K @ R @ K.T


def _sources(sd: FloatArray) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Return at every event the slow error's deviation (m), and whether another source of fixes begins there.

    A source's is the median of its fixes' (``sd``, NaN at steps); see :data:`.mixture.OTHER_SOURCE`.
    """
    slow, anew = np.zeros(len(sd)), np.zeros(len(sd), bool)
    fixes = np.flatnonzero(np.isfinite(sd))
    starts: list[int] = []
    level = 0.0
    for k in fixes:
        if not starts or sd[k] > OTHER_SOURCE * level or sd[k] * OTHER_SOURCE < level:
            starts.append(int(k))
            level = float(sd[k])
        level += 0.2 * (float(sd[k]) - level)
    for first, end in itertools.pairwise([*starts, len(sd)]):
        slow[first:end] = np.nanmedian(sd[first:end])
    if starts:
        slow[: starts[0]] = slow[starts[0]]
        anew[starts[1:]] = True
    return slow, anew


def _model(
    move: FloatArray, dt: float, state: FloatArray, slow: float, p: PhoneFusedParams
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return Jacobian, noise and value of the motion to the next event, linearized at ``state``."""
    F, Q = np.eye(N), np.zeros((N, N))
    heading = move[1] + state[2] + state[6] * dt
    c, w, r = math.cos(heading), math.sin(heading), move[0] * math.exp(state[3])
    F[0, 2], F[1, 2] = -r * w, r * c
    F[0, 6], F[1, 6] = -r * w * dt, r * c * dt
    F[0, 3], F[1, 3] = r * c, r * w
    F[2, 6] = dt
    keep = math.exp(-dt / p.gnss_tau_s)
    F[4, 4] = F[5, 5] = keep
    along, across = (p.sigma_length * r) ** 2, (math.radians(p.sigma_step_deg) * r) ** 2
    Q[0, 0], Q[1, 1] = along * c * c + across * w * w, along * w * w + across * c * c
    Q[0, 1] = Q[1, 0] = (along - across) * c * w
    if move[0] > 0:
        Q[2, 2], Q[3, 3] = math.radians(p.sigma_turn_deg) ** 2, 0.003**2
    Q[4, 4] = Q[5, 5] = slow**2 * (1 - keep * keep)
    Q[6, 6] = dt * 2e-5**2
    value = state.copy()
    value[0] += r * c
    value[1] += r * w
    value[2] += state[6] * dt
    value[4:6] *= keep
    return F, Q, value


def _inliers(
    walk: WalkEvents, state: FloatArray, cov: FloatArray, used: FloatArray, p: PhoneFusedParams
) -> FloatArray:
    """Return each fix's probability of being one, from its residual against the smoothed track without it."""
    out = np.zeros(len(state))
    for k in np.flatnonzero(np.isfinite(walk.fix[:, 0])):
        r = walk.fix[k, :2] - state[k, :2] - state[k, 4:6]
        H = np.zeros((2, N))
        H[0, 0] = H[1, 1] = H[0, 4] = H[1, 5] = 1.0
        S = H @ cov[k] @ H.T
        R = np.eye(2) * walk.fix[k, 2] ** 2 * (1 - p.gnss_slow_share)
        if used[k] > 1e-6:  # take its own share out of the smoothed residual: S R⁻¹ is its leverage
            M = np.eye(2) - S @ np.linalg.inv(R / used[k])
            if np.linalg.det(M) > 1e-6:
                r, S = np.linalg.solve(M, r), np.linalg.solve(M, S)
        S = S + R
        a, b = _density(r, S), _density(r, S + 2500.0 * np.eye(2)) + 1e-300
        out[k] = (1 - p.outlier) * a / ((1 - p.outlier) * a + p.outlier * b)
    return out


def _density(r: FloatArray, S: FloatArray) -> float:
    return math.exp(-0.5 * float(r @ np.linalg.solve(S, r))) / (2 * math.pi * math.sqrt(np.linalg.det(S)))


def _paces(starts: IntArray, ends: IntArray, length: FloatArray, heading: FloatArray) -> FloatArray:
    """Return velocity of the steps, east and north, and its mean square, as the forward pass has it, (n, 3)."""
    period = np.maximum((ends - starts) * 1e-9, 0.1)
    rate = length / period
    now = np.column_stack((rate * np.cos(heading), rate * np.sin(heading), rate * rate))
    out = now.copy()
    for k in range(1, len(ends)):
        if (ends[k] - ends[k - 1]) * 1e-9 <= 2.0 * period[k] + PACE_S:
            out[k] += math.exp(-period[k] / PACE_S) * (out[k - 1] - now[k])
    return out


@compiled
def _plane(s: Any, lat: float, lon: float, alt: float) -> tuple[float, float, float]:
    return geodesy.to_enu(s, lat, lon, alt)


@compiled
def _globe(s: Any, east: float, north: float) -> tuple[float, float, float]:
    return geodesy.from_enu(s, east, north, 0.0)


class PhoneSmooth(PlainEstimator):
    """The whole walk at once: steps, headings and fixes before and after every instant. Not causal.

    Steps and headings are those of ``phone.fused``; the track is then the most probable one given all fixes (see
    :func:`smooth`), so that a loss of signal is bridged from both ends. Frame as of ``phone.fused``.
    """

    name: ClassVar[str] = "phone.smooth"
    title: ClassVar[str] = "steps, heading and all GNSS fixes at once, offline"
    source: ClassVar[str] = "ours; Rauch, Tung and Striebel 1965, Bell 1994"
    offline: ClassVar[bool] = True
    Params = PhoneFusedParams
    inputs = PhoneFused.inputs
    outputs = (STEP, POSE, SIGMA, STATE, FIX)

    def __init__(self, params: msgspec.Struct | None = None) -> None:
        super().__init__(params)
        self._forward = PhoneFused(self.params)
        self._messages: list[tuple[int, int, tuple[Any, ...]]] = []
        self._columns: dict[int, tuple[str, ...]] = {}
        self._failed = ""
        self._noise: PhoneFusedParams = self.params

    def start(self, context: Context) -> None:
        """Hand the context to the forward pass."""
        self._forward.start(context)
        rate = self.params.rate_hz or context.rate_hz("acc") or 50.0
        self._noise = msgspec.structs.replace(self.params, sigma_drift=drift_sd(self.params, rate))
        self._messages = []
        self._columns = {
            i: context.channels[one.name][0].columns if one.columns == ALL_COLUMNS else one.columns
            for i, one in enumerate(self.inputs)
            if context.channels.get(one.name)
        }

    def take(self, message: Message) -> None:
        """Keep the message."""
        index = next(i for i, one in enumerate(self.inputs) if one.name == message.input)
        self._messages.append((index, message.t_ns, message.values))

    def finish(self) -> list[Result]:
        """Return the smoothed track."""
        import polars as pl

        if not self._messages:
            return []
        index = np.array([m[0] for m in self._messages])
        times = np.array([m[1] for m in self._messages], np.int64)
        values = np.full((len(times), 6), np.nan)
        fixes, velocities = np.zeros((0, 5)), np.zeros((0, 2))
        fix_times = velocity_times = times[:0]
        for i, columns in self._columns.items():
            mine = np.flatnonzero(index == i)
            if not len(mine):
                continue
            rows = [self._messages[k][2] for k in mine]
            table = pl.DataFrame(rows, schema=list(columns), orient="row", infer_schema_length=None)
            table = table.insert_column(0, pl.Series("t_ns", times[mine]))
            encoded = self._forward.encode(i, 0, table)
            values[mine, : encoded.shape[1]] = encoded
            if self.inputs[i].name == "gnss":
                good = np.isfinite(encoded[:, 0]) & np.isfinite(encoded[:, 1])
                fixes, fix_times = encoded[good], times[mine][good]
            elif self.inputs[i].name == "velocity":
                velocities, velocity_times = encoded, times[mine]
        self._messages = []
        outputs = self._run(index, times, values)
        return self._smoothed(outputs, fixes, fix_times, velocities, velocity_times)

    def _run(self, index: IntArray, times: IntArray, values: FloatArray) -> dict[str, list[tuple[int, Any]]]:
        """Run the forward pass; return its results by output."""
        forward, out = self._forward, {o.name: [] for o in self._forward.outputs}
        for a in range(0, len(times), 512):
            b = min(a + 512, len(times))
            capacity = (b - a) * forward.max_results
            whose, when = np.zeros(capacity, np.int64), np.zeros(capacity, np.int64)
            rows = np.full((capacity, forward.width), np.nan)
            n = forward.run(
                forward.state, index[a:b], index[a:b] * 0, times[a:b], values[a:b], whose, when, rows
            )
            for r in forward.results(when[:n], rows[:n]):
                out[r.output].append((r.t_ns, r.values))
        for r in forward.finish() or ():
            out[r.output].append((r.t_ns, r.values))
        return out

    def _smoothed(
        self,
        outputs: dict[str, list[tuple[int, Any]]],
        fixes: FloatArray,
        fix_times: IntArray,
        velocities: FloatArray,
        velocity_times: IntArray,
    ) -> list[Result]:
        p, s = self.params, self._forward.state[0]
        if not len(fixes):
            self._failed = "no fix arrived"
            return []
        state = dict(outputs["state"])
        steps = [(t, v, state[t]) for t, v in outputs["step"] if t in state]
        ends = np.array([t for t, _, _ in steps], np.int64)
        starts = ends - np.array([round(v[0] * 1e9) for _, v, _ in steps], np.int64)
        length = np.array([v[2] / c[1] for _, v, c in steps])
        heading = np.array([v[4] - c[0] for _, v, c in steps])
        sd = np.where(fixes[:, 3] > 0, np.maximum(fixes[:, 3], p.gnss_sd_min_m), p.gnss_sd_m)
        place = np.array([_plane(s, a, b, s["alt_zero"])[:2] for a, b in fixes[:, :2].tolist()])
        t_ns = np.unique(np.concatenate((ends, fix_times, velocity_times)))
        walked = np.zeros((len(t_ns), 2))
        which = np.searchsorted(ends, t_ns)  # the step that ends at or after an event
        inside = which < len(ends)
        begin = np.concatenate((t_ns[:1], t_ns[:-1]))
        i = np.minimum(which, max(len(ends) - 1, 0))
        if len(ends):
            part = np.minimum(t_ns, ends[i]) - np.maximum(begin, starts[i])
            share = np.clip(part / np.maximum(ends[i] - starts[i], 1), 0, 1) * inside
            walked = np.column_stack((length[i] * share, heading[i]))
        seen = np.full((len(t_ns), 3), np.nan)
        seen[np.searchsorted(t_ns, fix_times)] = np.column_stack((place, sd))
        settled = [c[0] for _, _, c in steps[len(steps) // 2 :]] or [0.0]
        drift = math.atan2(np.mean(np.sin(settled)), np.mean(np.cos(settled)))
        beside = np.full((len(t_ns), 5), np.nan)
        if len(ends):
            step = np.minimum(np.searchsorted(ends, velocity_times), len(ends) - 1)
            near = (velocity_times > starts[step] - 10**9) & (velocity_times < ends[step] + 10**9)
            pace = _paces(starts, ends, length, heading)[step]
            beside[np.searchsorted(t_ns, velocity_times[near])] = np.column_stack((velocities, pace))[near]
        done = smooth(WalkEvents(t_ns, walked, seen, beside), drift, self._noise)
        if not np.isfinite(done.state).all():
            self._failed = "the smoother diverged"
            return []
        return self._results(t_ns, done, steps, heading, length, dict(outputs["pose"]))

    def _results(
        self,
        t_ns: IntArray,
        done: Smoothed,
        steps: list[Any],
        heading: FloatArray,
        length: FloatArray,
        poses: dict[int, Any],
    ) -> list[Result]:
        s, out = self._forward.state[0], []
        at_step = {t: k for k, (t, _, _) in enumerate(steps)}
        fixes = float(s["fixes"])
        outliers = max(0.0, fixes - float(done.inlier.sum()))
        turn, sd = 0.0, np.sqrt(np.maximum(np.diagonal(done.cov, axis1=1, axis2=2), 0))
        for k, t in enumerate(t_ns.tolist()):
            x = done.state[k]
            j = at_step.get(t)
            if j is not None:
                turn = math.remainder(heading[j] + x[2], 2 * math.pi)
                old = steps[j][1]
                out.append(Result("step", t, (old[0], old[1], length[j] * math.exp(x[3]), old[3], turn)))
            z = poses[t][2] if t in poses else float("nan")
            quat = (math.cos(turn / 2), 0.0, 0.0, math.sin(turn / 2))
            out.append(Result("pose", t, (x[0], x[1], z, *quat)))
            nan = float("nan")
            out.append(Result("sigma", t, (sd[k, 0], sd[k, 1], nan, nan, nan, min(sd[k, 2], math.pi))))
            together = done.cov[k, 0, 1] / max(sd[k, 0] * sd[k, 1], 1e-12)
            out.append(Result("state", t, (x[2], math.exp(x[3]), 1.0, together, fixes, outliers)))
            lat, lon, _ = _globe(s, x[0], x[1])
            alt = float(s["alt_zero"]) + z if s["alt_n"] > 0 else nan
            high = 10.0 if s["alt_n"] > 0 else nan
            place = (math.degrees(lat), math.degrees(lon), alt, sd[k, 0], sd[k, 1], high)
            out.append(Result("fix", t, place))
        return out

    def remarks(self) -> list[Remark]:
        """Say what a user must know; among it what the forward pass says."""
        remarks = self._forward.remarks()
        if self._failed:
            remarks.append(Remark("not_smoothed", self._failed, fatal=True))
        return remarks
