"""How recordings are damaged: record by record, and as files that another program might have written."""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from functools import lru_cache
from io import BytesIO

import lz4.frame
import numpy as np
import zstandard
from mcap.opcode import Opcode
from mcap.writer import CompressionType, Writer

from .mutators import CELLS, NUMBERS, Mutated, Rng, blind, pick

_HEAD = struct.Struct("<BQ")
_CHUNK = struct.Struct("<QQQI")
MAGIC = b"\x89MCAP0\r\n"
NAMES = (
    *(
        "",
        "/",
        "//",
        "/a",
        "/a/b",
        "/" + "x" * 300,
        "/" + "y/" * 200,
        "/é",
        "/\x1b[31m",
        "/a b",
        "/..",
        "/../../x",
        "a",
        "/a\nb",
    ),
    *(
        "/con",
        "/a:b",
        "/foot/imu1",
        "/estimate/x",
        "/estimate/x/pose",
        "/reference/pose",
        "/annotation/x",
        "/annotation/",
        "/\u202e",
    ),
)
"""Topics, and names of attachments and records, that outputs stumble over."""
TEXTS = (
    "string data\n",
    "float64[] x\n",
    "float64[1000000000000] x\n",
    "string[99999999] s\n",
    "A inner\n",
    "wstring w\n",
    "float64 x\nfloat64 x\n",
    "geometry_msgs/Vector3[] v\n",
    "float64<=3 x\n",
    "int8 A=99999999999\nint8 x\n",
    "x\n",
    "\x00",
    "float64 " + "x" * 5000 + "\n",
    "builtin_interfaces/Time stamp\nuint64 n\nbool b\n",
    "std_msgs/Header header\nfloat32[4] q\nstring[] names\n\n"
    + "=" * 80
    + "\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n",
)
"""Message definitions that a schema may state."""


@dataclass
class Record:
    """One record of a file: its kind, its content, and the length that its head states."""

    opcode: int
    body: bytes
    length: int | None = None

    def bytes(self) -> bytes:
        return _HEAD.pack(self.opcode, len(self.body) if self.length is None else self.length) + self.body


def records(data: bytes, start: int = 8) -> list[Record]:
    """Return the records of a sound file."""
    found, at = [], start
    while at + 9 <= len(data) and data[at : at + 8] != MAGIC:
        opcode, length = _HEAD.unpack_from(data, at)
        found.append(Record(opcode, data[at + 9 : at + 9 + length]))
        at += 9 + length
    return found


def whole(parts: list[Record]) -> bytes:
    """Return a file of these records."""
    return MAGIC + b"".join(r.bytes() for r in parts) + MAGIC


def mutate(rng: Rng, data: bytes) -> Mutated:
    """Damage a recording; ``rows`` is 0 where every row that is still read must be one of the sound file."""
    how = int(rng.integers(10))
    if how <= 2:
        return _one_place(rng, data)
    if how <= 8:
        parts = records(data)
        said = ""
        for _ in range(int(rng.choice([1, 1, 2, 4]))):
            change = pick(rng, _CHANGES)
            said += change(rng, parts) + " "
        if rng.random() < 0.5:
            parts = _without_summary(parts)
            said += "unindexed"
        return Mutated(whole(parts), None, said.strip())
    return blind(rng, data)


def _one_place(rng: Rng, data: bytes) -> Mutated:
    """Damage one byte or cut the end: checksums must tell, and what they cover keeps its values."""
    damaged = bytearray(data)
    if rng.random() < 0.3:
        return Mutated(data[: int(rng.integers(0, len(data)))], 0, "cut")
    at = int(rng.integers(0, len(data)))
    damaged[at] ^= int(rng.integers(1, 256))
    return Mutated(bytes(damaged), 0, f"byte {at}")


