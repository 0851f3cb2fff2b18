"""Writing recordings: chunks laid by NumPy on mcap's record classes, whole or not at all."""

from __future__ import annotations

import contextlib
import json
import os
import struct
import zlib
from collections import deque
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np
import polars as pl
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC
from numpy.typing import NDArray

from .atomic import AtomicFile
from .cdr import Bytes
from .codec import Encoder, check_times
from .definitions import full_text
from .errors import MarchaError, UsageError
from .schemas import find_schema

if TYPE_CHECKING:
    from .reader import Recording

CHUNK_SIZE = 1 << 20
"""Uncompressed bytes of a chunk: 30 to 60 s of one 100 Hz channel."""

ZSTD_LEVEL = 3
QOS = (
    "- history: keep_last\n  depth: 10\n  reliability: reliable\n  durability: {durability}\n"
    "  deadline:\n    sec: 9223372036\n    nsec: 854775807\n"
    "  lifespan:\n    sec: 9223372036\n    nsec: 854775807\n"
    "  liveliness: automatic\n  liveliness_lease_duration:\n    sec: 9223372036\n    nsec: 854775807\n"
    "  avoid_ros_namespace_conventions: false\n"
)
"""What ROS 2 readers want to know of a channel, as rosbag2 writes it."""

RESERVED = frozenset({"offered_qos_profiles", "columns", "frame_id"})
"""Keys of a channel's metadata that the writer sets itself."""


def library_name() -> str:
    """Return ``marcha <version>``, as recordings name their writer."""
    try:
        return f"marcha {version('marcha')}"
    except PackageNotFoundError:
        return "marcha"


class Packed(NamedTuple):
    """A chunk ready for the file."""

    chunk: Chunk
    channel_id: int
    index: bytes


