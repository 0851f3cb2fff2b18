"""Tables of joint angles: OpenSim's MOT and STO (also orientations as quaternions), and CSV with units in its names."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import msgspec
import numpy as np
import polars as pl
from numpy.typing import NDArray

from ...recording.errors import MarchaError
from ..contract import ChannelSpec, CommonOptions, Import, ReportBuilder
from ..leg import JOINT_TOPIC, JOINTS, ORIENTATION, QUAT, rotations
from ..legchecks import unwrapped
from ..optical import FloatArray, TimedTables, blocks_of, float_windows
from ..text import text_lines
from ..timestamps import nanoseconds

Windows = Iterator[tuple[FloatArray, NDArray[np.int64]]]
_UNIT = re.compile(r"(?P<name>.+?)(?:_(?P<tail>deg|rad)|\s*[(\[](?P<unit>deg|rad|°)[)\]])", re.IGNORECASE)
_TIME = re.compile(r"(t|time|timestamp)(_s|\s*[(\[]s(ec)?[)\]])?", re.IGNORECASE)


class AnglesOptions(CommonOptions, frozen=True, kw_only=True):
    """Unit of columns whose names do not say it.

    Attributes
    ----------
    unit : str or None
        ``deg`` or ``rad``.
    y_up : bool
        The frame that orientations are given in has y up, as OpenSim's has: turned so that z is.
    """

    unit: Annotated[
        Literal["deg", "rad"] | None, msgspec.Meta(description="unit of angles whose column does not say it")
    ] = None
    y_up: Annotated[
        bool, msgspec.Meta(description="y is up in the frame of orientations: turn it so that z is")
    ] = False


class Angles:
    """Importer ``angles``: ``/reference/joint``, or ``/reference/<segment>/orientation`` of quaternions."""

    name: ClassVar[str] = "angles"
    title: ClassVar[str] = (
        "tables of joint angles (OpenSim MOT and STO, CSV with units), or STO of quaternions"
    )
    Options = AnglesOptions
    beside: ClassVar[bool] = True

    def sniff(self, head: bytes, path: Path) -> float:
        """OpenSim's header, or a time and columns that all say deg or rad."""
        text = head.decode("utf-8-sig", "replace")
        lines = [x.rstrip() for x in text.replace("\r", "\n").split("\n")]
        facts, end = _facts(lines)
        if end is not None:
            return 0.95 if _speaks(facts) else 0.0
        cells = _cells(lines[0]) if lines else []
        named = len(cells) > 1 and _TIME.fullmatch(cells[0]) and all(_UNIT.fullmatch(c) for c in cells[1:])
        return 0.9 if named else 0.0

    def read(self, paths: Sequence[Path], options: AnglesOptions) -> Import:
        """Read one file."""
        path = paths[0]
        _, lines = next(text_lines(path), (1, [""]))
        facts, end = _facts(lines)
        if end is None:
            return _csv(path, lines[0], options)
        if not _speaks(facts):
            raise MarchaError(f"{path}: its header has neither inDegrees nor DataType=Quaternion: no angles")
        report = ReportBuilder()
        start = next((k for k in range(end + 1, len(lines)) if lines[k].strip()), None)
        if start is None:
            raise MarchaError(f"{path}: ends with its header; nothing to convert")
        names = lines[start].split()
        quaternions = facts.get("datatype", "").lower() == "quaternion"
        if names[:1] != ["time"] or len(names) < 2:
            raise MarchaError(f"{path}, line {start + 1}: column names must begin with time, not {names[:1]}")
        columns = ["time", *(f"{n} {a}" for n in names[1:] for a in "wxyz")] if quaternions else names
        pieces = text_lines(path, start + 1)
        if quaternions:
            pieces = ((k, [x.replace(",", " ") for x in piece]) for k, piece in pieces)
        windows = float_windows(path, pieces, " ", columns, report)
        device = {"clock": "device", "time": "column time (s)", "frames": "as the file has them"}
        if quaternions:
            return _orientations(names[1:], windows, report, device, turn=options.y_up)
        degrees = facts.get("indegrees", "").lower() == "yes"
        factor = {n: np.pi / 180 if degrees and not re.search(r"_t[xyz]$", n) else 1.0 for n in names[1:]}
        return _joints(names[1:], factor, windows, report, device)


