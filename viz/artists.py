"""What each kind of channel looks like."""

# ruff: noqa: D102 - begin, draw and end are documented once, in Artist

from __future__ import annotations

import numpy as np
import polars as pl
import rerun as rr

from ..recording import SCHEMAS
from . import style
from .scene import (
    ChannelLike,
    Floats,
    Scene,
    Threshold,
    Times,
    columns_of,
    is_estimate,
    thresholds_of,
)
from .track import Track

CLOSED_M = 1.0
"""Start and end closer than this have one label."""

FAR_ABOVE = 5.0
"""A statistic that rises more than so many times above its threshold is shown up to there: else the
threshold is at zero."""


class Artist:
    """Draws one channel; subclasses say how."""

    def __init__(self, scene: Scene, channel: ChannelLike) -> None:
        self.scene, self.channel = scene, channel
        self.path = scene.group(channel.topic)
        self.color = scene.color(channel.topic)
        self.owner = scene.owner(channel.topic)
        self.what = channel.topic.rsplit("/", 1)[-1]

    @property
    def parent(self) -> str:
        """Entity of the channel's owner: ``/run/<run>``, ``/reference``."""
        return self.path.rsplit("/", 1)[0]

    def begin(self) -> None:
        """Log styles and say which views should show what."""

    def draw(self, t_ns: Times, block: pl.DataFrame) -> None:
        """Log one block of rows."""

    def end(self) -> None:
        """Log what needs the whole."""

    def scalars(self, path: str, t_ns: Times, values: Floats) -> None:
        """Log (n,) or (n, k) values; a block without any finite value is left out."""
        if np.isfinite(values).any():
            self.scene.columns(path, t_ns, rr.Scalars.columns(scalars=values))

    def limit(self, path: str, limit: Threshold, unit: str = "") -> None:
        """Log a horizontal line below an entity, over the whole time seen."""
        # two runs may limit one statistic differently
        entity = f"{path}/threshold/{limit.name}_{limit.value:g}"
        word = "min" if limit.name.endswith(".min") else "max"
        self.scene.lines(entity, [f"{word} {limit.value:g}{unit}"], [style.THRESHOLD])
        span = self.scene.span()
        self.scalars(entity, span, np.full(span.size, limit.value))


class Numbers(Artist):
    """Any channel of numbers: one line a column, named with its unit."""

    def begin(self) -> None:
        schema = SCHEMAS.get(self.channel.schema)
        known = {c.name: c for c in schema.columns} if schema else {}
        self.names = [
            c for c in self.channel.columns if c not in known or known[c].kind in ("number", "sigma", "flag")
        ]
        shown = [shown_as(c, known[c].unit if c in known else "") for c in self.names]
        self.factors = [s.factor for s in shown]
        self.scene.lines(self.path, [s.name for s in shown], [style.axis_color(i) for i in range(len(shown))])
        role = "other" if is_estimate(self.channel.topic) else "raw"
        self.scene.show(
            role, self.owner, f"{self.owner} {self.what}" if role == "other" else self.owner, self.path
        )

    def draw(self, t_ns: Times, block: pl.DataFrame) -> None:
        if self.names:
            self.scalars(self.path, t_ns, columns_of(block, self.names, self.factors))


class Imu(Artist):
    """Accelerometer, gyroscope and their norms, with the detectors' thresholds on them."""

    def begin(self) -> None:
        self.sensors = [
            (key, title, unit)
            for key, title, unit in (("acc", "accelerometer", "m/s²"), ("gyr", "gyroscope", "rad/s"))
            if f"{key}_x" in self.channel.columns
        ]
        for key, title, unit in self.sensors:
            path = f"{self.path}/{key}"
            self.scene.lines(path, [f"{key} {a} ({unit})" for a in "xyz"], style.AXES)
            self.scene.lines(f"{path}_norm", [f"‖{key}‖ ({unit})"], [style.NORM])
            self.scene.show("raw", self.owner, f"{self.owner} {title} ({unit})", path)
            self.scene.show("norm", self.owner, f"{self.owner} norm of the {title} ({unit})", f"{path}_norm")

    def draw(self, t_ns: Times, block: pl.DataFrame) -> None:
        for key, _, _ in self.sensors:
            values = columns_of(block, [f"{key}_{a}" for a in "xyz"])
            self.scalars(f"{self.path}/{key}", t_ns, values)
            self.scalars(f"{self.path}/{key}_norm", t_ns, np.sqrt(np.einsum("ij,ij->i", values, values)))

    def end(self) -> None:
        for key, _, unit in self.sensors:
            for limit in self.scene.thresholds:
                if limit.statistic == f"{key}_norm":
                    self.limit(f"{self.path}/{key}_norm", limit, f" {unit}")