def _without_summary(parts: list[Record]) -> list[Record]:
    """Return the records up to the end of the data, and a footer that has no summary: readers must scan."""
    ends = [k for k, r in enumerate(parts) if r.opcode == Opcode.DATA_END]
    kept = parts[: ends[0] + 1] if ends else parts
    return [*kept, Record(Opcode.FOOTER, struct.pack("<QQI", 0, 0, 0))]


def _any(rng: Rng, parts: list[Record], *kinds: int) -> int | None:
    at = [k for k, r in enumerate(parts) if not kinds or r.opcode in kinds]
    return int(pick(rng, at)) if at else None


def _order(rng: Rng, parts: list[Record]) -> str:
    a, b = _any(rng, parts), _any(rng, parts)
    if a is None or b is None:
        return "none"
    how = int(rng.integers(3))
    if how == 0:
        parts.pop(a)
    elif how == 1:
        parts.insert(b, parts[a])
    else:
        parts[a], parts[b] = parts[b], parts[a]
    return ("dropped", "doubled", "swapped")[how]


def _length(rng: Rng, parts: list[Record]) -> str:
    at = _any(rng, parts)
    if at is not None:
        parts[at].length = (len(parts[at].body) + int(pick(rng, (*NUMBERS, -2, 3, 9)))) % (1 << 64)
    return "length"


def _field(rng: Rng, parts: list[Record]) -> str:
    """Put a number at the border of its type into a record, mostly near its start where lengths and ids stand."""
    kinds = pick(
        rng,
        (
            (),
            (Opcode.FOOTER,),
            (Opcode.STATISTICS,),
            (Opcode.CHUNK_INDEX,),
            (Opcode.MESSAGE_INDEX,),
            (Opcode.CHUNK,),
            (Opcode.SCHEMA, Opcode.CHANNEL),
            (Opcode.METADATA, Opcode.ATTACHMENT, Opcode.METADATA_INDEX, Opcode.ATTACHMENT_INDEX),
        ),
    )
    at = _any(rng, parts, *kinds)
    if at is None or len(parts[at].body) < 8:
        return "none"
    body, size = bytearray(parts[at].body), int(rng.choice([2, 4, 8]))
    place = (
        int(rng.integers(0, min(len(body), int(rng.choice([24, 60, 1 << 30]))) - size + 1))
        if len(body) > size
        else 0
    )
    body[place : place + size] = (int(pick(rng, NUMBERS)) % (1 << 8 * size)).to_bytes(size, "little")
    parts[at] = Record(parts[at].opcode, bytes(body))
    return f"field of {parts[at].opcode}"


def _unpacked(body: bytes) -> tuple[tuple[int, ...], bytes]:
    """Return the head of a chunk (first, last, size, crc) and its records."""
    head = _CHUNK.unpack_from(body)
    n = int.from_bytes(body[28:32], "little")
    name, packed = body[32 : 32 + n].decode(), body[32 + n + 8 :]
    if name == "zstd":
        packed = zstandard.ZstdDecompressor().decompress(packed, max_output_size=head[2])
    elif name == "lz4":
        packed = lz4.frame.decompress(packed)
    return head, packed


def _intact(body: bytes) -> bool:
    """Whether a chunk can still be taken apart: an earlier change may have damaged it or made it a bomb."""
    try:
        data = _unpacked(body)[1]
        if len(data) >= 1 << 20:  # of zeros: more records than a mutation may take time for
            return False
        records(data, 0)
    except (ValueError, OverflowError, RuntimeError, struct.error, zstandard.ZstdError, MemoryError):
        return False
    return True


def _packed(first: int, last: int, size: int, crc: int, data: bytes, name: str) -> bytes:
    packed = {"zstd": zstandard.ZstdCompressor(1).compress, "lz4": lz4.frame.compress}.get(name, bytes)(data)
    said = name.encode()
    return (
        _CHUNK.pack(first, last, size, crc)
        + struct.pack("<I", len(said))
        + said
        + struct.pack("<Q", len(packed))
        + packed
    )


