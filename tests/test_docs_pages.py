"""The documents as a whole: links lead somewhere, pictures are small, nothing is missing from the index."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

import pytest

from .conftest import ROOT
from .docs_blocks import FENCE, PAGES, blocks, read
from .test_house import PYPROJECT

DOCS = ROOT / "docs"
IMAGES = sorted((DOCS / "images").iterdir())
LINK = re.compile(r"\]\(([^)\s]+)\)")
MAKE = re.compile(r"\bmake ([a-z]+)\b")
README = ROOT / "README.md"


def links(page: Path) -> list[str]:
    """Return the targets of links and pictures, those in code left out."""
    return LINK.findall(re.sub(r"`[^`\n]*`", "", FENCE.sub("", read(page))))


def anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings, as GitHub makes them."""
    found: set[str] = set()
    for title in re.findall(r"^#+ (.*)$", FENCE.sub("", read(page)), flags=re.MULTILINE):
        kept = re.sub(r"[^\w\- ]", "", title.lower().replace("`", "")).replace(" ", "-")
        found.add(kept)
    return found


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_every_link_leads_somewhere(page: Path) -> None:
    broken = []
    for link in links(page):
        if link.startswith(("http://", "https://")):
            continue
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        if not target.exists() or ROOT not in target.parents or (anchor and anchor not in anchors(target)):
            broken.append(link)
    assert not broken


def test_links_are_found() -> None:
    assert {"docs/README.md", "docs/images/figure.png", "LICENSE"} <= set(links(README))
    assert "how-to-read-the-report" in anchors(DOCS / "study.md")


def test_the_index_names_every_page() -> None:
    pages = {p.name for p in DOCS.glob("*.md")} - {"README.md"}
    assert pages <= set(links(DOCS / "README.md"))


def test_every_picture_is_used_somewhere() -> None:
    used = {Path(link).name for page in PAGES for link in links(page)}
    assert {p.name for p in IMAGES} <= used


def test_pictures_are_small() -> None:
    sizes = {p.name: p.stat().st_size for p in IMAGES}
    assert {n: s for n, s in sizes.items() if s > 300_000} == {}
    assert sum(sizes.values()) < 2_000_000
    assert all(p.read_bytes().startswith(b"\x89PNG") for p in IMAGES)


def test_every_picture_has_a_text_for_those_who_cannot_see_it() -> None:
    for page in PAGES:
        assert "![](" not in read(page), page.name


def test_the_readme_starts_with_two_commands_that_exist() -> None:
    targets = set(
        re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), flags=re.MULTILINE)
    )
    first = blocks(README)[0]
    assert [line.split("#")[0].split() for line in first.text.splitlines()] == [
        ["make", "demo"],
        ["make", "test"],
    ]
    for page in PAGES:
        code = "\n".join([*(b.text for b in blocks(page)), *re.findall(r"`(make [^`]*)`", read(page))])
        assert set(MAKE.findall(code)) <= targets, page.name


def test_without_make_the_same_is_typed() -> None:
    """What stands beside the two commands is what the Makefile does."""
    recipe = (ROOT / "Makefile").read_text(encoding="utf-8")
    by_hand = blocks(README)[1].text
    for words in ('--upgrade "pip>=25.1"', "--group dev", "-e .", "demo -o demo", "-m venv", "-m pytest"):
        assert words in recipe
        assert words in by_hand
    assert "dev" in PYPROJECT["dependency-groups"]


@pytest.mark.parametrize("group", ["importers", "estimators", "exporters", "metrics"])
def test_what_is_registered_is_in_the_readme(group: str) -> None:
    text = read(README)
    assert f"marcha.{group}" in text
    names = PYPROJECT["project"]["entry-points"][f"marcha.{group}"]
    if group in ("importers", "estimators"):
        assert [n for n in names if f"| `{n}` |" not in text] == []


def test_the_readme_promises_what_the_benchmarks_check() -> None:
    """The table of promises and ``benchmarks/`` name the same limits."""
    text = read(README).split("## Speed")[1].split("\n## ")[0]
    checked = "".join(p.read_text(encoding="utf-8") for p in (ROOT / "benchmarks").glob("*.py"))
    for ours, theirs in (("1.7 times", "≥ 1.7 times"), ("4 times", "≤ 4"), ("1000 MB", "≤ 1000 MB")):
        assert ours in text
        assert theirs in checked


def test_changelog_has_what_is_not_released_yet_and_this_version() -> None:
    text = read(ROOT / "CHANGELOG.md")
    sections = re.findall(r"^## \[(.+?)\]", text, flags=re.MULTILINE)
    assert sections[0] == "Unreleased"
    assert (
        len(text.split("## [Unreleased]")[1].split("\n## [")[0]) > 200
        or PYPROJECT["project"]["version"] in sections
    )


def test_the_architecture_page_names_what_exists() -> None:
    text = read(DOCS / "architecture.md")
    packages = {"mr": "recording", "rp": "replay"}
    named = set(
        re.findall(r"(?<![\w./`-])(mr|rp|viz|ingest|export|study|recording)\.([A-Za-z_][\w.]*)", text)
    )
    assert len(named) > 20
    for package, path in named:
        place = f"marcha.{packages.get(package, package)}"
        thing = importlib.import_module(place)
        for part in path.rstrip(".").split("."):
            place += f".{part}"
            thing = getattr(thing, part, None) or importlib.import_module(place)
