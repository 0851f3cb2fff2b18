"""phyphox: a folder or zip of CSV files, one a sensor, with the experiment's clock; or one of its files.

``Time (s)`` is the experiment's clock, which stands while the measurement is paused. ``meta/time.csv`` says
when it ran, by the phone's clock. phyphox gives Android's axes and signs on both platforms.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np
import polars as pl

from ...recording.errors import MarchaError
from ..columns import Header, find_header, float_blocks, require_header
from ..contract import CommonOptions, Import, ReportBuilder, SourceAttachment
from ..phonelog import (
    ACC,
    AXES,
    FIELD,
    GYR,
    HECTOPASCAL,
    MAG,
    MICROTESLA,
    PRESSURE,
    VALUES,
    SourceColumn,
    Stream,
    StreamChannel,
    declared,
    fix_part,
    imu_part,
    require_rows,
    xyz,
)
from ..text import start_of
from ..timestamps import nanoseconds

WANTED = '"Time (s)","X (m/s^2)",…'
TIME = re.compile(r"(?:time|zeit|temps|tiempo|tempo) \(s\)", re.IGNORECASE)
_CELL = re.compile(r"(?P<what>.*?)\s*\((?P<unit>[^()]*)\)\s*")
_UNITS = {
    "m/s^2": "acc",
    "m/s²": "acc",
    "rad/s": "gyr",
    "µT": "mag",
    "μT": "mag",
    "uT": "mag",
    "hPa": "pressure",
}
_FIX = {
    "latitude": "lat",
    "longitude": "lon",
    "height": "alt",
    "altitude": "alt",
    "horizontal accuracy": "accuracy",
    "vertical accuracy": "vertical",
    "velocity": "speed",
    "direction": "course",
}
_SPREADSHEET = (["timestamps", "x", "y", "z"], ["timestamps", "lat", "lon"])
_LATE_S = 0.5
"""Sensors may deliver so long after the measurement was paused."""


class PhyphoxOptions(CommonOptions, frozen=True, kw_only=True):
    """No options of its own: names, units and times stand in the files."""


class _Run(NamedTuple):
    """The experiment's clock at START and PAUSE (s), and the phone's at START (ns since 1970)."""

    start_s: float
    end_s: float
    system_ns: int


class Phyphox:
    """Importer ``phyphox``: ``/phone/acc``, ``/phone/gyr``, ``/phone/mag``, ``/phone/gnss``, ``/phone/pressure``."""

    name: ClassVar[str] = "phyphox"
    title: ClassVar[str] = "phyphox CSV: folder or zip with a file a sensor, or one file"
    Options = PhyphoxOptions

    def sniff(self, head: bytes, path: Path) -> float:
        """A header of phyphox; of a folder: in one of its files."""
        if path.is_dir():
            tables = _tables(path)
            if len({p.parent for p in tables}) > 1:  # several measurements are several recordings
                return 0.0
            return max((self.sniff(start_of(p), p) for p in tables), default=0.0)
        if find_header(head, _is_header) is not None:
            return 0.9
        return 0.6 if _saved_by_spreadsheet(head) else 0.0

    def chief(self, path: Path) -> Path:
        """Return the folder of a table: a measurement is all of its tables."""
        return path.parent

    def read(self, paths: Sequence[Path], options: PhyphoxOptions) -> Import:
        """Read a folder, or the files given."""
        files = [f for p in paths for f in (_tables(p) if p.is_dir() else [p])]
        report = ReportBuilder()
        attachments: list[SourceAttachment] = []
        runs, device = _runs(paths[0]), _device(paths[0])
        streams: list[tuple[Path, Header, Stream]] = []
        taken: dict[str, Path] = {}
        for file in files:
            header = _header(file)
            part = _part(file, header)
            if part is None:
                report.note(
                    "unused_file", f"{file.name}: no sensor that is known; left out", subject=file.name
                )
                continue
            if part.topic in taken:
                raise MarchaError(
                    f"{file}: {part.topic} is in {taken[part.topic].name} already; remove one of them"
                )
            taken[part.topic] = file
            even = not part.fixes
            stream = Stream([part], report, subject=file.name, even=even, attachments=attachments)
            streams.append((file, header, stream))
        if not streams:
            raise MarchaError(f"{paths[0]}: none of its files has a sensor that is known ({WANTED})")
        return Import(
            channels=declared(s for *_, s in streams),
            blocks=_blocks(paths[0], streams, runs, report),
            report=report,
            attachments=attachments,
            metadata={
                "device": {
                    "clock": "utc" if runs else "device",
                    "time": "experiment time placed by meta/time.csv" if runs else "experiment time",
                    "name": "phyphox",
                    "frames": AXES,
                    "converted": "magnetic field from µT, pressure from hPa, accuracy (68 % radius) to a standard "
                    "deviation an axis",
                    **device,
                }
            },
        )


def _tables(folder: Path) -> list[Path]:
    """Return the CSV files of measurements: not those of ``meta``, not deeper than a zip's top folder."""
    paths = sorted(p for p in (*folder.glob("*.csv"), *folder.glob("*/*.csv")) if p.is_file())
    sensors = [p for p in paths if p.parent.name != "meta" and p.name not in ("time.csv", "device.csv")]
    return [p for p in sensors if find_header(start_of(p), _is_header) or _saved_by_spreadsheet(start_of(p))]


