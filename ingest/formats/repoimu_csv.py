"""RepoIMU's pendulum and body recordings: one CSV a segment, an IMU beside its Vicon orientation, two header rows."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

from ...recording.errors import MarchaError
from ..contract import HEAD_BYTES, ChannelSpec, Import, ReportBuilder
from ..leg import (
    IMU,
    MAG,
    ORIENTATION,
    FieldStrength,
    Segments,
    note_arbitrary,
    plain_name,
    renamed,
    rotations,
)
from ..mapping import CellSource, Mapping, TextLayout, Time, Topic
from ..orientations import OrientationOptions, with_angles
from ..text import read_blocks
from .table import open_table

FIRST = "Time;Vicon Orientation;;;;IMU Acceleration;;;IMU Gyroscope;;;IMU Magnetometer;;"
SECOND = "s;W;X;Y;Z;X;Y;Z;X;Y;Z;X;Y;Z"


class RepoImuOptions(OrientationOptions, frozen=True, kw_only=True):
    """Names of the segments, one a file.

    Attributes
    ----------
    segments : str or None
        New names.
    field_ut : float
        Field that one arbitrary unit of the magnetometer stands for (µT).
    """

    segments: Segments = None
    field_ut: FieldStrength = 50.0


class RepoImuCsv:
    """Importer ``repoimu-csv``: ``/leg/<segment>/imu``, ``…/mag`` and ``/reference/<segment>/orientation``."""

    name: ClassVar[str] = "repoimu-csv"
    title: ClassVar[str] = "RepoIMU CSV: an IMU beside its Vicon orientation, one file a segment"
    Options = RepoImuOptions
    joins: ClassVar[bool] = True

    def sniff(self, head: bytes, path: Path) -> float:
        """The two header rows."""
        return 1.0 if _is_header(head) else 0.0

    def read(self, paths: Sequence[Path], options: RepoImuOptions) -> Import:
        """Read the files of one trial; they share its clock."""
        own = _names(paths)
        names = renamed(own, options.segments, paths[0])
        report = ReportBuilder()
        channels: list[ChannelSpec] = []
        streams = []
        for path, key in zip(paths, own, strict=True):
            head = next(read_blocks(path), (b"", True))[0][:HEAD_BYTES]
            if not _is_header(head):
                raise MarchaError(f"{path}, line 1: not the header rows of RepoIMU ({FIRST[:40]}…)")
            mapping = _mapping(names[key], options.field_ut * 1e-6)
            specs, blocks = open_table(path, mapping, path, report, beside=len(paths))
            channels += specs
            streams.append(rotations(blocks, [f"/reference/{names[key]}/orientation"], report))
        note_arbitrary(report, [f"/leg/{n}/mag" for n in names.values()], options.field_ut)
        channels, blocks = with_angles(channels, streams, options, report)
        return Import(
            channels=channels,
            blocks=blocks,
            report=report,
            metadata={
                "device": {
                    "clock": "device",
                    "time": "column Time (s), of the IMUs and of Vicon, which are synchronized",
                    "frames": "sensors: their own axes; reference: the sensor's axes at the first sample",
                }
            },
        )


def _is_header(head: bytes) -> bool:
    lines = [x.strip().replace("\ufeff", "") for x in head[:4096].decode("utf-8", "replace").splitlines()[:2]]
    return lines == [FIRST, SECOND]


def _names(paths: Sequence[Path]) -> list[str]:
    """Return ``segment1`` … of the files' names, or the names themselves."""
    matches = [re.search(r"segment[ _-]?(\d+)$", p.stem, re.IGNORECASE) for p in paths]
    names = [f"segment{m[1]}" if m else plain_name(p.stem) for m, p in zip(matches, paths, strict=True)]
    if len(set(names)) < len(names):
        raise MarchaError(f"{paths[0]}: two of the files speak of the same segment ({', '.join(names)})")
    return names


def _mapping(segment: str, tesla: float) -> Mapping:
    def cells(first: int, names: Sequence[str], scale: float = 1.0) -> dict[str, CellSource | str | int]:
        return {n: CellSource(column=first + k, scale=scale) for k, n in enumerate(names)}

    inertial = [f"{kind}_{a}" for kind in ("acc", "gyr") for a in "xyz"]
    frame = f"{segment}_imu"
    topics = [
        Topic(name=f"/leg/{segment}/imu", schema=IMU, columns=cells(6, inertial), frame=frame),
        Topic(
            name=f"/leg/{segment}/mag",
            schema=MAG,
            columns=cells(12, [f"mag_{a}" for a in "xyz"], tesla),
            frame=frame,
        ),
        Topic(
            name=f"/reference/{segment}/orientation",
            schema=ORIENTATION,
            columns=cells(2, [f"quat_{a}" for a in "wxyz"]),
            frame="vicon",
        ),
    ]
    layout = TextLayout(separator=";", header=False, skip_rows=2)
    return Mapping(topic=topics, time=Time(column=1, unit="s"), layout=layout)
