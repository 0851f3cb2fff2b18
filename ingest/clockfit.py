"""How one clock runs against another, from what both measured of the same motion, or from shared events.

The norm of the angular rate does not depend on frames or mounting: its cross-correlation gives the offset to a sample.
Then offset and drift are fitted by least squares to the rates themselves, x(offset + (1 + drift) t) = A y(t) + b, with
A and b (mounting, scale, bias) of every segment free, and residuals weighted by the inverse of their covariance: where
soft tissue lets the sensor lag about one axis, that axis counts less. Of several bandwidths the one with the smallest
standard deviation counts. Nothing is compared within or beside a gap.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from ..recording.errors import MarchaError

FloatArray = NDArray[np.float64]

RATE_HZ = 100.0
"""Common rate of the comparison."""
BANDS_HZ = (5.0, 2.5, 1.2)
"""Both rates are low-passed here; the first is for finding them."""
LEAST_R = 0.8
"""Below this correlation an alignment is refused."""
LEAST_S = 3.0
"""Shortest common motion (s)."""


class ClockFit(msgspec.Struct, frozen=True):
    """How one clock runs against the other: ``t_imu = offset_s + (1 + drift_ppm 1e-6) t_optical``.

    Attributes
    ----------
    method : str
        ``rates``, ``event`` or ``given``.
    offset_s, drift_ppm : float
        The fit; the offset is that at optical time 0.
    offset_sd_s, drift_sd_ppm : float
        Standard deviations from the residual (the offset's in the middle of the overlap; neighbours within a
        cycle of the band count once); NaN where nothing says them.
    correlation : float
        Of both rates at the fit: the quality figure; NaN without rates.
    overlap_s : float
        Time in which both were measured; between the first and the last event.
    """

    method: str
    offset_s: float
    drift_ppm: float
    offset_sd_s: float
    drift_sd_ppm: float
    correlation: float
    overlap_s: float


class Pair(NamedTuple):
    """The same motion on both clocks: times (s) and rates (rad/s), (n, k) and (m, l)."""

    t_imu: FloatArray
    imu: FloatArray
    t_optical: FloatArray
    optical: FloatArray


def stated_fit(offset_s: float, drift_ppm: float = 0.0) -> ClockFit:
    """Return what the user says."""
    nan = float("nan")
    return ClockFit("given", offset_s, drift_ppm, nan, nan, nan, nan)


def from_events(events: Sequence[tuple[float, float]]) -> ClockFit:
    """Return the line through shared events (inertial, optical time in s): one gives the offset, more the drift too.

    Raises
    ------
    MarchaError
        No event, or two at the same optical time.
    """
    if not events:
        raise MarchaError("alignment: no shared event")
    imu, optical = (np.array(side) for side in zip(*events, strict=True))
    nan = float("nan")
    if len(events) == 1:
        return ClockFit("event", float(imu[0] - optical[0]), 0.0, nan, nan, nan, 0.0)
    middle = optical.mean()
    spread = float(np.sum((optical - middle) ** 2))
    if spread == 0.0:
        raise MarchaError("alignment: the events lie at the same optical time")
    late = imu - optical
    drift = float(np.sum((optical - middle) * (late - late.mean())) / spread)
    residual = late - late.mean() - drift * (optical - middle)
    free = len(events) - 2
    sd = float(np.sqrt(np.sum(residual**2) / free)) if free else nan
    return ClockFit(
        "event",
        float(late.mean() - drift * middle),
        drift * 1e6,
        sd / np.sqrt(len(events)),
        1e6 * sd / np.sqrt(spread),
        nan,
        float(np.ptp(optical)),
    )


def from_rates(pairs: Sequence[Pair]) -> ClockFit:
    """Fit the optical clock to the inertial one by the rates of one or several segments.

    Raises
    ------
    MarchaError
        Too little data or motion, or no agreement.
    """
    coarse = [_Even.of(pair, BANDS_HZ[0]) for pair in pairs]
    best = max((e.lag() for e in coarse), key=lambda lagged: lagged[1])
    offset = best[0]
    fits = []
    for band in BANDS_HZ:
        sides = coarse if band == BANDS_HZ[0] else [_Even.of(pair, band) for pair in pairs]
        fits.append(_refine(sides, offset, band))
        offset = fits[0].at_start
    fit = min(fits, key=lambda f: f.drift_sd)
    if not fit.correlation >= LEAST_R:
        raise MarchaError(
            f"alignment: the rates agree with r = {fit.correlation:.2f} only: another segment, or no common motion?"
        )
    return ClockFit(
        method="rates",
        offset_s=fit.offset - fit.drift * fit.middle,
        drift_ppm=fit.drift * 1e6,
        offset_sd_s=fit.offset_sd,
        drift_sd_ppm=fit.drift_sd * 1e6,
        correlation=fit.correlation,
        overlap_s=fit.overlap,
    )


class _Even(NamedTuple):
    """A pair at :data:`RATE_HZ`, low-passed; NaN where one has gaps."""

    ta: FloatArray
    a: FloatArray
    slope: FloatArray
    tb: FloatArray
    b: FloatArray

    @classmethod
    def of(cls, pair: Pair, band_hz: float) -> _Even:
        a0, a = even(pair.t_imu, pair.imu, band_hz)
        b0, b = even(pair.t_optical, pair.optical, band_hz)
        if min(len(a), len(b)) < LEAST_S * RATE_HZ:
            raise MarchaError(f"alignment: inertial and optical need at least {LEAST_S:g} s each")
        ta, tb = a0 + np.arange(len(a)) / RATE_HZ, b0 + np.arange(len(b)) / RATE_HZ
        return cls(ta, a, np.gradient(a, 1 / RATE_HZ, axis=0), tb, b)

    def lag(self) -> tuple[float, float]:
        """Return the offset that the norms say, to a sample, and their correlation coefficient there."""
        from scipy.signal import correlate, correlation_lags

        x, y = (np.nan_to_num(np.linalg.norm(v, axis=1)) for v in (self.a, self.b))
        if min(np.std(x), np.std(y)) < 0.05:
            raise MarchaError("alignment: hardly any motion in one of the two; give the offset instead")
        score = correlate(x - x.mean(), y - y.mean(), method="fft")
        k = int(np.argmax(score))
        lag = int(correlation_lags(len(x), len(y))[k])
        return float(self.ta[0] + lag / RATE_HZ - self.tb[0]), float(
            score[k] / (np.std(x) * np.std(y)) / len(y)
        )


class _Fit(NamedTuple):
    offset: float  # in the middle of the overlap
    drift: float
    middle: float
    offset_sd: float
    drift_sd: float
    correlation: float
    overlap: float

    @property
    def at_start(self) -> float:
        return self.offset - self.drift * self.middle


def _refine(sides: Sequence[_Even], offset: float, band_hz: float) -> _Fit:
    drift, middle = 0.0, float(np.mean([s.tb[np.isfinite(s.b).all(axis=1)].mean() for s in sides]))
    normal, residual, weighted, total, overlap, count = np.eye(2), 0.0, 0.0, 1.0, 0.0, 1
    for turn in range(12):
        normal, gradient = np.zeros((2, 2)), np.zeros(2)
        residual, weighted, total, count, overlap = 0.0, 0.0, 0.0, 0, 0.0
        for s in sides:
            shifted = s.tb + offset + drift * (s.tb - middle)
            inside = np.isfinite(s.b).all(axis=1) & (shifted > s.ta[20]) & (shifted < s.ta[-20])
            inside &= np.interp(shifted, s.ta, _measured(s.a)) == 1.0
            if inside.sum() < LEAST_S * RATE_HZ:
                raise MarchaError(
                    f"alignment: the two overlap by less than {LEAST_S:g} s: no common motion in time"
                )
            overlap = max(overlap, float(inside.sum() / RATE_HZ))
            now = _interpolated(shifted[inside], s.ta, s.a)
            rise = _interpolated(shifted[inside], s.ta, s.slope)
            y = np.column_stack((s.b[inside], np.ones(inside.sum())))
            # What A and b can explain is taken out of the residual and of the slopes (variable projection).
            lever = rise * (s.tb[inside] - middle)[:, None]
            stacked = np.column_stack((now, rise, lever))
            stacked = stacked - y @ np.linalg.lstsq(y, stacked, rcond=None)[0]
            e, *columns = np.split(stacked, 3, axis=1)
            residual += float(np.sum(e**2))
            if turn > 0:  # the first turn removes what is of the coarse offset
                white = _whitening(e)
                e, columns = e @ white, [c @ white for c in columns]
            gradient += [np.sum(c * e) for c in columns]
            normal += [[np.sum(c * d) for d in columns] for c in columns]
            weighted += float(np.sum(e**2))
            total += float(np.sum((now - now.mean(axis=0)) ** 2))
            count += e.size
        step = -np.linalg.solve(normal, gradient)
        offset, drift = offset + step[0], drift + step[1]
        if turn > 0 and abs(step[0]) < 1e-7 and abs(step[1]) < 1e-8:
            break
    variance = weighted / count * RATE_HZ / (2 * band_hz)
    sd = np.sqrt(np.diag(np.linalg.inv(normal)) * variance)
    r = float(np.sqrt(max(0.0, 1.0 - residual / total)))
    return _Fit(float(offset), float(drift), middle, float(sd[0]), float(sd[1]), r, overlap)


def _whitening(e: FloatArray) -> FloatArray:
    """Return W (k, k) that gives residuals e (n, k) unit covariance; the weights differ by 1000 times at most."""
    cov = e.T @ e / len(e)
    k = len(cov)
    return np.linalg.cholesky(np.linalg.inv(cov + (1e-3 * np.trace(cov) / k + 1e-18) * np.eye(k)))


def _measured(values: FloatArray) -> FloatArray:
    """Return 1 where the row and its 20 neighbours on both sides are numbers, else 0 (n,)."""
    lost = ~np.isfinite(values).all(axis=1)
    return np.where(np.convolve(lost, np.ones(41), "same") > 0.5, 0.0, 1.0)


def _interpolated(t: FloatArray, own: FloatArray, values: FloatArray) -> FloatArray:
    """Return the spline through ``values`` at ``t``; what is missing counts as 0 (see :func:`_measured`)."""
    from scipy.interpolate import make_interp_spline

    return make_interp_spline(own, np.nan_to_num(values), k=3)(t)


def turn_rate(t: FloatArray, rot: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return body rates (rad/s) of attitudes (n, 3, 3) between neighbours, at their middle; none across a gap."""
    from scipy.spatial.transform import Rotation

    step = np.diff(t)
    near = (step > 0) & (step < 1.8 * np.median(step))
    turn = Rotation.from_matrix(np.swapaxes(rot[:-1][near], 1, 2) @ rot[1:][near]).as_rotvec()
    return (0.5 * (t[1:] + t[:-1]))[near], turn / step[near][:, None]


def even(t: FloatArray, values: FloatArray, band_hz: float) -> tuple[float, FloatArray]:
    """Return the first time and values at :data:`RATE_HZ`, low-passed without delay; NaN in gaps and near them.

    Shapes: ``t`` (n,) in s, ``values`` (n, k).
    """
    from scipy.signal import butter, sosfiltfilt

    good = np.isfinite(values).all(axis=1)
    t, values = t[good], values[good]
    if len(t) < 30:
        raise MarchaError("alignment: fewer than 30 readings on one side")
    grid = np.arange(t[0], t[-1], 1 / RATE_HZ)
    smooth = np.column_stack([np.interp(grid, t, v) for v in values.T])
    smooth = sosfiltfilt(butter(2, 2 * band_hz / RATE_HZ, output="sos"), smooth, axis=0)
    margin = 0.5 / band_hz
    for k in np.flatnonzero(np.diff(t) > max(3 * np.median(np.diff(t)), 2 / RATE_HZ)):
        smooth[(grid > t[k] - margin) & (grid < t[k + 1] + margin)] = np.nan
    return float(grid[0]), smooth
