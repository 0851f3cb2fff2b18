"""SensorTester: one ``;``-separated table, ``-`` where a sensor has no value, milliseconds since 1970."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np
import polars as pl

from ..columns import Header, find_header, float_blocks, require_header
from ..contract import CommonOptions, Import, ReportBuilder, SourceAttachment
from ..inertial import note_unused, one_file
from ..phonelog import (
    ACC,
    AXES,
    FIELD,
    GYR,
    HECTOPASCAL,
    MAG,
    MICROTESLA,
    PRESSURE,
    SourceColumn,
    Stream,
    StreamChannel,
    declared,
    fix_part,
    imu_part,
    require_rows,
    xyz,
)
from ..timestamps import nanoseconds
from .androsensor import orientation_part

WANTED = "TimeStamp[ms];…;AccX[m/s^2];AccY[m/s^2];AccZ[m/s^2];…"
TIME = "TimeStamp[ms]"
_HECTO = (850.0, 1100.0)
"""A pressure between these numbers is in hPa, whatever the header says: 850 Pa is the air 35 km up."""


class SensorTesterOptions(CommonOptions, frozen=True, kw_only=True):
    """No options of its own."""


class SensorTester:
    """Importer ``sensortester``: ``/phone/imu``, ``/phone/mag``, ``/phone/orientation``, ``/phone/gnss`` …"""

    name: ClassVar[str] = "sensortester"
    title: ClassVar[str] = "SensorTester: semicolons, units in brackets, - for no value"
    Options = SensorTesterOptions

    def sniff(self, head: bytes, path: Path) -> float:
        """Its header."""
        return 0.95 if find_header(head, _is_header) else 0.0

    def read(self, paths: Sequence[Path], options: SensorTesterOptions) -> Import:
        """Read one file."""
        path = one_file(paths, self.name)
        header = require_header(path, _is_header, WANTED)
        report = ReportBuilder()
        attachments: list[SourceAttachment] = []
        named = {n.split("[")[0].lower(): n for n in header.names}
        parts, used = _parts(named)
        note_unused([n for n in header.names if n], {TIME, *used}, report, header.line)
        stream = Stream(parts, report, attachments=attachments)
        return Import(
            channels=declared([stream]),
            blocks=_blocks(path, header, named, stream, report),
            report=report,
            attachments=attachments,
            metadata={
                "device": {
                    "clock": "utc",
                    "time": "milliseconds since 1970",
                    "name": "SensorTester",
                    "frames": AXES,
                    "converted": "magnetic field from µT; yaw, pitch, roll (°, magnetic north) to a rotation",
                }
            },
        )


def _is_header(cells: Sequence[str]) -> bool:
    names = {c.split("[")[0] for c in cells}
    return cells[0] == TIME and {"AccX", "AccY", "AccZ"} <= names


def _parts(named: dict[str, str]) -> tuple[list[StreamChannel], set[str]]:
    imu = xyz(ACC, [named[f"acc{a}"] for a in "xyz"])
    if all(f"gyro{a}" in named for a in "xyz"):
        imu |= xyz(GYR, [named[f"gyro{a}"] for a in "xyz"])
    parts = [imu_part("/phone/imu", imu, gravity="included")]
    used = {s.name for s in imu.values()}
    if all(f"magn{a}" in named for a in "xyz"):
        mag = xyz(FIELD, [named[f"magn{a}"] for a in "xyz"], MICROTESLA)
        parts.append(StreamChannel("/phone/mag", MAG, mag))
        used |= {s.name for s in mag.values()}
    angles = [named.get(f"orien{a}", "") for a in ("yaw", "pitch", "roll")]
    if all(angles):
        parts.append(orientation_part(angles))
        used |= set(angles)
    if "press" in named:
        parts.append(
            StreamChannel(
                "/phone/pressure", PRESSURE, {"pressure_pa": SourceColumn(named["press"], 1.0)}, held=True
            )
        )
        used.add(named["press"])
    if "lat" in named and "lng" in named:
        parts.append(fix_part({"lat": named["lat"], "lon": named["lng"]}))
        used |= {named["lat"], named["lng"]}
    return parts, used


def _blocks(
    path: Path, header: Header, named: dict[str, str], stream: Stream, report: ReportBuilder
) -> Iterator[tuple[str, pl.DataFrame]]:
    yield from stream.pull(_frames(path, header, named.get("press"), report))
    require_rows(path, [stream])


def _frames(path: Path, header: Header, press: str | None, report: ReportBuilder) -> Iterator[pl.DataFrame]:
    hecto: bool | None = None
    for frame in float_blocks(path, header, TIME, report):
        if press is not None:
            values = frame[press].to_numpy()
            if hecto is None and np.isfinite(values).any():
                middle = float(np.nanmedian(values))
                hecto = _HECTO[0] < middle < _HECTO[1] and "hpa" not in press.lower()
                if hecto:
                    report.note(
                        "unit_doubt",
                        f"{press}: {middle:.1f} is a pressure in hPa: taken as hPa",
                        line=int(frame["line"][0]),
                        subject=press,
                    )
            if hecto or "hpa" in press.lower():
                frame = frame.with_columns(pl.col(press) * HECTOPASCAL)
        t = nanoseconds(frame[TIME].to_numpy(), 1.0, tick_ns=1_000_000)
        yield frame.with_columns(t=pl.Series(t)).drop(TIME)
