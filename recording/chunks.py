"""Chunks of a file: found through the summary or by scanning, read, and split by channel."""

from __future__ import annotations

import struct
import threading
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    AttachmentIndex,
    Channel,
    ChunkIndex,
    Footer,
    Header,
    MetadataIndex,
    Schema,
    Statistics,
)
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC
from numpy.typing import NDArray

from .checksum import crc32
from .codec import PREFIX, Messages
from .errors import Finding, MarchaError

MAX_CHUNK = 1 << 32
"""A chunk that claims more bytes than this is broken."""

_RUN = 1 << 20
"""Bytes of loose messages (a file without chunks) that are taken together."""

_CHUNK_HEAD = struct.Struct("<QQQI")
_RECORD_HEAD = struct.Struct("<BQ")
_INDEX_HEAD = struct.Struct("<BQHI")
_FOOTER_SIZE = 9 + 20

BROKEN = (McapError, struct.error, ValueError, UnicodeDecodeError, EOFError, MemoryError, OverflowError)
"""What mcap's records raise on bytes that are not theirs."""


class ChunkError(Exception):
    """A chunk cannot be read; the text says why."""


@dataclass
class ChunkRef:
    """Where a chunk lies and what it spans.

    Attributes
    ----------
    start, length : int
        Its record in the file; for loose messages the run of records.
    first_ns, last_ns : int
        Log time of its first and last message.
    indexes : dict of int to int
        Channel id to the position of its message index; empty where there are none.
    index_length : int
        Bytes of the message indexes behind the chunk.
    loose : bool
        A run of messages outside chunks.
    """

    start: int
    length: int
    first_ns: int
    last_ns: int
    indexes: dict[int, int] = field(default_factory=dict)
    index_length: int = 0
    loose: bool = False


@dataclass
class Contents:
    """What a file holds, from its summary or from a scan."""

    profile: str = ""
    library: str = ""
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    chunks: list[ChunkRef] = field(default_factory=list)
    statistics: Statistics | None = None
    attachments: list[AttachmentIndex] = field(default_factory=list)
    metadata: list[MetadataIndex] = field(default_factory=list)
    findings: list[Finding] = field(default_factory=list)
    indexed: bool = True


