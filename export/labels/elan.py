"""EAF files of ELAN, versions 2.7 to 3.0; written as 3.0."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from xml.etree import ElementTree
from xml.sax.saxutils import escape, quoteattr

import polars as pl

from ...recording.errors import MarchaError
from .side import Label, lane_names, lanes, utf8

name = "eaf"
title = "ELAN .eaf, to the millisecond; overlaps of a tier in numbered tiers"
suffix = ".eaf"
UNIT = 1_000_000
"""Nanoseconds of a millisecond, the resolution of the format."""
_SCHEMA = "http://www.mpi.nl/tools/elan/EAFv3.0.xsd"
_NOT_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def limits(rows: pl.DataFrame) -> list[str]:
    """Return what the format cannot hold of these annotations."""
    losses = [
        "times are cut to whole ms; id, confidence, note, channel and metadata have no place, and the source "
        "is one a tier"
    ]
    if (rows["start_ns"] == rows["end_ns"]).any():
        losses.append("instants last 1 ms")
    if any(_lanes(rows, 0)):
        losses.append("labels of a tier may not overlap: they are moved to numbered tiers")
    return losses


def _times(rows: pl.DataFrame, origin_ns: int) -> list[tuple[str, int, int]]:
    """Return tier, start and end of each annotation in whole milliseconds; none is shorter than one."""
    out = []
    for tier, start, end in rows.select("tier", "start_ns", "end_ns").iter_rows():
        begin, stop = ((t - origin_ns) // UNIT for t in (start, end))
        out.append((tier, begin, max(stop, begin + 1)))
    return out


def _lanes(rows: pl.DataFrame, origin_ns: int) -> list[int]:
    return lanes(_times(rows, origin_ns))


def labels(rows: pl.DataFrame, origin_ns: int) -> list[Label]:
    """Return the labels as the file will hold them."""
    keys = list(zip(rows["tier"].to_list(), _lanes(rows, origin_ns), strict=True))
    names = lane_names([(_xml(tier), lane) for tier, lane in keys])
    return [
        Label(names[_xml(key[0]), key[1]], start * UNIT, end * UNIT, _xml(label), {}, source)
        for key, (_, start, end), label, source in zip(
            keys, _times(rows, origin_ns), rows["label"].to_list(), rows["source"].to_list(), strict=True
        )
    ]


def _xml(text: str) -> str:
    """Return text without the characters that XML 1.0 forbids."""
    return _NOT_XML.sub("\ufffd", text)


def text(placed: list[Label], end_ns: int) -> str:
    """Return the file."""
    tiers: dict[str, list[tuple[int, Label]]] = {}
    for number, label in enumerate(placed):
        tiers.setdefault(label.tier, []).append((number, label))
    slots = sorted(
        {(label.start_ns, 0, k) for k, label in enumerate(placed)}
        | {(label.end_ns, 1, k) for k, label in enumerate(placed)}
    )
    slot = {(k, end): f"ts{number}" for number, (_, end, k) in enumerate(slots, 1)}
    out = [
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        '<ANNOTATION_DOCUMENT AUTHOR="marcha" DATE="1970-01-01T00:00:00+00:00" FORMAT="3.0" VERSION="3.0" '
        'xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance" '
        f'xsi:noNamespaceSchemaLocation="{_SCHEMA}">\n'
        '    <HEADER MEDIA_FILE="" TIME_UNITS="milliseconds">\n'
        f'        <PROPERTY NAME="lastUsedAnnotationId">{len(placed)}</PROPERTY>\n    </HEADER>\n'
        "    <TIME_ORDER>\n"
    ]
    out += [
        f'        <TIME_SLOT TIME_SLOT_ID="ts{number}" TIME_VALUE="{t // UNIT}"/>\n'
        for number, (t, _, _) in enumerate(slots, 1)
    ]
    out.append("    </TIME_ORDER>\n")
    for tier, members in tiers.items():
        sources = {label.source for _, label in members}
        who = (
            f"ANNOTATOR={_attribute(sources.pop() or '')} "
            if len(sources) == 1 and None not in sources
            else ""
        )
        out.append(f'    <TIER {who}LINGUISTIC_TYPE_REF="default-lt" TIER_ID={_attribute(tier)}>\n')
        for k, label in members:
            value = escape(label.text, {"\r": "&#13;"})
            out.append(
                f'        <ANNOTATION>\n            <ALIGNABLE_ANNOTATION ANNOTATION_ID="a{k + 1}" '
                f'TIME_SLOT_REF1="{slot[k, 0]}" TIME_SLOT_REF2="{slot[k, 1]}">\n'
                f"                <ANNOTATION_VALUE>{value}</ANNOTATION_VALUE>\n"
                "            </ALIGNABLE_ANNOTATION>\n        </ANNOTATION>\n"
            )
        out.append("    </TIER>\n")
    out.append(
        '    <LINGUISTIC_TYPE GRAPHIC_REFERENCES="false" LINGUISTIC_TYPE_ID="default-lt" '
        'TIME_ALIGNABLE="true"/>\n</ANNOTATION_DOCUMENT>\n'
    )
    return "".join(out)


def _attribute(text: str) -> str:
    return quoteattr(_xml(text), {"\r": "&#13;", "\n": "&#10;", "\t": "&#9;"})


def sniff(path: Path, head: bytes) -> bool:
    """Return whether the root element is ELAN's."""
    return b"<ANNOTATION_DOCUMENT" in head


