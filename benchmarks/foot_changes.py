"""Recordings of a walk, changed in ways that leave the truth known: what an estimate must survive or remark.

Each change takes a :class:`Walk` and returns another one: the same foot with the sensor mounted otherwise, at
another rate, from another start, reversed in time, with another bias or a smaller range.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from marcha.algorithms.contract import FloatArray
from scipy.signal import firwin, upfirdn
from scipy.spatial.transform import Rotation

GRAVITY = 9.81


@dataclass(frozen=True)
class Walk:
    """Samples of a shoe's IMU and what is known of its way.

    Attributes
    ----------
    name : str
    t : ndarray, shape (n,)
        Seconds, ascending.
    acc, gyr : ndarray, shape (n, 3)
        Specific force (m/s²), angular rate (rad/s), sensor frame.
    truth_t : ndarray, shape (m,)
        Seconds, of the reference; empty without one.
    truth : ndarray, shape (m, 3)
        Positions, m.
    flat : bool
        The reference is horizontal.
    closed : bool
        It ends where it began.
    climb : float
        Metres that it ends above its start, NaN unless known.
    """

    name: str
    t: FloatArray
    acc: FloatArray
    gyr: FloatArray
    truth_t: FloatArray
    truth: FloatArray
    flat: bool = False
    closed: bool = False
    climb: float = np.nan

    @property
    def rate_hz(self) -> float:
        """Mean rate without gaps."""
        dt = np.diff(self.t)
        return float(1.0 / dt[dt <= 2.5 * np.median(dt)].mean())


Change = Callable[[Walk], Walk]


def cut(walk: Walk, first_s: float, last_s: float = np.inf) -> Walk:
    """Return what lies between two times since the first sample."""
    a, b = walk.t[0] + first_s, walk.t[0] + last_s
    here = (walk.t >= a) & (walk.t <= b)
    there = (walk.truth_t >= a) & (walk.truth_t <= b)
    whole = first_s <= 0 or onset_s(walk) >= first_s
    return replace(
        walk,
        t=walk.t[here],
        acc=walk.acc[here],
        gyr=walk.gyr[here],
        truth_t=walk.truth_t[there],
        truth=walk.truth[there],
        closed=walk.closed and whole,
        climb=walk.climb if whole else np.nan,
    )


def onset_s(walk: Walk) -> float:
    """Return when the foot first turns by more than 1 rad/s, s since the first sample."""
    fast = np.flatnonzero(np.linalg.norm(walk.gyr - np.median(walk.gyr, axis=0), axis=1) > 1.0)
    return float(walk.t[fast[0]] - walk.t[0]) if fast.size else 0.0


def mounted(turn: Rotation) -> Change:
    """Turn the sensor on the shoe."""
    return lambda w: replace(w, acc=turn.apply(w.acc), gyr=turn.apply(w.gyr))


def mirrored(walk: Walk) -> Walk:
    """Make a left foot of a right one: y is reflected; a rate is an axial vector."""
    y = np.array([1.0, -1.0, 1.0])
    return replace(walk, acc=walk.acc * y, gyr=-walk.gyr * y, truth=walk.truth * y)


def standing(walk: Walk) -> slice:
    """Return the samples of the rest at the start, a quarter of a second at least."""
    return slice(
        0, max(round(0.25 * walk.rate_hz), int(np.searchsorted(walk.t - walk.t[0], onset_s(walk) - 0.7)))
    )


def quietest(walk: Walk, length_s: float = 0.5) -> slice:
    """Return the samples of the stretch whose angular rate spreads least."""
    n = round(length_s * walk.rate_hz)
    sums = np.cumsum(np.vstack([np.zeros((1, 6)), np.column_stack([walk.gyr, walk.gyr**2])]), axis=0)
    mean, square = np.split((sums[n:] - sums[:-n]) / n, 2, axis=1)
    first = int(np.argmin((square - mean**2).sum(axis=1)))
    return slice(first, first + n)


def backwards(walk: Walk) -> Walk:
    """Reverse time: forces stay, rates but for the bias change their sign; the way is walked backwards."""
    end = walk.t[0] + walk.t[-1]
    bias = walk.gyr[quietest(walk)].mean(axis=0)
    return replace(
        walk,
        t=end - walk.t[::-1],
        acc=walk.acc[::-1],
        gyr=2 * bias - walk.gyr[::-1],
        truth_t=end - walk.truth_t[::-1],
        truth=walk.truth[::-1],
        climb=-walk.climb,
    )


def there_and_back(walk: Walk, times: int = 1) -> Walk:
    """Walk to the end and backwards to the start, ``times`` times: closed, whatever the walk."""
    back = backwards(walk)
    lap = walk.t[-1] - walk.t[0] + 1.0 / walk.rate_hz
    pieces = [(w, k * lap) for k, w in enumerate((walk, back) * times)]
    return replace(
        walk,
        t=np.concatenate([w.t + shift for w, shift in pieces]),
        acc=np.concatenate([w.acc for w, _ in pieces]),
        gyr=np.concatenate([w.gyr for w, _ in pieces]),
        truth_t=np.concatenate([w.truth_t + shift for w, shift in pieces]),
        truth=np.concatenate([w.truth for w, _ in pieces]),
        closed=True,
        climb=0.0,
    )


def resampled(rate_hz: float) -> Change:
    """Give the samples another rate: low-pass below the lower Nyquist frequency, linear in between."""

    def change(w: Walk) -> Walk:
        t = np.arange(w.t[0], w.t[-1], 1.0 / rate_hz)
        fine = max(1, round(4 * rate_hz / w.rate_hz))
        grid = np.arange(w.t[0], w.t[-1], 1.0 / (w.rate_hz * fine))
        taps = firwin(
            16 * fine * max(1, round(w.rate_hz / rate_hz)) + 1,
            0.45 * min(rate_hz, w.rate_hz),
            fs=w.rate_hz * fine,
        )
        half = len(taps) // 2

        def series(x: FloatArray) -> FloatArray:
            up = np.interp(grid, w.t, x)
            padded = np.pad(up, half, mode="edge")
            return np.interp(t, grid, np.asarray(upfirdn(taps, padded))[2 * half : 2 * half + len(grid)])

        def all_of(x: FloatArray) -> FloatArray:
            return np.column_stack([series(c) for c in x.T])

        return replace(w, t=t, acc=all_of(w.acc), gyr=all_of(w.gyr))

    return change


def rested(seconds: float, at_end: bool = False) -> Change:
    """Stand for longer before (or after) the walk: its own rest (its last quarter second), to and fro."""

    def change(w: Walk) -> Walk:
        n = round(seconds * w.rate_hz)
        acc, gyr = (x[-round(0.25 * w.rate_hz) :] if at_end else x[standing(w)] for x in (w.acc, w.gyr))
        swing = np.abs((np.arange(n) + len(acc)) % (2 * len(acc)) - len(acc)) % len(acc)
        swing = swing if at_end else swing[::-1]
        acc, gyr = acc[swing], gyr[swing]
        step = 1.0 / w.rate_hz
        if at_end:
            t = np.concatenate([w.t, w.t[-1] + step * np.arange(1, n + 1)])
            return replace(w, t=t, acc=np.vstack([w.acc, acc]), gyr=np.vstack([w.gyr, gyr]))
        t = np.concatenate([w.t[0] - step * np.arange(n, 0, -1), w.t])
        return replace(w, t=t, acc=np.vstack([acc, w.acc]), gyr=np.vstack([gyr, w.gyr]))

    return change


def off(acc: float = 0.0, gyr: float = 0.0) -> Change:
    """Add a bias, of the given norms, oblique to all axes."""
    along = np.array([0.6, -0.64, 0.48])
    return lambda w: replace(w, acc=w.acc + acc * along, gyr=w.gyr + gyr * along)


def ranged(acc: float = np.inf, gyr: float = np.inf) -> Change:
    """Let the sensor's range end at ± ``acc`` m/s² and ± ``gyr`` rad/s."""
    return lambda w: replace(w, acc=np.clip(w.acc, -acc, acc), gyr=np.clip(w.gyr, -gyr, gyr))


