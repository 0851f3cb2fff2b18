"""What the anchors of a recording allow: bound, dilution and number heard over the plan, and a place for another."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..algorithms.calibration import Calibration
from ..algorithms.contract import AlgorithmError, Context, FloatArray
from ..algorithms.indoor.anchors import Anchors, anchors_of
from ..algorithms.indoor.floorplan import raster_of
from ..algorithms.indoor.lateration import geometry_map
from ..algorithms.indoor.pathloss import power_dbm
from ..algorithms.indoor.radio_map import map_of
from ..recording.errors import UsageError
from .calibrations import calibrations_of, calibrations_of_runs

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ..recording import Recording

REACH_M = 10.0
"""Reach of the source's calibration: anchors farther away do not count."""
CELLS = 2500
"""Most points of the map; a plan of 25 m × 8 m has 0.3 m then."""
CANDIDATES = 240


@dataclass(frozen=True)
class Geometry:
    """Maps over the plan; NaN where nobody can walk, infinite where anchors do not do.

    Attributes
    ----------
    x, y : ndarray
        Centres of the cells (m), shapes (nx,), (ny,).
    bound_m : ndarray
        Least standard deviation of a position from one power of each anchor in reach (Cramér–Rao; Patwari et al.
        2003, eq 14), shape (nx, ny).
    dilution, heard : ndarray
        Error of a position by that of a range; anchors in reach.
    extra : ndarray
        Where another anchor lowers the median bound most: x, y (m).
    extra_bound_m : ndarray
        The bound with it, shape (nx, ny).
    anchors : Anchors
        What was taken.
    """

    x: FloatArray
    y: FloatArray
    bound_m: FloatArray
    dilution: FloatArray
    heard: FloatArray
    extra: FloatArray
    extra_bound_m: FloatArray
    anchors: Anchors


def _context(rec: Recording, calibrations: Sequence[Calibration]) -> Context:
    names = ("anchors.csv", "plan.geojson")
    return Context(
        metadata=rec.metadata,
        attachments={a.name: rec.attachment(a.name) for a in rec.attachments if a.name in names},
        calibrations={
            c.kind: c
            for c in (*calibrations_of(rec.metadata), *calibrations_of_runs(rec.metadata), *calibrations)
        },
    )


@dataclass(frozen=True)
class PowerMap:
    """Expected power of each anchor over the plan.

    Attributes
    ----------
    x, y : ndarray
        Points (m), shapes (nx,), (ny,).
    mean_dbm : ndarray
        Shape (anchors, nx, ny).
    anchors : Anchors
        In that order.
    surveyed : bool
        Whether it is a survey's radio map, else the log-distance models.
    """

    x: FloatArray
    y: FloatArray
    mean_dbm: FloatArray
    anchors: Anchors
    surveyed: bool


def power_map_of(
    rec: Recording, *, calibrations: Sequence[Calibration] = (), height_m: float = 1.2
) -> PowerMap:
    """Return what each anchor's power is expected to be over the plan: of the survey, else of the models.

    Raises
    ------
    UsageError
        No anchors, or no parameters of any.
    """
    context = _context(rec, calibrations)
    try:
        anchors = anchors_of(context)
    except AlgorithmError as error:
        raise UsageError(f"{rec.path}: {error}") from None
    storeys = anchors.storeys(context)
    radio_map = map_of(context, anchors, height_m, storeys)
    if radio_map is not None:  # of each anchor's own floor
        own = radio_map.mean[storeys.of_anchor, np.arange(len(anchors))]
        nx, ny = own.shape[1:]
        x, y = (radio_map.low[k] + radio_map.cell * np.arange(n) for k, n in enumerate((nx, ny)))
        return PowerMap(x, y, own, anchors, True)
    low, high = anchors.plane.min(axis=0) - 2.0, anchors.plane.max(axis=0) + 2.0
    x, y = (np.linspace(low[k], high[k], 80) for k in (0, 1))
    gx, gy = np.meshgrid(x, y, indexing="ij")
    up = anchors.above(height_m)
    mean = [
        power_dbm(np.sqrt(np.maximum((gx - a[0]) ** 2 + (gy - a[1]) ** 2 + h**2, 0.09)), p, eta)
        for a, h, p, eta in zip(anchors.plane, up, anchors.p_d0, anchors.eta, strict=True)
    ]
    return PowerMap(x, y, np.array(mean), anchors, False)


def geometry_of(
    rec: Recording,
    *,
    calibrations: Sequence[Calibration] = (),
    reach_m: float = REACH_M,
    height_m: float = 1.2,
) -> Geometry:
    """Return what the anchors of a recording allow.

    Parameters
    ----------
    rec : Recording
        With the attachment ``anchors.csv`` and, where known, ``plan.geojson``.
    calibrations : sequence of Calibration
        Beside those that the recording carries.
    reach_m, height_m : float
        Anchors farther than this do not count; height of the receiver.

    Raises
    ------
    UsageError
        No anchors; says what to give.
    """
    context = _context(rec, calibrations)
    try:
        anchors = anchors_of(context)
        raster = raster_of(context, anchors.storeys(context).numbers, anchors.plane)
    except AlgorithmError as error:
        raise UsageError(f"{rec.path}: {error}") from None
    low, high = anchors.plane.min(axis=0) - 2.0, anchors.plane.max(axis=0) + 2.0
    open_cells = None
    if raster is not None:
        open_cells = raster[2].max(axis=0)  # on any floor
        low, high = raster[0], raster[0] + raster[1] * np.array(open_cells.shape)
    cell = max(0.25, float(np.sqrt(np.prod(high - low) / CELLS)))
    sigma, up = anchors.relative_sigma, anchors.above(height_m)

    def maps(extra: FloatArray | None = None) -> dict[str, FloatArray]:
        plane = anchors.plane if extra is None else np.vstack([anchors.plane, extra])
        one, above = (
            (sigma, up)
            if extra is None
            else (np.append(sigma, np.median(sigma)), np.append(up, np.median(up)))
        )
        return geometry_map(
            plane, one, low=tuple(low), high=tuple(high), cell_m=cell, reach_m=reach_m, heights=above
        )

    plain = maps()
    gx, gy = np.meshgrid(plain["x"], plain["y"], indexing="ij")
    walked = np.ones(gx.shape, dtype=bool)
    if raster is not None and open_cells is not None:
        cells = (np.stack([gx, gy]) - raster[0][:, None, None]) / raster[1]
        i, j = (np.clip(a.astype(int), 0, n - 1) for a, n in zip(cells, open_cells.shape, strict=True))
        walked = open_cells[i, j] > 0
    places = np.column_stack([gx[walked], gy[walked]])
    tried = places[:: max(1, len(places) // CANDIDATES)]
    scores = [float(np.median(np.minimum(maps(p)["bound_m"][walked], 1e3))) for p in tried]
    best = tried[int(np.argmin(scores))]
    more = maps(best)

    def shown(values: FloatArray) -> FloatArray:
        return np.where(walked, values, np.nan)

    return Geometry(
        plain["x"],
        plain["y"],
        shown(plain["bound_m"]),
        shown(plain["dilution"]),
        shown(plain["heard"]),
        best,
        shown(more["bound_m"]),
        anchors,
    )
