"""What a real sensor makes of the truth: scale, misalignment, bias, noise, quantization, clipping."""

from __future__ import annotations

from typing import Annotated

import msgspec
import numpy as np

from ..checks import STANDARD_GRAVITY
from .gait import FloatArray

Vector = tuple[float, float, float]
_NonNegative = Annotated[float, msgspec.Meta(ge=0)]

"""What one g of a full scale means (m/s²)."""


class ImuErrors(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Errors of one accelerometer and gyroscope; a field set to 0 (or False) switches that error off.

    A reading is ``(1 + scale) · (I + [misalignment]×) · truth + bias(t) + noise``, then rounded to counts
    of the 16-bit converter and clipped at its full scale.

    Attributes
    ----------
    acc_bias, gyr_bias : tuple of float
        Fixed bias (m/s², rad/s).
    acc_bias_sigma, gyr_bias_sigma : float
        Standard deviation of the turn-on bias that is drawn on top of it, per axis (m/s², rad/s).
    acc_bias_walk, gyr_bias_walk : float
        Random walk of the bias (m/s²/√s, rad/s/√s).
    acc_noise, gyr_noise : float
        White noise density (m/s²/√Hz, rad/s/√Hz); a sample has density · √rate. Defaults: rest noise of the
        device's recordings at 100 Hz (0.035 m/s², 0.15 °/s).
    acc_scale, gyr_scale : tuple of float
        Relative scale error per axis.
    acc_misalignment, gyr_misalignment : tuple of float
        Small rotation of the sensitive axes (rad).
    acc_scale_sigma, gyr_scale_sigma : float
        Standard deviation of a scale error drawn on top of it for every recording, per axis.
    acc_misalignment_sigma, gyr_misalignment_sigma : float
        The same of the misalignment (rad).
    acc_warmup_sigma, gyr_warmup_sigma : float
        Standard deviation of a change of the bias (m/s², rad/s) that creeps in after the start with the time constant
        ``warmup_s``: the bias of the rest is not that of the walk.
    strap_acc, strap_gyr : float
        What strap and shoe add: a random share of the acceleration (without gravity) and of the angular rate, drawn
        anew about every ``strap_s``.
    quantize : bool
        Round to the converter's counts.
    clip : bool
        Clip at the full scale. Text and packets hold 16 bits and clip in any case; :meth:`Walk.measured`
        need not.
    """

    acc_bias: Vector = (0.0, 0.0, 0.0)
    gyr_bias: Vector = (0.0, 0.0, 0.0)
    acc_bias_sigma: _NonNegative = 0.03
    gyr_bias_sigma: _NonNegative = 0.001
    acc_bias_walk: _NonNegative = 1e-4
    gyr_bias_walk: _NonNegative = 1e-5
    acc_noise: _NonNegative = 3.5e-3
    gyr_noise: _NonNegative = 2.6e-4
    acc_scale: Vector = (0.0, 0.0, 0.0)
    gyr_scale: Vector = (0.0, 0.0, 0.0)
    acc_misalignment: Vector = (0.0, 0.0, 0.0)
    gyr_misalignment: Vector = (0.0, 0.0, 0.0)
    acc_scale_sigma: _NonNegative = 0.0
    gyr_scale_sigma: _NonNegative = 0.0
    acc_misalignment_sigma: _NonNegative = 0.0
    gyr_misalignment_sigma: _NonNegative = 0.0
    acc_warmup_sigma: _NonNegative = 0.0
    gyr_warmup_sigma: _NonNegative = 0.0
    warmup_s: Annotated[float, msgspec.Meta(gt=0)] = 10.0
    strap_acc: _NonNegative = 0.0
    strap_gyr: _NonNegative = 0.0
    strap_s: Annotated[float, msgspec.Meta(gt=0)] = 0.05
    quantize: bool = True
    clip: bool = True


IDEAL = ImuErrors(
    acc_bias_sigma=0.0,
    gyr_bias_sigma=0.0,
    acc_bias_walk=0.0,
    gyr_bias_walk=0.0,
    acc_noise=0.0,
    gyr_noise=0.0,
    quantize=False,
    clip=False,
)
"""A sensor without errors."""

MPU6050_1 = ImuErrors(gyr_bias=(0.017, 0.0065, 0.0035), acc_scale=(-0.022, -0.022, -0.022))
"""Sensor 1 of the real device: 0.96-0.98 g at rest, about 1 °/s of bias."""
MPU6050_2 = ImuErrors(gyr_bias=(-0.0126, 0.0015, -0.0132), acc_scale=(0.002, 0.002, 0.002))
"""Sensor 2 of the real device: 1.00 g at rest."""


UNKIND = {
    "acc_bias_sigma": 0.055,
    "gyr_bias_walk": 5e-5,
    "acc_scale_sigma": 0.004,
    "gyr_scale_sigma": 0.0025,
    "acc_misalignment_sigma": 0.0065,
    "gyr_misalignment_sigma": 0.004,
    "acc_warmup_sigma": 0.02,
    "gyr_warmup_sigma": 0.0006,
    "strap_acc": 0.02,
    "strap_gyr": 0.005,
}
"""What a worn, uncalibrated device adds: until unclipped simulated walks end as far off as real ones."""


class SimulatedImu:
    """One sensor in the course of a recording: the drawn turn-on bias, the wandering bias, the noise.

    Parameters
    ----------
    errors : ImuErrors
        What it does wrong.
    rate_hz : float
        Nominal rate, which turns noise densities into standard deviations.
    acc_lsb, gyr_lsb : float
        One count (m/s², rad/s).
    rng : numpy.random.Generator
        Own stream of random numbers.
    """

    def __init__(
        self, errors: ImuErrors, rate_hz: float, acc_lsb: float, gyr_lsb: float, rng: np.random.Generator
    ) -> None:
        self.errors = errors
        self._rng = rng
        self._rate = rate_hz
        self._lsb = np.repeat([acc_lsb, gyr_lsb], 3)
        e = errors
        sigma = np.repeat([e.acc_bias_sigma, e.gyr_bias_sigma], 3)
        self.turn_on_bias = np.concatenate((e.acc_bias, e.gyr_bias)) + sigma * rng.standard_normal(6)
        """Bias at the first sample: accelerometer (m/s²), gyroscope (rad/s)."""
        self._bias = self.turn_on_bias
        self._walk = np.repeat([e.acc_bias_walk, e.gyr_bias_walk], 3) / np.sqrt(rate_hz)
        self._noise = np.repeat([e.acc_noise, e.gyr_noise], 3) * np.sqrt(rate_hz)
        drawn = rng.standard_normal((4, 3)) if self._is_drawn(e) else np.zeros((4, 3))
        self._acc = _response(
            np.asarray(e.acc_scale) + e.acc_scale_sigma * drawn[0],
            np.asarray(e.acc_misalignment) + e.acc_misalignment_sigma * drawn[1],
        )
        self._gyr = _response(
            np.asarray(e.gyr_scale) + e.gyr_scale_sigma * drawn[2],
            np.asarray(e.gyr_misalignment) + e.gyr_misalignment_sigma * drawn[3],
        )
        warmup = np.repeat([e.acc_warmup_sigma, e.gyr_warmup_sigma], 3)
        self._warmup = warmup * rng.standard_normal(6) if warmup.any() else np.zeros(6)
        self._taken = 0
        self._strap = np.zeros(6)

    @staticmethod
    def _is_drawn(e: ImuErrors) -> bool:
        sigmas = (e.acc_scale_sigma, e.gyr_scale_sigma, e.acc_misalignment_sigma, e.gyr_misalignment_sigma)
        return any(sigmas)  # a device without them keeps the random numbers that it had

    def read(self, acc_b: FloatArray, gyr_b: FloatArray) -> FloatArray:
        """Return readings (n, 6), acceleration (m/s²) and angular rate (rad/s), of the next ``n`` samples."""
        n = len(acc_b)
        wander = self._walk * self._rng.standard_normal((n, 6))
        noise = self._noise * self._rng.standard_normal((n, 6))
        bias = self._bias + np.cumsum(wander, axis=0)
        if n:
            self._bias = bias[-1]
        since = (self._taken + np.arange(n)) / self._rate
        bias = bias + self._warmup * (1.0 - np.exp(-since / self.errors.warmup_s))[:, None]
        self._taken += n
        reading = np.hstack((acc_b @ self._acc.T, gyr_b @ self._gyr.T)) + bias + noise
        reading += self._strap_errors(acc_b, gyr_b)
        if self.errors.clip:
            reading = np.clip(reading, -32768 * self._lsb, 32767 * self._lsb)
        if self.errors.quantize:
            reading = np.round(reading / self._lsb) * self._lsb
        return reading

    def _strap_errors(self, acc_b: FloatArray, gyr_b: FloatArray) -> FloatArray:
        """Return shares of acceleration and rate, (n, 6), that last for about ``strap_s`` each."""
        e = self.errors
        if not (e.strap_acc or e.strap_gyr):
            return np.zeros((len(acc_b), 6))
        from scipy.signal import lfilter

        keep = float(np.exp(-1.0 / (self._rate * e.strap_s)))
        drawn = np.sqrt(1.0 - keep * keep) * self._rng.standard_normal((len(acc_b), 6))
        share, last = lfilter([1.0], [1.0, -keep], drawn, axis=0, zi=keep * self._strap[None])
        self._strap = last[0] / keep if len(acc_b) else self._strap
        moving = np.abs(np.linalg.norm(acc_b, axis=1) - STANDARD_GRAVITY)
        turning = np.linalg.norm(gyr_b, axis=1)
        size = np.hstack(
            [
                np.repeat((e.strap_acc * moving)[:, None], 3, 1),
                np.repeat((e.strap_gyr * turning)[:, None], 3, 1),
            ]
        )
        return share * size

    def counts(self, reading: FloatArray) -> np.ndarray:
        """Return readings as the converter's int16 counts.

        Shapes: ``reading`` and result (n, 6).
        """
        return np.clip(np.round(reading / self._lsb), -32768, 32767).astype(np.int16)


def _response(scale: FloatArray, misalignment: FloatArray) -> FloatArray:
    """Return diag(1 + scale) (I + [misalignment]×)."""
    x, y, z = misalignment
    skew = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return (1.0 + np.asarray(scale))[:, None] * (np.eye(3) + skew)
