"""A line of text as a row of whole numbers, or what it is instead."""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

ROW, BLANK, CHATTER, FEW, MANY, NOT_A_NUMBER, OUT_OF_RANGE = range(7)

_WALL_CLOCK = re.compile(
    rb"(?=\d.[:./-]|\d...[-/])"
    rb"(?:[\d/.-]{10}[ \tT])?(\d\d):(\d\d):(\d\d)(?:[.,:](\d*))?(?![^ \t])"
    rb"(?:[ \t>]|->)*"  # blanks and the arrow "->" of some terminals
)
_NUMBER = re.compile(rb"([+-]?)(\d+)(?![^ \t,;])[ \t]*(?:[,;][ \t]*)?")
_SEPARATOR = rb"(?:[ \t]*[,;][ \t]*|[ \t]+)"
_WORDS = re.compile(rb"[A-Za-z#*=\[][^\x00-\x08\x0a-\x1f]*")
_NUMBER_ALONE = re.compile(rb"(?:^|[,;\t])[ +-]*\d[ +\d-]*(?:$|[,;\t])")


@cache
def _row(columns: int) -> re.Pattern[bytes]:
    """Return what a line of so many numbers is, at a stroke; a separator may stand behind the last."""
    return re.compile(_SEPARATOR.join([rb"([+-]?\d{1,17})"] * columns) + rb"[ \t]*[,;]?")


class TextLine(NamedTuple):
    """What a line is.

    Attributes
    ----------
    status : int
        :data:`ROW` …
    values : sequence of int
        Numbers of a row.
    wall_ms : int
        Wall clock that a terminal put before it, ms of the day; -1 where none.
    column : int
        Column at fault, or how many there are.
    """

    status: int
    values: Sequence[int] = ()
    wall_ms: int = -1
    column: int = 0


def read_line(line: bytes, limits: Sequence[tuple[int, int]]) -> TextLine:
    """Read one line without its end, and without blanks around it.

    Parameters
    ----------
    line : bytes
        ``[wall clock] number, number …`` between commas, semicolons, tabs or spaces.
    limits : sequence of (int, int)
        Lowest and highest value of each column.
    """
    start, wall_ms = 0, -1
    if wall := _WALL_CLOCK.match(line):
        hours, minutes, seconds = (int(wall[k]) for k in (1, 2, 3))
        thousandths = int((wall[4] or b"")[:3].ljust(3, b"0"))
        start, wall_ms = wall.end(), ((hours * 60 + minutes) * 60 + seconds) * 1000 + thousandths
    if start == len(line):
        return TextLine(BLANK)
    if whole := _row(len(limits)).fullmatch(line, start):
        values = list(map(int, whole.groups()))
        if all(low <= value <= high for value, (low, high) in zip(values, limits, strict=True)):
            return TextLine(ROW, values, wall_ms)
    values, beyond = [], None
    while start < len(line):
        if len(values) == len(limits):
            return TextLine(MANY)
        number = _NUMBER.match(line, start)
        if number is None:
            return TextLine(
                CHATTER if not values and _is_words(line[start:]) else NOT_A_NUMBER, column=len(values)
            )
        value, (low, high) = int(number[1] + number[2][:18]), limits[len(values)]
        if beyond is None and not (low <= value <= high and len(number[2]) < 18):
            beyond = len(values)
        values.append(value)
        start = number.end()
    if beyond is not None:
        return TextLine(OUT_OF_RANGE, column=beyond)
    if len(values) < len(limits):
        return TextLine(FEW, column=len(values))
    return TextLine(ROW, values, wall_ms)


def _is_words(line: bytes) -> bool:
    """Whether a line is text (a boot message, a header): begins like it and has no cell that is a number."""
    return _WORDS.fullmatch(line) is not None and _NUMBER_ALONE.search(line) is None
