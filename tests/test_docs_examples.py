"""The examples of docs/examples.md prove what they say: each ends in assertions of its own."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

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
