"""The annotated recording to hand on: raw signals, estimates, stance and steps as annotations, provenance."""

from __future__ import annotations

from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, ClassVar

import msgspec
import numpy as np
import polars as pl

from ..recording import Recording, create
from ..recording.selection import Selection, selected_topics, within
from .events import ANNOTATIONS

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
        kept = [t for t in topics if options.estimates or not t.startswith(ESTIMATE)]
        with create(path, overwrite=overwrite) as out:
            for topic in kept:
                about = rec.channels[topic]
                out.add_channel(topic, about.schema, about.frame_id, about.columns, about.metadata)
            for window in rec.windows(kept, start_ns=options.start_ns, end_ns=options.end_ns):
                for topic, table in window.tables.items():
                    if table.height:
                        out.add_table(topic, rec.channels[topic].schema, table)
            for name, values in rec.metadata.items():
                out.add_metadata(name, values)
            out.add_metadata("export", provenance(rec, options))
            for attachment in rec.attachments:
                out.add_attachment(attachment.name, rec.attachment(attachment.name), attachment.media_type)
            if options.annotations:
                known = within(rec.annotations, options)
                phases = [phases_of(rec, topic, options) for topic in topics]
                out.add_annotations(pl.concat([known, *phases]).sort("start_ns", maintain_order=True))
        return [path]


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

    Tiers are ``<run>/stance`` and ``<run>/step``, as a replay names them. A stance lasts from its first still sample
    to the first moving one, or to the last sample.
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
