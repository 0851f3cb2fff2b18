"""What views draw on: the Rerun stream of one recording, its names, colours, times, and what is shown where.

A :class:`Canvas` belongs to one recording. Views log entities through it and say with :meth:`Canvas.show`
which panel of which tab shows them; :mod:`marcha.viz.blueprint` arranges the panels.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
import polars as pl
import rerun as rr
from numpy.typing import NDArray

from ..recording.names import is_estimate
from ..replay.alignment import on_a_plan
from ..replay.references import shown_reference
from . import style
from .floor import FloorPlan
from .text import printable
from .timeaxis import TimeAxis
from .trace import ALIGNMENT, Trace

Floats = NDArray[np.float64]
Times = NDArray[np.int64]
Kind = Literal["plot", "lanes", "space", "map", "log", "document", "picture"]

FAR_M = 1e4
"""Positions farther from zero than this are logged relative to a local origin: Rerun's 3D is float32."""

PLACES = ("geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PointStamped")
"""Message types that hold positions in metres."""

OVERVIEW, RAW, DETECTOR, ESTIMATES = "Overview", "Raw", "Detector", "Estimates"
COMPARE, REPORT, JOINTS, RADIO, FIGURES = "Compare", "Report", "Joints", "Radio", "Figures"
TABS = (OVERVIEW, RAW, DETECTOR, JOINTS, RADIO, FIGURES, ESTIMATES, COMPARE, REPORT)
"""Tabs in their order; a plug-in's own come before the last two."""

SPACE = "track"
"""The panel of the 3D view of tracks; the tab *Compare* shows the same from above."""


class ChannelLike(Protocol):
    """What a view must know of a channel before its first row."""

    @property
    def topic(self) -> str:
        """Name in the recording."""
        ...

    @property
    def schema(self) -> str:
        """Message type."""
        ...

    @property
    def columns(self) -> Sequence[str]:
        """Columns of its table without the times."""
        ...

    @property
    def metadata(self) -> Mapping[str, str]:
        """Metadata of the channel."""
        ...


@dataclass(frozen=True)
class Entry:
    """An entity in a panel of a tab.

    Attributes
    ----------
    kind : str
        What shows it: ``plot`` (time series), ``lanes`` (states over time), ``space`` (3D), ``map``, ``log``,
        ``document``, ``picture``.
    tab, panel : str
        Name of the tab, and of the panel in it. Entries with the same kind, tab and panel share one.
    owner : str
        The sensor, run or reference that it belongs to.
    path : str
        Entity path; what lies below it (thresholds) belongs to it unless ``alone``.
    stack : str
        Panels of one stack lie behind each other as small tabs, one visible.
    past : bool
        Whether all of it up to the cursor is shown (a trail), not only the newest.
    alone : bool
        Whether what lies below the entity is left out.
    """

    kind: Kind
    tab: str
    panel: str
    owner: str
    path: str
    stack: str = ""
    past: bool = False
    alone: bool = False


@dataclass(frozen=True)
class Threshold:
    """A limit on a statistic, from the channel's metadata.

    Attributes
    ----------
    statistic : str
        The column that it limits.
    name : str
        What the metadata calls it, for example ``acc_norm.min``.
    value : float
        In the statistic's unit.
    """

    statistic: str
    name: str
    value: float


