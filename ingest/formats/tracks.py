"""Tracks of GPX and KML: fixes of a phone or a watch, or a reference."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, ClassVar, Literal
from xml.etree import ElementTree

import msgspec
import numpy as np
import polars as pl

from ...recording.errors import MarchaError
from ..contract import CommonOptions, Import, ReportBuilder
from ..inertial import one_file
from ..phonelog import Stream, declared, fix_part, require_rows
from ..timestamps import MOST_NS


class TrackImportOptions(CommonOptions, frozen=True, kw_only=True):
    """What the track is.

    Attributes
    ----------
    role : str
        ``fixes`` of the device (``/phone/gnss``) or ``reference`` (``/reference/fix``).
    """

    role: Annotated[
        Literal["fixes", "reference"], msgspec.Meta(description="fixes of the device, or a reference track")
    ] = "fixes"


class Gpx:
    """Importer ``gpx``: ``/phone/gnss`` or ``/reference/fix``."""

    name: ClassVar[str] = "gpx"
    title: ClassVar[str] = "GPX track"
    Options = TrackImportOptions

    def sniff(self, head: bytes, path: Path) -> float:
        """Its root element."""
        return 0.95 if b"<gpx" in head[:2048] else 0.0

    def read(self, paths: Sequence[Path], options: TrackImportOptions) -> Import:
        """Read one file."""
        return _track(one_file(paths, self.name), self.name, options, _gpx_points)


class Kml:
    """Importer ``kml``: ``/phone/gnss`` or ``/reference/fix``."""

    name: ClassVar[str] = "kml"
    title: ClassVar[str] = "KML track (gx:Track, or points with a TimeStamp)"
    Options = TrackImportOptions

    def sniff(self, head: bytes, path: Path) -> float:
        """Its root element."""
        return 0.95 if b"<kml" in head[:2048] else 0.0

    def read(self, paths: Sequence[Path], options: TrackImportOptions) -> Import:
        """Read one file."""
        return _track(one_file(paths, self.name), self.name, options, _kml_points)


Point = tuple[str, float, float, float]


def _track(
    path: Path, name: str, options: TrackImportOptions, points: Callable[[Path], Iterator[Point]]
) -> Import:
    report = ReportBuilder()
    topic = "/phone/gnss" if options.role == "fixes" else "/reference/fix"
    part = fix_part({"lat": "lat", "lon": "lon", "alt": "alt"}, topic)
    stream = Stream([part], report, subject="track", even=False)
    return Import(
        channels=declared([stream]),
        blocks=_blocks(path, stream, points, report),
        report=report,
        metadata={"device": {"clock": "utc", "time": "time of each point", "name": f"{name.upper()} track"}},
    )


def _blocks(
    path: Path, stream: Stream, points: Callable[[Path], Iterator[Point]], report: ReportBuilder
) -> Iterator[tuple[str, pl.DataFrame]]:
    try:
        track: list[Point] = list(points(path))
    except OSError as error:
        raise MarchaError(f"{path}: cannot be read: {error.strerror or error}") from error
    except (ElementTree.ParseError, LookupError, ValueError) as error:  # the last two: its encoding
        raise MarchaError(f"{path}: is no whole XML of a track: {error}") from None
    if not track:
        raise MarchaError(f"{path}: no point of a track; routes and waypoints are no recording")
    if not any(p[0] for p in track):
        raise MarchaError(
            f"{path}: {len(track)} points and no time: a line is no recording; draw it over a map as GeoJSON"
        )
    rows = []
    for k, (text, lat, lon, alt) in enumerate(track, 1):
        stamp = _instant(text)
        if stamp is None:
            report.drop("bad_row", f"point {k}: {text[:40]!r} is no time; left out", line=k)
        elif not np.isfinite([lat, lon]).all():
            report.drop("bad_row", f"point {k}: has no latitude and longitude; left out", line=k)
        else:
            rows.append((stamp, k, lat, lon, alt))
    if rows:
        t, line, lat, lon, alt = zip(*rows, strict=True)
        frame = pl.DataFrame({"t": t, "line": line, "lat": lat, "lon": lon, "alt": alt})
        yield from stream.pull([frame])
    require_rows(path, [stream])


def _instant(text: str) -> int | None:
    try:
        moment = datetime.fromisoformat(text.strip())
    except ValueError:
        return None
    moment = moment if moment.tzinfo else moment.replace(tzinfo=UTC)
    stamp = round(moment.timestamp() * 1e6) * 1000
    return stamp if abs(stamp) <= MOST_NS else None


def _local(tag: object) -> str:
    return str(tag).rpartition("}")[2]


def _gpx_points(path: Path) -> Iterator[Point]:
    for _, element in ElementTree.iterparse(path):
        if _local(element.tag) != "trkpt":
            continue
        inside = {_local(c.tag): (c.text or "").strip() for c in element}
        yield (
            inside.get("time", ""),
            _number(element.get("lat", "")),
            _number(element.get("lon", "")),
            _number(inside.get("ele", "")),
        )
        element.clear()


def _kml_points(path: Path) -> Iterator[Point]:
    for _, element in ElementTree.iterparse(path):
        kind = _local(element.tag)
        if kind == "Track":
            when = [(c.text or "").strip() for c in element if _local(c.tag) == "when"]
            where = [(c.text or "").split() for c in element if _local(c.tag) == "coord"]
            if len(when) != len(where):
                raise MarchaError(
                    f"{path}: a track of {len(when)} times and {len(where)} places; which belong together cannot be "
                    "known: export it again"
                )
            for text, numbers in zip(when, where, strict=True):
                yield _kml_point(text, numbers)
        elif kind == "Placemark":
            children = {_local(c.tag): c for c in element.iter()}
            if "when" in children and "Point" in children and "coordinates" in children:
                text = (children["coordinates"].text or "").strip()
                yield _kml_point((children["when"].text or "").strip(), text.split(","))
            elif "LineString" in children and "coordinates" in children:
                for part in (children["coordinates"].text or "").split():
                    yield _kml_point("", part.split(","))


def _kml_point(text: str, numbers: Sequence[str]) -> Point:
    values = [*map(_number, numbers[:3]), np.nan, np.nan, np.nan]
    return text, values[1], values[0], values[2]


def _number(text: str) -> float:
    """Return a number of ASCII digits; NaN where it is none, so that only its point is left out."""
    try:
        return float(text) if text.isascii() and "_" not in text else np.nan
    except ValueError:
        return np.nan
