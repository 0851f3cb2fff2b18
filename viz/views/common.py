"""Views for any recording: numbers, texts and states of whatever type, inertial sensors, vectors, values."""

# ruff: noqa: D102 - begin, draw and end are documented once, in View

from __future__ import annotations

import numpy as np
import polars as pl

from ...recording import SCHEMAS
from .. import style
from ..canvas import (
    DETECTOR,
    OVERVIEW,
    RAW,
    REPORT,
    ChannelLike,
    Floats,
    RecentNorm,
    Times,
    columns_of,
    thresholds_of,
)
from ..naming import shown_as, unit_in, unit_of
from ..text import printable
from .base import View
from .lanes import Lane

FAR_ABOVE = 5.0
"""A statistic that rises more than so many times above its threshold is shown up to there: else the
threshold is at zero."""

STATE_COLUMNS = ("state", "mode", "zone")
"""Columns of named values that are states: numbers of a list, drawn as lanes. The channel's metadata ``states``
names them from 0 on (``T,S,TS``); ``states.<column>`` does so for any column."""

USE = "use"
"""An output of this name says by 0 and 1 what is used: a lane each."""

LONGEST = 300
"""Characters of a text in the log; the recording has all of it."""


class General(View):
    """Any channel: numbers as lines, one panel a unit, flags as lanes, texts in the log.

    Units and meanings come from the message type where marcha knows it, else from the types of the columns.
    """

    title = "any channel: numbers by unit, flags as lanes, texts in the log"
    priority = -100

    def begin(self) -> None:
        self.kinds: dict[str, str] | None = None  # known with the first rows
        self.lanes: dict[str, Lane] = {}
        schema = SCHEMAS.get(self.channel.schema)
        kinds = {} if schema is None or schema.names else {c.name: c.kind for c in schema.columns}
        if self.channel.columns and set(self.channel.columns) <= set(kinds):
            self._prepare({c: kinds[c] for c in self.channel.columns})

    def _prepare(self, kinds: dict[str, str]) -> None:
        """Decide what each column is drawn as, and say where."""
        self.kinds = kinds
        self.numbers = [c for c, k in kinds.items() if k in ("number", "sigma", "time")]
        self.flags = [c for c, k in kinds.items() if k == "flag"]
        self.texts = [c for c, k in kinds.items() if k not in ("number", "sigma", "time", "flag")]
        self.shown = {c: shown_as(c, self._unit(c, kinds[c])) for c in self.numbers}
        units = {c: unit_in(self.shown[c].name) for c in self.numbers}
        self.single = len(set(units.values())) <= 1
        head = (
            self.owner if self.role != "estimate" and self.what in self.owner else f"{self.owner} {self.what}"
        )
        if self.single and self.numbers:
            names = [self.shown[c].name for c in self.numbers]
            self.canvas.lines(self.path, names, [style.axis_color(i) for i in range(len(names))])
            self.canvas.show("plot", self.path, tab=self.tab, panel=head, owner=self.owner, alone=True)
        else:
            count: dict[str, int] = {}
            for c in self.numbers:
                place = count.setdefault(units[c], 0)
                count[units[c]] += 1
                self.canvas.lines(f"{self.path}/{slug(c)}", [self.shown[c].name], [style.axis_color(place)])
                panel = self._panel(c, head, units[c])
                entity_path = f"{self.path}/{slug(c)}"
                self.canvas.show("plot", entity_path, tab=self.tab, panel=panel, owner=self.owner)
        for c in self.flags:
            entity_path = f"{self.path}/{slug(c)}"
            self.lanes[c] = Lane(self.canvas, entity_path)
            self.canvas.show("lanes", entity_path, tab=OVERVIEW, panel="lanes", owner=self.owner)
        if self.texts:
            self.log = f"{self.canvas.prefix}/log{self.path.removeprefix(self.canvas.prefix)}"
            self.canvas.show("log", self.log, tab=REPORT, panel="texts", owner=self.owner)

    def _panel(self, column: str, head: str, unit: str) -> str:
        """Return the panel of a column where the channel has several units."""
        return f"{head} ({unit})" if unit else head

    def _unit(self, column: str, kind: str) -> str:
        return "s after the message" if kind == "time" else unit_of(self.channel.schema, column)

    def draw(self, t_ns: Times, block: pl.DataFrame) -> None:
        if self.kinds is None:
            names = [c for c in block.columns if c not in ("t_ns", "t_log_ns")]
            self._prepare({c: kind_of(block[c].dtype) for c in names})
        if self.numbers:
            values = np.column_stack([self._numbers(c, t_ns, block) for c in self.numbers])
            if self.single:
                self.canvas.scalars(self.path, t_ns, values)
            else:
                for i, c in enumerate(self.numbers):
                    self.canvas.scalars(f"{self.path}/{slug(c)}", t_ns, values[:, i])
        for c in self.flags:
            codes = block[c].cast(pl.Int64).fill_null(2).to_numpy()
            self.lanes[c].add(t_ns, np.clip(codes, 0, 2), ("no", "yes", ""))
        if self.texts:
            columns = [block[c].to_list() for c in self.texts]
            lines = [
                ", ".join(f"{c} {in_short(v)}" for c, v in zip(self.texts, row, strict=True) if v is not None)
                for row in zip(*columns, strict=True)
            ]
            self.canvas.text(self.log, t_ns, [f"{self.channel.topic}: {line}" for line in lines])

    def _numbers(self, column: str, t_ns: Times, block: pl.DataFrame) -> Floats:
        if self.kinds and self.kinds[column] == "time":
            return (block[column].to_numpy() - t_ns) / 1e9
        return columns_of(block, [column], [self.shown[column].factor])[:, 0]

    def end(self) -> None:
        for lane in self.lanes.values():
            lane.end()


