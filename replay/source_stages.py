"""The stages of the phone dissertation's detector over a channel, for whoever draws them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..algorithms.contract import FloatArray, IntArray
from ..algorithms.phone.source import extremes, limits, source_steps, thin

HALF_S = 0.75
"""w of the magnitude filter: 15 samples at 20 Hz."""


class SourceStages(NamedTuple):
    """What the detector makes of ‖a‖ (section 3.1.2); places are indices of samples.

    Attributes
    ----------
    upper, lower : ndarray, shape (n,)
        Limits mean ± σ (m/s²); NaN in the first and last w samples.
    peaks, valleys : ndarray of int64
        All local extremes.
    high, low : ndarray of int64
        Those beyond the limits.
    kept_high, kept_low : ndarray of int64
        Those that the temporal filter leaves.
    steps : ndarray of int64
        Peaks that are steps.
    """

    upper: FloatArray
    lower: FloatArray
    peaks: IntArray
    valleys: IntArray
    high: IntArray
    low: IntArray
    kept_high: IntArray
    kept_low: IntArray
    steps: IntArray


def source_stages(t_s: FloatArray, norm: FloatArray) -> SourceStages:
    """Return the stages, in batch.

    Parameters
    ----------
    t_s, norm : ndarray
        Time (s) and norm of the acceleration (m/s²), shape (n,).
    """
    half = max(1, round(HALF_S * (len(t_s) - 1) / max(float(t_s[-1] - t_s[0]), 1e-9))) if len(t_s) > 1 else 1
    upper, lower = limits(norm, half)
    peaks, valleys = extremes(norm, half)
    high, low = peaks[norm[peaks] > upper[peaks]], valleys[norm[valleys] < lower[valleys]]
    kept_high, kept_low = high[thin(t_s[high])], low[thin(t_s[low])]
    steps = np.asarray(source_steps(t_s, norm, half))
    return SourceStages(upper, lower, peaks, valleys, high, low, kept_high, kept_low, steps)
