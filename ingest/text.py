"""Numeric text in blocks: every physical line is a row, blank, chatter or a bad row, with its number."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..recording.errors import MarchaError
from .contract import ReportBuilder
from .textline import BLANK, CHATTER, FEW, MANY, NOT_A_NUMBER, ROW, TextLine, read_line

OddLine = tuple[int, bytes, int, int]
"""A line that is no row: its number, text, status and column at fault."""

BLOCK_BYTES = 4 << 20

COMPILED_FROM = 8 << 20
"""Bytes from which a file is read by the compiled scanner: an hour and a half of the serial text of two sensors."""

BOM = b"\xef\xbb\xbf"
"""Byte order mark that some editors put before UTF-8 text."""


@dataclass(frozen=True)
class IntegerRows:
    """The rows of one block of text.

    Attributes
    ----------
    values : int64 array (columns, rows)
        One line of the array a column.
    lines : int64 array (rows,)
        Physical line of each row, from 1.
    wall_ms : int32 array (rows,)
        Wall clock that a terminal put before the row, ms of the day; -1 where none.
    """

    values: NDArray[np.int64]
    lines: NDArray[np.int64]
    wall_ms: NDArray[np.int32]


def start_of(path: Path, size: int = 4096) -> bytes:
    """Return the first bytes of a file; all of them where ``size`` is negative.

    Raises
    ------
    MarchaError
        Where the file cannot be read.
    """
    try:
        with path.open("rb") as f:
            return f.read(size)
    except OSError as error:
        raise MarchaError(f"{path}: cannot be read: {error.strerror or error}") from error


def read_whole(path: Path) -> bytes:
    """Return all bytes of a file; raises as :func:`start_of`."""
    return start_of(path, -1)


def read_text(path: Path) -> str:
    """Return a text file (UTF-8, with or without a byte order mark), line ends as LF; raises as :func:`start_of`."""
    return read_whole(path).decode("utf-8-sig", "replace").replace("\r\n", "\n").replace("\r", "\n")


def read_blocks(path: Path, size: int | None = BLOCK_BYTES) -> Iterator[tuple[bytes, bool]]:
    """Yield pieces of a file cut at line ends, and whether a piece is the last.

    A file of lines ended by a lone CR is one piece, and so is any file without a ``size``.

    Raises
    ------
    MarchaError
        Where the file cannot be read.
    """
    try:
        with path.open("rb") as f:
            rest: list[bytes] = []
            while data := f.read(-1 if size is None else size):
                if size is not None and len(data) < size:  # the file's end, which need not be a line's
                    yield b"".join((*rest, data)), True
                    return
                cut = 0 if size is None else data.rfind(b"\n") + 1
                if cut:
                    yield b"".join((*rest, data[:cut])), False
                    rest.clear()
                rest.append(data[cut:])
            yield b"".join(rest), True
    except OSError as error:
        raise MarchaError(f"{path}: cannot be read: {error.strerror or error}") from error


def text_lines(path: Path, skip: int = 0) -> Iterator[tuple[int, list[str]]]:
    """Yield the lines of a text file piece by piece: the number (from 1) of a piece's first line, and its lines.

    Parameters
    ----------
    path : Path
        The file: UTF-8, with or without a byte order mark; lines end in LF, CRLF or CR.
    skip : int
        So many first lines are left out.

    Raises
    ------
    MarchaError
        Where the file cannot be read.
    """
    line = 1
    for k, (piece, final) in enumerate(read_blocks(path)):
        piece = piece.removeprefix(BOM) if k == 0 else piece
        lines = piece.decode("utf-8", "replace").replace("\r\n", "\n").replace("\r", "\n").split("\n")
        if not final:  # its last LF ends a line and begins none
            lines.pop()
        left = max(0, skip + 1 - line)
        if left < len(lines):
            yield line + left, lines[left:] if left else lines
        line += len(lines)


def integer_rows(
    path: Path,
    limits: Sequence[tuple[int, int]],
    names: Sequence[str],
    report: ReportBuilder,
    *,
    first_line: int = 1,
    size: int = BLOCK_BYTES,
) -> Iterator[IntegerRows]:
    """Read lines of ``len(limits)`` integers between commas, semicolons, tabs or spaces.

    Lines end in LF, CRLF or CR, also mixed. A wall clock in front (``12:34:56.789``, with or without a date)
    is taken off. Blank lines are nothing; lines of words are ``chatter``; any other line that is not a row is
    dropped as ``bad_row`` with the reason.

    Parameters
    ----------
    path : Path
        The file.
    limits : sequence of (int, int)
        Lowest and highest value of each column.
    names : sequence of str
        Names of the columns, for messages.
    report : ReportBuilder
        Takes chatter and bad rows; rows that are returned are counted by whoever keeps them.
    first_line : int
        Number of the first line.
    size : int
        Bytes of a block.
    """
    line = first_line
    ended = True
    compiled = path.is_file() and path.stat().st_size >= COMPILED_FROM
    for k, (piece, final) in enumerate(read_blocks(path, size)):
        if not piece:
            break
        if final:
            ended = piece[-1:] in b"\r\n"
        piece = piece.removeprefix(BOM) if k == 0 else piece
        rows, passed = rows_of(piece, limits, names, report, first_line=line, compiled=compiled)
        line += passed
        yield rows
    if not ended:
        report.note(
            "no_final_newline",
            "the last line has no line end: its last number may be cut short",
            line=line - 1,
        )


def rows_of(
    piece: bytes,
    limits: Sequence[tuple[int, int]],
    names: Sequence[str],
    report: ReportBuilder,
    *,
    first_line: int = 1,
    compiled: bool = False,
) -> tuple[IntegerRows, int]:
    """Read one piece of text as :func:`integer_rows` does; also return its number of physical lines."""
    rows, odd, passed = (_scan if compiled else _line_by_line)(piece, limits, first_line)
    for number, line, status, column in odd:
        if status == CHATTER:
            report.note("chatter", f"{shown(line)}: not a row of numbers; skipped", line=number)
        else:
            reason = _reason(status, column, names, limits)
            report.drop("bad_row", f"{shown(line)}: {reason}; row dropped", line=number)
    return rows, passed


def _line_by_line(
    piece: bytes, limits: Sequence[tuple[int, int]], first_line: int
) -> tuple[IntegerRows, list[OddLine], int]:
    """Return rows, lines that are none, and the number of physical lines."""
    lines = piece.replace(b"\r\n", b"\n").replace(b"\r", b"\n").split(b"\n")
    if not lines[-1]:
        lines.pop()
    good: list[tuple[int, TextLine]] = []
    odd: list[OddLine] = []
    for number, line in enumerate(lines, first_line):
        if not (bare := line.strip(b" \t")):
            continue
        one = read_line(bare, limits)
        if one.status == ROW:
            good.append((number, one))
        elif one.status != BLANK:
            odd.append((number, bare, one.status, one.column))
    values = np.array([one.values for _, one in good], np.int64).reshape(-1, len(limits)).T
    numbers = np.array([number for number, _ in good], np.int64)
    wall_ms = np.array([one.wall_ms for _, one in good], np.int32)
    return IntegerRows(np.ascontiguousarray(values), numbers, wall_ms), odd, len(lines)


def _scan(
    piece: bytes, limits: Sequence[tuple[int, int]], first_line: int
) -> tuple[IntegerRows, list[OddLine], int]:
    """Do the same compiled: twenty times as fast, but loading the compiler takes as long as 10 MB."""
    from .textscan import scan

    low = np.array([a for a, _ in limits], dtype=np.int64)
    high = np.array([b for _, b in limits], dtype=np.int64)
    data = np.frombuffer(piece, dtype=np.uint8)
    capacity = 1 + int(np.count_nonzero(data == 10)) + int(np.count_nonzero(data == 13))
    values = np.empty((len(low), capacity), dtype=np.int64)
    lines = np.empty(capacity, dtype=np.int64)
    wall = np.empty(capacity, dtype=np.int32)
    odd = np.empty((capacity, 5), dtype=np.int64)
    rows, n_odd, passed = scan(data, low, high, first_line, values, lines, wall, odd)
    odd_lines = [
        (number, piece[start:end], status, column)
        for number, start, end, status, column in odd[:n_odd].tolist()
    ]
    return IntegerRows(values[:, :rows], lines[:rows], wall[:rows]), odd_lines, passed


def shown(raw: bytes, width: int = 40) -> str:
    """A line of unknown bytes as short printable text in quotes."""
    text = raw[: width + 1].decode("ascii", "backslashreplace")
    text = "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)
    return f"'{text[:width]}{'…' if len(text) > width or len(raw) > width else ''}'"


def _reason(status: int, column: int, names: Sequence[str], limits: Sequence[tuple[int, int]]) -> str:
    if status == FEW:
        return f"{column} of {len(names)} columns"
    if status == MANY:
        return f"more than {len(names)} columns"
    name = f"column {column + 1} ({names[column]})"
    if status == NOT_A_NUMBER:
        return f"{name} is not a whole number"
    return f"{name} is outside {limits[column][0]} … {limits[column][1]}"
