"""Text whose rows are of several kinds, each with its own columns: split into one table a kind."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path

import polars as pl

from .columns import careful_block
from .contract import ReportBuilder
from .text import BOM, read_blocks, shown

Kinds = Mapping[str, Sequence[str]]
"""Names of the columns of each kind of row, its own word first or second as the format has it."""


def typed_blocks(
    path: Path,
    pattern: str,
    separator: str,
    kinds: Callable[[str, int], Sequence[str] | None],
    report: ReportBuilder,
    *,
    required: Callable[[str], str],
    texts: Collection[str] = (),
    comment: str = "#",
    ending: str = "",
) -> Iterator[dict[str, pl.DataFrame]]:
    """Yield for each block of text the rows of every kind: ``line`` and its columns, numbers as Float64.

    Parameters
    ----------
    path : Path
        The file.
    pattern : str
        Regular expression with one group: the word that says the kind of a row.
    separator : str
        Between cells.
    kinds : callable
        From a kind and its number of cells to the names of the columns; None where it is not read. An empty name
        leaves a cell out.
    report : ReportBuilder
        Takes bad rows and what is found in cells.
    required : callable
        From a kind to the column without which a row is none.
    texts : collection of str
        Columns that stay text.
    comment : str
        Lines that begin so are no rows.
    ending : str
        Characters that may close a row and are no cell.
    """
    line = 1
    for k, (piece, _) in enumerate(read_blocks(path)):
        piece = piece.removeprefix(BOM) if k == 0 else piece
        if not piece:
            continue
        rows = pl.Series("row", piece.replace(b"\r\n", b"\n").decode("utf-8", "replace").split("\n"))
        if piece.endswith(b"\n"):
            rows = rows[:-1]
        table = pl.DataFrame(
            {"row": rows, "line": range(line, line + rows.len())}, schema_overrides={"line": pl.Int64}
        )
        line += rows.len()
        if ending:
            table = table.with_columns(pl.col("row").str.strip_chars_end(ending))
        table = table.with_columns(kind=pl.col("row").str.extract(pattern))
        blank = pl.col("row").str.strip_chars() == ""
        odd = table.filter(pl.col("kind").is_null() & ~blank & ~pl.col("row").str.starts_with(comment))
        if odd.height:
            _bad(odd["row"][0], "not a row of this format", odd.height, odd["line"][0], report, "unknown")
        yield {
            str(kind): frame
            for (kind,), group in table.drop_nulls("kind").group_by("kind", maintain_order=True)
            if (frame := _split(str(kind), group, separator, kinds, report, required, texts)) is not None
        }


def _bad(row: str, why: str, count: int, line: int, report: ReportBuilder, subject: str) -> None:
    report.drop(
        "bad_row", f"{shown(row.encode())}: {why}; row dropped", count=count, line=line, subject=subject
    )


def _split(
    kind: str,
    group: pl.DataFrame,
    separator: str,
    kinds: Callable[[str, int], Sequence[str] | None],
    report: ReportBuilder,
    required: Callable[[str], str],
    texts: Collection[str],
) -> pl.DataFrame | None:
    cells = group["row"].str.count_matches(re.escape(separator)) + 1
    width = int(cells.mode().max())  # type: ignore[arg-type]
    names = kinds(kind, width)
    if names is None:
        return None
    few = cells < len(names)
    if few.any():
        first = int(few.arg_true()[0])
        why = f"{cells[first]} of {len(names)} columns"
        _bad(group["row"][first], why, int(few.sum()), group["line"][first], report, kind)
        group = group.filter(~few)
    if not group.height:
        return None
    split = group["row"].str.splitn(separator, len(names) + 1).struct.unnest()
    places = {f"field_{i}": name for i, name in enumerate(names) if name}
    text = split.select(list(places)).with_columns(line=group["line"])
    types = {c: pl.String if n in texts else pl.Float64 for c, n in places.items()}
    return careful_block(text, places, types, required(kind), report)
