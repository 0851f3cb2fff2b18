"""Streets and an aerial picture that a recording carries, for maps (see ``marcha.ingest.underlay``)."""

from __future__ import annotations

import json
from dataclasses import dataclass, field

import numpy as np

from .floor import Loaders, picture_of, tried
from .floor import geojson_lines as lines_of
from .shapes import Floats


@dataclass(frozen=True)
class MapUnderlay:
    """What lies under a map.

    Attributes
    ----------
    streets : list of ndarray, shape (n, 2)
        Lines, latitude and longitude in degrees.
    picture : ndarray of uint8, shape (h, w, 3), or None
        North up.
    corners : tuple of float
        West, east, south and north edge of the picture (deg).
    """

    streets: list[Floats] = field(default_factory=list)
    picture: np.ndarray | None = None
    corners: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)


def map_underlay(loaders: Loaders) -> MapUnderlay:
    """Read the attachments; one that cannot be read is left out, with a warning that names it."""
    streets: list[Floats] = tried(loaders, "streets.geojson", _streets) or []
    corners = tried(loaders, "aerial.json", _corners)
    name = next((n for n in ("aerial.png", "aerial.jpg") if n in loaders), "")
    picture = tried(loaders, name, picture_of) if name and corners else None
    return MapUnderlay(streets, picture, corners or (0.0, 0.0, 0.0, 0.0))


def _streets(data: bytes) -> list[Floats]:
    lines = [np.asarray(line, dtype=float)[:, 1::-1] for line in lines_of(json.loads(data))]
    return [line for line in lines if len(line) > 1 and np.isfinite(line).all()]


def _corners(data: bytes) -> tuple[float, float, float, float]:
    corners = json.loads(data)
    west, east, south, north = (float(corners[f"{k}_deg"]) for k in ("west", "east", "south", "north"))
    return west, east, south, north
