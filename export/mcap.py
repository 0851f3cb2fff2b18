"""The annotated recording to hand on: raw signals, estimates, stance and steps as annotations, provenance."""

from __future__ import annotations

from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, ClassVar

import msgspec
import polars as pl

from ..recording import (
    SCHEMAS,
    Recording,
    Writer,
    create,
)
from ..recording.annotations import EVENT
from ..recording.errors import MarchaError
from ..recording.events import SIDECAR, TABLE
from ..recording.names import ESTIMATE, free_name
from ..recording.selection import Selection, selected_topics, within
from .pointclouds import add_tracks
from .rules import by_rules
from .series import evenly


class McapOptions(Selection, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the annotated recording."""

    estimates: Annotated[bool, msgspec.Meta(description="keep what estimators wrote (/estimate/…)")] = True
    annotations: Annotated[
        bool,
        msgspec.Meta(
            description="keep annotations, and add stance phases and steps of runs that have none yet"
        ),
    ] = True
    rate_hz: Annotated[
        float,
        msgspec.Meta(
            ge=0, description="readings and estimates of numbers at even times of this rate (0: as recorded)"
        ),
    ] = 0.0
    tracks: Annotated[
        bool,
        msgspec.Meta(description="add every trajectory as one sensor_msgs/PointCloud2, which Rerun draws"),
    ] = True


class McapExporter:
    """One MCAP file that Foxglove, PlotJuggler, ROS 2 and Rerun open."""

    name: ClassVar[str] = "mcap"
    title: ClassVar[str] = (
        "one annotated MCAP recording: raw, estimates, stance and step annotations, provenance"
    )
    suffix: ClassVar[str] = ".mcap"
    Options: ClassVar[type[msgspec.Struct]] = McapOptions

    def losses(self, rec: Recording, options: Any) -> list[str]:
        """Return what resampling takes away; else nothing, for this is the recording itself."""
        if not options.rate_hz:
            return []
        topics = [t for t in selected_topics(rec, options) if rec.channels[t].schema != EVENT]
        whole = [t for t in topics if not _continuous(rec, t)]
        losses = [f"the times of the readings: they are interpolated to {options.rate_hz:g} Hz"]
        return losses + ([f"(left as they are: {', '.join(whole)})"] if whole else [])

    def export(self, rec: Recording, path: Path, options: Any, *, overwrite: bool = False) -> list[Path]:
        """Write one file; see :class:`marcha.export.Exporter`."""
        topics = selected_topics(rec, options)
        data = [t for t in topics if rec.channels[t].schema != EVENT]
        kept = [t for t in data if options.estimates or not t.startswith(ESTIMATE)]
        with create(path, overwrite=overwrite) as out:
            if options.whole and not options.rate_hz:
                tiers = [t for t, c in rec.channels.items() if options.annotations and c.schema == EVENT]
                out.copy_from(rec, [*kept, *tiers])
            else:
                _copy_part(rec, kept, options, out)
            if options.tracks:
                add_tracks(rec, kept, options, out)
            if options.annotations:
                phases = by_rules(rec, ("stance", "step"), options)
                phases = phases.filter(~pl.col("tier").is_in(rec.annotations["tier"].unique().implode()))
                if phases.height:
                    out.add_annotations(phases)
                out.attach_events()
            out.add_metadata(free_name("export", set(rec.metadata)), provenance(rec, options))
        return [path]


CONTINUOUS = (
    "sensor_msgs/msg/Imu",
    "sensor_msgs/msg/MagneticField",
    "sensor_msgs/msg/FluidPressure",
    "sensor_msgs/msg/Temperature",
    "sensor_msgs/msg/JointState",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/QuaternionStamped",
    "geometry_msgs/msg/Vector3Stamped",
    "marcha_msgs/msg/OpticalMarkers",
    "marcha_msgs/msg/NavigationSigma",
)
"""Messages that state a quantity which has a value at every time; events, fixes and stances are not among them."""


def _continuous(rec: Recording, topic: str) -> bool:
    return rec.channels[topic].schema in CONTINUOUS


def _copy_part(rec: Recording, topics: list[str], options: McapOptions, out: Writer) -> None:
    """Copy a range of time, with all that speaks of the whole."""
    for topic in topics:
        about = rec.channels[topic]
        if about.schema not in SCHEMAS:
            raise MarchaError(
                f"{rec.path}: {topic}: a part of a channel of type {about.schema} cannot be written; "
                "leave out the range of time, or choose other topics"
            )
        metadata = about.metadata
        if options.rate_hz and _continuous(rec, topic):
            metadata = {**metadata, "resampled_hz": f"{options.rate_hz:g}"}
        out.add_channel(topic, about.schema, about.frame_id, about.columns, metadata)
    if options.rate_hz:
        for topic in [t for t in topics if _continuous(rec, t)]:
            table = rec.table(topic, start_ns=options.start_ns, end_ns=options.end_ns)
            if table.height:
                out.add_table(topic, rec.channels[topic].schema, evenly(table, options.rate_hz))
        topics = [t for t in topics if not _continuous(rec, t)]
    for window in rec.windows(topics, start_ns=options.start_ns, end_ns=options.end_ns):
        for topic, table in window.tables.items():
            out.add_table(topic, rec.channels[topic].schema, table)
    for name, values in rec.metadata.items():
        out.add_metadata(name, values)
    for attachment in rec.attachments:
        if attachment.name in (TABLE, SIDECAR):
            continue  # written anew
        out.add_attachment(attachment.name, rec.attachment(attachment.name), attachment.media_type)
    marks = within(rec.stored_annotations, options)
    if options.annotations and marks.height:
        out.add_annotations(marks)


def provenance(rec: Recording, options: McapOptions) -> dict[str, str]:
    """Return where an export comes from and what was left out."""
    chosen = {k: v for k, v in msgspec.to_builtins(options).items() if v not in (None, ())}
    return {
        "tool": f"marcha {version('marcha')}",
        "source": rec.path.name,
        "source_size": str(rec.path.stat().st_size),
        "options": msgspec.json.encode(chosen).decode(),
    }
