"""Where messages come from: a recording, or something live.

A source hands over windows: for every topic a table with ``t_ns`` (the time a message speaks of),
``t_log_ns`` (when it was known) and its columns. Windows are disjoint in log time, so whatever merges one
window merges all.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import polars as pl

from ..recording.errors import MarchaError, UsageError

if TYPE_CHECKING:
    from ..recording import Recording

RATE_ROWS = 20_000
"""Rows from which a channel's rate is measured: its first ones, so that a range or a seek changes nothing."""


@dataclass(frozen=True)
class PlannedChannel:
    """One channel that a source has or that a run will write.

    Attributes
    ----------
    topic, schema, frame_id : str
        As in the recording.
    columns : tuple of str
        Columns beside the times.
    metadata : dict of str to str
        The channel's metadata.
    run : str
        Id of the run that writes it; empty for a channel of the source.
    """

    topic: str
    schema: str
    frame_id: str = ""
    columns: tuple[str, ...] = ()
    metadata: Mapping[str, str] = field(default_factory=dict)
    run: str = ""


@dataclass(frozen=True)
class Batch:
    """Messages of all topics between two log times.

    Attributes
    ----------
    end_ns : int
        All messages logged before this time have come once the batch is through (exclusive).
    tables : dict of str to polars.DataFrame
        ``t_ns``, ``t_log_ns`` and columns by topic, in channel order; log time never decreases.
    """

    end_ns: int
    tables: dict[str, pl.DataFrame]


