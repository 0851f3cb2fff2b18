"""The annotations of a recording as BIDS ``events.tsv`` with its ``events.json``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgspec
import polars as pl

TABLE = "events.tsv"
SIDECAR = "events.json"
"""Names of the two attachments."""
VOCABULARY = "vocabulary"
"""Name of the metadata record with the vocabularies: tier to JSON text of a :class:`Vocabulary`."""

COLUMNS = {
    "onset": "s since the start of the recording",
    "duration": "s; 0 is an instant",
    "trial_type": "label of the annotation",
    "tier": "kind of annotation",
    "id": "identifier, unique in the recording",
    "source": "who says so: human, human:NAME or algorithm:NAME@VERSION",
    "confidence": "share between 0 and 1",
    "note": "remark",
    "channel": "topic or segment that it speaks of",
    "start_ns": "ns, clock of the recording",
    "end_ns": "ns, clock of the recording",
    "metadata": "JSON object of further facts",
}
"""Columns of ``events.tsv`` with their units."""


class Vocabulary(msgspec.Struct, frozen=True, kw_only=True):
    """The labels of a tier.

    Attributes
    ----------
    labels : dict of str to str
        Label to what it means.
    closed : bool
        Whether no other label is allowed.
    hed : dict of str to str
        Label to its HED tags.
    """

    labels: dict[str, str] = {}
    closed: bool = False
    hed: dict[str, str] = {}


def vocabularies(metadata: Mapping[str, Mapping[str, str]]) -> dict[str, Vocabulary]:
    """Return the vocabularies of a recording by tier; one that cannot be read is left out."""
    result = {}
    for tier, text in metadata.get(VOCABULARY, {}).items():
        try:
            result[tier] = msgspec.json.decode(text, type=Vocabulary)
        except msgspec.MsgspecError:
            continue
    return result


def to_events(annotations: pl.DataFrame, origin_ns: int) -> pl.DataFrame:
    """Return annotations as BIDS events.

    Parameters
    ----------
    annotations : polars.DataFrame
        Columns of :data:`marcha.recording.annotations.COLUMNS`.
    origin_ns : int
        Time that onsets count from: the start of the recording.

    Returns
    -------
    polars.DataFrame
        Columns of :data:`COLUMNS`, by onset. Nanoseconds stay beside the seconds: nothing is rounded away.
    """
    return annotations.select(
        onset=((pl.col("start_ns") - origin_ns) / 1e9).round(9),
        duration=((pl.col("end_ns") - pl.col("start_ns")) / 1e9).round(9),
        trial_type=pl.col("label"),
        tier="tier",
        id="id",
        source="source",
        confidence="confidence",
        note="note",
        channel="channel",
        start_ns="start_ns",
        end_ns="end_ns",
        metadata="metadata",
    ).sort("start_ns", maintain_order=True)


def events_text(events: pl.DataFrame) -> str:
    """Return the table as BIDS wants it: tab separated, ``n/a`` for what is missing, UTF-8.

    A cell with a tab, a line break or a quotation mark stands in quotation marks.
    """
    return events.write_csv(separator="\t", null_value="n/a")


def bids_events(events: pl.DataFrame) -> pl.DataFrame:
    """Return the table as strict readers of BIDS take it: no line break, tab or quotation mark in a text."""
    texts = [c for c, dtype in events.schema.items() if dtype == pl.String and c != "metadata"]
    return events.with_columns(pl.col(c).map_elements(_unquoted, pl.String) for c in texts)


def plain(text: str) -> str:
    """Return text for formats of one line a label: line breaks and tabs as their pictures (␊, ␍, ␉)."""
    return text.translate(_PICTURES)


def _unquoted(text: str) -> str:
    return plain(text).replace('"', "″")


_PICTURES = {code: 0x2400 + code for code in range(0x20)} | {0x85: 0x2424, 0x2028: 0x2424, 0x2029: 0x2424}


def sidecar(metadata: Mapping[str, Mapping[str, str]]) -> dict[str, Any]:
    """Return the JSON object beside the table: every column, its unit, and the labels that are known."""
    about: dict[str, Any] = {}
    units = {"onset": "s", "duration": "s", "start_ns": "ns", "end_ns": "ns"}
    for name, text in COLUMNS.items():
        about[name] = {"Description": text}
        if name in units:
            about[name]["Units"] = units[name]
    by_tier = vocabularies(metadata)
    levels = {label: text or label for v in by_tier.values() for label, text in v.labels.items()}
    if levels:
        about["trial_type"]["Levels"] = levels
    tags = {label: text for v in by_tier.values() for label, text in v.hed.items()}
    if tags:
        about["trial_type"]["HED"] = tags
    return about
