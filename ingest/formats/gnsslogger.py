"""GnssLogger text: ``Fix,…``, ``UncalAccel,…`` … rows; the columns of each kind stand in ``#`` lines.

Sensors have UTC in whole milliseconds and the time since boot in nanoseconds: rows get the latter, moved to UTC by the
median difference. The satellite provider's fixes are taken where there are any, else the fused provider's, which
are mostly the same positions again.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np
import polars as pl

from ...recording.errors import MarchaError
from ..contract import HEAD_BYTES, CommonOptions, Import, ReportBuilder, SourceAttachment
from ..inertial import one_file
from ..phonelog import (
    ACC,
    AXES,
    FIELD,
    GYR,
    MAG,
    MICROTESLA,
    QUAT,
    QUATERNION,
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
from ..text import read_blocks, start_of
from ..timestamps import MOST_NS
from ..typedrows import typed_blocks

_SENSORS = {"Accel": "/phone/acc", "Gyro": "/phone/gyr", "Mag": "/phone/mag"}
_ORIENTATION = "OrientationDeg"
_SAME_CLOCK_NS = 20_000_000
"""UTC and the time since boot run alike where their difference varies less in a block."""
_FIX = {
    "latitude": "lat",
    "latitudedegrees": "lat",
    "longitude": "lon",
    "longitudedegrees": "lon",
    "altitude": "alt",
    "altitudemeters": "alt",
    "accuracy": "accuracy",
    "accuracymeters": "accuracy",
    "verticalaccuracymeters": "vertical",
    "speed": "speed",
    "speedmps": "speed",
    "bearing": "course",
    "bearingdegrees": "course",
    "(utc)timeinms": "t",
    "unixtimemillis": "t",
    "provider": "provider",
}


class GnssLoggerOptions(CommonOptions, frozen=True, kw_only=True):
    """No options of its own."""


class GnssLogger:
    """Importer ``gnsslogger``: ``/phone/gnss``, ``/phone/acc``, ``/phone/gyr``, ``/phone/mag``."""

    name: ClassVar[str] = "gnsslogger"
    title: ClassVar[str] = "GnssLogger text: fixes and uncalibrated sensors"
    Options = GnssLoggerOptions

    def sniff(self, head: bytes, path: Path) -> float:
        """The header line of its fixes."""
        return 0.95 if re.search(rb"(?m)^# ?Fix,Provider,", head) else 0.0

    def read(self, paths: Sequence[Path], options: GnssLoggerOptions) -> Import:
        """Read one file."""
        path = one_file(paths, self.name)
        columns = _columns(path)
        report = ReportBuilder()
        attachments: list[SourceAttachment] = []
        there: set[str] = set()
        providers: set[str] = set()
        for piece, _ in read_blocks(path):
            there |= {k for k in columns if f"\n{k},".encode() in piece}
            providers |= {m.decode().upper() for m in re.findall(rb"(?m)^Fix,([A-Za-z]+),", piece)}
        streams: dict[str, Stream] = {}
        for kind in sorted(there):
            names = columns[kind]
            if kind == "Fix":
                wanted = ("lat", "lon", "alt", "accuracy", "vertical", "speed", "course")
                part = fix_part({k: k for k in wanted if k in names})
                streams[kind] = Stream([part], report, subject="fixes", even=False, attachments=attachments)
                continue
            if kind == _ORIENTATION:
                part = StreamChannel(
                    "/phone/orientation", QUATERNION, _rotation, QUAT, metadata={"north": "magnetic"}
                )
                streams[kind] = Stream([part], report, subject=part.topic)
                continue
            topic = _SENSORS[kind.removeprefix("Uncal")]
            if topic in {p.topic for s in streams.values() for p in s.parts}:
                continue
            axes = ("x", "y", "z")
            part = (
                StreamChannel(topic, MAG, xyz(FIELD, axes, MICROTESLA))
                if topic == "/phone/mag"
                else imu_part(topic, xyz(ACC if topic == "/phone/acc" else GYR, axes))
            )
            streams[kind] = Stream([part], report, subject=topic)
        return Import(
            channels=declared(streams.values()),
            blocks=_blocks(path, columns, streams, "GPS" if "GPS" in providers else "FLP", report),
            report=report,
            attachments=attachments,
            metadata={
                "device": {
                    "clock": "utc",
                    "time": "sensors: time since boot moved to UTC by the median difference; fixes: UTC",
                    "name": "GnssLogger",
                    "frames": AXES,
                    "converted": "uncalibrated readings less the bias that Android states beside them; field from µT; "
                    "yaw, roll, pitch (°, magnetic north) to a rotation",
                }
            },
        )


def _columns(path: Path) -> dict[str, list[str]]:
    """Return the columns of every kind of row from the # lines; an empty name where a cell is not read."""
    columns: dict[str, list[str]] = {}
    for line in start_of(path, HEAD_BYTES).decode("utf-8", "replace").splitlines():
        cells = [c.strip() for c in line.lstrip("# ").split(",")]
        if not line.startswith("#") or len(cells) < 4:
            continue
        kind = cells[0]
        if kind == "Fix":
            columns[kind] = [_FIX.get(c.lower(), "") for c in cells]
        elif kind == _ORIENTATION or kind.removeprefix("Uncal") in _SENSORS:
            columns[kind] = [_sensor_column(c) for c in cells]
    for kind, names in columns.items():
        wanted = _needed(kind)
        if any(n not in names for n in wanted):
            raise MarchaError(
                f"{path}: the header of {kind} lacks time, axes or position; not a known version"
            )
    return columns


