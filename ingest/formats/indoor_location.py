"""Logs of the indoor-location apps: ``ms⇥TYPE_…`` rows of sensors, Wi-Fi, Bluetooth, surveyed waypoints.

Times are milliseconds since 1970; axes are Android's. Waypoints are where the person stood, surveyed on the
floor's plan (m from its lower left corner, x to the right, y up).
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np
import polars as pl

from ...recording.errors import MarchaError
from ..contract import CommonOptions, Import, ReportBuilder
from ..inertial import one_file
from ..phonelog import (
    ACC,
    AXES,
    FIELD,
    GYR,
    HECTOPASCAL,
    MAG,
    MICROTESLA,
    POINT,
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
from ..text import read_blocks
from ..typedrows import typed_blocks

_ROW = re.compile(rb"(?m)^\d{12,14}\tTYPE_[A-Z0-9_]+\t")
_HEAD = re.compile(r"(\w+):([^\t]*)")
_AXES = ("t", "", "x", "y", "z")
KINDS: dict[str, tuple[str, ...]] = {
    "ACCELEROMETER": _AXES,
    "GYROSCOPE": _AXES,
    "MAGNETIC_FIELD": _AXES,
    "ROTATION_VECTOR": _AXES,
    "PRESSURE": ("t", "", "x"),
    "GPS": ("t", "", "lat", "lon", "alt"),
    "WIFI": ("t", "", "", "mac", "rssi", "frequency", "seen"),
    "BEACON": ("t", "", "", "", "", "power", "rssi", "", "mac"),
    "WAYPOINT": ("t", "", "x", "y"),
}
"""Kinds of rows that are read, and their cells."""
_NAMES = {
    "ACCELEROMETER": "/phone/acc",
    "GYROSCOPE": "/phone/gyr",
    "MAGNETIC_FIELD": "/phone/mag",
    "ROTATION_VECTOR": "/phone/orientation",
    "PRESSURE": "/phone/pressure",
    "GPS": "/phone/gnss",
    "WIFI": "/phone/radio",
    "BEACON": "/phone/radio",
    "WAYPOINT": "/reference/position",
}


class IndoorLocationOptions(CommonOptions, frozen=True, kw_only=True):
    """No options of its own."""


class IndoorLocation:
    """Importer ``indoor-location``: ``/phone/…``, ``/phone/radio``, ``/reference/position``."""

    name: ClassVar[str] = "indoor-location"
    title: ClassVar[str] = "indoor-location text: ms, TYPE_…, values; waypoints on the floor plan"
    Options = IndoorLocationOptions

    def sniff(self, head: bytes, path: Path) -> float:
        """Rows of milliseconds and TYPE_ words."""
        return 0.95 if len(_ROW.findall(head)) >= 3 else 0.0

    def read(self, paths: Sequence[Path], options: IndoorLocationOptions) -> Import:
        """Read one file."""
        path = one_file(paths, self.name)
        report = ReportBuilder()
        there = _kinds(path)
        topics = dict.fromkeys(topic for kind, topic in _NAMES.items() if kind in there)
        streams = {topic: _stream(topic, report) for topic in topics}
        return Import(
            channels=declared(streams.values()),
            blocks=_blocks(path, streams, report),
            report=report,
            metadata={
                "device": {
                    "clock": "utc",
                    "time": "milliseconds since 1970",
                    "frames": AXES,
                    "converted": "magnetic field from µT, rotation vector (east, magnetic north, up) to a rotation",
                    "reference_frame": "plan: x to the right, y up, metres from the plan's lower left corner",
                    "name": "indoor-location",
                    **_about(path),
                }
            },
        )


def _about(path: Path) -> dict[str, str]:
    """Return what the first lines say about site and phone."""
    words = {
        "SiteName": "site",
        "FloorName": "floor",
        "Brand": "brand",
        "Model": "phone",
        "AndroidName": "os_release",
    }
    facts: dict[str, str] = {}
    try:
        with path.open(encoding="utf-8", errors="replace") as f:
            for _, line in zip(range(40), f, strict=False):
                if line.startswith("#"):
                    facts |= {words[k]: v.strip() for k, v in _HEAD.findall(line) if k in words and v.strip()}
    except OSError as error:
        raise MarchaError(f"{path}: cannot be read: {error.strerror or error}") from error
    return facts


def _kinds(path: Path) -> set[str]:
    """Return the kinds of rows that the file has and that are read."""
    there: set[str] = set()
    for piece, _ in read_blocks(path):
        there |= {kind for kind in KINDS if kind not in there and f"\tTYPE_{kind}\t".encode() in piece}
    return there


def _stream(topic: str, report: ReportBuilder) -> Stream:
    axes = ("x", "y", "z")
    if topic == "/phone/acc":
        part = imu_part(topic, xyz(ACC, axes), gravity="included")
    elif topic == "/phone/gyr":
        part = imu_part(topic, xyz(GYR, axes))
    elif topic == "/phone/mag":
        part = StreamChannel(topic, MAG, xyz(FIELD, axes, MICROTESLA))
    elif topic == "/phone/orientation":
        part = StreamChannel(
            topic, QUATERNION, _rotation, QUAT, metadata={"north": "magnetic", "source": "rotation vector"}
        )
    elif topic == "/phone/pressure":
        part = StreamChannel(topic, PRESSURE, {"pressure_pa": SourceColumn("x", HECTOPASCAL)})
    elif topic == "/phone/gnss":
        part = fix_part({"lat": "lat", "lon": "lon", "alt": "alt"})
    elif topic == "/phone/radio":
        return Stream([StreamChannel(topic, RADIO, radio_columns)], report, subject="signals", events=True)
    else:
        part = StreamChannel(topic, POINT, _point, ("pos_x", "pos_y", "pos_z"), frame_id="plan")
        return Stream([part], report, subject="waypoints", events=True)
    return Stream([part], report, subject=topic, even=topic != "/phone/gnss")


def _rotation(frame: pl.DataFrame) -> dict[str, np.ndarray]:
    return rotation_vector(*(frame[a].to_numpy() for a in "xyz"))


def _point(frame: pl.DataFrame) -> dict[str, np.ndarray]:
    return {"pos_x": frame["x"].to_numpy(), "pos_y": frame["y"].to_numpy(), "pos_z": np.zeros(frame.height)}


def radio_columns(frame: pl.DataFrame) -> dict[str, pl.Series]:
    """Return signals in the columns of RadioSignal from ``mac, rssi, technology, power, frequency, seen``."""
    return {
        "mac": frame["mac"].str.to_lowercase(),
        "rssi_dbm": frame["rssi"],
        "technology": frame["technology"],
        "tx_power_dbm": frame["power"],
        "frequency_hz": frame["frequency"],
        "last_seen_ns": frame["seen"],
    }


def radio_frame(frame: pl.DataFrame, technology: str, report: ReportBuilder) -> pl.DataFrame:
    """Return rows of one technology in the cells that :func:`radio_columns` takes; without an address: dropped.

    Parameters
    ----------
    frame : polars.DataFrame
        ``t, line, mac, rssi`` and where known ``power`` (dBm), ``frequency`` (MHz), ``seen`` (ns).
    technology : str
        ``wifi`` or ``ble``.
    report : ReportBuilder
        Takes rows without an address.
    """
    good = frame["mac"].str.contains(r"^(?i)[0-9a-f]{2}(:[0-9a-f]{2}){5}$").fill_null(False)
    if not good.all():
        first = int((~good).arg_true()[0])
        report.drop(
            "bad_row",
            f"{technology} signal of {frame['mac'][first]!r}: no hardware address; row dropped",
            count=int((~good).sum()),
            line=frame["line"][first],
            subject=f"{technology} address",
        )
        frame = frame.filter(good)
    nothing = pl.lit(None, dtype=pl.Float64).fill_null(np.nan)
    return frame.select(
        "t",
        "line",
        "mac",
        "rssi",
        technology=pl.lit(technology),
        power=pl.col("power") if "power" in frame.columns else nothing,
        frequency=pl.col("frequency") * 1e6 if "frequency" in frame.columns else nothing,
        seen=pl.col("seen") if "seen" in frame.columns else pl.lit(0, dtype=pl.Int64),
    )


def _blocks(
    path: Path, streams: dict[str, Stream], report: ReportBuilder
) -> Iterator[tuple[str, pl.DataFrame]]:
    unread: dict[str, None] = {}

    def kinds(kind: str, width: int) -> Sequence[str] | None:
        if kind not in KINDS:
            unread[kind] = None
        return KINDS.get(kind)

    tables = typed_blocks(
        path,
        r"^\d+\tTYPE_([A-Z0-9_]+)",
        "\t",
        kinds,
        report,
        required=lambda kind: "t",
        texts=("mac",),
    )
    for block in tables:
        for kind, frame in block.items():
            frame = frame.with_columns(t=whole_ns(frame["t"], 1e3))
            if kind in ("WIFI", "BEACON"):
                if "seen" in frame.columns:  # access points without a time hold NaN
                    frame = frame.with_columns(seen=whole_ns(frame["seen"].fill_nan(0), 1e3))
                frame = radio_frame(frame, "wifi" if kind == "WIFI" else "ble", report)
            yield from streams[_NAMES[kind]].push(frame)
    for stream in streams.values():
        yield from stream.finish()
    if unread:
        report.note("unused_row", f"rows of kind {', '.join(unread)}: not imported", count=len(unread))
    require_rows(path, list(streams.values()))