def _facts(lines: Sequence[str]) -> tuple[dict[str, str], int | None]:
    """Return ``key=value`` of OpenSim's header in lower case, and the line of ``endheader``; None without."""
    facts: dict[str, str] = {}
    for k, line in enumerate(lines[:100]):
        if line.strip().lower() == "endheader":
            return facts, k
        key, mark, value = line.partition("=")
        if mark:
            facts[key.strip().lower()] = value.strip()
    return facts, None


def _speaks(facts: dict[str, str]) -> bool:
    return "indegrees" in facts or facts.get("datatype", "").lower() == "quaternion"


def _cells(line: str) -> list[str]:
    separator = next((c for c in ",;\t" if c in line), ",")
    return [c.strip().strip('"') for c in line.rstrip(separator + " \r\n").split(separator)]


def _csv(path: Path, header: str, options: AnglesOptions) -> Import:
    cells = _cells(header)
    if len(cells) < 2 or not _TIME.fullmatch(cells[0]):
        raise MarchaError(f"{path}, line 1: no header of time (s) and angles, such as time,knee_deg")
    factor, names = {}, []
    for cell in cells[1:]:
        match = _UNIT.fullmatch(cell)
        unit = (match["tail"] or match["unit"]).lower() if match else options.unit
        if unit is None:
            raise MarchaError(
                f"{path}, line 1: column {cell!r} does not say deg or rad; say it with --set unit=deg"
            )
        name = match["name"].strip() if match else cell
        if name in factor:
            raise MarchaError(f"{path}, line 1: {name!r} stands twice; rename one of the columns")
        names.append(name)
        factor[name] = 1.0 if unit == "rad" else np.pi / 180
    report = ReportBuilder()
    separator = next(c for c in ",;\t" if c in header)
    windows = float_windows(path, text_lines(path, 1), separator, cells, report)
    return _joints(names, factor, windows, report, {"clock": "device", "time": f"column {cells[0]} (s)"})


def _joints(
    names: Sequence[str],
    factor: dict[str, float],
    windows: Windows,
    report: ReportBuilder,
    device: dict[str, str],
) -> Import:
    def tables() -> Iterator[TimedTables]:
        for values, rows in windows:
            table = pl.DataFrame({n: values[:, k + 1] * factor[n] for k, n in enumerate(names)})
            yield nanoseconds(values[:, 0], 1e9), rows, [(JOINT_TOPIC, table)]

    spec = ChannelSpec(
        JOINT_TOPIC, JOINTS, "", tuple(names), {"source": "table of angles, signs as in the file"}
    )
    return Import(
        channels=[spec],
        blocks=unwrapped(blocks_of(tables(), report), [JOINT_TOPIC], report),
        report=report,
        metadata={"device": device},
    )


def _orientations(
    names: Sequence[str], windows: Windows, report: ReportBuilder, device: dict[str, str], *, turn: bool
) -> Import:
    specs = [ChannelSpec(f"/reference/{n}/orientation", ORIENTATION, "optical", QUAT) for n in names]

    def tables() -> Iterator[TimedTables]:
        for values, rows in windows:
            quats = values[:, 1:].reshape(len(values), len(names), 4)
            if turn:  # +90° about x, then it
                w, x, y, z = np.moveaxis(quats, 2, 0)
                quats = np.sqrt(0.5) * np.stack((w - x, x + w, y - z, z + y), axis=2)
            yield (
                nanoseconds(values[:, 0], 1e9),
                rows,
                [
                    (s.topic, pl.DataFrame({q: quats[:, k, j] for j, q in enumerate(QUAT)}))
                    for k, s in enumerate(specs)
                ],
            )

    topics = [s.topic for s in specs]
    blocks = rotations(blocks_of(tables(), report), topics, report)
    return Import(channels=specs, blocks=blocks, report=report, metadata={"device": device})
