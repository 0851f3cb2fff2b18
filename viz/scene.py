"""One recording on one Rerun stream: channels become entities, logged in columns.

A :class:`Scene` draws one recording (read from a file or arriving live). Each channel has an artist
(:mod:`marcha.viz.artists`), chosen by its message type, which logs its style once, its rows in blocks, and
what can only be drawn when all is known (the whole track) at the end.

Entities, below a prefix of the recording's own where several are shown together:

========================  =====================================================================
``/<topic>/…``            raw signals: ``acc``, ``gyr``, ``acc_norm``, ``gyr_norm``, ``mag`` …
``/run/<run>/…``          one run: ``track`` (whole), ``trail`` (one point a sample), ``foot`` (its axes),
                          ``height``, ``velocity``, ``speed``, ``stance``, ``detector/<statistic>``,
                          ``sigma/<what>``, ``step``, ``footprints``, ``error``, ``distance``, ``mark``
``/reference/…``          the same for the truth, where there is one
``/annotation/<tier>``    lanes of labelled intervals
``/log``                  steps and annotations as text
``/report``               metrics, parameters and findings
========================  =====================================================================

The only time line is ``time``: nanoseconds since the epoch, or since the device's own zero. Estimates
stand at the time that they speak of, not at the time when they were known.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, Protocol

import numpy as np
import polars as pl
import rerun as rr
from numpy.typing import NDArray

from . import style
from .track import Track, compare, reference_of

if TYPE_CHECKING:
    from .artists import Artist

TIMELINE = "time"
BLOCK_ROWS = 1000
"""Rows a block: small enough for bounded memory, large enough for speed (measured: 2.5 million rows/s)."""

ALIGNMENT = "origin-yaw"
"""Tracks start together and in one direction, so that what is seen (and what sigma speaks of) is the drift
since then."""

FAR_M = 1e4
"""Positions farther from zero than this are logged relative to a local origin: Rerun's 3D is float32."""

Floats = NDArray[np.float64]
Times = NDArray[np.int64]


class ChannelLike(Protocol):
    """What a scene must know of a channel before its first row."""

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
class Clock:
    """How recorded nanoseconds become Rerun's time line.

    Attributes
    ----------
    kind : str
        ``timestamp``: since the epoch; ``duration``: since a zero of its own.
    zero_ns : int
        Subtracted from every time (recordings of different days side by side: each from its own start).
    """

    kind: Literal["timestamp", "duration"]
    zero_ns: int = 0

    def column(self, t_ns: Times) -> rr.TimeColumn:
        """Return the times as the column of the one time line."""
        t = t_ns - self.zero_ns if self.zero_ns else t_ns
        if self.kind == "timestamp":
            return rr.TimeColumn(TIMELINE, timestamp=t.astype("datetime64[ns]"))
        return rr.TimeColumn(TIMELINE, duration=t.astype("timedelta64[ns]"))


@dataclass(frozen=True)
class Entry:
    """An entity that a view should show.

    Attributes
    ----------
    role : str
        What kind of view: ``raw``, ``norm``, ``track``, ``trail``, ``foot``, ``mark``, ``footprints``,
        ``height``, ``velocity``,
        ``speed``, ``stance``, ``detector``, ``sigma``, ``error``, ``distance``, ``step``, ``annotation``,
        ``other``.
    owner : str
        The sensor, run or reference that it belongs to.
    title : str
        Title of a view of its own, with the unit.
    path : str
        Entity path; what lies below it (thresholds) belongs to it.
    """

    role: str
    owner: str
    title: str
    path: str


