"""AndroSensor: one CSV with a row of all sensors at an interval, units in the header.

A short second export (``accX,accY,…,delta``) has the same columns without units and without positions.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np
import polars as pl

from ...recording.errors import MarchaError
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
    QUAT,
    QUATERNION,
    VALUES,
    SourceColumn,
    Stream,
    StreamChannel,
    declared,
    fix_part,
    imu_part,
    quaternion_of,
    require_rows,
    whole_ns,
    xyz,
)

WANTED = "ACCELEROMETER X (m/s²),…,Time since start in ms"
SHORT = {
    "accX": "acc x", "accY": "acc y", "accZ": "acc z",
    "gX": "gravity x", "gY": "gravity y", "gZ": "gravity z",
    "gyrX": "gyr x", "gyrY": "gyr y", "gyrZ": "gyr z",
    "mX": "mag x", "mY": "mag y", "mZ": "mag z",
    "oZ": "azimuth", "oX": "pitch", "oY": "roll", "delta": "ms",
}  # fmt: skip
"""Columns of the short export; its units are those of the long one."""
_SENSORS = (
    ("acc", re.compile(r"accelerometer ([xyz])\b", re.IGNORECASE)),
    ("linear", re.compile(r"linear acceleration ([xyz])\b", re.IGNORECASE)),
    ("gravity", re.compile(r"gravity ([xyz])\b", re.IGNORECASE)),
    ("gyr", re.compile(r"gyroscope ([xyz])\b", re.IGNORECASE)),
    ("mag", re.compile(r"magnetic field ([xyz])\b", re.IGNORECASE)),
)
_OTHERS = (
    ("azimuth", re.compile(r"orientation z", re.IGNORECASE)),
    ("pitch", re.compile(r"orientation x", re.IGNORECASE)),
    ("roll", re.compile(r"orientation y", re.IGNORECASE)),
    ("lat", re.compile(r"location latitude", re.IGNORECASE)),
    ("lon", re.compile(r"location longitude", re.IGNORECASE)),
    ("alt", re.compile(r"location altitude \(", re.IGNORECASE)),
    ("accuracy", re.compile(r"location accuracy", re.IGNORECASE)),
    ("speed", re.compile(r"location speed \( ?kmh\)", re.IGNORECASE)),
    ("course", re.compile(r"location orientation", re.IGNORECASE)),
    ("pressure", re.compile(r"(?:atmospheric )?pressure \(hpa\)", re.IGNORECASE)),
    ("ms", re.compile(r"time since start in ms", re.IGNORECASE)),
    ("wall", re.compile(r"yyyy-mo-dd", re.IGNORECASE)),
)


class AndroSensorOptions(CommonOptions, frozen=True, kw_only=True):
    """No options of its own; ``start`` gives the UTC time that the local wall clock of the file does not say."""


class AndroSensor:
    """Importer ``androsensor``: ``/phone/imu``, ``/phone/mag``, ``/phone/gnss``, ``/phone/orientation`` …"""

    name: ClassVar[str] = "androsensor"
    title: ClassVar[str] = "AndroSensor CSV: all sensors in a row, units in the header"
    Options = AndroSensorOptions

    def sniff(self, head: bytes, path: Path) -> float:
        """Its column names and the time since the start."""
        return 0.95 if find_header(head, _is_header) else 0.0

    def read(self, paths: Sequence[Path], options: AndroSensorOptions) -> Import:
        """Read one file."""
        path = one_file(paths, self.name)
        header = require_header(path, _is_header, WANTED)
        report = ReportBuilder()
        attachments: list[SourceAttachment] = []
        columns = _columns_of(header.names)
        if header.names[0] in SHORT:
            report.note(
                "assumed_unit",
                "the header has no units: those of AndroSensor are taken (m/s², rad/s, µT, °, ms)",
                line=header.line,
            )
        parts = _parts(path, columns)
        used = {n for k, n in columns.items() if not k.startswith("gravity")}
        note_unused(header.names, used, report, header.line)
        device = {
            "clock": "device",
            "time": "milliseconds since the start",
            "name": "AndroSensor",
            "frames": AXES,
            "converted": "magnetic field from µT; azimuth, pitch, roll (°, magnetic north) to a rotation; accuracy "
            "(68 % radius) to a standard deviation an axis",
        }
        stream = Stream(parts, report, attachments=attachments)
        return Import(
            channels=declared([stream]),
            blocks=_blocks(path, header, columns, stream, report, device),
            report=report,
            metadata={"device": device},
            attachments=attachments,
        )


def _is_header(cells: Sequence[str]) -> bool:
    if "accX" in cells and "delta" in cells:
        return True
    return any(c.lower().startswith("time since start in ms") for c in cells) and any(
        p.match(c) for c in cells for _, p in _SENSORS
    )


def _columns_of(names: Sequence[str]) -> dict[str, str]:
    """Return what is known (``acc x``, ``lat`` …) and the name of its column."""
    columns: dict[str, str] = {}
    for name in names:
        if name in SHORT:
            columns[SHORT[name]] = name
        for key, pattern in _SENSORS:
            if m := pattern.match(name):
                columns.setdefault(f"{key} {m[1].lower()}", name)
        for key, pattern in _OTHERS:
            if pattern.match(name):
                columns.setdefault(key, name)
    return columns


def _parts(path: Path, columns: dict[str, str]) -> list[StreamChannel]:
    def three(key: str) -> list[str]:
        names = [columns.get(f"{key} {a}", "") for a in "xyz"]
        return names if all(names) else []

    imu: dict[str, SourceColumn] = {}
    if names := three("acc"):
        imu |= xyz(ACC, names)
    if names := three("gyr"):
        imu |= xyz(GYR, names)
    parts = [imu_part("/phone/imu", imu, gravity="included")] if imu else []
    if names := three("linear"):
        parts.append(
            StreamChannel("/phone/linear_acc", VALUES, xyz(ACC, names), ACC, metadata={"gravity": "removed"})
        )
    if names := three("mag"):
        parts.append(StreamChannel("/phone/mag", MAG, xyz(FIELD, names, MICROTESLA)))
    angles = [columns.get(a, "") for a in ("azimuth", "pitch", "roll")]
    if all(angles):
        parts.append(orientation_part(angles))
    if "pressure" in columns:
        source = {"pressure_pa": SourceColumn(columns["pressure"], HECTOPASCAL)}
        parts.append(StreamChannel("/phone/pressure", PRESSURE, source, held=True))
    if "lat" in columns and "lon" in columns:
        wanted = ("lat", "lon", "alt", "accuracy", "speed", "course")
        parts.append(fix_part({k: columns[k] for k in wanted if k in columns}, speed_factor=1 / 3.6))
    if not parts:
        raise MarchaError(f"{path}: no sensor with its three axes in the header; nothing to convert")
    return parts


def orientation_part(names: Sequence[str]) -> StreamChannel:
    """Return the phone's own orientation, from columns of azimuth, pitch and roll in degrees."""

    def make(frame: pl.DataFrame) -> dict[str, np.ndarray]:
        return quaternion_of(*(np.radians(frame[n].to_numpy()) for n in names))

    about = {"north": "magnetic", "source": "azimuth, pitch and roll of the phone"}
    return StreamChannel("/phone/orientation", QUATERNION, make, QUAT, metadata=about)


def _blocks(
    path: Path,
    header: Header,
    columns: dict[str, str],
    stream: Stream,
    report: ReportBuilder,
    device: dict[str, str],
) -> Iterator[tuple[str, pl.DataFrame]]:
    yield from stream.pull(_frames(path, header, columns, report, device))
    require_rows(path, [stream])


def _frames(
    path: Path, header: Header, columns: dict[str, str], report: ReportBuilder, device: dict[str, str]
) -> Iterator[pl.DataFrame]:
    texts = {n for n in header.names if n and n not in columns.values()} | {columns.get("wall", "")}
    first = True
    for frame in float_blocks(path, header, columns["ms"], report, texts=texts):
        if first and "wall" in columns and frame.height:
            device["wall_clock_start"] = f"{frame[columns['wall']][0]} (local time of the phone)"
            first = False
        t = whole_ns(frame[columns["ms"]], 1e3).alias("t")
        yield pl.DataFrame([*(s for s in frame.get_columns() if s.name not in (*texts, columns["ms"])), t])
