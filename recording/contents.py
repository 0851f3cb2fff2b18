"""What a file holds: found through its summary, or by scanning it where that cannot be trusted."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass, field
from io import BytesIO

import numpy as np
from mcap.data_stream import ReadDataStream
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

from .checksum import crc32
from .chunks import BROKEN, LAST_NS, ChunkError, ChunkRef, FileReader, read_chunk, split
from .codec import PREFIX, RECORD_HEAD
from .errors import Finding, MarchaError

_RUN = 1 << 20
"""Bytes of loose messages (a file without chunks) that are taken together."""


UNINDEXED = "the summary has no chunk index"
"""Why a sound file is read from its start."""


_FOOTER_SIZE = 9 + 20


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
        raise MarchaError(
            f"{path}: not an MCAP recording{short}: it begins with {magic.hex(' ')}; `marcha convert` makes one "
            "of a raw log"
        )
    stated: Statistics | None = None
    try:
        contents = _summary(file)
    except BROKEN as e:
        reason = str(e) or type(e).__name__
    else:
        if contents is not None and _indexes_all(contents):
            contents.chunks.sort(key=lambda c: c.start)
            _read_header(file, contents)
            return contents
        reason = UNINDEXED
        stated = contents.statistics if contents is not None else None
    scanned = _scan(file, reason)
    count = scanned.statistics.message_count if scanned.statistics is not None else 0
    if stated is not None and stated.message_count > count and not scanned.findings:
        lost = stated.message_count - count
        _add(
            scanned.findings,
            "lost_messages",
            f"the file tells of {stated.message_count}, {lost} are not there",
        )
    return scanned


def _summary(file: FileReader) -> Contents | None:
    """Return what the summary says, None where there is none; ValueError where it cannot be trusted."""
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
    if any(c.last_ns > LAST_NS or c.start + c.length > file.size for c in contents.chunks):
        raise ValueError("the summary tells of chunks outside the file, or of times beyond the year 2262")
    return contents


def _indexes_all(contents: Contents) -> bool:
    """Whether a summary leads to everything that it counts."""
    statistics = contents.statistics
    return (
        statistics is not None
        and statistics.chunk_count == len(contents.chunks)
        and (not statistics.message_count or bool(contents.chunks))
        and len(contents.channels) == statistics.channel_count
        and len(contents.metadata) == statistics.metadata_count
        and len(contents.attachments) == statistics.attachment_count
    )


def _read_header(file: FileReader, contents: Contents) -> None:
    opcode, length = RECORD_HEAD.unpack(file.read(8, 9))
    if opcode == Opcode.HEADER:
        with contextlib.suppress(*BROKEN):  # nothing that is read depends on it
            header = Header.read(ReadDataStream(BytesIO(file.read(17, length))))
            contents.profile, contents.library = header.profile, header.library


def _scan(file: FileReader, reason: str) -> Contents:
    """Walk the records from the start, keep whole and sound chunks, stop where the bytes make no sense."""
    contents = Contents(indexed=False)
    counts: dict[int, int] = {}
    offset, ended, run = 8, False, None
    while offset + 9 <= file.size:
        opcode, length = RECORD_HEAD.unpack(file.read(offset, 9))
        body, end = offset + 9, offset + 9 + length
        if end > file.size:
            break
        if opcode != Opcode.MESSAGE:
            run = None
        try:
            if opcode == Opcode.DATA_END or opcode == Opcode.FOOTER:
                ended = True
                break
            if opcode == Opcode.CHUNK:
                _scan_chunk(file, ChunkRef(offset, end - offset, 0, 0), contents, counts)
            elif opcode == Opcode.MESSAGE:
                run = _scan_message(file, offset, end, run, contents, counts)
            elif opcode == Opcode.MESSAGE_INDEX and contents.chunks:
                chunk = contents.chunks[-1]
                if not chunk.loose and chunk.start + chunk.length + chunk.index_length == offset:
                    chunk.index_length += end - offset
            elif opcode in (Opcode.HEADER, Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA):
                _scan_record(opcode, offset, file.read(body, length), contents)
            elif opcode == Opcode.ATTACHMENT:
                _scan_attachment(file, offset, length, contents)
            elif opcode == 0:
                break
        except BROKEN as e:
            _add(contents.findings, "bad_record", f"byte {offset}: {e or type(e).__name__}; skipped")
            run = None
        offset = end
    if not ended:
        _add(
            contents.findings,
            "truncated",
            f"{reason}: cut short at byte {offset} of {file.size}; read up to the last whole chunk",
        )
    elif reason != UNINDEXED:
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
        parts = split(data, None, lambda opcode, body: _scan_record(opcode, 0, body, contents))
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
    file: FileReader, offset: int, end: int, run: ChunkRef | None, contents: Contents, counts: dict[int, int]
) -> ChunkRef:
    head = np.frombuffer(file.read(offset, PREFIX.itemsize), PREFIX)[0]
    channel, log = int(head["channel"]), int(head["log"])
    if max(log, int(head["publish"])) > LAST_NS:
        raise ValueError("a message at a time beyond the year 2262")
    if run is None or run.length + end - offset > _RUN:
        run = ChunkRef(offset, 0, log, log, loose=True)
        contents.chunks.append(run)
    run.length += end - offset
    run.first_ns, run.last_ns = min(run.first_ns, log), max(run.last_ns, log)
    run.indexes[channel] = 0
    counts[channel] = counts.get(channel, 0) + 1
    return run


def _scan_record(opcode: int, offset: int, body: bytes, contents: Contents) -> None:
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
        contents.metadata.append(MetadataIndex(offset, 9 + len(body), stream.read_prefixed_string()))


def _scan_attachment(file: FileReader, offset: int, length: int, contents: Contents) -> None:
    stream = ReadDataStream(BytesIO(file.read(offset + 9, min(length, 1 << 16))))
    log, created = stream.read8(), stream.read8()
    name, media = stream.read_prefixed_string(), stream.read_prefixed_string()
    size = stream.read8()
    contents.attachments.append(AttachmentIndex(offset, 9 + length, log, created, size, name, media))
