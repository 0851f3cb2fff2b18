"""Annotations that do not fit: one line that names file, line and remedy, the right exit code, nothing lost."""

from __future__ import annotations

from pathlib import Path

import marcha.recording as mr
import pytest
from marcha.recording.changes import change
from marcha.recording.events import Vocabulary

from .annotation_samples import START_NS, hard_annotations, recording
from .cli_helpers import marcha


@pytest.fixture
def walk(tmp_path: Path) -> Path:
    path = recording(tmp_path / "walk.mcap")
    words = Vocabulary(labels={"flat": "", "stairs": ""}, closed=True)
    change(mr.open(path), path, add=hard_annotations(20), vocabulary={"road": words}, overwrite=True)
    return path


HEAD = "onset\tduration\ttrial_type\ttier\tid\n"
TABLES = {
    "outside": (
        HEAD + "1\t2\ta\tt\tx1\n999\t5\tb\tt\tx2\n",
        "line 3: 1 of 2 annotations lie outside",
        "offset",
    ),
    "other clock": (
        HEAD + "1\t2\ta\tt\tx1\n1700000000\t1\tb\tt\tx2\n",
        "line 3: 1 of 2 annotations lie",
        "offset",
    ),
    "reversed": (HEAD + "1\t2\ta\tt\tx1\n5\t-2\tb\tt\tx2\n", "line 3: ends at", "durations are not negative"),
    "duplicate id": (HEAD + "1\t2\ta\tt\tx1\n3\t2\tb\tt\tx1\n", "line 3: id 'x1' is there twice", "its own"),
    "vocabulary": (
        HEAD + "1\t2\tflat\troad\tx1\n3\t2\tgrass\troad\tx2\n",
        "line 3: tier 'road': label 'grass'",
        "flat, stairs",
    ),
    "no number": (
        HEAD + "1\t2\ta\tt\tx1\nlate\t2\tb\tt\tx2\n",
        "line 3: onset is 'late', not a number",
        "correct",
    ),
    "tier": (HEAD + "1\t2\ta\t/t/\tx1\n", "tier '/t/' must be a plain name", "topic is"),
    "columns": ("onset\tlabel\n1\ta\n", "line 1: has columns onset, label", "needs onset and duration"),
    "empty": ("", "is empty", "needs a header"),
}


@pytest.mark.parametrize("kind", list(TABLES))
def test_a_table_that_does_not_fit_is_one_line(walk: Path, tmp_path: Path, kind: str) -> None:
    text, words, remedy = TABLES[kind]
    (tmp_path / "events.tsv").write_text(text, "utf-8")
    before = walk.read_bytes()
    ran = marcha("annotate", "import", walk, tmp_path / "events.tsv", "--in-place")
    assert ran.code == 1
    assert words in ran.complaint
    assert remedy in ran.complaint
    assert "events.tsv" in ran.complaint or kind == "tier"
    assert walk.read_bytes() == before
    assert ran.out == ""


@pytest.mark.parametrize("name", ["a.tsv", "a.txt", "a.eaf", "a.TextGrid"])
def test_text_that_is_not_utf8_is_named_with_its_line(walk: Path, tmp_path: Path, name: str) -> None:
    heads = {
        "a.tsv": b"onset\tduration\ttrial_type\n",
        "a.txt": b"1.0\t2.0\tok\n",
        "a.eaf": b'<?xml version="1.0" encoding="UTF-8"?>\n<ANNOTATION_DOCUMENT>',
        "a.TextGrid": b'File type = "ooTextFile"\n',
    }
    (tmp_path / name).write_bytes(heads[name] + b"1.0\t2.0\tB\xe4d\n")
    ran = marcha("annotate", "import", walk, tmp_path / name, "--in-place")
    assert ran.code == 1
    assert f"{name}: line 2: byte 0xe4 is not UTF-8; save" in ran.complaint


def test_an_id_that_is_taken_is_named_and_replaced_only_when_asked_for(walk: Path, tmp_path: Path) -> None:
    taken = mr.open(walk).annotations["id"][0]
    (tmp_path / "events.tsv").write_text(HEAD + f"1\t2\tnew\tt\t{taken}\n", "utf-8")
    ran = marcha("annotate", "import", walk, tmp_path / "events.tsv", "--in-place")
    assert ran.code == 1
    assert f"annotation id {taken!r} is taken by" in ran.complaint
    ran = marcha("annotate", "import", walk, tmp_path / "events.tsv", "--in-place", "--replace")
    assert ran.code == 0
    after = mr.open(walk).annotations
    assert after.filter(id=taken)["label"].to_list() == ["new"]
    assert after.height == 20


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (
            ("add", "--label", "x", "--from", "2000", "--to", "2001", "--in-place"),
            "lie outside of the recording",
        ),
        (
            ("add", "--label", "x", "--from", f"@{START_NS // 2}", "--in-place"),
            "lie outside of the recording",
        ),
        (
            ("add", "--label", "x", "--from", "5", "--to", "3", "--in-place"),
            "the end is not before the start",
        ),
        (("add", "--label", "x", "--from", "1", "--tier", "road", "--in-place"), "it has flat, stairs"),
        (("add", "--label", "x", "--from", "1", "--confidence", "2", "--in-place"), "is not between 0"),
        (("list", "--tier", "nope"), "no tier 'nope'; it has gait, "),
        (("export", "-o", "x.eaf", "--tier", "nope"), "no tier 'nope'; it has gait, "),
        (("remove", "--tier", "nope", "--in-place"), "no tier 'nope'; it has gait, "),
        (("diff", "--tier", "nope", "--tier", "none"), "no tier 'nope'; it has gait, "),
        (("remove", "zzz", "--in-place"), "no annotation has an id that begins with 'zzz'"),
        (("undo", "--change", "9", "--in-place"), "there is not change 9 to undo"),
        ((), "give --page or --show"),
        (("--page",), "give either -o NEW.mcap or --in-place"),
        (("--page", "--in-place", "--video", "none.mp4"), "none.mp4: there is no such film"),
    ],
)
def test_what_is_asked_wrongly_is_one_line_and_changes_nothing(
    walk: Path, arguments: tuple[str, ...], words: str
) -> None:
    before = walk.read_bytes()
    command = arguments[:1] if arguments and not arguments[0].startswith("-") else ()
    ran = marcha("annotate", *command, walk, *arguments[len(command) :])
    assert ran.code in (1, 2)
    assert words in ran.complaint
    assert walk.read_bytes() == before
    assert not walk.with_name(f"{walk.name}.draft.jsonl").exists()
