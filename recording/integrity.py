"""Whether a file keeps its own promises: indexes, counts, checksums, times."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from mcap.opcode import Opcode

from .checksum import crc32
from .chunks import (
    ChunkError,
    ChunkRef,
    read_chunk,
    read_index,
    split,
)
from .contents import add_finding
from .errors import Finding

if TYPE_CHECKING:
    from .reader import Recording

_BLOCK = 1 << 20


def structure(rec: Recording) -> list[Finding]:
    """Read every byte of a recording and return where it contradicts itself.

    Parameters
    ----------
    rec : Recording
        The recording; chunks that cannot be read go to its ``findings`` (``bad_chunk``).

    Returns
    -------
    list of Finding
        ``bad_checksum`` (the data section's), ``bad_index`` (a message index or a chunk's times that are not
        those of its messages), ``bad_count`` (the statistics'), ``log_time_order`` (log time decreases within
        a channel), ``published_late`` (publish time after log time: nobody knows a message before it exists).
    """
    findings: list[Finding] = []
    if rec.contents.indexed and not _data_checksum(rec):
        add_finding(findings, "bad_checksum", "the checksum of the data section is wrong")
    last: dict[int, int] = {}
    counts: dict[int, int] = {}
    for ref in rec.chunk_refs(set(rec.contents.channels)):
        _check_chunk(rec, ref, last, counts, findings)
    statistics = rec.contents.statistics
    stated = statistics.channel_message_counts if statistics else counts
    if not any(f.kind == "bad_chunk" for f in rec.findings):
        for id_ in sorted(stated.keys() | counts.keys()):
            if stated.get(id_, 0) != counts.get(id_, 0):
                topic = rec.contents.channels[id_].topic if id_ in rec.contents.channels else f"channel {id_}"
                detail = f"{topic}: {counts.get(id_, 0)} messages, the statistics say {stated.get(id_, 0)}"
                add_finding(findings, "bad_count", detail)
    return findings


def _check_chunk(
    rec: Recording, ref: ChunkRef, last: dict[int, int], counts: dict[int, int], findings: list[Finding]
) -> None:
    try:
        parts = split(read_chunk(rec.file, ref, reuse=True), None)
    except ChunkError as e:
        rec.lost(ref, str(e))
        return
    where = f"chunk at byte {ref.start}"
    for id_, messages in parts.items():
        log = messages.log
        topic = rec.contents.channels[id_].topic if id_ in rec.contents.channels else f"channel {id_}"
        counts[id_] = counts.get(id_, 0) + len(log)
        if (np.diff(log, prepend=last.get(id_, int(log[0]))) < 0).any():
            add_finding(
                findings, "log_time_order", f"{topic}: {where}: log time decreases; tables are sorted by it"
            )
        last[id_] = int(log[-1])
        late = messages.publish > log
        if late.any():
            i = int(np.argmax(late))
            detail = (
                f"{topic}: {where}: published at {messages.publish[i]} ns, logged before that at {log[i]} ns"
            )
            add_finding(findings, "published_late", detail)
    logs = [m.log for m in parts.values()]
    first, final = min(int(v.min()) for v in logs), max(int(v.max()) for v in logs)
    if (first, final) != (ref.first_ns, ref.last_ns):
        add_finding(findings, "bad_index", f"{where}: its times are not those of its messages")
    if ref.index_length:
        try:
            times = read_index(rec.file, ref)
        except ChunkError as e:
            add_finding(findings, "bad_index", f"{where}: {e}")
            return
        same = {k for k, v in times.items() if len(v)} == set(parts) and all(
            np.array_equal(np.sort(times[k]), np.sort(m.log)) for k, m in parts.items()
        )
        if not same:
            add_finding(findings, "bad_index", f"{where}: the message index does not fit its messages")


def _data_checksum(rec: Recording) -> bool:
    """Return whether the data section's checksum, where there is one, is right."""
    footer = rec.file.size - 8 - 29
    summary = int.from_bytes(rec.file.read(footer + 9, 8), "little")
    end = summary or footer
    record = rec.file.read(end - 13, 13)
    if record[:1] != bytes([Opcode.DATA_END]):
        return True  # padding before the summary; nothing can be said
    crc, offset = 0, 0
    while offset < end - 13:
        block = rec.file.read(offset, min(_BLOCK, end - 13 - offset))
        crc = crc32(block, crc)
        offset += len(block)
    return int.from_bytes(record[9:], "little") in (0, crc)
