"""Chunks of a file: read, and split by channel."""

from __future__ import annotations

import struct
import threading
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
import zstandard
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from numpy.typing import NDArray

from .checksum import crc32
from .codec import INDEX_HEAD, PREFIX, RECORD_HEAD, Messages
from .errors import MarchaError
from .files import require_regular

MAX_CHUNK = 1 << 28
"""A chunk that claims more bytes than this is broken, or made to take memory."""
MOST_GROWTH, FREE_GROWTH = 1000, 1 << 24
"""So many times its packed size a chunk may have where it has more than so many bytes."""
LAST_NS = (1 << 63) - 1
"""Times beyond this (year 2262) are none: they do not fit the integers of tables."""


_CHUNK_HEAD = struct.Struct("<QQQI")

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


class FileReader:
    """Positioned reads from one file, safe from several threads."""

    def __init__(self, path: Path) -> None:
        self.path = path
        require_regular(path)
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
    offset = 9 + _CHUNK_HEAD.size
    name_length = int.from_bytes(record[offset : offset + 4], "little")
    compression = record[offset + 4 : offset + 4 + name_length].decode("utf-8", "replace")
    offset += 4 + name_length
    length = int.from_bytes(record[offset : offset + 8], "little")
    if offset + 8 + length > len(record):
        raise ChunkError(f"{where}: its length is wrong")
    if size > MAX_CHUNK or size > max(FREE_GROWTH, MOST_GROWTH * length):
        raise ChunkError(f"{where}: claims {size} bytes in {length} packed ones")
    return ChunkHead(size, crc, compression, offset + 8, length)


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
    filled = 0
    while filled < size and (n := stream.readinto(view[filled:])):
        filled += n
    if filled == size and stream.read(1):
        raise ValueError("more bytes than stated")
    return view[:filled]


def split(
    data: NDArray[np.uint8],
    wanted: Collection[int] | None,
    on_record: Callable[[int, bytes], None] | None = None,
) -> dict[int, Messages]:
    """Split a chunk's records by channel.

    Parameters
    ----------
    data : ndarray of uint8, shape (bytes,)
        Decompressed records.
    wanted : collection of int or None
        Channel ids to return; None for all.
    on_record : callable, optional
        Called with opcode and body of each schema and channel record found in the chunk.

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
    raw, size, offset = data.data, len(data), 0
    rows: dict[int, tuple[list[int], list[int]]] = {}
    unpack = RECORD_HEAD.unpack_from
    while offset + 9 <= size:
        opcode, length = unpack(raw, offset)
        end = offset + 9 + length
        if end > size:
            raise ChunkError(f"a record of {length} bytes runs out of its chunk")
        if opcode == 0:
            raise ChunkError("a record of kind 0")
        if opcode == 5:
            if length < 22:
                raise ChunkError(f"a message record of {length} bytes")
            channel = raw[offset + 9] | raw[offset + 10] << 8
            if wanted is None or channel in wanted:
                starts, sizes = rows.setdefault(channel, ([], []))
                starts.append(offset)
                sizes.append(length - 22)
        elif on_record is not None and opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            try:
                on_record(opcode, bytes(raw[offset + 9 : end]))
            except BROKEN as e:
                raise ChunkError(f"a record of kind {opcode}: {e}") from None
        offset = end
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
    low, high = (np.ndarray((n,), "<u8", data, offset, (stride,)) for offset in (0, 3))  # type: ignore[arg-type]
    if (low != low[0]).any():
        return None
    one_channel = bool((high == high[0]).all())
    head = np.ndarray((n,), PREFIX, data, 0, (stride,))  # type: ignore[arg-type]
    if not one_channel and (head["length"] != stride - 9).any():
        return None
    offsets = np.arange(n, dtype=np.int64) * stride + PREFIX.itemsize
    sizes = np.full(n, stride - PREFIX.itemsize, np.int64)
    messages = Messages(data, offsets, sizes, _times(head["log"]), _times(head["publish"]))
    channels = head["channel"]
    if one_channel:
        return {int(channels[0]): messages}
    return {int(c): messages.take(channels == c) for c in np.unique(channels)}


def _times(stated: NDArray[np.uint64]) -> NDArray[np.int64]:
    if len(stated) and int(stated.max()) > LAST_NS:
        raise ChunkError(f"a message at time {int(stated.max())} ns, beyond the year 2262")
    return stated.astype(np.int64)


def _messages(data: NDArray[np.uint8], starts: NDArray[np.int64], sizes: NDArray[np.int64]) -> Messages:
    windows = np.lib.stride_tricks.sliding_window_view(data, PREFIX.itemsize)
    head = windows[starts].view(PREFIX)[:, 0]
    log, publish = _times(head["log"]), _times(head["publish"])
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
    offset = 0
    while offset < len(data):
        if offset + INDEX_HEAD.size > len(data):
            raise ChunkError("a message index is cut short")
        opcode, length, channel, size = INDEX_HEAD.unpack_from(data, offset)
        if opcode == Opcode.MESSAGE_INDEX:
            if size % 16 or offset + INDEX_HEAD.size + size > len(data):
                raise ChunkError("a message index has a wrong length")
            out[channel] = np.frombuffer(data, "<u8", size // 8, offset + INDEX_HEAD.size)[::2].astype(
                np.int64
            )
        offset += 9 + length
    return out
