"""What a real sensor makes of the truth: scale, misalignment, bias, noise, quantization, clipping."""

from __future__ import annotations

from typing import Annotated

import msgspec
import numpy as np

from .gait import FloatArray

Vector = tuple[float, float, float]
_NonNegative = Annotated[float, msgspec.Meta(ge=0)]

STANDARD_GRAVITY = 9.80665
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
        self._acc = _response(e.acc_scale, e.acc_misalignment)
        self._gyr = _response(e.gyr_scale, e.gyr_misalignment)

    def read(self, acc_b: FloatArray, gyr_b: FloatArray) -> FloatArray:
        """Return readings (n, 6), acceleration (m/s²) and angular rate (rad/s), of the next ``n`` samples."""
        n = len(acc_b)
        wander = self._walk * self._rng.standard_normal((n, 6))
        noise = self._noise * self._rng.standard_normal((n, 6))
        bias = self._bias + np.cumsum(wander, axis=0)
        if n:
            self._bias = bias[-1]
        reading = np.hstack((acc_b @ self._acc.T, gyr_b @ self._gyr.T)) + bias + noise
        if self.errors.clip:
            reading = np.clip(reading, -32768 * self._lsb, 32767 * self._lsb)
        if self.errors.quantize:
            reading = np.round(reading / self._lsb) * self._lsb
        return reading

    def counts(self, reading: FloatArray) -> np.ndarray:
        """Return readings as the converter's int16 counts."""
        return np.clip(np.round(reading / self._lsb), -32768, 32767).astype(np.int16)


def _response(scale: Vector, misalignment: Vector) -> FloatArray:
    """Return diag(1 + scale) (I + [misalignment]×)."""
    x, y, z = misalignment
    skew = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return (1.0 + np.asarray(scale))[:, None] * (np.eye(3) + skew)
