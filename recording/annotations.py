"""Annotations: labelled intervals, as ``foxglove_msgs/msg/Event`` on ``/annotation/<tier>``."""

from __future__ import annotations

import json
import re
from hashlib import blake2b
from itertools import chain
from typing import Any

import msgspec
import numpy as np
import polars as pl
from numpy.typing import NDArray

from .cdr import Bytes, decode
from .codec import (
    MAX_TIME_NS,
    PREFIX,
    SECOND,
    Columns,
    Messages,
)
from .definitions import Library
from .errors import MarchaError

EVENT = "foxglove_msgs/msg/Event"
TOPIC = "/annotation/"
FIELDS: dict[str, Any] = {
    "id": pl.String,
    "source": pl.String,
    "confidence": pl.Float64,
    "note": pl.String,
    "channel": pl.String,
}
"""Columns that may be null: ``id`` (unique in a recording), ``source`` (``human``, ``human:NAME``,
``algorithm:NAME@VERSION``), ``confidence`` (0 … 1), ``note``, ``channel`` (topic or segment it speaks of)."""
COLUMNS: dict[str, Any] = {
    "tier": pl.String,
    "start_ns": pl.Int64,
    "end_ns": pl.Int64,
    "label": pl.String,
    "metadata": pl.String,
    **FIELDS,
}
"""Columns of an annotation table; ``metadata`` is JSON text: an object of strings, compact, keys sorted. An
instant ends where it starts."""


def check_annotations(table: pl.DataFrame) -> pl.DataFrame:
    """Return the table with all of :data:`COLUMNS` in order, sorted by tier and start.

    Parameters
    ----------
    table : polars.DataFrame
        ``tier``, ``start_ns``, ``end_ns`` (inclusive, both), ``label``; optional ``metadata``: JSON text, a
        struct, or null; optional :data:`FIELDS`. A key of metadata that is one of the fields becomes its
        value.

    Raises
    ------
    MarchaError
        A column is missing, unknown or of the wrong type, an interval ends before it starts, a tier is no
        part of a topic, metadata is not an object, an id is there twice, or a confidence is no share.
    """
    lacking = [pl.lit(None, kind).alias(name) for name, kind in FIELDS.items() if name not in table.columns]
    if "metadata" not in table.columns:
        lacking.append(pl.lit("{}").alias("metadata"))
    table = table.with_columns(lacking)
    if set(table.columns) != set(COLUMNS):
        odd = ", ".join(sorted(set(table.columns) ^ set(COLUMNS)))
        raise MarchaError(f"annotations: columns missing or unknown: {odd}; they are {', '.join(COLUMNS)}")
    table = table.with_columns(
        pl.col(name).cast(kind) for name, kind in FIELDS.items() if table.schema[name] == pl.Null
    )
    metadata = table["metadata"].to_list()
    if not _canonical(metadata):
        values = [_metadata(v) for v in metadata]
        table = _lifted(table.with_columns(pl.Series("metadata", values, dtype=pl.String)))
    table = table.select(*COLUMNS)
    for name, kind in COLUMNS.items():
        if table.height and table.schema[name] != kind:
            raise MarchaError(f"annotations: column {name!r}: type {table.schema[name]}, must be {kind}")
        if name not in FIELDS and table[name].null_count():
            raise MarchaError(f"annotations: column {name!r} has nulls")
    table = table.cast(COLUMNS)  # an empty table may have any types  # pyright: ignore[reportArgumentType]
    check_ids(table)
    odd = table.filter(~pl.col("confidence").is_between(0.0, 1.0))
    if odd.height:
        row = odd.row(0, named=True)
        raise MarchaError(
            f"annotations: {row['tier']}: {row['label']!r}: confidence {row['confidence']} is not between 0 "
            "and 1; give a share"
        )
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


def check_ids(table: pl.DataFrame) -> None:
    """Raise ``MarchaError`` where an id is there twice or is no plain word."""
    ids = table["id"].drop_nulls()
    if ids.n_unique() != len(ids):
        twice = str(ids.filter(ids.is_duplicated())[0])
        raise MarchaError(f"annotations: id {twice!r} is there twice; give each annotation its own")
    for word in [i for i in ids.to_list() if not _WORD.fullmatch(i)][:1]:
        raise MarchaError(f"annotations: id {word!r} is no word of letters, digits and . _ : -")


