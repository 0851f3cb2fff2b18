"""What the importers of legs share: names of segments, channels, rotations and markers in blocks."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
import polars as pl
from numpy.typing import NDArray

from ..recording.errors import MarchaError, UsageError
from ..recording.rotations import QUAT
from .contract import ReportBuilder

FloatArray = NDArray[np.float64]

IMU = "sensor_msgs/msg/Imu"
MAG = "sensor_msgs/msg/MagneticField"
ORIENTATION = "geometry_msgs/msg/QuaternionStamped"
JOINTS = "sensor_msgs/msg/JointState"
MARKERS = "marcha_msgs/msg/OpticalMarkers"

MARKERS_TOPIC = "/reference/markers"
JOINT_TOPIC = "/reference/joint"

Segments = Annotated[
    str | None,
    msgspec.Meta(
        description="names of the segments, in the order of the source (thigh,shank), or old:new pairs "
        "(seg2:thigh,seg3:shank)"
    ),
]
FieldStrength = Annotated[
    float,
    msgspec.Meta(
        gt=0,
        description="field (µT) that one arbitrary unit of the magnetometer stands for; its direction counts",
    ),
]


def renamed(own: Sequence[str], segments: str | None, path: Path) -> dict[str, str]:
    """Return the name of each of the source's own segments.

    Raises
    ------
    UsageError
        Another number of names than segments, an unknown segment, a name given twice.
    """
    names = {name: name for name in own}
    if segments is None:
        return names
    parts = [p.strip() for p in segments.split(",") if p.strip()]
    if any(":" in p for p in parts):
        for part in parts:
            old, _, new = part.partition(":")
            if old not in names or not new:
                raise UsageError(
                    f"option segments={segments!r}: {path.name} has {', '.join(own)}, not {old!r}"
                )
            names[old] = new
    elif len(parts) != len(own):
        raise UsageError(
            f"option segments={segments!r}: {len(parts)} names for {len(own)} segments of {path.name} "
            f"({', '.join(own)})"
        )
    else:
        names = dict(zip(own, parts, strict=True))
    for name in names.values():
        if not re.fullmatch(r"[A-Za-z][\w-]*", name):
            raise UsageError(f"option segments={segments!r}: {name!r} is no name of letters, digits, _ and -")
    if len(set(names.values())) < len(names):
        raise UsageError(f"option segments={segments!r}: a name stands twice")
    return names


def plain_name(text: str) -> str:
    """Return a device's or file's name as part of a topic."""
    name = re.sub(r"\W+", "_", text).strip("_").lower()
    return name if name[:1].isalpha() else f"imu_{name}"


def note_arbitrary(report: ReportBuilder, topics: Iterable[str], field_ut: float) -> None:
    """Say that a magnetometer in arbitrary units was scaled."""
    topics = list(topics)
    if topics:
        report.note(
            "assumed_unit",
            f"{', '.join(topics)}: arbitrary units; one is taken for {field_ut:g} µT (field_ut): directions are "
            "right, strengths are nominal",
            count=len(topics),
        )


def sign_free(table: pl.DataFrame, columns: Sequence[str] = QUAT) -> tuple[pl.DataFrame, NDArray[np.bool_]]:
    """Return a table whose quaternions are unit, and which of its rows hold none (norm 0 or a missing part)."""
    quat = table.select(columns).to_numpy()
    norm = np.linalg.norm(quat, axis=1)
    lost = ~np.isfinite(norm) | (norm < 0.5) | (norm > 2.0)
    unit = quat / np.where(lost, 1.0, norm)[:, None]
    return table.with_columns(pl.Series(c, unit[:, k]) for k, c in enumerate(columns)), lost


def rotations(
    blocks: Iterable[tuple[str, pl.DataFrame]], topics: Iterable[str], report: ReportBuilder
) -> Iterator[tuple[str, pl.DataFrame]]:
    """Yield the blocks; of ``topics`` only rows with a rotation, normalized (finding ``no_rotation``)."""
    wanted = set(topics)
    for topic, table in blocks:
        if topic in wanted:
            table, lost = sign_free(table)
            if lost.any():
                first = int(np.argmax(lost))
                report.note(
                    "no_rotation",
                    f"{topic}: no orientation here, from {table['t_ns'][first] * 1e-9:.3f} s on: no message",
                    count=int(lost.sum()),
                    subject=topic,
                )
                table = table.filter(pl.Series(~lost))
            if not table.height:
                continue
        yield topic, table


def unseen(
    blocks: Iterable[tuple[str, pl.DataFrame]], report: ReportBuilder, topic: str = MARKERS_TOPIC
) -> Iterator[tuple[str, pl.DataFrame]]:
    """Yield the blocks; a marker at exactly 0, 0, 0 was not seen: NaN (repair ``unseen_marker``)."""
    for name, table in blocks:
        if name != topic:
            yield name, table
            continue
        marks = marker_names(table.columns)
        pos = table.select(f"{m}.{a}" for m in marks for a in "xyz").to_numpy().reshape(table.height, -1, 3)
        zero = (pos == 0).all(axis=2)
        if zero.any():
            row, k = (int(i[0]) for i in np.nonzero(zero))
            report.repair(
                "unseen_marker",
                f"{topic} {marks[k]}: at exactly 0, 0, 0 at {table['t_ns'][row] * 1e-9:.3f} s: taken as not seen",
                count=int(zero.sum()),
                rows=int(zero.any(axis=1).sum()),
                subject=topic,
            )
            pos = np.where(zero[..., None], np.nan, pos)
            table = table.with_columns(
                pl.Series(f"{m}.{a}", np.ascontiguousarray(pos[:, i, j]))
                for i, m in enumerate(marks)
                for j, a in enumerate("xyz")
            )
        yield name, table


def marker_names(columns: Iterable[str]) -> list[str]:
    """Return the markers of a table's columns (``knee.x`` …)."""
    return [c.removesuffix(".x") for c in columns if c.endswith(".x")]


def unique_markers(names: Sequence[str], path: Path, line: int) -> list[str]:
    """Return the names of markers.

    Raises
    ------
    MarchaError
        One stands twice.
    """
    if len(set(names)) < len(names):
        twice = next(n for n in names if list(names).count(n) > 1)
        raise MarchaError(f"{path}, line {line}: marker {twice!r} stands twice; rename one of them")
    return list(names)
