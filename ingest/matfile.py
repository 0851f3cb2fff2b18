"""MATLAB 5 files: their tables of numbers, read without trusting a byte of them.

Compiled readers end the process on some damaged files; this one checks every length and says what is wrong.
Only real numeric matrices are read; other variables are known by their name.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..recording.errors import MarchaError
from .text import read_whole

MAGIC = b"MATLAB 5.0 MAT-file"
_HDF5 = b"\x89HDF\r\n\x1a\n"
_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_MATRIX, _COMPRESSED = 14, 15
_NUMERIC = range(6, 16)
"""Classes double … uint64."""
_MOST_BYTES = 1 << 32


class Variable(NamedTuple):
    """A variable: name, shape, and its values where it is a real matrix of numbers and was asked for."""

    name: str
    shape: tuple[int, ...]
    values: np.ndarray | None


def read_mat(path: Path, names: set[str] | None = None) -> dict[str, Variable]:
    """Read the variables ``names`` of a file; others, and all without ``names``, come without values.

    Raises
    ------
    MarchaError
        The file cannot be read, is no MATLAB 5 file or is damaged.
    """
    data = read_whole(path)
    if data[:8] == _HDF5 or data[:10] == b"MATLAB 7.3" or data[512:520] == _HDF5:
        raise MarchaError(f"{path}: a MATLAB 7.3 file (HDF5); save it with save(…, '-v7')")
    if not data.startswith(MAGIC) or data[126:128] not in (b"IM", b"MI"):
        raise MarchaError(f"{path}: not a readable MATLAB file: it does not begin with {MAGIC.decode()!r}")
    order = "<" if data[126:128] == b"IM" else ">"
    variables: dict[str, Variable] = {}
    try:
        for kind, body in _elements(memoryview(data)[128:], order):
            matrix = body
            if kind == _COMPRESSED:
                matrix = _inflated(body, order)
            elif kind != _MATRIX:
                continue
            variable = _variable(matrix, order, names)
            variables[variable.name] = variable
    except (_Damaged, zlib.error) as error:
        raise MarchaError(f"{path}: a damaged MATLAB file: {error}; copy or save it again") from None
    return variables


class _Damaged(Exception):
    pass


def _elements(data: memoryview, order: str) -> Iterator[tuple[int, memoryview]]:
    offset = 0
    while offset + 8 <= len(data):
        kind, size, start, end = _tag(data, offset, order)
        yield kind, data[start : start + size]
        offset = end if kind != _COMPRESSED else start + size  # compressed elements are not padded
    if any(data[offset:]):
        raise _Damaged(f"{len(data) - offset} bytes behind its last variable")


def _tag(data: memoryview, offset: int, order: str) -> tuple[int, int, int, int]:
    """Return type, size, start of the data and start of the next element."""
    if offset + 8 > len(data):
        raise _Damaged("it ends in the middle of a variable")
    first, second = (int(v) for v in np.frombuffer(data[offset : offset + 8], f"{order}u4"))
    if first >> 16:  # a small element: size and type in one word
        kind, size, start, end = first & 0xFFFF, first >> 16, offset + 4, offset + 8
        if size > 4:
            raise _Damaged("a small element of more than 4 bytes")
    else:
        kind, size, start = first, second, offset + 8
        end = start + (size + 7) // 8 * 8
    if start + size > len(data):
        raise _Damaged("it ends in the middle of a variable")
    return kind, size, start, end


def _inflated(body: memoryview, order: str) -> memoryview:
    inflater = zlib.decompressobj()
    head = inflater.decompress(body, 8)
    if len(head) < 8:
        raise _Damaged("a compressed variable is cut")
    kind, size = (int(v) for v in np.frombuffer(head, f"{order}u4"))
    if kind != _MATRIX or size > _MOST_BYTES:
        raise _Damaged("a compressed variable is no matrix, or larger than 4 GiB")
    data = inflater.decompress(inflater.unconsumed_tail, size)
    if len(data) < size:
        raise _Damaged("a compressed variable is cut")
    return memoryview(data)


def _variable(data: memoryview, order: str, names: set[str] | None) -> Variable:
    kind, size, start, offset = _tag(data, 0, order)
    if kind != 6 or size != 8:
        raise _Damaged("a variable without flags")
    flags = int(np.frombuffer(data[start : start + 4], f"{order}u4")[0])
    kind, size, start, offset = _tag(data, offset, order)
    if kind != 5 or size % 4:
        raise _Damaged("a variable without dimensions")
    shape = tuple(int(n) for n in np.frombuffer(data[start : start + size], f"{order}i4"))
    kind, size, start, offset = _tag(data, offset, order)
    name = bytes(data[start : start + size]).decode("utf-8", "replace")
    numeric = (flags & 0xFF) in _NUMERIC and not flags & 0x0800 and all(n >= 0 for n in shape)
    if not numeric or names is None or name not in names:
        return Variable(name, shape, None)
    kind, size, start, offset = _tag(data, offset, order)
    if kind not in _TYPES:
        raise _Damaged(f"variable {name!r} has values of the unknown type {kind}")
    dtype = np.dtype(order + _TYPES[kind])
    count = int(np.prod(shape, dtype=object)) if shape else 0
    if size != count * dtype.itemsize:
        raise _Damaged(f"variable {name!r} holds {size} bytes, not the {count} values of its dimensions")
    values = np.frombuffer(data[start : start + size], dtype).astype(float)
    return Variable(name, shape, values.reshape(shape, order="F"))
