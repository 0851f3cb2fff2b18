"""Label tracks of Audacity: start, end, text; points, regions, and the extended form with frequencies."""

from __future__ import annotations

from pathlib import Path

import msgspec
import polars as pl

from ...recording.errors import MarchaError
from ...recording.events import plain
from .side import Label, nanoseconds, utf8

name = "audacity"
title = "Audacity label track, to the microsecond: one tier plainly, more with [tier] before the text"
suffix = ".txt"
UNIT = 1000
"""Nanoseconds of the last of six decimals."""


def limits(rows: pl.DataFrame) -> list[str]:
    """Return what the format cannot hold of these annotations."""
    losses = ["times are rounded to 1 µs; id, source, confidence, note, channel and metadata have no place"]
    if rows["tier"].n_unique() > 1:
        losses.append("one track holds all tiers: the tier stands in brackets before the text")
    if rows["label"].str.contains(r"[\x00-\x1f\x{85}\x{2028}\x{2029}]").any():
        losses.append("line breaks and tabs in labels are written as signs")
    return losses


def labels(rows: pl.DataFrame, origin_ns: int) -> list[Label]:
    """Return the labels as the file will hold them."""
    several = rows["tier"].n_unique() > 1
    out = []
    for tier, start, end, text, metadata in rows.select(
        "tier", "start_ns", "end_ns", "label", "metadata"
    ).iter_rows():
        shown = plain(f"[{tier}] {text}" if several else text)
        begin, stop = ((t - origin_ns + UNIT // 2) // UNIT * UNIT for t in (start, end))
        facts = msgspec.json.decode(metadata, type=dict[str, str])
        out.append(Label("", begin, stop, shown, facts))
    return out


def text(placed: list[Label], end_ns: int) -> str:
    """Return the file."""
    lines = []
    for label in placed:
        lines.append(f"{_seconds(label.start_ns)}\t{_seconds(label.end_ns)}\t{label.text}\n")
        low, high = (label.metadata.get(k) for k in ("low_hz", "high_hz"))
        if low is not None and high is not None and _is_number(low) and _is_number(high):
            lines.append(f"\\\t{low}\t{high}\n")
    return "".join(lines)


def sniff(path: Path, head: bytes) -> bool:
    """Return whether the first line is two numbers and a text."""
    cells = head.decode("utf-8", "replace").lstrip("\ufeff").split("\n", 1)[0].split("\t")
    return len(cells) >= 2 and all(_is_number(c) for c in cells[:2])


def read(path: Path, data: bytes) -> list[Label]:
    """Return the labels of a file.

    Raises
    ------
    MarchaError
        A line that is no label: file, line, value.
    """
    out: list[Label] = []
    for number, line in enumerate(utf8(path, data).replace("\r\n", "\n").split("\n"), 1):
        if not line.strip():
            continue
        cells = line.split("\t", 2)
        if cells[0] == "\\":
            if not out or len(cells) < 3:
                raise MarchaError(
                    f"{path}: line {number}: frequencies without a label before them; take it out"
                )
            low, high = (c.strip() for c in cells[1:])
            out[-1] = out[-1]._replace(metadata={"high_hz": high, "low_hz": low})
            continue
        if len(cells) < 2:
            raise MarchaError(
                f"{path}: line {number}: {line[:60]!r} is no label: start, end and text, separated by tabs"
            )
        start, end = (nanoseconds(path, number, c) for c in cells[:2])
        if end < start:
            raise MarchaError(f"{path}: line {number}: ends at {cells[1]} s, before {cells[0]} s; swap them")
        shown = cells[2] if len(cells) > 2 else ""
        out.append(Label("", start, end, shown))
    return out


def _seconds(t_ns: int) -> str:
    sign = "-" if t_ns < 0 else ""
    whole, rest = divmod(abs(t_ns), 10**9)
    return f"{sign}{whole}.{rest // UNIT:06d}"


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