@dataclass
class _Output:
    """One channel being written."""

    id: int
    topic: str
    schema: str
    frame_id: str
    metadata: dict[str, str]
    encoder: Encoder | None = None
    columns: tuple[str, ...] | None = None
    pending: list[pl.DataFrame] = field(default_factory=list)
    rows: int = 0
    sequence: int = 0
    last_log: int = -1

    @property
    def chunk_rows(self) -> int:
        assert self.encoder is not None
        return max(1, CHUNK_SIZE // self.encoder.record_size)


class Writer:
    """Writes one recording; use as a context manager.

    Nothing appears at ``path`` before the block ends without an exception; an exception leaves no trace. See
    :func:`marcha.recording.create`.
    """

    def __init__(self, path: Path | str, *, overwrite: bool = False) -> None:
        self.path = Path(path)
        self._file = AtomicFile(self.path, overwrite=overwrite)
        self._outputs: dict[str, _Output] = {}
        self._schemas: dict[str, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._statistics = Statistics(0, 0, {}, 0, 0, 0, 0, 0, 0)
        self._chunk_indexes: list[ChunkIndex] = []
        self._attachment_indexes: list[AttachmentIndex] = []
        self._metadata_indexes: list[MetadataIndex] = []
        self._metadata_names: set[str] = set()
        self._crc = 0
        self._at = 0
        self._pool = ThreadPoolExecutor(min(4, os.cpu_count() or 1), thread_name_prefix="marcha-write")
        self._jobs: deque[Future[Packed]] = deque()
        self._closed = False
        try:
            self._write(MCAP0_MAGIC)
            self._record(Header(profile="ros2", library=library_name()))
        except BaseException:
            self.abort()
            raise

    # ------------------------------------------------------------------------------------------------ public

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
            Columns of the tables to come, without ``t_ns`` and ``t_log_ns``; default: those of the first table.
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
        if topic in self._outputs:
            raise UsageError(f"{self.path}: {topic}: the channel is there already; add_table appends to it")
        find_schema(schema)
        strings = {str(k): str(v) for k, v in (metadata or {}).items()}
        if RESERVED & strings.keys():
            raise UsageError(f"{self.path}: {topic}: metadata keys {sorted(RESERVED & strings.keys())} are reserved")
        out = _Output(max(self._channels, default=0) + 1, topic, schema, frame_id, strings)
        if columns is not None:
            self._declare(out, tuple(columns))
        else:  # the record waits for the columns; the id is taken
            self._channels[out.id] = Channel(out.id, topic, "cdr", {}, 0)
        self._outputs[topic] = out

    def add_table(
        self,
        topic: str,
        schema: str,
        table: pl.DataFrame,
        frame_id: str = "",
        metadata: Mapping[str, str] | None = None,
    ) -> None:
        """Write rows; may be called again and then appends.

        Parameters
        ----------
        topic, schema, frame_id, metadata
            See :meth:`add_channel`; ``metadata`` and ``frame_id`` count at the first call.
        table : polars.DataFrame
            ``t_ns`` (Int64), optional ``t_log_ns`` (Int64, default ``t_ns``), and columns of the type.

        Raises
        ------
        MarchaError
            Unknown or missing columns, wrong types, negative time, or log time that decreases.
        UsageError
            Another type than the channel has.
        """
        self._check_open()
        if topic not in self._outputs:
            self.add_channel(topic, schema, frame_id, None, metadata)
        out = self._outputs[topic]
        if out.schema != schema:
            raise UsageError(f"{self.path}: {topic}: {schema} into a channel of {out.schema}")
        if frame_id and out.frame_id != frame_id:
            raise UsageError(f"{self.path}: {topic}: frame_id {frame_id!r}, the channel has {out.frame_id!r}")
        where = f"{self.path}: {topic}"
        columns = tuple(c for c in table.columns if c not in ("t_ns", "t_log_ns"))
        if out.columns is None:
            self._declare(out, columns)
        assert out.encoder is not None and out.columns is not None
        if set(columns) != set(out.columns):
            odd = ", ".join(sorted(set(columns) ^ set(out.columns)))
            raise MarchaError(f"{where}: every table of a channel has the same columns; missing or unknown: {odd}")
        log = "t_log_ns" if "t_log_ns" in table.columns else "t_ns"
        for name in ("t_ns", log):
            if name not in table.columns or table.schema[name] != pl.Int64 or table[name].null_count():
                raise MarchaError(f"{where}: column {name!r} must be there, Int64, without nulls")
        times = check_times(table[log].to_numpy(), f"{where}: {log}")
        check_times(table["t_ns"].to_numpy(), f"{where}: t_ns")
        if len(times) == 0:
            return
        steps = np.diff(times, prepend=out.last_log)
        if (steps < 0).any():
            bad = int(np.argmax(steps < 0))
            raise MarchaError(
                f"{where}: row {bad}: log time {times[bad]} ns is before the previous row's {times[bad] - steps[bad]}; "
                "sort the table by t_log_ns"
            )
        out.last_log = int(times[-1])
        try:
            arrays = out.encoder.arrays(table)
        except MarchaError as e:
            raise MarchaError(f"{self.path}: {e}") from None
        block = {"t_ns": table["t_ns"].to_numpy(), "t_log_ns": times, **arrays}
        self._buffer(out, block)

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Write a metadata record; values become strings.

        Raises
        ------
        UsageError
            The name is taken: readers show one record a name.
        """
        self._check_open()
        if name in self._metadata_names:
            raise UsageError(f"{self.path}: metadata record {name!r} is there already")
        self._metadata_names.add(name)
        start = self._at
        self._record(Metadata(name, {str(k): str(v) for k, v in values.items()}))
        self._metadata_indexes.append(MetadataIndex(start, self._at - start, name))
        self._statistics.metadata_count += 1

    def add_attachment(self, name: str, data: bytes, media_type: str = "application/octet-stream") -> None:
        """Attach a file (anchor table, floor plan, raw source …)."""
        self._check_open()
        if any(a.name == name for a in self._attachment_indexes):
            raise UsageError(f"{self.path}: attachment {name!r} is there already")
        start = self._at
        self._record(Attachment(0, 0, name, media_type, data))
        self._attachment_indexes.append(AttachmentIndex(start, self._at - start, 0, 0, len(data), name, media_type))
        self._statistics.attachment_count += 1

    def close(self) -> None:
        """Write what is pending and the summary, and put the file in its place."""
        if self._closed:
            return
        try:
            self._finish()
        except BaseException:
            self.abort()
            raise
        self._closed = True
        self._pool.shutdown()

    def abort(self) -> None:
        """Drop the recording; nothing is left on disk."""
        self._closed = True
        self._pool.shutdown(wait=True, cancel_futures=True)
        self._file.abort()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        if kind is None:
            self.close()
        else:
            self.abort()

    # ------------------------------------------------------------------------------------------------ channels

    def _declare(self, out: _Output, columns: tuple[str, ...]) -> None:
        schema = find_schema(out.schema)
        try:
            out.encoder = Encoder(schema, columns, out.frame_id, out.topic, out.id)
        except MarchaError as e:
            raise type(e)(f"{self.path}: {e}") from None
        out.columns = columns
        durability = "transient_local" if out.topic == "/tf_static" else "volatile"
        metadata = {
            "offered_qos_profiles": QOS.format(durability=durability),
            "columns": json.dumps(columns, ensure_ascii=False),
            "frame_id": out.frame_id,
            **out.metadata,
        }
        self._add_channel(Channel(out.id, out.topic, "cdr", metadata, self._schema_id(out.schema, full_text(out.schema))))

    def _schema_id(self, name: str, text: str) -> int:
        key = f"{name}\n{text}"
        if key not in self._schemas:
            schema = Schema(len(self._schemas) + 1, text.encode(), "ros2msg", name)
            self._schemas[key] = schema
            self._record(schema)
        return self._schemas[key].id

    def _add_channel(self, channel: Channel) -> None:
        self._channels[channel.id] = channel
        self._statistics.channel_message_counts.setdefault(channel.id, 0)
        self._record(channel)

    # ------------------------------------------------------------------------------------------------ chunks

    def _buffer(self, out: _Output, block: dict[str, NDArray[Any]]) -> None:
        """Cut rows into chunks; keep less than a chunk for the next call."""
        rows = len(block["t_ns"])
        size = out.chunk_rows
        at = 0
        if out.rows:
            at = min(rows, size - out.rows)
            out.pending.append({k: v[:at].copy() for k, v in block.items()})  # type: ignore[arg-type]
            out.rows += at
            if out.rows == size:
                self._flush(out)
        while rows - at >= size:
            self._submit(out, {k: v[at : at + size] for k, v in block.items()})
            at += size
        if at < rows:
            out.pending.append({k: v[at:].copy() for k, v in block.items()})  # type: ignore[arg-type]
            out.rows += rows - at

    def _flush(self, out: _Output) -> None:
        if out.rows:
            parts: list[Any] = out.pending
            self._submit(out, {k: np.concatenate([p[k] for p in parts]) for k in parts[0]})
            out.pending, out.rows = [], 0

    def _submit(self, out: _Output, block: dict[str, NDArray[Any]]) -> None:
        assert out.encoder is not None
        self._jobs.append(self._pool.submit(_lay, out.encoder, block, out.sequence))
        out.sequence += len(block["t_ns"])
        while len(self._jobs) > 8:
            self._put(self._jobs.popleft().result())

    def _drain(self) -> None:
        while self._jobs:
            self._put(self._jobs.popleft().result())

    def _put(self, packed: Packed) -> None:
        chunk, start = packed.chunk, self._at
        self._record(chunk)
        length = self._at - start
        index_at = self._at
        self._write(packed.index)
        self._chunk_indexes.append(
            ChunkIndex(
                chunk_length=length,
                chunk_start_offset=start,
                compression=chunk.compression,
                compressed_size=len(chunk.data),
                message_end_time=chunk.message_end_time,
                message_index_length=len(packed.index),
                message_index_offsets={packed.channel_id: index_at},
                message_start_time=chunk.message_start_time,
                uncompressed_size=chunk.uncompressed_size,
            )
        )
        self._count({packed.channel_id: (len(packed.index) - 15) // 16}, chunk)

    def _count(self, counts: Mapping[int, int], chunk: Chunk) -> None:
        statistics = self._statistics
        first = statistics.message_count == 0
        start, end = chunk.message_start_time, chunk.message_end_time
        statistics.message_start_time = start if first else min(statistics.message_start_time, start)
        statistics.message_end_time = max(statistics.message_end_time, end)
        statistics.chunk_count += 1
        for channel, count in counts.items():
            statistics.message_count += count
            statistics.channel_message_counts[channel] = statistics.channel_message_counts.get(channel, 0) + count

    # ------------------------------------------------------------------------------------------------ file

    def _finish(self) -> None:
        for out in self._outputs.values():
            if out.columns is None:
                raise UsageError(f"{self.path}: {out.topic}: declared without columns and never written")
            self._flush(out)
        self._drain()
        self._record(DataEnd(self._crc))
        self._statistics.schema_count = len(self._schemas)
        self._statistics.channel_count = len(self._channels)
        groups: list[tuple[Opcode, Sequence[McapRecord]]] = [
            (Opcode.SCHEMA, list(self._schemas.values())),
            (Opcode.CHANNEL, list(self._channels.values())),
            (Opcode.STATISTICS, [self._statistics]),
            (Opcode.CHUNK_INDEX, self._chunk_indexes),
            (Opcode.ATTACHMENT_INDEX, self._attachment_indexes),
            (Opcode.METADATA_INDEX, self._metadata_indexes),
        ]
        builder, start = RecordBuilder(), self._at
        offsets: list[SummaryOffset] = []
        for opcode, records in groups:
            group_start = builder.count
            for record in records:
                record.write(builder)
            if builder.count > group_start:
                offsets.append(SummaryOffset(opcode, start + group_start, builder.count - group_start))
        offset_start = start + builder.count
        for offset in offsets:
            offset.write(builder)
        summary = builder.end()
        head = struct.pack("<BQQQ", Opcode.FOOTER, 20, start, offset_start)
        self._write(summary)
        self._record(Footer(start, offset_start, zlib.crc32(head, zlib.crc32(summary))))
        self._write(MCAP0_MAGIC)
        self._file.commit()

    def _record(self, record: McapRecord) -> None:
        builder = RecordBuilder()
        record.write(builder)
        self._write(builder.end())

    def _write(self, data: bytes) -> None:
        self._file.write(data)
        self._crc = zlib.crc32(data, self._crc)
        self._at += len(data)

    def _check_open(self) -> None:
        if self._closed:
            raise UsageError(f"{self.path}: the recording is closed")


def _lay(encoder: Encoder, block: dict[str, NDArray[Any]], sequence: int) -> Packed:
    """Lay one block into a compressed chunk with its index; runs in a worker thread."""
    data, offsets = encoder.encode(block, block["t_ns"], block["t_log_ns"], sequence)
    return pack(data, encoder.channel_id, block["t_log_ns"], offsets)


def pack(data: Bytes, channel_id: int, log: NDArray[np.int64], offsets: NDArray[np.int64]) -> Packed:
    """Compress the message records of one channel into a chunk and build its message index."""
    raw = memoryview(data)
    compressed = zstandard.ZstdCompressor(level=ZSTD_LEVEL).compress(raw)
    chunk = Chunk(
        compression="zstd",
        data=compressed,
        message_start_time=int(log.min()),
        message_end_time=int(log.max()),
        uncompressed_crc=zlib.crc32(raw),
        uncompressed_size=data.size,
    )
    entries = np.empty((len(log), 2), "<u8")
    entries[:, 0] = log
    entries[:, 1] = offsets
    builder = RecordBuilder()  # MessageIndex.write would loop over tuples
    builder.start_record(Opcode.MESSAGE_INDEX)
    builder.write2(channel_id)
    builder.write4(entries.nbytes)
    builder.write(entries.tobytes())
    builder.finish_record()
    return Packed(chunk, channel_id, builder.end())


