"""Delimited text in blocks: every physical line is a row of cells, blank, a comment or a bad row."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import polars as pl

from ..recording.errors import MarchaError
from .contract import ReportBuilder
from .mapping import TextLayout
from .text import BLOCK_BYTES, BOM, read_blocks, shown


class NoRowError(MarchaError):
    """A file ends before its first row."""


class Cells:
    """A file of delimited text: its header, and its rows as text in blocks.

    Parameters
    ----------
    path : Path
        The file.
    layout : TextLayout
        How it is laid out.
    size : int
        Bytes of a block.

    Raises
    ------
    NoRowError
        The file is empty or ends before its first row.
    MarchaError
        It cannot be read.
    """

    def __init__(self, path: Path, layout: TextLayout, size: int = BLOCK_BYTES) -> None:
        self.path = path
        self._size = size
        self._layout = layout
        self._separator = b"\t" if layout.separator == "blanks" else layout.separator.encode("ascii")
        self._preamble = layout.skip_rows + layout.header + layout.skip_after_header
        first = next(self._blocks())[0]
        lines = first.split(b"\n", self._preamble + 1)
        if len(lines) <= self._preamble or not first.strip():
            raise NoRowError(f"{path}: ends before its first row (layout.skip_rows = {layout.skip_rows})")
        row = self._split(self._first_row(first))
        names = [c.strip() for c in self._split(lines[layout.skip_rows])] if layout.header else []
        named = max((i + 1 for i, name in enumerate(names) if name), default=0)
        # A header may end in separators that its rows lack, or have fewer names than its rows have cells.
        self.width = len(row) if named <= len(row) <= len(names) or not layout.header else named
        self.names = names[: self.width]
        if not self.width:
            raise MarchaError(f"{path}: line {layout.skip_rows + 1} is blank; see layout.skip_rows")

    def number(self, column: str | int) -> int | None:
        """Return the place (from 0) of a column given by name or number (from 1); None where absent."""
        if isinstance(column, int):
            return column - 1 if column <= self.width else None
        return self.names.index(column.strip()) if column.strip() in self.names else None

    def rows(self, columns: Sequence[int], report: ReportBuilder) -> Iterator[pl.DataFrame]:
        """Yield the wanted columns as text, named ``c<place>``, and ``line`` (Int64)."""
        for block, line in self.blocks():
            frame = self.parse(block, line, columns, report)
            if frame.height:
                yield frame

    def blocks(self) -> Iterator[tuple[bytes, int]]:
        """Yield the text behind the header in blocks of whole lines ended by LF, and each block's first line."""
        line = 1
        for k, (block, passed) in enumerate(self._blocks()):
            skip = self._preamble if k == 0 else 0
            if skip:
                block = block.split(b"\n", skip)[-1]
            yield block, line + skip
            line += passed

    def parse(self, block: bytes, line: int, columns: Sequence[int], report: ReportBuilder) -> pl.DataFrame:
        """Return the rows of one block as :meth:`rows` does; ``line`` is the number of its first line."""
        return self._parse(block, line, sorted(set(columns)), report)

    def _blocks(self) -> Iterator[tuple[bytes, int]]:
        """Yield blocks with LF line ends and one-byte separators, and their number of physical lines."""
        wide = self._layout.encoding.lower().replace("_", "-").startswith(("utf-16", "utf-32"))
        for k, (piece, _) in enumerate(read_blocks(self.path, None if wide else self._size)):
            if not piece and k:
                continue
            if self._layout.encoding.lower() not in ("utf-8", "ascii"):
                try:
                    piece = piece.decode(self._layout.encoding).encode()
                except (LookupError, UnicodeError) as error:
                    raise MarchaError(
                        f"{self.path}: layout.encoding {self._layout.encoding}: {error}"
                    ) from error
            piece = piece.removeprefix(BOM) if k == 0 else piece
            if b"\r" in piece:
                piece = piece.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
            if self._layout.separator == "blanks":
                piece = re.sub(rb"(?m)^\t|\t$", b"", re.sub(rb"[ \t]+", b"\t", piece))
            yield piece, piece.count(b"\n") + (not piece.endswith(b"\n"))

    def _first_row(self, block: bytes) -> bytes:
        lines = block.split(b"\n")[self._preamble :]
        comment = self._layout.comment.encode()
        rows = (x for x in lines if x.strip() and not (comment and x.startswith(comment)))
        return next(rows, b"")

    def _split(self, line: bytes) -> list[str]:
        text = line.decode("utf-8", "replace")
        try:
            return next(csv.reader([text], delimiter=self._separator.decode()), [])
        except csv.Error as error:
            raise MarchaError(
                f"{self.path}: {shown(line)}: {error}; repair the line, or see layout.separator"
            ) from None

    def _parse(
        self, block: bytes, first_line: int, columns: list[int], report: ReportBuilder
    ) -> pl.DataFrame:
        data = np.frombuffer(block, dtype=np.uint8)
        ends = np.flatnonzero(data == 10)
        if not block.endswith(b"\n"):
            ends = np.append(ends, data.size)
        starts = np.concatenate(([0], ends[:-1] + 1)) if ends.size else ends
        if b'"' in block:
            lines = (block[a:b] for a, b in zip(starts.tolist(), ends.tolist(), strict=True))
            cells = np.array([len(self._split(x)) for x in lines], dtype=np.int64)
        else:
            marks = np.flatnonzero(data == self._separator[0])
            cells = np.searchsorted(marks, ends) - np.searchsorted(marks, starts) + 1
        blank = ends == starts
        comment = self._layout.comment.encode()
        for i in np.flatnonzero((cells != self.width) & ~blank).tolist():
            line = block[starts[i] : ends[i]]
            if not line.strip(b" \t" + self._separator) or (comment and line.startswith(comment)):
                blank[i] = True
            elif cells[i] > self.width and not line.split(self._separator, self.width)[-1].strip(
                b" " + self._separator
            ):
                cells[i] = self.width  # trailing separators
            else:
                report.drop(
                    "bad_row",
                    f"{self.path.name}: {shown(line)}: {cells[i]} of {self.width} columns; row dropped",
                    line=first_line + i,
                )
        good = (cells == self.width) & ~blank
        if comment:
            for i in np.flatnonzero(good & (data[np.minimum(starts, data.size - 1)] == comment[0])).tolist():
                good[i] = not block[starts[i] : ends[i]].startswith(comment)
        complete = np.flatnonzero(good)
        if not complete.size:
            return pl.DataFrame({"line": pl.Series([], dtype=pl.Int64)})
        if complete.size < ends.size:
            block = b"\n".join(
                block[a:b] for a, b in zip(starts[complete].tolist(), ends[complete].tolist(), strict=True)
            )
        try:
            frame = pl.read_csv(
                block,
                has_header=False,
                separator=self._separator.decode(),
                infer_schema=False,
                truncate_ragged_lines=True,
                encoding="utf8-lossy",
                new_columns=[f"c{i}" for i in range(self.width)],
            )
        except pl.exceptions.PolarsError:
            frame = None
        if frame is None or frame.height != complete.size:  # a quote that is never closed swallows lines
            raise MarchaError(
                f"{self.path}: lines {first_line} … {first_line + ends.size - 1}: a quote does not end "
                "on its line; remove the quotes"
            )
        return frame.select(f"c{i}" for i in columns).with_columns(line=pl.Series(complete + first_line))