class Velocity(Artist):
    """Velocity by axis, and the speed."""

    def begin(self) -> None:
        self.names = list(self.channel.columns[:3])
        self.scene.lines(self.path, [f"velocity {a} (m/s)" for a in "xyz"], style.AXES)
        self.speed = f"{self.parent}/speed"
        self.scene.lines(self.speed, [self.owner], [self.color])
        self.scene.show("velocity", self.owner, f"{self.owner} velocity (m/s)", self.path)
        self.scene.show("speed", self.owner, "speed (m/s)", self.speed)

    def draw(self, t_ns: Times, block: pl.DataFrame) -> None:
        values = columns_of(block, self.names)
        self.scalars(self.path, t_ns, values)
        self.scalars(self.speed, t_ns, np.sqrt(np.einsum("ij,ij->i", values, values)))


class Pose(Artist):
    """The whole track as a line, a point a sample up to the cursor, the axes of the body, and the height."""

    POSITION = ("pos_x", "pos_y", "pos_z")
    QUATERNION = ("quat_x", "quat_y", "quat_z", "quat_w")  # Rerun's order

    def begin(self) -> None:
        # the channel named "pose" is its owner's track itself; others ("vicon") keep their name
        self.base = self.scene.base(self.channel.topic)
        self.track = Track(self.owner, self.color)
        if self.scene.shows(self.owner):
            self.scene.tracks[self.base] = self.track
        self.zero: Floats | None = None
        self.level: float | None = None  # a reference's zero of height is elsewhere: estimates begin at 0
        self.scene.lines(f"{self.base}/height", [self.owner], [self.color])
        self._points(2.0)
        self.turns = set(self.QUATERNION) <= set(self.channel.columns)
        if self.turns:
            self.scene.static(f"{self.base}/foot", rr.TransformAxes3D(0.3))
        for role in ("track", "trail", "mark", *(["foot"] if self.turns else [])):
            self.scene.show(role, self.owner, "track", f"{self.base}/{role}")
        self.scene.show("height", self.owner, "height above the start (m)", f"{self.base}/height")

    def draw(self, t_ns: Times, block: pl.DataFrame) -> None:
        position = columns_of(block, self.POSITION)
        finite = np.isfinite(position).all(axis=1)
        if self.level is None and finite.any():
            self.level = (
                float(position[finite][0, 2]) if self.channel.topic.startswith("/reference/") else 0.0
            )
        self.scalars(f"{self.base}/height", t_ns, position[:, 2] - (self.level or 0.0))
        t_ns, position = t_ns[finite], position[finite]
        if not t_ns.size:
            return
        if self.zero is None:
            self.zero = self.scene.origin(position[0])
        position -= self.zero
        turn = columns_of(block, self.QUATERNION)[finite] if self.turns else None
        self.track.add(t_ns, position, None if turn is None else turn[:, [3, 0, 1, 2]])
        local = position.astype(np.float32)
        self.scene.columns(f"{self.base}/trail", t_ns, rr.Points3D.columns(positions=local))
        if turn is not None:
            good = np.isfinite(turn).all(axis=1)
            columns = rr.Transform3D.columns(
                translation=local[good], quaternion=turn[good].astype(np.float32)
            )
            self.scene.columns(f"{self.base}/foot", t_ns[good], columns)

    def end(self) -> None:
        line = self.track.positions.astype(np.float32)
        if not len(line):
            return
        color = style.rgb(self.color)
        self.scene.static(
            f"{self.base}/track",
            rr.LineStrips3D([line], colors=color, radii=rr.Radius.ui_points(1.0)),
        )
        if self.track.sparse:
            self._points(7.0)
        owners = list(self.scene.tracks) if self.base in self.scene.tracks else [self.base]
        # names stand at different places of the walk, so that those of several runs do not cover each other
        at = len(line) * (owners.index(self.base) + 1) // (len(owners) + 1)
        first = owners[0] == self.base
        closed = float(np.linalg.norm(line[-1] - line[0])) < CLOSED_M
        self.scene.static(
            f"{self.base}/mark",
            rr.Points3D(
                line[[0, at, -1]],
                labels=["start" if first else "", self.owner, "end" if first and not closed else ""],
                colors=color,
                radii=rr.Radius.ui_points([5.0, 0.0, 5.0]),
                show_labels=True,
            ),
        )

    def _points(self, radius: float) -> None:
        """Style the trail."""
        points = rr.Points3D.from_fields(colors=style.rgb(self.color), radii=rr.Radius.ui_points(radius))
        self.scene.static(f"{self.base}/trail", points)