def scaled(acc: float = 1.0, gyr: float = 1.0) -> Change:
    """Scale both sensors."""
    return lambda w: replace(w, acc=w.acc * acc, gyr=w.gyr * gyr)


def thinned(share: float) -> Change:
    """Lose samples by chance."""

    def change(w: Walk) -> Walk:
        keep = np.random.default_rng(11).random(len(w.t)) >= share
        keep[0] = True
        return replace(w, t=w.t[keep], acc=w.acc[keep], gyr=w.gyr[keep])

    return change


def begun(after_onset_s: float) -> Change:
    """Begin so long after the foot's first turn (before it, where negative)."""
    return lambda w: cut(w, max(0.0, onset_s(w) + after_onset_s))


def chain(*changes: Change) -> Change:
    """Apply one change after the other."""

    def change(w: Walk) -> Walk:
        for each in changes:
            w = each(w)
        return w

    return change


def _turn(seed: int) -> Rotation:
    return Rotation.random(rng=np.random.default_rng(seed))


CHANGES: dict[str, Change] = {
    "as it is": lambda w: w,
    "turned 1": mounted(_turn(1)),
    "turned 2": mounted(_turn(2)),
    "turned 3": mounted(_turn(3)),
    "upside down": mounted(Rotation.from_euler("x", 180, degrees=True)),
    "nose down": mounted(Rotation.from_euler("y", 90, degrees=True)),
    "mirrored": mirrored,
    "backwards": backwards,
    "there and back": there_and_back,
    "four times there and back": lambda w: there_and_back(w, 4),
    "100 Hz": resampled(100.0),
    "200 Hz": resampled(200.0),
    "400 Hz": resampled(400.0),
    "800 Hz": resampled(800.0),
    "50 Hz": resampled(50.0),
    "rest 10 s longer": rested(10.0),
    "rest 60 s longer": rested(60.0),
    "rest at the end": rested(5.0, at_end=True),
    "rest 0.5 s": begun(-0.5),
    "rest 0.2 s": begun(-0.2),
    "from the first turn": begun(0.0),
    "from the first swing": begun(0.4),
    "from the walk": begun(3.0),
    "rest at the end only": chain(begun(1.0), rested(5.0, at_end=True)),
    "gyroscope off 1 deg/s": off(gyr=0.0175),
    "gyroscope off 5 deg/s": off(gyr=0.0873),
    "gyroscope off 15 deg/s": off(gyr=0.262),
    "accelerometer off 0.1": off(acc=0.1),
    "accelerometer off 0.3": off(acc=0.3),
    "accelerometer +3 %": scaled(acc=1.03),
    "gyroscope to 500 deg/s": ranged(gyr=8.73),
    "gyroscope to 250 deg/s": ranged(gyr=4.36),
    "accelerometer to 4 g": ranged(acc=4 * GRAVITY),
    "accelerometer to 2 g": ranged(acc=2 * GRAVITY),
    "in g": scaled(acc=1 / GRAVITY),
    "in deg/s": scaled(gyr=180 / np.pi),
    "5 % lost": thinned(0.05),
    "30 % lost": thinned(0.3),
}