def identified(table: pl.DataFrame) -> pl.DataFrame:
    """Return the annotations with an id each: rows that state none get one from what they say.

    The same table gives the same ids: twelve hexadecimal digits of the BLAKE2b hash of tier, start, end,
    label, metadata, and how many equal rows came before. An id that is there twice counts at its first row.

    Parameters
    ----------
    table : polars.DataFrame
        Columns of :data:`COLUMNS`.
    """
    stated_ids = table["id"]
    if not stated_ids.null_count() and stated_ids.n_unique() == table.height:
        return table
    taken = set(stated_ids.drop_nulls())
    seen: set[str] = set()
    before: dict[bytes, int] = {}
    ids: list[str] = []
    rows = table.select("tier", "start_ns", "end_ns", "label", "metadata").iter_rows()
    for stated, row in zip(stated_ids.to_list(), rows, strict=True):
        name = stated
        if name is None or name in seen:
            text = "\0".join(map(str, row)).encode()
            while True:
                before[text] = before.get(text, 0) + 1
                name = blake2b(text + b"%d" % before[text], digest_size=6).hexdigest()
                if name not in taken and name not in seen:
                    break
        seen.add(name)
        ids.append(name)
    return table.with_columns(pl.Series("id", ids, pl.String))


def _lifted(table: pl.DataFrame) -> pl.DataFrame:
    """Return the table with fields that stood in the metadata in their columns."""
    texts: list[dict[str, str]] = _ALL_TEXTS.decode(f"[{','.join(table['metadata'].to_list())}]")
    if not any(FIELDS.keys() & pairs.keys() for pairs in texts):
        return table
    fields = {name: table[name].to_list() for name in FIELDS}
    for row, pairs in enumerate(texts):
        for name in FIELDS.keys() & pairs.keys():
            value = _field(name, pairs[name])
            if value is None or fields[name][row] not in (None, value):
                continue
            fields[name][row] = value
            del pairs[name]
    return table.with_columns(
        pl.Series("metadata", [_CANONICAL.encode(pairs).decode() for pairs in texts], pl.String),
        *(pl.Series(name, values, FIELDS[name]) for name, values in fields.items()),
    )


def _field(name: str, text: str) -> str | float | None:
    """Return the value of a field; None where the text is none."""
    if name == "id":
        return text if _WORD.fullmatch(text) else None
    if name != "confidence":
        return text or None
    try:
        value = float(text)
    except ValueError:
        return None
    return value if 0.0 <= value <= 1.0 else None


def _canonical(values: list[Any]) -> bool:
    """Return whether all values are texts as :func:`_metadata` returns them; parsed all at once."""
    try:
        decoded = _ALL_TEXTS.decode(f"[{','.join(values)}]")
    except (TypeError, msgspec.DecodeError):
        return False
    return not any(RESERVED & texts.keys() for texts in decoded) and values == [
        _CANONICAL.encode(texts).decode() for texts in decoded
    ]


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


