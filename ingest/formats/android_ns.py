"""Tables of Android sensor events without a header: ``ns,accuracy,x,y,z``, nanoseconds since boot.

A folder holds one file a sensor (``accelerometer.csv``, ``gyroscope.csv`` …) and may hold ``stepcounter.csv``, the
log of a step counter worn on the feet: ``ns,left,right``, 1 while that foot is on the ground. A step is where one
of them becomes 1.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import msgspec
import numpy as np
import polars as pl

from ...recording.errors import MarchaError
from ..columns import Header, float_blocks
from ..contract import CommonOptions, Import, ReportBuilder
from ..phonelog import (
    ACC,
    AXES,
    FIELD,
    GYR,
    MAG,
    MICROTESLA,
    STEP,
    Stream,
    StreamChannel,
    declared,
    imu_part,
    require_rows,
    xyz,
)
from ..text import start_of

_EVENT = re.compile(rb"\d{10,19},[0-3],(?:[-+0-9.eE]+,){2}[-+0-9.eE]+\r?")
_CONTACT = re.compile(rb"\d{10,19},[01],[01]\r?")
_SENSORS = {"acc": "acc", "gyr": "gyr", "mag": "mag"}
EVENT, CONTACT = ("t", "accuracy", "x", "y", "z"), ("t", "left", "right")


class AndroidNsOptions(CommonOptions, frozen=True, kw_only=True):
    """What a file holds that does not say it.

    Attributes
    ----------
    sensor : str or None
        ``acc``, ``gyr`` or ``mag``; without it the file's name says it.
    """

    sensor: Annotated[
        Literal["acc", "gyr", "mag"] | None,
        msgspec.Meta(description="sensor of a file whose name does not say it"),
    ] = None


class AndroidNs:
    """Importer ``android-ns``: ``/phone/acc``, ``/phone/gyr``, ``/phone/mag``, ``/reference/steps``."""

    name: ClassVar[str] = "android-ns"
    title: ClassVar[str] = (
        "headerless Android events: ns since boot, accuracy, x, y, z; foot contacts as truth"
    )
    Options = AndroidNsOptions

    def sniff(self, head: bytes, path: Path) -> float:
        """Rows of the one or the other form; of a folder: in one of its files."""
        if path.is_dir():
            return 0.85 if any(_kind(start_of(p)) == "event" for p in path.glob("*.csv")) else 0.0
        return {"event": 0.85, "contact": 0.8}.get(_kind(head), 0.0)

    def read(self, paths: Sequence[Path], options: AndroidNsOptions) -> Import:
        """Read a file, or the files of a folder."""
        path = paths[0]
        files = sorted(path.glob("*.csv")) if path.is_dir() else list(paths)
        report = ReportBuilder()
        streams: list[tuple[Path, tuple[str, ...], Stream]] = []
        for file in files:
            kind = _kind(start_of(file))
            if kind == "contact":
                part = StreamChannel(
                    "/reference/steps", STEP, _step, frame_id="feet", metadata={"source": "foot contacts"}
                )
                streams.append((file, CONTACT, Stream([part], report, subject=file.name, events=True)))
            elif kind == "event":
                part = _part(file, options.sensor)
                streams.append((file, EVENT, Stream([part], report, subject=file.name)))
            elif not path.is_dir():
                raise MarchaError(f"{file}: no rows like ns,accuracy,x,y,z or ns,left,right")
        topics = [p.topic for *_, s in streams for p in s.parts]
        twice = next((t for t in topics if topics.count(t) > 1), None)
        if twice or not streams:
            why = f"{twice} is in two of its files" if twice else "no file of events in it"
            raise MarchaError(f"{path}: {why}; convert the files one by one")
        return Import(
            channels=declared(s for *_, s in streams),
            blocks=_blocks(path, streams, report),
            report=report,
            metadata={
                "device": {
                    "clock": "device",
                    "time": "nanoseconds since boot",
                    "name": "Android sensor events",
                    "frames": AXES,
                    **_about(path),
                }
            },
        )


def _kind(head: bytes) -> str:
    """Return ``event`` or ``contact`` where all of the first rows are such; nothing otherwise."""
    rows = [r for r in head.split(b"\n")[:20] if r.strip()]
    rows = rows[:-1] if len(rows) > 3 and not head.endswith(b"\n") else rows  # the last one may be cut
    if len(rows) < 2:
        return ""
    if all(_EVENT.fullmatch(r) for r in rows):
        return "event"
    return "contact" if all(_CONTACT.fullmatch(r) for r in rows) else ""


def _part(file: Path, sensor: str | None) -> StreamChannel:
    kind = sensor or next((s for key, s in _SENSORS.items() if file.stem.lower().startswith(key)), None)
    if kind is None:
        raise MarchaError(
            f"{file}: neither name nor content says which sensor this is; give --set sensor=acc, gyr or mag"
        )
    if kind == "mag":
        return StreamChannel("/phone/mag", MAG, xyz(FIELD, "xyz", MICROTESLA))
    return imu_part(f"/phone/{kind}", xyz(ACC if kind == "acc" else GYR, "xyz"))


def _about(path: Path) -> dict[str, str]:
    file = (path if path.is_dir() else path.parent) / "metadata.txt"
    if not file.is_file():
        return {}
    pairs = (line.partition(":") for line in file.read_text(encoding="utf-8", errors="replace").splitlines())
    return {k.strip(): v.strip() for k, _, v in pairs if v.strip()}


def _step(frame: pl.DataFrame) -> dict[str, np.ndarray]:
    nothing = np.full(frame.height, np.nan)
    t = frame["t_ns"].to_numpy()
    index = np.arange(frame.height, dtype=np.uint32)
    return {
        "start_ns": t, "end_ns": t, "index": index,
        "length_m": nothing, "height_m": nothing, "heading_rad": nothing,
    }  # fmt: skip


def _blocks(
    path: Path, streams: list[tuple[Path, tuple[str, ...], Stream]], report: ReportBuilder
) -> Iterator[tuple[str, pl.DataFrame]]:
    for file, names, stream in streams:
        frames = float_blocks(file, Header(0, names, ","), "t", report, integers=("t",))
        if names == CONTACT:
            frames = _contacts(frames, report)
        yield from stream.pull(frames)
    require_rows(path, [s for *_, s in streams])


def _contacts(frames: Iterator[pl.DataFrame], report: ReportBuilder) -> Iterator[pl.DataFrame]:
    """Yield the rows in which a foot comes to the ground, one a foot; the others say nothing new."""
    rows = pl.concat([*frames])
    feet = rows.select("left", "right").to_numpy()
    down = np.zeros_like(feet, dtype=bool)
    down[1:] = (feet[1:] == 1) & (feet[:-1] == 0)
    rows_down, _ = np.nonzero(down)
    report.note(
        "contacts",
        f"{down[:, 0].sum()} contacts of the one foot and {down[:, 1].sum()} of the other in {rows.height} rows",
        count=int(down.sum()),
    )
    report.keep(rows.height - len(rows_down))
    yield rows[rows_down.tolist()].select("t", "line")
