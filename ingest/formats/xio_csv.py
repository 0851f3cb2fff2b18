"""CSV of x-io's sensors with a time column: ``Time (s),Gyroscope X (deg/s),…,Accelerometer X (g),…``.

Written by the x-IMU3 software and used by x-io's own gait tracking example. Units stand in the header. Axes
are the device's: a right-handed frame in which the accelerometer reads +1 g upwards at rest.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import ClassVar

import polars as pl

from ...recording.errors import MarchaError
from ..columns import (
    Header,
    find_header,
    float_blocks,
    require_header,
    with_ticks,
)
from ..contract import CommonOptions, Import, ReportBuilder
from ..inertial import (
    ACC,
    FIELD,
    GYR,
    IMU,
    MAG,
    ChannelColumns,
    SourceColumn,
    complete,
    note_unused,
    one_file,
    tables,
    x_io_columns,
)
from ..timestamps import TimestampRepair

WANTED = "Time (s),Gyroscope X (deg/s),…,Accelerometer X (g),…"


class XioOptions(CommonOptions, frozen=True, kw_only=True):
    """No options of its own: times and units stand in the file."""


class XioCsv:
    """Importer ``xio-csv``: topics ``/foot/imu`` and, where there is a magnetometer, ``/foot/mag``."""

    name: ClassVar[str] = "xio-csv"
    title: ClassVar[str] = "x-io CSV with a time column and units in its header (x-IMU3)"
    Options = XioOptions

    def sniff(self, head: bytes, path: Path) -> float:
        """A header with x-io's column names and a time."""
        return 0.95 if find_header(head, _is_header) else 0.0

    def read(self, paths: Sequence[Path], options: XioOptions) -> Import:
        """Read one file."""
        path = one_file(paths, self.name)
        header = require_header(path, _is_header, WANTED)
        columns = x_io_columns(path, header.names, header.line)
        if "t" not in columns:
            raise MarchaError(
                f"{path}, line {header.line}: no column is a time such as 'Time (s)'; repair the header"
            )
        report = ReportBuilder()
        plans = [ChannelColumns("/foot/imu", IMU, complete(columns, ACC) | complete(columns, GYR))]
        if field := complete(columns, FIELD):
            plans.append(ChannelColumns("/foot/mag", MAG, field))
        used = [columns["t"].name, *(s.name for p in plans for s in p.columns.values())]
        note_unused(header.names, used, report, header.line)
        clock = TimestampRepair(report, tick_ns=1)
        return Import(
            channels=[p.spec() for p in plans],
            blocks=tables(path, _frames(path, header, columns["t"], report), plans, clock, report),
            report=report,
            metadata={
                "device": {
                    "clock": "device",
                    "time": f"column {columns['t'].name!r}",
                    "name": "x-io sensor, CSV",
                    "frames": "imu: the device's axes, right-handed; +1 g upwards at rest",
                }
            },
        )


def _is_header(cells: Sequence[str]) -> bool:
    timed = any(c.startswith(("Time (", "Timestamp (")) for c in cells)
    return timed and any(c.startswith(("Accelerometer X", "Gyroscope X")) for c in cells)


def _frames(path: Path, header: Header, time: SourceColumn, report: ReportBuilder) -> Iterator[pl.DataFrame]:
    for frame in float_blocks(path, header, time.name, report):
        yield with_ticks(frame, time.name, time.factor, report).drop(time.name)
