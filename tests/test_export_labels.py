"""Labels of other tools, there and back: what a format cannot hold is in its side file."""

from __future__ import annotations

import itertools
from pathlib import Path
from xml.etree import ElementTree

import marcha.recording as mr
import polars as pl
import pytest
from hypothesis import given
from hypothesis import strategies as st
from marcha.export import export
from marcha.export.labels import WRITTEN, read_labels
from marcha.export.labels.side import lanes, side_path
from marcha.recording import MarchaError, Recording
from marcha.recording.annotations import COLUMNS
from marcha.recording.changes import change
from pympi.Elan import Eaf
from pympi.Praat import TextGrid

from .annotation_samples import START_NS, hard_annotations, recording

COUNT = 10_000
RESOLUTION = {"audacity": 1_000, "eaf": 1_000_000, "textgrid": 1}


@pytest.fixture(scope="module")
def rec(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    folder = tmp_path_factory.mktemp("labels")
    rec = mr.open(recording(folder / "raw.mcap"))
    change(rec, folder / "a.mcap", add=hard_annotations(COUNT))
    return mr.open(folder / "a.mcap")


@pytest.fixture(scope="module")
def files(rec: Recording) -> dict[str, Path]:
    out = {n: rec.path.with_name(f"x{m.suffix}") for n, m in WRITTEN.items()}
    for name, path in (*out.items(), ("events", rec.path.with_name("x.tsv"))):
        export(rec, name, path)
    return {**out, "events": rec.path.with_name("x.tsv")}


@pytest.mark.parametrize("name", ["events", *WRITTEN])
def test_everything_comes_back(rec: Recording, files: dict[str, Path], name: str) -> None:
    found = read_labels(files[name], rec)
    assert found.notes == []
    key = ["start_ns", "id"]
    assert found.annotations.sort(key).equals(rec.annotations.sort(key))


@pytest.mark.parametrize("name", list(WRITTEN))
def test_without_the_side_file_times_and_texts_are_right(
    rec: Recording, files: dict[str, Path], name: str, tmp_path: Path
) -> None:
    bare = tmp_path / files[name].name
    bare.write_bytes(files[name].read_bytes())
    found = read_labels(bare, rec).annotations
    expected = rec.annotations
    if name == "textgrid":  # an interval without text is the space between labels
        expected = expected.filter(
            (pl.col("label").str.strip_chars() != "") | (pl.col("end_ns") == pl.col("start_ns"))
        )
    assert found.height == expected.height
    for column in ("start_ns", "end_ns"):
        error = (found[column].sort() - expected[column].sort()).abs().max()
        assert isinstance(error, int)
        assert error <= RESOLUTION[name]
    if name != "audacity":
        plain = expected.filter(pl.col("label").str.contains(r"^[^\x00-\x1f]*$"))["label"].sort()
        assert found.filter(pl.col("label").is_in(plain.unique().implode()))["label"].sort().equals(plain)


def test_elan_files_have_no_overlap_in_a_tier_and_other_readers_agree(
    rec: Recording, files: dict[str, Path]
) -> None:
    eaf = Eaf(str(files["eaf"]))
    read = 0
    for tier in eaf.get_tier_names():
        rows = sorted(row[:2] for row in eaf.get_annotation_data_for_tier(tier))
        assert all(a < b for a, b in rows)
        assert all(a[1] <= b[0] for a, b in itertools.pairwise(rows))
        read += len(rows)
    assert read == COUNT


def test_praat_files_have_no_gap_in_a_tier_and_other_readers_agree(
    files: dict[str, Path], rec: Recording
) -> None:
    grid = TextGrid(str(files["textgrid"]))
    points = sum(len(list(t.get_intervals(sort=True))) for t in grid.get_tiers() if t.tier_type == "TextTier")
    assert points == (rec.annotations["start_ns"] == rec.annotations["end_ns"]).sum()
    for tier in grid.get_tiers():
        if tier.tier_type == "IntervalTier":
            rows = list(tier.get_intervals(sort=True))
            assert rows[0][0] == 0
            assert all(a[1] == b[0] for a, b in itertools.pairwise(rows))


def test_a_label_that_was_moved_keeps_its_tier_and_it_is_said(rec: Recording, tmp_path: Path) -> None:
    path = tmp_path / "m.txt"
    export(rec, "audacity", path)
    lines = path.read_text("utf-8").split("\n")
    k = next(k for k, line in enumerate(lines) if "[terrain] ходьба" in line)
    lines[k] = "1.5\t2.25\t[terrain] moved"
    path.write_text("\n".join(lines), "utf-8")
    found = read_labels(path, rec)
    (row,) = found.annotations.filter(label="moved").rows(named=True)
    assert (row["tier"], row["start_ns"], row["end_ns"]) == (
        "terrain",
        START_NS + 1_500_000_000,
        START_NS + 2_250_000_000,
    )
    assert found.notes == [
        f"1 of {COUNT} labels are not as exported: they have the file's times and no source, "
        "confidence or note"
    ]


EAF = """<?xml version="1.0" encoding="UTF-8"?>
<ANNOTATION_DOCUMENT AUTHOR="" DATE="2020-01-01T00:00:00+01:00" FORMAT="{version}" VERSION="{version}">
<HEADER MEDIA_FILE="" TIME_UNITS="milliseconds"/><TIME_ORDER><TIME_SLOT TIME_SLOT_ID="ts1" TIME_VALUE="1000"/>
<TIME_SLOT TIME_SLOT_ID="ts2"/><TIME_SLOT TIME_SLOT_ID="ts3" TIME_VALUE="3000"/></TIME_ORDER>
<TIER LINGUISTIC_TYPE_REF="d" TIER_ID="phase" ANNOTATOR="eva">
<ANNOTATION><ALIGNABLE_ANNOTATION ANNOTATION_ID="a1" TIME_SLOT_REF1="ts1" TIME_SLOT_REF2="ts2">
<ANNOTATION_VALUE>stance</ANNOTATION_VALUE></ALIGNABLE_ANNOTATION></ANNOTATION>
<ANNOTATION><ALIGNABLE_ANNOTATION ANNOTATION_ID="a2" TIME_SLOT_REF1="ts2" TIME_SLOT_REF2="ts3">
<ANNOTATION_VALUE/></ALIGNABLE_ANNOTATION></ANNOTATION></TIER>
<TIER LINGUISTIC_TYPE_REF="s" TIER_ID="part" PARENT_REF="phase">
<ANNOTATION><REF_ANNOTATION ANNOTATION_ID="a3" ANNOTATION_REF="a1"><ANNOTATION_VALUE>heel</ANNOTATION_VALUE>
</REF_ANNOTATION></ANNOTATION>
<ANNOTATION><REF_ANNOTATION ANNOTATION_ID="a4" ANNOTATION_REF="a1" PREVIOUS_ANNOTATION="a3">
<ANNOTATION_VALUE>flat</ANNOTATION_VALUE></REF_ANNOTATION></ANNOTATION></TIER>
<LINGUISTIC_TYPE LINGUISTIC_TYPE_ID="d" TIME_ALIGNABLE="true"/></ANNOTATION_DOCUMENT>
"""


@pytest.mark.parametrize("version", ["2.7", "2.8", "3.0"])
def test_elan_s_own_files_with_open_slots_and_referring_tiers(
    rec: Recording, tmp_path: Path, version: str
) -> None:
    (tmp_path / "e.eaf").write_text(EAF.format(version=version))
    table = read_labels(tmp_path / "e.eaf", rec).annotations
    rows = [
        (r["tier"], (r["start_ns"] - START_NS) // 10**6, (r["end_ns"] - START_NS) // 10**6, r["label"])
        for r in table.rows(named=True)
    ]
    assert rows == [
        ("phase", 1000, 2000, "stance"),
        ("part", 1000, 1500, "heel"),
        ("part", 1500, 2000, "flat"),
        ("phase", 2000, 3000, ""),
    ]
    assert table["source"].to_list()[0] == "eva"


def test_elan_opens_what_pympi_saves_again(rec: Recording, files: dict[str, Path], tmp_path: Path) -> None:
    eaf = Eaf(str(files["eaf"]))
    eaf.to_file(str(tmp_path / "again.eaf"))
    assert read_labels(tmp_path / "again.eaf", rec).annotations.height == COUNT


def test_praat_s_short_form_and_utf16(rec: Recording, tmp_path: Path) -> None:
    text = (
        'File type = "ooTextFile"\nObject class = "TextGrid"\n\n0\n2\n<exists>\n2\n'
        '"IntervalTier"\n"a"\n0\n2\n2\n0\n1\n""\n1\n2\n"say ""hi"""\n'
        '"TextTier"\n"p"\n0\n2\n1\n0.5\n"üb"\n'
    )
    (tmp_path / "s.TextGrid").write_bytes(text.encode("utf-16"))
    rows = read_labels(tmp_path / "s.TextGrid", rec).annotations.select("tier", "label").rows()
    assert rows == [("p", "üb"), ("a", 'say "hi"')]


def test_audacity_frequencies_are_kept(rec: Recording, tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("1.0\t1.0\tpoint\n2.5\t3.5\tregion\n\\\t100.0\t200.5\n")
    table = read_labels(tmp_path / "a.txt", rec).annotations
    assert table["metadata"].to_list() == ["{}", '{"high_hz":"200.5","low_hz":"100.0"}']
    assert table["tier"].to_list() == ["a", "a"]


BAD = [
    ("a.txt", b"1\t0.5\tx\n", "line 1: ends at 0.5 s, before 1 s"),
    ("a.txt", b"1\t2\tx\n1\tabc\ty\n", "line 2: 'abc' is not a time"),
    ("a.txt", b"1\t2\t\xff\n", "line 1: byte 0xff is not UTF-8"),
    ("a.txt", b"1\t2000\tx\n", "outside of the recording"),
    ("a.eaf", b"<ANNOTATION_DOCUMENT>", "is not XML"),
    ("a.eaf", b'<!DOCTYPE x [<!ENTITY a "b">]><ANNOTATION_DOCUMENT/>', "declares a document type"),
    (
        "a.TextGrid",
        b'File type = "ooTextFile"\nObject class = "TextGrid"\n0\n2\n<exists>\n1\n"Interv',
        "ends where",
    ),
    ("a.TextGrid", b"ooBinaryFile\x08TextGrid", "is a binary TextGrid"),
    ("a.tsv", b"onset\tduration\ttrial_type\tconfidence\n1\t1\tx\tsure\n", "line 2: confidence is 'sure'"),
    ("a.csv", "onset,duration,label\n1,1,ä\n".encode("latin-1"), "line 2: byte 0xe4 is not UTF-8"),
]


@pytest.mark.parametrize(("name", "content", "says"), BAD, ids=[f"{k}-{b[0]}" for k, b in enumerate(BAD)])
def test_a_broken_file_is_one_line(
    rec: Recording, tmp_path: Path, name: str, content: bytes, says: str
) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(MarchaError, match=says) as error:
        read_labels(tmp_path / name, rec)
    assert "\n" not in str(error.value)
    assert name in str(error.value) or "outside" in says


@given(st.binary(max_size=300), st.sampled_from(["a.eaf", "a.TextGrid", "a.txt", "a.tsv", "a.c3d"]))
def test_any_bytes_are_read_or_refused(
    tmp_path_factory: pytest.TempPathFactory, data: bytes, name: str
) -> None:
    folder = tmp_path_factory.mktemp("b")
    (folder / name).write_bytes(
        {"a.eaf": b"<ANNOTATION_DOCUMENT>", "a.TextGrid": b'"ooTextFile" "TextGrid" 0 1 <exists> '}.get(
            name, b""
        )
        + data
    )
    if not _MADE:
        _MADE.append(mr.open(recording(folder / "r.mcap")))
    try:
        assert read_labels(folder / name, _MADE[0]).annotations.columns == list(COLUMNS)
    except MarchaError as error:
        said = str(error)
    else:
        said = ""
    assert "\n" not in said


_MADE: list[Recording] = []


def test_extra_columns_of_a_table_become_metadata(rec: Recording, tmp_path: Path) -> None:
    (tmp_path / "e.tsv").write_text("onset\tduration\ttrial_type\tresponse_time\n1\tn/a\tgo\t0.3\n")
    (row,) = read_labels(tmp_path / "e.tsv", rec).annotations.rows(named=True)
    assert (row["start_ns"], row["end_ns"], row["metadata"]) == (
        START_NS + 10**9,
        START_NS + 10**9,
        '{"response_time":"0.3"}',
    )


def test_an_offset_moves_the_file_s_zero(rec: Recording, tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("1.0\t2.0\tx\n")
    table = read_labels(tmp_path / "a.txt", rec, offset_ns=5 * 10**9).annotations
    assert table["start_ns"].to_list() == [START_NS + 6 * 10**9]


def test_a_damaged_side_file_is_named(rec: Recording, tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("1.0\t2.0\tx\n")
    side_path(tmp_path / "a.txt").write_text("{")
    with pytest.raises(MarchaError, match=r"a\.txt\.marcha\.json: is no side file"):
        read_labels(tmp_path / "a.txt", rec)


@given(st.lists(st.tuples(st.sampled_from("ab"), st.integers(0, 30), st.integers(1, 9)), max_size=30))
def test_lanes_hold_no_overlap_and_are_as_few_as_can_be(rows: list[tuple[str, int, int]]) -> None:
    spans = sorted(((t, a, a + n) for t, a, n in rows), key=lambda r: r[1])
    found = lanes(spans)
    for tier in "ab":
        mine = [(a, b, lane) for (t, a, b), lane in zip(spans, found, strict=True) if t == tier]
        for lane in {m[2] for m in mine}:
            rest = [(a, b) for a, b, k in mine if k == lane]
            assert all(x[1] <= y[0] for x, y in itertools.pairwise(rest))
        most = max((sum(a <= t < b for a, b, _ in mine) for t in range(40)), default=0)
        assert len({m[2] for m in mine}) == most


def test_an_eaf_file_is_well_formed_xml(files: dict[str, Path]) -> None:
    root = ElementTree.parse(files["eaf"]).getroot()
    assert [child.tag for child in root][:2] == ["HEADER", "TIME_ORDER"]
    times = [int(s.get("TIME_VALUE", "-1")) for s in root.iter("TIME_SLOT")]
    assert times == sorted(times)