class Canvas:
    """Where the views of one recording draw.

    Parameters
    ----------
    stream : rerun.RecordingStream
        Where to log; the caller owns it and its sinks.
    channels : iterable of channels
        What will come.
    axis : TimeAxis
        Meaning of ``t_ns``.
    prefix : str
        Entity path before everything, for example ``/walk1`` where several recordings are shown together.
    first_color : int
        Number of runs drawn before in the same view, so that no two runs have one colour.
    alignment : str
        How tracks are laid upon the reference; see :func:`marcha.replay.alignment.align`.
    metadata : mapping
        The recording's metadata records.
    attachments : mapping of str to callable
        The recording's attachments: name to a function that reads the bytes.

    Attributes
    ----------
    entries : list of Entry
        What is shown where, so far.
    zoom : dict of str to (float, float)
        Range of the vertical axis by entity, where the viewer's own choice would mislead.
    traces : dict of str to Trace
        Tracks by the entity path of their owner.
    runs : list of str
        Ids of the runs, in order.
    references : list of str
        Topics with reference positions.
    plan : FloorPlan
        Anchors and plan, once they are drawn.
    geo : list of ndarray
        Corners (latitude and longitude, °) of what is on the map, empty where nothing is.
    solid : dict of str to list of ndarray
        Corners (3,), m, of what is in a panel of a space of its own (segments, markers), by panel.
    followed : dict of str to str
        Entity that the eye follows in such a panel, by panel: what walks through a room is small beside its way.
    store : dict
        What views of one recording share, under a name of their own.
    flat : bool
        Whether the view from above tells more than the one in space.
    """

    def __init__(
        self,
        stream: rr.RecordingStream,
        channels: Iterable[ChannelLike],
        axis: TimeAxis,
        prefix: str = "",
        first_color: int = 0,
        alignment: str = ALIGNMENT,
        metadata: Mapping[str, Mapping[str, str]] | None = None,
        attachments: Mapping[str, Callable[[], bytes]] | None = None,
    ) -> None:
        self.stream, self.axis, self.prefix = stream, axis, prefix.rstrip("/")
        self.alignment, self.metadata, self.attachments = alignment, metadata or {}, attachments or {}
        self.channels = list(channels)
        self.entries: list[Entry] = []
        self.rows = 0
        self.zoom: dict[str, tuple[float, float]] = {}
        self.traces: dict[str, Trace] = {}
        self.norms: dict[str, RecentNorm] = {}
        self.first_ns: int | None = None
        self.last_ns: int | None = None
        self.plan = FloorPlan()
        self.store: dict[str, Any] = {}
        self.geo: list[Floats] = []
        self.solid: dict[str, list[Floats]] = {}
        self.followed: dict[str, str] = {}
        self.flat = False
        self._origin: Floats | None = None
        topics = [c.topic for c in self.channels]
        self.runs = list(dict.fromkeys(t.split("/")[2] for t in topics if is_estimate(t)))
        self.references = [
            c.topic for c in self.channels if c.topic.startswith("/reference/") and c.schema in PLACES
        ]
        # the truth of sensors that no run reads would only cover the one that matters
        used = {self.reference_of(run) for run in self.runs or [""]}
        wanted = {self.owner(t) for t in used if t is not None}
        self._aside = {self.owner(t) for t in self.references} - wanted
        self.colors = {run: style.run_color(first_color + i) for i, run in enumerate(self.runs)}
        self.thresholds = sorted(
            {t for c in self.channels for t in thresholds_of(c)}, key=lambda t: (t.name, t.value)
        )

    def reference_of(self, run: str) -> str | None:
        """Return the topic of the positions that a run is compared with, None where there is none."""
        return shown_reference({c.topic: c for c in self.channels}, run, self.metadata)

    def alignment_of(self, run: str, reference: str) -> str:
        """Return how a run's track is laid upon a reference topic: on a plan it stays where it is."""
        frames = {c.topic: getattr(c, "frame_id", "") for c in self.channels}
        frame = self.metadata.get(f"run/{run}", {}).get("frame") or frames.get(
            f"/estimate/{run}/position", ""
        )
        return on_a_plan(frame, frames.get(reference, "")) or self.alignment

    # -- what things are called

    def group(self, topic: str) -> str:
        """Return the entity path of a channel: runs below ``/run``, everything else as its topic says."""
        return self.prefix + entity(f"/run/{topic[10:]}" if is_estimate(topic) else topic)

    def base(self, topic: str) -> str:
        """Return the entity path of a position channel's track: its owner's if it is called ``pose``, or
        ``position`` where there is no pose.
        """
        parent, _, what = topic.rpartition("/")
        main = what == "pose" or (
            what == "position" and not any(c.topic == f"{parent}/pose" for c in self.channels)
        )
        path = self.group(topic)
        return path.rpartition("/")[0] if main and parent else path

    def color(self, topic: str) -> str:
        """Return the colour of a channel's owner: its run's, or the reference's."""
        return self.colors[topic.split("/")[2]] if is_estimate(topic) else style.REFERENCE

    def owner(self, topic: str) -> str:
        """Return what a legend calls the channel's owner: the run, ``reference``, or the topic."""
        parts = topic.split("/")
        if is_estimate(topic):
            name = parts[2]
        else:  # "/reference/imu2/pose" belongs to "reference imu2"
            name = " ".join(parts[1:-1]) if len(parts) > 2 and parts[1] == "reference" else topic
        return printable(f"{self.prefix[1:]} {name}".strip())

    def primary(self, schema: str, needs: str) -> str | None:
        """Return the topic of the sensor that the first run reads, or else of the first one.

        Parameters
        ----------
        schema, needs : str
            Message type, and a column that it must have.
        """
        candidates = [
            c.topic for c in self.channels if c.schema == schema and needs in c.columns and is_raw(c.topic)
        ]
        read = [t for t in candidates if any(t[1:].replace("/", "_") in run for run in self.runs)]
        return next(iter(read or candidates), None)

    # -- what is shown where

    def shows(self, owner: str) -> bool:
        """Return whether views show what belongs to this owner."""
        return owner not in self._aside

    def show(
        self,
        kind: Kind,
        path: str,
        *,
        tab: str,
        panel: str,
        owner: str = "",
        stack: str = "",
        past: bool = False,
        alone: bool = False,
    ) -> None:
        """Say that a panel should show an entity; see :class:`Entry`."""
        if self.shows(owner):
            entry = Entry(kind, tab, printable(panel), owner, path, printable(stack), past, alone)
            if entry not in self.entries:
                self.entries.append(entry)

    def origin(self, first: Floats) -> Floats:
        """Return the local origin for positions that begin at ``first`` (3,), in metres: zero unless far
        away.
        """
        if self._origin is None:
            self._origin = np.round(first) if np.abs(first).max() > FAR_M else np.zeros(3)
        near = np.abs(first - self._origin).max() <= FAR_M
        return self._origin if near else np.round(first)

    @staticmethod
    def reach(corners: list[Floats], points: Floats) -> None:
        """Widen corners so that points (n, k) lie between them."""
        points = np.concatenate([*(c[None, :] for c in corners), points])
        corners[:] = [points.min(axis=0), points.max(axis=0)]

    def hide(self, path: str) -> None:
        """Take an entity out of all panels: it holds nothing worth seeing."""
        self.entries = [e for e in self.entries if e.path != path]

    # -- logging

    def lines(self, path: str, names: Sequence[str], colors: Sequence[str], width: float = 1.5) -> None:
        """Style lines: one name and colour a column of the entity."""
        names, rgb = [printable(n) for n in names], [style.rgb(c) for c in colors]
        self.static(path, rr.SeriesLines(names=names, colors=rgb, widths=[width] * len(names)))

    def points(self, path: str, name: str, color: str, marker: Any = "circle", size: float = 3.0) -> None:
        """Style single points over time."""
        name, rgb = printable(name), style.rgb(color)
        self.static(path, rr.SeriesPoints(names=name, colors=rgb, markers=marker, marker_sizes=size))

    def static(self, path: str, *archetypes: Any) -> None:
        """Log something that holds at all times."""
        self.stream.log(path, *archetypes, static=True)

    def columns(self, path: str, t_ns: Times, columns: Iterable[Any]) -> None:
        """Log columns of one entity."""
        if t_ns.size:
            self.stream.send_columns(path, self.axis.columns(t_ns), columns)
            self.rows += t_ns.size

    def scalars(self, path: str, t_ns: Times, values: Floats) -> None:
        """Log (n,) or (n, k) values; a block without any finite value is left out."""
        if np.isfinite(values).any():
            self.columns(path, t_ns, rr.Scalars.columns(scalars=values))

    def text(self, path: str, t_ns: Times, text: Sequence[str]) -> None:
        """Log lines of text.

        Shape of ``t_ns``: (n,), one a text.
        """
        clean = [printable(t) for t in text]
        self.columns(path, t_ns, rr.TextLog.columns(text=clean, level=["INFO"] * len(clean)))

    def states(self, path: str, t_ns: Times, states: Sequence[str]) -> None:
        """Log changes of state; the empty one is a gap.

        Shape of ``t_ns``: (n,), one a state.
        """
        self.columns(path, t_ns, rr.StateChange.columns(state=[printable(s) for s in states]))

    def limit(self, path: str, limit: Threshold, unit: str = "") -> None:
        """Log a horizontal line below an entity, over the whole time seen."""
        # two runs may limit one statistic differently
        entity_path = f"{path}/threshold/{entity(f'{limit.name}_{limit.value:g}')}"
        word = "min" if limit.name.endswith(".min") else "max"
        self.lines(entity_path, [f"{word} {limit.value:g}{unit}"], [style.THRESHOLD])
        span = self.span()
        self.scalars(entity_path, span, np.full(span.size, limit.value))

    def span(self) -> Times:
        """Return first and last time seen, shape (2,), or nothing, shape (0,), before the first row."""
        if self.first_ns is None or self.last_ns is None:
            return np.empty(0, dtype=np.int64)
        return np.array([self.first_ns, self.last_ns], dtype=np.int64)