class Imu(View):
    """Accelerometer, gyroscope and their norms, with the detectors' thresholds on them; orientation where the
    device states one.
    """

    title = "accelerometer, gyroscope, their norms against thresholds, the device's own orientation"
    schemas = ("sensor_msgs/msg/Imu",)

    @classmethod
    def fits(cls, channel: ChannelLike) -> bool:
        return super().fits(channel) and not {"acc_x", "gyr_x", "quat_w"}.isdisjoint(channel.columns)

    def begin(self) -> None:
        canvas = self.canvas
        has = [key for key in ("acc", "gyr") if f"{key}_x" in self.channel.columns]
        name = {"acc": ("accelerometer", "m/s²"), "gyr": ("gyroscope", "rad/s")}
        self.sensors = [(key, *name[key]) for key in has]
        for key, title, unit in self.sensors:
            path = f"{self.path}/{key}"
            canvas.lines(path, [f"{key} {a} ({unit})" for a in "xyz"], style.AXES)
            canvas.lines(f"{path}_norm", [f"‖{key}‖ ({unit})"], [style.NORM])
            panel = f"{self.owner} {title} ({unit})"
            canvas.show("plot", path, tab=RAW, panel=panel, owner=self.owner, alone=True)
            if canvas.primary(self.channel.schema, f"{key}_x") == self.channel.topic:
                panel = norm_panel(self.owner, key)
                canvas.show("plot", f"{path}_norm", tab=OVERVIEW, panel=panel, owner=self.owner)
                if key == "acc":
                    canvas.norms[self.channel.topic] = RecentNorm()
        self.turns = "quat_w" in self.channel.columns
        if self.turns:
            path = f"{self.path}/orientation"
            canvas.lines(path, [f"{a} (°)" for a in EULER], style.AXES)
            panel = f"{self.owner} orientation (°)"
            canvas.show("plot", path, tab=RAW, panel=panel, owner=self.owner)

    def draw(self, t_ns: Times, block: pl.DataFrame) -> None:
        for key, _, _ in self.sensors:
            values = columns_of(block, [f"{key}_{a}" for a in "xyz"])
            norm = np.sqrt(np.einsum("ij,ij->i", values, values))
            self.canvas.scalars(f"{self.path}/{key}", t_ns, values)
            self.canvas.scalars(f"{self.path}/{key}_norm", t_ns, norm)
            if key == "acc" and self.channel.topic in self.canvas.norms:
                self.canvas.norms[self.channel.topic].add(t_ns, norm)
        if self.turns:
            angles = euler_deg(columns_of(block, [f"quat_{a}" for a in "wxyz"]))
            self.canvas.scalars(f"{self.path}/orientation", t_ns, angles)

    def end(self) -> None:
        for key, _, unit in self.sensors:
            for limit in self.canvas.thresholds:
                if limit.statistic == f"{key}_norm":
                    self.canvas.limit(f"{self.path}/{key}_norm", limit, f" {unit}")


