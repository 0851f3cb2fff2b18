"""Anchors and the plan of a floor, given beside a log: they go into the recording as attachments.

An anchor table: :mod:`.anchors`. A plan is GeoJSON (metres, or degrees, which are laid out in metres from the
south-west corner) or a picture with a scale. What a picture or an outline does not say itself stands in a JSON file
(``width_m``, ``height_m`` or ``metres_per_pixel``, ``x_m``, ``y_m`` of the lower left corner, ``x_axis_azimuth_deg``,
``handedness``, ``storey_m``: height of a storey), or is set as ``plan.width_m=…``.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..recording.errors import MarchaError, UsageError
from .anchors import DEGREES_SPAN, GeographicLayout, is_anchor_header, layout_of, read_anchors
from .contract import ReportBuilder, SourceAttachment
from .headers import header_of
from .text import BOM, start_of

PLACE_KEYS = ("width_m", "height_m", "metres_per_pixel", "x_m", "y_m", "x_axis_azimuth_deg", "storey_m")
KINDS = ("wall", "obstacle", "passable", "room", "zone", "stairs")
EAST_DEG = 90.0
"""Azimuth of the x axis of what was laid out from degrees."""
OTHER_PICTURES = (".bmp", ".gif", ".tif", ".tiff", ".webp", ".pdf", ".svg")
"""Pictures of a floor that no viewer here draws: they are refused as such."""
PICTURES = {b"\x89PNG\r\n\x1a\n": ("plan.png", "image/png"), b"\xff\xd8\xff": ("plan.jpg", "image/jpeg")}


@dataclass
class Floor:
    """What is known of a floor.

    Attributes
    ----------
    attachments : list of SourceAttachment
        ``anchors.csv``, ``plan.geojson``, ``plan.png`` or ``plan.jpg``, ``plan.json``.
    anchors : tuple of str
        Addresses of the anchors.
    metadata : dict of str to str
        Record ``plan``: what runs must know of its frame.
    """

    attachments: list[SourceAttachment] = field(default_factory=list)
    anchors: tuple[str, ...] = ()
    metadata: dict[str, str] = field(default_factory=dict)


def kind_of(path: Path) -> str:
    """Return ``anchors``, ``outline``, ``picture`` or ``place`` by content; empty for what is no part of a floor."""
    if not path.is_file():
        return ""
    head = start_of(path, 65536)
    if any(head.startswith(magic) for magic in PICTURES) or path.suffix.lower() in OTHER_PICTURES:
        return "picture"
    if head.removeprefix(BOM).lstrip().startswith(b"{"):
        if b'"FeatureCollection"' in head:
            return "outline"
        return "place" if b"map_info" in head or any(f'"{k}"'.encode() in head for k in PLACE_KEYS) else ""
    header = header_of(head)
    return "anchors" if header is not None and is_anchor_header(header) else ""


def floor_files(importer: object, paths: Sequence[Path]) -> list[Path]:
    """Return the parts of a floor in a log's own folders, where its importer says that they hold some (``floors``)."""
    if not getattr(importer, "floors", False):
        return []
    return [f for p in paths if p.is_dir() for f in sorted(p.iterdir()) if kind_of(f)]


def read_floor(paths: Sequence[Path], settings: Mapping[str, Any], report: ReportBuilder) -> Floor:
    """Read the parts of a floor.

    Parameters
    ----------
    paths : sequence of Path
        Files for which :func:`kind_of` has an answer.
    settings : mapping
        ``width_m`` … as in a JSON file, which they override; ``rooms`` (kind of areas that say none).
    report : ReportBuilder
        Takes what is found in the anchor table.

    Raises
    ------
    MarchaError
        Two files of a kind, or one that cannot be read; says which line.
    """
    by_kind: dict[str, Path] = {}
    for path in paths:
        kind = kind_of(path)
        if kind in by_kind:
            raise UsageError(f"{path}: {by_kind[kind].name} is the {kind} of the floor already; give one")
        by_kind[kind] = path
    unknown = set(settings) - {*PLACE_KEYS, "handedness", "rooms"}
    if unknown:
        raise UsageError(f"plan.{min(unknown)}: a plan has {', '.join((*PLACE_KEYS, 'handedness', 'rooms'))}")
    floor = Floor()
    layout: GeographicLayout | None = None
    place = _place(by_kind.get("place"), by_kind.get("picture") or by_kind.get("outline"), settings)
    if "outline" in by_kind:
        data, place, layout = _outline(by_kind["outline"], place, str(settings.get("rooms", "room")))
        floor.attachments.append(SourceAttachment("plan.geojson", data, "application/geo+json"))
    if "picture" in by_kind:
        path = by_kind["picture"]
        head = start_of(path, 16)
        if not any(head.startswith(magic) for magic in PICTURES):
            raise UsageError(f"{path}: a picture of a floor is PNG or JPEG; save it as one of them")
        if not {"width_m", "height_m", "metres_per_pixel"} & set(place):
            raise UsageError(
                f"{path}: nothing says how large it is; set plan.width_m=… (m from its left to its right edge), "
                f"or write {path.stem}.json with width_m, x_m, y_m, x_axis_azimuth_deg"
            )
        name, media = next(v for magic, v in PICTURES.items() if head.startswith(magic))
        place = _filled(place, path)
        floor.attachments.append(SourceAttachment(name, path.read_bytes(), media))
        floor.attachments.append(
            SourceAttachment("plan.json", json.dumps(place).encode(), "application/json")
        )
    if "anchors" in by_kind:
        drawn = by_kind.get("outline") or by_kind.get("picture")
        table, floor.anchors, own = read_anchors(by_kind["anchors"], report, layout=layout, drawn=drawn)
        floor.attachments.insert(0, table)
        if own is not None:
            place = {"x_axis_azimuth_deg": EAST_DEG, **place}
    floor.metadata = {
        k: str(place[k]) for k in ("x_axis_azimuth_deg", "handedness", "storey_m") if k in place
    }
    return floor


