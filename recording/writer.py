"""Writing recordings: tables in blocks, annotations, copies; whole or not at all."""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Collection, Iterable, Mapping, Sequence
from concurrent.futures import Executor, Future
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import msgspec
import numpy as np
import polars as pl
from mcap.records import Channel
from numpy.typing import NDArray

from .annotations import (
    EVENT,
    TOPIC,
    check_annotations,
    check_ids,
    encode_events,
    identified,
)
from .codec import check_times, index_of
from .definitions import full_text
from .encoder import Chunk, Encoder, message_record
from .errors import MarchaError, UsageError
from .events import SIDECAR, TABLE, events_text, sidecar, to_events
from .mcapfile import CHUNK_SIZE, ZSTD_LEVEL, McapFile, Packed, pack
from .schemas import find_schema
from .threads import helpers

Times = NDArray[np.int64]

_QUEUE = 8
"""Tables that may wait to be written: bounds memory."""

if TYPE_CHECKING:
    from .reader import Recording

_QOS = (
    "- history: keep_last\n  depth: 10\n  reliability: reliable\n  durability: {durability}\n"
    "  deadline:\n    sec: 9223372036\n    nsec: 854775807\n"
    "  lifespan:\n    sec: 9223372036\n    nsec: 854775807\n"
    "  liveliness: automatic\n  liveliness_lease_duration:\n    sec: 9223372036\n    nsec: 854775807\n"
    "  avoid_ros_namespace_conventions: false\n"
)

RESERVED = frozenset({"offered_qos_profiles", "columns", "frame_id"})
"""Keys of a channel's metadata that the writer sets itself."""


def qos_profile(topic: str) -> str:
    """Return what ROS 2 readers want to know of a channel, as rosbag2 writes it."""
    return _QOS.format(durability="transient_local" if topic == "/tf_static" else "volatile")


EVENT_ROWS = 4096
"""Annotations that are encoded together: their texts take a kilobyte each while they are."""


@dataclass
class _Output:
    """One channel being written; ``encoder`` is there once the columns are known."""

    id: int
    topic: str
    schema: str
    frame_id: str
    metadata: dict[str, str]
    encoder: Encoder | None = None
    columns: tuple[str, ...] = ()
    chunk: Chunk | None = None
    records: list[tuple[int, bytes]] = field(default_factory=list)
    sequence: int = 0
    last_log: int = -1


