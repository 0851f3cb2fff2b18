"""Views of radio positioning: signal strength by transmitter, ranges, and their circles about the anchors."""

# ruff: noqa: D102 - begin, draw and end are documented once, in View

from __future__ import annotations

import numpy as np
import polars as pl
import rerun as rr

from .. import style
from ..canvas import OVERVIEW, RADIO, SPACE, Times, columns_of
from ..shapes import circle
from ..text import printable
from .base import View
from .common import slug

MOST = 24
"""Transmitters shown together; of more, those that are anchors or are heard most."""


class ByTransmitter(View):
    """Numbers of many transmitters in one channel: a line each."""

    column: str
    unit: str
    tabs: tuple[str, ...] = (RADIO,)

    def begin(self) -> None:
        self.counts: dict[str, int] = {}
        what = "" if self.what in self.owner else f" {self.what}"
        self.panel = f"{self.owner}{what} ({self.unit})"
        self.log = f"{self.canvas.prefix}/log{self.path.removeprefix(self.canvas.prefix)}"

    def draw(self, t_ns: Times, block: pl.DataFrame) -> None:
        values = columns_of(block, [self.column])[:, 0]
        macs = block["mac"].fill_null("unknown").to_numpy()
        for mac in dict.fromkeys(macs.tolist()):
            if mac not in self.counts:
                self.counts[mac] = 0
                self._style(mac, len(self.counts) - 1)
            mine = macs == mac
            self.counts[mac] += int(mine.sum())
            self._line(mac, t_ns[mine], values[mine])

    def _entity(self, mac: str) -> str:
        return f"{self.path}/{slug(mac)}"

    def _style(self, mac: str, number: int) -> None:
        self.canvas.points(self._entity(mac), printable(mac), style.run_color(number), "circle", 2.5)
        if number < MOST:  # a live view cannot wait for the end
            for tab in self.tabs:
                self.canvas.show("plot", self._entity(mac), tab=tab, panel=self.panel, owner=self.owner)

    def _line(self, mac: str, t_ns: Times, values: np.ndarray) -> None:
        self.canvas.scalars(self._entity(mac), t_ns, values)

    def end(self) -> None:
        if len(self.counts) <= MOST:
            return
        anchors = self.canvas.plan.anchors if self.canvas.plan else {}
        ordered = sorted(self.counts, key=lambda m: (m.lower() not in anchors, -self.counts[m]))
        canvas = self.canvas
        canvas.entries = [e for e in canvas.entries if e.panel != printable(self.panel)]
        panel = f"{self.panel}, {MOST} of {len(self.counts)} transmitters"
        for mac in ordered[:MOST]:
            for tab in self.tabs:
                canvas.show("plot", self._entity(mac), tab=tab, panel=panel, owner=self.owner)


class Signals(ByTransmitter):
    """Received signal strength, a line of points for each transmitter."""

    title = "signal strength by transmitter"
    schemas = ("marcha_msgs/msg/RadioSignal",)
    needs = ("mac", "rssi_dbm")
    column, unit, tabs = "rssi_dbm", "dBm", (OVERVIEW, RADIO)


class Ranges(ByTransmitter):
    """Ranges to anchors, a line of points each, and a circle about the anchor in the plan."""

    title = "ranges by anchor, and their circles in the plan"
    schemas = ("marcha_msgs/msg/Ranging",)
    needs = ("mac", "distance_m")
    column, unit = "distance_m", "m"

    def _circle(self, mac: str) -> str:
        return f"{self.path}/circle/{slug(mac)}"

    def _style(self, mac: str, number: int) -> None:
        super()._style(mac, number)
        anchors = self.canvas.plan.anchors if self.canvas.plan else {}
        if mac.lower() in anchors:
            color, thin = (*style.rgb(style.run_color(number)), 200), rr.Radius.ui_points(0.8)
            self.canvas.static(self._circle(mac), rr.LineStrips3D.from_fields(colors=color, radii=thin))
            self.canvas.show("space", self._circle(mac), tab=OVERVIEW, panel=SPACE, owner=self.owner)

    def _line(self, mac: str, t_ns: Times, values: np.ndarray) -> None:
        super()._line(mac, t_ns, values)
        anchor = self.canvas.plan.anchors.get(mac.lower()) if self.canvas.plan else None
        usable = np.isfinite(values) & (values > 0)
        if anchor is None or not usable.any():
            return
        # the range is along the slope: in the plane of the floor it is shorter by the anchor's height
        flat = np.sqrt(np.maximum(values[usable] ** 2 - anchor.position[2] ** 2, 0.0))
        centre = np.tile([*anchor.position[:2], 0.0], (len(flat), 1))
        strips = circle(centre, np.column_stack([flat, flat]))
        self.canvas.columns(self._circle(mac), t_ns[usable], rr.LineStrips3D.columns(strips=list(strips)))
