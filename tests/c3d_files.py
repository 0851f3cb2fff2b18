"""C3D files of any processor and number format, byte by byte after the format's published manual (c3d.org)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

BLOCK = 512
PROCESSORS = {"intel": 84, "dec": 85, "sgi": 86}
"""Fourth byte of the parameter section: PC, VAX and PDP-11, MIPS and Sun."""


def write_c3d(
    path: Path,
    points: NDArray[np.floating[Any]],
    analogs: NDArray[np.floating[Any]],
    *,
    processor: str,
    integers: bool,
    scale: float = 0.125,
    analog_scale: float = 0.25,
    rate: float = 100.0,
    changed: Mapping[int, int] | None = None,
) -> None:
    """Write markers ``m1``… (mm; NaN where not seen) and analog channels ``a1``… (V).

    Parameters
    ----------
    points : ndarray, shape (frames, markers, 3)
        Positions; multiples of ``scale`` for integers.
    analogs : ndarray, shape (frames * samples, channels)
        Values; multiples of ``analog_scale`` for integers.
    processor : str
        A key of :data:`PROCESSORS`.
    integers : bool
        Whether numbers are 16-bit integers times a scale, else 32-bit floats.
    changed : mapping of int to int, optional
        Bytes of the file put instead of what belongs there.
    """
    encode = Encoder(processor)
    frames, markers = points.shape[:2]
    channels = analogs.shape[1]
    each = len(analogs) // frames
    first_parameter = 2
    groups: dict[str, dict[str, Any]] = {
        "POINT": {
            "USED": [markers],
            "SCALE": scale if integers else -scale,
            "RATE": rate,
            "FRAMES": [frames],
            "LABELS": [f"m{i + 1}" for i in range(markers)],
            "UNITS": "mm",
        },
        "ANALOG": {
            "USED": [channels],
            "GEN_SCALE": 1.0,
            "SCALE": np.full(channels, analog_scale),
            "OFFSET": np.zeros(channels, np.int64),
            "RATE": rate * each,
            "LABELS": [f"a{i + 1}" for i in range(channels)],
            "UNITS": ["V"] * channels,
        },
    }
    blocks = -(-len(_parameters(encode, groups, 0)) // BLOCK)
    data_start = first_parameter + blocks
    groups["POINT"]["DATA_START"] = [data_start]
    blocks_again = -(-len(_parameters(encode, groups, blocks)) // BLOCK)
    assert blocks_again == blocks, "one number more moved the data"
    header = bytes([first_parameter, 0x50])
    header += encode.words([markers, each * channels, 1, frames, 10])
    header += encode.floats([scale if integers else -scale])
    header += encode.words([data_start, each]) + encode.floats([rate])
    data = bytearray()
    seen = np.asarray(np.isfinite(points).all(axis=2))
    for frame in range(frames):
        for marker in range(markers):
            xyz = np.where(seen[frame, marker], points[frame, marker], 0.0)
            residual = 0 if seen[frame, marker] else -1
            data += (
                encode.words([*np.rint(xyz / scale), residual])
                if integers
                else encode.floats([*xyz, residual])
            )
        values = (analogs[frame * each : (frame + 1) * each] / analog_scale).ravel()
        data += encode.words(values) if integers else encode.floats(values)
    text = _padded(header) + _padded(_parameters(encode, groups, blocks)) + _padded(bytes(data))
    content = bytearray(text)
    for at, byte in (changed or {}).items():
        content[at] = byte
    path.write_bytes(content)


class Encoder:
    """Numbers in the bytes of a processor."""

    def __init__(self, processor: str) -> None:
        self.code = PROCESSORS[processor]
        self.order = ">" if processor == "sgi" else "<"
        self.vax = processor == "dec"

    def words(self, values: Any) -> bytes:
        return np.asarray(values).astype(f"{self.order}i2").tobytes()

    def floats(self, values: Any) -> bytes:
        """Return 32-bit floats. A VAX F float is four times the IEEE one of the same bits, its high word first."""
        numbers = np.asarray(values, np.float32)
        if not self.vax:
            return numbers.astype(f"{self.order}f4").tobytes()
        return (
            (numbers * np.float32(4))
            .astype("<f4")
            .view("<u2")
            .reshape(-1, 2)[:, ::-1]
            .astype("<u2")
            .tobytes()
        )


def _padded(part: bytes) -> bytes:
    return part + bytes(-len(part) % BLOCK)


def _parameters(encode: Encoder, groups: Mapping[str, Mapping[str, Any]], blocks: int) -> bytes:
    """Return the parameter section: its head, groups with negative numbers, their parameters."""
    out = bytearray([1, 0x50, blocks, encode.code])
    for number, (group, parameters) in enumerate(groups.items(), 1):
        out += bytes([len(group), 256 - number]) + group.encode() + encode.words([3]) + b"\x00"
        for name, value in parameters.items():
            kind, shape, raw = _value(encode, value)
            body = bytes([kind & 0xFF, len(shape), *shape]) + raw + b"\x00"
            out += bytes([len(name), number]) + name.encode() + encode.words([2 + len(body)]) + body
    return bytes(out) + bytes(2)


def _value(encode: Encoder, value: Any) -> tuple[int, list[int], bytes]:
    if isinstance(value, str):
        return -1, [len(value)], value.encode()
    if isinstance(value, float):
        return 4, [], encode.floats([value])
    if isinstance(value, list) and value and isinstance(value[0], str):
        width = max(map(len, value))
        return -1, [width, len(value)], "".join(v.ljust(width) for v in value).encode()
    numbers = np.asarray(value)
    if numbers.dtype.kind == "f":
        return 4, [len(numbers)], encode.floats(numbers)
    return 2, [len(numbers)] if len(numbers) > 1 else [], encode.words(numbers)
