"""A continuous radio map: what each anchor's power is expected to be over the plan, with its doubt.

Gaussian process of the powers of surveyed points about the log-distance model of the anchor (Ferris et al. 2006,
"Gaussian processes for signal strength-based location estimation", section III).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..contract import Context, FloatArray
from .anchors import Anchors, device_of, spread_of
from .storeys import Storeys

LENGTH_M = 8.0
"""Distance over which a deviation from the model is felt; rooms, not centimetres."""
LEAST_POINTS = 3
"""Points that an anchor needs for a map."""
WEAK = np.array([[149.0, 7.0], [7.0, 1.0]])
"""Covariance of (P_d0, η) where a calibration does not say what anchors differ by: 10 dB at 5 m, and 1 of η."""
MARGIN_M = 3.0
CELL_M = 0.5
FURTHER_DB = 4.0
"""Loss of each further floor (ITU-R P.1238, table 3)."""


@dataclass(frozen=True)
class RadioMap:
    """Expected powers on a grid of each floor.

    Attributes
    ----------
    low : ndarray
        Lower corner (m), shape (2,).
    cell : float
        Distance of the grid's points (m).
    mean, sd : ndarray
        dBm and dB, shape (floors, anchors, nx, ny).
    mapped : ndarray of bool
        Anchors that enough points heard, shape (anchors,); the others have the mean of their model and no ``sd``.
    """

    low: FloatArray
    cell: float
    mean: FloatArray
    sd: FloatArray
    mapped: NDArray[np.bool_]


def map_of(
    context: Context, anchors: Anchors, height_m: float, storeys: Storeys | None = None, floor_db: float = 0.0
) -> RadioMap | None:
    """Return the map of the calibration's surveyed points; None where no anchor has three.

    Each anchor's P_d0 and η are part of the process (Rasmussen and Williams 2006, section 2.7), with what the anchors
    of its technology differ by as prior; what is left has the variance that all anchors' residuals have together,
    half of it room-sized (:data:`LENGTH_M`), half within a wavelength. The doubt has all three. Points of another floor
    than a grid's say what the model is, and nothing of that floor's rooms.

    Parameters
    ----------
    context : Context
        With the calibration ``radio``.
    anchors : Anchors
        Anchors of the map.
    height_m : float
        Of the receiver above its floor (m).
    storeys : Storeys, optional
        Floors of the building; default: those of anchors and plan.
    floor_db : float
        Loss of the slab between two floors (dB); see :func:`slab_loss_db`.
    """
    calibration = context.calibrations.get("radio")
    if calibration is None or not calibration.usable or not len(anchors):
        return None
    points = {str(a["mac"]): a.get("points", []) for a in calibration.values.get("anchors", ())}
    mine = [np.array(points.get(mac, []), dtype=np.float64).reshape(-1, 4) for mac in anchors.macs]
    mapped = np.array([len(m) >= LEAST_POINTS for m in mine])
    if not mapped.any():
        return None
    if storeys is None:
        storeys = anchors.storeys(context)
    surveyed = np.vstack([*(m[:, :2] for m in mine), anchors.plane])
    low = surveyed.min(axis=0) - MARGIN_M
    nx, ny = (np.ceil((surveyed.max(axis=0) + MARGIN_M - low) / CELL_M).astype(int) + 1).tolist()
    axes = low[0] + CELL_M * np.arange(nx), low[1] + CELL_M * np.arange(ny)
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    offset = float(calibration.values.get("offsets_db", {}).get(device_of(context.metadata), 0.0))
    height = storeys.levels[storeys.of_anchor] + storeys.above
    floors = [storeys.at(m[:, 2]) for m in mine]
    losses = [slab_loss_db(f - storeys.of_anchor[k], floor_db) for k, f in enumerate(floors)]
    designs = [_design(anchors, k, m[:, :2], m[:, 2] - height[k]) for k, m in enumerate(mine)]
    heard = [m[:, 3] + loss for m, loss in zip(mine, losses, strict=True)]
    shape = (len(storeys), len(mine), nx * ny)
    mean, sd = np.empty(shape), np.full(shape, np.nan)
    for floor, k in np.ndindex(shape[:2]):
        up = storeys.levels[floor] + height_m - height[k]
        where = _design(anchors, k, grid, np.full(len(grid), up))
        loss = float(slab_loss_db(floor - storeys.of_anchor[k], floor_db))
        mean[floor, k] = where @ [anchors.p_d0[k], anchors.eta[k]] - loss
        if not mapped[k]:
            continue
        m, design, technology = mine[k], designs[k], anchors.technology[k]
        alike = [j for j in np.flatnonzero(mapped).tolist() if anchors.technology[j] == technology]
        variance = _residual_variance([(designs[j], heard[j]) for j in alike])
        prior, spread = spread_of(calibration.values, technology) or (_common(designs, heard, alike), WEAK)
        between = np.linalg.norm(m[:, None, :2] - m[None, :, :2], axis=2)
        apart = np.linalg.norm(grid[:, None] - m[None, :, :2], axis=2)
        together, here = floors[k][:, None] == floors[k][None, :], floors[k][None, :] == floor
        cross = 0.5 * variance * np.exp(-apart / LENGTH_M) * here + where @ spread @ design.T
        covariance = (
            0.5 * variance * (np.exp(-between / LENGTH_M) * together + np.eye(len(m)))
            + design @ spread @ design.T
        )
        weights = np.linalg.solve(covariance, cross.T).T
        mean[floor, k] = where @ prior + weights @ (heard[k] - design @ prior) + offset - loss
        whole = variance + np.einsum("ij,jk,ik->i", where, spread, where)
        sd[floor, k] = np.sqrt(np.maximum(whole - np.einsum("ij,ij->i", weights, cross), 1.0))
    return RadioMap(low, CELL_M, mean.reshape(*shape[:2], nx, ny), sd.reshape(*shape[:2], nx, ny), mapped)


def slab_loss_db(floors: NDArray[np.integer[Any]] | int, floor_db: float) -> FloatArray:
    """Return the loss through slabs (dB): ``floor_db``, and :data:`FURTHER_DB` for each further one.

    At 2.4 GHz and in offices ``floor_db`` is 15 dB (ITU-R P.1238, table 3: 15 + 4 (n − 1)). ``floors``: how many are
    between transmitter and receiver, shape (n,) or one.
    """
    n = np.abs(np.asarray(floors))
    return np.where(n > 0, floor_db + FURTHER_DB * (n - 1.0), 0.0) if floor_db > 0 else np.zeros(n.shape)


def _design(anchors: Anchors, k: int, where: FloatArray, up: FloatArray) -> FloatArray:
    """Return the log-distance model's rows (1, −10 log10 d) at places (n, 2), shape (n, 2)."""
    square = ((where - anchors.plane[k]) ** 2).sum(axis=1) + np.where(np.isnan(up), 0.0, up) ** 2
    return np.column_stack([np.ones(len(where)), -5.0 * np.log10(np.maximum(square, 0.09))])


