r"""Binary packets of the shoe-mounted MPU-6050: 28 bytes a sensor, big-endian.

``'$' id:u8 t_ms:u32 q[4]:i16 a[3]:i16 g[3]:i16 '\r\n'``. ``q`` is the unit quaternion of the sensor's motion
processor (DMP), w x y z in units of 2⁻¹⁴, rotation from the sensor frame to the DMP's level frame, whose
heading is zero at power-up; ``a`` and ``g`` are counts of the 16-bit converter. The id is the sensor's number
(1, 2, or counted from 0) or its bus address (0x68, 0x69).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ...recording.errors import MarchaError
from ...recording.rotations import QUAT
from ..checks import SensorCheck
from ..contract import (
    HEAD_BYTES,
    ChannelSpec,
    Import,
    ReportBuilder,
)
from ..timestamps import TimestampRepair
from .mpu6050 import (
    AXES,
    IMU,
    Mpu6050Options,
    Scale,
    scales,
)

RAW = ("q0", "q1", "q2", "q3", "ax", "ay", "az", "gx", "gy", "gz")
#: One unit of the quaternion (Q14, MPU-6050 DMP).
Q14 = 1 / 16384
#: Quaternions whose length is further from 1 than this are no rotation; all zero means that the DMP is off.
UNIT_TOLERANCE = 0.02

PACKET = np.dtype(
    [("start", "u1"), ("id", "u1"), ("t_ms", ">u4"), ("v", ">i2", 10), ("end", ">u2")], align=False
)
SIZE = PACKET.itemsize
#: What devices send as id, to the sensor's number.
NUMBERS, ADDRESSES, FROM_ZERO = {1: 1, 2: 2}, {0x68: 1, 0x69: 2}, {0: 1, 1: 2}
BLOCK_BYTES = 4 << 20


class Mpu6050Packets:
    """Importer ``mpu6050-packets``: topics ``/foot/imu1``, ``/foot/imu2`` … with orientation."""

    name: ClassVar[str] = "mpu6050-packets"
    title: ClassVar[str] = (
        "binary 28-byte '$' packets of MPU-6050 on a shoe, with the sensor's own orientation"
    )
    Options = Mpu6050Options
    joins: ClassVar[bool] = True

    def sniff(self, head: bytes, path: Path) -> float:
        """Most bytes belong to packets."""
        starts = _packet_starts(np.frombuffer(head, dtype=np.uint8))
        if len(starts) < 2:
            return 0.0
        usable = len(head) - (SIZE - 1 if len(head) >= HEAD_BYTES else 0)
        share = min(1.0, len(starts) * SIZE / usable)
        return share if share > 0.5 else 0.0

    def read(self, paths: Sequence[Path], options: Mpu6050Options) -> Import:
        """Read one capture, or several pieces of it in the order given."""
        sensor_of = _sensors(paths)
        numbers = sorted(set(sensor_of.values()))
        scale = scales(paths, options, numbers)
        report = ReportBuilder()
        metadata = {
            "device": {
                "clock": "device",
                "time": "millis() of the controller, unrolled; zero at its boot",
                "name": "MPU-6050, binary packets",
                "mounting": options.mounting,
                "frames": "imu1, imu2: axes as printed on the sensor, +1 g upwards at rest; orientation: "
                "from the sensor to the DMP's level frame, z up, heading zero at power-up",
            }
        }
        channels = [
            ChannelSpec(f"/foot/imu{n}", IMU, f"imu{n}", (*AXES, *QUAT), scale[n].metadata()) for n in numbers
        ]
        return Import(
            channels=channels,
            blocks=_blocks(paths, sensor_of, scale, report),
            report=report,
            metadata=metadata,
        )


def _packet_starts(data: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Return where packets start: '$' with CR LF 26 bytes on, no two overlapping."""
    last = data.size - SIZE + 1
    if last <= 0:
        return np.empty(0, dtype=np.int64)
    starts = np.flatnonzero((data[:last] == 36) & (data[26 : 26 + last] == 13) & (data[27 : 27 + last] == 10))
    if starts.size < 2 or (np.diff(starts) >= SIZE).all():
        return starts
    kept = []  # a '$' inside a packet may have CR LF at its distance: the first in the stream is real
    free = 0
    for start in starts.tolist():
        if start >= free:
            kept.append(start)
            free = start + SIZE
    return np.array(kept, dtype=np.int64)


def _packets(path: Path) -> Iterator[tuple[NDArray[np.void], list[tuple[int, int]]]]:
    """Yield packets, and the stretches (first byte from 0, length) that are none."""
    try:
        with path.open("rb") as f:
            rest, offset, ended = b"", 0, False
            while not ended:
                piece = f.read(BLOCK_BYTES)
                ended = not piece
                data = np.frombuffer(rest + piece, dtype=np.uint8)
                starts = _packet_starts(data)
                ends = starts + SIZE
                stop = data.size if ended else max(int(ends[-1]) if starts.size else 0, data.size - SIZE + 1)
                edges = zip([0, *ends.tolist()], [*starts.tolist(), stop], strict=True)
                lost = [(offset + a, b - a) for a, b in edges if b > a]
                packets = (
                    np.lib.stride_tricks.sliding_window_view(data, SIZE)[starts] if starts.size else data[:0]
                )
                yield np.ascontiguousarray(packets).view(PACKET).reshape(-1), lost
                rest, offset = data[stop:].tobytes(), offset + stop
    except OSError as error:
        raise MarchaError(f"{path}: cannot be read: {error.strerror or error}") from error