def _needed(kind: str) -> tuple[str, ...]:
    return ("t", "lat", "lon") if kind == "Fix" else ("t", "x", "y", "z")


def _rotation(frame: pl.DataFrame) -> dict[str, np.ndarray]:
    yaw, roll, pitch = (np.radians(frame[c].to_numpy()) for c in "xyz")
    return quaternion_of(yaw, pitch, roll)


def _sensor_column(name: str) -> str:
    low = name.lower()
    roles = {
        "utctimemillis": "t",
        "elapsedrealtimenanos": "boot",
        "yawdeg": "x",
        "rolldeg": "y",
        "pitchdeg": "z",
    }
    if low in roles:
        return roles[low]
    bias = low.startswith(("bias", "drift"))
    match = re.search(r"([xyz])(?:mps2|radpersec|microt)$", low)
    return (("bias_" if bias else "") + match[1]) if match else ""


def _utc_ns(frame: pl.DataFrame, boot_ns: list[int], report: ReportBuilder) -> pl.Series:
    """Return the rows' times (ns): since boot moved to UTC where both run alike, else UTC.

    A row whose time since boot is missing, or is none that a clock can say, has its UTC alone. ``boot_ns`` keeps the
    UTC of boot, found in the first block that has both, for all kinds of rows.
    """
    utc = whole_ns(frame["t"], 1e3)
    if "boot" not in frame.columns:
        return utc
    boot = frame["boot"]
    usable = boot.is_finite() & (boot.abs() <= MOST_NS)
    far = boot.is_infinite() | (boot.abs() > MOST_NS)
    if far.any():
        first = int(far.arg_true()[0])
        report.repair(
            "missing_cell",
            f"elapsedRealtimeNanos: {boot[first]:g} is beyond any clock: taken as missing",
            count=int(far.sum()),
            line=frame["line"][first],
            subject="boot",
        )
    if not usable.any():
        return utc
    since = pl.select(pl.when(usable).then(boot)).to_series().round().cast(pl.Int64)
    gap = (utc - since).drop_nulls()
    middle = int(np.median(gap.to_numpy()))
    if int(gap.max()) - int(gap.min()) > _SAME_CLOCK_NS:  # type: ignore[arg-type]
        return utc
    if not boot_ns:
        boot_ns.append(middle)
    offset = boot_ns[0] if abs(middle - boot_ns[0]) < _SAME_CLOCK_NS else middle
    return (since + offset).fill_null(utc)


def _blocks(
    path: Path,
    columns: dict[str, list[str]],
    streams: dict[str, Stream],
    provider: str,
    report: ReportBuilder,
) -> Iterator[tuple[str, pl.DataFrame]]:
    boot_ns: list[int] = []

    def kinds(kind: str, width: int) -> Sequence[str] | None:
        if kind not in streams:
            return None
        names = columns[kind]
        needed = 1 + max(names.index(n) for n in _needed(kind))
        return names[: max(width, needed)]  # old versions leave out trailing cells that their header names

    tables = typed_blocks(
        path, r"^([A-Za-z]+),", ",", kinds, report, required=lambda kind: "t", texts=("provider",)
    )
    for block in tables:
        for kind, frame in block.items():
            frame = frame.with_columns(t=_utc_ns(frame, boot_ns, report))
            if kind == "Fix" and "provider" in frame.columns:
                gps = frame["provider"].str.to_uppercase() == provider
                if not gps.all():
                    report.drop(
                        "other_provider",
                        f"fixes of other providers than {provider} are left out",
                        count=int((~gps).sum()),
                        line=int(frame["line"][int((~gps).arg_true()[0])]),
                    )
                    frame = frame.filter(gps)
            for axis in "xyz":
                if f"bias_{axis}" in frame.columns:
                    frame = frame.with_columns(pl.col(axis) - pl.col(f"bias_{axis}").fill_nan(0.0))
            yield from streams[kind].push(frame)
    for stream in streams.values():
        yield from stream.finish()
    require_rows(path, list(streams.values()))
