"""Text exports of Xsens/Movella MT Manager: one file a sensor, joined on the packet counter.

Comment lines (``// Update Rate: 100.0Hz``), then a header (``PacketCounter``, ``Acc_X`` …) and rows between tabs,
commas, semicolons or spaces. Orientation as matrix (``Mat[1][1]``), quaternion (``Quat_q0``) or Euler angles.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, ClassVar, NamedTuple

import msgspec
import numpy as np
import polars as pl

from ...recording.errors import MarchaError
from ..contract import HEAD_BYTES, ChannelSpec, Import, ReportBuilder
from ..leg import (
    IMU,
    MAG,
    ORIENTATION,
    QUAT,
    FieldStrength,
    Segments,
    note_arbitrary,
    plain_name,
    renamed,
    rotations,
)
from ..mapping import CellSource, Mapping, TextLayout, Time, Topic
from ..orientations import DEVICE_TOPIC, OrientationOptions, with_angles
from ..text import start_of
from ..timestamps import Rate, possible_rate
from .table import open_table

COUNTERS = ("PacketCounter", "Counter")
COUNTER_PERIOD = 65536
"""The packet counter has 16 bits."""
MATRIX = tuple(f"Mat[{i}][{j}]" for i in (1, 2, 3) for j in (1, 2, 3))
QUATERNIONS = (
    ("Quat_q0", "Quat_q1", "Quat_q2", "Quat_q3"),
    ("Quat_w", "Quat_x", "Quat_y", "Quat_z"),
    ("Quat_W", "Quat_X", "Quat_Y", "Quat_Z"),
    ("q0", "q1", "q2", "q3"),
)
EULER = ("Roll", "Pitch", "Yaw")
_RATE = re.compile(r"^//\s*(?:Update Rate|Sample rate)\s*:\s*(\d{1,9}(?:\.\d*)?)\s*Hz", re.IGNORECASE)


class XsensOptions(OrientationOptions, frozen=True, kw_only=True):
    """Names of the segments, one a file.

    Attributes
    ----------
    segments : str or None
        New names.
    rate_hz : float or None
        Packets per second, where the file does not say.
    field_ut : float
        Field that one arbitrary unit of the magnetometer stands for (µT).
    """

    segments: Segments = None
    rate_hz: Annotated[
        Rate | None,
        msgspec.Meta(description="packets per second, where the file's comments do not say"),
    ] = None
    field_ut: FieldStrength = 50.0


class _Header(NamedTuple):
    line: int
    names: list[str]
    separator: str
    rate_hz: float | None


class XsensText:
    """Importer ``xsens-text``: ``/leg/<segment>/imu``, ``…/mag`` and ``…/orientation`` (the device's own)."""

    name: ClassVar[str] = "xsens-text"
    title: ClassVar[str] = "Xsens/Movella MT text, one file a sensor, joined on the packet counter"
    Options = XsensOptions
    joins: ClassVar[bool] = True

    def sniff(self, head: bytes, path: Path) -> float:
        """The header with a packet counter and Acc_X, or a quaternion."""
        header = _header(head)
        if header is None:
            return 0.0
        return 0.95 if header.rate_hz is not None else 0.8

    def read(self, paths: Sequence[Path], options: XsensOptions) -> Import:
        """Read the sensors of one session: their packet counters are one clock."""
        own = [_device(p) for p in paths]
        if len(set(own)) < len(own):
            own = [plain_name(p.stem) for p in paths]
        names = renamed(own, options.segments, paths[0])
        report = ReportBuilder()
        channels: list[ChannelSpec] = []
        streams = []
        magnetic = []
        rates = set()
        for path, key in zip(paths, own, strict=True):
            head = start_of(path, HEAD_BYTES)
            header = _header(head)
            if header is None:
                raise MarchaError(
                    f"{path}: no header with PacketCounter and Acc_X or a quaternion; see docs/formats.md"
                )
            rate = options.rate_hz or header.rate_hz
            if rate is None:
                raise MarchaError(f"{path}: no '// Update Rate: …' line; say it with --set rate_hz=100")
            rates.add(possible_rate(rate, path, "say it with --set rate_hz=100"))
            topics = _topics(names[key], header, path, options.field_ut * 1e-6)
            magnetic += [t.name for t in topics if t.schema == MAG]
            layout = TextLayout(separator=header.separator, skip_rows=header.line - 1, comment="//")
            counter = next(c for c in COUNTERS if c in header.names)
            time = Time(column=counter, rate_hz=rate, rollover=COUNTER_PERIOD)
            specs, blocks = open_table(
                path, Mapping(topic=topics, time=time, layout=layout), path, report, beside=len(paths)
            )
            channels += [_final(s) for s in specs]
            final = f"/leg/{names[key]}/orientation"
            streams.append(rotations(_quaternions(blocks), [final], report))
        if len(rates) > 1:
            raise MarchaError(
                f"{paths[0]}: the files have different rates ({', '.join(f'{r:g}' for r in sorted(rates))} Hz): "
                "they are not of one session"
            )
        note_arbitrary(report, magnetic, options.field_ut)
        channels, blocks = with_angles(channels, streams, options, report, DEVICE_TOPIC)
        return Import(
            channels=channels,
            blocks=blocks,
            report=report,
            metadata={
                "device": {
                    "clock": "device",
                    "time": f"packet counter at {rates.pop():g} Hz, from its zero",
                    "name": "Xsens/Movella MT, text export",
                    "frames": "sensors: their own axes; orientation: rot_nb, n local, z up, as the device says",
                }
            },
        )


def _header(head: bytes) -> _Header | None:
    rate = None
    text = head.decode("utf-8-sig", "replace")
    for number, line in enumerate(re.split(r"\r\n|\n|\r", text)[:60], 1):
        if line.startswith("//"):
            match = _RATE.match(line)
            rate = float(match[1]) if match else rate
            continue
        for separator, mark in (("\t", "\t"), (";", ";"), (",", ","), (None, "blanks")):
            cells = [c.strip() for c in line.split(separator)]
            counted = any(c in cells for c in COUNTERS)
            oriented = any(set(q) <= set(cells) for q in (*QUATERNIONS, MATRIX))
            if counted and ({"Acc_X", "Acc_Y", "Acc_Z"} <= set(cells) or oriented):
                return _Header(number, [c for c in cells if c], mark, rate)
        if line.strip():
            return None
    return None


def _device(path: Path) -> str:
    """Return the device's id where the file's name ends in it, else the name."""
    match = re.search(r"[_-]([0-9A-Fa-f]{8})$", path.stem)
    return plain_name(f"imu_{match[1]}" if match else path.stem)


def _topics(segment: str, header: _Header, path: Path, tesla: float) -> list[Topic]:
    have = set(header.names)
    frame = f"{segment}_imu"

    def axes(kind: str, word: str, scale: float = 1.0) -> dict[str, CellSource | str | int]:
        names = [f"{word}_{a}" for a in "XYZ"]
        if not set(names) <= have:
            return {}
        return {f"{kind}_{a.lower()}": CellSource(column=f"{word}_{a}", scale=scale) for a in "XYZ"}

    topics = []
    inertial = axes("acc", "Acc") | axes("gyr", "Gyr")
    if inertial:
        topics.append(Topic(name=f"/leg/{segment}/imu", schema=IMU, columns=inertial, frame=frame))
    if field := axes("mag", "Mag", tesla):
        topics.append(Topic(name=f"/leg/{segment}/mag", schema=MAG, columns=field, frame=frame))
    columns: dict[str, CellSource | str | int] = {}
    if quat := next((q for q in QUATERNIONS if set(q) <= have), None):
        columns = {f"quat{k}": c for k, c in enumerate(quat)}
    elif set(MATRIX) <= have:
        columns = {f"matrix{k}": c for k, c in enumerate(MATRIX)}
    elif set(EULER) <= have:
        columns = {f"euler{k}": c for k, c in enumerate(EULER)}
    if columns:  # becomes quaternions below
        name = f"/leg/{segment}/orientation"
        topics.append(Topic(name=name, schema="marcha_msgs/msg/NamedValues", columns=columns, frame=frame))
    if not topics:
        raise MarchaError(
            f"{path}, line {header.line}: neither Acc_X, Acc_Y, Acc_Z nor an orientation in the header"
        )
    return topics


def _final(spec: ChannelSpec) -> ChannelSpec:
    if not spec.topic.endswith("/orientation"):
        return spec
    source = re.sub(r"\d", "", spec.columns[0])
    metadata = {"source": f"the device's own, from its {source}"}
    return ChannelSpec(spec.topic, ORIENTATION, spec.frame_id, QUAT, metadata)


def _quaternions(blocks: Iterator[tuple[str, pl.DataFrame]]) -> Iterator[tuple[str, pl.DataFrame]]:
    from scipy.spatial.transform import Rotation

    for topic, table in blocks:
        if not topic.endswith("/orientation"):
            yield topic, table
            continue
        values = table.drop("t_ns").to_numpy()
        kind = table.columns[1][:4]
        out = np.full((len(values), 4), np.nan)
        good = np.asarray(np.isfinite(values).all(axis=1))
        if kind == "quat":
            out = values
        elif kind == "matr":
            matrix = values.reshape(-1, 3, 3)
            good[good] = np.abs(np.linalg.det(matrix[good]) - 1) < 0.1
            out[good] = Rotation.from_matrix(matrix[good]).as_quat(canonical=True, scalar_first=True)
        else:
            turned = Rotation.from_euler("ZYX", values[good][:, ::-1], degrees=True)
            out[good] = turned.as_quat(canonical=True, scalar_first=True)
        yield topic, pl.DataFrame([table["t_ns"], *(pl.Series(n, out[:, k]) for k, n in enumerate(QUAT))])