class Stance(Artist):
    """A lane that tells still from moving; only changes are logged."""

    def begin(self) -> None:
        self.last = -1
        self.scene.static(
            self.path,
            rr.StateConfiguration(
                values=["still", "moving"],
                labels=["still", "moving"],
                colors=[(*style.rgb(style.STILL), 255), (*style.rgb(style.MOVING), 255)],
                visible=[True, False],  # a swing is too short for a word: it is the gap between two stances
            ),
        )
        self.scene.show("stance", self.owner, "stance", self.path)

    def draw(self, t_ns: Times, block: pl.DataFrame) -> None:
        still = columns_of(block, self.channel.columns[:1])[:, 0]
        state = np.where(np.isfinite(still), still > 0.5, 2).astype(np.int64)
        change = np.flatnonzero(np.diff(state, prepend=self.last))
        self.last = int(state[-1])
        names = np.array(["moving", "still", ""])  # the empty state is a gap
        self.scene.columns(
            self.path, t_ns[change], rr.StateChange.columns(state=names[state[change]].tolist())
        )

    def end(self) -> None:
        span = self.scene.span()[1:]
        self.scene.columns(self.path, span, rr.StateChange.columns(state=[""] * span.size))


class Values(Artist):
    """Named values (statistics of a detector, internals of a filter): each by itself, with its own
    thresholds.
    """

    def begin(self) -> None:
        self.shown = {c: shown_as(c) for c in self.channel.columns}
        self.highest = dict.fromkeys(self.shown, 0.0)
        role = "detector" if self.what == "detector" else "other"
        for name, shown in self.shown.items():
            path = f"{self.path}/{name}"
            self.scene.lines(path, [shown.name], [self.color])
            self.scene.show(role, self.owner, f"{self.owner}: {shown.name}", path)

    def draw(self, t_ns: Times, block: pl.DataFrame) -> None:
        for name, shown in self.shown.items():
            values = columns_of(block, [name], [shown.factor])[:, 0]
            self.scalars(f"{self.path}/{name}", t_ns, values)
            finite = values[np.isfinite(values)]
            self.highest[name] = max(self.highest[name], float(finite.max(initial=0.0)))

    def end(self) -> None:
        for limit in thresholds_of(self.channel):
            if limit.statistic in self.shown:
                path = f"{self.path}/{limit.statistic}"
                self.limit(path, limit)
                if self.highest[limit.statistic] > FAR_ABOVE * limit.value > 0.0:
                    self.scene.zoom[path] = (-0.1 * FAR_ABOVE * limit.value, FAR_ABOVE * limit.value)


class Sigma(Artist):
    """A filter's own standard deviations, as bands of ±1σ about zero: where the error should lie."""

    GROUPS = (("pos", "position", "m"), ("vel", "velocity", "m/s"), ("att", "attitude", "°"))

    def begin(self) -> None:
        self.groups = {}
        self.widest = 0.0
        for key, title, unit in self.GROUPS:
            names = [c for c in self.channel.columns if c.startswith(f"sigma_{key}_")]
            for name, color in zip(names, style.AXES, strict=False):
                path = f"{self.path}/{key}_{name[-1]}"
                self.groups[name] = (path, shown_as(name).factor)
                self.scene.static(
                    path,
                    rr.Measurements.from_fields(
                        names=f"±1σ {title} {name[-1]}", units=unit, colors=style.rgb(color), widths=0.5
                    ),
                )
                role = "sigma" if key == "pos" else f"sigma_{key}"
                self.scene.show(role, self.owner, f"{self.owner}: ±1σ of the {title} ({unit})", path)

    def draw(self, t_ns: Times, block: pl.DataFrame) -> None:
        zero = np.zeros(len(t_ns))
        for name, (path, factor) in self.groups.items():
            sigma = columns_of(block, [name], [factor])[:, 0]
            if np.isfinite(sigma).any():
                self.scene.columns(path, t_ns, rr.Measurements.columns(values=zero, variances=sigma * sigma))
                if name.startswith("sigma_pos_"):
                    self.widest = max(self.widest, float(np.nanmax(sigma)))

    def end(self) -> None:
        if self.widest > 0.0:  # the viewer's own zoom knows the values, all zero, but not their bands
            for name in (n for n in self.groups if n.startswith("sigma_pos_")):
                self.scene.zoom[self.groups[name][0]] = (-1.3 * self.widest, 1.3 * self.widest)


