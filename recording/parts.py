"""Recordings from recordings: a part of one, several joined, one without what tells whose it is."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import msgspec
import polars as pl

from .annotations import EVENT
from .changes import HISTORY
from .errors import UsageError
from .events import SIDECAR, TABLE
from .provenance import source_file
from .reader import Recording
from .schemas import SCHEMAS
from .selection import Selection, selected_topics
from .writer import Writer

_EVENTS = (TABLE, SIDECAR, HISTORY)
_PRIVATE_KEY = re.compile(
    r"name|serial|\bmac\b|address|user|owner|subject|person|patient|date|birth|host|path|file|source|blake2b|uuid"
    r"|phone|mail|time|wall_clock|start_ms|input_recording|\bby\b",
    re.IGNORECASE,
)
_FIX = "sensor_msgs/msg/NavSatFix"
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
    chosen = Selection(start_ns=start_ns, end_ns=end_ns)
    topics = [t for t in selected_topics(rec, chosen) if rec.channels[t].schema != EVENT]
    if start_ns > rec.end_ns or end_ns <= rec.start_ns:
        raise UsageError(
            f"{rec.path}: nothing lies between {start_ns} and {end_ns} ns; it goes from {rec.start_ns} to {rec.end_ns}"
        )
    with Writer(out, overwrite=overwrite) as file:
        _copy(file, rec, topics, chosen)
        marks = rec.annotations.filter((pl.col("end_ns") >= start_ns) & (pl.col("start_ns") < end_ns))
        file.add_annotations(
            marks.with_columns(
                pl.col("start_ns").clip(lower_bound=start_ns), pl.col("end_ns").clip(upper_bound=end_ns - 1)
            )
        )
        for name, values in rec.metadata.items():
            file.add_metadata(name, values)
        for attachment in rec.attachments:
            if attachment.name not in _EVENTS:
                file.add_attachment(attachment.name, rec.attachment(attachment.name), attachment.media_type)
        facts = {**_parent(rec), "start_ns": str(start_ns), "end_ns": str(end_ns)}
        file.add_metadata(_free("cut", rec.metadata), facts)


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
        Put before the topics of each: ``/anna`` makes ``/anna/foot/imu``. Empty without it.
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
    seen: dict[str, Path] = {}
    for rec, start in zip(recs, starts, strict=True):
        for topic, channel in rec.channels.items():
            name = start + topic
            if channel.schema != EVENT and name in seen:
                raise UsageError(f"{rec.path}: {name}: is in {seen[name]} too; give each its --prefix")
            seen[name] = rec.path
    with Writer(out, overwrite=overwrite) as file:
        ids: set[str] = set()
        taken: set[str] = set()
        for number, (rec, offset, start) in enumerate(zip(recs, offsets, starts, strict=True), 1):
            topics = [t for t, c in rec.channels.items() if c.schema != EVENT]
            _copy(file, rec, topics, Selection(), offset, start)
            marks = rec.annotations.with_columns(
                pl.col("start_ns", "end_ns") + offset,
                id=pl.when(~pl.col("id").is_in(list(ids))).then("id"),
                tier=pl.concat_str(pl.lit(f"{start.strip('/')}/" if start else ""), "tier"),
            )
            ids |= set(marks["id"].drop_nulls())
            file.add_annotations(marks)
            name = _free(rec.path.stem, taken)
            taken.add(name)
            for key, values in rec.metadata.items():
                file.add_metadata(f"{name}/{key}", values)
            for attachment in rec.attachments:
                if attachment.name not in _EVENTS:
                    data = rec.attachment(attachment.name)
                    file.add_attachment(f"{name}/{attachment.name}", data, attachment.media_type)
            facts = {**_parent(rec), "offset_ns": str(offset), "prefix": start}
            file.add_metadata(f"merge/{number}", facts)


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
    removed, left = [f"dates: times begin at 0 instead of {rec.start_ns} ns"], []
    topics = []
    for topic, channel in rec.channels.items():
        if channel.schema == EVENT:
            continue
        if channel.schema == _FIX and not keep_fixes:
            removed.append(f"{topic}: {channel.count} fixes")
        elif channel.schema not in SCHEMAS:
            removed.append(f"{topic}: {channel.schema} is not known")
        else:
            topics.append(topic)
            left.append(f"topic {topic}" + (f", frame {channel.frame_id}" if channel.frame_id else ""))
            left += [f"channel {topic}: {k} = {v}" for k, v in channel.metadata.items() if not _is_private(k)]
    with Writer(out, overwrite=overwrite) as file:
        addresses: dict[str, str] = {}
        _copy(file, rec, topics, Selection(), -rec.start_ns, "", addresses)
        if addresses:
            removed.append(f"{len(addresses)} hardware addresses: numbered")
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
            left += [f"label {label!r}" for label in marks["label"].unique(maintain_order=True).to_list()]
        for name, values in rec.metadata.items():
            kept = {
                k: v
                for k, v in values.items()
                if not _is_private(k) and name not in ("provenance", "cut") and not name.startswith("merge/")
            }
            removed += [f"metadata {name}: {k}" for k in values if k not in kept]
            left += [f"metadata {name}: {k} = {v[:80]}" for k, v in kept.items()]
            if kept:
                file.add_metadata(name, kept)
        removed += [f"attachment {a.name}" for a in rec.attachments]
    return Anonymized(removed, left)


def _is_private(key: str) -> bool:
    return _PRIVATE_KEY.search(key) is not None


def _copy(
    file: Writer,
    rec: Recording,
    topics: Sequence[str],
    chosen: Selection,
    offset_ns: int = 0,
    prefix: str = "",
    addresses: dict[str, str] | None = None,
) -> None:
    """Copy rows of channels, at other times, below a prefix, with numbers for hardware addresses."""
    for topic in topics:
        about = rec.channels[topic]
        if about.schema not in SCHEMAS:
            raise UsageError(
                f"{rec.path}: {topic}: type {about.schema} cannot be written; leave the channel out"
            )
        metadata = {k: v for k, v in about.metadata.items() if addresses is None or not _is_private(k)}
        file.add_channel(prefix + topic, about.schema, about.frame_id, about.columns, metadata)
    for window in rec.windows(topics, start_ns=chosen.start_ns, end_ns=chosen.end_ns):
        for topic, table in window.tables.items():
            if offset_ns:
                table = table.with_columns(pl.col("^.*_ns$") + offset_ns)
            if addresses is not None and rec.channels[topic].schema in _RADIO:
                for mac in table["mac"].unique(maintain_order=True).to_list():
                    addresses.setdefault(
                        mac, ":".join(f"{len(addresses):012x}"[k : k + 2] for k in range(0, 12, 2))
                    )
                table = table.with_columns(pl.col("mac").replace(addresses))
            file.add_table(prefix + topic, rec.channels[topic].schema, table)


def _parent(rec: Recording) -> dict[str, str]:
    source = source_file(rec.path)
    return {"source": source.name, "source_size": str(source.size), "source_blake2b": source.blake2b}


def _free(name: str, taken: dict[str, dict[str, str]] | set[str]) -> str:
    number, free = 1, name
    while free in taken:
        number += 1
        free = f"{name}_{number}"
    return free