def _chunk(rng: Rng, parts: list[Record]) -> str:
    """Damage what a chunk holds, with a checksum that fits, and what its head says of it."""
    at = _any(rng, parts, Opcode.CHUNK)
    if at is None or not _intact(parts[at].body):
        return "none"
    (first, last, size, crc), data = _unpacked(parts[at].body)
    how, name = int(rng.integers(7)), str(pick(rng, ("zstd", "lz4", "", "zstd", "xyz", "\x1b[1m")))
    if how <= 2:
        inner = records(data, 0)
        for _ in range(int(rng.choice([1, 3, 40]))):
            _message(rng, inner)
        data = b"".join(r.bytes() for r in inner)
        size, crc = len(data), zlib.crc32(data)
    elif how == 3:
        size = int(pick(rng, (*NUMBERS, size + 1, size - 1)))
        crc = int(pick(rng, (0, crc)))
    elif how == 4:
        data, crc = bytes(int(pick(rng, (0, 1, 1 << 20, 1 << 25 if name in ("zstd", "lz4") else 1 << 16)))), 0
        size = int(pick(rng, (len(data), 100)))
    elif how == 5:
        data = blind(rng, data).data
        size, crc = len(data), 0
    else:
        first, last = (int(pick(rng, NUMBERS)) % (1 << 64) for _ in "ab")
    parts[at] = Record(Opcode.CHUNK, _packed(first, last, size % (1 << 64), crc % (1 << 32), data, name))
    return f"chunk {how} {name!r}"


def _message(rng: Rng, inner: list[Record]) -> None:
    at = _any(rng, inner, Opcode.MESSAGE)
    if at is None:
        return
    body = bytearray(inner[at].body)
    how = int(rng.integers(6))
    if how == 0:
        body[0:2] = struct.pack("<H", int(pick(rng, (0, 1, 2, 77, 65535))))
    elif how == 1:
        place = int(pick(rng, (6, 14)))
        body[place : place + 8] = (int(pick(rng, NUMBERS)) % (1 << 64)).to_bytes(8, "little")
    elif how == 2:
        body = body[: int(rng.integers(0, len(body) + 1))]
    elif how == 3:
        body += rng.bytes(int(rng.choice([1, 4, 100])))
    elif how == 4 and len(body) > 34:
        place = int(rng.integers(22, len(body) - 4))
        body[place : place + 4] = (int(pick(rng, NUMBERS)) % (1 << 32)).to_bytes(4, "little")
    else:
        inner.insert(int(rng.integers(len(inner) + 1)), inner[at])
    inner[at] = Record(Opcode.MESSAGE, bytes(body))


def _loose(rng: Rng, parts: list[Record]) -> str:
    """Put the records of a chunk beside it, as a file without chunks has them."""
    at = _any(rng, parts, Opcode.CHUNK)
    if at is not None and _intact(parts[at].body):
        inner = records(_unpacked(parts[at].body)[1], 0)
        for _ in range(int(rng.choice([0, 2]))):
            _message(rng, inner)
        parts[at : at + 1] = inner
    return "loose"


