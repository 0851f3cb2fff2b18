"""How inputs are damaged: by their structure (rows, cells, keys, lengths), and blindly."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import numpy as np

Rng = np.random.Generator

CELLS = (
    *(
        "",
        "-",
        " ",
        "nan",
        "NaN",
        "inf",
        "-inf",
        "null",
        "0",
        "-0",
        "1",
        "-1",
        "1,5",
        "1.5.2",
        "--1",
        "0x10",
        "1_000",
    ),
    *(
        "1e308",
        "1e309",
        "-1e30",
        "1e30",
        "4e18",
        "1e-400",
        "9" * 30,
        "9" * 400,
        "1" * 5000,
        "2147483648",
        "-9223372036854775808",
    ),
    *(
        "9223372036854775807",
        "18446744073709551615",
        "4294967295",
        "65536",
        "253402300800",
        "true",
        "=1+1",
        "@x",
        '"',
        '""',
    ),
    *(
        '"a',
        "'",
        "a;b",
        "a\tb",
        "\x00",
        "\x1b[31m",
        "\x07",
        "\u202e",
        "٣",
        "½",
        "𝟙",
        "é",
        "\ufeff",
        "\r",
        "../../x",
        "/",
        "%n%s",
    ),
    *(
        "1970-01-01",
        "2024-02-30 25:61:61",
        "9999-12-31T23:59:59Z",
        "0000-00-00",
        "12:34:56.789",
        "-12:00",
        "$(x)",
        "x" * 2000,
    ),
)
"""Cells that readers stumble over."""
NUMBERS = (
    0,
    1,
    -1,
    2,
    255,
    256,
    65535,
    65536,
    2**31 - 1,
    2**31,
    2**32 - 1,
    2**32,
    2**53,
    2**63 - 1,
    2**63,
    2**64 - 1,
)
"""Lengths, offsets and counts at the borders of their types."""
_NUMBER = re.compile(rb"[-+]?\d+(?:[.,]\d+)?(?:[eE][-+]?\d+)?")
_SEPARATORS = (b",", b";", b"\t", b" ")


@dataclass
class Mutated:
    """Damaged bytes; ``rows`` is how many rows of values were touched, None where more than rows may differ."""

    data: bytes
    rows: int | None = None
    what: str = ""


def pick(rng: Rng, items: Any) -> Any:
    """Return one of a sequence."""
    return items[int(rng.integers(len(items)))]


def text(rng: Rng, data: bytes) -> Mutated:
    """Damage a file of lines."""
    done = Mutated(data, 0)
    for _ in range(int(rng.choice([1, 1, 1, 2, 3, 8]))):
        change = pick(rng, _TEXT)
        step = change(rng, done.data)
        rows = None if done.rows is None or step.rows is None else done.rows + step.rows
        done = Mutated(step.data, rows, f"{done.what} {change.__name__}".strip())
    return done


def blind(rng: Rng, data: bytes) -> Mutated:
    """Damage bytes without knowing what they are."""
    change = pick(rng, (_flip, _cut, _insert, _remove, _repeat, _zeros, _number_bytes))
    return Mutated(change(rng, bytearray(data)), None, change.__name__)


def _flip(rng: Rng, data: bytearray) -> bytes:
    for at in rng.integers(0, max(1, len(data)), int(rng.choice([1, 1, 2, 5, 20]))):
        if len(data):
            data[at] ^= 1 << int(rng.integers(8))
    return bytes(data)


def _cut(rng: Rng, data: bytearray) -> bytes:
    return bytes(data[: int(rng.integers(0, len(data) + 1))])


def _insert(rng: Rng, data: bytearray) -> bytes:
    at = int(rng.integers(0, len(data) + 1))
    return bytes(data[:at]) + rng.bytes(int(rng.choice([1, 2, 4, 17, 3000]))) + bytes(data[at:])


def _remove(rng: Rng, data: bytearray) -> bytes:
    at = int(rng.integers(0, len(data) + 1))
    return bytes(data[:at]) + bytes(data[at + int(rng.choice([1, 2, 4, 100, 5000])) :])


def _repeat(rng: Rng, data: bytearray) -> bytes:
    a, b = sorted(rng.integers(0, len(data) + 1, 2).tolist())
    return bytes(data[:b]) + bytes(data[a:])


def _zeros(rng: Rng, data: bytearray) -> bytes:
    at = int(rng.integers(0, len(data) + 1))
    part = data[at : at + int(rng.choice([1, 8, 512, 4096]))]
    return bytes(data[:at]) + bytes(len(part)) + bytes(data[at + len(part) :])


def _number_bytes(rng: Rng, data: bytearray) -> bytes:
    size = int(rng.choice([1, 2, 4, 8]))
    if len(data) < size:
        return bytes(data)
    at = int(rng.integers(0, min(len(data), int(rng.choice([64, 4096, 1 << 40]))) - size + 1))
    value = int(pick(rng, NUMBERS)) % (1 << 8 * size)
    data[at : at + size] = value.to_bytes(size, "little" if rng.random() < 0.5 else "big")
    return bytes(data)


# -- lines and cells ---------------------------------------------------------------------------------------


def _lines(data: bytes) -> list[bytes]:
    return data.splitlines(keepends=True)


def _row(rng: Rng, lines: list[bytes]) -> int:
    """Return a row that is not near the start, where headers stand."""
    return int(rng.integers(min(len(lines) - 1, 40), len(lines))) if len(lines) > 1 else 0


def _cell(rng: Rng, data: bytes) -> Mutated:
    lines = _lines(data)
    if not lines:
        return Mutated(data, 0)
    at = _row(rng, lines)
    separator = max(_SEPARATORS, key=lines[at].count)
    cells = lines[at].rstrip(b"\r\n").split(separator)
    new = str(pick(rng, CELLS)).encode("utf-8", "surrogatepass")
    cells[int(rng.integers(len(cells)))] = new
    lines[at] = separator.join(cells) + lines[at][len(lines[at].rstrip(b"\r\n")) :]
    # A quote that is left open may swallow lines, and a return makes one row two.
    return Mutated(b"".join(lines), None if b'"' in new or b"\r" in new else 2)


def _number(rng: Rng, data: bytes) -> Mutated:
    found = [m.span() for m in _NUMBER.finditer(data, int(rng.integers(0, max(1, len(data)))))][:50]
    if not found:
        return Mutated(data, 0)
    a, b = pick(rng, found)
    new = str(pick(rng, CELLS)).encode("utf-8", "surrogatepass")
    head = data[:a].count(b"\n") < 40
    quotes = b'"' in new or b"\r" in new
    return Mutated(data[:a] + new + data[b:], None if head or quotes else 2)


def _without_rows(rng: Rng, data: bytes) -> Mutated:
    lines = _lines(data)
    if len(lines) < 60:
        return Mutated(data, 0)
    at = _row(rng, lines)
    gone = int(rng.choice([1, 1, 2, 10, 100]))
    return Mutated(b"".join(lines[:at] + lines[at + gone :]), 2)


def _twice(rng: Rng, data: bytes) -> Mutated:
    lines = _lines(data)
    if len(lines) < 60:
        return Mutated(data, 0)
    at = _row(rng, lines)
    return Mutated(
        b"".join(lines[: at + 1] + lines[at : at + int(rng.choice([1, 2, 30]))] + lines[at + 1 :]), 2
    )


def _swapped(rng: Rng, data: bytes) -> Mutated:
    lines = _lines(data)
    if len(lines) < 60:
        return Mutated(data, 0)
    a, b = _row(rng, lines), _row(rng, lines)
    lines[a], lines[b] = lines[b], lines[a]
    return Mutated(b"".join(lines), 4)


def _junk(rng: Rng, data: bytes) -> Mutated:
    lines = _lines(data)
    at = _row(rng, lines)
    junk = pick(
        rng,
        (
            b"\n",
            b"\x00" * 40 + b"\n",
            b"rebooting\x1b[2J...\n",
            b"," * 30 + b"\n",
            b" " * 3000 + b"\n",
            b"\xff\xfe\n",
        ),
    )
    return Mutated(b"".join([*lines[:at], junk, *lines[at:]]), 2)


def _ended(rng: Rng, data: bytes) -> Mutated:
    return Mutated(_cut(rng, bytearray(data)), 2 if data.count(b"\n") > 60 else None)


def _header(rng: Rng, data: bytes) -> Mutated:
    lines = _lines(data)
    if not lines:
        return Mutated(data, 0)
    at = int(rng.integers(0, min(len(lines), 6)))
    separator = max(_SEPARATORS, key=lines[at].count)
    cells = lines[at].rstrip(b"\r\n").split(separator)
    k = int(rng.integers(len(cells)))
    how = int(rng.integers(5))
    if how == 0:
        cells[k] = str(pick(rng, CELLS)).encode("utf-8", "surrogatepass")
    elif how == 1:
        cells.pop(k)
    elif how == 2:
        cells.append(cells[k])
    elif how == 3:
        cells[k] = cells[k][: len(cells[k]) // 2]
    else:
        cells[k] = re.sub(
            rb"\(.*\)|\[.*\]", str(pick(rng, ("(", "()", "(xx)", "[g", "(\x1b[1m)"))).encode(), cells[k]
        )
    lines[at] = separator.join(cells) + b"\n"
    return Mutated(b"".join(lines), None)


def _line_ends(rng: Rng, data: bytes) -> Mutated:
    plain = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    return Mutated(plain.replace(b"\n", pick(rng, (b"\r\n", b"\r", b"\n\n"))), None)


def _encoded(rng: Rng, data: bytes) -> Mutated:
    said = data.decode("utf-8", "replace")
    return Mutated(
        said.encode(str(pick(rng, ("utf-16", "utf-8-sig", "utf-32", "cp500", "utf-7"))), "replace"), None
    )


def _separated(rng: Rng, data: bytes) -> Mutated:
    a, b = pick(rng, _SEPARATORS), pick(rng, _SEPARATORS)
    return Mutated(data.replace(a, b), None)


def _bytes(rng: Rng, data: bytes) -> Mutated:
    return blind(rng, data)


_TEXT = (
    _cell,
    _cell,
    _number,
    _number,
    _number,
    _without_rows,
    _twice,
    _swapped,
    _junk,
    _ended,
    _header,
    _line_ends,
    _encoded,
    _separated,
    _bytes,
)


# -- TOML --------------------------------------------------------------------------------------------------

_VALUES = (
    *(
        "true",
        "0",
        "-1",
        "1e308",
        "nan",
        "inf",
        "1" * 5000,
        '""',
        "''",
        '"x"',
        "[]",
        "{}",
        "[[]]",
        "1979-05-27",
        "07:32:00",
    ),
    *(
        '"\\u0000"',
        '"/etc/passwd"',
        '"../x"',
        '"punycode"',
        '"undefined"',
        '"utf-16"',
        '"' + "x" * 3000 + '"',
        "[" * 300 + "]" * 300,
    ),
    *(
        '["a", 1]',
        "{a = 1}",
        "0x7fffffffffffffffffff",
        "9223372036854775808",
        '"%Y %q"',
        '"\\u001b[31m"',
        '"m/s²"',
        '"["',
        '"(?P<a"',
    ),
)


def toml(rng: Rng, data: bytes) -> Mutated:
    """Damage a TOML file: keys, values, tables."""
    for _ in range(int(rng.choice([1, 1, 2, 4]))):
        lines = _lines(data)
        if not lines:
            break
        keyed = [k for k, line in enumerate(lines) if b"=" in line]
        how = int(rng.integers(7))
        if how <= 2 and keyed:
            at = int(pick(rng, keyed))
            key = lines[at].split(b"=", 1)[0]
            lines[at] = key + b"= " + str(pick(rng, _VALUES)).encode() + b"\n"
        elif how == 3 and keyed:
            at = int(pick(rng, keyed))
            key, _, value = lines[at].partition(b"=")
            lines[at] = (
                key.strip()[:-1] + str(pick(rng, ("", "x", ".y", '."z z"', "\x00"))).encode() + b"=" + value
            )
        elif how == 4:
            lines.pop(int(rng.integers(len(lines))))
        elif how == 5:
            at = int(rng.integers(len(lines)))
            lines.insert(at, lines[int(rng.integers(len(lines)))])
        else:
            data = blind(rng, data).data
            continue
        data = b"".join(lines)
    return Mutated(data, None, "toml")