@dataclass(frozen=True)
class Threshold:
    """A detector's limit on one of its statistics, from the channel's metadata.

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


class Scene:
    """Draws one recording into a Rerun stream.

    Parameters
    ----------
    stream : rerun.RecordingStream
        Where to log; the caller owns it and its sinks.
    channels : iterable of channels
        What will come (``topic``, ``schema``, ``columns``, ``metadata``); rows of others are not drawn.
    clock : Clock
        Meaning of ``t_ns``.
    prefix : str
        Entity path before everything, for example ``/walk1`` where several recordings are shown together.
    first_color : int
        Number of runs drawn before in the same view, so that no two runs have one colour.
    alignment : str
        How tracks are laid upon the reference; see :func:`marcha.replay.alignment.align`.
    """

    def __init__(
        self,
        stream: rr.RecordingStream,
        channels: Iterable[ChannelLike],
        clock: Clock,
        prefix: str = "",
        first_color: int = 0,
        alignment: str = ALIGNMENT,
    ) -> None:
        from .artists import artist_of

        self.stream, self.clock, self.prefix = stream, clock, prefix.rstrip("/")
        self.alignment = alignment
        self.entries: list[Entry] = []
        self.rows = 0
        self.zoom: dict[str, tuple[float, float]] = {}  # entity -> range of the vertical axis
        self.tracks: dict[str, Track] = {}
        self.first_ns: int | None = None
        self.last_ns: int | None = None
        self._origin: Floats | None = None
        channels = list(channels)
        self.runs = list(dict.fromkeys(c.topic.split("/")[2] for c in channels if is_estimate(c.topic)))
        places = ("geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PointStamped")
        self.references = [
            c.topic for c in channels if c.topic.startswith("/reference/") and c.schema in places
        ]
        # the truth of sensors that no run reads would only cover the one that matters
        used = {reference_of(run, self.references) for run in self.runs or [""]}
        wanted = {self.owner(t) for t in used if t is not None}
        self._aside = {self.owner(t) for t in self.references} - wanted
        self.colors = {run: style.run_color(first_color + i) for i, run in enumerate(self.runs)}
        self.thresholds = sorted(
            {t for c in channels for t in thresholds_of(c)}, key=lambda t: (t.name, t.value)
        )
        self.artists: dict[str, Artist] = {c.topic: artist_of(self, c) for c in channels}

    # -- what things are called and where they go

    def group(self, topic: str) -> str:
        """Return the entity path of a channel: runs below ``/run``, everything else as its topic says."""
        return f"{self.prefix}/run/{topic[10:]}" if is_estimate(topic) else f"{self.prefix}{topic}"

    def base(self, topic: str) -> str:
        """Return the entity path of a pose channel's track: its owner's if it is called ``pose``."""
        return self.group(topic).removesuffix("/pose")

    def color(self, topic: str) -> str:
        """Return the colour of a channel's owner: its run's, or the reference's."""
        return self.colors[topic.split("/")[2]] if is_estimate(topic) else style.REFERENCE

    def owner(self, topic: str) -> str:
        """Return what a legend calls the channel's owner: the run, ``reference``, or the topic."""
        parts = topic.split("/")
        if is_estimate(topic):
            name = parts[2]
        else:  # "/reference/imu2/pose" belongs to "reference imu2"
            name = " ".join(parts[1:-1]) if parts[1] == "reference" else topic
        return f"{self.prefix[1:]} {name}".strip()

    def shows(self, owner: str) -> bool:
        """Return whether views show what belongs to this owner."""
        return owner not in self._aside

    def show(self, role: str, owner: str, title: str, path: str) -> None:
        """Say that a view should show an entity."""
        if self.shows(owner):
            self.entries.append(Entry(role, owner, title, path))

    def origin(self, first: Floats) -> Floats:
        """Return the local origin for positions that begin at ``first`` (3,), in metres: zero unless far
        away.
        """
        if self._origin is None:
            self._origin = np.round(first) if np.abs(first).max() > FAR_M else np.zeros(3)
        near = np.abs(first - self._origin).max() <= FAR_M
        return self._origin if near else np.round(first)

    # -- logging

    def lines(self, path: str, names: Sequence[str], colors: Sequence[str], width: float = 1.5) -> None:
        """Style lines: one name and colour a column of the entity."""
        rgb = [style.rgb(c) for c in colors]
        self.static(path, rr.SeriesLines(names=list(names), colors=rgb, widths=[width] * len(names)))

    def static(self, path: str, *archetypes: Any) -> None:
        """Log something that holds at all times."""
        self.stream.log(path, *archetypes, static=True)

    def columns(self, path: str, t_ns: Times, columns: Iterable[Any]) -> None:
        """Log columns of one entity."""
        if t_ns.size:
            self.stream.send_columns(path, [self.clock.column(t_ns)], columns)
            self.rows += t_ns.size

    def begin(self) -> None:
        """Log what holds at all times: colours, names, axes."""
        self.static(self.prefix or "/", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
        for artist in self.artists.values():
            artist.begin()
        self.show("report", self.prefix[1:], self.prefix[1:] or "report", f"{self.prefix}/report")

    def annotate(self, annotations: pl.DataFrame) -> None:
        """Draw labelled intervals (``tier, start_ns, end_ns, label``): a lane and lines in the log for
        each tier.

        Stances and steps that a replay wrote are left out: the run's own channels show them.
        """
        for (tier,), rows in annotations.group_by("tier", maintain_order=True):
            if str(tier).rpartition("/")[0] in self.runs:
                continue
            path, log = f"{self.prefix}/annotation/{tier}", f"{self.prefix}/log/annotation/{tier}"
            rows = rows.sort("start_ns")
            start, end, labels = (
                rows["start_ns"].to_numpy(),
                rows["end_ns"].to_numpy(),
                rows["label"].to_list(),
            )
            # an interval that another one follows at once needs no gap between them
            gap = np.flatnonzero(~np.isin(end, start))
            times = np.concatenate([start, end[gap]])
            states = [*labels, *[""] * len(gap)]
            order = np.argsort(times, kind="stable")
            self.columns(path, times[order], rr.StateChange.columns(state=[states[i] for i in order]))
            text = [
                f"{tier}: {label}, {(b - a) / 1e9:.2f} s"
                for label, a, b in zip(labels, start, end, strict=True)
            ]
            self.columns(log, start, rr.TextLog.columns(text=text, level=["INFO"] * len(text)))
            self.show("annotation", str(tier), str(tier), path)
            self.show("log", str(tier), str(tier), log)

    def write(self, topic: str, table: pl.DataFrame) -> None:
        """Draw rows of one channel (``t_ns`` and its columns)."""
        artist = self.artists.get(topic)
        if artist is None or table.height == 0:
            return
        t_ns = table["t_ns"].to_numpy()
        low, high = int(t_ns.min()), int(t_ns.max())
        self.first_ns = low if self.first_ns is None else min(low, self.first_ns)
        self.last_ns = high if self.last_ns is None else max(high, self.last_ns)
        for start in range(0, table.height, BLOCK_ROWS):
            artist.draw(t_ns[start : start + BLOCK_ROWS], table.slice(start, BLOCK_ROWS))

    def end(self) -> None:
        """Draw what needs the whole: tracks, thresholds, errors against the reference."""
        for artist in self.artists.values():
            artist.end()
        self._compare()

    def _compare(self) -> None:
        """Turn every run's track onto the reference and log its error over time."""
        for path, track in self.tracks.items():
            _, mark, rest = path.partition("/run/")
            topic = reference_of(rest.split("/")[0], self.references) if mark else None
            reference = self.tracks.get(self.base(topic)) if topic is not None else None
            found = compare(track, reference, self.alignment) if reference is not None else None
            if found is None:
                continue
            track.place, track.worst_m = found.place, found.worst_m
            self.static(
                path, rr.Transform3D(translation=found.place.translation, mat3x3=found.place.rotation)
            )
            error, distance = f"{path}/error", f"{path}/distance"
            names = [f"error {a} (m)" for a in "xyz"]
            self.lines(error, names, style.AXES)
            self.lines(distance, [f"{track.owner} distance (m)"], [track.color])
            self.columns(error, found.t_ns, rr.Scalars.columns(scalars=found.error))
            self.columns(distance, found.t_ns, rr.Scalars.columns(scalars=found.distance))
            self.show("error", track.owner, f"error after alignment {self.alignment} (m)", error)
            self.show("distance", track.owner, "distance to the reference (m)", distance)

    def span(self) -> Times:
        """Return first and last time seen, shape (2,), or nothing, shape (0,), before the first row."""
        if self.first_ns is None or self.last_ns is None:
            return np.empty(0, dtype=np.int64)
        return np.array([self.first_ns, self.last_ns], dtype=np.int64)


def is_estimate(topic: str) -> bool:
    """Return whether a topic is a run's output, ``/estimate/<run>/<what>``."""
    return topic.startswith("/estimate/") and topic.count("/") >= 3


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
