"""Surveyed places: what is heard where, and how well they cover the floor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..contract import AlgorithmError, Context, FloatArray

GRID_M = 0.5


@dataclass(frozen=True)
class Place:
    """A fingerprint.

    Attributes
    ----------
    where : ndarray
        x, y, z (m).
    powers : mapping of str to float
        Mean power (dBm) by transmitter.
    count : int
        Powers behind the mean of the transmitter that was heard most.
    """

    where: FloatArray
    powers: Mapping[str, float]
    count: int

    def as_dict(self) -> dict[str, Any]:
        """Return it as it lies in a calibration."""
        x, y, z = (float(v) for v in self.where)
        return {"x": x, "y": y, "z": z, "count": self.count, "powers": dict(self.powers)}


def places_of(context: Context) -> list[Place]:
    """Return the surveyed places of the calibration ``radio``.

    Raises
    ------
    AlgorithmError
        There are none; says how to get them.
    """
    calibration = context.calibrations.get("radio")
    places = calibration.values.get("places", []) if calibration is not None and calibration.usable else []
    if not places:
        raise AlgorithmError(
            "no radio map: calibrate one from a survey (marcha calibrate radio SURVEY -o radio.json) and give it with "
            "--calibration radio.json"
        )
    return [Place(np.array([p["x"], p["y"], p["z"]]), p["powers"], int(p.get("count", 1))) for p in places]


def coverage(where: Sequence[FloatArray]) -> dict[str, float]:
    """Return how well places cover the floor: the area of their convex hull and distances to the nearest place.

    Parameters
    ----------
    where : sequence of ndarray, shape (2,) or more
        x, y, … of each place (m).

    Returns
    -------
    dict of str to float
        ``area_m2``; ``median_m``, ``p95_m`` and ``most_m`` of the distance from points of the hull to the nearest
        place. 0 where places lie on a line.
    """
    import shapely
    from scipy.spatial import KDTree

    points = np.array([w[:2] for w in where], dtype=np.float64).reshape(-1, 2)
    hull = shapely.MultiPoint(points).convex_hull
    empty = {"area_m2": float(hull.area), "median_m": 0.0, "p95_m": 0.0, "most_m": 0.0}
    if hull.area <= 0:
        return empty
    x0, y0, x1, y1 = hull.bounds
    step = max(GRID_M, (hull.area / 1e5) ** 0.5)
    gx, gy = np.meshgrid(np.arange(x0, x1 + step, step), np.arange(y0, y1 + step, step))
    inside = shapely.contains_xy(hull, gx, gy)
    if not inside.any():
        return empty
    far, _ = KDTree(points).query(np.column_stack([gx[inside], gy[inside]]))
    return empty | {
        "median_m": float(np.median(far)),
        "p95_m": float(np.percentile(far, 95)),
        "most_m": float(far.max()),
    }
