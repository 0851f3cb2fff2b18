"""Views of radio positioning: signal strength by transmitter with its model, ranges and circles, points in the plan."""

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

HELD_M = 1.2
"""Height of a receiver, where nothing says it."""
MODEL_POINTS = 400
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

    def end(self) -> None:
        super().end()
        for number, mac in enumerate(self.counts):
            self._model(mac, number)

    def _model(self, mac: str, number: int) -> None:
        """Draw what the anchor's model expects at the true positions, else at those of the first run."""
        canvas = self.canvas
        anchor = canvas.plan.anchors.get(mac.lower()) if canvas.plan else None
        tracks = sorted(canvas.traces.items(), key=lambda item: "/reference" not in item[0])
        if (
            anchor is None
            or not np.isfinite(anchor.p_d0 + anchor.eta)
            or not tracks
            or not tracks[0][1].count
        ):
            return
        trace = tracks[0][1]
        t_ns = trace.t_ns[:: max(1, trace.count // MODEL_POINTS)]
        away = trace.at(t_ns)[:, :2] - anchor.position[:2]
        up = anchor.position[2] - HELD_M if anchor.position[2] > 0 else 0.0
        expected = anchor.p_d0 - 5.0 * anchor.eta * np.log10(np.maximum((away**2).sum(axis=1) + up**2, 0.09))
        path = f"{self._entity(mac)}/model"
        canvas.lines(path, [f"{printable(mac)} model"], [style.run_color(number)], 1.0)
        canvas.scalars(path, t_ns, expected)


class PointsOnPlan(View):
    """Several points of one time in the plan: they stand until the next ones come."""

    schemas = ("marcha_msgs/msg/NamedValues",)
    radius: float

    def begin(self) -> None:
        self.rest: tuple[Times, np.ndarray] = np.zeros(0, np.int64), np.zeros((0, 2))
        points = rr.Points3D.from_fields(colors=style.rgb(self.color), radii=rr.Radius.ui_points(self.radius))
        self.canvas.static(self.path, points)
        self.canvas.show("space", self.path, tab=OVERVIEW, panel=SPACE, owner=self.owner)

    def draw(self, t_ns: Times, block: pl.DataFrame) -> None:
        t_ns = np.concatenate([self.rest[0], t_ns])
        where = np.concatenate([self.rest[1], columns_of(block, list(self.needs))])
        whole = t_ns < t_ns[-1]  # the newest time may go on in the next block
        self.rest = t_ns[~whole], where[~whole]
        self._log(t_ns[whole], where[whole])

    def end(self) -> None:
        self._log(*self.rest)

    def _log(self, t_ns: Times, where: np.ndarray) -> None:
        finite = np.isfinite(where).all(axis=1)
        times, counts = np.unique(t_ns[finite], return_counts=True)
        flat = np.column_stack([where[finite], np.zeros(int(finite.sum()))]).astype(np.float32)
        if len(times):
            self.canvas.columns(self.path, times, rr.Points3D.columns(positions=flat).partition(counts))


class Particles(PointsOnPlan):
    """The cloud of a particle filter."""

    title = "particles of a filter in the plan"
    needs = ("particle_x", "particle_y")
    radius = 2.0


class Triples(PointsOnPlan):
    """What each three anchors say: the fix is their mean."""

    title = "solutions of each three anchors in the plan"
    needs = ("triple_x", "triple_y")
    radius = 3.5


class Ranges(ByTransmitter):
    """Ranges to anchors, a line of points each, and a circle about the anchor in the plan."""

    title = "ranges by anchor, and their circles in the plan"
    schemas = ("marcha_msgs/msg/Ranging",)
    needs = ("mac", "distance_m")
    column, unit = "distance_m", "m"
    last_ns = -1

    def draw(self, t_ns: Times, block: pl.DataFrame) -> None:
        super().draw(t_ns, block)
        if self.role == "estimate":
            self._forget(t_ns, block["mac"].fill_null("unknown").to_numpy())

    def _forget(self, t_ns: Times, macs: np.ndarray) -> None:
        """Take away the circles of anchors that a window did not hear: an old circle is no range of now."""
        windows = np.unique(t_ns)
        windows = windows[windows > self.last_ns]  # the first may have begun in the block before
        self.last_ns = int(t_ns[-1])
        anchors = self.canvas.plan.anchors if self.canvas.plan else {}
        for mac in (m for m in self.counts if m.lower() in anchors):
            silent = np.setdiff1d(windows, t_ns[macs == mac])
            empty = np.zeros(len(silent), dtype=np.int64)
            self.canvas.columns(
                self._circle(mac), silent, rr.LineStrips3D.columns(strips=[]).partition(empty)
            )

    def _circle(self, mac: str) -> str:
        return f"{self.path}/circle/{slug(mac)}"

    def _style(self, mac: str, number: int) -> None:
        super()._style(mac, number)
        anchors = self.canvas.plan.anchors if self.canvas.plan else {}
        if mac.lower() in anchors:
            # of a pair the corrected one is bright
            bright, width = (90, 0.6) if self.what == "ranges" and self.role == "estimate" else (220, 1.2)
            color, thin = (*style.rgb(style.run_color(number)), bright), rr.Radius.ui_points(width)
            self.canvas.static(self._circle(mac), rr.LineStrips3D.from_fields(colors=color, radii=thin))
            self.canvas.show("space", self._circle(mac), tab=OVERVIEW, panel=SPACE, owner=self.owner)

    def _line(self, mac: str, t_ns: Times, values: np.ndarray) -> None:
        super()._line(mac, t_ns, values)
        anchor = self.canvas.plan.anchors.get(mac.lower()) if self.canvas.plan else None
        usable = np.isfinite(values) & (values > 0)
        if anchor is None or not usable.any():
            return
        flat = values[usable]
        if self.role != "estimate":  # along the slope; what an estimator ranged is in the plane already
            up = anchor.position[2] - HELD_M if anchor.position[2] > 0 else 0.0
            flat = np.sqrt(np.maximum(flat**2 - up**2, 0.0))
        centre = np.tile([*anchor.position[:2], 0.0], (len(flat), 1))
        strips = circle(centre, np.column_stack([flat, flat]))
        self.canvas.columns(self._circle(mac), t_ns[usable], rr.LineStrips3D.columns(strips=list(strips)))