def _sensors(paths: Sequence[Path]) -> dict[int, int]:
    """Return device id to sensor number (1 or 2), from the first block of each file.

    The way of counting is the one that most packets follow: a damaged id must not renumber the rest.
    """
    counts: Counter[int] = Counter()
    for path in paths:
        packets, _ = next(_packets(path))
        counts.update(packets["id"].tolist())
    if not counts:
        raise MarchaError(f"{paths[0]}: no 28-byte '$' packet in it; is it the device's binary log?")
    numbering = max((NUMBERS, ADDRESSES, FROM_ZERO), key=lambda k: sum(counts[i] for i in k))
    if not counts.keys() & numbering.keys():
        raise MarchaError(
            f"{paths[0]}: packets of devices {sorted(counts)}; known ids are 1 2, 0 1 or 0x68 0x69"
        )
    return {i: n for i, n in numbering.items() if i in counts}


def _blocks(
    paths: Sequence[Path], sensor_of: dict[int, int], scale: dict[int, Scale], report: ReportBuilder
) -> Iterator[tuple[str, pl.DataFrame]]:
    sensors = {i: _Sensor(n, scale[n], report) for i, n in sensor_of.items()}
    number = 0  # packets so far: findings count packets from 1
    for path in paths:
        for packets, lost in _packets(path):
            for start, length in lost:
                report.drop(
                    "lost_bytes",
                    f"{path.name}: bytes that are no packet, the first {length} from byte {start} on",
                    count=length,
                    rows=-(-length // SIZE),
                    line=number + 1,
                )
            numbers = np.arange(number + 1, number + 1 + len(packets))
            number += len(packets)
            for i in np.unique(packets["id"]).tolist():
                mine = packets["id"] == i
                if i in sensors:
                    yield from sensors[i].feed(packets[mine], numbers[mine])
                    continue
                strangers = numbers[mine]
                report.drop(
                    "bad_row",
                    f"packet of device {i}; the log is of {', '.join(map(str, sensors))}: dropped",
                    count=len(strangers),
                    line=int(strangers[0]),
                )
    for sensor in sensors.values():
        yield from sensor.finish()


class _Sensor:
    """One device id: its clock, its checks, its channel."""

    def __init__(self, number: int, scale: Scale, report: ReportBuilder) -> None:
        self.topic = f"/foot/imu{number}"
        self._scale = scale
        self._report = report
        self._clock = TimestampRepair(report, tick_ns=1_000_000, period=2**32, subject=f"{self.topic}: ")
        self._check = SensorCheck(report, self.topic, AXES, limits=scale.limits())

    def feed(
        self, packets: NDArray[np.void], numbers: NDArray[np.int64], *, final: bool = False
    ) -> Iterator[tuple[str, pl.DataFrame]]:
        values = packets["v"].astype(np.int64)
        frame = pl.DataFrame(
            {"t": packets["t_ms"].astype(np.int64), "line": numbers.astype(np.int64)}
            | {name: values[:, i] for i, name in enumerate(RAW)}
        )
        frame = self._clock.feed(frame, final=final)
        if not frame.height:
            return
        lines = frame["line"].to_numpy()
        counts = [frame[c].to_numpy() for c in RAW[4:]]
        self._check.feed(counts, lines)
        si = [c * (self._scale.acc if i < 3 else self._scale.gyr) for i, c in enumerate(counts)]
        self._check.feed_si(si[:3], si[3:], lines)
        columns = dict(zip(AXES, si, strict=True)) | self._orientation(frame, lines)
        yield self.topic, pl.DataFrame({"t_ns": frame["t_ns"], **columns})

    def finish(self) -> Iterator[tuple[str, pl.DataFrame]]:
        """Yield what the clock held back, and report."""
        yield from self.feed(np.empty(0, PACKET), np.empty(0, np.int64), final=True)
        self._check.finish(scale_hint="is the full scale (conf-A1G1A2G2) right?")

    def _orientation(self, frame: pl.DataFrame, lines: NDArray[np.int64]) -> dict[str, NDArray[np.float64]]:
        quat = frame.select(RAW[:4]).to_numpy() * Q14
        norm = np.linalg.norm(quat, axis=1)
        wrong = np.abs(norm - 1) > UNIT_TOLERANCE
        if wrong.any():
            first = int(np.argmax(wrong))
            self._report.loss(
                "missing_cell",
                f"{self.topic}: the quaternion's length is {norm[first]:.3g}, not 1: left out (NaN)",
                count=int(wrong.sum()),
                line=int(lines[first]),
                subject=f"{self.topic} quat",
            )
            quat[wrong] = np.nan
        quat[~wrong] /= norm[~wrong, None]
        return dict(zip(QUAT, quat.T, strict=True))
