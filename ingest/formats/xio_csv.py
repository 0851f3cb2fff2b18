"""CSV of x-io's sensors with a time column: ``Time (s),Gyroscope X (deg/s),…,Accelerometer X (g),…``.

Written by the x-IMU3 software and used by x-io's own gait tracking example. Units stand in the header. Axes
are the device's: a right-handed frame in which the accelerometer reads +1 g upwards at rest. One file is a foot's;
several, or one whose segment is named, are sensors on the segments of a leg.

Other loggers use the same words. x-io's software writes its own between commas, behind the time, the gyroscope first
and in deg/s, then the accelerometer in g: any other header is one of ``inertial-csv``.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import ClassVar

import polars as pl

from ...recording.errors import MarchaError
from ..columns import Header, find_header, float_blocks, require_header, with_ticks
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
    segments_of,
    tables,
    x_io_columns,
)
from ..leg import Segments
from ..timestamps import TimestampRepair

WANTED = "Time (s),Gyroscope X (deg/s),…,Accelerometer X (g),…"
_UNITS = {
    f"{sensor} {axis}": unit
    for sensor, unit in (("Gyroscope", "deg/s"), ("Accelerometer", "g"), ("Magnetometer", ""))
    for axis in "XYZ"
}
"""Columns in the order in which x-io writes them, and their unit where it is always the same."""


class XioOptions(CommonOptions, frozen=True, kw_only=True):
    """Names of the segments, one a file; times and units stand in the files.

    Attributes
    ----------
    segments : str or None
        Names; with them, or of several files, the sensors are on a leg.
    """

    segments: Segments = None


class XioCsv:
    """Importer ``xio-csv``: ``/foot/imu``, or ``/leg/<segment>/imu``, and ``…/mag`` where there is a magnetometer."""

    name: ClassVar[str] = "xio-csv"
    title: ClassVar[str] = "x-io CSV with a time column and units in its header (x-IMU3)"
    Options = XioOptions
    joins: ClassVar[bool] = True

    def sniff(self, head: bytes, path: Path) -> float:
        """A header with a time and x-io's column names, in x-io's order and units."""
        header = find_header(head, _is_header)
        return 0.95 if header is not None and _is_own(header) else 0.0

    def read(self, paths: Sequence[Path], options: XioOptions) -> Import:
        """Read one file, or those of a leg's sensors: their times are taken to be of one clock."""
        report = ReportBuilder()
        on_leg = len(paths) > 1 or options.segments is not None
        names = segments_of(paths, options.segments, report) if on_leg else [""]
        channels: list[ChannelColumns] = []
        streams: list[Iterator[tuple[str, pl.DataFrame]]] = []
        times: list[str] = []
        for path, segment in zip(paths, names, strict=True):
            one_file([path], self.name)
            header = require_header(path, _is_header, WANTED)
            columns = x_io_columns(path, header.names, header.line)
            if "t" not in columns:
                raise MarchaError(
                    f"{path}, line {header.line}: no column is a time such as 'Time (s)'; repair the header"
                )
            place, frame_id = (f"/leg/{segment}", f"{segment}_imu") if segment else ("/foot", "imu")
            readings = complete(columns, ACC) | complete(columns, GYR)
            of_file = [ChannelColumns(f"{place}/imu", IMU, readings, frame_id)]
            if field := complete(columns, FIELD):
                of_file.append(ChannelColumns(f"{place}/mag", MAG, field, frame_id))
            used = [columns["t"].name, *(s.name for c in of_file for s in c.columns.values())]
            note_unused(header.names, used, report, header.line)
            frames = _frames(path, header, columns["t"], report)
            streams.append(tables(path, frames, of_file, TimestampRepair(report, tick_ns=1), report))
            channels += of_file
            times.append(f"column {columns['t'].name!r}")
        return Import(
            channels=[c.spec() for c in channels],
            blocks=chain.from_iterable(streams),
            report=report,
            metadata={
                "device": {
                    "clock": "device",
                    "time": ", ".join(dict.fromkeys(times)),
                    "name": "x-io sensor, CSV",
                    "frames": "imu: the device's axes, right-handed; +1 g upwards at rest",
                }
            },
        )


def _is_header(cells: Sequence[str]) -> bool:
    timed = any(c.startswith(("Time (", "Timestamp (")) for c in cells)
    return timed and any(c.startswith(("Accelerometer X", "Gyroscope X")) for c in cells)


def _is_own(header: Header) -> bool:
    """Whether a header is of x-io's own software: separator, order and units."""
    named = [c.partition(" (") for c in header.names]
    sensors = [(name, unit) for name, _, unit in named if name in _UNITS]
    order = [name for name in _UNITS if name in dict(sensors)]
    return (
        header.separator == ","
        and named[0][0] in ("Time", "Timestamp")
        and named[1][0] in _UNITS
        and [name for name, _ in sensors] == order
        and all(unit == f"{_UNITS[name]})" for name, unit in sensors if _UNITS[name])
    )


def _frames(path: Path, header: Header, time: SourceColumn, report: ReportBuilder) -> Iterator[pl.DataFrame]:
    for frame in float_blocks(path, header, time.name, report):
        yield with_ticks(frame, time.name, time.factor, report).drop(time.name)