class FileReader:
    """Positioned reads from one file, safe from several threads."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._file: IO[bytes] = path.open("rb")
            self.size = self._file.seek(0, 2)
        except IsADirectoryError:
            raise MarchaError(f"{path}: is a folder, not a recording") from None
        except FileNotFoundError:
            raise MarchaError(f"{path}: no such file") from None
        except OSError as e:
            raise MarchaError(f"{path}: cannot read: {e.strerror or e}") from None
        self._lock = threading.Lock()

    def read(self, start: int, length: int) -> bytes:
        """Return ``length`` bytes from ``start``; fewer where the file ends."""
        try:
            with self._lock:
                self._file.seek(start)
                return self._file.read(length)
        except OSError as e:
            raise MarchaError(f"{self.path}: cannot read at byte {start}: {e.strerror or e}") from None

    def close(self) -> None:
        """Close the file."""
        self._file.close()


# ------------------------------------------------------------------------------------------------ finding


def find_contents(file: FileReader) -> Contents:
    """Read the summary, or scan the whole file where there is none or it cannot be trusted.

    Raises
    ------
    MarchaError
        Not an MCAP file, or nothing in it can be read.
    """
    path = file.path
    if file.size == 0:
        raise MarchaError(f"{path}: empty file, not a recording")
    magic = file.read(0, 8)
    if magic != MCAP0_MAGIC:
        short = f" ({file.size} bytes)" if file.size < 8 else ""
        raise MarchaError(f"{path}: not an MCAP recording{short}: it begins with {magic.hex(' ')}")
    try:
        contents = _summary(file)
    except BROKEN as e:
        contents, reason = None, str(e) or type(e).__name__
    else:
        reason = "the summary has no chunk index"
    if contents is not None:
        return contents
    return _scan(file, reason)


def _summary(file: FileReader) -> Contents | None:
    tail = file.read(max(0, file.size - 8 - _FOOTER_SIZE), _FOOTER_SIZE + 8)
    if len(tail) < _FOOTER_SIZE + 8 or tail[-8:] != MCAP0_MAGIC or tail[0] != Opcode.FOOTER:
        raise ValueError("the file ends without a footer")
    footer = Footer.read(ReadDataStream(BytesIO(tail[9:])))
    if footer.summary_start == 0:
        return None
    end = file.size - 8 - _FOOTER_SIZE
    if not 8 <= footer.summary_start <= end:
        raise ValueError("the footer points outside the file")
    summary = file.read(footer.summary_start, end - footer.summary_start)
    crc = crc32(tail[: _FOOTER_SIZE - 4], crc32(summary))
    if footer.summary_crc not in (0, crc):
        raise ValueError("the summary's checksum is wrong")
    contents = Contents()
    for record in StreamReader(BytesIO(summary + tail), skip_magic=True).records:
        if isinstance(record, Schema):
            contents.schemas[record.id] = record
        elif isinstance(record, Channel):
            contents.channels[record.id] = record
        elif isinstance(record, Statistics):
            contents.statistics = record
        elif isinstance(record, AttachmentIndex):
            contents.attachments.append(record)
        elif isinstance(record, MetadataIndex):
            contents.metadata.append(record)
        elif isinstance(record, ChunkIndex):
            contents.chunks.append(
                ChunkRef(
                    record.chunk_start_offset,
                    record.chunk_length,
                    record.message_start_time,
                    record.message_end_time,
                    record.message_index_offsets,
                    record.message_index_length,
                )
            )
    statistics = contents.statistics
    if statistics is None or statistics.chunk_count != len(contents.chunks):
        return None
    if statistics.message_count and not contents.chunks:
        return None
    if (
        len(contents.channels) != statistics.channel_count
        or len(contents.metadata) != statistics.metadata_count
    ):
        return None
    if len(contents.attachments) != statistics.attachment_count:
        return None
    contents.chunks.sort(key=lambda c: c.start)
    _read_header(file, contents)
    return contents


def _read_header(file: FileReader, contents: Contents) -> None:
    opcode, length = _RECORD_HEAD.unpack(file.read(8, 9))
    if opcode == Opcode.HEADER:
        header = Header.read(ReadDataStream(BytesIO(file.read(17, length))))
        contents.profile, contents.library = header.profile, header.library


def _scan(file: FileReader, reason: str) -> Contents:
    """Walk the records from the start, keep whole and sound chunks, stop where the bytes make no sense."""
    contents = Contents(indexed=False)
    counts: dict[int, int] = {}
    at, ended, run = 8, False, None
    while at + 9 <= file.size:
        opcode, length = _RECORD_HEAD.unpack(file.read(at, 9))
        body, end = at + 9, at + 9 + length
        if end > file.size:
            break
        if opcode != Opcode.MESSAGE:
            run = None
        try:
            if opcode == Opcode.DATA_END or opcode == Opcode.FOOTER:
                ended = True
                break
            if opcode == Opcode.CHUNK:
                _scan_chunk(file, ChunkRef(at, end - at, 0, 0), contents, counts)
            elif opcode == Opcode.MESSAGE:
                run = _scan_message(file, at, end, run, contents, counts)
            elif opcode == Opcode.MESSAGE_INDEX and contents.chunks:
                chunk = contents.chunks[-1]
                if not chunk.loose and chunk.start + chunk.length + chunk.index_length == at:
                    chunk.index_length += end - at
            elif opcode in (Opcode.HEADER, Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA):
                _scan_record(opcode, at, file.read(body, length), contents)
            elif opcode == Opcode.ATTACHMENT:
                _scan_attachment(file, at, length, contents)
            elif opcode == 0:
                break
        except BROKEN as e:
            _add(contents.findings, "bad_record", f"byte {at}: {e or type(e).__name__}; skipped")
        at = end
    if not ended:
        _add(
            contents.findings,
            "truncated",
            f"{reason}: cut short at byte {at} of {file.size}; read up to the last whole chunk",
        )
    elif reason != "the summary has no chunk index":
        _add(contents.findings, "bad_summary", f"{reason}; the file was read from its start")
    times = [t for c in contents.chunks for t in (c.first_ns, c.last_ns)]
    contents.statistics = Statistics(
        attachment_count=len(contents.attachments),
        channel_count=len(contents.channels),
        channel_message_counts=counts,
        chunk_count=len(contents.chunks),
        message_count=sum(counts.values()),
        message_end_time=max(times, default=0),
        message_start_time=min(times, default=0),
        metadata_count=len(contents.metadata),
        schema_count=len(contents.schemas),
    )
    if not contents.channels and not contents.metadata and not ended:
        raise MarchaError(f"{file.path}: {reason}, and no channel can be read from its {file.size} bytes")
    return contents


def _add(findings: list[Finding], kind: str, detail: str) -> None:
    """Count a finding; the first of a kind gives the detail."""
    for i, f in enumerate(findings):
        if f.kind == kind:
            findings[i] = Finding(kind, f.count + 1, f.first_line, f.detail)
            return
    findings.append(Finding(kind, 1, None, detail))


add_finding: Callable[[list[Finding], str, str], None] = _add


def _scan_chunk(file: FileReader, ref: ChunkRef, contents: Contents, counts: dict[int, int]) -> None:
    try:
        data = read_chunk(file, ref)
        parts = split(data, None, contents)
    except ChunkError as e:
        _add(contents.findings, "bad_chunk", f"{e}; skipped")
        return
    logs = [m.log for m in parts.values() if len(m.log)]
    ref.first_ns = min((int(v.min()) for v in logs), default=0)
    ref.last_ns = max((int(v.max()) for v in logs), default=0)
    ref.indexes = dict.fromkeys(parts, 0)
    for channel, messages in parts.items():
        counts[channel] = counts.get(channel, 0) + len(messages.log)
    if logs:
        contents.chunks.append(ref)


def _scan_message(
    file: FileReader, at: int, end: int, run: ChunkRef | None, contents: Contents, counts: dict[int, int]
) -> ChunkRef:
    head = np.frombuffer(file.read(at, PREFIX.itemsize), PREFIX)[0]
    channel, log = int(head["channel"]), int(head["log"])
    if run is None or run.length + end - at > _RUN:
        run = ChunkRef(at, 0, log, log, loose=True)
        contents.chunks.append(run)
    run.length += end - at
    run.first_ns, run.last_ns = min(run.first_ns, log), max(run.last_ns, log)
    run.indexes[channel] = 0
    counts[channel] = counts.get(channel, 0) + 1
    return run


def _scan_record(opcode: int, at: int, body: bytes, contents: Contents) -> None:
    stream = ReadDataStream(BytesIO(body))
    if opcode == Opcode.HEADER:
        header = Header.read(stream)
        contents.profile, contents.library = header.profile, header.library
    elif opcode == Opcode.SCHEMA:
        schema = Schema.read(stream)
        contents.schemas[schema.id] = schema
    elif opcode == Opcode.CHANNEL:
        channel = Channel.read(stream)
        contents.channels[channel.id] = channel
    else:
        contents.metadata.append(MetadataIndex(at, 9 + len(body), stream.read_prefixed_string()))


def _scan_attachment(file: FileReader, at: int, length: int, contents: Contents) -> None:
    stream = ReadDataStream(BytesIO(file.read(at + 9, min(length, 1 << 16))))
    log, created = stream.read8(), stream.read8()
    name, media = stream.read_prefixed_string(), stream.read_prefixed_string()
    size = stream.read8()
    contents.attachments.append(AttachmentIndex(at, 9 + length, log, created, size, name, media))


# ------------------------------------------------------------------------------------------------ reading

_local = threading.local()


def read_chunk(file: FileReader, ref: ChunkRef, reuse: bool = False) -> NDArray[np.uint8]:
    """Return the decompressed records of a chunk, its checksum verified.

    Parameters
    ----------
    file : FileReader
        The file.
    ref : ChunkRef
        Where the chunk lies.
    reuse : bool
        Whether the bytes may lie in a buffer that this thread's next call overwrites. Fresh memory for every
        chunk costs as much as decompressing it.

    Raises
    ------
    ChunkError
        Checksum, compression or lengths are wrong.
    """
    record = file.read(ref.start, ref.length)
    if ref.loose:
        return np.frombuffer(record, "u1")
    head = chunk_head(record, ref)
    where, size = f"chunk at byte {ref.start}", head.uncompressed_size
    body = memoryview(record)[head.start : head.start + head.length]
    try:
        data = _decompress(head.compression, body, size, reuse)
    except (zstandard.ZstdError, RuntimeError, MemoryError, ValueError, EOFError) as e:
        raise ChunkError(f"{where}: {head.compression}: {e}") from None
    if len(data) != size:
        raise ChunkError(f"{where}: {len(data)} bytes, {size} stated")
    if head.crc and crc32(data) != head.crc:
        raise ChunkError(f"{where}: the checksum is wrong")
    return np.frombuffer(data, "u1")


class ChunkHead(NamedTuple):
    """Head of a chunk record; the compressed bytes are ``record[start:start + length]``."""

    uncompressed_size: int
    crc: int
    compression: str
    start: int
    length: int


def chunk_head(record: bytes, ref: ChunkRef) -> ChunkHead:
    """Parse the head of a chunk record.

    Raises
    ------
    ChunkError
        It is no chunk, or its lengths are wrong.
    """
    where = f"chunk at byte {ref.start}"
    if len(record) < ref.length or ref.length < 9 + 40 or record[0] != Opcode.CHUNK:
        raise ChunkError(f"{where}: no chunk there")
    _, _, size, crc = _CHUNK_HEAD.unpack_from(record, 9)
    at = 9 + _CHUNK_HEAD.size
    name_length = int.from_bytes(record[at : at + 4], "little")
    compression = record[at + 4 : at + 4 + name_length].decode("utf-8", "replace")
    at += 4 + name_length
    length = int.from_bytes(record[at : at + 8], "little")
    if at + 8 + length > len(record):
        raise ChunkError(f"{where}: its length is wrong")
    if size > MAX_CHUNK:
        raise ChunkError(f"{where}: claims {size} bytes")
    return ChunkHead(size, crc, compression, at + 8, length)


def _decompress(compression: str, body: memoryview, size: int, reuse: bool) -> bytes | memoryview:
    if compression == "":
        return body
    if compression == "zstd":
        decompressor = getattr(_local, "zstd", None)
        if decompressor is None:
            decompressor = _local.zstd = zstandard.ZstdDecompressor()
        stated = zstandard.frame_content_size(body) if len(body) else 0
        if stated > size:  # it would be allocated as the frame says, not as the chunk does
            raise ValueError(f"{stated} bytes, {size} stated")
        if not reuse:
            return decompressor.decompress(body, max_output_size=size) if size else b""
        with decompressor.stream_reader(body, read_size=max(1, len(body))) as stream:
            return _fill(stream, size)
    if compression == "lz4":
        import lz4.frame

        return lz4.frame.LZ4FrameDecompressor().decompress(body, max_length=size + 1)
    raise ValueError("unknown compression")


def _fill(stream: Any, size: int) -> memoryview:
    """Read ``size`` bytes into this thread's buffer; the view returned is valid until the next call."""
    buffer = getattr(_local, "buffer", None)
    if buffer is None or len(buffer) < size:
        buffer = _local.buffer = bytearray(size)
    view = memoryview(buffer)[:size]
    at = 0
    while at < size and (n := stream.readinto(view[at:])):
        at += n
    if at == size and stream.read(1):
        raise ValueError("more bytes than stated")
    return view[:at]


