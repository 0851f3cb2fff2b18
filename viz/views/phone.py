"""Views of phones outdoors: fixes on the map with their accuracy, tracks on the map."""

# ruff: noqa: D102 - begin, draw and end are documented once, in View

from __future__ import annotations

import numpy as np
import polars as pl
import rerun as rr

from .. import style
from ..canvas import OVERVIEW, Floats, Times, columns_of
from ..shapes import geo_circle
from ..underlay import map_underlay
from .common import General

MAP = "map"
SD = ("sd_east_m", "sd_north_m")
PANELS = {"lat_deg": "latitude", "lon_deg": "longitude", "alt_m": "altitude"}
"""Numbers of such different sizes that each has a panel of its own; the rest are accuracies."""


class Fix(General):
    """GNSS fixes on the map with a circle of one standard deviation each; all their numbers over time.

    Fixes that an estimator states are joined to a track.
    """

    title = "fixes on the map with their accuracy, and their numbers over time"
    schemas = ("sensor_msgs/msg/NavSatFix",)
    needs = ("lat_deg", "lon_deg")
    priority = 0

    def _panel(self, column: str, head: str, unit: str) -> str:
        named = PANELS.get(column, "accuracy" if column.startswith("sd_") else "")
        return super()._panel(column, f"{head} {named}".strip(), unit)

    def begin(self) -> None:
        super().begin()
        canvas, color = self.canvas, style.rgb(style.DEVICE if self.role == "raw" else self.color)
        self.line: list[Floats] = []
        self.points, self.circles = f"{self.path}/map/fixes", f"{self.path}/map/accuracy"
        canvas.static(self.points, rr.GeoPoints.from_fields(colors=color, radii=rr.Radius.ui_points(4.0)))
        canvas.show("map", self.points, tab=OVERVIEW, panel=MAP, owner=self.owner, past=True)
        streets = map_underlay(canvas.attachments).streets
        if streets:  # one path for all channels: drawn once
            grey = rr.GeoLineStrings(lat_lon=streets, colors=(120, 120, 120), radii=rr.Radius.ui_points(1.2))
            canvas.static("/map/streets", grey)
            canvas.show("map", "/map/streets", tab=OVERVIEW, panel=MAP, owner=self.owner)
        self.accuracy = set(SD) <= set(self.channel.columns)
        if self.accuracy:
            thin = rr.Radius.ui_points(0.7)
            canvas.static(self.circles, rr.GeoLineStrings.from_fields(colors=(*color, 160), radii=thin))
            canvas.show("map", self.circles, tab=OVERVIEW, panel=MAP, owner=self.owner)

    def draw(self, t_ns: Times, block: pl.DataFrame) -> None:
        super().draw(t_ns, block)
        place = columns_of(block, ["lat_deg", "lon_deg"])
        good = np.flatnonzero(np.isfinite(place).all(axis=1))
        place, t_ns, block = place[good], t_ns[good], block[good]
        self.canvas.columns(self.points, t_ns, rr.GeoPoints.columns(positions=place))
        if len(place):
            self.canvas.reach(self.canvas.geo, place)
        if self.role != "raw":
            self.line.append(place)
        if self.accuracy:
            sd = columns_of(block, SD)
            stated = np.isfinite(sd).all(axis=1) & (sd > 0).all(axis=1)
            rings = geo_circle(place[stated], sd[stated])
            columns = rr.GeoLineStrings.columns(line_strings=list(rings))
            self.canvas.columns(self.circles, t_ns[stated], columns)

    def end(self) -> None:
        super().end()
        if self.line:
            line = np.concatenate(self.line)
            if len(line) > 1:
                entity_path = f"{self.path}/map/track"
                width = rr.Radius.ui_points(2.0)
                track = rr.GeoLineStrings(lat_lon=[line], colors=style.rgb(self.color), radii=width)
                self.canvas.static(entity_path, track)
                self.canvas.show("map", entity_path, tab=OVERVIEW, panel=MAP, owner=self.owner)