def _common(designs: list[FloatArray], heard: list[FloatArray], alike: list[int]) -> FloatArray:
    """Return P_d0 and η of anchors taken together."""
    rows, powers = np.vstack([designs[j] for j in alike]), np.concatenate([heard[j] for j in alike])
    return np.asarray(np.linalg.lstsq(rows, powers, rcond=None)[0], dtype=np.float64)


def _residual_variance(parts: list[tuple[FloatArray, FloatArray]]) -> float:
    """Return the variance (dB²) of what each anchor's own model leaves, of all together."""
    left = [p - design @ np.linalg.lstsq(design, p, rcond=None)[0] for design, p in parts]
    freedom = sum(len(r) - 2 for r in left)
    return max(float(sum(r @ r for r in left)) / max(freedom, 1), 1.0)


@dataclass(frozen=True)
class RadioField:
    """Powers over the floor by places alone, without anchors' positions.

    Attributes
    ----------
    grid : ndarray
        Points (m), shape (n, 2): all within reach of a surveyed place.
    mean, sd : ndarray
        dBm and dB, shape (transmitters, n).
    covered : ndarray of bool
        Transmitters that enough places heard, shape (transmitters,).
    """

    grid: FloatArray
    mean: FloatArray
    sd: FloatArray
    covered: NDArray[np.bool_]


