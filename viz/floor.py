"""Anchors and the floor plan that a recording carries as attachments, for views and figures.

``anchors.csv``
    A header with ``mac``, ``x``, ``y`` and where known ``z``, ``technology``, ``p_d0``, ``eta`` (m, dBm).
``plan.geojson``
    Outlines. Coordinates are metres of the plan, or degrees where the whole plan would else be smaller than
    5 cm; degrees are laid out in metres from the south-west corner.
``plan.png`` (or ``.jpg``) with ``plan.json``
    A picture and where it lies: ``width_m`` and ``height_m``, or ``metres_per_pixel``; ``x_m`` and ``y_m`` of
    its lower left corner, 0 where not given.
"""

from __future__ import annotations

import csv
import io
import json
import math
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ..recording import Recording
from .shapes import Floats, metres_a_degree
from .text import printable

DEGREES_SPAN = 0.05
"""A plan whose coordinates span less than this is in degrees (0.05 m is no building; 0.05° are 5 km)."""

ANCHORS, OUTLINES, PLACE = "anchors.csv", "plan.geojson", "plan.json"
PICTURES = ("plan.png", "plan.jpg", "plan.jpeg")
Loaders = Mapping[str, Callable[[], bytes]]


@dataclass(frozen=True)
class Anchor:
    """A transmitter or receiver of known place.

    Attributes
    ----------
    mac, technology : str
        Address in lower case, and ``wifi``, ``ble`` …
    position : ndarray, shape (3,)
        Metres on the plan; z is 0 where no height is known.
    p_d0, eta : float
        Received power at 1 m (dBm) and path loss exponent; NaN where not calibrated.
    """

    mac: str
    technology: str
    position: Floats
    p_d0: float = math.nan
    eta: float = math.nan


@dataclass(frozen=True)
class FloorPlan:
    """What is drawn under the tracks.

    Attributes
    ----------
    anchors : dict of str to Anchor
        By address.
    outlines : list of ndarray, shape (n, 2)
        Lines in metres.
    picture : ndarray of uint8, shape (h, w, 3), or None
        The plan's picture.
    corners : tuple of float
        Left, right, lower and upper edge of the picture, m.
    """

    anchors: dict[str, Anchor] = field(default_factory=dict)
    outlines: list[Floats] = field(default_factory=list)
    picture: np.ndarray | None = None
    corners: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)

    def __bool__(self) -> bool:
        return bool(self.anchors or self.outlines or self.picture is not None)


def loaders_of(rec: Recording) -> dict[str, Callable[[], bytes]]:
    """Return the recording's attachments by name, read when called."""

    def loader(name: str) -> Callable[[], bytes]:
        return lambda: rec.attachment(name)

    return {a.name: loader(a.name) for a in rec.attachments}


def floor_plan(loaders: Loaders) -> FloorPlan:
    """Read anchors and plan. An attachment that cannot be read is left out, with a warning that names it."""
    anchors: dict[str, Anchor] = tried(loaders, ANCHORS, _anchors) or {}
    outlines: list[Floats] = tried(loaders, OUTLINES, _outlines) or []
    name = next((n for n in PICTURES if n in loaders), "")
    picture = tried(loaders, name, picture_of) if name else None
    corners = (0.0, 0.0, 0.0, 0.0)
    if picture is not None:
        shape = picture.shape
        place = tried(loaders, PLACE, lambda data: _corners(json.loads(data), shape))
        if place is None:
            warnings.warn(f"attachment {name}: not drawn, no {PLACE} says where it lies", stacklevel=2)
            picture = None
        else:
            corners = place
    return FloorPlan(anchors, outlines, picture, corners)


