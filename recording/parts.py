"""Recordings from recordings: a part of one, several joined, one without what tells whose it is."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path

import msgspec
import polars as pl

from .annotations import EVENT
from .changes import HISTORY, Change
from .errors import UsageError
from .events import SIDECAR, TABLE, VOCABULARY
from .files import require_other
from .joins import JoinedPart, cut_history, history_text, joined_history
from .names import free_name
from .provenance import source_file
from .reader import Recording
from .schemas import SCHEMAS
from .selection import Selection, is_drawn, selected_topics
from .writer import Writer

_ORIGIN = re.compile(r"(^|/)(provenance|(cut|export)(_\d+)?|merge/\d+)$")
"""Metadata records that say from which file a recording is, and from when."""
_MERGED = re.compile(r"merge/\d+")
_EVENTS = (TABLE, SIDECAR, HISTORY)
_PRIVATE_KEY = re.compile(
    r"name|serial|\bmac\b|address|user|owner|subject|person|patient|date|birth|host|path|file|source|blake2b|uuid"
    r"|phone|mail|time|wall_clock|start_ms|input_recording|\bby\b",
    re.IGNORECASE,
)
_FIX = "sensor_msgs/msg/NavSatFix"
_OWN_CLOCK = "last_seen_ns"
"""Times of the receiver's own clock: no offset of the recording moves them."""
_ADDRESS = re.compile(r"\b[0-9A-Fa-f]{2}([:-])[0-9A-Fa-f]{2}(\1[0-9A-Fa-f]{2}){4}\b")
"""A hardware address, wherever it stands in a text."""
_FROM = "computed_from"
"""Member of a calibration that names its recordings, with their hashes and dates."""
_RADIO = ("marcha_msgs/msg/RadioSignal", "marcha_msgs/msg/Ranging")


class Anonymized(msgspec.Struct, frozen=True):
    """What was taken out of a recording, and what a person should still look at."""

    removed: list[str]
    left: list[str]


def cut(rec: Recording, out: Path | str, start_ns: int, end_ns: int, *, overwrite: bool = False) -> None:
    """Write the part of a recording from ``start_ns`` to before ``end_ns``; annotations are cut at both.

    Parameters
    ----------
    rec : Recording
        Whole recording.
    out : Path or str
        File to write.
    start_ns, end_ns : int
        Half-open range of log time.
    overwrite : bool
        Whether ``out`` may be replaced.

    Raises
    ------
    UsageError
        There is nothing in that time, or a channel is of a type that cannot be written in part.
    """
    require_other(out, [rec.path])
    chosen = Selection(start_ns=start_ns, end_ns=end_ns)
    topics = [t for t in selected_topics(rec, chosen) if rec.channels[t].schema != EVENT]
    if start_ns > rec.end_ns or end_ns <= rec.start_ns:
        raise UsageError(
            f"{rec.path}: nothing lies between {start_ns} and {end_ns} ns; it goes from {rec.start_ns} to {rec.end_ns}"
        )
    with Writer(out, overwrite=overwrite) as file:
        _copy(file, rec, topics, chosen)
        begins, ends = pl.col("start_ns"), pl.col("end_ns")
        ended = ends.is_between(begins, start_ns, closed="right")  # up to the cut: no instant of the part
        marks = rec.annotations.filter((ends >= start_ns) & (begins < end_ns) & ~ended)
        marks = marks.with_columns(
            pl.col("start_ns").clip(lower_bound=start_ns), pl.col("end_ns").clip(upper_bound=end_ns - 1)
        )
        file.add_annotations(marks)
        _add_history(file, cut_history(rec, marks))
        for name, values in rec.metadata.items():
            file.add_metadata(name, values)
        for attachment in rec.attachments:
            if attachment.name not in _EVENTS:
                file.add_attachment(attachment.name, rec.attachment(attachment.name), attachment.media_type)
        facts = {**_parent(rec), "start_ns": str(start_ns), "end_ns": str(end_ns)}
        file.add_metadata(free_name("cut", set(rec.metadata)), facts)