class Writer:
    """Writes one recording; use as a context manager.

    Nothing appears at ``path`` before the block ends without an exception; an exception leaves no trace. See
    :func:`marcha.recording.create`.
    """

    def __init__(self, path: Path | str, *, overwrite: bool = False, level: int | None = ZSTD_LEVEL) -> None:
        self.path = Path(path)
        self._level = level
        self._file = McapFile(self.path, overwrite=overwrite, threads=level is not None)
        self._worker: Executor = helpers("record", 1)
        self._jobs: deque[Future[None]] = deque()
        self._outputs: dict[str, _Output] = {}
        self._annotations: list[pl.DataFrame] = []
        self._metadata: dict[str, dict[str, str]] = {}
        self._events = False
        self._closed = False

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None
    ) -> None:
        if kind is None:
            self.close()
        else:
            self.abort()

    def add_channel(
        self,
        topic: str,
        schema: str,
        frame_id: str = "",
        columns: Sequence[str] | None = None,
        metadata: Mapping[str, str] | None = None,
    ) -> None:
        """Declare a channel before its data; a channel without rows is kept.

        Parameters
        ----------
        topic : str
            Starts with ``/``.
        schema : str
            A key of :data:`marcha.recording.SCHEMAS`.
        frame_id : str
            Frame of every message.
        columns : sequence of str, optional
            Columns of the tables to come, without ``t_ns`` and ``t_log_ns``; default: the first table's.
        metadata : mapping of str to str, optional
            Anything to say about the channel.

        Raises
        ------
        UsageError
            The topic is there already, the type unknown, or a key of ``metadata`` is one of :data:`RESERVED`.
        MarchaError
            The columns are not those of the type.
        """
        self._check_open()
        if not topic.startswith("/") or topic != topic.strip():
            raise UsageError(f"{self.path}: topic {topic!r} must start with '/' and have no blanks around it")
        if any(c.topic == topic for c in self._file.channels.values()) or topic in self._outputs:
            raise UsageError(f"{self.path}: {topic}: the channel is there already; add_table appends to it")
        find_schema(schema)
        strings = {str(k): str(v) for k, v in (metadata or {}).items()}
        if RESERVED & strings.keys():
            raise UsageError(
                f"{self.path}: {topic}: metadata keys {sorted(RESERVED & strings.keys())} are reserved"
            )
        out = _Output(0, topic, schema, frame_id, strings)
        if columns:
            self._declare(out, tuple(columns))
        self._outputs[topic] = out

    def add_table(
        self,
        topic: str,
        schema: str,
        table: pl.DataFrame | Mapping[str, NDArray[Any]],
        frame_id: str = "",
        metadata: Mapping[str, str] | None = None,
    ) -> None:
        """Write rows; may be called again and then appends.

        Parameters
        ----------
        topic, schema, frame_id, metadata
            See :meth:`add_channel`; ``metadata`` and ``frame_id`` count at the first call.
        table : polars.DataFrame, or mapping of str to ndarray
            ``t_ns`` (Int64), optional ``t_log_ns`` (Int64, default ``t_ns``), and columns of the type. Arrays
            of one length do as well; they must not be written to afterwards.

        Raises
        ------
        MarchaError
            Unknown or missing columns, wrong types, negative time, or log time that decreases.
        UsageError
            Another type or frame than the channel has.
        """
        self._check_open()
        if topic not in self._outputs:
            self.add_channel(topic, schema, frame_id, None, metadata)
        out = self._outputs[topic]
        where = f"{self.path}: {topic}"
        if out.schema != schema:
            raise UsageError(f"{where}: {schema} into a channel of {out.schema}")
        if frame_id and out.frame_id != frame_id:
            raise UsageError(f"{where}: frame_id {frame_id!r}, the channel has {out.frame_id!r}")
        series = {s.name: s for s in table.get_columns()} if isinstance(table, pl.DataFrame) else dict(table)
        columns = tuple(c for c in series if c not in ("t_ns", "t_log_ns"))
        if out.encoder is None:
            self._declare(out, columns)
        assert out.encoder is not None
        if set(columns) != set(out.columns):
            odd = ", ".join(sorted(set(columns) ^ set(out.columns)))
            raise MarchaError(
                f"{where}: every table of a channel has the same columns; missing or unknown: {odd}"
            )
        t_ns = self._times(series, "t_ns", where)
        log = self._times(series, "t_log_ns", where) if "t_log_ns" in series else t_ns
        if any(len(values) != len(t_ns) for values in series.values()):
            lengths = {name: len(values) for name, values in series.items()}
            raise MarchaError(f"{where}: columns of different lengths: {lengths}")
        if len(log) == 0:
            return
        if log[0] < out.last_log or (log[1:] < log[:-1]).any():
            before = np.concatenate(([out.last_log], log[:-1]))
            bad = int(np.argmax(log < before))
            raise MarchaError(
                f"{where}: row {bad}: log time {log[bad]} ns is before the previous row's {before[bad]}; "
                "sort the rows by log time"
            )
        try:
            arrays = out.encoder.arrays(series)
        except MarchaError as e:
            raise MarchaError(f"{self.path}: {e}") from None
        out.last_log = int(log[-1])
        while len(self._jobs) >= _QUEUE:
            self._jobs.popleft().result()
        self._jobs.append(self._worker.submit(self._put, out, out.encoder, arrays, t_ns, log))

    def add_message(self, topic: str, schema: str, t_ns: int, value: Mapping[str, Any]) -> None:
        """Write a channel of one message, of a type that has no table (``sensor_msgs/msg/PointCloud2``).

        Parameters
        ----------
        topic, schema, t_ns
            Topic, which is not there yet; a type whose text is in ``recording/msg``; when it was known.
        value : mapping
            Field name to value; see :func:`marcha.recording.cdr.encode`.

        Raises
        ------
        UsageError
            The topic is there already.
        """
        self._check_open()
        file = self._caught_up()
        if any(c.topic == topic for c in file.channels.values()) or topic in self._outputs:
            raise UsageError(f"{self.path}: {topic}: the channel is there already")
        id_ = file.free_id()
        message = message_record(schema, id_, t_ns, value)
        record = file.add_schema(schema, "ros2msg", full_text(schema).encode())
        file.add_channel(Channel(id_, topic, "cdr", {"offered_qos_profiles": qos_profile(topic)}, record))
        file.submit(pack_records, [(t_ns, message)], id_, self._level)

    def add_annotations(self, table: pl.DataFrame) -> None:
        """Add labelled intervals; may be called again.

        Parameters
        ----------
        table : polars.DataFrame
            ``tier, start_ns, end_ns, label`` and optionally ``metadata`` (JSON text or a struct) and
            :data:`marcha.recording.annotations.FIELDS`.

        Raises
        ------
        MarchaError
            See :func:`marcha.recording.annotations.check_annotations`.
        """
        self._check_open()
        try:
            checked = check_annotations(table)
            if checked.height:
                self._annotations.append(checked)
        except MarchaError as e:
            raise type(e)(f"{self.path}: {e}") from None

    def attach_events(self) -> None:
        """Attach the annotations as BIDS ``events.tsv`` and ``events.json`` when the recording is closed."""
        self._events = True

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Write a metadata record; values become strings.

        Raises
        ------
        UsageError
            The name is taken: readers show one record a name.
        """
        self._check_open()
        self._caught_up().add_metadata(name, values)
        self._metadata[name] = dict(values)

    def add_attachment(self, name: str, data: bytes, media_type: str = "application/octet-stream") -> None:
        """Attach a file (anchor table, floor plan, raw source …).

        Raises
        ------
        UsageError
            The name is taken.
        """
        self._check_open()
        self._caught_up().add_attachment(name, data, media_type)

    def copy_from(
        self,
        rec: Recording,
        topics: Collection[str] | None = None,
        *,
        annotations: bool = True,
        leave: Collection[str] = (),
    ) -> None:
        """Copy channels of another recording, with its metadata records, attachments and annotations.

        Chunks are copied as they are, without decompressing, unless they also hold channels that are left out
        or channel ids are taken; those that are not compressed are compressed, unless this writer does not.
        Copied channels cannot be appended to. A table of events that is attached is written anew.

        Parameters
        ----------
        rec : Recording
            The source.
        topics : collection of str, optional
            Channels to copy (an annotation tier is one), default all.
        annotations : bool
            Whether annotations are copied.
        leave : collection of str
            Names of metadata records and attachments that are not copied.

        Raises
        ------
        UsageError
            A topic, metadata record or attachment is in both recordings, or a topic is unknown.
        MarchaError
            A channel that is not CDR: ROS readers would refuse the whole file.
        """
        from .copying import copy_into

        self._check_open()
        copy_into(self._caught_up(), rec, topics, self._level)
        if annotations:
            table = rec.stored_annotations
            if topics is not None:
                table = table.filter((TOPIC + pl.col("tier")).is_in(list(topics)))
            if table.height:
                self.add_annotations(table)
        self._events |= any(a.name == TABLE for a in rec.attachments)
        for name, values in rec.metadata.items():
            if name not in leave:
                self.add_metadata(name, values)
        for attachment in rec.attachments:
            if attachment.name not in leave and attachment.name not in (TABLE, SIDECAR):
                self.add_attachment(attachment.name, rec.attachment(attachment.name), attachment.media_type)

    def close(self) -> None:
        """Write what is pending and the summary, and put the file in its place."""
        if self._closed:
            return
        try:
            file = self._caught_up()
            for out in self._outputs.values():
                if out.encoder is None:
                    raise UsageError(f"{self.path}: {out.topic}: declared without columns and never written")
                self._flush(out)
            if self._annotations:
                self._put_annotations(pl.concat(self._annotations))
            file.finish()
        except BaseException:
            self.abort()
            raise
        self._closed = True
        self._worker.shutdown()

    def abort(self) -> None:
        """Drop the recording; nothing is left on disk."""
        if not self._closed:
            self._closed = True
            self._worker.shutdown(cancel_futures=True)
            self._file.abort()

    def _caught_up(self) -> McapFile:
        """Return the file with all rows in it so far; raise what went wrong with them."""
        while self._jobs:
            self._jobs.popleft().result()
        return self._file

    def _check_open(self) -> None:
        if self._closed:
            raise UsageError(f"{self.path}: the recording is closed")

    def _declare(self, out: _Output, columns: tuple[str, ...]) -> None:
        file = self._caught_up()
        out.id = file.free_id()
        try:
            out.encoder = Encoder(find_schema(out.schema), columns, out.frame_id, out.topic, out.id)
        except MarchaError as e:
            raise type(e)(f"{self.path}: {e}") from None
        out.columns = columns
        metadata = {
            "offered_qos_profiles": qos_profile(out.topic),
            "columns": json.dumps(columns, ensure_ascii=False),
            "frame_id": out.frame_id,
            **out.metadata,
        }
        schema = file.add_schema(out.schema, "ros2msg", full_text(out.schema).encode())
        file.add_channel(Channel(out.id, out.topic, "cdr", metadata, schema))

    def _times(
        self, series: Mapping[str, pl.Series | NDArray[Any]], name: str, where: str
    ) -> NDArray[np.int64]:
        values = series.get(name)
        if isinstance(values, pl.Series) and values.dtype == pl.Int64 and not values.null_count():
            values = values.to_numpy()
        if not isinstance(values, np.ndarray) or values.dtype != np.int64:
            raise MarchaError(f"{where}: column {name!r} must be there, Int64, without nulls")
        return check_times(values, f"{where}: {name}")

    def _put(
        self, out: _Output, encoder: Encoder, arrays: dict[str, NDArray[Any]], t_ns: Times, log: Times
    ) -> None:
        """Encode rows into chunks; keep a chunk that is not full for the next call."""
        if not encoder.even:
            records = encoder.records(arrays, t_ns, log, out.sequence)
            out.sequence += len(records)
            self._gather(out, zip(log.tolist(), records, strict=True))
            return
        row = 0
        while row < len(log):
            chunk = out.chunk = out.chunk or encoder.chunk(CHUNK_SIZE)
            n = min(len(log) - row, chunk.most - chunk.rows)
            rows = slice(row, row + n)
            columns = {name: values[rows] for name, values in arrays.items()}
            chunk.encode_into(columns, t_ns[rows], log[rows], out.sequence)
            row += n
            out.sequence += n
            if chunk.rows == chunk.most:
                self._flush(out)

    def _gather(self, out: _Output, records: Iterable[tuple[int, bytes]]) -> None:
        """Collect records of different sizes, given with their log times, to chunks."""
        size = sum(len(r) for _, r in out.records)
        for record in records:
            out.records.append(record)
            size += len(record[1])
            if size >= CHUNK_SIZE:
                self._flush(out)
                size = 0

    def _flush(self, out: _Output) -> None:
        chunk, records = out.chunk, out.records
        if chunk is not None:
            assert out.encoder is not None
            release = partial(out.encoder.release, chunk)
            self._file.submit(pack, chunk.data, out.id, chunk.index, self._level, release)
        if records:
            self._file.submit(pack_records, records, out.id, self._level)
        out.chunk, out.records = None, []

    def _put_annotations(self, table: pl.DataFrame) -> None:
        check_ids(table)
        if self._events:
            self._file.drain()
            table = identified(table.sort("start_ns", maintain_order=True))
            first = int(table["start_ns"].min() or 0)  # pyright: ignore[reportArgumentType]
            origin = min(first, self._file.start_ns) if self._file.start_ns is not None else first
            events = events_text(to_events(table, origin)).encode()
            about = msgspec.json.format(msgspec.json.encode(sidecar(self._metadata)), indent=2) + b"\n"
            self._file.add_attachment(TABLE, events, "text/tab-separated-values")
            self._file.add_attachment(SIDECAR, about, "application/json")
        for (tier,), rows in table.group_by("tier", maintain_order=True):
            topic = f"{TOPIC}{tier}"
            if any(c.topic == topic for c in self._file.channels.values()):
                raise UsageError(f"{self.path}: {topic}: is a channel already")
            id_ = self._file.free_id()
            schema = self._file.add_schema(EVENT, "ros2msg", full_text(EVENT).encode())
            self._file.add_channel(
                Channel(id_, topic, "cdr", {"offered_qos_profiles": qos_profile(topic)}, schema)
            )
            for piece in rows.sort("start_ns", maintain_order=True).iter_slices(EVENT_ROWS):
                self._put_events(piece, id_)

    def _put_events(self, rows: pl.DataFrame, id_: int) -> None:
        data, index = encode_events(rows, id_)
        ends = np.append(index[1:, 1], data.size)
        row = 0
        while row < len(index):
            begin = index[row, 1]
            n = max(1, int(np.searchsorted(ends, begin + CHUNK_SIZE, side="right")) - row)
            part = index[row : row + n] - (0, begin)
            self._file.submit(pack, data[begin : ends[row + n - 1]], id_, part, self._level)
            row += n


def pack_records(records: Sequence[tuple[int, bytes]], channel_id: int, level: int | None) -> Packed:
    """Pack message records, given with their log times, into a chunk."""
    sizes = np.array([len(r) for _, r in records])
    data = np.frombuffer(b"".join(r for _, r in records), "u1")
    log = np.array([t for t, _ in records], np.int64)
    return pack(data, channel_id, index_of(log, sizes), level)
