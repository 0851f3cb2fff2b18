"""Calibrated CSV of the x-IMU: ``Packet number,Gyroscope X (deg/s),…,Accelerometer X (g),…``.

The file has no time. ``Packet number`` counts the packets of all kinds that the device sent (inertial,
quaternion, battery …), so its steps are not equal and it is no clock. Rows are taken to be one nominal
interval apart. A step far beyond the usual ones says that packets of all kinds were lost, how many of them
inertial is estimated from the usual number of packets a row.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, ClassVar

import msgspec
import numpy as np
import polars as pl

from ..columns import (
    Header,
    find_header,
    float_blocks,
    require_header,
)
from ..contract import CommonOptions, Import, ReportBuilder
from ..inertial import (
    ACC,
    FIELD,
    GYR,
    IMU,
    MAG,
    ChannelColumns,
    complete,
    note_unused,
    one_file,
    tables,
    x_io_columns,
)
from ..timestamps import Rate, TimestampRepair, nanoseconds

COUNTER = "Packet number"
WANTED = "Packet number,Gyroscope X (deg/s),…,Accelerometer X (g),…"


class XimuOptions(CommonOptions, frozen=True, kw_only=True):
    """The file has no time: the rate must be known.

    Attributes
    ----------
    rate_hz : float
        Output rate of the inertial packets that the device was set to (Hz).
    """

    rate_hz: Annotated[
        Rate, msgspec.Meta(description="rate of the inertial packets, Hz: the file has no time")
    ] = 256.0


class XimuCsv:
    """Importer ``ximu-csv``: topics ``/foot/imu`` and, where there is a magnetometer, ``/foot/mag``."""

    name: ClassVar[str] = "ximu-csv"
    title: ClassVar[str] = "calibrated CSV of the x-IMU: a packet counter, no time"
    Options = XimuOptions

    def sniff(self, head: bytes, path: Path) -> float:
        """A header with the packet counter and x-io's column names."""
        return 0.95 if find_header(head, _is_header) else 0.0

    def read(self, paths: Sequence[Path], options: XimuOptions) -> Import:
        """Read one file."""
        path = one_file(paths, self.name)
        header = require_header(path, _is_header, WANTED)
        columns = x_io_columns(path, header.names, header.line)
        report = ReportBuilder()
        report.note(
            "assumed_rate",
            f"the file has no time ({COUNTER!r} counts packets of all kinds): rows are taken to be "
            f"1/{options.rate_hz:g} s apart; set rate_hz if the device was set otherwise",
            line=header.line,
        )
        plans = [ChannelColumns("/foot/imu", IMU, complete(columns, ACC) | complete(columns, GYR))]
        if field := complete(columns, FIELD):
            plans.append(ChannelColumns("/foot/mag", MAG, field, held=True))
        used = {s.name for p in plans for s in p.columns.values()} | {COUNTER}
        note_unused(header.names, used, report, header.line)
        clock = TimestampRepair(report, tick_ns=1, even=False)
        return Import(
            channels=[p.spec() for p in plans],
            blocks=tables(path, _frames(path, header, options.rate_hz, report), plans, clock, report),
            report=report,
            metadata={
                "device": {
                    "clock": "device",
                    "time": f"assumed: {options.rate_hz:g} Hz from the first row",
                    "name": "x-IMU, calibrated CSV",
                    "frames": "imu: the device's axes, right-handed; +1 g upwards at rest",
                }
            },
        )


def _is_header(cells: Sequence[str]) -> bool:
    return cells[0] == COUNTER and any(c.startswith(("Accelerometer X", "Gyroscope X")) for c in cells)


def _frames(path: Path, header: Header, rate_hz: float, report: ReportBuilder) -> Iterator[pl.DataFrame]:
    """Yield rows with a time ``t`` (ns) made of their place in the file and the packets that were lost."""
    row, last, a_row = -1, None, None
    for frame in float_blocks(path, header, COUNTER, report):
        if not frame.height:
            continue
        counter = frame[COUNTER].to_numpy()
        steps = np.diff(counter, prepend=counter[0] - 1 if last is None else last)
        if a_row is None and len(steps) > 2:
            usual = steps[1:][(steps[1:] > 0) & (steps[1:] <= 4 * np.median(steps[1:]))]
            a_row = (
                max(1.0, float(usual.mean())) if usual.size else 1.0
            )  # none: the counter hardly ever rises
        lost = _lost(steps, a_row or 1.0, frame["line"].to_numpy(), report)
        place = row + np.cumsum(1 + lost)
        # A row that repeats the one before, counter included, is no new place in time: the clock drops it.
        place -= np.cumsum(steps == 0)
        row, last = int(place[-1]), counter[-1]
        t = nanoseconds(place, 1e9 / rate_hz)
        yield frame.with_columns(t=pl.Series(t)).drop(COUNTER)


def _lost(steps: np.ndarray, a_row: float, lines: np.ndarray, report: ReportBuilder) -> np.ndarray:
    """Return how many inertial packets are missing before each row, and report them.

    Packets of other kinds come in between at their own rates, so a step of up to twice the mean is normal and
    proves nothing; only beyond that something is missing.
    """
    lost = np.where(steps > 2 * a_row + 1, np.round(steps / a_row) - 1, 0).astype(np.int64)
    jumps = np.flatnonzero(lost)
    if jumps.size:
        report.loss(
            "gap",
            f"{COUNTER} steps by {steps[jumps[0]]:g} where {a_row:.2f} is usual: about {lost[jumps[0]]} rows "
            "are missing, "
            "the time goes on by as many intervals",
            count=jumps.size,
            line=int(lines[jumps[0]]),
        )
    back = np.flatnonzero(steps < 0)
    if back.size:
        report.note(
            "backwards_time",
            f"{COUNTER} steps back by {-steps[back[0]]:g}: rows are kept in their order in the file",
            count=back.size,
            line=int(lines[back[0]]),
        )
    return lost
