"""Vicon Nexus' ASCII export: sections (Trajectories, Model Outputs …), each with a rate and headers of its own."""

from __future__ import annotations

import re
import sys
from collections import deque
from collections.abc import Iterator, Sequence
from hashlib import blake2b
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ...recording.errors import MarchaError, UsageError
from ..contract import ChannelSpec, Import, ReportBuilder
from ..leg import JOINT_TOPIC, JOINTS, unique_markers
from ..optical import FloatArray, MarkerOptions, beside_each_other, blocks_of, float_windows, marker_import
from ..text import text_lines
from ..timestamps import nanoseconds, possible_rate
from ..units import conversion

SECTIONS = ("Trajectories", "Model Outputs")
SOURCE = "Vicon Model Outputs; x (flexion), then y and z of each angle"


class _Section(NamedTuple):
    path: Path
    rate_hz: float
    names: list[str]
    units: list[str]
    separator: str
    first: int
    """Its first line of numbers."""
    end: int = sys.maxsize
    """The line behind its last one."""

    def windows(self, report: ReportBuilder) -> Iterator[tuple[FloatArray, NDArray[np.int64]]]:
        """Yield frame, sub frame, x, y, z of every name, and lines."""

        def pieces() -> Iterator[tuple[int, list[str]]]:
            for line, lines in text_lines(self.path, self.first - 1):
                if line >= self.end:
                    return
                yield line, lines[: self.end - line]

        columns = ["Frame", "Sub Frame", *(f"{n} {a}" for n in self.names for a in "XYZ")]
        return float_windows(self.path, pieces(), self.separator, columns, report)

    def frames(
        self, columns: Sequence[tuple[str, int, float]], report: ReportBuilder
    ) -> Iterator[pl.DataFrame]:
        """Yield ``t`` (ns), ``line`` and columns: name, place behind the sub frame, factor."""
        for values, lines in self.windows(report):
            t_ns = nanoseconds(values[:, 0] - 1, 1e9 / self.rate_hz)
            yield pl.DataFrame(
                {"t": t_ns, "line": lines} | {name: values[:, 2 + k] * factor for name, k, factor in columns}
            )

    def counted(self) -> bytes:
        """Return a digest of the numbers of its frames."""
        digest = blake2b()
        for values, _ in self.windows(ReportBuilder()):
            digest.update(values[:, 0].tobytes())
        return digest.digest()


class ViconCsv:
    """Importer ``vicon-csv``: ``/reference/markers``, and ``/reference/joint`` of modelled angles."""

    name: ClassVar[str] = "vicon-csv"
    title: ClassVar[str] = "Vicon Nexus CSV: marker trajectories and modelled angles"
    Options = MarkerOptions
    beside: ClassVar[bool] = True

    def sniff(self, head: bytes, path: Path) -> float:
        """A section's name, a rate and a header of frames."""
        if b"Sub Frame" not in head:
            return 0.0
        lines = head[:65536].decode("utf-8-sig", "replace").splitlines()
        begins = any(_starts(lines, k) for k in range(len(lines) - 3))
        return 0.95 if begins else 0.0

    def read(self, paths: Sequence[Path], options: MarkerOptions) -> Import:
        """Read one file."""
        path = paths[0]
        report = ReportBuilder()
        sections = _sections(path)
        if not sections:
            raise MarchaError(
                f"{path}: has neither a section Trajectories nor Model Outputs with their headers"
            )
        modelled, marks = sections.get("Model Outputs"), sections.get("Trajectories")
        angles = _angles(modelled) if modelled is not None else {}
        spec = ChannelSpec(JOINT_TOPIC, JOINTS, "", tuple(angles), {"source": SOURCE})
        device = {"time": "frames at the section's rate; frame 1 is at 0"}
        if marks is None:
            if modelled is None or not angles:
                raise MarchaError(f"{path}: its Model Outputs hold no angles (deg, rad)")
            frames = modelled.frames([(n, *source) for n, source in angles.items()], report)
            windows = (
                (f["t"].to_numpy(), f["line"].to_numpy(), [(spec.topic, f.drop("t", "line"))]) for f in frames
            )
            return Import(
                channels=[spec],
                blocks=blocks_of(windows, report),
                report=report,
                metadata={"device": {"clock": "device", **device}},
            )
        names = unique_markers([n.rpartition(":")[2] for n in marks.names], path, 1)
        columns = []
        for k, (name, unit) in enumerate(zip(names, marks.units, strict=True)):
            try:
                factor = conversion(unit, "m")[0]
            except UsageError as error:
                raise MarchaError(f"{path}: marker {name}: {error}") from None
            columns += [(f"{name}.{a}", 3 * k + j, factor) for j, a in enumerate("xyz")]
        frames = marks.frames(columns, report)
        more = []
        if modelled is not None and angles:
            if modelled.rate_hz == marks.rate_hz and modelled.counted() == marks.counted():
                more = [spec]
                beside = modelled.frames(
                    [(f"{spec.topic} {n}", *source) for n, source in angles.items()], report
                )
                frames = beside_each_other(frames, beside)
            else:
                report.note(
                    "unused_column", "Model Outputs are of other frames than Trajectories: not imported"
                )
        device["rate_hz"] = f"{marks.rate_hz:g}"
        return marker_import(frames, names, report, device, options, more)


