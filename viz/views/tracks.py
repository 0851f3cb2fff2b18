"""Views of positions: tracks in space and from above, heights, and the uncertainty stated with them."""

# ruff: noqa: D102 - begin, draw and end are documented once, in View

from __future__ import annotations

import numpy as np
import polars as pl
import rerun as rr

from .. import style
from ..canvas import COMPARE, ESTIMATES, OVERVIEW, PLACES, SPACE, ChannelLike, Floats, Times, columns_of
from ..naming import shown_as
from ..shapes import ELLIPSE95, circle, thinned
from ..trace import Trace
from .base import View

CLOSED_M = 1.0
"""Start and end closer than this have one label."""

POSITION = ("pos_x", "pos_y", "pos_z")
QUATERNION = ("quat_x", "quat_y", "quat_z", "quat_w")  # Rerun's order


class Positions(View):
    """The whole track as a line, a point a sample up to the cursor, the axes of the body, and the height."""

    title = "tracks: whole line, trail up to the cursor, axes of the body, height"
    schemas = PLACES
    needs = POSITION

    def begin(self) -> None:
        # the channel named "pose" is its owner's track itself; others ("vicon") keep their name
        canvas = self.canvas
        self.base = canvas.base(self.channel.topic)
        own = self.base != self.path  # it is its owner's track
        self.name = self.owner if own or self.role != "estimate" else f"{self.owner} {self.what}"
        self.trace = Trace(self.name, self.color)
        if canvas.shows(self.owner):
            canvas.traces[self.base] = self.trace
        self.zero: Floats | None = None
        self.level: float | None = None  # a reference's zero of height is elsewhere: estimates begin at 0
        canvas.lines(f"{self.base}/height", [self.name], [self.color])
        self._points(2.0)
        self.turns = set(QUATERNION) <= set(self.channel.columns)
        if self.turns:
            canvas.static(f"{self.base}/foot", rr.TransformAxes3D(0.3))
        for part in ("track", "trail", "mark", *(["foot"] if self.turns else [])):
            entity_path, past = f"{self.base}/{part}", part == "trail"
            canvas.show("space", entity_path, tab=OVERVIEW, panel=SPACE, owner=self.owner, past=past)
        panel = "height above the start (m)"
        canvas.show("plot", f"{self.base}/height", tab=OVERVIEW, panel=panel, owner=self.owner)

    def draw(self, t_ns: Times, block: pl.DataFrame) -> None:
        canvas = self.canvas
        position = columns_of(block, POSITION)
        placed_rows = np.isfinite(position[:, :2]).all(axis=1)
        if not np.isfinite(position[placed_rows, 2]).any():
            position[placed_rows, 2] = 0.0  # a position in the plane
        finite = np.isfinite(position).all(axis=1)
        if self.level is None and finite.any():
            self.level = float(position[finite][0, 2]) if self.role == "reference" else 0.0
        canvas.scalars(f"{self.base}/height", t_ns, position[:, 2] - (self.level or 0.0))
        t_ns, position = t_ns[finite], position[finite]
        if not t_ns.size:
            return
        if self.zero is None:
            self.zero = canvas.origin(position[0])
        position -= self.zero
        turn = columns_of(block, QUATERNION)[finite] if self.turns else None
        self.trace.add(t_ns, position, None if turn is None else turn[:, [3, 0, 1, 2]])
        local = position.astype(np.float32)
        canvas.columns(f"{self.base}/trail", t_ns, rr.Points3D.columns(positions=local))
        if turn is not None:
            good = np.isfinite(turn).all(axis=1)
            columns = rr.Transform3D.columns(
                translation=local[good], quaternion=turn[good].astype(np.float32)
            )
            canvas.columns(f"{self.base}/foot", t_ns[good], columns)

    def end(self) -> None:
        canvas = self.canvas
        line = self.trace.positions.astype(np.float32)
        if not len(line):
            return
        if np.ptp(line[:, 2]) == 0.0:  # a track in the plane
            canvas.hide(f"{self.base}/height")
        color = style.rgb(self.color)
        canvas.static(
            f"{self.base}/track",
            rr.LineStrips3D([line], colors=color, radii=rr.Radius.ui_points(1.0)),
        )
        if self.trace.sparse:
            self._points(7.0)
        owners = list(canvas.traces) if self.base in canvas.traces else [self.base]
        # names stand at different places of the walk, so that those of several runs do not cover each other
        label_row = len(line) * (owners.index(self.base) + 1) // (len(owners) + 1)
        first = owners[0] == self.base
        closed = float(np.linalg.norm(line[-1] - line[0])) < CLOSED_M
        canvas.static(
            f"{self.base}/mark",
            rr.Points3D(
                line[[0, label_row, -1]],
                labels=["start" if first else "", self.name, "end" if first and not closed else ""],
                colors=color,
                radii=rr.Radius.ui_points([5.0, 0.0, 5.0]),
                show_labels=True,
            ),
        )

    def _points(self, radius: float) -> None:
        """Style the trail."""
        points = rr.Points3D.from_fields(colors=style.rgb(self.color), radii=rr.Radius.ui_points(radius))
        self.canvas.static(f"{self.base}/trail", points)