class Velocity(View):
    """Velocity by axis, and the speed."""

    title = "velocity by axis, and the speed"
    schemas = ("geometry_msgs/msg/Vector3Stamped",)
    needs = ("vel_x", "vel_y", "vel_z")

    def begin(self) -> None:
        canvas = self.canvas
        self.names = list(self.channel.columns[:3])
        canvas.lines(self.path, [f"velocity {a} (m/s)" for a in "xyz"], style.AXES)
        panel = f"{self.owner} {self.what} (m/s)"
        canvas.show("plot", self.path, tab=self.tab, panel=panel, owner=self.owner, alone=True)
        self.speed = f"{self.parent}/speed" if self.what == "velocity" else f"{self.path}/speed"
        canvas.lines(self.speed, [self.owner], [self.color])
        if self.role != "raw":
            canvas.show("plot", self.speed, tab="Compare", panel="speed (m/s)", owner=self.owner)

    def draw(self, t_ns: Times, block: pl.DataFrame) -> None:
        values = columns_of(block, self.names)
        self.canvas.scalars(self.path, t_ns, values)
        speed = np.sqrt(np.nansum(values * values, axis=1))  # a receiver's velocity has no vertical part
        speed[np.isnan(values).all(axis=1)] = np.nan
        self.canvas.scalars(self.speed, t_ns, speed)


class Values(View):
    """Named values (internals of a filter), one panel a unit; those of a detector each by itself, with its own
    thresholds; numbered states as lanes. The channel's metadata ``unit`` says the unit of all of them.
    """

    title = "named values, each with its thresholds; states as lanes"
    schemas = ("marcha_msgs/msg/NamedValues",)

    def begin(self) -> None:
        canvas = self.canvas
        metadata = self.channel.metadata
        columns = list(self.channel.columns)
        labels = {c: metadata.get("states", "") for c in columns if c in STATE_COLUMNS}
        labels |= {k[7:]: v for k, v in metadata.items() if k.startswith("states.")}
        if self.what == USE:
            labels |= dict.fromkeys(columns, ",used")
        states = [c for c in columns if c in labels]
        self.lanes: dict[str, tuple[Lane, list[str]]] = {}
        for name in states:
            words = [printable(w.strip()) for w in labels[name].split(",")] if labels[name] else []
            entity_path = f"{self.path}/{slug(name)}"
            colors = {w: style.run_color(i) for i, w in enumerate(words) if w}
            self.lanes[name] = (Lane(canvas, entity_path, colors), words)
            for tab in (OVERVIEW, self._tab()):
                canvas.show("lanes", entity_path, tab=tab, panel="lanes", owner=self.owner)
        unit = metadata.get("unit", "")
        self.shown = {c: shown_as(c, unit) for c in columns if c not in self.lanes}
        self.highest = dict.fromkeys(self.shown, 0.0)
        for number, (name, shown) in enumerate(self.shown.items()):
            path = f"{self.path}/{slug(name)}"
            alone = self._tab() == DETECTOR
            canvas.lines(path, [shown.name], [self.color if alone else style.axis_color(number)])
            unit = unit_in(shown.name)
            together = f"{self.owner} {self.what}" if self.role == "estimate" else self.owner
            panel = f"{self.owner}: {shown.name}" if alone else together + (f" ({unit})" if unit else "")
            self._show(name, path, panel)

    def _show(self, name: str, path: str, panel: str) -> None:
        """Say where a value is shown."""
        self.canvas.show("plot", path, tab=self._tab(), panel=panel, owner=self.owner)

    def _tab(self) -> str:
        return DETECTOR if self.what == "detector" and self.role == "estimate" else self.tab

    def draw(self, t_ns: Times, block: pl.DataFrame) -> None:
        for name, shown in self.shown.items():
            values = columns_of(block, [name], [shown.factor])[:, 0]
            self.canvas.scalars(f"{self.path}/{slug(name)}", t_ns, values)
            finite = values[np.isfinite(values)]
            self.highest[name] = max(self.highest[name], float(finite.max(initial=0.0)))
        for name, (lane, words) in self.lanes.items():
            values = columns_of(block, [name])[:, 0]
            states, codes = np.unique(values, return_inverse=True)
            lane.add(t_ns, codes, [state_name(v, words) for v in states])

    def end(self) -> None:
        for limit in thresholds_of(self.channel):
            if limit.statistic in self.shown:
                path = f"{self.path}/{slug(limit.statistic)}"
                self.canvas.limit(path, limit)
                if self.highest[limit.statistic] > FAR_ABOVE * limit.value > 0.0:
                    self.canvas.zoom[path] = (-0.1 * FAR_ABOVE * limit.value, FAR_ABOVE * limit.value)
        for lane, _ in self.lanes.values():
            lane.end()


