"""docs/formats.md names every format, every option of the simulator and every kind of finding."""

from __future__ import annotations

import re

import pytest
from marcha.ingest.simulate import SCENARIOS, ImuErrors, Line, Options, Style

from .conftest import ROOT
from .test_house import PYPROJECT

PAGE = (ROOT / "docs" / "formats.md").read_text(encoding="utf-8")
OPTIONS = [f for s in (Options, Style, ImuErrors, Line) for f in s.__struct_fields__]
KIND = re.compile(r"report\.(?:drop|repair|loss|note)\(\s*\"([a-z_]+)\"")


@pytest.mark.parametrize("name", PYPROJECT["project"]["entry-points"]["marcha.importers"])
def test_every_format_has_a_section(name: str) -> None:
    assert f"\n## {name}\n" in PAGE


@pytest.mark.parametrize("name", [*OPTIONS, *SCENARIOS])
def test_every_option_of_the_simulator_is_there(name: str) -> None:
    assert f"`{name}`" in PAGE


def test_every_finding_is_explained() -> None:
    sources = [p.read_text(encoding="utf-8") for p in (ROOT / "ingest").glob("*.py")]
    kinds = {kind for text in sources for kind in KIND.findall(text)}
    assert len(kinds) > 12
    assert {k for k in kinds if f"`{k}`" not in PAGE} == set()
