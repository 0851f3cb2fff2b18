"""Views of feet and steps: stance lanes, step lengths, footprints, steps on the norm of the accelerometer."""

# ruff: noqa: D102 - begin, draw and end are documented once, in View

from __future__ import annotations

import numpy as np
import polars as pl
import rerun as rr

from .. import style
from ..canvas import (
    COMPARE,
    DETECTOR,
    OVERVIEW,
    REPORT,
    SPACE,
    ChannelLike,
    Times,
    columns_of,
    entity,
)
from ..stance_figures import condition, statistics_of
from .base import View
from .common import norm_panel
from .lanes import Lane

IMU = "sensor_msgs/msg/Imu"


class Stance(View):
    """A lane that tells still from moving; only changes are logged."""

    title = "stance: a lane that tells still from moving"
    schemas = ("marcha_msgs/msg/Stance",)
    needs = ("still",)

    def begin(self) -> None:
        colors = {"still": style.STILL, "moving": style.MOVING}
        # a swing is too short for a word: it is the gap between two stances
        self.lane = Lane(self.canvas, self.path, colors, hidden=["moving"])
        for tab in (OVERVIEW, DETECTOR):
            self.canvas.show("lanes", self.path, tab=tab, panel="lanes", owner=self.owner)

    def draw(self, t_ns: Times, block: pl.DataFrame) -> None:
        still = columns_of(block, self.channel.columns[:1])[:, 0]
        state = np.where(np.isfinite(still), still > 0.5, 2).astype(np.int64)
        self.lane.add(t_ns, state, ("moving", "still", ""))

    def end(self) -> None:
        self.lane.end()


class Conditions(View):
    """How a stance detector decides: a lane a condition that tells met from not met, beside its statistics."""

    title = "stance detector: a lane a condition, met or not"
    schemas = ("marcha_msgs/msg/NamedValues",)
    roles = ("estimate",)
    beside = True

    @classmethod
    def fits(cls, channel: ChannelLike) -> bool:
        return super().fits(channel) and "detector" in channel.metadata

    def begin(self) -> None:
        colors = {"met": style.STILL, "not met": style.MOVING}
        self.lanes = {}
        for statistic in statistics_of(self.channel.columns):
            path = f"{self.path}/condition/{entity(statistic)}"
            self.lanes[statistic] = Lane(self.canvas, path, colors, hidden=["not met"])
            self.canvas.show("lanes", path, tab=DETECTOR, panel="lanes", owner=self.owner)

    def draw(self, t_ns: Times, block: pl.DataFrame) -> None:
        for statistic, lane in self.lanes.items():
            met = condition(statistic, block, self.channel.metadata)
            finite = np.isfinite(block[statistic].cast(pl.Float64).to_numpy())
            lane.add(t_ns, np.where(finite, met, 2).astype(np.int64), ("not met", "met", ""))

    def end(self) -> None:
        for lane in self.lanes.values():
            lane.end()


class Steps(View):
    """Steps: their length over time, a footprint each where the foot came down, a point each on the norm of
    the accelerometer, and a line in the log.
    """

    title = "steps: lengths, footprints, points on the norm of the accelerometer, a line in the log"
    schemas = ("marcha_msgs/msg/Step",)
    needs = ("end_ns", "index", "length_m", "height_m", "heading_rad")

    def begin(self) -> None:
        canvas = self.canvas
        self.waiting = np.empty(0, dtype=np.int64)
        color = style.rgb(self.color)
        canvas.points(self.path, self.owner, self.color)
        canvas.show("plot", self.path, tab=COMPARE, panel="step length (m)", owner=self.owner, alone=True)
        self.prints = f"{self.parent}/footprints"
        canvas.static(self.prints, rr.Points3D.from_fields(colors=color, radii=rr.Radius.ui_points(5.0)))
        canvas.show("space", self.prints, tab=OVERVIEW, panel=SPACE, owner=self.owner, past=True)
        part = self.parent.rsplit("/", 1)[-1]
        self.log = f"{canvas.prefix}/log/{self.what}/{part}"
        canvas.show("log", self.log, tab=REPORT, panel="steps and annotations", owner=self.owner)
        self.norm = canvas.primary(IMU, "acc_x")
        if self.norm is not None:
            self.events = f"{self.path}/on_norm"
            canvas.points(self.events, f"{self.owner} {self.what}", self.color, "diamond", 4.0)
            panel = norm_panel(canvas.owner(self.norm), "acc")
            canvas.show("plot", self.events, tab=OVERVIEW, panel=panel, owner=self.owner)

    def draw(self, t_ns: Times, block: pl.DataFrame) -> None:
        canvas = self.canvas
        canvas.scalars(self.path, t_ns, columns_of(block, ["length_m"])[:, 0])
        rows = columns_of(block, ["index", "length_m", "height_m", "heading_rad"])
        canvas.text(self.log, t_ns, [f"{self.owner}: {in_words(*row)}" for row in rows.tolist()])
        self.waiting = np.concatenate([self.waiting, block["end_ns"].to_numpy()])
        self._prints(whole=False)
        if self.norm is not None and self.norm in canvas.norms:
            canvas.scalars(self.events, t_ns, canvas.norms[self.norm].at(t_ns))

    def end(self) -> None:
        self._prints(whole=True)

    def _prints(self, whole: bool) -> None:
        """Log the footprints whose place is known already: the track's at the end of the swing."""
        trace = self.canvas.traces.get(self.parent)
        if trace is None or trace.count == 0 or not self.waiting.size:
            return
        ready = self.waiting[self.waiting <= trace.last_ns] if not whole else self.waiting
        self.waiting = self.waiting[len(ready) :]
        place = trace.at(ready).astype(np.float32)
        self.canvas.columns(self.prints, ready, rr.Points3D.columns(positions=place))


def in_words(index: float, length: float, height: float, heading: float) -> str:
    """Return a step in words; what is not known is left out."""
    text = f"step {index:.0f}" if np.isfinite(index) else "step"
    if np.isfinite(length):
        text += f", {length:.2f} m"
    if np.isfinite(height):
        text += f", {round(height, 2) + 0.0:+.2f} m up"
    if np.isfinite(heading):
        text += f", towards {round(float(np.degrees(heading)), 0) + 0.0:.0f}°"
    return text