def _strings(rng: Rng, parts: list[Record]) -> str:
    """Rewrite a schema, channel, metadata record or attachment with odd texts."""
    at = _any(rng, parts, Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA, Opcode.ATTACHMENT)
    if at is None:
        return "none"
    kind, body = parts[at].opcode, parts[at].body
    name = str(pick(rng, NAMES))
    if kind == Opcode.SCHEMA:
        encoding, text = (
            str(pick(rng, ("ros2msg", "ros2msg", "jsonschema", "ros2idl", ""))),
            str(pick(rng, TEXTS)),
        )
        known = body[6 : 6 + int.from_bytes(body[2:6], "little")].decode("utf-8", "replace")
        title = str(
            pick(
                rng,
                (known, known, "a/msg/A", "a", "", "foxglove_msgs/msg/Event", "sensor_msgs/msg/JointState"),
            )
        )
        body = body[:2] + _s(title) + _s(encoding) + _b(text.encode())
    elif kind == Opcode.CHANNEL:
        about = {
            str(pick(rng, ("columns", "frame_id", "unit", "x" * 500))): str(pick(rng, (*_COLUMNS, *CELLS)))
            for _ in range(3)
        }
        body = body[:4] + _s(name) + _s(str(pick(rng, ("cdr", "cdr", "json", "")))) + _m(about)
    elif kind == Opcode.METADATA:
        title = str(
            pick(
                rng,
                (
                    "truth",
                    "device",
                    "provenance",
                    "import_report",
                    "run/foot_naive_foot_imu1",
                    "clocks",
                    "history",
                    name,
                ),
            )
        )
        keys = (
            "length_m",
            "closed",
            "steps",
            "findings",
            "rows_read",
            "fatal",
            "range.start_ns",
            "segments",
            "loop_s",
            "estimator",
            "input",
            "clock",
            "json",
            name,
        )
        body = _s(title) + _m({str(pick(rng, keys)): str(pick(rng, (*_COLUMNS, *CELLS))) for _ in range(5)})
    else:
        data = rng.bytes(20)
        front = (
            struct.pack("<QQ", 1, 1)
            + _s(str(pick(rng, (name, "events.tsv", "anchors.csv", "plan.geojson", "a", "a/b"))))
            + _s(str(pick(rng, ("text/plain", "", "\x1b"))))
            + struct.pack("<Q", len(data))
            + data
        )
        body = front + struct.pack("<I", zlib.crc32(front))
    parts[at] = Record(kind, body)
    return f"strings of {kind}"


_COLUMNS = (
    '["a"]',
    "[]",
    "{}",
    "1",
    "null",
    '"abc"',
    '["a","a"]',
    "[1,2]",
    '["acc_x"]',
    "[[]]",
    "[" * 2000,
    '[["bad_row","x",1,"y"]]',
    '[["a","b","c"]]',
    '[{"kind":1}]',
)
_CHANGES = (_order, _length, _field, _field, _chunk, _chunk, _chunk, _loose, _strings, _strings, _strings)


def _s(text: str) -> bytes:
    return _b(text.encode("utf-8", "surrogatepass"))


def _b(data: bytes) -> bytes:
    return struct.pack("<I", len(data)) + data


def _m(items: dict[str, str]) -> bytes:
    return _b(b"".join(_s(k) + _s(v) for k, v in items.items()))


# -- files as another program might write them ------------------------------------------------------------------


