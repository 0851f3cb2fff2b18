"""GetSensorData (IPIN): rows ``ACCE;app time;sensor time;…``, signals, and ``POSI``: surveyed positions.

The comment lines at the head declare the columns of each kind of row, which differ between the app's versions: they
are believed where they are there. The app's clock (s since the start) is common to all rows but late by the time of
handing over; the sensor's clock is exact with an origin of its own. Rows get the sensor's time, moved by the median
difference of the two.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np
import polars as pl

from ..contract import HEAD_BYTES, CommonOptions, Import, ReportBuilder
from ..inertial import one_file
from ..phonelog import (
    ACC,
    AXES,
    FIELD,
    FIX,
    GYR,
    HECTOPASCAL,
    MAG,
    MICROTESLA,
    PRESSURE,
    QUAT,
    QUATERNION,
    RADIO,
    SourceColumn,
    Stream,
    StreamChannel,
    declared,
    fix_part,
    imu_part,
    require_rows,
    rotation_vector,
    whole_ns,
    xyz,
)
from ..text import read_blocks, start_of
from ..typedrows import typed_blocks
from .indoor_location import radio_columns, radio_frame

_ROW = re.compile(rb"(?m)^(?:ACCE|GYRO|MAGN|PRES|AHRS|GNSS|WIFI|BLE4|BLUE|POSI|LIGH);-?\d+(?:\.\d+)?;")
_AXES = ("", "app", "t", "x", "y", "z")
KINDS: dict[str, tuple[str, ...]] = {
    "ACCE": _AXES,
    "GYRO": _AXES,
    "MAGN": _AXES,
    "PRES": ("", "app", "t", "x"),
    "AHRS": ("", "app", "t", "", "", "", "x", "y", "z"),
    "GNSS": ("", "app", "t", "lat", "lon", "alt", "course", "accuracy", "speed"),
    "WIFI": ("", "app", "t", "", "mac", "rssi"),
    "BLE4": ("", "app", "", "mac", "rssi"),
    "BLUE": ("", "app", "", "mac", "rssi"),
    "POSI": ("", "app", "", "lat", "lon"),
}
_WIFI_NEW = ("", "app", "t", "", "mac", "frequency", "rssi")
_TOPICS = {
    "ACCE": "/phone/acc",
    "GYRO": "/phone/gyr",
    "MAGN": "/phone/mag",
    "PRES": "/phone/pressure",
    "AHRS": "/phone/orientation",
    "GNSS": "/phone/gnss",
    "WIFI": "/phone/radio",
    "BLE4": "/phone/radio",
    "BLUE": "/phone/radio",
    "POSI": "/reference/fix",
}
_DECLARED = re.compile(r"'([A-Z0-9]{4});([^'\r\n]*)'?")
_NAMES = (
    (r"(?:app)?timestamp", "app"),
    (r"sensortimestamp", "t"),
    (r"(?:acc|gyr|mag)_([xyz])", ""),
    (r"rotvec([xyz])", ""),
    (r"quat\(([234])\)", ""),
    (r"pres\(", "x"),
    (r"lat", "lat"),
    (r"lon", "lon"),
    (r"alt", "alt"),
    (r"accuracy\(m\)", "accuracy"),
    (r"bearing", "course"),
    (r"speed", "speed"),
    (r"mac", "mac"),
    (r"frequency", "frequency"),
    (r"rssi?(?:\(|$)", "rssi"),
)
"""How the head names the columns that are read; without a name of ours the group is the axis."""
_OPTIONAL = ("t", "alt", "accuracy", "course", "speed")
_SAME_CLOCK_S = 0.5
"""Two clocks run alike where their difference varies less in a block."""


class GetSensorDataOptions(CommonOptions, frozen=True, kw_only=True):
    """No options of its own; ``start`` gives the UTC time of the first row."""


class GetSensorData:
    """Importer ``getsensordata``: ``/phone/…``, ``/phone/radio``, ``/reference/fix``."""

    name: ClassVar[str] = "getsensordata"
    title: ClassVar[str] = "GetSensorData text (IPIN): ACCE;…, GYRO;…, WIFI;…, POSI;…"
    Options = GetSensorDataOptions

    def sniff(self, head: bytes, path: Path) -> float:
        """Rows of four capitals and a time."""
        return 0.95 if len(_ROW.findall(head)) >= 3 else 0.0

    def read(self, paths: Sequence[Path], options: GetSensorDataOptions) -> Import:
        """Read one file."""
        path = one_file(paths, self.name)
        report = ReportBuilder()
        stated = _declared(start_of(path, HEAD_BYTES))
        there: set[str] = set()
        for piece, _ in read_blocks(path):
            there |= {k for k in KINDS if piece.startswith(f"{k};".encode()) or f"\n{k};".encode() in piece}
        topics = dict.fromkeys(topic for kind, topic in _TOPICS.items() if kind in there)
        streams = {topic: _stream(topic, report) for topic in topics}
        return Import(
            channels=declared(streams.values()),
            blocks=_blocks(path, streams, stated, report),
            report=report,
            metadata={
                "device": {
                    "clock": "device",
                    "time": "sensor time moved to the app's clock (s since the start) by the median difference",
                    "name": "GetSensorData",
                    "frames": AXES,
                    "converted": "magnetic field from µT, pressure from hPa, AHRS rotation vector to a rotation",
                }
            },
        )


def _declared(head: bytes) -> dict[str, tuple[str, ...]]:
    """Return the columns of each kind as the comments declare them, up to the last that is read.

    A kind that is declared twice (beacons of two makes) has its first columns in common.
    """
    columns_of: dict[str, tuple[str, ...]] = {}
    comments = [c for c in head.decode("utf-8", "replace").splitlines() if c.startswith("%")]
    for kind, text in (m.groups() for c in comments if (m := _DECLARED.search(c))):
        if kind not in KINDS or kind in columns_of:
            continue
        # An empty name is a slip of the app: "Mag_X(uT);;Mag_Y(uT)" has no column there.
        columns = ["", *(_column(n) for n in text.split(";") if n.strip())]
        if kind not in ("WIFI", "BLE4", "BLUE", "GNSS") and "accuracy" in columns:
            columns[columns.index("accuracy")] = ""
        if all(n in columns for n in KINDS[kind] if n and n not in _OPTIONAL):
            last = max(i for i, n in enumerate(columns) if n)
            columns_of[kind] = tuple(columns[: last + 1])
    return columns_of


def _column(name: str) -> str:
    low = name.strip().lower()
    for pattern, column in _NAMES:
        if match := re.match(pattern, low):
            return column or {"2": "x", "3": "y", "4": "z"}.get(match[1], match[1])
    return ""


def _stream(topic: str, report: ReportBuilder) -> Stream:
    axes = ("x", "y", "z")
    if topic == "/phone/radio":
        return Stream([StreamChannel(topic, RADIO, radio_columns)], report, subject="signals", events=True)
    if topic == "/reference/fix":
        columns = {"lat_deg": SourceColumn("lat", 1.0), "lon_deg": SourceColumn("lon", 1.0)}
        part = StreamChannel(topic, FIX, columns, frame_id="wgs84", metadata={"source": "surveyed points"})
        return Stream([part], report, subject="surveyed points", events=True)
    parts = {
        "/phone/acc": imu_part(topic, xyz(ACC, axes), gravity="included"),
        "/phone/gyr": imu_part(topic, xyz(GYR, axes)),
        "/phone/mag": StreamChannel(topic, MAG, xyz(FIELD, axes, MICROTESLA)),
        "/phone/pressure": StreamChannel(topic, PRESSURE, {"pressure_pa": SourceColumn("x", HECTOPASCAL)}),
        "/phone/orientation": StreamChannel(
            topic, QUATERNION, _rotation, QUAT, metadata={"north": "magnetic"}
        ),
        "/phone/gnss": fix_part({k: k for k in ("lat", "lon", "alt", "accuracy", "speed", "course")}),
    }
    return Stream([parts[topic]], report, subject=topic, even=topic != "/phone/gnss")


def _rotation(frame: pl.DataFrame) -> dict[str, np.ndarray]:
    return rotation_vector(*(frame[a].to_numpy() for a in "xyz"))


def _blocks(
    path: Path, streams: dict[str, Stream], stated: dict[str, tuple[str, ...]], report: ReportBuilder
) -> Iterator[tuple[str, pl.DataFrame]]:
    offsets: dict[str, float | None] = {}

    def kinds(kind: str, width: int) -> Sequence[str] | None:
        columns = stated.get(kind, ())
        if columns and len(columns) <= width:
            return columns
        return _WIFI_NEW if kind == "WIFI" and width >= 7 else KINDS.get(kind)

    tables = typed_blocks(
        path,
        r"^([A-Z0-9]{4});",
        ";",
        kinds,
        report,
        required=lambda kind: "app",
        texts=("mac",),
        comment="%",
        ending="; \t",
    )
    for block in tables:
        for kind, frame in block.items():
            seconds = frame["app"]
            if "t" in frame.columns and kind not in ("WIFI", "BLE4", "BLUE"):
                if kind not in offsets:
                    gap = (frame["app"] - frame["t"]).to_numpy()
                    alike = np.isfinite(gap).all() and np.ptp(gap) < _SAME_CLOCK_S
                    offsets[kind] = float(np.median(gap)) if alike else None
                if (offset := offsets[kind]) is not None:
                    seconds = frame["t"].fill_nan(None).fill_null(frame["app"] - offset) + offset
            frame = frame.with_columns(t=whole_ns(seconds, 1e6)).drop("app")
            if _TOPICS[kind] == "/phone/radio":
                frame = radio_frame(frame, "wifi" if kind == "WIFI" else "ble", report)
            yield from streams[_TOPICS[kind]].push(frame)
    for stream in streams.values():
        yield from stream.finish()
    require_rows(path, list(streams.values()))
