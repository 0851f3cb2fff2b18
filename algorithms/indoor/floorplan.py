"""The floor plan of a recording as a raster of cells that can be walked.

``plan.geojson`` is a FeatureCollection in the plan's metres; a feature's property ``kind`` is ``wall`` (lines),
``obstacle`` (areas that cannot be entered), ``passable`` (areas that can; where there is one, all else cannot) or
another word, which this ignores; ``stairs`` (areas: stairs, lifts) are walked like others, and there alone floors are
changed. A feature's ``floor`` says on which floor it is; without it, it is on all.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..contract import AlgorithmError, Context, FloatArray
from .storeys import floor_of

ATTACHMENT = "plan.geojson"
CELL_M = 0.25
CLOSED, OPEN, STAIRS = 0, 1, 2
"""What a cell is; from :data:`STAIRS` the other floors are reached."""
AROUND_M = 3.0
"""How far around the anchors one may be where the plan says stairs alone."""
STAIRS_M = 1.0
"""So far around stairs a position may be and still mean them."""


def raster_of(
    context: Context, floors: Sequence[int] = (0,), anchors: FloatArray | None = None, cell_m: float = CELL_M
) -> tuple[FloatArray, float, Any] | None:
    """Return lower corner (2,), side of a cell (m) and cells by floor (floors, nx, ny); None where no plan says any.

    A plan that has nothing but stairs reaches as far as the ``anchors`` (m), shape (n, 2).
    """
    if ATTACHMENT not in context.attachments:
        return None
    import shapely

    try:
        plan = json.loads(context.attachments[ATTACHMENT])
        features = [
            (f.get("properties") or {}, floor_of(f), shapely.geometry.shape(f["geometry"]))
            for f in plan["features"]
        ]
    except (ValueError, KeyError, TypeError, AttributeError, shapely.errors.GEOSException) as error:
        raise AlgorithmError(f"attachment {ATTACHMENT}: not a GeoJSON FeatureCollection: {error!r}") from None
    kinds = ("wall", "obstacle", "passable", "stairs")
    drawn = [(p["kind"], floor, g) for p, floor, g in features if p.get("kind") in kinds]
    everything = [g for _, _, g in drawn]
    if not everything:
        return None
    if anchors is not None and {kind for kind, _, _ in drawn} == {"stairs"}:
        everything.append(shapely.MultiPoint(anchors).buffer(AROUND_M))
    x0, y0, x1, y1 = shapely.total_bounds(everything)
    if not np.isfinite([x0, y0, x1, y1]).all() or max(x1 - x0, y1 - y0) > 5000 or max(x1 - x0, y1 - y0) <= 0:
        raise AlgorithmError(
            f"attachment {ATTACHMENT}: reaches from ({x0}, {y0}) to ({x1}, {y1}); it must be in metres"
        )
    low = np.array([x0, y0]) - cell_m
    nx, ny = math.ceil((x1 - low[0]) / cell_m) + 1, math.ceil((y1 - low[1]) / cell_m) + 1
    x, y = low[0] + cell_m * (np.arange(nx) + 0.5), low[1] + cell_m * (np.arange(ny) + 0.5)
    gx, gy = np.meshgrid(x, y, indexing="ij")
    cells = np.stack(
        [
            _cells([(kind, g) for kind, floor, g in drawn if floor in (None, number)], gx, gy, cell_m)
            for number in floors
        ]
    )
    if not cells.any():
        raise AlgorithmError(f"attachment {ATTACHMENT}: no cell of {cell_m:g} m can be walked")
    return low, cell_m, cells


def _cells(drawn: Sequence[tuple[str, Any]], gx: FloatArray, gy: FloatArray, cell_m: float) -> Any:
    """Return what the cells of a floor are, by the shapes drawn on it; ``gx``, ``gy``: their middles (m), (nx, ny)."""
    import shapely

    by_kind = {kind: shapely.union_all([g for k, g in drawn if k == kind]) for kind, _ in drawn}
    cells = np.ones(gx.shape, dtype=bool)
    if "passable" in by_kind:
        cells = shapely.contains_xy(by_kind["passable"], gx, gy)
    if "obstacle" in by_kind:
        cells &= ~shapely.contains_xy(by_kind["obstacle"], gx, gy)
    if "stairs" in by_kind:
        cells |= shapely.contains_xy(by_kind["stairs"], gx, gy)
    if "wall" in by_kind:  # as thick as no straight move between neighbouring cells can pass
        cells &= ~shapely.contains_xy(by_kind["wall"].buffer(0.71 * cell_m), gx, gy)
    kinds = np.where(cells, OPEN, CLOSED).astype(np.uint8)
    if "stairs" in by_kind:
        kinds[cells & shapely.contains_xy(by_kind["stairs"].buffer(STAIRS_M), gx, gy)] = STAIRS
    return kinds