def encode_events(rows: pl.DataFrame, channel_id: int) -> tuple[Bytes, NDArray[np.int64]]:
    """Return the message records of the annotations of one tier, one behind the other, and their index.

    Raises
    ------
    MarchaError
        A text contains a NUL, which a message's string cannot hold.
    """
    start, end = rows["start_ns"].to_numpy(), rows["end_ns"].to_numpy()
    metadata: list[dict[str, str]] = _ALL_TEXTS.decode(f"[{','.join(rows['metadata'].to_list())}]")
    for name in reversed(FIELDS):
        if name in rows.columns and rows[name].null_count() < rows.height:
            texts = [v if v is None or isinstance(v, str) else repr(v) for v in rows[name].to_list()]
            metadata = [m if t is None else {name: t, **m} for t, m in zip(texts, metadata, strict=True)]
    strings: list[str] = []
    for label, pairs in zip(rows["label"].to_list(), metadata, strict=True):
        strings += ("label", label, *chain.from_iterable(pairs.items()))
    counts = np.fromiter(map(len, metadata), np.int64, len(metadata)) + 1
    first = 2 * (np.cumsum(counts) - counts)  # string of each row
    joined = "".join(strings)
    raw = strings if joined.isascii() else [string.encode() for string in strings]
    lengths = np.fromiter(map(len, raw), np.int64, len(raw))
    text = np.frombuffer(joined.encode(), np.uint8)
    ends = np.cumsum(lengths)
    if not text.all():
        string = int(np.searchsorted(ends, np.argmin(text), side="right"))
        row = int(np.searchsorted(first, string, side="right")) - 1
        label = rows["label"][row]
        raise MarchaError(
            f"annotations: {label!r} at {start[row]} ns: {strings[string]!r}: a string may not contain NUL"
        )
    # A string is its length (with the NUL), its bytes, a NUL, and what is missing to a multiple of four,
    # except behind the last one.
    sizes = 4 + lengths + 1
    padded = sizes + -sizes % 4
    last = np.append(first[1:], len(raw)) - 1
    padded[last] = sizes[last]
    head = np.zeros(len(start), _HEAD)
    taken = padded.copy()
    taken[first] += _HEAD.itemsize
    behind = np.cumsum(taken)
    labels_at = behind - padded
    records = labels_at[first] - _HEAD.itemsize
    head["opcode"], head["channel"], head["sequence"] = 5, channel_id, np.arange(len(start))
    head["length"] = behind[last] - records - 9
    head["log"] = head["publish"] = start
    head["encapsulation"] = b"\0\1\0\0"
    head["start_s"], head["start_ns"] = np.divmod(start, SECOND)
    head["end_s"], head["end_ns"] = np.divmod(end, SECOND)
    head["pairs"] = counts
    data = np.zeros(behind[-1], np.uint8)
    data[records[:, None] + np.arange(_HEAD.itemsize)] = head.view(np.uint8).reshape(len(start), -1)
    data[labels_at[:, None] + np.arange(4)] = (lengths + 1).astype("<u4").view(np.uint8).reshape(-1, 4)
    data[np.repeat(labels_at + 4 - (ends - lengths), lengths) + np.arange(len(text))] = text
    return data, np.column_stack((start, records))


_HEAD = np.dtype(
    [
        *PREFIX.descr,
        ("encapsulation", "S4"),
        ("start_s", "<i4"),
        ("start_ns", "<u4"),
        ("end_s", "<i4"),
        ("end_ns", "<u4"),
        ("pairs", "<u4"),
    ]
)
"""What stands before the strings of an event's record."""
RESERVED = frozenset({"label", *FIELDS})
"""Keys of an event that are columns of their own."""
_WORD = re.compile(r"[\w.:-]+")
_TEXTS = msgspec.json.Decoder(dict[str, str])
_ALL_TEXTS = msgspec.json.Decoder(list[dict[str, str]])
_CANONICAL = msgspec.json.Encoder(order="sorted")


class EventDecoder:
    """Decodes annotation messages into the columns of a tier; see ``codec.Decoder``."""

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
        rows: list[tuple[Any, ...]] = []
        for i in range(len(messages.log)):
            value = decode(messages.message(i), self.definition, self.library)
            start, end = (value[k]["sec"] * SECOND + value[k]["nanosec"] for k in ("start_time", "end_time"))
            pairs = {p["key"]: p["value"] for p in value["metadata"]}
            label = pairs.pop("label", "")
            fields = []
            for name in FIELDS:
                field = _field(name, pairs[name]) if name in pairs else None
                if field is not None:
                    del pairs[name]
                fields.append(field)
            text = _CANONICAL.encode(pairs).decode()
            rows.append((start, int(messages.log[i]), start, end, label, text, *fields))
        names: dict[str, Any] = {
            "t_ns": pl.Int64,
            "t_log_ns": pl.Int64,
            **{k: v for k, v in COLUMNS.items() if k != "tier"},
        }
        return pl.DataFrame(rows, schema=names, orient="row")

    def decode_columns(self, messages: Messages) -> Columns:
        """Return what :meth:`decode` returns as series."""
        return self.decode(messages).to_dict()
