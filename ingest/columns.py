"""Text with a header line that a format is known by, streamed as float columns with line numbers."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import polars as pl

from ..recording.errors import MarchaError
from .cells import Cells
from .contract import HEAD_BYTES, ReportBuilder
from .mapping import TextLayout
from .text import start_of
from .timestamps import MOST_NS

PREAMBLE_LINES = 200
"""A header stands in one of so many first lines."""
MISSING = ("", "-", "nan", "na", "null", "none", "inf", "-inf")
"""Cells (lower case) that say that there is no value."""
_MISSING_AS_WRITTEN = ("", "-", "nan", "NaN", "NA", "null", "NULL", "None", "inf", "-inf")
_NAMED = re.compile(r"[A-DF-Za-df-z\u0080-\U0010ffff]")
"""A header has letters other than a number's exponent."""
_LINE_END = re.compile(r"\r\n|\n|\r")
_COMMA = re.compile(r"^[+-]?\d+,\d+([eE][+-]?\d+)?$")
_POINT = re.compile(r"^[+-]?\d*\.\d+([eE][+-]?\d+)?$")


@dataclass(frozen=True)
class Header:
    """The header of a table.

    Attributes
    ----------
    line : int
        Physical line, from 1; 0 for a file that has none, whose columns are known.
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
    for number, separator, cells in _rows_of_cells(head):
        if accept(cells):
            return Header(number, cells, separator)
    return None


@lru_cache(maxsize=8)
def _rows_of_cells(head: bytes) -> tuple[tuple[int, str, tuple[str, ...]], ...]:
    """Return line, separator and cells of what may be a header; kept, because many formats ask of one file."""
    text = head.decode("utf-8-sig", "replace")
    lines = enumerate(_LINE_END.split(text, PREAMBLE_LINES)[:PREAMBLE_LINES], 1)
    return tuple(
        (number, separator, tuple(c.strip().strip('"') for c in line.split(separator)))
        for number, line in lines
        if _NAMED.search(line)
        for separator in (",", ";", "\t")
        if separator in line
    )


def require_header(path: Path, accept: Callable[[Sequence[str]], bool], wanted: str) -> Header:
    """Return the header of a file.

    Raises
    ------
    MarchaError
        The file cannot be read or has no such header; ``wanted`` says what one looks like.
    """
    header = find_header(start_of(path, HEAD_BYTES), accept)
    if header is None:
        raise MarchaError(f"{path}: no header line like {wanted!r} in its first {PREAMBLE_LINES} lines")
    names = [n for n in header.names if n]
    if len(set(names)) < len(names):
        twice = next(n for n in names if names.count(n) > 1)
        raise MarchaError(f"{path}, line {header.line}: column {twice!r} stands twice; rename one of them")
    return header


def float_blocks(
    path: Path,
    header: Header,
    required: str,
    report: ReportBuilder,
    *,
    integers: Collection[str] = (),
    texts: Collection[str] = (),
) -> Iterator[pl.DataFrame]:
    """Yield the rows behind the header: one Float64 column a name, and ``line`` (Int64).

    A cell without a value is NaN, as is one that is no number (a repair, ``missing_cell``); one decimal comma in
    a file of decimal points is repaired (``decimal_comma``), a file of decimal commas is read as such. Rows with
    another number of cells than the header, or without a number in the column ``required``, are dropped as
    ``bad_row``; blank lines are nothing.

    Parameters
    ----------
    path : Path
        The file.
    header : Header
        Its header.
    required : str
        Column without which a row is none.
    report : ReportBuilder
        Takes what is found.
    integers, texts : collection of str
        Columns that stay whole numbers (Int64: nanoseconds since 1970 need them), and text.

    Raises
    ------
    MarchaError
        The file ends with its header, or its rows do not fit it.
    """
    headed = header.line > 0
    cells = Cells(
        path, TextLayout(separator=header.separator, skip_rows=max(header.line - 1, 0), header=headed)
    )
    if not headed and cells.width != len(header.names):
        raise MarchaError(f"{path}: its first row has {cells.width} cells, not {len(header.names)}")
    if headed and tuple(cells.names) != header.names:
        raise MarchaError(
            f"{path}, line {header.line}: the header's {len(header.names)} names do not fit the "
            f"{cells.width} cells of the first row; repair the header"
        )
    names = {f"c{i}": name for i, name in enumerate(header.names) if name}
    kinds = {
        c: pl.String if n in texts else pl.Int64 if n in integers else pl.Float64 for c, n in names.items()
    }
    commas: bool | None = None if header.separator != "," else False
    for block, line in cells.blocks():
        if commas is None and block:
            commas = _is_decimal_comma(block, header.separator)
            if commas:
                report.note("decimal_comma", "numbers are written with a decimal comma: read so", line=line)
        if commas:
            block = block.replace(b",", b".")
        frame = _plain_block(block, line, header.separator, cells.width, names, kinds, required)
        if frame is None:
            text = cells.parse(block, line, [int(c[1:]) for c in names], report)
            frame = careful_block(text, names, kinds, required, report) if text.height else None
        if frame is not None and frame.height:
            yield frame


def _is_decimal_comma(block: bytes, separator: str) -> bool:
    """Whether the first row has numbers with a comma and none with a point."""
    first = block.split(b"\n", 1)[0].decode("utf-8", "replace").split(separator)
    return any(_COMMA.fullmatch(c.strip()) for c in first) and not any(
        _POINT.fullmatch(c.strip()) for c in first
    )


def _plain_block(
    block: bytes,
    line: int,
    separator: str,
    width: int,
    names: Mapping[str, str],
    kinds: Mapping[str, Any],
    required: str,
) -> pl.DataFrame | None:
    """Return a block in which every line is a row and every cell what it should be; None where one is not."""
    rows = block.count(b"\n") + (not block.endswith(b"\n"))
    if not block or block.isspace() or block.count(separator.encode()) != rows * (width - 1):
        return None
    try:
        frame = pl.read_csv(
            block,
            has_header=False,
            separator=separator,
            schema={f"c{i}": kinds.get(f"c{i}", pl.String) for i in range(width)},
            null_values=list(_MISSING_AS_WRITTEN),
        )
    except pl.exceptions.PolarsError:
        return None
    if frame.height != rows:
        return None
    place = next(c for c, name in names.items() if name == required)
    numbers = [c for c in names if kinds[c] == pl.Float64]
    odd = frame.select(  # all columns at once: each query costs as much as some thousand cells
        *(pl.col(c).is_infinite().any() for c in numbers),
        none=pl.col(place).is_null().any(),
        nan=pl.col(place).is_nan().any() if place in numbers else pl.lit(value=False),
    )
    if any(odd.row(0)):
        return None
    cells = (
        (pl.col(c).fill_null(math.nan) if c in numbers else pl.col(c)).alias(n) for c, n in names.items()
    )
    return frame.select(pl.int_range(line, line + rows, dtype=pl.Int64).alias("line"), *cells)


def careful_block(
    block: pl.DataFrame,
    names: Mapping[str, str],
    kinds: Mapping[str, Any],
    required: str,
    report: ReportBuilder,
) -> pl.DataFrame:
    """Return the rows of a block of text, cell by cell, and report what is no number."""
    place = next(c for c, name in names.items() if name == required)
    block = _with_number(block, place, required, report)
    columns: dict[str, Any] = {"line": block["line"]}
    for place, name in names.items():
        if kinds[place] == pl.String:
            columns[name] = block[place].str.strip_chars()
            continue
        if kinds[place] == pl.Int64:
            columns[name] = block[place].str.strip_chars().cast(pl.Int64, strict=False)
            if not columns[name].null_count():
                continue
            columns[name] = _numbers(block[place]).round().cast(pl.Int64, strict=False)
            continue
        value = _numbers(block[place])
        columns[name] = value.fill_null(math.nan)
        if not value.null_count():
            continue
        text = block[place].str.strip_chars()
        dotted = _numbers(
            pl.select(pl.when(text.str.contains(_COMMA.pattern)).then(text)).to_series().str.replace(",", ".")
        )
        comma = value.is_null() & dotted.is_not_null()
        if comma.any():
            first = int(comma.arg_true()[0])
            report.repair(
                "decimal_comma",
                f"{name}: {text[first]!r} is read as {dotted[first]:g}",
                count=int(comma.sum()),
                line=block["line"][first],
                subject=name,
            )
            value = value.fill_null(dotted)
            columns[name] = value.fill_null(math.nan)
        filled = text.is_not_null() & ~text.str.to_lowercase().is_in(MISSING)
        odd = filled & value.is_null()
        if odd.any():
            first = int(odd.arg_true()[0])
            report.repair(
                "missing_cell",
                f"{name}: {text[first]!r} is not a number: taken as missing",
                count=int(odd.sum()),
                line=block["line"][first],
                subject=f"{name} unreadable",
            )
    return pl.DataFrame(columns)


def with_ticks(
    frame: pl.DataFrame, name: str, factor: float, report: ReportBuilder, limit: float = MOST_NS
) -> pl.DataFrame:
    """Return the rows with ``t`` (Int64): the column ``name`` times ``factor``, rounded.

    Rows whose time no clock can say are dropped as ``bad_row``.
    """
    t = frame[name] * factor
    far = t.abs() > limit
    if far.any():
        first = int(far.arg_true()[0])
        report.drop(
            "bad_row",
            f"{name}: {frame[name][first]:g} is beyond any clock; row dropped",
            count=int(far.sum()),
            line=frame["line"][first],
        )
        frame, t = frame.filter(~far), t.filter(~far)
    return frame.with_columns(t=t.round().cast(pl.Int64))


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
    first = int(bad.arg_true()[0])
    report.drop(
        "bad_row",
        f"{name}: {block[place][first]!r} is not a number; row dropped",
        count=int(bad.sum()),
        line=block["line"][first],
    )
    return block.filter(~bad)
