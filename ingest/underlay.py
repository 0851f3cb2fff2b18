"""Streets or an aerial picture given beside a log: they go into the recording as attachments, for maps.

``streets.geojson`` has lines in degrees (RFC 7946). ``aerial.png`` (or ``.jpg``) is a picture whose corners
``aerial.json`` states: ``north_deg``, ``south_deg``, ``west_deg``, ``east_deg``, north up. Known by these names.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path

from ..recording.errors import MarchaError
from .contract import SourceAttachment
from .text import read_whole

MEDIA = {
    "streets.geojson": "application/geo+json",
    "aerial.png": "image/png",
    "aerial.jpg": "image/jpeg",
    "aerial.json": "application/json",
}
CORNERS = ("north_deg", "south_deg", "west_deg", "east_deg")


def is_underlay(path: Path) -> bool:
    """Whether a file is one of those that lie under a map."""
    return path.name in MEDIA and path.is_file()


def read_underlay(paths: Sequence[Path]) -> list[SourceAttachment]:
    """Return the files as attachments.

    Raises
    ------
    MarchaError
        A file that cannot be read, lines that are not in degrees, a picture without its corners.
    """
    files = []
    for path in paths:
        data = read_whole(path)
        if path.suffix in (".geojson", ".json"):
            try:
                content = json.loads(data)
            except ValueError as error:
                raise MarchaError(f"{path}: is no JSON: {error}") from None
            if path.name == "aerial.json":
                _check_corners(path, content)
            elif not (isinstance(content, dict) and content.get("type") == "FeatureCollection"):
                raise MarchaError(
                    f"{path}: is no GeoJSON FeatureCollection; streets are lines of one, in degrees"
                )
        files.append(SourceAttachment(path.name, data, MEDIA[path.name]))
    names = {a.name for a in files}
    if names & {"aerial.png", "aerial.jpg"} and "aerial.json" not in names:
        raise MarchaError(
            f"{paths[0].parent}: a picture under a map needs aerial.json with {', '.join(CORNERS)}"
        )
    return files


def _check_corners(path: Path, content: object) -> None:
    values = [content.get(k) if isinstance(content, dict) else None for k in CORNERS]
    numbers = [v for v in values if isinstance(v, int | float) and math.isfinite(v)]
    if len(numbers) < 4 or not (
        -90 <= numbers[1] < numbers[0] <= 90 and -180 <= numbers[2] < numbers[3] <= 180
    ):
        raise MarchaError(
            f"{path}: corners {dict(zip(CORNERS, values, strict=True))} are no rectangle; give {', '.join(CORNERS)}"
        )
