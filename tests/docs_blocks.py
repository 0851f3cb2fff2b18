"""The fenced blocks of the documents, and how their commands are run."""

from __future__ import annotations

import re
import shlex
from dataclasses import dataclass
from pathlib import Path

from .conftest import ROOT

PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")])
FENCE = re.compile(
    r"^(?P<before><!-- (?P<remark>[^\n]*) -->\n)?```(?P<language>\w*)\n(?P<text>.*?)^```$",
    re.MULTILINE | re.DOTALL,
)
EXIT_CODE = re.compile(r"#.*\bexit code (\d+)")


@dataclass(frozen=True)
class Block:
    """A fenced block: its language, text, the comment right above it, and its line in the page."""

    page: str
    line: int
    language: str
    text: str
    remark: str

    @property
    def runs(self) -> bool:
        """Whether a reader's screen would show what the test sees: not marked ``<!-- not run: why -->``."""
        return not self.remark.startswith("not run: ")


@dataclass(frozen=True)
class Command:
    """One line that starts ``marcha``: its words and the exit code that the page tells."""

    words: tuple[str, ...]
    code: int


def read(page: Path) -> str:
    """Return a page's text."""
    return page.read_text(encoding="utf-8")


def blocks(page: Path, *languages: str) -> list[Block]:
    """Return the fenced blocks of a page, of certain languages if any are named."""
    text = read(page)
    return [
        Block(page.name, text.count("\n", 0, m.start()) + 1, m["language"], m["text"], m["remark"] or "")
        for m in FENCE.finditer(text)
        if not languages or m["language"] in languages
    ]


def commands(text: str) -> list[Command]:
    """Return the marcha commands of a block of shell lines."""
    found = []
    for line in text.splitlines():
        words = shlex.split(line, comments=True)
        if words and words[0] == "marcha":
            code = EXIT_CODE.search(line)
            found.append(Command(tuple(words[1:]), int(code[1]) if code else 0))
    return found


def squeezed(text: str) -> list[str]:
    """Return lines with runs of blanks as one, empty ones left out."""
    return [" ".join(line.split()) for line in text.splitlines() if line.strip()]
