"""Spreadsheets (.xlsx) as tables, by the library calamine."""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from pathlib import Path

import polars as pl

from ..recording.errors import MarchaError


def is_workbook(path: Path) -> bool:
    """Whether a file is a spreadsheet of Office Open XML, by what its archive holds."""
    try:
        return zipfile.is_zipfile(path) and "xl/workbook.xml" in zipfile.ZipFile(path).namelist()
    except (OSError, zipfile.BadZipFile):
        return False


def read_workbook(path: Path) -> dict[str, pl.DataFrame]:
    """Return each sheet by name: its first row that is not empty names the columns; empty rows are left out.

    Numbers are floats, columns with a text in them texts, empty cells null.

    Raises
    ------
    MarchaError
        The file cannot be read.
    """
    from python_calamine import CalamineError, CalamineWorkbook

    try:
        book = CalamineWorkbook.from_path(str(path))
        sheets = {name: book.get_sheet_by_name(name).to_python() for name in book.sheet_names}
    except (OSError, CalamineError) as error:
        raise MarchaError(f"{path}: cannot be read as a spreadsheet: {error}") from error
    return {name: _table(rows) for name, rows in sheets.items()}


def _table(rows: Sequence[Sequence[object]]) -> pl.DataFrame:
    filled = [row for row in rows if any(cell not in ("", None) for cell in row)]
    if not filled:
        return pl.DataFrame()
    names = [str(c).strip() or f"column_{k + 1}" for k, c in enumerate(filled[0])]
    columns = {}
    for k, name in enumerate(names):
        cells = [row[k] if k < len(row) and row[k] != "" else None for row in filled[1:]]
        numeric = all(isinstance(c, int | float) for c in cells if c is not None)
        kind = pl.Float64 if numeric else pl.String
        columns[name] = pl.Series(
            name, [c if numeric or c is None else str(c) for c in cells], dtype=kind, strict=False
        )
    return pl.DataFrame(columns)