class Frames(View):
    """Transforms between frames: a line in the log each."""

    title = "transforms between frames, in the log"
    schemas = ("tf2_msgs/msg/TFMessage", "geometry_msgs/msg/TransformStamped")
    needs = ("pos_x", "pos_y", "pos_z")

    def begin(self) -> None:
        self.log = f"{self.canvas.prefix}/log{self.path.removeprefix(self.canvas.prefix)}"
        self.canvas.show("log", self.log, tab=REPORT, panel="texts", owner=self.owner)

    def draw(self, t_ns: Times, block: pl.DataFrame) -> None:
        position = columns_of(block, ["pos_x", "pos_y", "pos_z"])
        turn = np.tile([1.0, 0.0, 0.0, 0.0], (block.height, 1))
        if "quat_w" in block:
            turn = columns_of(block, [f"quat_{a}" for a in "wxyz"])
        angles = euler_deg(turn)
        parents = block["parent_frame_id"].to_list() if "parent_frame_id" in block else [""] * block.height
        children = block["child_frame_id"].to_list() if "child_frame_id" in block else [""] * block.height
        self.canvas.text(
            self.log,
            t_ns,
            [
                f"{self.channel.topic}: {child} in {parent or 'its frame'} at ({x:.3f}, {y:.3f}, {z:.3f}) m, "
                f"roll {roll:.1f}°, pitch {pitch:.1f}°, yaw {yaw:.1f}°"
                for parent, child, (x, y, z), (roll, pitch, yaw) in zip(
                    parents, children, position, angles, strict=True
                )
            ],
        )


class Events(View):
    """Annotations: the recording's table of them is drawn (:meth:`marcha.viz.scene.Scene.annotate`)."""

    title = "annotations: intervals as lanes, instants as points"
    schemas = ("foxglove_msgs/msg/Event",)


EULER = ("roll", "pitch", "yaw")


def euler_deg(quat_wxyz: Floats) -> Floats:
    """Return roll, pitch, yaw (n, 3) in degrees (rotations about x, y, z of the body, z first: Tait-Bryan)."""
    w, x, y, z = quat_wxyz.T
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return np.degrees(np.column_stack([roll, pitch, yaw]))


def slug(name: str) -> str:
    """Return a column's name as the last part of an entity path."""
    if name.isascii() and name.replace("_", "").isalnum():
        return name
    import rerun as rr

    return rr.escape_entity_path_part(printable(name) or "_")


def kind_of(dtype: pl.DataType) -> str:
    """Return the kind of a column of an unknown message type."""
    if dtype == pl.Boolean:
        return "flag"
    return "number" if dtype.is_numeric() else "text"


def in_short(value: object) -> str:
    """Return a value of any type as a text of one line and bounded length."""
    if isinstance(value, bytes):
        return f"{len(value)} bytes"
    text = printable(value)
    return text if len(text) <= LONGEST else text[: LONGEST - 1] + "…"


def state_name(value: float, words: list[str]) -> str:
    """Return the name of a numbered state; a missing one is a gap."""
    if not np.isfinite(value):
        return ""
    if float(value).is_integer() and 0 <= value < len(words):
        return words[int(value)]
    return f"{value:g}"


def norm_panel(owner: str, key: str) -> str:
    """Return the name of the panel of a sensor's norm."""
    title, unit = {"acc": ("accelerometer", "m/s²"), "gyr": ("gyroscope", "rad/s")}[key]
    return f"{owner} norm of the {title} ({unit})"
