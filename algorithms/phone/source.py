"""The dissertation's chain over a whole record at once (batch), in NumPy.

The streaming stages differ from it where they must: the intervals' statistics are those so far, the median
trails. :func:`source_steps` with ``so_far=True`` is the streaming rule: equal to ``phone.steps`` with ``peaks``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..contract import FloatArray, IntArray


def extremes(a: FloatArray, half: int | None = None) -> tuple[IntArray, IntArray]:
    """Return places of local peaks and valleys; a plateau counts once, at its first sample.

    Parameters
    ----------
    a : ndarray
        Signal, shape (n,).
    half : int, optional
        Longest plateau that is looked at, in samples; any by default.
    """
    a = np.asarray(a, dtype=np.float64)
    change = np.flatnonzero(np.diff(a) != 0)  # a[i] != a[i + 1]
    if len(change) < 2:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    first, last = change[:-1] + 1, change[1:]  # runs of equal samples between two changes
    rises, falls = a[first] > a[first - 1], a[last + 1] < a[last]
    short = np.ones(len(first), bool) if half is None else last + 1 - first <= half
    return first[rises & falls & short], first[~rises & ~falls & short]


def limits(a: FloatArray, half: int, printed: bool = False) -> tuple[FloatArray, FloatArray]:
    """Return upper and lower limit mean ± σ over 2w + 1 centred samples (eqs 3.2–3.5); NaN at both ends.

    Parameters
    ----------
    a : ndarray
        Norm of the acceleration (m/s²), shape (n,).
    half : int
        w.
    printed : bool
        σ by eq 3.3 as printed: about each sample's own local mean.
    """
    a = np.asarray(a, dtype=np.float64)
    upper, lower = np.full(len(a), np.nan), np.full(len(a), np.nan)
    width = 2 * half + 1
    if len(a) < width:
        return upper, lower
    windows = np.lib.stride_tricks.sliding_window_view(a, width)
    mean = np.full(len(a), np.nan)
    mean[half : len(a) - half] = windows.mean(axis=1)
    sigma = np.full(len(a), np.nan)
    if printed:
        away = (a - mean) ** 2
        sigma[half : len(a) - half] = np.sqrt(
            np.lib.stride_tricks.sliding_window_view(away, width).mean(axis=1)
        )
    else:
        sigma[half : len(a) - half] = windows.std(axis=1)
    return mean + sigma, mean - sigma


def thin(t_s: FloatArray, so_far: bool = False) -> NDArray[np.bool_]:
    """Return which extremes stay: later than mean − σ of the intervals after the one before that stayed.

    Shapes: ``t_s`` (s) and result (n,).

    Eqs 3.6–3.9. The earlier of a cluster stays. With ``so_far`` the statistics are those of the intervals
    before each extreme, as sample by sample; none is rejected before there are two.
    """
    keep = np.zeros(len(t_s), bool)
    gaps = np.diff(t_s)
    least = float(gaps.mean() - gaps.std()) if len(gaps) else 0.0
    previous = -np.inf
    for i, t in enumerate(t_s):
        if so_far:
            seen = gaps[: max(0, i - 1)]
            least = float(seen.mean() - seen.std()) if len(seen) >= 2 else 0.0
        if t - previous > least:
            keep[i] = True
            previous = t
    return keep


def source_steps(
    t_s: FloatArray, norm: FloatArray, half: int = 15, *, printed: bool = False, so_far: bool = False
) -> IntArray:
    """Return the places of the peaks that are steps: each with its adjacent valley (section 3.1.2).

    Parameters
    ----------
    t_s, norm : ndarray
        Time (s) and ‖a‖ (m/s²), shape (n,).
    half : int
        w of the magnitude filter; 15 at 20 Hz.
    printed, so_far : bool
        See :func:`limits` and :func:`thin`.
    """
    upper, lower = limits(norm, half, printed)
    peaks, valleys = extremes(norm, half)
    peaks, valleys = peaks[norm[peaks] > upper[peaks]], valleys[norm[valleys] < lower[valleys]]
    peaks, valleys = peaks[thin(t_s[peaks], so_far)], valleys[thin(t_s[valleys], so_far)]
    steps: list[int] = []
    waiting = -1
    for place, is_peak in sorted([(int(p), True) for p in peaks] + [(int(v), False) for v in valleys]):
        if is_peak and waiting < 0:
            waiting = place
        elif not is_peak and waiting >= 0:
            steps.append(waiting)
            waiting = -1
    return np.array(steps, np.int64)


def source_headings(mag: FloatArray, window: int = 20, *, centred: bool = True) -> FloatArray:
    """Return H (rad, clockwise from magnetic north), median-filtered over ``window`` samples (eqs 3.17, 3.18).

    Parameters
    ----------
    mag : ndarray
        Field in Android's axes, any unit, shape (n, 3).
    window : int
        Samples: 20 at 20 Hz. Cut off at the ends.
    centred : bool
        Section 3.1.6; else trailing, section 2.4.5.
    """
    h = np.unwrap(np.arctan2(-mag[:, 0], mag[:, 1]))
    before = window // 2 if centred else window - 1
    after = window - 1 - before
    return np.array([np.median(h[max(0, i - before) : i + after + 1]) for i in range(len(h))])
