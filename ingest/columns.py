"""Text with one header line and a number in every cell, streamed as float columns with line numbers."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import polars as pl

from ..recording.errors import MarchaError
from .contract import ReportBuilder
from .text import read_blocks

PREAMBLE_LINES = 200
"""A header stands in one of so many first lines."""

MISSING = frozenset({"", "-", "nan", "na", "null", "none"})
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
    header = find_header(first[: 1 << 16], accept)
    if header is None:
        raise MarchaError(f"{path}: no header line like {wanted!r} in its first {PREAMBLE_LINES} lines")
    if len(set(header.names)) < len(header.names):
        twice = next(n for n in header.names if header.names.count(n) > 1)
        raise MarchaError(f"{path}, line {header.line}: column {twice!r} stands twice; rename one of them")
    return header


def float_blocks(path: Path, header: Header, report: ReportBuilder) -> Iterator[pl.DataFrame]:
    """Yield the rows behind the header: one Float64 column a name, and ``line`` (Int64).

    Cells without a value are NaN. A row with another number of cells than the header, or a cell that is
    no number, is dropped as ``bad_row``. Blank lines are nothing.
    """
    line = 1
    for piece, _ in read_blocks(path):
        if not piece:
            continue
        skip = max(0, header.line + 1 - line)
        for _ in range(skip):
            end = re.search(rb"\r\n|\n|\r", piece)
            piece = piece[end.end() :] if end else b""
            line += 1
        if piece:
            frame, passed = _parse(piece, header, line, report)
            line += passed
            if frame.height:
                yield frame


def _parse(piece: bytes, header: Header, line: int, report: ReportBuilder) -> tuple[pl.DataFrame, int]:
    """Return the rows of one piece and its number of lines: all at once where every line is a plain row."""
    ends = piece.count(b"\n") + (not piece.endswith(b"\n"))
    cells = piece.count(header.separator.encode()) + ends
    if cells == ends * len(header.names) and (
        b"\r" not in piece or piece.count(b"\r") == piece.count(b"\r\n")
    ):
        try:
            frame = pl.read_csv(
                piece,
                has_header=False,
                separator=header.separator,
                quote_char=None,
                schema=dict.fromkeys(header.names, pl.Float64),
                null_values=["NaN", "nan", "-"],
            )
        except pl.exceptions.PolarsError:
            frame = None
        if frame is not None and frame.height == ends:
            frame = frame.fill_null(math.nan).with_columns(pl.all().replace([math.inf, -math.inf], math.nan))
            return frame.with_columns(line=pl.Series(np.arange(line, line + ends))), ends
    return _parse_lines(piece, header, line, report)


def _parse_lines(piece: bytes, header: Header, line: int, report: ReportBuilder) -> tuple[pl.DataFrame, int]:
    """Read a piece with damaged lines, line by line."""
    texts = re.split(r"\r\n|\n|\r", piece.decode("utf-8", "backslashreplace"))
    if texts[-1] == "":
        texts.pop()
    rows, lines = [], []
    for number, text in enumerate(texts, line):
        if not text.strip():
            continue
        cells = [c.strip().strip('"') for c in text.split(header.separator)]
        shown = text if len(text) <= 40 else f"{text[:40]}…"
        if len(cells) != len(header.names):
            report.drop(
                "bad_row",
                f"{shown!r}: {len(cells)} of {len(header.names)} columns; row dropped",
                line=number,
            )
            continue
        values = [_number(c) for c in cells]
        if None in values:
            name = header.names[values.index(None)]
            report.drop("bad_row", f"{shown!r}: column {name!r} is not a number; row dropped", line=number)
            continue
        rows.append(values)
        lines.append(number)
    schema = dict.fromkeys(header.names, pl.Float64)
    frame = pl.DataFrame(rows, schema=schema, orient="row") if rows else pl.DataFrame(schema=schema)
    return frame.with_columns(line=pl.Series(lines, dtype=pl.Int64)), len(texts)


def _number(cell: str) -> float | None:
    """Return a cell's value, NaN where it has none, None where it is no number."""
    if cell.lower() in MISSING:
        return math.nan
    if "_" in cell:
        return None
    try:
        value = float(cell)
    except ValueError:
        return None
    return value if math.isfinite(value) else math.nan
