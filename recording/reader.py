"""Reading recordings: topic and time selection, columns, windows and messages in log-time order."""

from __future__ import annotations

import heapq
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from io import BytesIO
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import polars as pl
from mcap import records
from mcap.data_stream import ReadDataStream

from .annotations import (
    COLUMNS,
    EVENT,
    TOPIC,
    EventDecoder,
    identified,
)
from .cdr import CdrError
from .chunks import (
    BROKEN,
    ChunkError,
    ChunkRef,
    FileReader,
    read_chunk,
    read_index,
    split,
)
from .codec import Columns, Messages
from .contents import add_finding, find_contents
from .decoder import Decoder
from .definitions import load, long_name, parse_full
from .encoder import Encoder
from .errors import Finding, MarchaError, UsageError
from .model import Attachment, Channel, RecordedMessage, Window
from .schemas import SCHEMAS, Schema, declared_columns
from .windows import TIME_TYPES, OrderedPool, between, complete, cut, joined, messages_of
from .writer import RESERVED


@dataclass
class TopicSource:
    """What is needed to decode one topic."""

    topic: str
    ids: list[int]
    schema: str
    metadata: dict[str, str]
    decoder: Decoder | EventDecoder | None = None
    declared: tuple[str, ...] | None = None


class Recording:
    """A recording opened for reading; see :func:`marcha.recording.open`.

    Attributes
    ----------
    path : pathlib.Path
        The file.
    findings : list of Finding
        What could not be read and was left out; grows while damaged chunks are met.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self.file = FileReader(self.path)
        try:
            self.contents = find_contents(self.file)
        except BaseException:
            self.file.close()
            raise
        self.findings: list[Finding] = self.contents.findings
        self._bad: set[int] = set()
        self.sources = self._make_sources()
        self._tables: dict[str, pl.DataFrame] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self.file.close()

    # ------------------------------------------------------------------------------------ what is inside

    @property
    def start_ns(self) -> int:
        """Log time of the first message (0 in an empty recording)."""
        return min((c.first_ns for c in self.contents.chunks), default=0)

    @property
    def end_ns(self) -> int:
        """Log time of the last message (0 in an empty recording)."""
        return max((c.last_ns for c in self.contents.chunks), default=0)

    @property
    def duration_s(self) -> float:
        """Seconds from the first message to the last."""
        return (self.end_ns - self.start_ns) * 1e-9

    @property
    def profile(self) -> str:
        """Profile of the MCAP header (``ros2``)."""
        return self.contents.profile

    @property
    def library(self) -> str:
        """Program that wrote the file."""
        return self.contents.library

    @cached_property
    def channels(self) -> dict[str, Channel]:
        """All channels by topic, in the order of their ids."""
        spans = self._spans()
        return {t: self._describe(s, spans) for t, s in self.sources.items()}

    @cached_property
    def metadata(self) -> dict[str, dict[str, str]]:
        """Metadata records: name to its keys and values."""
        out: dict[str, dict[str, str]] = {}
        for index in self.contents.metadata:
            try:
                record = records.Metadata.read(self._stream(index.offset, index.length))
            except BROKEN as e:
                add_finding(self.findings, "bad_metadata", f"{index.name}: {e or type(e).__name__}; left out")
                continue
            out.setdefault(record.name, {}).update(record.metadata)
        return out

    @cached_property
    def attachments(self) -> list[Attachment]:
        """Attached files, without their contents."""
        return [Attachment(a.name, a.media_type, a.data_size) for a in self.contents.attachments]

    def attachment(self, name: str) -> bytes:
        """Return the contents of an attachment.

        Raises
        ------
        UsageError
            There is none of this name.
        MarchaError
            Its record is broken.
        """
        for index in self.contents.attachments:
            if index.name == name:
                try:
                    record = records.Attachment.read(self._stream(index.offset, index.length))
                except BROKEN as e:
                    raise MarchaError(f"{self.path}: attachment {name!r}: {e or type(e).__name__}") from None
                return record.data
        names = ", ".join(a.name for a in self.attachments) or "none"
        raise UsageError(f"{self.path}: no attachment {name!r}; there are: {names}")

    @cached_property
    def annotations(self) -> pl.DataFrame:
        """Annotations by start time: the columns of :data:`marcha.recording.annotations.COLUMNS`."""
        return identified(self.stored_annotations)

    @cached_property
    def stored_annotations(self) -> pl.DataFrame:
        """The same as the file has them: those without an id stay without one."""
        parts = [
            self.table(s.topic).select(pl.lit(s.topic.removeprefix(TOPIC)).alias("tier"), *list(COLUMNS)[1:])
            for s in self.sources.values()
            if isinstance(s.decoder, EventDecoder)
        ]
        table = pl.concat([pl.DataFrame(schema=COLUMNS), *parts]).sort("start_ns", maintain_order=True)
        return table.with_columns(id=pl.when(pl.col("id").is_first_distinct()).then("id"))

    @property
    def data_span(self) -> tuple[int, int] | None:
        """Log time of the first and last message that is no annotation; None where there is none."""
        spans = [
            (c.start_ns, c.end_ns)
            for t, c in self.channels.items()
            if not isinstance(self.sources[t].decoder, EventDecoder)
            and c.start_ns is not None
            and c.end_ns is not None
        ]
        return (min(a for a, _ in spans), max(b for _, b in spans)) if spans else None

    # ------------------------------------------------------------------------------------------------ reading

    def table(
        self, topic: str, start_ns: int | None = None, end_ns: int | None = None, log_time: bool = False
    ) -> pl.DataFrame:
        """Return a channel as a table.

        Parameters
        ----------
        topic : str
            A key of :attr:`channels`.
        start_ns, end_ns : int, optional
            Half-open range of log time.
        log_time : bool
            Whether to add ``t_log_ns``, when each message was known.

        Returns
        -------
        polars.DataFrame
            ``t_ns`` (Int64, the time a row speaks of), then the channel's columns, in log-time order.

        Raises
        ------
        UsageError
            No such topic.
        MarchaError
            The messages are of a kind that marcha cannot read.
        """
        source = self._source(topic)
        refs = self.chunk_refs(set(source.ids), start_ns, end_ns)
        parts: list[Columns] = []
        with OrderedPool(len(refs)) as pool:
            for decoded in pool.map(lambda ref: self._decode(ref, [source], start_ns, end_ns), refs):
                parts += [columns for _, columns in decoded]
        table = joined(parts) if parts else self._empty(source)
        return table if log_time else table.drop("t_log_ns")

    def windows(
        self,
        topics: Collection[str] | None = None,
        start_ns: int | None = None,
        end_ns: int | None = None,
        max_rows: int = 65536,
        ahead: bool = True,
    ) -> Iterator[Window]:
        """Yield the recording in stretches of log time, disjoint and in order.

        Memory holds about ``max_rows`` rows and one chunk a channel, whatever the length of the recording.

        Parameters
        ----------
        topics : collection of str, optional
            Channels to read, default all that can be read, annotations apart.
        start_ns, end_ns : int, optional
            Half-open range of log time.
        max_rows : int
            Rows of all channels together in a window; more only where that many share one log time.
        ahead : bool
            Have threads read the next chunks meanwhile. Without it the caller's thread does all, which takes
            less processor time in all.

        Yields
        ------
        Window
        """
        sources = self._select(topics)
        ids = {i for s in sources for i in s.ids}
        refs = sorted(self.chunk_refs(ids, start_ns, end_ns), key=lambda r: (r.first_ns, r.start))
        held: dict[str, list[Columns]] = {s.topic: [] for s in sources}
        with OrderedPool(len(refs) if ahead else 0) as pool:
            decoded = pool.map(lambda ref: self._decode(ref, sources, start_ns, end_ns), refs)
            for i, parts in enumerate(decoded):
                for topic, columns in parts:
                    held[topic].append(columns)
                horizon = refs[i + 1].first_ns if i + 1 < len(refs) else None
                if horizon is None or complete(held, horizon) >= max_rows:
                    yield from cut(held, horizon, max_rows)

    def messages(
        self, topics: Collection[str] | None = None, start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[RecordedMessage]:
        """Yield every message in log-time order, ties by channel order; see :meth:`windows`."""
        order = {t: i for i, t in enumerate(self.sources)}
        for window in self.windows(topics, start_ns, end_ns):
            streams = [
                messages_of(topic, order[topic], table)
                for topic, table in sorted(window.tables.items(), key=lambda t: order[t[0]])
            ]
            for *_, message in heapq.merge(*streams, key=lambda m: m[:3]):
                yield message

    # ------------------------------------------------------------------------------------------------ inside

    def _stream(self, start: int, length: int) -> ReadDataStream:
        return ReadDataStream(BytesIO(self.file.read(start + 9, length - 9)))

    def _make_sources(self) -> dict[str, TopicSource]:
        out: dict[str, TopicSource] = {}
        for id_, channel in sorted(self.contents.channels.items()):
            record = self.contents.schemas.get(channel.schema_id)
            name = long_name(record.name) if record else ""
            topic = channel.topic
            if topic in out:
                if out[topic].schema == name and out[topic].metadata == dict(channel.metadata):
                    out[topic].ids.append(id_)
                    continue
                topic = f"{channel.topic}#{id_}"
                add_finding(
                    self.findings, "duplicate_topic", f"{channel.topic}: several channels; read as {topic}"
                )
            source = TopicSource(topic, [id_], name, dict(channel.metadata))
            out[topic] = source
            try:
                source.decoder = self._make_decoder(source, channel, record)
            except (MarchaError, CdrError, UnicodeDecodeError) as e:
                add_finding(self.findings, "unreadable_channel", f"{topic}: {e}; listed, not read")
        return out

    def _make_decoder(
        self, source: TopicSource, channel: records.Channel, record: records.Schema | None
    ) -> Decoder | EventDecoder:
        if channel.message_encoding != "cdr":
            raise MarchaError(f"message encoding {channel.message_encoding!r}, only cdr is read")
        ours_of: Schema | None = SCHEMAS.get(source.schema)
        if record is None or (record.encoding != "ros2msg" and ours_of is None and source.schema != EVENT):
            raise MarchaError(
                f"schema encoding {record.encoding if record else 'none'!r}, only ros2msg is read"
            )
        if record.encoding == "ros2msg":
            library = parse_full(record.name, record.data.decode())
            ours = load(source.schema) if ours_of else {}
            if ours_of and any(
                library.get(k) is None or library[k].fields != d.fields for k, d in ours.items()
            ):
                ours_of = None  # somebody's own message of the same name: take it as it is
        else:
            library = load(source.schema)
        if source.schema == EVENT and library == load(EVENT):
            source.declared = tuple(COLUMNS)[1:]
            return EventDecoder(library)
        text = source.metadata.get("columns")
        if ours_of is not None and text is not None and "frame_id" in source.metadata:
            source.declared = declared_columns(ours_of, text)
        return Decoder(ours_of, library, source.declared)

    def _source(self, topic: str) -> TopicSource:
        source = self.sources.get(topic)
        if source is None:
            topics = ", ".join(self.sources) or "none"
            raise UsageError(f"{self.path}: no topic {topic!r}; there are: {topics}")
        if source.decoder is None:
            raise MarchaError(
                f"{self.path}: {topic}: messages of type {source.schema or 'unknown'} cannot be read"
            )
        return source

    def _select(self, topics: Collection[str] | None) -> list[TopicSource]:
        if topics is None:
            return [s for s in self.sources.values() if isinstance(s.decoder, Decoder)]
        wanted = set([topics] if isinstance(topics, str) else topics)
        for topic in sorted(wanted):
            self._source(topic)
        return [s for t, s in self.sources.items() if t in wanted]

    def chunk_refs(
        self, ids: set[int], start_ns: int | None = None, end_ns: int | None = None
    ) -> list[ChunkRef]:
        """Return the chunks that may hold messages of these channels in a range of log time."""
        return [
            c
            for c in self.contents.chunks
            if (not c.indexes or ids.intersection(c.indexes))
            and (start_ns is None or c.last_ns >= start_ns)
            and (end_ns is None or c.first_ns < end_ns)
        ]

    def _decode(
        self, ref: ChunkRef, sources: Sequence[TopicSource], start_ns: int | None, end_ns: int | None
    ) -> list[tuple[str, Columns]]:
        """Return topic and columns of the rows in one chunk; a broken chunk gives none and a finding."""
        topic_of = {i: s for s in sources for i in s.ids}
        try:
            parts = split(read_chunk(self.file, ref, reuse=True), topic_of)  # a table holds copies
        except ChunkError as e:
            self.lost(ref, str(e))
            return []
        out: list[tuple[str, Columns]] = []
        for id_, messages in sorted(parts.items()):
            source = topic_of[id_]
            keep = between(messages, start_ns, end_ns)
            if keep is not None:
                messages = messages.take(keep)
            if not len(messages.log):
                continue
            assert source.decoder is not None
            try:
                columns = source.decoder.decode_columns(messages)
            except CdrError as e:
                self.lost(ref, f"{source.topic}: chunk at byte {ref.start}: {e}")
                continue
            if len(columns["t_ns"]):
                out.append((source.topic, columns))
        return out

    def lost(self, ref: ChunkRef, detail: str) -> None:
        """Note that a chunk could not be read."""
        if ref.start not in self._bad:
            self._bad.add(ref.start)
            add_finding(self.findings, "bad_chunk", f"{detail}; skipped")

    def _empty(self, source: TopicSource) -> pl.DataFrame:
        """Return a table without rows, its columns of the types that rows would have."""
        if isinstance(source.decoder, EventDecoder):
            return source.decoder.decode(_nothing(b""))
        channel = self.channels[source.topic]
        self._source(source.topic)  # to describe a channel may have shown that it cannot be read
        if channel.count and (first := self._first(source)) is not None:
            return first[0].clear()
        schema = source.decoder.schema if source.decoder is not None else None
        columns = channel.columns or (schema.needed if schema is not None else ())
        if source.decoder is None or schema is None or not columns:
            return pl.DataFrame(schema=TIME_TYPES)
        encoder = Encoder(schema, columns, channel.frame_id, channel.topic, 0)
        return source.decoder.decode(_nothing(encoder.blank())).clear()

    def _describe(self, source: TopicSource, spans: dict[int, tuple[int, int, int]]) -> Channel:
        here = [spans[i] for i in source.ids if i in spans]
        count = sum(s[0] for s in here)
        columns, frame_id = source.declared or (), source.metadata.get("frame_id", "")
        if source.declared is None and source.decoder is not None and count:
            first = self._first(source)
            columns, frame_id = ((), "") if first is None else (tuple(first[0].columns[2:]), first[1])
        elif source.declared is None and isinstance(source.decoder, Decoder) and source.decoder.schema:
            columns = source.decoder.schema.needed  # without a message nothing says more
        return Channel(
            source.topic,
            source.schema,
            frame_id,
            columns,
            count,
            min((s[1] for s in here), default=None),
            max((s[2] for s in here), default=None),
            {k: v for k, v in source.metadata.items() if k not in RESERVED},
        )

    def _first(self, source: TopicSource) -> tuple[pl.DataFrame, str] | None:
        """Return the first readable message of a channel as a row, and its frame id."""
        for ref in self.chunk_refs(set(source.ids)):
            try:
                parts = split(read_chunk(self.file, ref), source.ids)
            except ChunkError as e:
                self.lost(ref, str(e))
                continue
            for messages in parts.values():
                assert source.decoder is not None
                try:
                    row = source.decoder.decode(messages.take(slice(0, 1)))
                    return row, source.decoder.frame_id(messages.message(0))
                except CdrError as e:
                    add_finding(self.findings, "unreadable_channel", f"{source.topic}: {e}; listed, not read")
                    source.decoder = None
                    return None
        return None

    def _spans(self) -> dict[int, tuple[int, int, int]]:
        """Return count, first and last log time of every channel id that has messages."""
        counts: dict[int, int] = {}
        times: dict[int, tuple[int, int]] = {}
        statistics = self.contents.statistics
        stated = statistics.channel_message_counts if statistics is not None else {}
        for ref in self.contents.chunks:
            if len(ref.indexes) == 1 and ref.indexes.keys() <= stated.keys():
                spans = dict.fromkeys(ref.indexes, (ref.first_ns, ref.last_ns))
            else:
                logs = {k: log for k, log in self._times(ref).items() if len(log)}
                spans = {k: (int(log.min()), int(log.max())) for k, log in logs.items()}
                for k, log in logs.items():
                    counts[k] = counts.get(k, 0) + len(log)
            for id_, (first, last) in spans.items():
                old = times.get(id_, (first, last))
                times[id_] = min(old[0], first), max(old[1], last)
        counts |= stated
        return {i: (counts.get(i, 0), *span) for i, span in times.items()}

    def _times(self, ref: ChunkRef) -> dict[int, Any]:
        if ref.index_length and not ref.loose:
            try:
                times = read_index(self.file, ref)
            except ChunkError:
                times = {}
            if times:
                return times
        try:
            return {k: m.log for k, m in split(read_chunk(self.file, ref), None).items()}
        except ChunkError as e:
            self.lost(ref, str(e))
            return {}


def _nothing(message: bytes) -> Messages:
    """Return one message at time 0, or none where it is empty."""
    zeros = np.zeros(min(1, len(message)), np.int64)
    return Messages(np.frombuffer(message, "u1"), zeros, zeros + len(message), zeros, zeros)