def _sections(path: Path) -> dict[str, _Section]:
    """Return the sections of a file by their names; of those with one name the last."""
    sections: dict[str, _Section] = {}
    before: deque[str] = deque(maxlen=4)
    name = ""  # of the section whose rows are read
    for first, lines in text_lines(path):
        for number, line in enumerate(lines, first):
            if len(before) == 4 and "Sub Frame" in before[3] and _starts(before, 0):
                name = _word(before[0])
                if name in SECTIONS:
                    sections[name] = _section(path, before, line, number)
            elif name in sections and not line.strip(sections[name].separator + ' "'):
                sections[name] = sections[name]._replace(end=number)
                name = ""
            before.append(line)
    return sections


def _word(line: str) -> str:
    return line.strip().strip('",;\t')


def _starts(lines: Sequence[str], k: int) -> bool:
    """Whether a section starts in line ``k``: its name, a rate, names, then Frame and Sub Frame."""
    if not re.fullmatch(r"[A-Za-z][A-Za-z ]*", _word(lines[k])):
        return False
    rate = re.fullmatch(r"\d+(\.\d+)?", _word(lines[k + 1]))
    return rate is not None and re.match(r'"?Frame"?[,;\t]"?Sub Frame', lines[k + 3]) is not None


def _section(path: Path, head: Sequence[str], below: str, line: int) -> _Section:
    """Return a section of its four lines of headers and the line of units, the ``line``-th of the file."""
    separator = next(c for c in ",;\t" if c in head[3])
    header = [c.strip().strip('"') for c in head[2].split(separator)]
    names = [c for c in header[2:] if c]
    axes = [c.strip().strip('"') for c in head[3].rstrip(separator + " ").split(separator)]
    if axes[2:] != ["X", "Y", "Z"] * len(names):
        raise MarchaError(
            f"{path}, line {line - 1}: {len(names)} names above {len(axes) - 2} columns, not X, Y, Z each"
        )
    units = [c.strip().strip('"') for c in below.split(separator)]
    per_name = [units[2 + 3 * i] if len(units) > 2 + 3 * i else "" for i in range(len(names))]
    rate = possible_rate(float(_word(head[1])), path, f"correct line {line - 3}")
    return _Section(path, rate, names, per_name, separator, line + 1)


def _angles(section: _Section) -> dict[str, tuple[int, float]]:
    """Return place and factor of modelled angles, ``<name>``, ``<name>_y``, ``<name>_z`` (rad).

    x is flexion in Vicon's models.
    """
    return {
        name.rpartition(":")[2] + tail: (3 * k + j, np.pi / 180 if unit == "deg" else 1.0)
        for k, (name, unit) in enumerate(zip(section.names, section.units, strict=True))
        if unit in ("deg", "rad")
        for j, tail in enumerate(("", "_y", "_z"))
    }
