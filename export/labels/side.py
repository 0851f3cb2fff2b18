"""What label formats share: tiers without overlap, and a side file with what they cannot hold."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from heapq import heappop, heappush
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import msgspec
import polars as pl

from ...recording.annotations import COLUMNS
from ...recording.errors import MarchaError

SUFFIX = ".marcha.json"
"""What the name of a side file adds to its file's."""


class Label(NamedTuple):
    """A label as a file has it: times in nanoseconds since the file's zero."""

    tier: str
    start_ns: int
    end_ns: int
    text: str
    metadata: Mapping[str, str] = MappingProxyType({})
    source: str | None = None
    filler: bool = False
    """Whether this is nothing unless the side file says otherwise: the space between labels."""


class Side(msgspec.Struct, frozen=True):
    """The side file: for every label of the file the annotation that it stands for.

    Attributes
    ----------
    about : dict
        Facts for a person: what was written, and what the file could not hold.
    labels : list
        Tier, start, end [ns since the file's zero] and text, as the file has them.
    annotations : list
        The annotations themselves, in the same order, in the columns of ``columns``; times count from the
        file's zero.
    """

    about: dict[str, Any]
    labels: list[tuple[str, int, int, str]]
    annotations: list[list[Any]]
    columns: list[str]


def side_path(path: Path) -> Path:
    """Return the name of a file's side file."""
    return path.with_name(path.name + SUFFIX)


def side_file(labels: Sequence[Label], rows: pl.DataFrame, origin_ns: int, about: dict[str, Any]) -> bytes:
    """Return the side file of ``labels``, which stand for ``rows`` in that order."""
    moved = rows.with_columns(pl.col("start_ns", "end_ns") - origin_ns).select(*COLUMNS)
    kept = Side(about, [label[:4] for label in labels], [list(r) for r in moved.rows()], list(COLUMNS))
    return msgspec.json.encode(kept) + b"\n"


def annotations_of(
    path: Path, labels: Iterable[Label], origin_ns: int, tier: str | None
) -> tuple[pl.DataFrame, list[str]]:
    """Return the annotations that the labels of a file stand for, and what is to be said about them.

    A label that is as it was written becomes the annotation that the side file has. One that was changed or
    is new becomes an annotation with the times and the text of the file; its tier is that of the others of
    its tier in the file.

    Parameters
    ----------
    path : Path
        The file; its side file lies beside it, or does not.
    labels : iterable of Label
        What it holds.
    origin_ns : int
        Time that the file's zero stands for.
    tier : str, optional
        Tier of labels that have none.
    """
    side = _read_side(side_path(path))
    rows_of: dict[tuple[str, int, int], list[tuple[str, list[Any]]]] = {}
    tiers: dict[str, str] = {}
    if side is not None:
        for key, values in zip(side.labels, side.annotations, strict=True):
            rows_of.setdefault((key[0], key[1], key[2]), []).append((key[3], values))
            tiers.setdefault(key[0] or f"[{values[0]}]", values[0])
    default = tier or path.name.split(".")[0]
    rows, changed = [], 0
    for label in labels:
        same = _taken(rows_of.get(label[:3], []), label.text)
        if same is not None:
            rows.append(same)
        elif not label.filler:
            changed += side is not None
            name, shown = (tiers.get(label.tier, label.tier) or default), label.text
            if not label.tier and (begin := next((t for t in tiers if shown.startswith(f"{t} ")), "")):
                name, shown = tiers[begin], shown.removeprefix(f"{begin} ")
            text = msgspec.json.encode(dict(label.metadata)).decode()
            rows.append(
                [name, label.start_ns, label.end_ns, shown, text, None, label.source, None, None, None]
            )
    table = pl.DataFrame(rows, schema=COLUMNS, orient="row").with_columns(
        pl.col("start_ns", "end_ns") + origin_ns
    )
    notes = []
    if changed:
        notes.append(
            f"{changed} of {len(rows)} labels are not as exported: they have the file's times and no "
            "source, confidence or note"
        )
    return table, notes


