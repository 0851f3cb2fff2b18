"""The kernel behind :mod:`marcha.ingest.text`: one pass over the bytes, no allocation, any separators."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

from .textline import CHATTER, FEW, MANY, NOT_A_NUMBER, OUT_OF_RANGE, ROW

_TAB, _LF, _CR, _SPACE, _COMMA, _SEMICOLON, _COLON, _DOT, _PLUS, _MINUS = (
    9,
    10,
    13,
    32,
    44,
    59,
    58,
    46,
    43,
    45,
)

# Without counting references to the arrays (_nrt): numba would do that, atomically, at every call.
_OPTIONS: Any = {"cache": True, "nogil": True, "_nrt": False}
_compiled = numba.njit(**_OPTIONS)
_inlined = numba.njit(**_OPTIONS, forceinline=True)


@_inlined
def _digit(c):
    return 48 <= c <= 57


@_inlined
def _space(c):
    return c == 32 or c == 9


@_compiled
def _wall_clock(data, a, b):
    """Return (ms of the day, position behind it) of ``[date ]hh:mm:ss[.fff] `` at ``a``, or (-1, a)."""
    i = a
    while i < b and i - a < 11 and (_digit(data[i]) or data[i] == 45 or data[i] == 47 or data[i] == 46):
        i += 1
    if i - a == 10 and i < b and (_space(data[i]) or data[i] == 84):  # yyyy-mm-dd, then a space or T
        i += 1
    else:
        i = a
    if b - i < 8 or data[i + 2] != 58 or data[i + 5] != 58:
        return -1, a
    for k in (0, 1, 3, 4, 6, 7):
        if not _digit(data[i + k]):
            return -1, a
    h = (data[i] - 48) * 10 + data[i + 1] - 48
    m = (data[i + 3] - 48) * 10 + data[i + 4] - 48
    s = (data[i + 6] - 48) * 10 + data[i + 7] - 48
    ms = ((np.int64(h) * 60 + m) * 60 + s) * 1000
    i += 8
    if i < b and (data[i] == 46 or data[i] == 44 or data[i] == 58):
        i += 1
        scale = 100
        while i < b and _digit(data[i]):
            ms += np.int64(data[i] - 48) * scale
            scale //= 10
            i += 1
    if i < b and not _space(data[i]):
        return -1, a
    while i < b and (_space(data[i]) or data[i] == 62 or (data[i] == 45 and i + 1 < b and data[i + 1] == 62)):
        i += 1  # blanks and the arrow "->" of some terminals
    return ms, i


@_compiled
def _words(data, a, b):
    """Whether a line is text (a boot message, a header): begins like it and has no cell that is a number."""
    c = data[a]
    if not ((65 <= c <= 90) or (97 <= c <= 122) or c == 35 or c == 42 or c == 61 or c == 91):  # # * = [
        return False
    digits = 0
    other = 0
    for k in range(a, b + 1):
        c = data[k] if k < b else np.uint8(44)
        if c == 44 or c == 59 or c == 9:
            if digits > 0 and other == 0:
                return False
            digits = 0
            other = 0
        elif _digit(c):
            digits += 1
        elif c < 32:
            return False
        elif c != 32 and c != 43 and c != 45:
            other += 1
    return True


@_inlined
def _clean_row(data, pos, n, low, high, values, row):
    """Read a row of the plainest form, or a blank line; return where the next begins, -1 if it is neither."""
    columns = low.size
    if n - pos < 20 * columns + 2:  # enough for every number that is read below: no more checks of the end
        return np.int64(-1)
    i = pos
    if data[i] == 13 and data[i + 1] == 10:
        return i + 2
    if data[i] == 10:
        return i + 1
    for column in range(columns):
        negative = data[i] == 45
        if negative:
            i += 1
        start = i
        value = np.int64(0)
        digit = np.int64(data[i]) - 48
        while 0 <= digit <= 9 and i - start < 17:
            value = value * 10 + digit
            i += 1
            digit = np.int64(data[i]) - 48
        if negative:
            value = -value
        if i == start or value < low[column] or value > high[column]:
            return np.int64(-1)
        values[column, row] = value
        if column < columns - 1:
            if data[i] != 44:
                return np.int64(-1)
            i += 1
    if data[i] == 13 and data[i + 1] == 10:
        return i + 2
    return i + 1 if data[i] == 10 else np.int64(-1)


@_compiled
def scan(data, low, high, first_line, values, lines, wall, odd):
    """Read all lines of ``data`` into ``values`` (columns, rows).

    Parameters
    ----------
    data : uint8 array
        Text, whole lines.
    low, high : int64 array (columns,)
        Range of each column.
    first_line : int
        Number of the first line.
    values, lines, wall : int64 (columns, capacity), int64 (capacity,), int32 (capacity,)
        Filled, a row each.
    odd : int64 array (capacity, 5)
        Filled for each line that is neither row nor blank: line, start, end, status, column.

    Returns
    -------
    tuple of int
        Rows, odd lines, physical lines.
    """
    n = data.size
    columns = low.size
    rows = 0
    odds = 0
    line = first_line
    pos = 0
    while pos < n:
        i = _clean_row(data, pos, n, low, high, values, rows)
        if i >= 0:
            if i > pos + 2:
                lines[rows] = line
                wall[rows] = -1
                rows += 1
            line += 1
            pos = i
            continue
        a = pos
        end = pos
        while end < n and data[end] != 10 and data[end] != 13:
            end += 1
        nxt = end
        if nxt < n:
            nxt += 2 if data[nxt] == 13 and nxt + 1 < n and data[nxt + 1] == 10 else 1
        pos = nxt
        b = end
        while a < b and _space(data[a]):
            a += 1
        while b > a and _space(data[b - 1]):
            b -= 1
        number = line
        line += 1
        if a == b:
            continue
        start = a
        stamp, a = (np.int64(-1), a)
        if (
            b - a >= 8
            and _digit(data[a])
            and (
                data[a + 2] == 58
                or data[a + 4] == 45
                or data[a + 2] == 46
                or data[a + 2] == 47
                or data[a + 2] == 45
                or data[a + 4] == 47
            )
        ):
            stamp, a = _wall_clock(data, a, b)
            if a == b:
                continue
        status = ROW
        where = 0
        column = 0
        i = a
        while i < b:
            if column == columns:
                status = MANY
                break
            negative = data[i] == 45
            if negative or data[i] == 43:
                i += 1
            value = np.int64(0)
            digits = 0
            while i < b and _digit(data[i]):
                if digits < 18:
                    value = value * 10 + (data[i] - 48)
                digits += 1
                i += 1
            if digits == 0 or (i < b and not (_space(data[i]) or data[i] == 44 or data[i] == 59)):
                status = NOT_A_NUMBER
                where = column
                break
            if negative:
                value = -value
            if digits > 17 or value < low[column] or value > high[column]:
                if status == ROW:
                    status = OUT_OF_RANGE
                    where = column
            else:
                values[column, rows] = value
            column += 1
            while i < b and _space(data[i]):
                i += 1
            if i < b and (data[i] == 44 or data[i] == 59):
                i += 1
                while i < b and _space(data[i]):
                    i += 1
        if status == NOT_A_NUMBER and column == 0:
            if _words(data, a, b):
                status = CHATTER
        elif status == ROW and column < columns:
            status = FEW
            where = column
        if status == ROW:
            lines[rows] = number
            wall[rows] = stamp
            rows += 1
        else:
            odd[odds, 0] = number
            odd[odds, 1] = start
            odd[odds, 2] = b
            odd[odds, 3] = status
            odd[odds, 4] = where
            odds += 1
    return rows, odds, line - first_line