def split(
    data: NDArray[np.uint8], wanted: Collection[int] | None, contents: Contents | None = None
) -> dict[int, Messages]:
    """Split a chunk's records by channel.

    Parameters
    ----------
    data : ndarray of uint8
        Decompressed records.
    wanted : collection of int or None
        Channel ids to return; None for all.
    contents : Contents, optional
        Takes the schema and channel records found in the chunk.

    Returns
    -------
    dict of int to Messages

    Raises
    ------
    ChunkError
        A record's length runs out of the chunk.
    """
    even = _split_even(data)
    if even is not None:
        return {k: v for k, v in even.items() if wanted is None or k in wanted}
    raw, size, at = data.data, len(data), 0
    rows: dict[int, tuple[list[int], list[int]]] = {}
    unpack = _RECORD_HEAD.unpack_from
    while at + 9 <= size:
        opcode, length = unpack(raw, at)
        end = at + 9 + length
        if end > size:
            raise ChunkError(f"a record of {length} bytes runs out of its chunk")
        if opcode == 5:
            if length < 22:
                raise ChunkError(f"a message record of {length} bytes")
            channel = raw[at + 9] | raw[at + 10] << 8
            if wanted is None or channel in wanted:
                starts, sizes = rows.setdefault(channel, ([], []))
                starts.append(at)
                sizes.append(length - 22)
        elif contents is not None and opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            try:
                _scan_record(opcode, at, bytes(raw[at + 9 : end]), contents)
            except BROKEN as e:
                raise ChunkError(f"a record of kind {opcode}: {e}") from None
        at = end
    return {k: _messages(data, np.array(s, np.int64), np.array(n, np.int64)) for k, (s, n) in rows.items()}