def with_calibration(plan: FloorPlan, metadata: Mapping[str, Mapping[str, str]]) -> FloorPlan:
    """Return the plan whose anchors have what the recording's calibrations, or those of its runs, say of them."""
    from ..replay.calibrations import calibrations_of, calibrations_of_runs

    anchors = dict(plan.anchors)
    for one in (*calibrations_of(metadata), *calibrations_of_runs(metadata)):
        for row in one.values.get("anchors", ()) if one.kind == "radio" else ():
            mac = str(row["mac"])
            if mac in anchors and row.get("p_d0") is not None:
                anchors[mac] = replace(anchors[mac], p_d0=float(row["p_d0"]), eta=float(row["eta"]))
    return replace(plan, anchors=anchors)


def plan_of(rec: Recording) -> FloorPlan:
    """Return the floor of a recording, its anchors with their calibration."""
    return with_calibration(floor_plan(loaders_of(rec)), rec.metadata)


def tried(loaders: Loaders, name: str, read: Callable[[bytes], Any]) -> Any:
    """Return what ``read`` makes of an attachment; None where it is not there, or with a warning not readable."""
    if name not in loaders:
        return None
    try:
        return read(loaders[name]())
    except Exception as error:
        reason = printable(f"{type(error).__name__}: {error}".splitlines()[0])
        warnings.warn(f"attachment {name}: not drawn, it cannot be read: {reason}", stacklevel=3)
        return None


def _anchors(data: bytes) -> dict[str, Anchor]:
    anchors: dict[str, Anchor] = {}
    for row in csv.DictReader(io.StringIO(data.decode("utf-8-sig"))):
        row = {
            (k or "").strip().lower(): (v or "").strip() for k, v in row.items() if isinstance(v, str | None)
        }
        place = [_number(row.get(a, "")) for a in "xyz"]
        if not all(map(math.isfinite, place[:2])):
            raise ValueError(f"anchor {row.get('mac', '')!r} has no x and y")
        mac = row["mac"].lower()
        technology = printable(row.get("technology", ""))
        position = np.nan_to_num(np.array(place))
        anchors[mac] = Anchor(
            mac, technology, position, _number(row.get("p_d0", "")), _number(row.get("eta", ""))
        )
    return anchors


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


def _outlines(data: bytes) -> list[Floats]:
    lines = [np.asarray(line, dtype=float)[:, :2] for line in geojson_lines(json.loads(data))]
    lines = [line for line in lines if len(line) > 1 and np.isfinite(line).all()]
    if not lines:
        return []
    points = np.concatenate(lines)
    low, high = points.min(axis=0), points.max(axis=0)
    if (high - low).max() < DEGREES_SPAN:
        scale = metres_a_degree(np.array([(low[1] + high[1]) / 2]))[0][::-1]
        lines = [(line - low) * scale for line in lines]
    return lines


def geojson_lines(node: Any) -> Iterator[Any]:
    """Yield every line and ring of a GeoJSON object."""
    kind = node.get("type")
    if kind == "FeatureCollection":
        for feature in node["features"]:
            yield from geojson_lines(feature)
    elif kind == "Feature":
        if node.get("geometry"):
            yield from geojson_lines(node["geometry"])
    elif kind == "GeometryCollection":
        for geometry in node["geometries"]:
            yield from geojson_lines(geometry)
    elif kind == "LineString":
        yield node["coordinates"]
    elif kind in ("Polygon", "MultiLineString"):
        yield from node["coordinates"]
    elif kind == "MultiPolygon":
        for polygon in node["coordinates"]:
            yield from polygon


def picture_of(data: bytes) -> np.ndarray:
    """Return a picture as colours, shape (h, w, 3)."""
    from PIL import Image

    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))


def _corners(place: Mapping[str, Any], shape: tuple[int, ...]) -> tuple[float, float, float, float]:
    scale = float(place.get("metres_per_pixel", math.nan))
    width, height = (
        float(place.get(name, scale * pixels))
        for name, pixels in (("width_m", shape[1]), ("height_m", shape[0]))
    )
    if not (width > 0 and height > 0 and math.isfinite(width) and math.isfinite(height)):
        raise ValueError("neither width_m and height_m nor metres_per_pixel")
    x, y = float(place.get("x_m", 0.0)), float(place.get("y_m", 0.0))
    return (x, x + width, y, y + height)
