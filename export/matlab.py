"""MATLAB: one struct a channel in a MAT file of version 5."""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import Any, ClassVar

import msgspec
import numpy as np
import polars as pl

from ..recording import Recording
from ..recording.annotations import COLUMNS, EVENT
from ..recording.errors import MarchaError
from ..recording.events import SIDECAR, TABLE
from ..recording.selection import Selection, selected_topics, within
from .facts import origin
from .files import write_files
from .tables import meaning

MOST = 2**31 - 2**20
"""Bytes of one variable that the format holds."""
LONGEST = 63
"""Letters of a name in MATLAB."""


class MatlabExporter:
    """MAT file of version 5: what MATLAB, Octave and scipy load."""

    name: ClassVar[str] = "matlab"
    title: ClassVar[str] = "MATLAB .mat (version 5): a struct a channel with units, annotations, provenance"
    suffix: ClassVar[str] = ".mat"
    Options: ClassVar[type[msgspec.Struct]] = Selection

    def losses(self, rec: Recording, options: Any) -> list[str]:
        """Return what is renamed, and what is left out."""
        selected_topics(rec, options)
        losses = [
            "topics and columns as they are: names are made valid in MATLAB; topic, units and columns say so"
        ]
        if others := [a.name for a in rec.attachments if a.name not in (TABLE, SIDECAR)]:
            losses.append(f"attachments: {', '.join(others)}")
        return losses

    def export(self, rec: Recording, path: Path, options: Any, *, overwrite: bool = False) -> list[Path]:
        """Write the file; see :class:`marcha.export.Exporter`."""
        from scipy.io import savemat

        channels: dict[str, Any] = {}
        for topic in selected_topics(rec, options):
            channel = rec.channels[topic]
            if channel.schema == EVENT or not channel.columns:
                continue
            table = rec.table(topic, start_ns=options.start_ns, end_ns=options.end_ns, log_time=True)
            if table.estimated_size() > MOST:
                raise MarchaError(
                    f"{path}: {topic}: is larger than a MAT file holds (2 GB); choose a part with --start and --end"
                )
            names = valid_names(table.columns)
            columns = {names[n]: _values(table[n]) for n in table.columns}
            units = [meaning(channel.schema, n)["unit"] for n in table.columns]
            channels[topic] = {
                "topic": topic,
                "schema": channel.schema,
                "frame_id": channel.frame_id,
                "columns": np.array(table.columns, object),
                "units": np.array(units, object),
                **columns,
            }
        names = valid_names(list(channels))
        marks = within(rec.annotations, options)
        document = {names[t]: value for t, value in channels.items()}
        document["annotations"] = {n: _values(marks[n]) for n in COLUMNS}
        document["about"] = {k: np.int64(v) if isinstance(v, int) else v for k, v in origin(rec).items()}
        buffer = io.BytesIO()
        savemat(buffer, document, long_field_names=True, do_compression=True, oned_as="column")
        return write_files({path: buffer.getvalue()}, overwrite=overwrite)


def _values(series: pl.Series) -> Any:
    if series.dtype == pl.Boolean or series.dtype.is_numeric():
        return series.to_numpy()
    return np.array(["" if v is None else str(v) for v in series.to_list()], object)


def valid_names(names: list[str]) -> dict[str, str]:
    """Return a name that MATLAB takes for each: letters, digits, underscores, 63 at most, no two alike."""
    taken = {"annotations", "about", "topic", "schema", "frame_id", "columns", "units"}
    out = {}
    for name in names:
        stem = re.sub(r"[^0-9A-Za-z_]+", "_", name).strip("_") or "x"
        stem = (stem if stem[0].isalpha() else f"x{stem}")[:LONGEST]
        free, number = stem, 1
        while free in taken:
            number += 1
            tail = f"_{number}"
            free = stem[: LONGEST - len(tail)] + tail
        taken.add(free)
        out[name] = free
    return out
