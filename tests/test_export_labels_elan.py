"""ELAN's files: what its published schema (EAF 3.0) asks for, and what comes back after ELAN has saved them."""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree import ElementTree

import marcha.recording as mr
import pytest
from marcha.export import export
from marcha.export.labels import read_labels
from marcha.recording import Recording
from marcha.recording.changes import change

from .annotation_samples import hard_annotations, recording

COUNT = 2_000
ORDER = ("LICENSE", "HEADER", "TIME_ORDER", "TIER", "LINGUISTIC_TYPE", "LOCALE", "LANGUAGE", "CONSTRAINT")
ORDER += ("CONTROLLED_VOCABULARY", "LEXICON_REF", "REF_LINK_SET", "EXTERNAL_REF")
"""Children of the document, in the schema's sequence."""
NCNAME = re.compile(r"[^\W\d][\w.\-]*")
DATE = re.compile(r"-?\d{4,}-\d\d-\d\dT\d\d:\d\d:\d\d(\.\d+)?(Z|[+-]\d\d:\d\d)?")
ATTRIBUTES = {
    "ANNOTATION_DOCUMENT": {"AUTHOR": True, "DATE": True, "VERSION": True, "FORMAT": False},
    "HEADER": {"MEDIA_FILE": False, "TIME_UNITS": False},
    "PROPERTY": {"NAME": False},
    "TIME_ORDER": {},
    "TIME_SLOT": {"TIME_SLOT_ID": True, "TIME_VALUE": False},
    "TIER": {
        "TIER_ID": True,
        "PARTICIPANT": False,
        "ANNOTATOR": False,
        "LINGUISTIC_TYPE_REF": True,
        "DEFAULT_LOCALE": False,
        "PARENT_REF": False,
        "EXT_REF": False,
        "LANG_REF": False,
    },
    "ANNOTATION": {},
    "ALIGNABLE_ANNOTATION": {
        "ANNOTATION_ID": True,
        "TIME_SLOT_REF1": True,
        "TIME_SLOT_REF2": True,
        "SVG_REF": False,
        "EXT_REF": False,
        "LANG_REF": False,
        "CVE_REF": False,
    },
    "ANNOTATION_VALUE": {},
    "LINGUISTIC_TYPE": {
        "LINGUISTIC_TYPE_ID": True,
        "TIME_ALIGNABLE": False,
        "CONSTRAINTS": False,
        "GRAPHIC_REFERENCES": False,
        "CONTROLLED_VOCABULARY_REF": False,
        "EXT_REF": False,
        "LEXICON_REF": False,
    },
}
"""Attributes of each element that marcha writes, and whether the schema requires them."""
CHILDREN = {
    "HEADER": ("MEDIA_DESCRIPTOR", "LINKED_FILE_DESCRIPTOR", "PROPERTY"),
    "TIME_ORDER": ("TIME_SLOT",),
    "TIER": ("ANNOTATION",),
    "ANNOTATION": ("ALIGNABLE_ANNOTATION",),
    "ALIGNABLE_ANNOTATION": ("ANNOTATION_VALUE",),
}


