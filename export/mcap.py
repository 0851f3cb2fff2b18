"""The annotated recording to hand on: raw signals, estimates, stance and steps as annotations, provenance."""

from __future__ import annotations

from collections.abc import Container
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, ClassVar

import msgspec
import numpy as np
import polars as pl

from ..recording import (
    SCHEMAS,
    Recording,
    Writer,
    create,
)
from ..recording.errors import MarchaError
from ..recording.selection import Selection, selected_topics, within
from .events import ANNOTATIONS

EVENT = "foxglove_msgs/msg/Event"
STANCE = "marcha_msgs/msg/Stance"
STEP = "marcha_msgs/msg/Step"
ESTIMATE = "/estimate/"


class McapOptions(Selection, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the annotated recording."""

    estimates: Annotated[bool, msgspec.Meta(description="keep what estimators wrote (/estimate/…)")] = True
    annotations: Annotated[
        bool,
        msgspec.Meta(
            description="keep annotations, and add stance phases and steps of runs that have none yet"
        ),
    ] = True


class McapExporter:
    """One MCAP file that Foxglove, PlotJuggler, ROS 2 and Rerun open."""

    name: ClassVar[str] = "mcap"
    title: ClassVar[str] = (
        "one annotated MCAP recording: raw, estimates, stance and step annotations, provenance"
    )
    suffix: ClassVar[str] = ".mcap"
    Options: ClassVar[type[msgspec.Struct]] = McapOptions

    def export(self, rec: Recording, path: Path, options: Any, *, overwrite: bool = False) -> list[Path]:
        """Write one file; see :class:`marcha.export.Exporter`."""
        topics = selected_topics(rec, options)
        data = [t for t in topics if rec.channels[t].schema != EVENT]
        kept = [t for t in data if options.estimates or not t.startswith(ESTIMATE)]
        with create(path, overwrite=overwrite) as out:
            if options.whole:
                tiers = [t for t, c in rec.channels.items() if options.annotations and c.schema == EVENT]
                out.copy_from(rec, [*kept, *tiers])
            else:
                _copy_part(rec, kept, options, out)
            if options.annotations:
                phases = pl.concat(
                    [pl.DataFrame(schema=ANNOTATIONS), *(phases_of(rec, t, options) for t in data)]
                )
                if phases.height:
                    out.add_annotations(phases.sort("start_ns", maintain_order=True))
            out.add_metadata(_free("export", rec.metadata), provenance(rec, options))
        return [path]


def _copy_part(rec: Recording, topics: list[str], options: McapOptions, out: Writer) -> None:
    """Copy a range of time, with all that speaks of the whole."""
    for topic in topics:
        about = rec.channels[topic]
        if about.schema not in SCHEMAS:
            raise MarchaError(
                f"{rec.path}: {topic}: a part of a channel of type {about.schema} cannot be written; "
                "leave out the range of time, or choose other topics"
            )
        out.add_channel(topic, about.schema, about.frame_id, about.columns, about.metadata)
    for window in rec.windows(topics, start_ns=options.start_ns, end_ns=options.end_ns):
        for topic, table in window.tables.items():
            out.add_table(topic, rec.channels[topic].schema, table)
    for name, values in rec.metadata.items():
        out.add_metadata(name, values)
    for attachment in rec.attachments:
        out.add_attachment(attachment.name, rec.attachment(attachment.name), attachment.media_type)
    known = within(rec.annotations, options)
    if options.annotations and known.height:
        out.add_annotations(known)


def _free(name: str, taken: Container[str]) -> str:
    number, free = 1, name
    while free in taken:
        number += 1
        free = f"{name}_{number}"
    return free


def provenance(rec: Recording, options: McapOptions) -> dict[str, str]:
    """Return where an export comes from and what was left out."""
    chosen = {k: v for k, v in msgspec.to_builtins(options).items() if v not in (None, ())}
    return {
        "tool": f"marcha {version('marcha')}",
        "source": rec.path.name,
        "source_size": str(rec.path.stat().st_size),
        "options": msgspec.json.encode(chosen).decode(),
    }


def phases_of(rec: Recording, topic: str, selection: Selection) -> pl.DataFrame:
    """Return stances or steps of an estimate as annotations, empty where the recording has them already.

    Tiers are ``<run>/stance`` and ``<run>/step``, as a replay names them. A stance lasts from its first still
    sample to the first moving one, or to the last sample.
    """
    channel = rec.channels[topic]
    run, _, _ = topic.removeprefix(ESTIMATE).rpartition("/")
    tier = {STANCE: f"{run}/stance", STEP: f"{run}/step"}.get(channel.schema)
    if not topic.startswith(ESTIMATE) or tier is None or tier in rec.annotations["tier"]:
        return pl.DataFrame(schema=ANNOTATIONS)
    table = rec.table(topic, start_ns=selection.start_ns, end_ns=selection.end_ns)
    if channel.schema == STEP:
        return table.select(
            tier=pl.lit(tier),
            start_ns="start_ns",
            end_ns="end_ns",
            label=pl.format("step {}", "index"),
            metadata=pl.struct("index", "length_m", "height_m", "heading_rad").struct.json_encode(),
        )
    return _stances(table, tier)


def _stances(table: pl.DataFrame, tier: str) -> pl.DataFrame:
    if not table.height:
        return pl.DataFrame(schema=ANNOTATIONS)
    t_ns = table["t_ns"].to_numpy()
    still = table["still"].to_numpy().astype(np.int8)
    edges = np.diff(still, prepend=np.int8(0), append=np.int8(0))
    first, after = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)
    return pl.DataFrame({"start_ns": t_ns[first], "end_ns": t_ns[np.minimum(after, len(t_ns) - 1)]}).select(
        tier=pl.lit(tier), start_ns="start_ns", end_ns="end_ns", label=pl.lit("stance"), metadata=pl.lit("{}")
    )
