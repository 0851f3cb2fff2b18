"""Serial text of two MPU-6050 on one shoe: ``t_ms`` and twelve counts of the 16-bit converter a row.

A row is ``t_ms, ax1, ay1, az1, gx1, gy1, gz1, ax2, ay2, az2, gx2, gy2, gz2``; ``t_ms`` is the controller's
``millis()``, unsigned 32 bit, so it wraps every 49.7 days. Axes are those printed on the sensor; the
accelerometer reads +1 g upwards at rest.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np
import polars as pl

from ...recording.errors import MarchaError
from ..checks import SensorCheck
from ..contract import HEAD_BYTES, Import, ReportBuilder
from ..text import IntegerRows, integer_rows
from ..timestamps import TimestampRepair
from .mpu6050 import (
    AXES,
    Mpu6050Options,
    Scale,
    channel,
    scales,
)

COLUMNS = ("t_ms", *(f"{axis}{sensor}" for sensor in (1, 2) for axis in ("ax", "ay", "az", "gx", "gy", "gz")))
LIMITS = ((0, 2**32 - 1), *[(-32768, 32767)] * 12)
#: Steps of a believable time column, ms.
STEP_MS = (0, 1000)

_WALL = rb"\s*(?:(?:[\d/.-]{10}[ T])?\d\d:\d\d:\d\d(?:[.,:]\d+)?(?:[\s>-]+|$))?"  # a terminal's wall clock
_BLANK = re.compile(_WALL + rb"\s*")
_ROW = re.compile(_WALL + rb"(\d+)(?:(?:[ \t]*[,;][ \t]*|[ \t]+)[+-]?\d+){12}[\s,;]*")


class Mpu6050Serial:
    """Importer ``mpu6050-serial``: topics ``/foot/imu1`` and ``/foot/imu2``."""

    name: ClassVar[str] = "mpu6050-serial"
    title: ClassVar[str] = "serial text of two MPU-6050 on a shoe: 13 whole numbers a row, 100 Hz"
    Options = Mpu6050Options
    joins: ClassVar[bool] = True

    def sniff(self, head: bytes, path: Path) -> float:
        """Rows of 13 whole numbers whose first grows like milliseconds."""
        lines = [line for line in re.split(rb"[\r\n]+", head) if not _BLANK.fullmatch(line)]
        lines = lines[:-1] if len(lines) > 1 and len(head) >= HEAD_BYTES else lines  # the last may be cut
        times = [int(m[1]) for line in lines if (m := _ROW.fullmatch(line))]
        if len(times) < 2 or 2 * len(times) < len(lines):
            return 0.0
        timely = sum(STEP_MS[0] <= b - a <= STEP_MS[1] for a, b in itertools.pairwise(times)) / (
            len(times) - 1
        )
        return 0.95 * timely * len(times) / len(lines)

    def read(self, paths: Sequence[Path], options: Mpu6050Options) -> Import:
        """Read one text, or several pieces of one capture in the order given."""
        scale = scales(paths, options)
        report = ReportBuilder()
        metadata: dict[str, dict[str, str]] = {
            "device": {
                "clock": "device",
                "time": "millis() of the controller, unrolled; zero at its boot",
                "name": "two MPU-6050, serial text",
                "mounting": options.mounting,
                "frames": "imu1, imu2: axes as printed on the sensor, +1 g upwards at rest",
            }
        }
        channels = [channel(sensor, scale[sensor]) for sensor in (1, 2)]
        blocks = _blocks(paths, scale, report, metadata["device"])
        return Import(channels=channels, blocks=blocks, report=report, metadata=metadata)


def _blocks(
    paths: Sequence[Path], scale: dict[int, Scale], report: ReportBuilder, device: dict[str, str]
) -> Iterator[tuple[str, pl.DataFrame]]:
    clock = TimestampRepair(report, tick_ns=1_000_000, period=2**32)
    checks = {s: SensorCheck(report, f"/foot/imu{s}", AXES, limits=scale[s].limits()) for s in (1, 2)}
    wall = _WallClock()
    for frame in clock.stream(_frames(paths, report, wall)):
        yield from _tables(frame, scale, checks)
    if not report.kept:
        raise MarchaError(
            f"{paths[0]}: no row of {len(COLUMNS)} whole numbers in it; is it the device's serial text?"
        )
    for check in checks.values():
        check.finish(scale_hint="is the full scale (conf-A1G1A2G2) right?")
    device.update(wall.metadata())


def _frames(paths: Sequence[Path], report: ReportBuilder, wall: _WallClock) -> Iterator[pl.DataFrame]:
    for path in paths:
        for rows in integer_rows(path, LIMITS, COLUMNS, report):
            wall.feed(rows)
            series = zip(("t", *COLUMNS[1:]), rows.values, strict=True)
            yield pl.DataFrame([*(pl.Series(n, v) for n, v in series), pl.Series("line", rows.lines)])


def _tables(
    frame: pl.DataFrame, scale: dict[int, Scale], checks: dict[int, SensorCheck]
) -> Iterator[tuple[str, pl.DataFrame]]:
    lines = frame["line"].to_numpy()
    for sensor in (1, 2):
        counts = [frame[f"{a}{sensor}"].to_numpy() for a in ("ax", "ay", "az", "gx", "gy", "gz")]
        checks[sensor].feed(counts, lines)
        si = [c * (scale[sensor].acc if i < 3 else scale[sensor].gyr) for i, c in enumerate(counts)]
        checks[sensor].feed_si(si[:3], si[3:], lines)
        table = pl.DataFrame([frame["t_ns"], *(pl.Series(a, v) for a, v in zip(AXES, si, strict=True))])
        yield f"/foot/imu{sensor}", table


class _WallClock:
    """First and last wall clock that a terminal put before the rows, beside the device time."""

    def __init__(self) -> None:
        self._seen: list[tuple[int, int]] = []
        self._rows = 0

    def feed(self, rows: IntegerRows) -> None:
        stamped = np.flatnonzero(rows.wall_ms >= 0)
        if not stamped.size:
            return
        self._rows += stamped.size
        ends = [(int(rows.wall_ms[i]), int(rows.values[0, i])) for i in (stamped[0], stamped[-1])]
        self._seen = [self._seen[0] if self._seen else ends[0], ends[1]]

    def metadata(self) -> dict[str, str]:
        if not self._seen:
            return {}
        (first, t_first), (last, t_last) = self._seen
        return {
            "wall_clock_first": _clock_text(first),
            "wall_clock_first_t_ms": str(t_first),
            "wall_clock_last": _clock_text(last),
            "wall_clock_last_t_ms": str(t_last),
            "wall_clock_rows": str(self._rows),
        }


def _clock_text(ms: int) -> str:
    s, ms = divmod(ms, 1000)
    return f"{s // 3600:02}:{s // 60 % 60:02}:{s % 60:02}.{ms:03}"
