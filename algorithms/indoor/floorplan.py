"""The floor plan of a recording as a raster of cells that can be walked.

``plan.geojson`` is a FeatureCollection in the plan's metres; a feature's property ``kind`` is ``wall`` (lines),
``obstacle`` (areas that cannot be entered), ``passable`` (areas that can; where there is one, all else cannot) or
another word, which this ignores.
"""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np

from ..contract import AlgorithmError, Context, FloatArray

ATTACHMENT = "plan.geojson"
CELL_M = 0.25


def raster_of(context: Context, cell_m: float = CELL_M) -> tuple[FloatArray, float, Any] | None:
    """Return lower corner (2,), side of a cell (m) and open cells (nx, ny); None where no plan says anything."""
    if ATTACHMENT not in context.attachments:
        return None
    import shapely

    try:
        plan = json.loads(context.attachments[ATTACHMENT])
        features = [
            (f.get("properties") or {}, shapely.geometry.shape(f["geometry"])) for f in plan["features"]
        ]
    except (ValueError, KeyError, TypeError, AttributeError, shapely.errors.GEOSException) as error:
        raise AlgorithmError(f"attachment {ATTACHMENT}: not a GeoJSON FeatureCollection: {error!r}") from None
    kinds = ("wall", "obstacle", "passable")
    by_kind = {k: [g for p, g in features if p.get("kind") == k] for k in kinds}
    everything = [g for shapes in by_kind.values() for g in shapes]
    if not everything:
        return None
    x0, y0, x1, y1 = shapely.total_bounds(everything)
    if not np.isfinite([x0, y0, x1, y1]).all() or max(x1 - x0, y1 - y0) > 5000 or max(x1 - x0, y1 - y0) <= 0:
        raise AlgorithmError(
            f"attachment {ATTACHMENT}: reaches from ({x0}, {y0}) to ({x1}, {y1}); it must be in metres"
        )
    low = np.array([x0, y0]) - cell_m
    nx, ny = math.ceil((x1 - low[0]) / cell_m) + 1, math.ceil((y1 - low[1]) / cell_m) + 1
    x, y = low[0] + cell_m * (np.arange(nx) + 0.5), low[1] + cell_m * (np.arange(ny) + 0.5)
    gx, gy = np.meshgrid(x, y, indexing="ij")
    cells = np.ones((nx, ny), dtype=bool)
    if by_kind["passable"]:
        cells = shapely.contains_xy(shapely.union_all(by_kind["passable"]), gx, gy)
    if by_kind["obstacle"]:
        cells &= ~shapely.contains_xy(shapely.union_all(by_kind["obstacle"]), gx, gy)
    if by_kind["wall"]:  # as thick as no straight move between neighbouring cells can pass
        walls = shapely.union_all(by_kind["wall"]).buffer(0.71 * cell_m)
        cells &= ~shapely.contains_xy(walls, gx, gy)
    if not cells.any():
        raise AlgorithmError(f"attachment {ATTACHMENT}: no cell of {cell_m:g} m can be walked")
    return low, cell_m, cells.astype(np.uint8)