@pytest.fixture(scope="module")
def rec(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    folder = tmp_path_factory.mktemp("elan")
    change(mr.open(recording(folder / "raw.mcap")), folder / "a.mcap", add=hard_annotations(COUNT))
    return mr.open(folder / "a.mcap")


@pytest.fixture(scope="module")
def eaf(rec: Recording) -> Path:
    export(rec, "eaf", rec.path.with_name("x.eaf"))
    return rec.path.with_name("x.eaf")


def test_the_file_is_what_the_schema_asks_for(eaf: Path) -> None:
    """The rules of EAFv3.0.xsd for every element that is written, stated here: the schema is not ours to ship."""
    root = ElementTree.parse(eaf).getroot()
    assert root.tag == "ANNOTATION_DOCUMENT"
    places = [ORDER.index(child.tag) for child in root]
    assert places == sorted(places)
    assert [places.count(ORDER.index(name)) for name in ("HEADER", "TIME_ORDER")] == [1, 1]
    schema = "{http://www.w3.org/2001/XMLSchema-instance}noNamespaceSchemaLocation"
    for element in root.iter():
        known = ATTRIBUTES[element.tag]
        assert {k for k in element.attrib if k != schema} <= known.keys(), element.tag
        assert {k for k, required in known.items() if required} <= set(element.attrib), element.tag
        inner = [CHILDREN[element.tag].index(c.tag) for c in element] if element.tag in CHILDREN else []
        assert inner == sorted(inner)
        if element.tag in ("ANNOTATION", "ALIGNABLE_ANNOTATION"):
            assert len(element) == 1
    assert DATE.fullmatch(root.attrib["DATE"])
    assert root.find("HEADER").attrib["TIME_UNITS"] in ("NTSC-frames", "PAL-frames", "milliseconds")  # type: ignore[union-attr]
    slots = [s.attrib["TIME_SLOT_ID"] for s in root.iter("TIME_SLOT")]
    names = [a.attrib["ANNOTATION_ID"] for a in root.iter("ALIGNABLE_ANNOTATION")]
    assert len({*slots, *names}) == len(slots) + len(names)  # xsd:ID is unique in the document
    assert all(NCNAME.fullmatch(name) for name in (*slots, *names))
    values = [int(s.attrib["TIME_VALUE"]) for s in root.iter("TIME_SLOT")]
    assert all(0 <= v < 2**32 for v in values)  # xsd:unsignedInt
    assert values == sorted(values)
    known_slots = set(slots)
    for entry in root.iter("ALIGNABLE_ANNOTATION"):
        assert {entry.attrib["TIME_SLOT_REF1"], entry.attrib["TIME_SLOT_REF2"]} <= known_slots
    tiers = [t.attrib["TIER_ID"] for t in root.iter("TIER")]
    assert len(set(tiers)) == len(tiers)
    types = {t.attrib["LINGUISTIC_TYPE_ID"] for t in root.iter("LINGUISTIC_TYPE")}
    assert {t.attrib["LINGUISTIC_TYPE_REF"] for t in root.iter("TIER")} <= types
    for kind in root.iter("LINGUISTIC_TYPE"):
        assert {kind.get("TIME_ALIGNABLE"), kind.get("GRAPHIC_REFERENCES")} <= {"true", "false"}


def saved_by_elan(eaf: Path, out: Path) -> None:
    """Write a file as ELAN does after opening it: its own ids and header, slots and annotations by time, a locale,
    its constraints, tiers in another order.
    """
    root = ElementTree.parse(eaf).getroot()
    order = root.find("TIME_ORDER")
    header = root.find("HEADER")
    assert order is not None
    assert header is not None
    times = {s.attrib["TIME_SLOT_ID"]: int(s.attrib["TIME_VALUE"]) for s in order}
    order.clear()
    entries = sorted(
        root.iter("ALIGNABLE_ANNOTATION"),
        key=lambda e: (times[e.attrib["TIME_SLOT_REF1"]], e.attrib["ANNOTATION_ID"]),
    )
    found: list[tuple[int, ElementTree.Element, str]] = []
    for number, entry in enumerate(entries, 1):
        entry.set("ANNOTATION_ID", f"a{number}")
        for name in ("TIME_SLOT_REF1", "TIME_SLOT_REF2"):
            found.append((times[entry.attrib[name]], entry, name))
    found.sort(key=lambda f: f[0])
    for number, (t, entry, name) in enumerate(found, 1):
        entry.set(name, f"ts{number}")
        ElementTree.SubElement(order, "TIME_SLOT", TIME_SLOT_ID=f"ts{number}", TIME_VALUE=str(t))
    for tier in root.iter("TIER"):
        tier[:] = sorted(tier, key=lambda a: int(a[0].attrib["TIME_SLOT_REF1"][2:]))
        tier.set("DEFAULT_LOCALE", "en")
    tiers = root.findall("TIER")
    for tier in tiers:
        root.remove(tier)
    at = list(root).index(order) + 1
    root[at:at] = tiers[::-1]
    header.insert(
        0, ElementTree.Element("MEDIA_DESCRIPTOR", MEDIA_URL="file:///walk.mp4", MIME_TYPE="video/mp4")
    )
    ElementTree.SubElement(header, "PROPERTY", NAME="URN").text = "urn:nl-mpi-tools-elan-eaf:1"
    ElementTree.SubElement(root, "LOCALE", COUNTRY_CODE="US", LANGUAGE_CODE="en")
    about = "Time alignable annotations within the parent annotation's time interval, gaps are allowed"
    ElementTree.SubElement(root, "CONSTRAINT", DESCRIPTION=about, STEREOTYPE="Included_In")
    ElementTree.ElementTree(root).write(out, encoding="UTF-8", xml_declaration=True)


def test_what_elan_saved_again_comes_back_whole(rec: Recording, eaf: Path, tmp_path: Path) -> None:
    again = tmp_path / eaf.name
    saved_by_elan(eaf, again)
    for side in eaf.parent.glob(f"{eaf.name}.*"):
        (tmp_path / side.name).write_bytes(side.read_bytes())
    assert len(list(tmp_path.iterdir())) == 2
    found = read_labels(again, rec)
    key = ["start_ns", "id"]
    assert found.annotations.sort(key).equals(rec.annotations.sort(key))
    assert found.notes == []
