"""Spreadsheets of signal strengths, a sheet a technology: at distances, or at points of a floor.

``Distance, RSSI, Point`` (powers of one anchor at distances) or ``x, y, RSSI A, RSSI B, …`` (fingerprints and test
points; the letters are anchors). Sheets are called after the technology: ``WiFi``, ``BLE``, ``Zigbee``. Where the
anchors stand is said by the option ``anchors``.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar

import msgspec
import numpy as np
import polars as pl

from ...recording.errors import MarchaError, UsageError
from ..contract import CommonOptions, Import, ReportBuilder
from ..inertial import one_file
from ..radio import local_address, signed_powers, technology_of
from ..surveys import SurveyPoint, survey_import
from ..workbook import is_workbook, read_workbook

_RSSI = re.compile(r"^rssi\s+(?P<node>\w+)$", re.IGNORECASE)


class RssiSheetOptions(CommonOptions, frozen=True, kw_only=True):
    """Which sheet, and where the anchors stand.

    Attributes
    ----------
    technology : str, optional
        Only this sheet: ``wifi``, ``ble`` or ``zigbee``; default: all sheets, one after another.
    anchors : str
        ``A 0 0, B 0 4, C 4 0``: name, x, y and where known z (m) of each anchor.
    exchange : str
        ``B C``: two anchors whose columns are exchanged in this file.
    """

    technology: Annotated[
        str | None, msgspec.Meta(description="only this technology: wifi, ble or zigbee")
    ] = None
    anchors: Annotated[str, msgspec.Meta(description="name x y [z] of each anchor (m), between commas")] = ""
    exchange: Annotated[str, msgspec.Meta(description="two anchors whose columns are exchanged: B C")] = ""


class RssiSheet:
    """Importer ``rssi-sheet``: ``/indoor/radio`` and ``/reference/position``; the anchors where they are given."""

    name: ClassVar[str] = "rssi-sheet"
    title: ClassVar[str] = "spreadsheet of signal strengths: Distance, RSSI, Point or x, y, RSSI A, RSSI B …"
    Options = RssiSheetOptions

    def sniff(self, head: bytes, path: Path) -> float:
        """A workbook with such a sheet."""
        if not head.startswith(b"PK") or not is_workbook(path):
            return 0.0
        try:
            return 0.9 if any(_shape(t) for t in read_workbook(path).values()) else 0.0
        except MarchaError:
            return 0.0

    def read(self, paths: Sequence[Path], options: RssiSheetOptions) -> Import:
        """Read one workbook."""
        path = one_file(paths, self.name)
        if not path.exists() or not is_workbook(path):
            raise MarchaError(f"{path}: {'is no spreadsheet (.xlsx)' if path.exists() else 'no such file'}")
        wanted = technology_of(options.technology) if options.technology else None
        report = ReportBuilder()
        positions = _anchors(options.anchors)
        points: list[SurveyPoint] = []
        heard: dict[str, dict[str, Any]] = {}
        shapes: set[str] = set()
        for name, table in read_workbook(path).items():
            technology = technology_of(name)
            shape = _shape(table)
            if not shape or (wanted is not None and technology != wanted):
                continue
            if technology == "unknown":
                raise UsageError(f"{path}, sheet {name!r}: its name says no technology (WiFi, BLE, Zigbee)")
            shapes.add(shape)
            label = f"{path.name}, sheet {name}"
            table = _exchanged(table, options.exchange, label, report)
            mine = _points(table, shape, technology, label, report, heard)
            if shape == "points":
                _look_exchanged(
                    mine, {m: positions.get(a["name"]) for m, a in heard.items()}, heard, label, report
                )
            points += mine
        if not points:
            raise UsageError(
                f"{path}: no sheet{f' of {wanted}' if wanted else ''} with Distance and RSSI, or x, y and RSSI A …"
            )
        if shapes == {"distance"}:
            anchors = [{**a, "x": 0.0, "y": 0.0} for a in heard.values()]
        else:
            missing = sorted({a["name"] for a in heard.values()} - set(positions))
            if positions and missing:
                raise UsageError(
                    f"anchors: nothing says where {missing[0]} stands; there are {', '.join(positions)}"
                )
            anchors = [{**a, **positions[a["name"]]} for a in heard.values()] if positions else []
            if not positions:
                report.note(
                    "no_anchors",
                    "nothing says where the anchors stand: fingerprints do without; for ranges: anchors=A 0 0, B 0 4 …",
                )
        return survey_import(points, anchors, report, "x and y of the spreadsheet, m")


def _shape(table: pl.DataFrame) -> str:
    """Return ``distance``, ``points`` or nothing."""
    names = {c.strip().lower() for c in table.columns}
    if {"distance", "rssi"} <= names:
        return "distance"
    return "points" if {"x", "y"} <= names and any(_RSSI.match(c) for c in table.columns) else ""


def _points(
    table: pl.DataFrame,
    shape: str,
    technology: str,
    label: str,
    report: ReportBuilder,
    heard: dict[str, dict[str, Any]],
) -> list[SurveyPoint]:
    columns = {c.strip().lower(): c for c in table.columns}
    nodes = (
        {"A": columns["rssi"]}
        if shape == "distance"
        else {m["node"]: c for c in table.columns if (m := _RSSI.match(c.strip()))}
    )
    powers: dict[str, list[float]] = {}
    for node, column in nodes.items():
        values = table[column].cast(pl.Float64, strict=False).fill_null(float("nan")).to_list()
        powers[node] = signed_powers(values, f"{label}, {column}", report)
        mac = local_address(f"{technology} {node}")
        heard[mac] = {"mac": mac, "technology": technology, "name": node}
    first = columns["distance"] if shape == "distance" else columns["x"]
    x = table[first].cast(pl.Float64, strict=False).to_list()
    y = (
        [0.0] * len(x)
        if shape == "distance"
        else table[columns["y"]].cast(pl.Float64, strict=False).to_list()
    )
    points: list[SurveyPoint] = []
    for k, (px, py) in enumerate(zip(x, y, strict=True)):
        here = {n: v[k] for n, v in powers.items() if v[k] == v[k]}
        if px is None or py is None or not here:
            report.drop(
                "bad_row", f"{label}: row {k + 2}: no place or no power; dropped", line=k + 2, subject=label
            )
            continue
        heard_here = {local_address(f"{technology} {n}"): (technology, [v]) for n, v in here.items()}
        points.append(SurveyPoint((float(px), float(py), 0.0), heard_here))
    return points


def _exchanged(table: pl.DataFrame, exchange: str, label: str, report: ReportBuilder) -> pl.DataFrame:
    """Return the table with the columns of two anchors exchanged, as the user says."""
    if not exchange:
        return table
    names = {m["node"]: c for c in table.columns if (m := _RSSI.match(c.strip()))}
    pair = exchange.replace(",", " ").split()
    if len(pair) != 2 or not set(pair) <= set(names):
        raise UsageError(f"exchange={exchange!r}: two of {', '.join(names) or 'no anchors'}, such as B C")
    a, b = (names[p] for p in pair)
    report.repair(
        "exchanged_anchors",
        f"{label}: powers of {pair[0]} and {pair[1]} exchanged, as told",
        count=table.height,
    )
    return table.rename({a: b, b: a}).select(table.columns)


BETTER = 1.15
"""A pair of anchors is said to look exchanged where the sum of squares is this many times smaller so."""


def _look_exchanged(
    points: Sequence[SurveyPoint],
    places: dict[str, dict[str, float] | None],
    heard: dict[str, dict[str, Any]],
    label: str,
    report: ReportBuilder,
) -> None:
    """Report two anchors whose powers fall with the distance to each other's place, not to their own."""
    rows = [
        (p.where, mac, power) for p in points for mac, (_, powers) in p.powers.items() for power in powers
    ]
    rows = [r for r in rows if places.get(r[1]) is not None]
    macs = sorted({mac for _, mac, _ in rows})
    if len(macs) < 2 or len(rows) < 8:
        return
    power = np.array([p for *_, p in rows])

    def left(order: dict[str, str]) -> float:
        stations = [places[order[mac]] or {} for _, mac, _ in rows]
        d = np.array(
            [np.hypot(w[0] - a["x"], w[1] - a["y"]) for (w, *_), a in zip(rows, stations, strict=True)]
        )
        design = np.column_stack([np.ones(len(d)), -10 * np.log10(np.maximum(d, 0.1))])
        solution, *_ = np.linalg.lstsq(design, power, rcond=None)
        return float(((power - design @ solution) ** 2).sum())

    same = {m: m for m in macs}
    pairs = [(a, b) for i, a in enumerate(macs) for b in macs[i + 1 :]]
    sums = {(a, b): left(same | {a: b, b: a}) for a, b in pairs}
    best = min(sums, key=lambda k: sums[k])
    own = left(same)
    if own > BETTER * sums[best]:
        a, b = sorted(heard[m]["name"] for m in best)
        rms = [float(np.sqrt(v / len(rows))) for v in (own, sums[best])]
        report.note(
            "exchanged_anchors",
            f"{label}: powers of {a} and {b} look exchanged: they leave {rms[0]:.1f} dB about the model, exchanged "
            f"{rms[1]:.1f} dB; kept as they are; set exchange={a} {b} where that is so",
            subject=label,
        )


def _anchors(text: str) -> dict[str, dict[str, float]]:
    anchors: dict[str, dict[str, float]] = {}
    for part in filter(None, (p.strip() for p in text.split(","))):
        name, *place = part.split()
        try:
            numbers = [float(v) for v in place]
        except ValueError:
            numbers = []
        if len(numbers) not in (2, 3):
            raise UsageError(f"anchors: {part!r} is not name x y [z], such as A 0 0, B 0 4, C 4 0")
        anchors[name] = dict(zip("xyz", numbers, strict=False))
    return anchors
