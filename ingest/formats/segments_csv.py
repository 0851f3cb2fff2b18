"""CSV of segments at a stated rate: ``# sampling frequency: 40``, then ``<segment>_<quantity>_<axis>`` columns.

Inertial sensors (``seg1_acc_x``, ``seg1_gyr_x``, ``seg1_mag_x``) and, in a file of its own rate and clock, optical
markers and orientations (``seg1_marker1_x``, ``seg1_quat_w``), as the recordings of hinged chains beside the
RING publication have them.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

from ...recording.errors import MarchaError
from ..columns import Header, find_header
from ..contract import HEAD_BYTES, Import, ReportBuilder
from ..leg import (
    IMU,
    MAG,
    MARKERS,
    MARKERS_TOPIC,
    ORIENTATION,
    FieldStrength,
    Segments,
    note_arbitrary,
    renamed,
    rotations,
    unseen,
)
from ..mapping import CellSource, Mapping, TextLayout, Time, Topic
from ..orientations import OrientationOptions, with_angles
from ..text import start_of
from ..timestamps import possible_rate
from .table import open_table

_RATE = re.compile(rb"^#\s*sampling frequency:\s*(\d{1,9}(?:\.\d*)?)(?![\d.])", re.MULTILINE)
_UNITS = re.compile(rb"^#\s*units are\s*([^\r\n]+)", re.MULTILINE)
_COLUMN = re.compile(
    r"(?P<segment>.+?)_(?:(?P<kind>acc|gyr|mag|quat)|(?P<marker>marker\w*))_(?P<axis>[wxyz])"
)


class SegmentsOptions(OrientationOptions, frozen=True, kw_only=True):
    """Names of the segments.

    Attributes
    ----------
    segments : str or None
        New names.
    field_ut : float
        Field that one arbitrary unit of the magnetometer stands for (µT).
    """

    segments: Segments = None
    field_ut: FieldStrength = 50.0


def _accept(cells: Sequence[str]) -> bool:
    columns = [m for c in cells if (m := _COLUMN.fullmatch(c))]
    return len(columns) >= 3 and len(columns) == len([c for c in cells if c])


class SegmentsCsv:
    """Importer ``segments-csv``: ``/leg/<segment>/…`` or ``/reference/…``, by the columns."""

    name: ClassVar[str] = "segments-csv"
    title: ClassVar[str] = (
        "CSV of segments at a stated rate: inertial sensors, or optical markers and orientations"
    )
    Options = SegmentsOptions
    beside: ClassVar[bool] = True

    def sniff(self, head: bytes, path: Path) -> float:
        """A stated rate, and columns that name segment, quantity and axis."""
        return 0.95 if _RATE.search(head[:4096]) and find_header(head, _accept) else 0.0

    def read(self, paths: Sequence[Path], options: SegmentsOptions) -> Import:
        """Read one file."""
        path = paths[0]
        head = start_of(path, HEAD_BYTES)
        rate, header = _RATE.search(head[:4096]), find_header(head, _accept)
        if rate is None or header is None:
            raise MarchaError(
                f"{path}: needs a line '# sampling frequency: N' and a header of columns like thigh_acc_x"
            )
        units = _UNITS.search(head[:4096])
        if units is not None and not units[1].startswith(b"seconds/meters/radians"):
            unit = units[1].decode("utf-8", "replace")
            raise MarchaError(f"{path}: units are {unit!r}, not seconds/meters/radians; import it with --map")
        report = ReportBuilder()
        topics = _topics(header, options, path)
        note_arbitrary(report, [t.name for t in topics if t.schema == MAG], options.field_ut)
        layout = TextLayout(separator=header.separator, skip_rows=header.line - 1)
        mapping = Mapping(
            topic=topics,
            time=Time(
                rate_hz=possible_rate(float(rate[1]), path, "correct its line of the sampling frequency")
            ),
            layout=layout,
        )
        channels, blocks = open_table(path, mapping, path, report)
        turning = [t.name for t in topics if t.schema == ORIENTATION]
        channels, blocks = with_angles(
            channels, [unseen(rotations(blocks, turning, report), report)], options, report
        )
        return Import(
            channels=channels,
            blocks=blocks,
            report=report,
            metadata={
                "device": {
                    "clock": "device",
                    "time": f"rows at {rate[1].decode()} Hz, from 0 at the first",
                    "frames": "sensors: their own axes; reference: the optical system's",
                }
            },
        )


def _topics(header: Header, options: SegmentsOptions, path: Path) -> list[Topic]:
    parts = [(c, m) for c in header.names if (m := _COLUMN.fullmatch(c))]
    own = list(dict.fromkeys(m["segment"] for _, m in parts))
    names = renamed(own, options.segments, path)
    groups: dict[tuple[str, str], dict[str, CellSource | str | int]] = {}
    for column, m in parts:
        segment = names[m["segment"]]
        if m["marker"]:
            key, target = (MARKERS_TOPIC, MARKERS), f"{segment}_{m['marker']}.{m['axis']}"
        elif m["kind"] == "quat":
            key, target = (f"/reference/{segment}/orientation", ORIENTATION), f"quat_{m['axis']}"
        elif m["kind"] == "mag":
            key, target = (f"/leg/{segment}/mag", MAG), f"mag_{m['axis']}"
        else:
            key, target = (f"/leg/{segment}/imu", IMU), f"{m['kind']}_{m['axis']}"
        scaled = m["kind"] == "mag"
        groups.setdefault(key, {})[target] = CellSource(
            column=column, scale=options.field_ut * 1e-6 if scaled else 1.0
        )
    return [
        Topic(
            name=topic,
            schema=schema,
            columns=columns,
            frame="optical" if topic.startswith("/reference") else f"{topic.split('/')[2]}_imu",
        )
        for (topic, schema), columns in groups.items()
    ]
