"""Copying channels from one recording into another, chunk by chunk."""

from __future__ import annotations

from collections.abc import Collection
from typing import TYPE_CHECKING

import numpy as np
from mcap.records import Channel

from .annotations import EventDecoder
from .chunks import (
    ChunkError,
    ChunkRef,
    chunk_head,
    read_chunk,
    read_index,
    split,
)
from .codec import PREFIX, Messages, index_of
from .errors import MarchaError, UsageError
from .mcapfile import (
    McapFile,
    Packed,
    pack,
    seal,
)

if TYPE_CHECKING:
    from .reader import Recording


def copy_into(file: McapFile, rec: Recording, topics: Collection[str] | None, level: int | None) -> None:
    """Copy channels and their messages; annotations go another way (see :meth:`Writer.copy_from`).

    Chunks that are not compressed are, where ``level`` is not None.
    """
    ids = _copy_channels(file, rec, topics)
    same = all(old == new for old, new in ids.items())
    for ref in rec.chunk_refs(set(ids)):
        packed = None
        if same and not ref.loose and ref.indexes and ids.keys() >= ref.indexes.keys():
            packed = _verbatim(rec, ref)
        if packed is not None:
            file.submit(_sealed, packed, level)
            continue
        try:
            parts = split(read_chunk(rec.file, ref), ids)
        except ChunkError as e:
            rec.lost(ref, str(e))
            continue
        for old, messages in parts.items():
            file.submit(_reencode, messages, ids[old], level)
    file.drain()


def _copy_channels(file: McapFile, rec: Recording, topics: Collection[str] | None) -> dict[int, int]:
    """Write schemas and channels; return the new id of every old one."""
    wanted = None if topics is None else set([topics] if isinstance(topics, str) else topics)
    unknown = (wanted or set()) - set(rec.sources)
    if unknown:
        there = ", ".join(rec.sources) or "none"
        raise UsageError(f"{rec.path}: no topic {', '.join(sorted(unknown))}; there are: {there}")
    taken = {c.topic for c in file.channels.values()}
    ids: dict[int, int] = {}
    for topic, source in rec.sources.items():
        if (wanted is not None and topic not in wanted) or isinstance(source.decoder, EventDecoder):
            continue
        for old in source.ids:
            channel = rec.contents.channels[old]
            schema = rec.contents.schemas.get(channel.schema_id)
            if channel.message_encoding != "cdr" or schema is None:
                raise MarchaError(
                    f"{rec.path}: {topic}: message encoding {channel.message_encoding!r}; a recording holds "
                    "only cdr messages; name the topics to copy"
                )
            if channel.topic in taken:
                raise UsageError(
                    f"{file.path}: {channel.topic}: is in both recordings; name the topics to copy"
                )
            schema_id = file.add_schema(schema.name, schema.encoding, schema.data, schema.id)
            ids[old] = file.free_id() if old in file.channels else old
            metadata = {"offered_qos_profiles": "", **channel.metadata}
            file.add_channel(Channel(ids[old], channel.topic, "cdr", metadata, schema_id))
    return ids


def _verbatim(rec: Recording, ref: ChunkRef) -> Packed | None:
    """Return the chunk as it stands in the file, None where its indexes do not tell all about it."""
    record = rec.file.read(ref.start, ref.length)
    indexes = rec.file.read(ref.start + ref.length, ref.index_length)
    try:
        head = chunk_head(record, ref)
        times = read_index(rec.file, ref)
    except ChunkError:
        return None
    if set(times) != set(ref.indexes):
        return None
    channels: dict[int, tuple[int, int]] = {}
    offset = 0
    while offset < len(indexes):
        channel = int.from_bytes(indexes[offset + 9 : offset + 11], "little")
        channels[channel] = (offset, len(times[channel]))
        offset += 9 + int.from_bytes(indexes[offset + 1 : offset + 9], "little")
    return Packed(
        (record,),
        (indexes,),
        channels,
        ref.first_ns,
        ref.last_ns,
        head.compression,
        head.length,
        head.uncompressed_size,
    )


def _sealed(packed: Packed, level: int | None) -> Packed:
    """Return a chunk as it is, or compressed where it is not and should be."""
    if level is None or packed.compression:
        return packed
    (record,) = packed.chunk
    head = chunk_head(bytes(record), ChunkRef(0, len(record), packed.first_ns, packed.last_ns))
    raw = memoryview(record)[head.start : head.start + head.length]
    pieces, compression = seal(raw, packed.first_ns, packed.last_ns, head.crc, level)
    return packed._replace(chunk=pieces, compression=compression, compressed_size=len(pieces[-1]))


def _reencode(messages: Messages, channel_id: int, level: int | None) -> Packed:
    """Lay the messages of one channel into a chunk of its own, under another id."""
    starts = messages.offsets - PREFIX.itemsize
    sizes = messages.sizes + PREFIX.itemsize
    data = np.concatenate([messages.data[i : i + n] for i, n in zip(starts, sizes, strict=True)])
    index = index_of(messages.log, sizes)
    offsets = index[:, 1]
    data[offsets + 9] = channel_id & 0xFF
    data[offsets + 10] = channel_id >> 8
    return pack(data, channel_id, index, level)
