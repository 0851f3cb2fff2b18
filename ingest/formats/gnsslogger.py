"""GnssLogger text: ``Fix,…``, ``UncalAccel,…`` … rows; the columns of each kind stand in ``#`` lines."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import ClassVar

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
    Stream,
    StreamChannel,
    declared,
    fix_part,
    imu_part,
    require_rows,
    whole_ns,
    xyz,
)
from ..text import read_blocks, start_of
from ..typedrows import typed_blocks

_SENSORS = {"Accel": "/phone/acc", "Gyro": "/phone/gyr", "Mag": "/phone/mag"}
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
        for piece, _ in read_blocks(path):
            there |= {k for k in columns if f"\n{k},".encode() in piece}
        streams: dict[str, Stream] = {}
        for kind in sorted(there):
            names = columns[kind]
            if kind == "Fix":
                part = fix_part({k: k for k in ("lat", "lon", "alt", "accuracy", "vertical") if k in names})
                streams[kind] = Stream([part], report, subject="fixes", even=False, attachments=attachments)
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
            blocks=_blocks(path, columns, streams, report),
            report=report,
            attachments=attachments,
            metadata={
                "device": {
                    "clock": "utc",
                    "time": "milliseconds since 1970",
                    "name": "GnssLogger",
                    "frames": AXES,
                    "converted": "uncalibrated readings less the bias that Android states beside them; field from µT",
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
        elif kind.removeprefix("Uncal") in _SENSORS:
            columns[kind] = [_sensor_column(c) for c in cells]
    for kind, names in columns.items():
        wanted = ("t", "lat", "lon") if kind == "Fix" else ("t", "x", "y", "z")
        if any(n not in names for n in wanted):
            raise MarchaError(
                f"{path}: the header of {kind} lacks time, axes or position; not a known version"
            )
    return columns


def _sensor_column(name: str) -> str:
    low = name.lower()
    if low == "utctimemillis":
        return "t"
    bias = low.startswith("bias")
    match = re.search(r"([xyz])(?:mps2|radpersec|microt)$", low)
    return (("bias_" if bias else "") + match[1]) if match else ""


def _blocks(
    path: Path, columns: dict[str, list[str]], streams: dict[str, Stream], report: ReportBuilder
) -> Iterator[tuple[str, pl.DataFrame]]:
    def kinds(kind: str, width: int) -> Sequence[str] | None:
        if kind not in streams:
            return None
        names = columns[kind]
        needed = 1 + max(
            names.index(n) for n in (("t", "lat", "lon") if kind == "Fix" else ("t", "x", "y", "z"))
        )
        return names[: max(width, needed)]  # old versions leave out trailing cells that their header names

    tables = typed_blocks(
        path, r"^([A-Za-z]+),", ",", kinds, report, required=lambda kind: "t", texts=("provider",)
    )
    for block in tables:
        for kind, frame in block.items():
            frame = frame.with_columns(t=whole_ns(frame["t"], 1e3))
            if kind == "Fix" and "provider" in frame.columns:
                gps = frame["provider"].str.to_uppercase().is_in(["GPS", "FLP"])
                if not gps.all():
                    report.drop(
                        "other_provider",
                        "fixes of the network provider are left out",
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
