"""Vicon Nexus' ASCII export: sections (Trajectories, Model Outputs …), each with a rate and headers of its own."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np
import polars as pl

from ...recording.errors import MarchaError, UsageError
from ..contract import ChannelSpec, Import, ReportBuilder
from ..leg import JOINT_TOPIC, JOINTS, unique_markers
from ..optical import FloatArray, MarkerOptions, blocks_of, float_rows, marker_import, read_text
from ..timestamps import nanoseconds, possible_rate
from ..units import conversion

SECTIONS = ("Trajectories", "Model Outputs")


class _Section(NamedTuple):
    rate_hz: float
    names: list[str]
    units: list[str]
    values: FloatArray  # frame, sub frame, x, y, z of every name
    lines: np.ndarray


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
        lines = head[:65536].removeprefix(b"\xef\xbb\xbf").decode("utf-8", "replace").splitlines()
        begins = any(_starts(lines, k) for k in range(len(lines) - 3))
        return 0.95 if begins else 0.0

    def read(self, paths: Sequence[Path], options: MarkerOptions) -> Import:
        """Read one file."""
        path = paths[0]
        lines = read_text(path).split("\n")
        report = ReportBuilder()
        sections = {
            _word(lines[k]): _section(path, lines, k, report)
            for k in range(len(lines) - 3)
            if _starts(lines, k) and _word(lines[k]) in SECTIONS
        }
        if not sections:
            raise MarchaError(
                f"{path}: has neither a section Trajectories nor Model Outputs with their headers"
            )
        angles = _angles(sections["Model Outputs"]) if "Model Outputs" in sections else None
        marks = sections.get("Trajectories")
        device = {"time": "frames at the section's rate; frame 1 is at 0"}
        if marks is None:
            assert angles is not None or not sections
            if angles is None:
                raise MarchaError(f"{path}: its Model Outputs hold no angles (deg, rad)")
            spec, table, section = angles
            blocks = blocks_of([(_times(section), section.lines, [(spec.topic, table)])], report)
            return Import(
                channels=[spec],
                blocks=blocks,
                report=report,
                metadata={"device": {"clock": "device", **device}},
            )
        names = unique_markers([n.rpartition(":")[2] for n in marks.names], path, 1)
        factors = []
        for name, unit in zip(names, marks.units, strict=True):
            try:
                factors.append(conversion(unit, "m")[0])
            except UsageError as error:
                raise MarchaError(f"{path}: marker {name}: {error}") from None
        pos = marks.values[:, 2:].reshape(len(marks.values), -1, 3) * np.array(factors)[:, None]
        more = []
        if angles is not None:
            spec, table, section = angles
            if np.array_equal(section.values[:, 0], marks.values[:, 0]) and section.rate_hz == marks.rate_hz:
                more = [(spec, table)]
            else:
                report.note(
                    "unused_column", "Model Outputs are of other frames than Trajectories: not imported"
                )
        device["rate_hz"] = f"{marks.rate_hz:g}"
        return marker_import(_times(marks), marks.lines, names, pos, report, device, options, more)


def _word(line: str) -> str:
    return line.strip().strip('",;\t')


def _starts(lines: Sequence[str], k: int) -> bool:
    """Whether a section starts in line ``k``: its name, a rate, names, then Frame and Sub Frame."""
    if not re.fullmatch(r"[A-Za-z][A-Za-z ]*", _word(lines[k])):
        return False
    rate = re.fullmatch(r"\d+(\.\d+)?", _word(lines[k + 1]))
    return rate is not None and re.match(r'"?Frame"?[,;\t]"?Sub Frame', lines[k + 3]) is not None


def _section(path: Path, lines: Sequence[str], k: int, report: ReportBuilder) -> _Section:
    separator = next(c for c in ",;\t" if c in lines[k + 3])
    header = [c.strip().strip('"') for c in lines[k + 2].split(separator)]
    names = [c for c in header[2:] if c]
    axes = [c.strip().strip('"') for c in lines[k + 3].rstrip(separator + " ").split(separator)]
    if axes[2:] != ["X", "Y", "Z"] * len(names):
        raise MarchaError(
            f"{path}, line {k + 4}: {len(names)} names above {len(axes) - 2} columns, not X, Y, Z each"
        )
    units = [c.strip().strip('"') for c in lines[k + 4].split(separator)]
    first = k + 5
    end = next((j for j in range(first, len(lines)) if not lines[j].strip(separator + ' "')), len(lines))
    columns = ["Frame", "Sub Frame", *(f"{n} {a}" for n in names for a in "XYZ")]
    values, rows = float_rows(path, lines[first:end], first + 1, separator, columns, report)
    per_name = [units[2 + 3 * i] if len(units) > 2 + 3 * i else "" for i in range(len(names))]
    rate = possible_rate(float(_word(lines[k + 1])), path, f"correct line {k + 2}")
    return _Section(rate, names, per_name, values, rows)


def _times(section: _Section) -> np.ndarray:
    return nanoseconds(section.values[:, 0] - 1, 1e9 / section.rate_hz)


def _angles(section: _Section) -> tuple[ChannelSpec, pl.DataFrame, _Section] | None:
    """Return modelled angles as ``<name>``, ``<name>_y``, ``<name>_z`` (rad), x being flexion in Vicon's models."""
    columns = {}
    for k, (name, unit) in enumerate(zip(section.names, section.units, strict=True)):
        if unit not in ("deg", "rad"):
            continue
        for j, tail in enumerate(("", "_y", "_z")):
            value = section.values[:, 2 + 3 * k + j]
            columns[name.rpartition(":")[2] + tail] = np.radians(value) if unit == "deg" else value
    if not columns:
        return None
    metadata = {"source": "Vicon Model Outputs; x (flexion), then y and z of each angle"}
    spec = ChannelSpec(JOINT_TOPIC, JOINTS, "", tuple(columns), metadata)
    return spec, pl.DataFrame(columns), section