def _taken(options: list[tuple[str, list[Any]]], text: str) -> list[Any] | None:
    """Take out the annotation with this text; else one that differs from it in its kind of line breaks alone,
    which tools rewrite when they save.
    """
    for alike in (str, _one_kind_of_breaks):
        for place, (label, values) in enumerate(options):
            if alike(label) == alike(text):
                del options[place]
                return values
    return None


def _one_kind_of_breaks(text: str) -> str:
    return text.replace("\r\n", "\n").replace("\r", "\n")


def _read_side(path: Path) -> Side | None:
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        return None
    except OSError as error:
        raise MarchaError(f"{path}: cannot read: {error.strerror or error}") from None
    try:
        side = msgspec.json.decode(data, type=Side)
        pl.DataFrame(side.annotations, schema=COLUMNS, orient="row")
    except (msgspec.MsgspecError, pl.exceptions.PolarsError, TypeError, ValueError):
        side = None
    if side is None or side.columns != list(COLUMNS) or len(side.labels) != len(side.annotations):
        raise MarchaError(f"{path}: is no side file of this version; move it away to read the labels alone")
    return side


def lanes(rows: Iterable[tuple[str, int, int]]) -> list[int]:
    """Return the lane (from 0) of each interval: the lowest of its tier where it overlaps nothing.

    Parameters
    ----------
    rows : iterable of (str, int, int)
        Tier, start, end (not included), by start.
    """
    busy: dict[str, list[tuple[int, int]]] = {}
    free: dict[str, list[int]] = {}
    count: Counter[str] = Counter()
    out = []
    for tier, start, end in rows:
        ends, idle = busy.setdefault(tier, []), free.setdefault(tier, [])
        while ends and ends[0][0] <= start:
            heappush(idle, heappop(ends)[1])
        if idle:
            lane = heappop(idle)
        else:
            lane = count[tier]
            count[tier] += 1
        heappush(ends, (end, lane))
        out.append(lane)
    return out


def lane_names(pairs: Iterable[tuple[str, Any]]) -> dict[tuple[str, Any], str]:
    """Return a tier's name in the file for each (tier, lane), no two alike: ``tier``, ``tier [2]``, …"""
    distinct = list(dict.fromkeys(pairs))
    taken = {tier for tier, _ in distinct}
    chosen: set[str] = set()
    names = {}
    for tier, lane in distinct:
        name, number = tier, 1
        while name in chosen or (number > 1 and name in taken):
            number += 1
            name = f"{tier} [{number}]"
        chosen.add(name)
        names[tier, lane] = name
    return names


def utf8(path: Path, data: bytes) -> str:
    """Return the text of a file; UTF-16 only where it begins with its mark.

    Raises
    ------
    MarchaError
        The bytes are no text in these encodings: line, byte, remedy.
    """
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        try:
            return data.decode("utf-16")
        except UnicodeDecodeError:
            raise MarchaError(f"{path}: begins like UTF-16 and is not; save it as UTF-8") from None
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        raise MarchaError(
            f"{path}: line {line}: byte 0x{data[error.start]:02x} is not UTF-8; save the file as UTF-8"
        ) from None


def nanoseconds(path: Path, line: int, text: str, unit_ns: int = 10**9) -> int:
    """Return a decimal number of seconds (or of ``unit_ns``) in whole nanoseconds.

    Raises
    ------
    MarchaError
        It is no number, or beyond any clock.
    """
    from decimal import Decimal, InvalidOperation

    try:
        value = Decimal(text.strip()) * unit_ns
        if value.is_finite() and abs(value) < 2**62:
            return int(value.to_integral_value())
    except InvalidOperation:
        pass
    raise MarchaError(f"{path}: line {line}: {text[:40]!r} is not a time; correct it")
