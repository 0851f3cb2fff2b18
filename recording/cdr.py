"""CDR byte layout of messages, derived from their definitions.

A message has a fixed layout once the lengths of its strings and sequences are given. :class:`Layout` holds
it as a NumPy structured type that covers the whole message, encapsulation included, so that a block of equal
messages is encoded or decoded as columns. Alignment counts from byte 4, behind the encapsulation; an empty
sequence gets no padding for its element type. (OMG DDS-RTPS 9.4.2, XCDR1; checked against rosbags.)
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .definitions import PRIMITIVES, Definition, Library

ENCAPSULATION = {b"\x00\x00": ">", b"\x00\x01": "<"}
"""Byte order by the first two bytes of a message; bytes 2 and 3 are options (pad bits) and do not matter."""

_ENCAPSULATION_WORD = {order: int.from_bytes(head, "little") for head, order in ENCAPSULATION.items()}

MAX_LEAVES = 4096
"""A message with more leaves than this (a point cloud of structures) has no columns."""

MAX_BYTES = 1 << 28
"""Largest fixed-size message that has columns."""

MAX_DEPTH = 32
"""Types within types: a definition that holds itself ends here."""

Bytes = NDArray[np.uint8]


class CdrError(ValueError):
    """The bytes do not fit the definition, or the encoding is not plain CDR."""


class Layout:
    """Where every leaf of a message lies, for given lengths of strings and sequences.

    Attributes
    ----------
    dtype : numpy.dtype
        Structured type of the whole message. Field names are paths: ``header.stamp.sec``,
        ``orientation_covariance`` (shape 9), ``transforms[0].header.frame_id`` (bytes); the length
        prefix of a string or sequence is ``<path>#``.
    counts : dict of str to int
        Value of each length prefix.
    sequences : dict of str to int
        Number of elements of each sequence.
    order : str
        ``<`` or ``>``.
    """

    def __init__(
        self,
        definition: Definition,
        library: Library,
        count_at: Callable[[str, int, bool], int],
        order: str = "<",
    ) -> None:
        self.order = order
        self.counts: dict[str, int] = {}
        self.sequences: dict[str, int] = {}
        self._names: list[str] = ["#"]  # the first two bytes; the options behind them stay out
        self._formats: list[Any] = ["<u2"]
        self._offsets: list[int] = [0]
        self._at = 4
        self._count_at = count_at
        self._library = library
        self._walk("", definition)
        try:
            self.dtype = np.dtype(
                {
                    "names": self._names,
                    "formats": self._formats,
                    "offsets": self._offsets,
                    "itemsize": self._at,
                }
            )
        except ValueError as error:  # a definition that names a field twice
            raise CdrError(f"{definition.name}: {error}") from None

    @property
    def key(self) -> tuple[Any, ...]:
        """What tells layouts of one definition apart."""
        return (self.order, *self.counts.values())

    def _add(self, path: str, format_: Any, size: int, align: int) -> None:
        self._at += -(self._at - 4) % align
        if len(self._names) >= MAX_LEAVES:
            raise CdrError(f"more than {MAX_LEAVES} values in one message")
        if self._at + size > MAX_BYTES:
            raise CdrError(f"{path}: one message would have more than {MAX_BYTES} bytes")
        self._names.append(path)
        self._formats.append(format_)
        self._offsets.append(self._at)
        self._at += size

    def _count(self, path: str, string: bool) -> int:
        self._add(f"{path}#", f"{self.order}u4", 4, 4)
        count = self._count_at(path, self._offsets[-1], string)
        self.counts[path] = count
        return count

    def _walk(self, prefix: str, definition: Definition) -> None:
        if prefix.count(".") > MAX_DEPTH:
            raise CdrError(f"{prefix[:80]}…: types lie more than {MAX_DEPTH} deep within one another")
        for field in definition.fields:
            path = prefix + field.name
            length = field.length
            if length == -1:
                length = self._count(path, False)
                self.sequences[path] = length
            primitive = PRIMITIVES.get(field.type)
            if primitive is not None:
                if length == 0:
                    continue
                size = np.dtype(primitive).itemsize
                format_ = self.order + primitive if size > 1 else primitive
                if length is None:
                    self._add(path, format_, size, size)
                else:
                    self._add(path, (format_, (length,)), size * length, size)
                continue
            if field.type == "wstring":
                raise CdrError(f"{path}: wide strings are not supported")
            if length is not None and length > MAX_LEAVES:
                raise CdrError(f"{path}: {length} values; at most {MAX_LEAVES}")
            for i in range(1 if length is None else length):
                item = path if length is None else f"{path}[{i}]"
                if field.type == "string":
                    count = self._count(item, True)
                    if count:
                        self._add(item, f"S{count}", count, 1)
                else:
                    self._walk(item + ".", self._library[field.type])

    def template(self) -> NDArray[Any]:
        """Return one zeroed message (shape ()) with encapsulation and length prefixes set."""
        record = np.zeros((), self.dtype)
        record["#"] = _ENCAPSULATION_WORD[self.order]
        for path, count in self.counts.items():
            record[f"{path}#"] = count
        return record

    def fits(self, block: NDArray[Any]) -> NDArray[np.bool_]:
        """Return which messages of ``block`` (a view with this layout's type) have this layout's lengths.

        Shapes: ``block`` and result (n,).
        """
        good = block["#"] == _ENCAPSULATION_WORD[self.order]
        for path, count in self.counts.items():
            good &= block[f"{path}#"] == count
        return good

    def leaf(self, block: NDArray[Any], path: str) -> NDArray[Any]:
        """Return the values of one leaf; ``path`` may end in an index, ``position[3]``.

        Shapes: ``block`` (n,), result (n,), or (n, k) of an array of k values.

        Raises
        ------
        KeyError
            There is no such leaf in this layout.
        """
        names = block.dtype.names or ()
        if path in names:
            return block[path]
        base, index = split_index(path)
        if index is None or base not in names or index >= block.dtype[base].shape[0]:
            raise KeyError(path)
        return block[base][..., index]

    def text(self, block: NDArray[Any], path: str) -> str | None:
        """Return the string at ``path`` in the first message of ``block``; None where there is none.

        Shape of ``block``: (n,).
        """
        if path not in self.counts or path in self.sequences:
            return None
        if self.counts[path] == 0:
            return ""
        return decode_text(bytes(block[path].flat[0]))


def decode_text(raw: bytes) -> str:
    """Return a string's text; bytes that are not UTF-8 are kept as escapes."""
    return raw.rstrip(b"\x00").decode("utf-8", "backslashreplace")


_INDEX = re.compile(r"^(.*)\[(\d+)\]$")


def split_index(path: str) -> tuple[str, int | None]:
    """Split ``position[3]`` into ``("position", 3)``; without an index the second part is None."""
    match = _INDEX.match(path)
    return (match[1], int(match[2])) if match else (path, None)


def byte_order(message: bytes | memoryview) -> str:
    """Return ``<`` or ``>`` from the encapsulation.

    Raises
    ------
    CdrError
        Shorter than 4 bytes, or not plain CDR (parameter lists and XCDR2 are not supported).
    """
    head = bytes(message[:4])
    if len(head) < 4:
        raise CdrError(f"{len(head)} bytes, shorter than the encapsulation")
    order = ENCAPSULATION.get(head[:2])
    if order is None:
        raise CdrError(f"encapsulation {head[:2].hex(' ')}: only plain CDR (00 00, 00 01) is supported")
    return order


def layout_of_message(message: bytes | memoryview, definition: Definition, library: Library) -> Layout:
    """Return the layout of one message, walking its bytes.

    Raises
    ------
    CdrError
        The message ends before its definition does, or a length is out of range.
    """
    order = byte_order(message)
    size = len(message)
    name = "little" if order == "<" else "big"

    def count_at(path: str, offset: int, string: bool) -> int:
        if offset + 4 > size:
            raise CdrError(f"{path}: the message ends at byte {size}")
        count = int.from_bytes(message[offset : offset + 4], name)
        if count > size - offset - 4:  # every element takes a byte at least
            raise CdrError(f"{path}: length {count} in a message of {size} bytes")
        return count

    layout = Layout(definition, library, count_at, order)
    if layout.dtype.itemsize > size:
        raise CdrError(f"{size} bytes, {layout.dtype.itemsize} expected")
    return layout


def layout_of_lengths(definition: Definition, library: Library, lengths: Mapping[str, int]) -> Layout:
    """Return the layout for given lengths: bytes of each string (without NUL), elements of each sequence.

    A path that ``lengths`` does not name is empty.
    """

    def count_at(path: str, offset: int, string: bool) -> int:
        return lengths.get(path, 0) + string  # a string's length counts its NUL

    return Layout(definition, library, count_at)


def encode(value: Mapping[str, Any], definition: Definition, library: Library) -> bytes:
    """Encode one message of any type.

    Parameters
    ----------
    value : mapping
        Field name to value; nested mappings for messages, sequences for arrays. Every field must be there.
    definition : Definition
        The message type.
    library : Library
        It and all types that it uses.

    Raises
    ------
    CdrError
        A field is missing, unknown, or of the wrong length.
    """
    out = bytearray(b"\x00\x01\x00\x00")
    _write(out, "", value, definition, library)
    return bytes(out)


def _write(
    out: bytearray, prefix: str, value: Mapping[str, Any], definition: Definition, library: Library
) -> None:
    """Append the fields of one message; alignment counts from byte 4."""
    if value.keys() != definition.names:
        odd = sorted(definition.names ^ value.keys())
        raise CdrError(f"{definition.name}: fields missing or unknown: {', '.join(odd)}")
    for field in definition.fields:
        path, item = prefix + field.name, value[field.name]
        if field.length == -1:
            out += bytes(-len(out) % 4) + len(item).to_bytes(4, "little")
        elif field.length is not None and len(item) != field.length:
            raise CdrError(f"{definition.name}: {path}: {len(item)} elements, {field.length} expected")
        primitive = PRIMITIVES.get(field.type)
        if primitive is not None:
            if field.length is None or len(item):
                try:
                    raw = np.array(item, "<" + primitive)
                except (OverflowError, ValueError, TypeError) as e:
                    raise CdrError(f"{definition.name}: {path}: {e}") from None
                if raw.shape != (() if field.length is None else (len(item),)):
                    raise CdrError(f"{definition.name}: {path}: shape {raw.shape}")
                out += bytes(-(len(out) - 4) % raw.itemsize) + raw.tobytes()
            continue
        for i, v in enumerate([item] if field.length is None else item):
            if field.type == "string":
                text = str(v).encode()
                if b"\x00" in text:
                    raise CdrError(f"{definition.name}: {path}: a string may not contain NUL")
                out += bytes(-len(out) % 4) + (len(text) + 1).to_bytes(4, "little") + text + b"\x00"
            else:
                inner = f"{path}." if field.length is None else f"{path}[{i}]."
                _write(out, inner, v, library[field.type], library)


def decode(message: bytes | memoryview, definition: Definition, library: Library) -> dict[str, Any]:
    """Decode one message of any type into nested dicts, lists, numbers and strings.

    Raises
    ------
    CdrError
        See :func:`layout_of_message`.
    """
    layout = layout_of_message(message, definition, library)
    record = np.frombuffer(message, layout.dtype, 1)
    return _unflatten("", record, definition, library, layout)


def _unflatten(
    prefix: str, record: NDArray[Any], definition: Definition, library: Library, layout: Layout
) -> dict:
    out: dict[str, Any] = {}
    for field in definition.fields:
        path = prefix + field.name
        if field.type in PRIMITIVES:
            empty = field.length is not None and path not in layout.dtype.names  # type: ignore[operator]
            out[field.name] = [] if empty else record[path][0].tolist()
            continue
        count = layout.sequences.get(path, field.length)
        paths = [path] if count is None else [f"{path}[{i}]" for i in range(count)]
        values: list[Any] = [
            layout.text(record, p)
            if field.type == "string"
            else _unflatten(p + ".", record, library[field.type], library, layout)
            for p in paths
        ]
        out[field.name] = values[0] if count is None else values
    return out
