"""A page of tables and pictures as one HTML file, readable without a network."""

from __future__ import annotations

import base64
import math
from collections.abc import Iterable, Sequence
from html import escape
from importlib import resources
from string import Template

import msgspec


class PagePicture(msgspec.Struct, frozen=True):
    """A drawn figure.

    Attributes
    ----------
    name : str
        File name without suffix.
    section : str
        Part of the report that it belongs to.
    caption : str
        What it shows, for the report and for readers who cannot see it.
    png, svg : bytes
        The picture.
    """

    name: str
    section: str
    caption: str
    png: bytes
    svg: bytes


def number(value: float | None, digits: int = 3) -> str:
    """Return a number with ``digits`` significant digits, or a dash where there is none."""
    if value is None or not math.isfinite(value):
        return "–"
    if value == 0:
        return "0"
    exponent = math.floor(math.log10(abs(value)))
    if -4 <= exponent < 5:
        return f"{value:.{max(0, digits - 1 - exponent)}f}"
    return f"{value:.{digits - 1}e}"


class Html:
    """Collects the body of the page."""

    def __init__(self) -> None:
        self.parts: list[str] = []
        self.sections: list[tuple[str, str]] = []

    def section(self, title: str) -> None:
        """Start a section."""
        name = f"s{len(self.sections) + 1}"
        self.sections.append((name, title))
        self.parts.append(f'<h2 id="{name}">{escape(title)}</h2>')

    def heading(self, title: str) -> None:
        """Start a part of a section."""
        self.parts.append(f"<h3>{escape(title)}</h3>")

    def text(self, text: str, kind: str = "") -> None:
        """Add a paragraph of plain text."""
        self.parts.append(f"<p{f' class={kind}' if kind else ''}>{escape(text)}</p>")

    def warning(self, lines: Sequence[str]) -> None:
        """Add lines that must be seen."""
        if lines:
            items = "<br>".join(escape(line) for line in lines)
            self.parts.append(f'<div class="warning">{items}</div>')

    def table(self, head: Sequence[str], rows: Iterable[Sequence[str]], text_columns: int = 1) -> None:
        """Add a table; cells are HTML already, the first ``text_columns`` columns are words.

        A row of one cell is a heading across the table. A cell that starts with ``@class `` has that class.
        """

        def cell(tag: str, index: int, content: str) -> str:
            classes = ["text"] if index < text_columns else []
            if content.startswith("@"):
                extra, _, content = content[1:].partition(" ")
                classes.append(extra)
            attribute = f' class="{" ".join(classes)}"' if classes else ""
            return f"<{tag}{attribute}>{content}</{tag}>"

        out = [
            '<div class="scroll"><table><tr>',
            *(cell("th", i, escape(h)) for i, h in enumerate(head)),
            "</tr>",
        ]
        for row in rows:
            if len(row) == 1:
                out.append(f'<tr class="section"><td colspan="{len(head)}">{row[0]}</td></tr>')
            else:
                out += ["<tr>", *(cell("td", i, c) for i, c in enumerate(row)), "</tr>"]
        self.parts.append("".join([*out, "</table></div>"]))

    def pictures(self, pictures: Iterable[PagePicture]) -> None:
        """Add pictures with their captions."""
        for picture in pictures:
            data = base64.b64encode(picture.png).decode()
            caption = escape(picture.caption)
            self.parts.append(
                f'<figure><img alt="{caption}" src="data:image/png;base64,{data}">'
                f"<figcaption>{caption}</figcaption></figure>"
            )

    def body(self) -> str:
        """Return the page's body with its table of contents under the introduction."""
        links = "".join(f'<a href="#{name}">{escape(title)}</a>' for name, title in self.sections)
        first = next((i for i, part in enumerate(self.parts) if part.startswith("<h2")), len(self.parts))
        return "\n".join([*self.parts[:first], f"<nav>{links}</nav>", *self.parts[first:]])

    def page(self, title: str) -> str:
        """Return the whole page: one file that needs no other."""
        template = resources.files(__name__.rpartition(".")[0]) / "page.html"
        return Template(template.read_text("utf-8")).substitute(title=escape(title), body=self.body())
