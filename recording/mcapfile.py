"""An MCAP file being written: records, chunks, indexes and checksums, on mcap's record classes."""

from __future__ import annotations

import struct
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
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
from .checksum import crc32, crc32_behind
from .codec import INDEX_HEAD, RECORD_HEAD
from .errors import UsageError
from .threads import helpers

CHUNK_SIZE = 1 << 20
"""Uncompressed bytes of a chunk: 30 to 60 s of one 100 Hz channel."""

ZSTD_LEVEL = -3
"""Of recordings. Readings of a 16-bit sensor: level 2 takes half as long again, for files a fifth smaller."""

_QUEUE = 8
"""Chunks that may wait for a worker: bounds memory."""


@cache
def library_name() -> str:
    """Return ``marcha <version>``, as recordings name their writer."""
    try:
        return f"marcha {version('marcha')}"
    except PackageNotFoundError:
        return "marcha"


class Packed(NamedTuple):
    """A chunk ready for the file: its record and its message indexes (in pieces), and for each channel where
    its index starts in them and how many messages it has. ``crc`` is that of the record's last piece, where
    it is known; ``written`` is called when the pieces may be used again.
    """

    chunk: Sequence[bytes | memoryview]
    indexes: Sequence[bytes | memoryview]
    channels: dict[int, tuple[int, int]]
    first_ns: int
    last_ns: int
    compression: str
    compressed_size: int
    uncompressed_size: int
    crc: int | None = None
    written: Callable[[], object] | None = None


class McapFile:
    """Writes the records of one file in order and keeps account of them for the summary.

    Parameters
    ----------
    path : pathlib.Path
        The file.
    overwrite : bool
        Whether it may be there already.
    threads : bool
        Whether chunks are worth worker threads, as they are when they are compressed.
    """

    def __init__(self, path: Path, *, overwrite: bool, threads: bool) -> None:
        self.path = path
        self.schemas: dict[tuple[str, str, bytes], Schema] = {}
        self.channels: dict[int, Channel] = {}
        self._file = AtomicFile(path, overwrite=overwrite)
        self._statistics = Statistics(0, 0, {}, 0, 0, 0, 0, 0, 0)
        self._chunks: list[ChunkIndex] = []
        self._attachments: dict[str, AttachmentIndex] = {}
        self._metadata: dict[str, MetadataIndex] = {}
        self._crc = 0
        self._at = 0
        self._pool = helpers("write", 4 if threads else 0)
        self._ahead = _QUEUE if threads else 0
        self._jobs: deque[Future[Packed]] = deque()
        try:
            self._write(MCAP0_MAGIC)
            self._record(Header(profile="ros2", library=library_name()))
        except BaseException:
            self.abort()
            raise

    @property
    def start_ns(self) -> int | None:
        """Log time of the first message in the file so far; None where there is none."""
        return self._statistics.message_start_time if self._statistics.message_count else None

    def add_schema(self, name: str, encoding: str, data: bytes, id_: int | None = None) -> int:
        """Write a schema record unless it is there; return its id (``id_`` where that is free)."""
        key = (name, encoding, data)
        if key not in self.schemas:
            taken = {s.id for s in self.schemas.values()}
            if id_ is None or id_ in taken or id_ == 0:
                id_ = max(taken, default=0) + 1
            self.schemas[key] = Schema(id_, data, encoding, name)
            self._record(self.schemas[key])
        return self.schemas[key].id

    def free_id(self) -> int:
        """Return an unused channel id."""
        return max(self.channels, default=0) + 1

    def add_channel(self, channel: Channel) -> None:
        """Write a channel record."""
        self.channels[channel.id] = channel
        self._statistics.channel_message_counts.setdefault(channel.id, 0)
        self._record(channel)

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Write a metadata record; one a name."""
        if name in self._metadata:
            raise UsageError(f"{self.path}: metadata record {name!r} is there already")
        start = self._at
        self._record(Metadata(name, {str(k): str(v) for k, v in values.items()}))
        self._metadata[name] = MetadataIndex(start, self._at - start, name)

    def add_attachment(self, name: str, data: bytes, media_type: str) -> None:
        """Write an attachment; one a name."""
        if name in self._attachments:
            raise UsageError(f"{self.path}: attachment {name!r} is there already")
        start = self._at
        self._record(Attachment(0, 0, name, media_type, data))
        self._attachments[name] = AttachmentIndex(start, self._at - start, 0, 0, len(data), name, media_type)

    def submit(self, pack: Callable[..., Packed], *args: Any) -> None:
        """Have ``pack(*args)`` make a chunk in a worker thread; they enter the file in that order."""
        if self._ahead == 0:
            self.put(pack(*args))
            return
        self._jobs.append(self._pool.submit(pack, *args))
        # A number, not what is done: the same tables give the same bytes.
        while len(self._jobs) > self._ahead:
            self.put(self._jobs.popleft().result())

    def drain(self) -> None:
        """Wait for all chunks that were submitted."""
        while self._jobs:
            self.put(self._jobs.popleft().result())

    def put(self, packed: Packed) -> None:
        """Write a chunk and its message indexes."""
        start = self._at
        *head, body = packed.chunk
        self._count(*head)
        self._count(body, crc=packed.crc)
        index_at = self._at
        self._count(*packed.indexes)
        self._file.write(*packed.chunk, *packed.indexes)
        if packed.written is not None:
            packed.written()
        self._chunks.append(
            ChunkIndex(
                chunk_length=index_at - start,
                chunk_start_offset=start,
                compression=packed.compression,
                compressed_size=packed.compressed_size,
                message_end_time=packed.last_ns,
                message_index_length=self._at - index_at,
                message_index_offsets={c: index_at + offset for c, (offset, _) in packed.channels.items()},
                message_start_time=packed.first_ns,
                uncompressed_size=packed.uncompressed_size,
            )
        )
        statistics = self._statistics
        first = statistics.message_count == 0
        statistics.message_start_time = (
            packed.first_ns if first else min(statistics.message_start_time, packed.first_ns)
        )
        statistics.message_end_time = max(statistics.message_end_time, packed.last_ns)
        for channel, (_, count) in packed.channels.items():
            statistics.message_count += count
            statistics.channel_message_counts[channel] += count

    def finish(self) -> None:
        """Write the summary and put the file in its place."""
        self.drain()
        self._record(DataEnd(self._crc))
        statistics = self._statistics
        statistics.schema_count, statistics.channel_count = len(self.schemas), len(self.channels)
        statistics.attachment_count, statistics.metadata_count = len(self._attachments), len(self._metadata)
        statistics.chunk_count = len(self._chunks)
        groups: list[tuple[Opcode, Sequence[McapRecord]]] = [
            (Opcode.SCHEMA, list(self.schemas.values())),
            (Opcode.CHANNEL, list(self.channels.values())),
            (Opcode.STATISTICS, [statistics]),
            (Opcode.CHUNK_INDEX, self._chunks),
            (Opcode.ATTACHMENT_INDEX, list(self._attachments.values())),
            (Opcode.METADATA_INDEX, list(self._metadata.values())),
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
        self._record(Footer(start, offset_start, crc32(head, crc32(summary))))
        self._write(MCAP0_MAGIC)
        self._file.commit()
        self._pool.shutdown()

    def abort(self) -> None:
        """Drop the file; nothing is left on disk."""
        self._pool.shutdown(wait=True, cancel_futures=True)
        self._file.abort()

    def _record(self, record: McapRecord) -> None:
        builder = RecordBuilder()
        record.write(builder)
        self._write(builder.end())

    def _write(self, data: bytes | memoryview) -> None:
        self._count(data)
        self._file.write(data)

    def _count(self, *pieces: bytes | memoryview, crc: int | None = None) -> None:
        """Keep account of bytes that are written now; ``crc`` is their own, where it is known."""
        for data in pieces:
            self._crc = crc32(data, self._crc) if crc is None else crc32_behind(self._crc, data, crc)
            self._at += len(data)


_local = threading.local()
_LENGTH = struct.Struct("<Q")


def _compressor(level: int) -> zstandard.ZstdCompressor:
    """Return this thread's compressor; a new one for every chunk would allocate its tables anew."""
    key, compressor = getattr(_local, "zstd", (None, None))
    if compressor is None or key != level:
        # What repeats in a chunk are whole doubles and the heads of messages: looking for shorter matches
        # costs a fifth of the time, and tables beyond the first cache a tenth, for 2 % of size.
        tuned: dict[str, int] = {"min_match": 7, "hash_log": 13, "window_log": 18} if level < 0 else {}
        parameters = zstandard.ZstdCompressionParameters.from_level(level, **tuned)
        compressor = zstandard.ZstdCompressor(compression_params=parameters)
        _local.zstd = level, compressor
    return compressor


