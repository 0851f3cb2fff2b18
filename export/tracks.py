"""Tracks on the globe: GPX, GeoJSON and KML, with times, accuracies, provenance, and privacy when asked for."""

from __future__ import annotations

import json
import math
from abc import abstractmethod
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, ClassVar, NamedTuple
from xml.sax.saxutils import escape

import msgspec
import numpy as np
import polars as pl
from numpy.typing import NDArray

from ..recording import Recording
from ..recording.errors import UsageError
from ..recording.selection import Selection, selected_topics
from .facts import FIRST_DATE_NS, origin
from .files import write_files

FIX = "sensor_msgs/msg/NavSatFix"
_DEG_M = 111_319.5
"""Metres of a degree of latitude, near enough for privacy."""
_SD = ("sd_east_m", "sd_north_m", "sd_up_m")


class TrackOptions(Selection, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of tracks; what is done for privacy is said in the file."""

    trim_m: Annotated[
        float, msgspec.Meta(ge=0, description="cut all within so many metres of a track's two ends [m]")
    ] = 0.0
    coarsen_m: Annotated[
        float,
        msgspec.Meta(ge=0, description="round positions to a grid of so many metres, drop accuracies [m]"),
    ] = 0.0
    move_east_m: Annotated[float, msgspec.Meta(description="move everything east by so much [m]")] = 0.0
    move_north_m: Annotated[float, msgspec.Meta(description="move everything north by so much [m]")] = 0.0


class FixTrack(NamedTuple):
    """One channel of fixes: rows with a position, times as text or None where the clock tells no date."""

    topic: str
    table: pl.DataFrame
    times: list[str] | None


def tracks_of(rec: Recording, options: TrackOptions) -> list[FixTrack]:
    """Return the tracks that a selection means.

    Raises
    ------
    UsageError
        No channel of fixes is chosen, or an option leaves nothing.
    """
    out = []
    for topic in selected_topics(rec, options):
        if rec.channels[topic].schema != FIX:
            continue
        table = rec.table(topic, start_ns=options.start_ns, end_ns=options.end_ns)
        table = table.filter(pl.col("lat_deg").is_finite() & pl.col("lon_deg").is_finite())
        table = _private(table, options)
        dated = table.height and int(table["t_ns"][0]) > FIRST_DATE_NS
        out.append(FixTrack(topic, table, [_iso(t) for t in table["t_ns"].to_list()] if dated else None))
    if not any(track.table.height for track in out):
        raise UsageError(f"{rec.path}: no fixes are left to write; choose topics of {FIX}, or less privacy")
    return out


def _private(table: pl.DataFrame, options: TrackOptions) -> pl.DataFrame:
    if options.trim_m and table.height:
        lat, lon = table["lat_deg"].to_numpy(), table["lon_deg"].to_numpy()
        near = np.zeros(len(lat), bool)
        for end in (0, -1):
            east = (lon - lon[end]) * _DEG_M * math.cos(math.radians(float(lat[end])))
            near |= np.hypot(east, (lat - lat[end]) * _DEG_M) <= options.trim_m
        table = table.filter(~near)
    if not table.height:
        return table
    cos = math.cos(math.radians(float(table["lat_deg"][0])))
    if options.move_east_m or options.move_north_m:
        table = table.with_columns(
            pl.col("lat_deg") + options.move_north_m / _DEG_M,
            pl.col("lon_deg") + options.move_east_m / (_DEG_M * cos),
        )
    if options.coarsen_m:
        grid = options.coarsen_m / _DEG_M
        table = table.with_columns(
            ((pl.col("lat_deg") / grid).round() * grid).round(7),
            ((pl.col("lon_deg") * cos / grid).round() * grid / cos).round(7),
        ).drop(_SD, strict=False)
    return table


def _iso(t_ns: int) -> str:
    whole, rest = divmod(t_ns, 10**9)
    return datetime.fromtimestamp(whole, UTC).strftime("%Y-%m-%dT%H:%M:%S") + f".{rest:09d}Z"


def _numbers(table: pl.DataFrame, name: str) -> list[float] | None:
    if name not in table.columns:
        return None
    values: NDArray[np.float64] = table[name].to_numpy()
    return values.tolist() if np.isfinite(values).any() else None


def _privacy(options: TrackOptions) -> dict[str, float]:
    return {
        k: getattr(options, k)
        for k in ("trim_m", "coarsen_m", "move_east_m", "move_north_m")
        if getattr(options, k)
    }


class TrackExporter:
    """What the formats of tracks have in common; a subclass writes the text."""

    name: ClassVar[str]
    title: ClassVar[str]
    suffix: ClassVar[str]
    Options: ClassVar[type[msgspec.Struct]] = TrackOptions

    @abstractmethod
    def text(self, rec: Recording, tracks: list[FixTrack], options: TrackOptions) -> str:
        """Return the file."""

    def losses(self, rec: Recording, options: Any) -> list[str]:
        """Return what is not a track, and what is unsure of those that are."""
        topics = [t for t, c in rec.channels.items() if c.schema != FIX]
        losses = [f"{len(topics)} channels that are no fixes"] if topics else []
        tracks = tracks_of(rec, options)
        if any(track.times is None for track in tracks):
            losses.append("dates: the recording's clock tells none, so that points have no time")
        if any(_numbers(track.table, "alt_m") for track in tracks):
            losses.append(
                "heights above sea level: heights are those that the device states, above the ellipsoid"
            )
        if private := _privacy(options):
            losses.append(
                "true positions: changed for privacy by "
                + ", ".join(f"{k} = {v:g}" for k, v in private.items())
            )
        return losses

    def export(self, rec: Recording, path: Path, options: Any, *, overwrite: bool = False) -> list[Path]:
        """Write the file; see :class:`marcha.export.Exporter`."""
        text = self.text(rec, tracks_of(rec, options), options)
        return write_files({path: text.encode()}, overwrite=overwrite)


def _about(rec: Recording, options: TrackOptions) -> dict[str, Any]:
    facts = origin(rec)
    if private := _privacy(options):
        facts = {"tool": facts["tool"], "privacy": private}  # a hash would lead back to the recording
    return facts


class GpxExporter(TrackExporter):
    """GPX 1.1; accuracies as extensions."""

    name = "gpx"
    title = "GPX 1.1 of fixes, with times and accuracies (maps, watches, OpenStreetMap)"
    suffix = ".gpx"

    def text(self, rec: Recording, tracks: list[FixTrack], options: TrackOptions) -> str:
        """Return the file."""
        about = _about(rec, options)
        out = [
            '<?xml version="1.0" encoding="UTF-8"?>\n<gpx version="1.1" creator="marcha" '
            'xmlns="http://www.topografix.com/GPX/1/1" xmlns:marcha="urn:marcha:accuracy">\n'
            f"<metadata><desc>{escape(json.dumps(about, ensure_ascii=False))}</desc></metadata>\n"
        ]
        for track in tracks:
            out.append(f"<trk><name>{escape(track.topic)}</name><trkseg>\n")
            lat, lon = track.table["lat_deg"].to_list(), track.table["lon_deg"].to_list()
            alt = _numbers(track.table, "alt_m")
            sds = {k: v for k in _SD if (v := _numbers(track.table, k))}
            for k in range(len(lat)):
                out.append(f'<trkpt lat="{lat[k]!r}" lon="{lon[k]!r}">')
                if alt and math.isfinite(alt[k]):
                    out.append(f"<ele>{alt[k]!r}</ele>")
                if track.times:
                    out.append(f"<time>{track.times[k]}</time>")
                extensions = [
                    f"<marcha:{n}>{v[k]!r}</marcha:{n}>" for n, v in sds.items() if math.isfinite(v[k])
                ]
                if extensions:
                    out.append(f"<extensions>{''.join(extensions)}</extensions>")
                out.append("</trkpt>\n")
            out.append("</trkseg></trk>\n")
        out.append("</gpx>\n")
        return "".join(out)


class GeoJsonExporter(TrackExporter):
    """GeoJSON (RFC 7946): a line a channel, times and accuracies as lists beside it."""

    name = "geojson"
    title = "GeoJSON of fixes, times and accuracies as properties (QGIS, web maps)"
    suffix = ".geojson"

    def text(self, rec: Recording, tracks: list[FixTrack], options: TrackOptions) -> str:
        """Return the file."""
        features = []
        for track in tracks:
            table = track.table
            if not table.height:
                continue
            alt = _numbers(table, "alt_m")
            points = [list(p) for p in table.select("lon_deg", "lat_deg").rows()]
            if alt and all(map(math.isfinite, alt)):
                points = [[*p, a] for p, a in zip(points, alt, strict=True)]
            one = len(points) == 1
            properties: dict[str, Any] = {"name": track.topic}
            if not _privacy(options):
                properties["t_ns"] = table["t_ns"].to_list()
            if track.times:
                properties["times"] = track.times
            for name in _SD:
                if values := _numbers(table, name):
                    properties[name] = [v if math.isfinite(v) else None for v in values]
            geometry = {"type": "Point" if one else "LineString", "coordinates": points[0] if one else points}
            features.append({"type": "Feature", "geometry": geometry, "properties": properties})
        document = {"type": "FeatureCollection", "marcha": _about(rec, options), "features": features}
        return json.dumps(document, ensure_ascii=False) + "\n"


class KmlExporter(TrackExporter):
    """KML 2.2 with Google's track extension; accuracies as arrays."""

    name = "kml"
    title = "KML of fixes, times and accuracies (Google Earth)"
    suffix = ".kml"

    def text(self, rec: Recording, tracks: list[FixTrack], options: TrackOptions) -> str:
        """Return the file."""
        about = escape(json.dumps(_about(rec, options), ensure_ascii=False))
        out = [
            '<?xml version="1.0" encoding="UTF-8"?>\n<kml xmlns="http://www.opengis.net/kml/2.2" '
            'xmlns:gx="http://www.google.com/kml/ext/2.2"><Document>\n'
            f"<description>{about}</description>\n"
        ]
        sds = {t.topic: {k: v for k in _SD if (v := _numbers(t.table, k))} for t in tracks}
        if names := sorted({n for values_of in sds.values() for n in values_of}):
            fields = "".join(f'<gx:SimpleArrayField name="{n}" type="float"/>' for n in names)
            out.append(f'<Schema id="accuracy">{fields}</Schema>\n')
        for track in tracks:
            alt = _numbers(track.table, "alt_m")
            out.append(f"<Placemark><name>{escape(track.topic)}</name>")
            rows = track.table.select("lon_deg", "lat_deg").rows()
            heights = [a if math.isfinite(a) else 0.0 for a in alt] if alt else [0.0] * len(rows)
            if track.times is None:
                points = " ".join(f"{x!r},{y!r},{z!r}" for (x, y), z in zip(rows, heights, strict=True))
                out.append(f"<LineString><coordinates>{points}</coordinates></LineString></Placemark>\n")
                continue
            out.append("<gx:Track>\n")
            out += [f"<when>{t}</when>\n" for t in track.times]
            out += [
                f"<gx:coord>{x!r} {y!r} {z!r}</gx:coord>\n" for (x, y), z in zip(rows, heights, strict=True)
            ]
            if values_of := sds[track.topic]:
                arrays = "".join(
                    f'<gx:SimpleArrayData name="{n}">{"".join(f"<gx:value>{v!r}</gx:value>" for v in values)}'
                    "</gx:SimpleArrayData>"
                    for n, values in values_of.items()
                )
                out.append(
                    f'<ExtendedData><SchemaData schemaUrl="#accuracy">{arrays}</SchemaData></ExtendedData>\n'
                )
            out.append("</gx:Track></Placemark>\n")
        out.append("</Document></kml>\n")
        return "".join(out)