def _is_header(cells: Sequence[str]) -> bool:
    """A time and a sensor: phyphox writes one a table, so that axes of two sensors are another logger's."""
    if not TIME.fullmatch(cells[0]) or len(cells) < 2:
        return False
    matches = [_CELL.fullmatch(c) for c in cells[1:]]
    units = {m["unit"] for m in matches if m}
    place = any(m and m["what"].lower() == "latitude" for m in matches)
    third = sum(m["what"].lower().split(" ")[-1] == "z" for m in matches if m)
    return place or (bool(units & set(_UNITS)) and (third == 1 or (third == 0 and "hPa" in units)))


def _saved_by_spreadsheet(head: bytes) -> bool:
    cells = head.split(b"\n", 1)[0].decode("utf-8", "replace").strip().split(",")
    return any(cells[: len(c)] == c for c in _SPREADSHEET)


def _header(file: Path) -> Header:
    head = start_of(file)
    if _saved_by_spreadsheet(head):
        rows = head.split(b"\n")[1:40]
        cells = [c.strip().decode("utf-8", "replace") for row in rows for c in row.split(b",") if c.strip()]
        digits = max((len(re.sub(r"[eE].*|[^\d]", "", c)) for c in cells), default=0)
        shown = next((c for c in cells[1:] if "E" in c), cells[1] if len(cells) > 1 else "")
        raise MarchaError(
            f"{file}, line 2: not phyphox's own export: the header has no units and numbers are kept to {digits} "
            f"digits ({shown}), times and positions as well: a spreadsheet saved it; export the measurement "
            "from phyphox again"
        )
    return require_header(file, _is_header, WANTED)


def _part(file: Path, header: Header) -> StreamChannel | None:
    """Return the channel of a file, from units and names; None for what is no sensor of a walk."""
    cells = {n: m for n in header.names if (m := _CELL.fullmatch(n))}
    fix = {_FIX[w]: n for n, m in cells.items() if (w := m["what"].lower()) in _FIX}
    if "lat" in fix and "lon" in fix:
        return fix_part(fix)
    by_axis: dict[str, str] = {}
    quantity = ""
    for name, m in cells.items():
        axis = m["what"].lower().split(" ")[-1]
        if m["unit"] in _UNITS and axis in ("x", "y", "z") and axis not in by_axis:
            by_axis[axis], quantity = name, _UNITS[m["unit"]]
        elif m["unit"] == "hPa":
            return StreamChannel(
                "/phone/pressure", PRESSURE, {"pressure_pa": SourceColumn(name, HECTOPASCAL)}
            )
    if len(by_axis) < 3:
        return None
    names = [by_axis[a] for a in "xyz"]
    if quantity == "acc" and (
        "linear" in names[0].lower() or "linear" in file.stem.lower() or "without" in file.stem
    ):
        return StreamChannel(
            "/phone/linear_acc", VALUES, xyz(ACC, names), ACC, metadata={"gravity": "removed by the phone"}
        )
    if quantity == "acc":
        return imu_part("/phone/acc", xyz(ACC, names), gravity="included")
    if quantity == "gyr":
        return imu_part("/phone/gyr", xyz(GYR, names))
    return StreamChannel("/phone/mag", MAG, xyz(FIELD, names, MICROTESLA))


