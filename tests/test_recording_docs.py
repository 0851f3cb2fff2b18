"""The format page says what the schemas say."""

from __future__ import annotations

import re

import marcha.recording as mr
import pytest
from marcha.recording.describe import updated

from .conftest import ROOT

PAGE = (ROOT / "docs" / "recording-format.md").read_text(encoding="utf-8")


def test_column_tables_are_current():
    assert updated(PAGE) == PAGE, "run: python -m marcha.recording.describe docs/recording-format.md"


@pytest.mark.parametrize("schema", sorted(mr.SCHEMAS))
def test_every_type_and_column_is_described(schema):
    section = PAGE.split(f"### {schema}\n")[1].split("###")[0]
    for column in mr.SCHEMAS[schema].columns:
        assert re.search(rf"\| `(<name>)?{re.escape(column.name)}` \|", section)
        assert column.unit
        assert column.doc


def test_every_finding_kind_is_listed():
    source = "".join(p.read_text(encoding="utf-8") for p in (ROOT / "recording").glob("*.py"))
    kinds = set(re.findall(r"\b_?add(?:_finding)?\(\s*(?:\w+\.)*(?:findings|found),\s*\"([a-z_]+)\"", source))
    kinds |= set(re.findall(r"(?:Finding|said)\(\s*\"([a-z_]+)\"", source))
    assert len(kinds) > 12
    assert {k for k in kinds if f"`{k}`" not in PAGE} == set()