def _split_even(data: NDArray[np.uint8]) -> dict[int, Messages] | None:
    """Return the messages of a chunk that holds records of one size only, else None."""
    if len(data) < PREFIX.itemsize or data[0] != 5:
        return None
    stride = 9 + int.from_bytes(data[1:9].tobytes(), "little")
    if stride < PREFIX.itemsize or len(data) % stride:
        return None
    n = len(data) // stride
    # Opcode, length and channel are the first eleven bytes: two overlapping words.
    low, high = (np.ndarray((n,), "<u8", data, at, (stride,)) for at in (0, 3))  # type: ignore[arg-type]
    if (low != low[0]).any():
        return None
    one_channel = bool((high == high[0]).all())
    head = np.ndarray((n,), PREFIX, data, 0, (stride,))  # type: ignore[arg-type]
    if not one_channel and (head["length"] != stride - 9).any():
        return None
    offsets = np.arange(n, dtype=np.int64) * stride + PREFIX.itemsize
    sizes = np.full(n, stride - PREFIX.itemsize, np.int64)
    messages = Messages(data, offsets, sizes, head["log"].astype(np.int64), head["publish"].astype(np.int64))
    channels = head["channel"]
    if one_channel:
        return {int(channels[0]): messages}
    return {int(c): messages.take(channels == c) for c in np.unique(channels)}