def _beside(path: Path, name: str) -> Path | None:
    """Return a file of ``meta``, also where it lies beside the tables."""
    folder = path if path.is_dir() else path.parent
    paths = [
        p for pattern in (f"meta/{name}", name, f"*/meta/{name}", f"*/{name}") for p in folder.glob(pattern)
    ]
    return paths[0] if paths else None


def _rows(file: Path) -> list[list[str]]:
    text = file.read_text(encoding="utf-8-sig", errors="replace")
    separator = next((s for s in (";", "\t") if s in text.split("\n", 1)[0]), ",")
    return [
        [c.strip().strip('"') for c in line.split(separator)] for line in text.splitlines() if line.strip()
    ]


def _runs(path: Path) -> list[_Run]:
    """Return when the experiment's clock ran; empty where nothing says it."""
    file = _beside(path, "time.csv")
    if file is None:
        return []
    runs: list[_Run] = []
    begun: tuple[float, int] | None = None
    for k, cells in enumerate(_rows(file)[1:], 2):
        try:
            elapsed, system = float(cells[1].replace(",", ".")), float(cells[2].replace(",", "."))
        except (IndexError, ValueError):
            raise MarchaError(
                f"{file}, line {k}: not event, experiment time, system time; repair or remove it"
            ) from None
        if cells[0].upper() == "START":
            begun = (elapsed, round(system * 1e6) * 1000)
        elif begun is not None:
            runs.append(_Run(begun[0], elapsed, begun[1]))
            begun = None
    if begun is not None:
        runs.append(_Run(begun[0], np.inf, begun[1]))
    return runs


def _device(path: Path) -> dict[str, str]:
    file = _beside(path, "device.csv")
    words = {
        "deviceModel": "phone",
        "deviceRelease": "os_release",
        "version": "app_version",
        "deviceBrand": "brand",
    }
    rows = [] if file is None else _rows(file)
    return {words[r[0]]: r[1] for r in rows if len(r) > 1 and r[0] in words and r[1]}


def _blocks(
    path: Path, streams: list[tuple[Path, Header, Stream]], runs: list[_Run], report: ReportBuilder
) -> Iterator[tuple[str, pl.DataFrame]]:
    for file, header, stream in streams:
        yield from stream.pull(_frames(file, header, runs, report))
        if not stream.rows:
            report.note(
                "header_only",
                f"{file.name}: has a header and no row: its channel is empty",
                subject=file.name,
            )
    if runs[1:]:
        longest = max(
            (b.system_ns - a.system_ns) / 1e9 - (b.start_s - a.start_s) for a, b in itertools.pairwise(runs)
        )
        report.note(
            "paused_clock",
            f"the experiment's clock stood {len(runs) - 1} times, longest {longest:.1f} s: time goes on by the phone's "
            "clock (time.csv)",
            count=len(runs) - 1,
        )
    require_rows(path, [s for *_, s in streams])


def _frames(file: Path, header: Header, runs: list[_Run], report: ReportBuilder) -> Iterator[pl.DataFrame]:
    time = header.names[0]
    for frame in float_blocks(file, header, time, report):
        seconds = frame[time].to_numpy()
        if not runs:
            t = pl.Series("t", nanoseconds(seconds, 1e9))
            yield pl.DataFrame([*(s for s in frame.get_columns() if s.name != time), t])
            continue
        starts = np.array([r.start_s for r in runs])
        run = np.maximum(np.searchsorted(starts, seconds, side="right") - 1, 0)
        origin = np.array([r.system_ns for r in runs])[run]
        t = nanoseconds(seconds - starts[run], 1e9, origin)
        late = seconds > runs[-1].end_s + _LATE_S
        if late.any():
            report.drop(
                "outside_recording",
                f"{file.name}: goes on to {seconds[-1]:.1f} s, but the measurement was paused for good at "
                f"{runs[-1].end_s:.1f} s (time.csv): from another measurement; rows dropped",
                count=int(late.sum()),
                line=int(frame["line"][int(np.argmax(late))]),
                subject=file.name,
            )
        yield frame.with_columns(t=pl.Series(t)).drop(time).filter(pl.Series(~late))