def _place(file: Path | None, beside: Path | None, settings: Mapping[str, Any]) -> dict[str, Any]:
    if file is None and beside is not None:
        own = beside.with_suffix(".json")
        file = own if own.is_file() and own != beside and kind_of(own) == "place" else None
    place: dict[str, Any] = {}
    if file is not None:
        try:
            stated = json.loads(file.read_bytes())
            if "map_info" in stated:  # of the indoor-location competition: the plan's size in metres
                stated = {"width_m": stated["map_info"]["width"], "height_m": stated["map_info"]["height"]}
            place = {k: v for k, v in stated.items() if k in (*PLACE_KEYS, "handedness")}
        except (ValueError, KeyError, TypeError) as error:
            raise MarchaError(f"{file}: does not say where the plan lies: {error!r}") from None
    place |= {k: v for k, v in settings.items() if k != "rooms"}
    for key in PLACE_KEYS:
        if key in place:
            try:
                place[key] = float(place[key])
            except (TypeError, ValueError):
                raise UsageError(f"plan.{key}={place[key]!r} is no number") from None
            least = 0.0 if key in ("width_m", "height_m", "metres_per_pixel", "storey_m") else -math.inf
            if not (math.isfinite(place[key]) and place[key] > least):
                raise UsageError(f"plan.{key}={place[key]:g} must be a positive number of metres")
    if place.get("handedness", "right") not in ("right", "left"):
        raise UsageError(
            f"plan.handedness={place['handedness']!r}: right (y left of x, seen from above) or left"
        )
    return place


def _filled(place: Mapping[str, Any], picture: Path) -> dict[str, Any]:
    """Return a picture's place with both sides, by its pixels."""
    from PIL import Image

    try:
        with Image.open(picture) as image:
            width, height = image.size
    except Exception as error:
        raise MarchaError(f"{picture}: is no picture that can be read: {error}") from None
    scale = place.get("metres_per_pixel") or place.get("width_m", 0.0) / width or place["height_m"] / height
    sides = {
        "width_m": place.get("width_m", scale * width),
        "height_m": place.get("height_m", scale * height),
    }
    return {**{k: v for k, v in place.items() if k != "metres_per_pixel"}, **sides}


def _outline(
    file: Path, place: Mapping[str, Any], rooms: str
) -> tuple[bytes, dict[str, Any], GeographicLayout | None]:
    """Return GeoJSON in metres, each feature with a ``kind``, where it lies, and how degrees were laid out."""
    if rooms not in KINDS:
        raise UsageError(f"plan.rooms={rooms!r}: one of {', '.join(KINDS)}")
    try:
        plan = json.loads(file.read_bytes())
        features = [f for f in plan["features"] if f.get("geometry")]
        points = [p for f in features for p in _points(f["geometry"]["coordinates"])]
        low = [min(p[k] for p in points) for k in (0, 1)]
        high = [max(p[k] for p in points) for k in (0, 1)]
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise MarchaError(f"{file}: is no GeoJSON FeatureCollection with coordinates: {error!r}") from None
    about = {**{k: plan[k] for k in (*PLACE_KEYS, "handedness") if k in plan}, **place}
    span = [high[k] - low[k] for k in (0, 1)]
    layout = None
    if 0 < max(span) < DEGREES_SPAN:
        layout = layout_of(low, high, about.get("width_m"), about.get("height_m"))
        about |= {"width_m": layout.scale[0] * span[0], "height_m": layout.scale[1] * span[1]}
        about.setdefault("x_axis_azimuth_deg", EAST_DEG)  # longitude runs to the east
    made = []
    for feature in features:
        facts = dict(feature.get("properties") or {})
        floor = "floor" in (facts.get("type"), facts.get("category"))
        if facts.get("kind") not in KINDS and feature["geometry"]["type"].endswith("Polygon"):
            facts["kind"] = "passable" if floor else rooms
        geometry = feature["geometry"]
        if layout is not None:
            geometry = {**geometry, "coordinates": _mapped(geometry["coordinates"], layout)}
        made.append({"type": "Feature", "properties": facts, "geometry": geometry})
    kept = {k: v for k, v in about.items() if k != "metres_per_pixel"}
    collection = {"type": "FeatureCollection", **kept, "features": made}
    return json.dumps(collection, ensure_ascii=False).encode(), about, layout


def _points(node: Any) -> Iterator[Any]:
    if node and isinstance(node[0], int | float):
        yield node
    else:
        for part in node:
            yield from _points(part)


def _mapped(node: Any, layout: GeographicLayout) -> Any:
    if node and isinstance(node[0], int | float):
        return list(layout.metres(node[0], node[1]))
    return [_mapped(part, layout) for part in node]
