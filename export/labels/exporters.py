"""Exporters of annotations alone: EAF, TextGrid, Audacity labels, BIDS events."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar

import msgspec
import polars as pl

from ...recording import Recording
from ...recording.annotations import TOPIC
from ...recording.events import events_text, sidecar, to_events
from ...recording.selection import Selection, selected_topics, within
from ..facts import origin
from ..files import write_files
from . import audacity, elan, textgrid
from .side import side_file, side_path


def chosen(rec: Recording, options: Selection) -> pl.DataFrame:
    """Return the annotations that a selection means: tiers by their topics, and those that touch the time."""
    topics = selected_topics(rec, options)
    table = within(rec.annotations, options)
    if options.topics:
        table = table.filter((TOPIC + pl.col("tier")).is_in(topics))
    return table


class LabelExporter:
    """What the formats of labels have in common; a subclass names the module that writes the text."""

    name: ClassVar[str]
    title: ClassVar[str]
    suffix: ClassVar[str]
    Options: ClassVar[type[msgspec.Struct]] = Selection
    format: ClassVar[ModuleType]

    def losses(self, rec: Recording, options: Any) -> list[str]:
        """Return what the format cannot hold; the side file holds it."""
        return self.format.limits(chosen(rec, options))

    def export(self, rec: Recording, path: Path, options: Any, *, overwrite: bool = False) -> list[Path]:
        """Write the file and its side file; see :class:`marcha.export.Exporter`."""
        rows = chosen(rec, options)
        labels = self.format.labels(rows, rec.start_ns)
        text = self.format.text(labels, rec.end_ns - rec.start_ns)
        about = {**origin(rec), "not_in_the_file": self.format.limits(rows)}
        files = {path: text.encode(), side_path(path): side_file(labels, rows, rec.start_ns, about)}
        return write_files(files, overwrite=overwrite)


class AudacityExporter(LabelExporter):
    """Label track of Audacity."""

    name, title, suffix, format = audacity.name, audacity.title, audacity.suffix, audacity


class EafExporter(LabelExporter):
    """File of ELAN."""

    name, title, suffix, format = elan.name, elan.title, elan.suffix, elan


class TextGridExporter(LabelExporter):
    """File of Praat."""

    name, title, suffix, format = textgrid.name, textgrid.title, textgrid.suffix, textgrid


class EventsExporter:
    """Annotations as a BIDS events table with its JSON; holds everything, to the nanosecond."""

    name: ClassVar[str] = "events"
    title: ClassVar[str] = "annotations as BIDS events.tsv with its events.json, whole and exact"
    suffix: ClassVar[str] = ".tsv"
    Options: ClassVar[type[msgspec.Struct]] = Selection

    def losses(self, rec: Recording, options: Any) -> list[str]:
        """Return nothing: the table holds all."""
        return []

    def export(self, rec: Recording, path: Path, options: Any, *, overwrite: bool = False) -> list[Path]:
        """Write the table and its JSON; see :class:`marcha.export.Exporter`."""
        table = events_text(to_events(chosen(rec, options), rec.start_ns))
        about = msgspec.json.format(msgspec.json.encode(sidecar(rec.metadata)), indent=2) + b"\n"
        return write_files({path: table.encode(), path.with_suffix(".json"): about}, overwrite=overwrite)