class RecentNorm:
    """The newest samples of a sensor's norm, so that events can be put on its line."""

    KEPT = 20_000

    def __init__(self) -> None:
        self.t_ns: Times = np.empty(0, dtype=np.int64)
        self.values: Floats = np.empty(0)

    def add(self, t_ns: Times, values: Floats) -> None:
        """Append samples (n,)."""
        self.t_ns = np.concatenate([self.t_ns, t_ns])[-self.KEPT :]
        self.values = np.concatenate([self.values, values])[-self.KEPT :]

    def at(self, t_ns: Times) -> Floats:
        """Return the values at other times, NaN outside of what is kept.

        Shapes: ``t_ns`` and result (n,).
        """
        if not self.t_ns.size:
            return np.full(len(t_ns), np.nan)
        zero = self.t_ns[0]
        own, t = (self.t_ns - zero) / 1e9, (t_ns - zero) / 1e9
        return np.interp(t, own, self.values, left=np.nan, right=np.nan)


def entity(path: str) -> str:
    """Return a path from a file as Rerun writes it: what is no letter, digit, ``-``, ``_`` or ``.`` escaped."""
    if path.isascii() and path.replace("/", "").replace("_", "").replace("-", "").replace(".", "").isalnum():
        return path.rstrip("/") if "//" not in path else "/" + "/".join(p for p in path.split("/") if p)
    parts = [rr.escape_entity_path_part(printable(p)) for p in path.split("/") if p]
    return ("/" if path.startswith("/") else "") + "/".join(parts)


def is_raw(topic: str) -> bool:
    """Return whether a topic is a sensor's."""
    return not topic.startswith(("/estimate/", "/reference/", "/annotation/"))


def thresholds_of(channel: ChannelLike) -> Iterator[Threshold]:
    """Read ``threshold.<statistic>`` and ``threshold.<statistic>.min`` (a floor) from a channel's
    metadata.
    """
    for key, text in channel.metadata.items():
        name = key.removeprefix("threshold.")
        if name == key:
            continue
        try:
            value = float(text)
        except ValueError:
            continue  # a rule in words has no line
        if math.isfinite(value):
            yield Threshold(name.partition(".")[0], name, value)


def columns_of(table: pl.DataFrame, names: Sequence[str], factors: Sequence[float] = ()) -> Floats:
    """Return columns as an (n, k) float64 array in the units they are shown in; null becomes NaN."""
    out = np.empty((table.height, len(names)))
    for i, name in enumerate(names):
        column = table[name]
        if column.dtype != pl.Float64:
            column = column.cast(pl.Float64)
        out[:, i] = column.fill_null(math.nan).to_numpy() if column.null_count() else column.to_numpy()
    return out * np.asarray(factors) if len(factors) else out
