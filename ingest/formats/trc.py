"""TRC: marker trajectories of Motion Analysis, OpenSim and others, as text between tabs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, ClassVar

import msgspec
import numpy as np
import polars as pl

from ...recording.errors import MarchaError, UsageError
from ..contract import Import, ReportBuilder
from ..leg import unique_markers
from ..optical import MarkerOptions, float_windows, marker_import, marker_table
from ..text import BOM, text_lines
from ..timestamps import nanoseconds
from ..units import conversion


class TrcOptions(MarkerOptions, frozen=True, kw_only=True):
    """Which way is up.

    Attributes
    ----------
    y_up : bool
        The file's y is up, as OpenSim has it: turned so that z is.
    """

    y_up: Annotated[bool, msgspec.Meta(description="y is up in the file: turn it so that z is")] = False


class Trc:
    """Importer ``trc``: ``/reference/markers``."""

    name: ClassVar[str] = "trc"
    title: ClassVar[str] = "TRC marker trajectories (Motion Analysis, OpenSim)"
    Options = TrcOptions
    beside: ClassVar[bool] = True

    def sniff(self, head: bytes, path: Path) -> float:
        """Its first word."""
        return 1.0 if head.removeprefix(BOM).startswith(b"PathFileType") else 0.0

    def read(self, paths: Sequence[Path], options: TrcOptions) -> Import:
        """Read one file."""
        path = paths[0]
        _, lines = next(text_lines(path), (1, [""]))
        if len(lines) < 6 or not lines[0].startswith("PathFileType"):
            raise MarchaError(
                f"{path}, line 1: not the header of a TRC file (PathFileType, five lines, rows)"
            )
        facts = dict(zip(lines[1].split("\t"), (c.strip() for c in lines[2].split("\t")), strict=False))
        try:
            factor, _ = conversion(facts.get("Units", ""), "m")
        except UsageError as error:
            raise MarchaError(f"{path}, line 3: Units: {error}") from None
        cells = lines[3].rstrip().split("\t")
        if [c.strip() for c in cells[:2]] != ["Frame#", "Time"]:
            raise MarchaError(f"{path}, line 4: begins with {cells[:2]}, not with Frame# and Time")
        names = unique_markers([c.strip() for c in cells[2:] if c.strip()], path, 4)
        if not names:
            raise MarchaError(f"{path}, line 4: names no marker")
        report = ReportBuilder()

        def check_count(key: str, count: int, what: str) -> None:
            stated = facts.get(key, "")
            if stated.isdecimal() and float(stated) != count:
                say = report.loss if float(stated) > count else report.note  # more were there
                say("header_doubt", f"{key} is {stated[:20]}, but {what}", line=3)

        check_count("NumMarkers", len(names), f"{len(names)} markers are named")
        columns = ["Frame#", "Time", *(f"{n} {a}" for n in names for a in "XYZ")]
        windows = float_windows(path, text_lines(path, 5), "\t", columns, report)

        def frames() -> Iterator[pl.DataFrame]:
            count = kept = 0
            for values, rows in windows:
                count += len(values)
                timeless = np.isnan(values[:, 1])
                if timeless.any():
                    first = int(np.argmax(timeless))
                    report.drop(
                        "bad_row",
                        "a row without a time; dropped",
                        count=int(timeless.sum()),
                        line=int(rows[first]),
                    )
                    values, rows = values[~timeless], rows[~timeless]
                kept += len(values)
                pos = values[:, 2:].reshape(len(values), len(names), 3) * factor
                if options.y_up:
                    pos = pos[..., [0, 2, 1]] * np.array([1.0, -1.0, 1.0])
                times = pl.DataFrame({"t": nanoseconds(values[:, 1], 1e9), "line": rows})
                yield times.hstack(marker_table(names, pos))
            if not kept:
                raise MarchaError(f"{path}: no row has a time; nothing to convert")
            check_count("NumFrames", count, f"there are {count} rows")

        device = {"time": "column Time (s)", "rate_hz": facts.get("DataRate", "")}
        return marker_import(frames(), names, report, device, options)