def merge(
    recs: Sequence[Recording],
    out: Path | str,
    *,
    offsets_ns: Sequence[int] | None = None,
    prefixes: Sequence[str] | None = None,
    overwrite: bool = False,
) -> None:
    """Join recordings into one; each keeps its provenance below its own name.

    Parameters
    ----------
    recs : sequence of Recording
        What is joined.
    out : Path or str
        File to write.
    offsets_ns : sequence of int, optional
        Added to all times of each: zero without it.
    prefixes : sequence of str, optional
        Put before the topics of each: ``/anna`` makes ``/anna/foot/imu``, and ``/estimate/anna_<run>/…`` and
        ``/reference/anna/…`` of estimates and references (:class:`JoinedPart`). Empty without it.
    overwrite : bool
        Whether ``out`` may be replaced.

    Raises
    ------
    UsageError
        A topic would be there twice, or the lists are not as long as ``recs``.
    """
    offsets = list(offsets_ns or [0] * len(recs))
    starts = list(prefixes or [""] * len(recs))
    if len(recs) < 2 or len(offsets) != len(recs) or len(starts) != len(recs):
        raise UsageError(
            f"merge: {len(recs)} recordings, {len(offsets)} offsets, {len(starts)} prefixes: "
            "as many of each, two at least"
        )
    require_other(out, [rec.path for rec in recs])
    seen: dict[str, Path] = {}
    for rec, start in zip(recs, starts, strict=True):
        for topic, channel in rec.channels.items():
            name = start + topic
            if channel.schema != EVENT and name in seen and not is_drawn(rec, topic):
                raise UsageError(f"{rec.path}: {name}: is in {seen[name]} too; give each its --prefix")
            seen[name] = rec.path
    with Writer(out, overwrite=overwrite) as file:
        ids: set[str] = set()
        taken: set[str] = set()
        places: list[JoinedPart] = []
        vocabularies: dict[str, set[str]] = {}
        for number, (rec, offset, start) in enumerate(zip(recs, offsets, starts, strict=True), 1):
            name = free_name(rec.path.stem, taken)
            place = JoinedPart(rec, start, offset, name, ids)
            places.append(place)
            topics = [t for t in selected_topics(rec, Selection()) if rec.channels[t].schema != EVENT]
            _copy(file, rec, topics, Selection(), place)
            file.add_annotations(place.marks())
            for tier, words in rec.metadata.get(VOCABULARY, {}).items():
                vocabularies.setdefault(place.tier(tier), set()).add(words)
            for key, values in rec.metadata.items():
                file.add_metadata(*place.record(key, values))
            for attachment in rec.attachments:
                if attachment.name not in _EVENTS:
                    data = rec.attachment(attachment.name)
                    file.add_attachment(f"{name}/{attachment.name}", data, attachment.media_type)
            facts = {**_parent(rec), "offset_ns": str(offset), "prefix": start, "records": name}
            file.add_metadata(f"merge/{number}", facts)
        agreed = {tier: words.pop() for tier, words in vocabularies.items() if len(words) == 1}
        if agreed:  # what two recordings say differently stays below their names alone
            file.add_metadata(VOCABULARY, agreed)
        _add_history(file, joined_history(places))


def anonymize(
    rec: Recording, out: Path | str, *, keep_fixes: bool = False, overwrite: bool = False
) -> Anonymized:
    """Write a recording without names, serials, dates and fixes; return what went and what is left.

    Times begin at 0. Hardware addresses are numbered. Attachments, the list of changes, names behind sources
    and notes go; labels stay and are listed, as is every text of the metadata that is left.

    Parameters
    ----------
    rec : Recording
        What is to be handed on.
    out : Path or str
        File to write.
    keep_fixes : bool
        Whether fixes stay.
    overwrite : bool
        Whether ``out`` may be replaced.
    """
    require_other(out, [rec.path])
    removed, left = [f"dates: times begin at 0 instead of {rec.start_ns} ns"], []
    addresses: dict[str, str] = {}
    topics = []
    for topic, channel in rec.channels.items():
        if channel.schema == EVENT or is_drawn(rec, topic):
            continue
        if channel.schema == _FIX and not keep_fixes:
            removed.append(f"{topic}: {channel.count} fixes")
        elif channel.schema not in SCHEMAS:
            removed.append(f"{topic}: {channel.schema} is not known")
        else:
            topics.append(topic)
            left.append(f"topic {topic}" + (f", frame {channel.frame_id}" if channel.frame_id else ""))
            left += _texts_of(rec, topic)
            if _OWN_CLOCK in channel.columns:
                removed.append(f"{topic}: {_OWN_CLOCK}, times of the receiver's own clock")
            for key, value in channel.metadata.items():
                if _is_private(key):
                    removed.append(f"channel {topic}: {key}")
                else:
                    left.append(f"channel {topic}: {key} = {_numbered(value, addresses)}")
    with Writer(out, overwrite=overwrite) as file:
        _copy(file, rec, topics, Selection(), JoinedPart(rec, "", -rec.start_ns, "", set()), addresses)
        marks = rec.annotations
        source = pl.when(pl.col("source").str.starts_with("human")).then(pl.lit("human")).otherwise("source")
        file.add_annotations(
            marks.with_columns(
                pl.col("start_ns", "end_ns") - rec.start_ns,
                source=source,
                note=pl.lit(None, pl.String),
                metadata=pl.lit("{}"),
                id=pl.lit(None, pl.String),
            )
        )
        if marks.height:
            removed.append(f"notes, metadata, ids and annotators of {marks.height} annotations")
            for column in ("tier", "label", "channel"):
                texts = marks[column].drop_nulls().unique(maintain_order=True).to_list()
                left += [f"{column} {text!r}" for text in texts if text]
        files = _merged_names(rec)
        for record, values in rec.metadata.items():
            first, slash, rest = record.partition("/")
            name = f"{files[first]}/{rest}" if slash and first in files else record
            kept = {k: v for k, v in values.items() if not (_is_private(k) or _ORIGIN.search(name))}
            for key, value in kept.items():
                whole = _without_origin(value)
                removed += [f"metadata {record}: {key}: {_FROM}"] if whole != value else []
                kept[key] = _numbered(whole, addresses)
            if "records" in kept:  # of a run in a joined recording
                kept["records"] = files.get(kept["records"], kept["records"])
            removed += [f"metadata {record}: {k}" for k in values if k not in kept]
            left += [f"metadata {name}: {k} = {v}" for k, v in kept.items()]
            if kept:
                file.add_metadata(name, kept)
        removed += [f"attachment {a.name}" for a in rec.attachments]
        if addresses:
            removed.append(f"{len(addresses)} hardware addresses: numbered")
    return Anonymized(removed, left)