def _messages(data: NDArray[np.uint8], starts: NDArray[np.int64], sizes: NDArray[np.int64]) -> Messages:
    windows = np.lib.stride_tricks.sliding_window_view(data, PREFIX.itemsize)
    head = windows[starts].view(PREFIX)[:, 0]
    log, publish = head["log"].astype(np.int64), head["publish"].astype(np.int64)
    return Messages(data, starts + PREFIX.itemsize, sizes, log, publish)


def read_index(file: FileReader, ref: ChunkRef) -> dict[int, NDArray[np.int64]]:
    """Return the log times of each channel's messages in a chunk, from its message indexes.

    Raises
    ------
    ChunkError
        The indexes are not there or broken.
    """
    data = file.read(ref.start + ref.length, ref.index_length)
    out: dict[int, NDArray[np.int64]] = {}
    at = 0
    while at < len(data):
        if at + _INDEX_HEAD.size > len(data):
            raise ChunkError("a message index is cut short")
        opcode, length, channel, size = _INDEX_HEAD.unpack_from(data, at)
        if opcode == Opcode.MESSAGE_INDEX:
            if size % 16 or at + _INDEX_HEAD.size + size > len(data):
                raise ChunkError("a message index has a wrong length")
            out[channel] = np.frombuffer(data, "<u8", size // 8, at + _INDEX_HEAD.size)[::2].astype(np.int64)
        at += 9 + length
    return out