def read(path: Path, data: bytes) -> list[Label]:
    """Return the labels of a file.

    Annotations that refer to others have their times; several below one share its time in equal parts, and
    time slots without a value lie evenly between their neighbours, as ELAN draws them.

    Raises
    ------
    MarchaError
        The file is no XML or no EAF, or an annotation refers to what is not there.
    """
    utf8(path, data)
    if b"<!ENTITY" in data or b"<!DOCTYPE" in data:
        raise MarchaError(f"{path}: declares a document type; ELAN writes none: save it there again")
    try:
        root = ElementTree.fromstring(data)
    except ElementTree.ParseError as error:
        raise MarchaError(f"{path}: line {error.position[0]}: is not XML: {error}") from None
    except (LookupError, ValueError) as error:  # an encoding that is unknown, or of several bytes
        raise MarchaError(f"{path}: is not XML: {error}; save it in UTF-8") from None
    if root.tag != "ANNOTATION_DOCUMENT":
        raise MarchaError(f"{path}: is XML of {root.tag[:60]!r}, not of ELAN; save it as .eaf")
    header = root.find("HEADER")
    unit = UNIT
    if header is not None and header.get("TIME_UNITS", "milliseconds") != "milliseconds":
        raise MarchaError(f"{path}: counts time in {header.get('TIME_UNITS')!r}; save it in milliseconds")
    slots = {k: v * unit for k, v in _slots(path, root).items()}
    spans: dict[str, tuple[int, int]] = {}
    entries: list[tuple[str, str, str, str | None]] = []
    referring: dict[str, list[tuple[str, str]]] = {}
    for tier in root.iter("TIER"):
        tier_name, who = tier.get("TIER_ID", ""), tier.get("ANNOTATOR") or None
        for holder in tier.iter("ANNOTATION"):
            for entry in holder:
                number = entry.get("ANNOTATION_ID", "")
                entries.append((tier_name, number, entry.findtext("ANNOTATION_VALUE") or "", who))
                if entry.tag == "ALIGNABLE_ANNOTATION":
                    try:
                        first, last = (slots[entry.get(f"TIME_SLOT_REF{k}", "")] for k in (1, 2))
                    except KeyError as error:
                        raise MarchaError(
                            f"{path}: tier {tier_name!r}: annotation {number!r}: no time slot {error}; "
                            "save it in ELAN again"
                        ) from None
                    if last < first:
                        raise MarchaError(
                            f"{path}: tier {tier_name!r}: annotation {number!r} ends at {last // UNIT} ms, "
                            f"before {first // UNIT} ms; correct it in ELAN"
                        )
                    spans[number] = first, last
                else:
                    referring.setdefault(tier_name, []).append((number, entry.get("ANNOTATION_REF", "")))
    _refer(path, spans, referring.values())
    order = sorted(range(len(entries)), key=lambda k: (spans[entries[k][1]][0], k))
    return [Label(entries[k][0], *spans[entries[k][1]], entries[k][2], {}, entries[k][3]) for k in order]


def _slots(path: Path, root: ElementTree.Element) -> dict[str, int]:
    """Return the time of each slot in milliseconds."""
    names: list[str] = []
    values: list[int | None] = []
    for slot in root.iter("TIME_SLOT"):
        value = slot.get("TIME_VALUE")
        if value is not None and not re.fullmatch(r"\d{1,12}", value):
            raise MarchaError(
                f"{path}: time slot {slot.get('TIME_SLOT_ID')!r}: {value[:30]!r} is no time in ms"
            )
        names.append(slot.get("TIME_SLOT_ID", ""))
        values.append(None if value is None else int(value))
    stated = [k for k, v in enumerate(values) if v is not None]
    out = {}
    next_stated = 0
    for k, value in enumerate(values):
        if value is None:
            while next_stated < len(stated) and stated[next_stated] < k:
                next_stated += 1
            before, after = (
                (stated[next_stated - 1] if next_stated else None),
                (stated[next_stated] if next_stated < len(stated) else None),
            )
            if before is None or after is None:
                raise MarchaError(f"{path}: time slot {names[k]!r} has no time and none on both sides of it")
            low, high = values[before] or 0, values[after] or 0
            value = low + round((high - low) * (k - before) / (after - before))
        out[names[k]] = value
    return out


def _refer(path: Path, spans: dict[str, tuple[int, int]], tiers: Iterable[list[tuple[str, str]]]) -> None:
    """Give annotations that refer to others their times."""
    pending = [list(members) for members in tiers]
    while pending:
        left = []
        for members in pending:
            if not all(parent in spans for _, parent in members):
                left.append(members)
                continue
            count = Counter(parent for _, parent in members)
            place: Counter[str] = Counter()
            for number, parent in members:
                start, end = spans[parent]
                k, n = place[parent], count[parent]
                spans[number] = start + (end - start) * k // n, start + (end - start) * (k + 1) // n
                place[parent] += 1
        if len(left) == len(pending):
            number, parent = left[0][0]
            raise MarchaError(
                f"{path}: annotation {number!r} refers to {parent!r}, which is not there; save it again"
            )
        pending = left
