"""A continuous radio map: what each anchor's power is expected to be over the plan, with its doubt.

Gaussian process of the powers of surveyed points about the log-distance model of the anchor (Ferris et al. 2006,
"Gaussian processes for signal strength-based location estimation", section III).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..contract import Context, FloatArray
from .anchors import Anchors
from .pathloss import power_dbm

LENGTH_M = 8.0
"""Distance over which a deviation from the model is felt; rooms, not centimetres."""
MARGIN_M = 3.0
CELL_M = 0.5


@dataclass(frozen=True)
class RadioMap:
    """Expected powers on a grid.

    Attributes
    ----------
    low : ndarray
        Lower corner (m), shape (2,).
    cell : float
        Distance of the grid's points (m).
    mean, sd : ndarray
        dBm and dB, shape (anchors, nx, ny).
    """

    low: FloatArray
    cell: float
    mean: FloatArray
    sd: FloatArray


def map_of(context: Context, anchors: Anchors, height_m: float) -> RadioMap | None:
    """Return the map of the calibration's surveyed points; None where any anchor has fewer than three."""
    calibration = context.calibrations.get("radio")
    if calibration is None or not calibration.usable or not len(anchors):
        return None
    points = {str(a["mac"]): a.get("points", []) for a in calibration.values.get("anchors", ())}
    mine = [np.array(points.get(mac, []), dtype=np.float64).reshape(-1, 4) for mac in anchors.macs]
    if min(len(m) for m in mine) < 3:
        return None
    surveyed = np.vstack([*(m[:, :2] for m in mine), anchors.plane])
    low = surveyed.min(axis=0) - MARGIN_M
    nx, ny = (np.ceil((surveyed.max(axis=0) + MARGIN_M - low) / CELL_M).astype(int) + 1).tolist()
    axes = low[0] + CELL_M * np.arange(nx), low[1] + CELL_M * np.arange(ny)
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    mean, sd = np.empty((len(mine), nx * ny)), np.empty((len(mine), nx * ny))
    up = anchors.above(height_m)
    for k, m in enumerate(mine):
        expected = _model(anchors, k, m[:, :2], m[:, 2] - anchors.position[k, 2])
        # Half of what the model leaves is room-sized, half changes within a wavelength.
        variance = max(float(np.mean((m[:, 3] - expected) ** 2)), 1.0)
        between = np.linalg.norm(m[:, None, :2] - m[None, :, :2], axis=2)
        cross = 0.5 * variance * np.exp(-np.linalg.norm(grid[:, None] - m[None, :, :2], axis=2) / LENGTH_M)
        covariance = 0.5 * variance * (np.exp(-between / LENGTH_M) + np.eye(len(m)))
        weights = np.linalg.solve(covariance, cross.T).T
        mean[k] = _model(anchors, k, grid, np.full(len(grid), up[k])) + weights @ (m[:, 3] - expected)
        sd[k] = np.sqrt(np.maximum(0.5 * variance - np.einsum("ij,ij->i", weights, cross), 1.0))
    return RadioMap(low, CELL_M, mean.reshape(-1, nx, ny), sd.reshape(-1, nx, ny))


def _model(anchors: Anchors, k: int, where: FloatArray, up: FloatArray) -> FloatArray:
    square = ((where - anchors.plane[k]) ** 2).sum(axis=1) + np.where(np.isnan(up), 0.0, up) ** 2
    return power_dbm(np.sqrt(np.maximum(square, 0.09)), anchors.p_d0[k], anchors.eta[k])