def field_of(where: FloatArray, powers: FloatArray, anchors: FloatArray | None = None) -> RadioField:
    """Return a Gaussian process for each transmitter (Ferris et al. 2006), about a level that falls with distance.

    Mean: least squares of a constant and log distance to its anchor, or to the place where it is strongest where the
    anchor is not known.
    What is left has the variance of its residuals, half of it room-sized (:data:`LENGTH_M`), half within a
    wavelength. The grid reaches half the distance between neighbouring places beyond them (at least half a metre, at
    most :data:`MARGIN_M`), no farther: there nothing was surveyed.

    Parameters
    ----------
    where : ndarray
        Places (m), shape (m, 2).
    powers : ndarray
        dBm, NaN where not heard, shape (m, transmitters).
    anchors : ndarray, optional
        x, y (m) of each transmitter, NaN where not known, shape (transmitters, 2).
    """
    from scipy.spatial import KDTree

    tree = KDTree(where)
    apart = float(np.median(tree.query(where, k=2)[0][:, 1])) if len(where) > 1 else MARGIN_M
    margin = min(max(0.5 * apart, 0.5), MARGIN_M)
    low, high = where.min(axis=0) - margin, where.max(axis=0) + margin
    step = max(min(CELL_M, 0.25 * apart), float(np.sqrt(np.prod(high - low) / 20_000)), 0.05)
    axes = [np.arange(low[k], high[k] + step, step) for k in (0, 1)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    near, _ = tree.query(grid)
    grid = grid[near <= max(margin, 0.75 * apart)]
    count = powers.shape[1]
    mean, sd = np.full((count, len(grid)), np.nan), np.full((count, len(grid)), np.nan)
    covered = np.isfinite(powers).sum(axis=0) >= 3
    between = np.linalg.norm(where[:, None] - where[None], axis=2)
    cross = np.exp(-np.linalg.norm(grid[:, None] - where[None], axis=2) / LENGTH_M)
    for k in np.flatnonzero(covered).tolist():
        here = np.isfinite(powers[:, k])
        p = powers[here, k]
        top, blur = where[here][np.argsort(-p)[: max(1, here.sum() // 10)]].mean(axis=0), 1.0
        if anchors is not None and np.isfinite(anchors[k]).all():
            top, blur = anchors[k], 0.3
        design = np.column_stack([np.ones(here.sum()), _fall(where[here], top, blur)])
        (level, eta), *_ = np.linalg.lstsq(design, p, rcond=None)
        eta = min(max(eta, 0.0), 6.0)
        level = float(np.mean(p - eta * design[:, 1]))
        left = p - level - eta * design[:, 1]
        variance = max(float(np.mean(left**2)), 4.0)
        covariance = variance * (
            0.5 * np.exp(-between[np.ix_(here, here)] / LENGTH_M) + 0.5 * np.eye(here.sum())
        )
        weights = np.linalg.solve(covariance, 0.5 * variance * cross[:, here].T).T
        mean[k] = level + eta * _fall(grid, top, blur) + weights @ left
        spread = 0.5 * variance - np.einsum("ij,ij->i", weights, 0.5 * variance * cross[:, here])
        sd[k] = np.sqrt(np.maximum(spread, 0.0) + 0.25 * variance)
    return RadioField(grid, mean, sd, covered)


def _fall(where: FloatArray, top: FloatArray, blur_m: float) -> FloatArray:
    """Return −10 log10 of the distances (m) of places (n, 2) to ``top`` (2,), which is known to ``blur_m``."""
    return -10.0 * np.log10(blur_m + np.linalg.norm(where - top, axis=1))