class Steps(Artist):
    """Steps: their length over time, a footprint each where the foot came down, and a line in the log."""

    def begin(self) -> None:
        self.waiting = np.empty(0, dtype=np.int64)
        color = style.rgb(self.color)
        self.scene.static(
            self.path, rr.SeriesPoints(names=self.owner, colors=color, markers="circle", marker_sizes=3.0)
        )
        self.prints = f"{self.parent}/footprints"
        self.scene.static(self.prints, rr.Points3D.from_fields(colors=color, radii=rr.Radius.ui_points(5.0)))
        self.log = f"{self.scene.prefix}/log/{self.what}/{self.channel.topic.split('/')[2]}"
        self.scene.show("log", self.owner, "steps", self.log)
        self.scene.show("step", self.owner, "step length (m)", self.path)
        self.scene.show("footprints", self.owner, "footprints", self.prints)

    def draw(self, t_ns: Times, block: pl.DataFrame) -> None:
        self.scalars(self.path, t_ns, columns_of(block, ["length_m"])[:, 0])
        rows = block.select("index", "length_m", "height_m", "heading_rad").rows()
        text = [
            f"{self.owner}: step {i}, {length:.2f} m, {round(height, 2) + 0.0:+.2f} m up, "
            f"towards {round(float(np.degrees(heading)), 0) + 0.0:.0f}°"
            for i, length, height, heading in rows
        ]
        self.scene.columns(
            self.log,
            t_ns,
            rr.TextLog.columns(text=text, level=["INFO"] * len(text)),
        )
        self.waiting = np.concatenate([self.waiting, block["end_ns"].to_numpy()])
        self._prints(whole=False)

    def end(self) -> None:
        self._prints(whole=True)

    def _prints(self, whole: bool) -> None:
        """Log the footprints whose place is known already: the track's at the end of the swing."""
        track = self.scene.tracks.get(self.parent)
        if track is None or track.count == 0 or not self.waiting.size:
            return
        ready = self.waiting[self.waiting <= track.last_ns] if not whole else self.waiting
        self.waiting = self.waiting[len(ready) :]
        place = track.at(ready).astype(np.float32)
        self.scene.columns(self.prints, ready, rr.Points3D.columns(positions=place))


class Fix(Artist):
    """GNSS fixes on the map."""

    def begin(self) -> None:
        self.scene.static(
            self.path,
            rr.GeoPoints.from_fields(colors=style.rgb(style.AXES[2]), radii=rr.Radius.ui_points(4.0)),
        )
        self.scene.show("map", self.owner, self.owner, self.path)

    def draw(self, t_ns: Times, block: pl.DataFrame) -> None:
        place = columns_of(block, ["lat_deg", "lon_deg"])
        good = np.isfinite(place).all(axis=1)
        self.scene.columns(self.path, t_ns[good], rr.GeoPoints.columns(positions=place[good]))


class Nothing(Artist):
    """A channel without a picture of its own (radio addresses, frames)."""


def shown_as(column: str, unit: str = "") -> style.Column:
    """Return how a column is shown, by its own entry in the style or by its unit."""
    unit = "" if unit in ("-", "as named") else unit
    return style.COLUMNS.get(column) or style.Column(f"{column} ({unit})" if unit else column)


ARTISTS: dict[str, type[Artist]] = {
    "sensor_msgs/msg/Imu": Imu,
    "sensor_msgs/msg/NavSatFix": Fix,
    "geometry_msgs/msg/PoseStamped": Pose,
    "geometry_msgs/msg/PointStamped": Pose,
    "geometry_msgs/msg/Vector3Stamped": Velocity,
    "marcha_msgs/msg/Stance": Stance,
    "marcha_msgs/msg/Step": Steps,
    "marcha_msgs/msg/NavigationSigma": Sigma,
    "marcha_msgs/msg/NamedValues": Values,
    "marcha_msgs/msg/RadioSignal": Nothing,
    "marcha_msgs/msg/Ranging": Nothing,
    "geometry_msgs/msg/TransformStamped": Nothing,
    "tf2_msgs/msg/TFMessage": Nothing,
    "foxglove_msgs/msg/Event": Nothing,  # drawn from the recording's table of annotations
}
"""By message type; every other one is drawn as numbers."""


def artist_of(scene: Scene, channel: ChannelLike) -> Artist:
    """Return the artist that draws a channel."""
    kind = ARTISTS.get(channel.schema, Numbers)
    if kind is Values and channel.columns and all(c.startswith("sigma_") for c in channel.columns):
        kind = Sigma  # as marcha wrote them before it had NavigationSigma
    return kind(scene, channel)