def pack(
    data: Bytes,
    channel_id: int,
    index: NDArray[np.int64],
    level: int | None = ZSTD_LEVEL,
    written: Callable[[], object] | None = None,
) -> Packed:
    """Compress message records of one channel into a chunk and build its message index.

    Parameters
    ----------
    data : ndarray of uint8
        Message records, one behind the other.
    channel_id : int
        Their channel.
    index : ndarray of int64, shape (n, 2)
        Log time and first byte of every record.
    level : int or None
        Compression level of zstd; None does not compress.
    written : callable, optional
        Called when ``data`` and ``index`` may be used again.
    """
    raw = data.data
    first, last = int(index[:, 0].min()), int(index[:, 0].max())
    crc = crc32(raw)
    pieces, compression = seal(raw, first, last, crc, level)
    entries = np.ascontiguousarray(index, "<i8").reshape(-1).view(np.uint8).data
    return Packed(
        pieces,
        (INDEX_HEAD.pack(Opcode.MESSAGE_INDEX, 6 + len(entries), channel_id, len(entries)), entries),
        {channel_id: (0, len(index))},
        first,
        last,
        compression,
        len(pieces[-1]),
        data.size,
        crc if level is None else None,
        written,
    )


def seal(
    raw: memoryview, first_ns: int, last_ns: int, crc: int, level: int | None
) -> tuple[tuple[bytes, bytes | memoryview], str]:
    """Return the chunk record around ``raw`` in two pieces, and its compression.

    The second piece is ``raw`` itself where ``level`` is None: the record class's own writer would copy these
    megabytes three times.
    """
    compression, body = ("", raw) if level is None else ("zstd", _compressor(level).compress(raw))
    builder = RecordBuilder()
    Chunk(compression, b"", last_ns, first_ns, crc, len(raw)).write(builder)
    head = bytearray(builder.end())
    _LENGTH.pack_into(head, 1, len(head) - RECORD_HEAD.size + len(body))
    _LENGTH.pack_into(head, len(head) - _LENGTH.size, len(body))
    return (bytes(head), body), compression