class Sigma(View):
    """A filter's own standard deviations, as bands of ±1σ about zero: where the error should lie; of the
    position also as the 95 % ellipse about the track.
    """

    title = "stated standard deviations: bands about zero, and the 95 % ellipse about the track"
    schemas = ("marcha_msgs/msg/NavigationSigma",)
    GROUPS = (("pos", "position", "m"), ("vel", "velocity", "m/s"), ("att", "attitude", "°"))

    def begin(self) -> None:
        canvas = self.canvas
        self.groups: dict[str, tuple[str, float]] = {}
        self.widest = 0.0
        self.waiting: list[tuple[Times, Floats]] = []
        self.next_ns = 0
        for key, title, unit in self.GROUPS:
            names = [c for c in self.channel.columns if c.startswith(f"sigma_{key}_")]
            for name, color in zip(names, style.AXES, strict=False):
                path = f"{self.path}/{key}_{name[-1]}"
                self.groups[name] = (path, shown_as(name).factor)
                canvas.static(
                    path,
                    rr.Measurements.from_fields(
                        names=f"±1σ {title} {name[-1]}", units=unit, colors=style.rgb(color), widths=0.5
                    ),
                )
                if key == "pos":
                    panel = f"{self.owner}: error and ±1σ of the position (m)"
                    canvas.show("plot", path, tab=COMPARE, panel=panel, owner=self.owner, stack="error")
                else:
                    panel = f"{self.owner}: ±1σ of the {title} ({unit})"
                    canvas.show("plot", path, tab=ESTIMATES, panel=panel, owner=self.owner)
        self.plane = {"sigma_pos_x", "sigma_pos_y"} <= set(self.channel.columns)
        if self.plane:
            self.ellipse = f"{self.parent}/ellipse"
            canvas.static(
                self.ellipse,
                rr.LineStrips3D.from_fields(colors=style.rgb(self.color), radii=rr.Radius.ui_points(1.0)),
            )
            canvas.show("space", self.ellipse, tab=OVERVIEW, panel=SPACE, owner=self.owner)

    def draw(self, t_ns: Times, block: pl.DataFrame) -> None:
        zero = np.zeros(len(t_ns))
        for name, (path, factor) in self.groups.items():
            sigma = columns_of(block, [name], [factor])[:, 0]
            if np.isfinite(sigma).any():
                columns = rr.Measurements.columns(values=zero, variances=sigma * sigma)
                self.canvas.columns(path, t_ns, columns)
                if name.startswith("sigma_pos_"):
                    self.widest = max(self.widest, float(np.nanmax(sigma)))
        if self.plane:
            axes = columns_of(block, ["sigma_pos_x", "sigma_pos_y"])
            kept, self.next_ns = thinned(t_ns, self.next_ns)
            kept = kept[np.isfinite(axes[kept]).all(axis=1)]
            self.waiting.append((t_ns[kept], ELLIPSE95 * axes[kept]))
            self._ellipses(whole=False)

    def end(self) -> None:
        if self.plane:
            self._ellipses(whole=True)
        if self.widest > 0.0:  # the viewer's own zoom knows the values, all zero, but not their bands
            for name in (n for n in self.groups if n.startswith("sigma_pos_")):
                self.canvas.zoom[self.groups[name][0]] = (-1.3 * self.widest, 1.3 * self.widest)

    def _ellipses(self, whole: bool) -> None:
        """Log the ellipses whose centre is known already."""
        trace = self.canvas.traces.get(self.parent)
        if trace is None or trace.count == 0 or not self.waiting:
            return
        t_ns = np.concatenate([t for t, _ in self.waiting])
        axes = np.concatenate([a for _, a in self.waiting])
        ready = np.ones(len(t_ns), bool) if whole else t_ns <= trace.last_ns
        self.waiting = [(t_ns[~ready], axes[~ready])]
        if ready.any():
            strips = circle(trace.at(t_ns[ready]), axes[ready])
            self.canvas.columns(self.ellipse, t_ns[ready], rr.LineStrips3D.columns(strips=list(strips)))


class OlderSigma(Sigma):
    """Standard deviations as marcha wrote them before there was a message of their own."""

    title = "stated standard deviations of older recordings"
    schemas = ("marcha_msgs/msg/NamedValues",)
    priority = 2  # before the sigma of angles, whose topic is the same

    @classmethod
    def fits(cls, channel: ChannelLike) -> bool:
        parts = [c.split("_")[:2] for c in channel.columns]
        return (
            super().fits(channel)
            and bool(parts)
            and all(p[0] == "sigma" and p[-1] in ("pos", "vel", "att") for p in parts)
        )
