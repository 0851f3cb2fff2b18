"""Received power over distance: log-distance model, and its parameters from measurements.

Sources: log-distance path loss with d0 = 1 m (Rappaport 2002, eq. 4.69), its use for ranging and the
calibration of an anchor with trimmed means (hybrid indoor positioning, sections 3.1 and 4.4.2, eqs 3.1–3.6, 4.1–4.2).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..contract import AlgorithmError, FloatArray

LIGHT_M_S = 299_792_458.0
USUAL_ETA = (1.0, 6.0)
"""Path-loss exponents outside of this are doubted (indoors 1.6 in sight … 6 out of sight)."""


def free_space_loss_db(distance_m: ArrayLike, frequency_hz: float) -> FloatArray:
    """Return the loss between isotropic antennas in free space, dB (eq 3.1: L = (4 π d / λ)²)."""
    d = np.asarray(distance_m, dtype=np.float64)
    return 20.0 * np.log10(4.0 * math.pi * d * frequency_hz / LIGHT_M_S)


def power_dbm(distance_m: ArrayLike, p_d0_dbm: ArrayLike, eta: ArrayLike) -> FloatArray:
    """Return the received power at a distance (m), dBm: P_d0 − 10 η log10 d (eqs 3.3–3.4, d0 = 1 m)."""
    d = np.asarray(distance_m, dtype=np.float64)
    return np.asarray(p_d0_dbm) - 10.0 * np.asarray(eta) * np.log10(d)


def distance_m(power: ArrayLike, p_d0_dbm: ArrayLike, eta: ArrayLike) -> FloatArray:
    """Return the distance (m) at which ``power`` (dBm) is received (eq 3.6)."""
    return np.asarray(10.0 ** ((np.asarray(p_d0_dbm) - np.asarray(power)) / (10.0 * np.asarray(eta))))


def plane_range_m(slope_range_m: ArrayLike, height_difference_m: ArrayLike) -> FloatArray:
    """Return the range in the plane of one along the slope, 0 where that is shorter than the height."""
    square = np.asarray(slope_range_m) ** 2 - np.asarray(height_difference_m) ** 2
    return np.sqrt(np.maximum(square, 0.0))


def trimmed_mean(samples: ArrayLike, drop: int = 5) -> float:
    """Return the mean without the ``drop`` largest and smallest samples (section 4.4.2).

    Of fewer than 2 · drop + 1 samples the same share (a tenth at each end) is dropped.
    """
    ordered = np.sort(np.asarray(samples, dtype=np.float64))
    if not ordered.size:
        raise AlgorithmError("mean of no samples")
    cut = drop if ordered.size > 2 * drop else ordered.size // 10
    return float(ordered[cut : ordered.size - cut].mean())


@dataclass(frozen=True)
class PathLoss:
    """Parameters of the log-distance model of one anchor.

    Attributes
    ----------
    p_d0_dbm : float
        Power at 1 m.
    eta : float
        Path-loss exponent.
    residual_db : float
        Root mean square of what the model leaves of the measured powers.
    eta_by_distance : tuple of float
        By the source's way: the exponent that each distance gives.
    covariance : ndarray
        Of (P_d0, η), shape (2, 2); NaN where there are too few distances for one.
    """

    p_d0_dbm: float
    eta: float
    residual_db: float
    eta_by_distance: tuple[float, ...] = ()
    covariance: FloatArray | None = None

    @property
    def doubt(self) -> str:
        """What is unusual about it, empty where nothing is."""
        low, high = USUAL_ETA
        return "" if low <= self.eta <= high else f"η = {self.eta:.2f} is outside of {low:g} … {high:g}"


def calibrate_by_distances(distances_m: ArrayLike, powers_dbm: ArrayLike) -> PathLoss:
    """Return the parameters by the source's way (section 4.4.2, eq 4.2).

    P_d0 is the power at 1 m, η the mean of (P_d0 − P(d)) / (10 log10 d) over the other distances.

    Raises
    ------
    AlgorithmError
        There is no power at 1 m, or at no other distance.
    """
    d, p = _pairs(distances_m, powers_dbm)
    one = np.abs(d - 1.0) < 0.005
    if not one.any() or one.all():
        raise AlgorithmError(
            "the source's calibration needs the power at 1 m and at other distances; measured at "
            f"{', '.join(f'{x:g}' for x in np.unique(d)[:12])} m; use the regression"
        )
    p_d0 = float(p[one].mean())
    etas = (p_d0 - p[~one]) / (10.0 * np.log10(d[~one]))
    eta = float(etas.mean())
    left = p - power_dbm(d, p_d0, eta)
    return PathLoss(p_d0, eta, float(np.sqrt(np.mean(left**2))), tuple(etas.tolist()))


def regress(distances_m: ArrayLike, powers_dbm: ArrayLike) -> PathLoss:
    """Return P_d0 and η together by least squares on log10 of the distance.

    Raises
    ------
    AlgorithmError
        Fewer than two different distances.
    """
    d, p = _pairs(distances_m, powers_dbm)
    if np.ptp(np.log10(d)) < 1e-6:
        raise AlgorithmError(f"η cannot be told from powers at one distance ({d[0]:g} m); measure at others")
    design = np.column_stack([np.ones(d.size), -10.0 * np.log10(d)])
    solution, *_ = np.linalg.lstsq(design, p, rcond=None)
    left = p - design @ solution
    covariance = np.full((2, 2), np.nan)
    if d.size > 2:
        covariance = np.linalg.inv(design.T @ design) * float(left @ left) / (d.size - 2)
    return PathLoss(
        float(solution[0]), float(solution[1]), float(np.sqrt(np.mean(left**2))), covariance=covariance
    )


def _pairs(distances_m: ArrayLike, powers_dbm: ArrayLike) -> tuple[FloatArray, FloatArray]:
    d = np.asarray(distances_m, dtype=np.float64)
    p = np.asarray(powers_dbm, dtype=np.float64)
    if d.shape != p.shape or d.ndim != 1 or not d.size:
        raise AlgorithmError(f"distances and powers must pair up, not {d.shape} and {p.shape}")
    if not (np.isfinite(p).all() and np.isfinite(d).all() and (d > 0).all()):
        raise AlgorithmError("distances must be positive, powers finite")
    return d, p
