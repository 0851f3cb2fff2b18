"""What the commands print: one JSON object or compact tables on stdout, progress on stderr."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from .options import Common, plain

LONGEST = 120
"""Characters of a cell that is cut on a terminal (JSON, hashes); pipes and ``--json`` have it whole."""


GUTTER = 2
"""Characters between the columns of a table."""


@dataclass(frozen=True)
class Heading:
    """A line of text between tables."""

    text: str


@dataclass(frozen=True)
class TextTable:
    """Rows under column titles (with units); numbers are aligned right.

    Attributes
    ----------
    columns : sequence of str
        Titles; one that starts with ``>`` is aligned right.
    rows : sequence of sequences
        Cells; None is shown as ``–``, a float with four significant digits.
    fold : bool
        On a terminal that is too narrow, show the columns in several tables, each with the first column.
    cut : bool
        On a terminal, cut cells that are longer than :data:`LONGEST`.
    """

    columns: Sequence[str]
    rows: Sequence[Sequence[Any]]
    fold: bool = False
    cut: bool = False


@dataclass(frozen=True)
class Outcome:
    """What a command has to say.

    Attributes
    ----------
    document : dict
        The object that ``--json`` prints.
    lines : sequence of Heading or TextTable
        The same for a person.
    code : int
        Exit code.
    """

    document: dict[str, Any]
    lines: Sequence[Heading | TextTable] = field(default_factory=tuple)
    code: int = 0


def emit(outcome: Outcome, *, as_json: bool) -> None:
    """Print an outcome on standard output."""
    if as_json:
        emit_json(outcome.document)
        return
    from rich.console import Console

    out = Console(highlight=False, markup=False, emoji=False)
    wide = Console(highlight=False, markup=False, emoji=False, width=10_000)  # a table is never cut to fit
    for part in outcome.lines:
        if isinstance(part, Heading):
            out.print("\n".join(printable(line) for line in part.text.split("\n")), soft_wrap=True)
        elif part.rows:
            pieces = folded(part, out.width) if part.fold and out.is_terminal else [part]
            for k, piece in enumerate(pieces):
                if k:
                    out.print()
                wide.print(_grid(piece, terminal=out.is_terminal))


def emit_json(document: dict[str, Any]) -> None:
    """Print one JSON object on standard output; what is not a number (NaN, infinity) becomes null."""
    import msgspec

    try:
        text = msgspec.json.encode(document, enc_hook=plain)
    except UnicodeEncodeError:  # a file's name that is no UTF-8
        text = msgspec.json.encode(_encodable(document), enc_hook=plain)
    # JSON leaves what turns the direction of writing, and C1, as they are: a terminal does not. Another encoding
    # than UTF-8 gets ASCII.
    plain_text = str.isprintable if _is_utf8(sys.stdout) else str.isascii
    sys.stdout.write("".join(c if plain_text(c) else json.dumps(c)[1:-1] for c in text.decode()) + "\n")


def _is_utf8(stream: Any) -> bool:
    return (getattr(stream, "encoding", None) or "utf-8").lower().replace("-", "") == "utf8"


def _encodable(value: Any) -> Any:
    """Return a document whose texts are Unicode: bytes of a file's name that are none become escapes."""
    if isinstance(value, str | Path):
        return str(value).encode("utf-8", "backslashreplace").decode()
    if isinstance(value, dict):
        return {_encodable(k): _encodable(v) for k, v in value.items()}
    return [_encodable(v) for v in value] if isinstance(value, list | tuple) else value


def printable(text: str) -> str:
    """Return text that does nothing to a terminal but show: what a file says may hold anything."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def complain(line: str) -> None:
    """Write one line on standard error."""
    sys.stderr.write(f"marcha: {printable(line)}\n")


def warn(message: Warning | str, category: type[Warning], *where: object) -> None:
    """Say a warning in one line; takes the place of :func:`warnings.showwarning`."""
    from ..recording.errors import one_line

    complain(f"warning: {one_line(str(message))}")


def number(value: Any) -> str:
    """Return a cell's text: counts in full, measured values with four significant digits."""
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        if math.isnan(value):
            return "–"
        return f"{value:.0f}" if abs(value) >= 1e4 and math.isfinite(value) else f"{value:.4g}"
    return printable(str(value))


def folded(table: TextTable, width: int) -> list[TextTable]:
    """Return the table in pieces no wider than ``width`` characters, each led by the first column."""
    cells = [
        [title.removeprefix(">") for title in table.columns],
        *([number(c) for c in r] for r in table.rows),
    ]
    widths = [max(len(row[k]) for row in cells) + GUTTER for k in range(len(table.columns))]
    groups: list[list[int]] = []
    remaining = 0
    for k in range(1, len(widths)):
        if not groups or widths[k] > remaining:
            groups.append([0])
            remaining = width - widths[0]
        groups[-1].append(k)
        remaining -= widths[k]
    return [
        TextTable([table.columns[k] for k in group], [[row[k] for k in group] for row in table.rows])
        for group in groups
    ] or [table]


def _grid(table: TextTable, *, terminal: bool) -> Any:
    from rich.table import Table as Grid
    from rich.text import Text

    grid = Grid(box=None, pad_edge=False, padding=(0, GUTTER, 0, 0), header_style="bold" if terminal else "")
    for title in table.columns:
        right = title.startswith(">")
        justify: Literal["right", "left"] = "right" if right else "left"
        grid.add_column(Text(title.removeprefix(">")), justify=justify, no_wrap=True, overflow="ignore")
    for row in table.rows:
        cells = [number(cell) for cell in row]
        if terminal and table.cut:
            cells = [c if len(c) <= LONGEST else c[: LONGEST - 1] + "…" for c in cells]
        grid.add_row(*map(Text, cells))
    return grid


def columns_of(runs: Iterable[tuple[str, dict[str, Any]]], title: str = "metric") -> TextTable:
    """Return a table with one column a run and one row a figure, in the order of first appearance."""
    runs = list(runs)
    names = list(dict.fromkeys(name for _, figures in runs for name in figures))
    return TextTable(
        [title, *(f">{run}" for run, _ in runs)],
        [[name, *(figures.get(name) for _, figures in runs)] for name in names],
        fold=True,
    )


Progress = Callable[[float, float], None]
"""Called with (done, total); a total of 0 is unknown."""


@contextmanager
def progress(
    what: str, common: Common, *, counted: bool = False, before: str = ""
) -> Iterator[Progress | None]:
    """Give a callback that draws a bar on standard error; None without a terminal or where not wanted.

    ``counted`` shows how many instead of a share: for work of unknown length. ``before`` says what goes on
    until the callback is called for the first time.
    """
    if common.quiet or not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bars

    bars = Bars(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn() if counted else TextColumn("{task.percentage:>3.0f} %"),
        *(() if counted else (TimeRemainingColumn(),)),
        console=Console(stderr=True, highlight=False),
        transient=True,
    )
    with bars:
        task = bars.add_task(before or what, total=None)
        yield lambda done, total: bars.update(task, description=what, completed=done, total=total or None)
