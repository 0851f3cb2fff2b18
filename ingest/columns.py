"""Text with a header line that a format is known by, streamed as float columns with line numbers."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import polars as pl

from ..recording.errors import MarchaError
from .cells import Cells
from .contract import HEAD_BYTES, ReportBuilder
from .mapping import Layout
from .text import read_blocks

PREAMBLE_LINES = 200
"""A header stands in one of so many first lines."""
MISSING = ("", "-", "nan", "na", "null", "none", "inf", "-inf")
"""Cells (lower case) that say that there is no value."""


@dataclass(frozen=True)
class Header:
    """The header of a table.

    Attributes
    ----------
    line : int
        Physical line, from 1.
    names : tuple of str
        Column names, stripped.
    separator : str
        What stands between cells.
    """

    line: int
    names: tuple[str, ...]
    separator: str


def find_header(head: bytes, accept: Callable[[Sequence[str]], bool]) -> Header | None:
    """Return the first line whose cells ``accept`` takes for a header; None where there is none.

    Parameters
    ----------
    head : bytes
        Start of a file.
    accept : callable
        Gets the stripped cells of a line.
    """
    text = head.removeprefix(b"\xef\xbb\xbf").decode("utf-8", "replace")
    for number, line in enumerate(re.split(r"\r\n|\n|\r", text)[:PREAMBLE_LINES], 1):
        for separator in (",", ";", "\t"):
            cells = [c.strip().strip('"') for c in line.split(separator)]
            if len(cells) > 1 and accept(cells):
                return Header(number, tuple(cells), separator)
    return None


def require_header(path: Path, accept: Callable[[Sequence[str]], bool], wanted: str) -> Header:
    """Return the header of a file.

    Raises
    ------
    MarchaError
        The file cannot be read or has no such header; ``wanted`` says what one looks like.
    """
    first, _ = next(read_blocks(path), (b"", True))
    header = find_header(first[:HEAD_BYTES], accept)
    if header is None:
        raise MarchaError(f"{path}: no header line like {wanted!r} in its first {PREAMBLE_LINES} lines")
    names = [n for n in header.names if n]
    if len(set(names)) < len(names):
        twice = next(n for n in names if names.count(n) > 1)
        raise MarchaError(f"{path}, line {header.line}: column {twice!r} stands twice; rename one of them")
    return header


def float_blocks(path: Path, header: Header, required: str, report: ReportBuilder) -> Iterator[pl.DataFrame]:
    """Yield the rows behind the header: one Float64 column a name, and ``line`` (Int64).

    A cell without a value is NaN, as is one that is no number (a repair, ``missing_cell``). Rows with another
    number of cells than the header, or without a number in the column ``required``, are dropped as
    ``bad_row``; blank lines are nothing.

    Raises
    ------
    MarchaError
        The file ends with its header, or its rows do not fit it.
    """
    cells = Cells(path, Layout(separator=header.separator, skip_rows=header.line - 1))
    if tuple(cells.names) != header.names:
        raise MarchaError(
            f"{path}, line {header.line}: the header's {len(header.names)} names do not fit the "
            f"{cells.width} cells of the first row; repair the header"
        )
    names = {f"c{i}": name for i, name in enumerate(header.names) if name}
    for block in cells.rows([int(c[1:]) for c in names], report):
        block = _with_number(
            block, next(c for c, name in names.items() if name == required), required, report
        )
        columns = {"line": block["line"]}
        for place, name in names.items():
            value = _numbers(block[place])
            columns[name] = value.fill_null(math.nan)
            if not value.null_count():
                continue
            text = block[place].str.strip_chars()
            given = text.is_not_null() & ~text.str.to_lowercase().is_in(MISSING)
            odd = given & value.is_null()
            if odd.any():
                at = int(odd.arg_true()[0])
                report.repair(
                    "missing_cell",
                    f"{name}: {text[at]!r} is not a number: taken as missing",
                    count=int(odd.sum()),
                    line=block["line"][at],
                    subject=f"{name} unreadable",
                )
        yield pl.DataFrame(columns)


def _numbers(text: pl.Series) -> pl.Series:
    """Return finite numbers, null for anything else."""
    value = text.cast(pl.Float64, strict=False)
    if value.null_count():
        value = text.str.strip_chars().cast(pl.Float64, strict=False)
    finite = value.is_finite()
    return value if finite.all(ignore_nulls=False) else pl.select(pl.when(finite).then(value)).to_series()


def _with_number(block: pl.DataFrame, place: str, name: str, report: ReportBuilder) -> pl.DataFrame:
    """Return the rows with a number in column ``place``; the others are bad rows."""
    bad = _numbers(block[place]).is_null()
    if not bad.any():
        return block
    at = int(bad.arg_true()[0])
    report.drop(
        "bad_row",
        f"{name}: {block[place][at]!r} is not a number; row dropped",
        count=int(bad.sum()),
        line=block["line"][at],
    )
    return block.filter(~bad)