def odd(rng: Rng, data: bytes) -> bytes:
    """Return a sound recording with odd contents, written by mcap's own library from what ``data`` holds."""
    parts, out = records(data), BytesIO()
    packing = pick(rng, (CompressionType.ZSTD, CompressionType.LZ4, CompressionType.NONE))
    writer = Writer(
        out,
        compression=packing,
        use_chunking=bool(rng.random() < 0.8),
        chunk_size=int(rng.choice([1 << 10, 1 << 16, 1 << 20])),
    )
    writer.start(str(pick(rng, ("ros2", "", "x"))), "another program")
    schemas: dict[int, int] = {}
    channels: dict[int, int] = {}
    for part in parts:
        if part.opcode == Opcode.SCHEMA and (old := int.from_bytes(part.body[:2], "little")) not in schemas:
            title, encoding, text = texts(part.body[2:], 3)
            schemas[old] = writer.register_schema(title.decode(), encoding.decode(), text)
    for part in parts:
        if part.opcode == Opcode.CHANNEL and (old := int.from_bytes(part.body[:2], "little")) not in channels:
            topic, encoding, about = texts(part.body[4:], 3)
            name = topic.decode() if rng.random() < 0.7 else str(pick(rng, NAMES))
            pairs = texts(about)
            said = dict(
                zip((p.decode() for p in pairs[::2]), (p.decode() for p in pairs[1::2]), strict=False)
            )
            if rng.random() < 0.3:
                said = {} if rng.random() < 0.5 else said | {"columns": str(pick(rng, _COLUMNS))}
            schema = schemas.get(int.from_bytes(part.body[2:4], "little"), 0)
            channels[old] = writer.register_channel(name, encoding.decode(), schema, said)
    extra = _own_channels(rng, writer)
    share, shift = float(rng.choice([1.0, 0.3, 0.02])), int(rng.choice([0, 0, 10**18, 2**62, -(10**15)]))
    first = None
    messages = _messages(data)
    taken = rng.random(len(messages)) <= share
    for k in np.flatnonzero(taken).tolist():
        channel, sequence, log, publish, content = messages[k]
        first = log if first is None else first
        log, publish = (max(0, t - first + shift if shift < 0 else t + shift) for t in (log, publish))
        odds = rng.random(2)
        if odds[0] < 0.02:
            publish = int(pick(rng, (0, log, 2**63, 2**64 - 1)))
        if odds[1] < 0.02 and len(content) > 60:
            body = bytearray(content)
            at = int(rng.integers(40, len(body) - 8)) // 8 * 8 + 4
            body[at : at + 8] = struct.pack(
                "<d", float(pick(rng, (float("nan"), float("inf"), 1e308, -1e308, 5e-324)))
            )
            content = bytes(body)
        writer.add_message(channels.get(channel, 1), log, content, publish, sequence)
        for other, payload in extra:
            if rng.random() < 0.01:
                writer.add_message(other, log, payload, publish)
    for _ in range(int(rng.integers(0, 4))):
        writer.add_metadata(
            str(pick(rng, ("truth", "device", "x", "run/a", "\x1b[1m"))),
            {str(pick(rng, NAMES)): str(pick(rng, CELLS)), "length_m": str(pick(rng, CELLS))},
        )
        writer.add_attachment(
            1,
            1,
            str(pick(rng, ("a", "a/b", "../x", "x" * 300, "é", "\x1b", "anchors.csv", "plan.geojson"))),
            "text/plain",
            rng.bytes(9),
        )
    writer.finish()
    return out.getvalue()


@lru_cache(16)
def _messages(data: bytes) -> list[tuple[int, int, int, int, bytes]]:
    """Return channel, sequence, both times (ns) and content of every message of a sound file."""
    return [
        (*struct.unpack_from("<HIQQ", message.body), message.body[22:])
        for chunk in records(data)
        if chunk.opcode == Opcode.CHUNK
        for message in records(_unpacked(chunk.body)[1], 0)
        if message.opcode == Opcode.MESSAGE
    ]


def _own_channels(rng: Rng, writer: Writer) -> list[tuple[int, bytes]]:
    """Add channels of another program's types: a text, an array, a structure."""
    found = []
    for text, payload in (
        (TEXTS[0], _s("hello\x1b[31m\x00")),
        (TEXTS[1], struct.pack("<I4xd", 1, 2.0)),
        (TEXTS[13], bytes(8) + struct.pack("<QB", 7, 1)),
        ("float64 x\n", struct.pack("<d", float("inf"))),
    ):
        if rng.random() < 0.4:
            schema = writer.register_schema(
                str(pick(rng, ("other_msgs/msg/Thing", "std_msgs/msg/String", "a/msg/A"))),
                "ros2msg",
                text.encode(),
            )
            found.append(
                (writer.register_channel(str(pick(rng, NAMES)), "cdr", schema), b"\x00\x01\x00\x00" + payload)
            )
    return found


def texts(body: bytes, most: int = 1 << 16) -> list[bytes]:
    found, at = [], 0
    while at + 4 <= len(body) and len(found) < most:
        n = int.from_bytes(body[at : at + 4], "little")
        found.append(body[at + 4 : at + 4 + n])
        at += 4 + n
    return found
