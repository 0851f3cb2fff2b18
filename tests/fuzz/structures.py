"""How files with a structure of their own are damaged inside it: archives, XML, JSON, MATLAB and C3D files.

What a checksum or a length protects is written anew, so that the damage reaches what reads the contents.
"""

from __future__ import annotations

import io
import json
import re
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable
from typing import Any

from marcha.ingest.archive import DAMAGED

from .mutators import CELLS, NUMBERS, Mutated, Rng, blind, pick, text

PACKINGS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)
NAMES = ("../x", "/x", "x" * 300, "a/" * 40 + "b", "C:x", "é\x1b", "con", "in.csv", "a\\..\\..\\b", "", ".")
"""Of members of archives."""
_DEEP = 100_000


def zipped(rng: Rng, data: bytes) -> Mutated:
    """Damage what an archive holds, with checksums that fit: contents, names, number of its members."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = [(m.filename, archive.read(m)) for m in archive.infolist()]
    except DAMAGED:
        return blind(rng, data)
    if not members or rng.random() < 0.2:
        return blind(rng, data)
    for _ in range(int(rng.choice([1, 1, 2, 4]))):
        at, how = int(rng.integers(len(members))), int(rng.integers(10))
        name, content = members[at]
        if how <= 6:
            members[at] = (name, inside(rng, name, content).data)
        elif how == 7:
            members[at] = (str(pick(rng, NAMES)), content)
        elif how == 8:
            members.insert(at, members[int(rng.integers(len(members)))])
        elif len(members) > 1:
            members.pop(at)
    return Mutated(archived(members, int(pick(rng, PACKINGS[:2]))), None, "zip")


def archived(members: list[tuple[str, bytes]], packing: int) -> bytes:
    """Return an archive of these members, whatever their names."""
    out = io.BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(out, "w", packing) as archive:
        warnings.simplefilter("ignore")  # a name that stands twice
        for name, content in members:
            info = zipfile.ZipInfo(name or "x")
            info.compress_type = packing
            archive.writestr(info, content)
    return out.getvalue()


def inside(rng: Rng, name: str, data: bytes) -> Mutated:
    """Damage a file by what it is: its structure where it has one, its lines where it is text."""
    start = data[:64].lstrip(b"\xef\xbb\xbf \r\n\t")
    if start.startswith(b"PK\x03\x04"):
        return zipped(rng, data)
    if start.startswith(b"<") and rng.random() < 0.8:
        return xml(rng, data)
    if start[:1] in (b"{", b"[") and rng.random() < 0.7:
        return tree(rng, data)
    if data.startswith(b"MATLAB 5.0") and rng.random() < 0.8:
        return matlab(rng, data)
    if data[1:2] == b"\x50" and name.lower().endswith(".c3d") and rng.random() < 0.8:
        return c3d(rng, data)
    return blind(rng, data) if b"\x00" in data[:1000] else text(rng, data)


# -- XML ---------------------------------------------------------------------------------------------------

_ATTRIBUTE = re.compile(rb'(?<==")[^"<>]*(?=")')
_CONTENT = re.compile(rb"(?<=>)[^<>]+(?=<)")
_ELEMENT = re.compile(rb"<(\w[\w:]*)[^<>]*>[^<>]*</\1>|<\w[^<>]*/>")
_TAG = re.compile(rb"</?\w[^<>]*>")
_CELLS_OF_SHEETS = ("A0", "A1", "XFD1048576", "ZZZZ99", "A99999999999", "a1", "1", "B2:A1", "A1:XFD1048576")
_ENTITIES = (
    b'<!DOCTYPE x [<!ENTITY a "aaaaaaaaaa">'
    + b"".join(b'<!ENTITY %c "%s">' % (98 + k, b"&%c;" % (97 + k) * 10) for k in range(9))
    + b"]>"
)


def xml(rng: Rng, data: bytes) -> Mutated:
    """Damage elements, attributes, contents and the head of an XML file."""
    for _ in range(int(rng.choice([1, 1, 2, 4]))):
        data = pick(rng, _XML)(rng, data)
    return Mutated(data, None, "xml")


def _odd(rng: Rng) -> bytes:
    said = str(pick(rng, (*CELLS, *_CELLS_OF_SHEETS)))
    if rng.random() < 0.7:
        for sign, name in (("&", "&amp;"), ("<", "&lt;"), ('"', "&quot;")):
            said = said.replace(sign, name)
    return said.encode("utf-8", "surrogatepass")


def _replaced(rng: Rng, data: bytes, places: re.Pattern[bytes], new: Callable[[bytes], bytes]) -> bytes:
    found = [m.span() for m in places.finditer(data)]
    if not found:
        return data
    a, b = found[int(rng.integers(len(found)))]
    return data[:a] + new(data[a:b]) + data[b:]


def _wrapped(rng: Rng, data: bytes) -> bytes:
    how = int(rng.integers(5))
    deep = int(rng.choice([10, 1000, _DEEP]))
    if how == 0:
        return _replaced(rng, data, _ELEMENT, lambda e: b"<g>" * deep + e + b"</g>" * deep)
    if how == 1:
        return re.sub(rb"(<\?xml[^>]*\?>)?", rb"\1" + _ENTITIES, data, count=1)
    if how == 2:
        name = str(pick(rng, ("utf-16", "utf-7", "latin-1", "punycode", "x", ""))).encode()
        return re.sub(rb"^\s*(<\?xml[^>]*\?>)?", b'<?xml version="1.0" encoding="%s"?>' % name, data, count=1)
    if how == 3:
        return _replaced(rng, data, _CONTENT, lambda _: pick(rng, (b"&i;", b"&#0;", b"&#27;", b"<![CDATA[")))
    return data.replace(b"xmlns", b"xmlnt", 1)


_XML = (
    lambda rng, data: _replaced(rng, data, _ATTRIBUTE, lambda _: _odd(rng)),
    lambda rng, data: _replaced(rng, data, _CONTENT, lambda _: _odd(rng)),
    lambda rng, data: _replaced(rng, data, _CONTENT, lambda _: _odd(rng)),
    lambda rng, data: _replaced(rng, data, _ELEMENT, lambda _: b""),
    lambda rng, data: _replaced(rng, data, _ELEMENT, lambda e: e * int(rng.choice([2, 30]))),
    lambda rng, data: _replaced(rng, data, _TAG, lambda _: b""),
    lambda rng, data: _replaced(rng, data, _TAG, lambda t: t.replace(b" ", b"\n") + t),
    lambda rng, data: blind(rng, data).data,
    _wrapped,
)


# -- JSON --------------------------------------------------------------------------------------------------


def tree(rng: Rng, data: bytes) -> Mutated:
    """Put something else in the place of a value, a key or a list of a JSON file."""
    try:
        whole = json.loads(data)
    except ValueError:
        return text(rng, data)
    for _ in range(int(rng.choice([1, 1, 2, 4]))):
        places = list(_places(whole))
        if not places:
            break
        holder, key = places[int(rng.integers(len(places)))]
        how = int(rng.integers(6))
        if how <= 3:
            holder[key] = _value(rng)
        elif how == 4:
            del holder[key]
        elif isinstance(holder, dict):
            holder[str(pick(rng, CELLS))] = holder.pop(key)
        else:
            holder.append(holder[key])
    said = json.dumps(whole, ensure_ascii=bool(rng.random() < 0.5), allow_nan=True)
    if rng.random() < 0.1:
        said = said.replace(
            "null", str(pick(rng, ("[" * _DEEP, "1" * 5000, "NaN", "1e999", "-", '"\\ud800"')))
        )
    return Mutated(said.encode("utf-8", "surrogatepass"), None, "json")


def _places(node: Any) -> Any:
    items = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    for key, value in list(items):
        yield node, key
        yield from _places(value)


def _value(rng: Rng) -> Any:
    cell = str(pick(rng, CELLS))
    number = int(pick(rng, NUMBERS))
    odd = (None, True, [], {}, [[]], {"x": 1}, 1e308, float("inf"), float("nan"), number, -number, [cell])
    return pick(rng, (*odd, cell, cell, number, str(number)))


# -- MATLAB 5 ----------------------------------------------------------------------------------------------


def matlab(rng: Rng, data: bytes) -> Mutated:
    """Damage the variables of a MATLAB 5 file: tags, sizes, dimensions, names, values; packed ones too."""
    at, parts = 128, []
    while at + 8 <= len(data):
        kind, size = struct.unpack_from("<II", data, at)
        parts.append((kind, bytearray(data[at + 8 : at + 8 + size])))
        at += 8 + size
    if not parts or rng.random() < 0.15:
        return blind(rng, data)
    for _ in range(int(rng.choice([1, 1, 3]))):
        k = int(rng.integers(len(parts)))
        kind, body = parts[k]
        if kind == 15:
            try:
                body = bytearray(zlib.decompress(bytes(body)))
            except zlib.error:
                continue
        how = int(rng.integers(8))
        if how == 0:
            parts.insert(k, parts[k])
            continue
        if how == 1:
            kind = int(pick(rng, NUMBERS)) % (1 << 32)
        elif len(body) > 12:
            near = min(len(body) - 4, int(rng.choice([16, 64, 96, 1 << 30])))
            place = int(rng.integers(near + 1)) // 4 * 4
            new = int(pick(rng, (*NUMBERS, 3, 5, 6, 7, 9, 14, 15))) % (1 << 32)
            body[place : place + 4] = new.to_bytes(4, "little")
            if how == 2:
                del body[int(rng.integers(len(body))) :]
        packed = zlib.compress(bytes(body)) if kind == 15 else bytes(body)
        parts[k] = (kind, bytearray(packed))
    body = b"".join(struct.pack("<II", kind, len(part)) + bytes(part) for kind, part in parts)
    return Mutated(data[:128] + body, None, "matlab")


# -- C3D ---------------------------------------------------------------------------------------------------


def c3d(rng: Rng, data: bytes) -> Mutated:
    """Damage words of the header, and records of the parameters: names, groups, offsets, types, dimensions."""
    damaged = bytearray(data)
    for _ in range(int(rng.choice([1, 1, 2, 4]))):
        if rng.random() < 0.3 and len(damaged) > 48:
            word = int(rng.integers(0, 12)) * 2
            damaged[word : word + 2] = (int(pick(rng, NUMBERS)) % (1 << 16)).to_bytes(2, "little")
            continue
        places = _parameters(data)
        if not places:
            return blind(rng, data)
        start, end = places[int(rng.integers(len(places)))]
        at = int(rng.integers(start, min(end, start + int(rng.choice([2, 24, 400])))))
        damaged[at] = int(pick(rng, (0, 1, 2, 4, 127, 128, 254, 255, int(rng.integers(256)))))
    return Mutated(bytes(damaged), None, "c3d")


def _parameters(data: bytes) -> list[tuple[int, int]]:
    """Return where each record of the parameter section begins and ends."""
    at, found = max(data[0] - 1, 0) * 512 + 4, []
    while at + 4 < len(data) and data[at]:
        name = abs(struct.unpack_from("<b", data, at)[0])
        step = struct.unpack_from("<h", data, at + 2 + name)[0] if at + 4 + name <= len(data) else 0
        end = at + 2 + name + step
        if step <= 0 or end > len(data):
            break
        found.append((at, end))
        at = end
    return found
