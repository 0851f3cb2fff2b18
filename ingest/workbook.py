"""Spreadsheets (.xlsx) as tables, by the library calamine."""

from __future__ import annotations

import re
import zipfile
from collections.abc import Sequence
from pathlib import Path

import polars as pl

from ..recording.errors import MarchaError
from .archive import DAMAGED, trusted_members

MOST_CELLS = 2_000_000
"""Of a sheet, from its first row and column to its last: its reader holds the whole rectangle."""
MOST_BYTES = 100_000_000
"""Of all sheets and texts, unpacked."""
_TAG = re.compile(rb"""<(?:[\w.-]+:)?(c|row)(?=[\s/>])((?:[^<>"']|"[^"]*"|'[^']*')*)>""")
_PLACE = re.compile(rb"""(?:^|\s)r\s*=\s*["']([A-Za-z]{0,3})(\d{0,7})["']""")
_R = re.compile(rb"(?:^|\s)r\s*=")


def is_workbook(path: Path) -> bool:
    """Whether a file is a spreadsheet of Office Open XML, by what its archive holds."""
    try:
        return zipfile.is_zipfile(path) and "xl/workbook.xml" in zipfile.ZipFile(path).namelist()
    except (OSError, *DAMAGED):
        return False


def read_workbook(path: Path) -> dict[str, pl.DataFrame]:
    """Return each sheet by name: its first row that is not empty names the columns; empty rows are left out.

    Numbers are floats, columns with a text in them texts, empty cells null.

    Raises
    ------
    MarchaError
        The file cannot be read, or a sheet reaches further than any table of walks.
    """
    _require_small(path)
    from python_calamine import CalamineError, CalamineWorkbook

    try:
        book = CalamineWorkbook.from_path(str(path))
        sheets = {name: book.get_sheet_by_name(name).to_python() for name in book.sheet_names}
    except (OSError, CalamineError) as error:
        raise MarchaError(f"{path}: cannot be read as a spreadsheet: {error}") from error
    return {name: _table(rows) for name, rows in sheets.items()}


def _require_small(path: Path) -> None:
    """Refuse a workbook of which a few bytes would take the machine's memory, before its reader sees it."""
    try:
        with zipfile.ZipFile(path) as archive:
            members = trusted_members(path, archive)
            size = sum(m.file_size for m in members)
            if size > MOST_BYTES:
                raise MarchaError(
                    f"{path}: the spreadsheet unpacks to {size / 1e6:.0f} MB, more than {MOST_BYTES / 1e6:.0f} MB; "
                    "save what was measured as CSV"
                )
            for member in members:
                content = archive.read(
                    member
                )  # all of them, since what a member says of its size may be wrong
                if "worksheets/" in member.filename and (cells := _reach(content)) > MOST_CELLS:
                    raise MarchaError(
                        f"{path}: {member.filename} reaches over {cells} cells, more than {MOST_CELLS}; delete what "
                        "stands far from the table, or save it as CSV"
                    )
    except (OSError, *DAMAGED) as error:
        reason = str(error) or "it asks for more memory than there is"
        raise MarchaError(f"{path}: cannot be read as a spreadsheet: {reason}") from error


def _reach(sheet: bytes) -> int:
    """Return the cells of the rectangle that a sheet says it fills; too many where it cannot be told."""
    last_row = last_column = rows = cells = most_cells = 0
    for tag in _TAG.finditer(sheet):
        kind, attributes = tag.groups()
        place = _PLACE.search(attributes)
        if place is None and _R.search(attributes):
            return MOST_CELLS + 1
        if kind == b"row":
            rows, most_cells, cells = rows + 1, max(most_cells, cells), 0
        else:
            cells += 1
        if place is not None:
            column = 0
            for letter in place[1].upper():
                column = 26 * column + letter - 64
            last_column, last_row = max(last_column, column), max(last_row, int(place[2] or 0))
    # A row or cell that does not say where it is stands behind the one before it.
    return max(last_row, rows) * max(last_column, most_cells, cells)


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
