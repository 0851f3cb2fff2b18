"""Annotations: labelled intervals, as ``foxglove_msgs/msg/Event`` on ``/annotation/<tier>``."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from functools import lru_cache
from typing import Any

import msgspec
import polars as pl

from .cdr import CdrError, decode
from .codec import MAX_TIME_NS, PREFIX, SECOND, Columns, Messages
from .definitions import Library
from .errors import MarchaError

EVENT = "foxglove_msgs/msg/Event"
TOPIC = "/annotation/"
COLUMNS: dict[str, Any] = {
    "tier": pl.String,
    "start_ns": pl.Int64,
    "end_ns": pl.Int64,
    "label": pl.String,
    "metadata": pl.String,
}
"""Columns of an annotation table; ``metadata`` is JSON text: an object of strings, compact, keys sorted."""


def check_annotations(table: pl.DataFrame) -> pl.DataFrame:
    """Return the table with all of :data:`COLUMNS` in order, sorted by tier and start.

    Parameters
    ----------
    table : polars.DataFrame
        ``tier``, ``start_ns``, ``end_ns`` (inclusive, both), ``label``; optional ``metadata``: JSON text, a
        struct, or null.

    Raises
    ------
    MarchaError
        A column is missing, unknown or of the wrong type, an interval ends before it starts, a tier is no
        part of a topic, or metadata is not an object.
    """
    if "metadata" not in table.columns:
        table = table.with_columns(pl.lit("{}").alias("metadata"))
    if set(table.columns) != set(COLUMNS):
        odd = ", ".join(sorted(set(table.columns) ^ set(COLUMNS)))
        raise MarchaError(f"annotations: columns missing or unknown: {odd}; they are {', '.join(COLUMNS)}")
    values = [_metadata(v) for v in table["metadata"].to_list()]
    table = table.with_columns(pl.Series("metadata", values, dtype=pl.String)).select(*COLUMNS)
    for name, kind in COLUMNS.items():
        if table.height and table.schema[name] != kind:
            raise MarchaError(f"annotations: column {name!r}: type {table.schema[name]}, must be {kind}")
        if table[name].null_count():
            raise MarchaError(f"annotations: column {name!r} has nulls")
    table = table.cast(COLUMNS)  # an empty table may have any types  # pyright: ignore[reportArgumentType]
    bad = table.filter(
        (pl.col("end_ns") < pl.col("start_ns")) | (pl.col("start_ns") < 0) | (pl.col("end_ns") > MAX_TIME_NS)
    )
    if bad.height:
        row = bad.row(0)
        raise MarchaError(
            f"annotations: {row[0]}: {row[3]!r}: from {row[1]} to {row[2]} ns is no interval of the recording"
        )
    for tier in table["tier"].unique().to_list():
        if not tier or tier.startswith("/") or tier != tier.strip():
            raise MarchaError(f"annotations: tier {tier!r} must be a plain name; its topic is {TOPIC}<tier>")
    return table.sort("tier", "start_ns", maintain_order=True)


def _metadata(value: Any) -> str:
    """Return the text of a JSON object of strings: compact, its keys in the order of the alphabet."""
    if isinstance(value, str):
        try:  # an object of strings already, the usual case
            texts = _TEXTS.decode(value)
            if "label" not in texts:
                return _CANONICAL.encode(texts).decode()
        except msgspec.DecodeError:
            pass
        try:
            value = json.loads(value or "{}")
        except ValueError:
            raise MarchaError(f"annotations: metadata {value!r} is not the text of a JSON object") from None
    if value is None:
        value = {}
    if not isinstance(value, dict):
        raise MarchaError(f"annotations: metadata {value!r} is not an object")
    if "label" in value:
        raise MarchaError("annotations: metadata may not have the key 'label'; it holds the label itself")
    texts = {
        str(k): v if isinstance(v, str) else json.dumps(v, ensure_ascii=False)
        for k, v in value.items()
        if v is not None
    }
    return _CANONICAL.encode(texts).decode()


def encode_events(rows: pl.DataFrame, channel_id: int) -> Iterator[tuple[int, bytes]]:
    """Yield log time and message record of every annotation of one tier."""
    for i, (start, end, label, text) in enumerate(
        rows.select("start_ns", "end_ns", "label", "metadata").iter_rows()
    ):
        try:
            pairs = _pairs(label, text)
        except CdrError as e:
            raise MarchaError(f"annotations: {label!r} at {start} ns: {e}") from None
        message = _EVENT.pack(b"\0\1\0\0", *divmod(start, SECOND), *divmod(end, SECOND)) + pairs
        size = len(message) + PREFIX.itemsize - 9
        yield start, _PREFIX.pack(5, size, channel_id, i, start, start) + message


@lru_cache(maxsize=256)
def _pairs(label: str, text: str) -> bytes:
    """Return the key-value pairs of one event: as ``cdr.encode`` does, ten times as fast."""
    pairs = _TEXTS.decode(text)
    strings = ["label", label]
    for pair in pairs.items():
        strings += pair
    parts = [(len(pairs) + 1).to_bytes(4, "little")]
    for string in strings:
        if "\0" in string:
            raise CdrError(f"{string!r}: a string may not contain NUL")
        raw = string.encode()
        size = len(raw) + 1
        parts += (size.to_bytes(4, "little"), raw, _ENDS[size % 4])
    parts[-1] = b"\0"  # padding stands between strings, not behind the last
    return b"".join(parts)


_ENDS = (bytes(1), bytes(4), bytes(3), bytes(2))
"""NUL and padding behind a string, by its length modulo 4."""
_TEXTS = msgspec.json.Decoder(dict[str, str])
_CANONICAL = msgspec.json.Encoder(order="sorted")
_EVENT = struct.Struct("<4siIiI")
_PREFIX = struct.Struct("<BQHIQQ")
"""``codec.PREFIX`` for one record."""


class EventDecoder:
    """Decodes annotation messages into ``start_ns, end_ns, label, metadata``; see ``codec.Decoder``."""

    def __init__(self, library: Library) -> None:
        self.library = library
        self.definition = next(iter(library.values()))

    def frame_id(self, message: memoryview) -> str:
        """Return "": an event has no frame."""
        return ""

    def decode(self, messages: Messages) -> pl.DataFrame:
        """Return ``t_ns``, ``t_log_ns`` and the columns of an annotation, one row a message.

        Raises
        ------
        CdrError
            A message does not fit the definition.
        """
        rows: list[tuple[int, int, int, int, str, str]] = []
        for i in range(len(messages.log)):
            value = decode(messages.message(i), self.definition, self.library)
            start, end = (value[k]["sec"] * SECOND + value[k]["nanosec"] for k in ("start_time", "end_time"))
            pairs = {p["key"]: p["value"] for p in value["metadata"]}
            label = pairs.pop("label", "")
            text = _CANONICAL.encode(pairs).decode()
            rows.append((start, int(messages.log[i]), start, end, label, text))
        names: dict[str, Any] = {
            "t_ns": pl.Int64,
            "t_log_ns": pl.Int64,
            **{k: v for k, v in COLUMNS.items() if k != "tier"},
        }
        return pl.DataFrame(rows, schema=names, orient="row")

    def decode_columns(self, messages: Messages) -> Columns:
        """Return what :meth:`decode` returns as series."""
        return self.decode(messages).to_dict()