class Source(Protocol):
    """What the engine asks of a source."""

    name: str
    channels: dict[str, PlannedChannel]
    seekable: bool
    start_ns: int
    end_ns: int

    @property
    def metadata(self) -> Mapping[str, Mapping[str, str]]:
        """Metadata records by name."""
        ...

    @property
    def attachments(self) -> Mapping[str, bytes]:
        """Attachments by name, read when asked for."""
        ...

    @property
    def static(self) -> Mapping[str, pl.DataFrame]:
        """Static channels (frames) by topic."""
        ...

    def rate_hz(self, topic: str) -> float:
        """Return the channel's measured or declared rate in hertz, 0 where it is not known."""
        ...

    def batches(
        self, topics: Sequence[str], start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[Batch]:
        """Yield batches of these topics, log time in [start_ns, end_ns)."""
        ...


def measured_rate(t_ns: np.ndarray) -> float:
    """Return the rate of ascending times in hertz: the mean interval without gaps (over 2.5 medians).

    Parameters
    ----------
    t_ns : ndarray of int64, shape (n,)
        Times; repeated and backward ones are left out.

    Returns
    -------
    float
        Hertz; 0 where fewer than two distinct times are there.
    """
    intervals = np.diff(t_ns)
    intervals = intervals[intervals > 0]
    if not intervals.size:
        return 0.0
    usual = intervals[intervals <= 2.5 * np.median(intervals)]
    return float(1e9 / usual.mean())


class SourceFailed(MarchaError):
    """A live source broke off. What it delivered before is recorded all the same."""


class _Attachments(Mapping[str, bytes]):
    """Attachments of a recording, read when asked for."""

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self._names = [a.name for a in recording.attachments]

    def __getitem__(self, name: str) -> bytes:
        if name not in self._names:
            raise KeyError(name)
        return self._recording.attachment(name)

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


class RecordingSource:
    """Messages of a recording, or of a part of its topics.

    Parameters
    ----------
    recording : Recording
        As :func:`marcha.recording.open` gives it.
    max_rows : int
        Largest number of rows in a batch; bounds memory.
    withheld : mapping of str to sequence of (int, int), optional
        Messages that are kept back, by topic: from when to when (log time in ns, half open). With the fixes of a
        receiver goes its velocity (``<topic>_velocity``).
    """

    seekable = True

    def __init__(
        self,
        recording: Recording,
        max_rows: int = 65_536,
        withheld: Mapping[str, Sequence[tuple[int, int]]] | None = None,
    ) -> None:
        self.recording = recording
        self.withheld = dict(withheld or {})
        for topic in self.withheld:
            if topic not in recording.channels:
                there = ", ".join(recording.channels) or "none"
                raise UsageError(f"{recording.path}: no channel {topic} to withhold; there are {there}")
        for topic, spans in list(self.withheld.items()):
            if (velocity := f"{topic}_velocity") in recording.channels:
                self.withheld.setdefault(velocity, spans)
        self.name = Path(recording.path).name
        self.max_rows = max_rows
        self.channels: dict[str, PlannedChannel] = {
            topic: PlannedChannel(topic, c.schema, c.frame_id, tuple(c.columns), dict(c.metadata))
            for topic, c in recording.channels.items()
            if c.columns  # others cannot be read; they are copied verbatim all the same
        }
        self.start_ns = recording.start_ns
        self.end_ns = recording.end_ns
        self.metadata = recording.metadata
        self.attachments = _Attachments(recording)
        self._rates: dict[str, float] = {}
        self._static: dict[str, pl.DataFrame] | None = None

    @property
    def static(self) -> dict[str, pl.DataFrame]:
        """Static frames by topic."""
        if self._static is None:
            self._static = {t: self.recording.table(t) for t in self.channels if t.endswith("_static")}
        return self._static

    def rate_hz(self, topic: str) -> float:
        """Return the rate of the channel's first samples in hertz."""
        if topic not in self._rates:
            head = next(iter(self.recording.windows([topic], max_rows=RATE_ROWS)), None)
            times = np.empty(0, np.int64)
            if head is not None and topic in head.tables:
                times = head.tables[topic]["t_ns"].head(RATE_ROWS).to_numpy()
            self._rates[topic] = measured_rate(times)
        return self._rates[topic]

    def batches(
        self, topics: Sequence[str], start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[Batch]:
        """Yield batches of these topics, log time in [start_ns, end_ns)."""
        order = [t for t in self.channels if t in set(topics)]
        windows = self.recording.windows(
            order,
            start_ns=start_ns,
            end_ns=end_ns,
            max_rows=self.max_rows,
            ahead=False,  # the engine has a thread for all of this
        )
        for window in windows:
            tables = {t: self._left(t, window.tables[t]) for t in order if t in window.tables}
            yield Batch(window.end_ns, {t: table for t, table in tables.items() if table.height})

    def _left(self, topic: str, table: pl.DataFrame) -> pl.DataFrame:
        for start, end in self.withheld.get(topic, ()):
            table = table.filter((pl.col("t_log_ns") < start) | (pl.col("t_log_ns") >= end))
        return table


class LiveSource:
    """Messages that arrive now, from an iterator or put in by another thread.

    Parameters
    ----------
    channels : sequence of PlannedChannel
        What will come. A channel's metadata may say ``rate_hz``.
    messages : iterable of (topic, t_ns, values), optional
        Read in a thread of its own until it ends. Without it, call :meth:`put` and :meth:`close`.
        ``values`` are numbers, texts or booleans in the order of the channel's columns.
    name : str
        What the lineage says about the input.
    capacity : int
        Messages that may wait; whoever puts more waits until the engine has caught up.
    metadata, attachments : mapping, optional
        What estimators are told before the first message, as a recording would.

    Notes
    -----
    A message is known when it arrives, so its log time is its own time, or the latest seen so far where it
    arrives late: log time never decreases. Repeated and backward times within a channel stay in the record;
    the engine does not feed them and says so.
    """

    seekable = False

    def __init__(
        self,
        channels: Sequence[PlannedChannel],
        messages: Iterable[tuple[str, int, Sequence[Any]]] | None = None,
        name: str = "live",
        capacity: int = 65_536,
        metadata: Mapping[str, Mapping[str, str]] | None = None,
        attachments: Mapping[str, bytes] | None = None,
    ) -> None:
        self.name = name
        self.metadata: Mapping[str, Mapping[str, str]] = metadata or {}
        self.attachments: Mapping[str, bytes] = attachments or {}
        self.static: Mapping[str, pl.DataFrame] = {}
        self.channels = {c.topic: c for c in channels}
        self.start_ns = 0
        self.end_ns = 0
        self._queue: queue.Queue[tuple[str, int, Sequence[Any]] | BaseException | None] = queue.Queue(
            capacity
        )
        self._closed = False
        self._failure: BaseException | None = None
        if messages is not None:
            threading.Thread(target=self._pump, args=(messages,), daemon=True, name="live source").start()

    def _pump(self, messages: Iterable[tuple[str, int, Sequence[Any]]]) -> None:
        try:
            for topic, t_ns, values in messages:
                self.put(topic, t_ns, values)
        except BaseException as error:  # whatever the reader of the device raised belongs to the engine
            self._queue.put(error)
        else:
            self._queue.put(None)

    def put(self, topic: str, t_ns: int, values: Sequence[Any]) -> None:
        """Hand over one message; may be called from any one thread.

        Raises
        ------
        UsageError
            For a topic that was not declared, or a number of values that does not fit its columns.
        """
        channel = self.channels.get(topic)
        if channel is None:
            raise UsageError(
                f"live source {self.name}: topic {topic} was not declared; declared: {list(self.channels)}"
            )
        if len(values) != len(channel.columns):
            raise UsageError(
                f"live source {self.name}: {topic} got {len(values)} values for its {len(channel.columns)} "
                f"columns {channel.columns}"
            )
        self._queue.put((topic, int(t_ns), values))

    def close(self) -> None:
        """Say that nothing more will come."""
        self._queue.put(None)

    def rate_hz(self, topic: str) -> float:
        """Return the rate that the channel's metadata declares (``rate_hz``), else 0."""
        return float(self.channels[topic].metadata.get("rate_hz", 0) or 0)

    def batches(
        self, topics: Sequence[str], start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[Batch]:
        """Yield whatever has arrived, as soon as something has; each message comes once."""
        wanted, latest = set(topics), -(2**63)
        while not self._closed:
            rows: dict[str, list[tuple[int, int, Sequence[Any]]]] = {
                t: [] for t in self.channels if t in wanted
            }
            for message in self._arrived():
                topic, t_ns, values = message
                latest = max(latest, t_ns)
                inside = (start_ns is None or latest >= start_ns) and (end_ns is None or latest < end_ns)
                if topic in rows and inside:
                    rows[topic].append((t_ns, latest, values))
            tables = {t: self._table(t, r) for t, r in rows.items() if r}
            if tables:
                yield Batch(latest, tables)
        if self._failure is not None:
            raise SourceFailed(f"live source {self.name} failed: {self._failure}") from self._failure

    def _arrived(self) -> list[tuple[str, int, Sequence[Any]]]:
        """Wait for one message, then take all that are there."""
        messages: list[tuple[str, int, Sequence[Any]]] = []
        item = self._queue.get()
        while True:
            if item is None:
                self._closed = True
                return messages
            if isinstance(item, BaseException):
                self._failure = item
                self._closed = True
                return messages
            messages.append(item)
            try:
                item = self._queue.get_nowait()
            except queue.Empty:
                return messages

    def _table(self, topic: str, rows: list[tuple[int, int, Sequence[Any]]]) -> pl.DataFrame:
        data: dict[str, Any] = {
            "t_ns": np.array([r[0] for r in rows], dtype=np.int64),
            "t_log_ns": np.array([r[1] for r in rows], dtype=np.int64),
        }
        columns = zip(*(r[2] for r in rows), strict=True)
        for name, values in zip(self.channels[topic].columns, columns, strict=True):
            numbers = isinstance(values[0], int | float) and not isinstance(values[0], bool)
            data[name] = np.array(values, dtype=np.float64) if numbers else list(values)
        return pl.DataFrame(data)
