"""The examples of docs/examples.md prove what they say: each ends in assertions of its own."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from marcha.recording import SCHEMAS

from .conftest import ROOT

PAGE = (ROOT / "docs" / "examples.md").read_text(encoding="utf-8")
EXAMPLES = dict(re.findall(r"^## (.*?)\n.*?^```python\n(.*?)^```", PAGE, flags=re.DOTALL | re.MULTILINE))


def test_the_page_has_the_three_proofs() -> None:
    assert len(EXAMPLES) == 3
    assert all(text.count("\nassert ") >= 3 for text in EXAMPLES.values())


@pytest.mark.parametrize("title", EXAMPLES)
def test_an_example_proves_what_it_says(title: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    exec(compile(EXAMPLES[title], f"docs/examples.md: {title}", "exec"), {"__name__": "example"})


def test_the_vocabulary_names_what_there_is() -> None:
    page = (ROOT / "docs" / "vocabulary.md").read_text(encoding="utf-8")
    places = re.findall(r"`((?:\w+/)+(?:\w+\.py)?)`", page)
    assert len(places) > 5
    assert [p for p in places if not (ROOT / p).exists()] == []
    known = {column.name for schema in SCHEMAS.values() for column in schema.columns} | {"quat_w", "t_log_ns"}
    named = {
        c
        for row in page.split("## Columns")[1].split("## ")[0].split("\n")
        for c in re.findall(r"`([\w ]+)`", row)[:1]
    }
    columns = {c for cell in named for c in cell.split() if "_" in c and c != "rot_nb"}
    assert len(columns) > 20
    assert columns - known == set()