def _merged_names(rec: Recording) -> dict[str, str]:
    """Return what a merge put before the names of records, names of files, and ``part1``… instead."""
    return {
        values.get("records", Path(values.get("source", "")).stem): f"part{name.partition('/')[2]}"
        for name, values in rec.metadata.items()
        if _MERGED.fullmatch(name)
    }


def _texts_of(rec: Recording, topic: str) -> list[str]:
    """Return the names and texts that a channel's rows hold: joints, markers, frames."""
    schema = SCHEMAS[rec.channels[topic].schema]
    if schema.names:
        return [f"column {topic}: {name}" for name in rec.channels[topic].columns]
    return [
        f"text {topic}: {column.name} = {text}"
        for column in schema.columns
        if column.kind == "text"
        for text in rec.table(topic)[column.name].unique(maintain_order=True).to_list()
    ]


def _is_private(key: str) -> bool:
    return _PRIVATE_KEY.search(key) is not None


def _copy(
    file: Writer,
    rec: Recording,
    topics: Sequence[str],
    chosen: Selection,
    place: JoinedPart | None = None,
    addresses: dict[str, str] | None = None,
) -> None:
    """Copy rows of channels, with the times and names of a place, with numbers for hardware addresses."""
    place = place or JoinedPart(rec, "", 0, "", set())
    for topic in topics:
        about = rec.channels[topic]
        if about.schema not in SCHEMAS:
            raise UsageError(
                f"{rec.path}: {topic}: type {about.schema} cannot be written; leave the channel out"
            )
        metadata = {k: v for k, v in about.metadata.items() if addresses is None or not _is_private(k)}
        metadata = place.channel_metadata(metadata)
        if addresses is not None:
            metadata = {k: _numbered(v, addresses) for k, v in metadata.items()}
        columns = [c for c in about.columns if addresses is None or c != _OWN_CLOCK]
        file.add_channel(place.topic(topic), about.schema, about.frame_id, columns, metadata)
    for window in rec.windows(topics, start_ns=chosen.start_ns, end_ns=chosen.end_ns):
        for topic, table in window.tables.items():
            if addresses is not None:
                table = table.drop(_OWN_CLOCK, strict=False)
            if place.offset_ns:
                times = [c.name for c in SCHEMAS[rec.channels[topic].schema].columns if c.kind == "time"]
                moved = {"t_ns", "t_log_ns", *times} - {_OWN_CLOCK}
                table = table.with_columns(pl.col([c for c in table.columns if c in moved]) + place.offset_ns)
            if addresses is not None and rec.channels[topic].schema in _RADIO:
                for mac in table["mac"].unique(maintain_order=True).to_list():
                    _number(mac, addresses)
                table = table.with_columns(pl.col("mac").replace(addresses))
            file.add_table(place.topic(topic), rec.channels[topic].schema, table)


def _without_origin(text: str) -> str:
    """Return a calibration written as JSON without what it was computed from; any other text as it is."""
    if f'"{_FROM}"' not in text:
        return text
    try:
        value = json.loads(text)
    except ValueError:
        return text
    kept = {k: [] if k == _FROM else v for k, v in value.items()} if isinstance(value, dict) else value
    return json.dumps(kept, ensure_ascii=False)


def _number(address: str, addresses: dict[str, str]) -> str:
    """Return the number that stands for a hardware address, written as one."""
    digits = f"{len(addresses):012x}"
    return addresses.setdefault(address, ":".join(digits[k : k + 2] for k in range(0, 12, 2)))


def _numbered(text: str, addresses: dict[str, str]) -> str:
    """Return a text with numbers for the hardware addresses in it, but for those that are numbers already."""
    return _ADDRESS.sub(lambda m: m[0] if m[0] in addresses.values() else _number(m[0], addresses), text)


def _add_history(file: Writer, changes: list[Change]) -> None:
    """Attach the list of changes where there is one, and then the table of annotations too."""
    if changes:
        file.attach_events()
        file.add_attachment(HISTORY, history_text(changes), "application/jsonl")


def _parent(rec: Recording) -> dict[str, str]:
    source = source_file(rec.path)
    return {"source": source.name, "source_size": str(source.size), "source_blake2b": source.blake2b}
