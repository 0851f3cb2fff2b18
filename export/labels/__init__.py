"""Labels of other tools, both ways: Audacity, ELAN, Praat, C3D events, BIDS and other tables."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import polars as pl

from ...recording import Recording
from ...recording.changes import check_inside, check_labels, check_unique
from ...recording.errors import UsageError
from ...recording.event_table import read_events
from ...recording.events import vocabularies
from ...recording.files import read_small
from . import audacity, c3d, elan, textgrid
from .side import annotations_of

FORMATS: dict[str, ModuleType] = {m.name: m for m in (c3d, elan, textgrid, audacity)}
"""Formats that are read, by name, in the order in which a file is tried; a table is what none of them is."""
WRITTEN: dict[str, ModuleType] = {m.name: m for m in (audacity, elan, textgrid)}
TABLE = "table"
_RESOLUTION = 1_000_000
"""How far a label may reach over the ends of a recording because its format rounds [ns]."""


class Labels(NamedTuple):
    """What a file of labels holds: its format, the annotations, and what is to be said about them."""

    format: str
    annotations: pl.DataFrame
    notes: list[str]


def read_labels(
    path: Path,
    rec: Recording,
    *,
    format: str | None = None,
    tier: str | None = None,
    offset_ns: int = 0,
) -> Labels:
    """Read annotations of a recording from a file of another tool.

    Parameters
    ----------
    path : Path
        The file; a side file beside it is used.
    rec : Recording
        The recording that they speak of: the file's zero is its start.
    format : str, optional
        One of :data:`FORMATS` or ``table``; found by content without it.
    tier : str, optional
        Tier of labels that have none; the file's name without it.
    offset_ns : int
        Added to all times: what the recording's clock said, since its start, at the file's zero.

    Raises
    ------
    MarchaError
        The file is broken, a label lies outside of the recording or does not fit its tier's closed vocabulary, or an
        id is there twice.
    UsageError
        An unknown format.
    """
    data = read_small(path)
    if format is not None and format not in (*FORMATS, TABLE):
        raise UsageError(f"label format {format!r}: not known; there are {', '.join((*FORMATS, TABLE))}")
    name = format or next((n for n, m in FORMATS.items() if m.sniff(path, data[:4096])), TABLE)
    origin = rec.start_ns + offset_ns
    if name == TABLE:
        table, notes = read_events(path, origin, tier=tier, offset_ns=offset_ns), []
    else:
        table, notes = annotations_of(path, FORMATS[name].read(path, data), origin, tier)
    table, reach = _within(rec, table)
    if reach:
        notes.append(f"{reach} labels reached less than 1 ms over an end of the recording and were cut there")
    lines = name == TABLE
    check_unique(path, table, lines=lines)
    check_inside(rec, table, path, lines=lines)
    check_labels(path, table, vocabularies(rec.metadata), lines=lines)
    return Labels(name, table, notes)


def _within(rec: Recording, table: pl.DataFrame) -> tuple[pl.DataFrame, int]:
    """Cut what reaches over the recording's ends by less than a format's rounding; return how many."""
    span = rec.data_span
    if span is None or not table.height:
        return table, 0
    first, last = span
    near = pl.col("start_ns").is_between(first - _RESOLUTION, last + _RESOLUTION) & pl.col(
        "end_ns"
    ).is_between(first - _RESOLUTION, last + _RESOLUTION)
    cut = table.with_columns(
        pl.when(near).then(pl.col(k).clip(first, last)).otherwise(pl.col(k)).alias(k)
        for k in ("start_ns", "end_ns")
    )
    moved = (cut["start_ns"] != table["start_ns"]) | (cut["end_ns"] != table["end_ns"])
    return cut, int(moved.sum())


__all__ = ["FORMATS", "TABLE", "WRITTEN", "Labels", "read_labels"]
