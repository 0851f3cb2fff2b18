"""Signal strengths at known distances, a text file a distance: ``Node A: -31``, a line a packet.

A folder is one technology, its name says which (``WiFi``, ``BLE``, ``Zigbee``); a file's name says the distance
(``1.5m.txt``) or the number of the point (``7.txt``), whose distance stands in a spreadsheet beside the folder
(columns ``Distance``, ``Point``) or in the option ``distances``. Where the spreadsheet states powers of the same
points, both are compared.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, ClassVar

import msgspec
import numpy as np
import polars as pl

from ...recording.errors import MarchaError, UsageError
from ..contract import CommonOptions, Import, ReportBuilder
from ..radio import compare_powers, local_address, signed_powers, technology_of
from ..surveys import SurveyPoint, survey_import
from ..text import read_text
from ..workbook import is_workbook, read_workbook

_ROW = re.compile(r"^\s*(?:Node\s+)?(?P<node>\w+)\s*:\s*(?P<rssi>-?\d+(?:\.\d+)?)\s*$")
_METRES = re.compile(r"^(?P<metres>\d+(?:\.\d+)?)\s*m$", re.IGNORECASE)


class RssiDistancesOptions(CommonOptions, frozen=True, kw_only=True):
    """What file names do not say.

    Attributes
    ----------
    distances : str
        Distances of points 1, 2, … in metres, between commas.
    spreadsheet : str, optional
        Workbook with the columns Distance and Point; default: the only one beside the folder or up to two above.
    technology : str, optional
        ``wifi``, ``ble`` or ``zigbee``; default: as the folder is called.
    """

    distances: Annotated[str, msgspec.Meta(description="metres of points 1, 2, …, between commas")] = ""
    spreadsheet: Annotated[
        str | None,
        msgspec.Meta(description="workbook with Distance and Point; default: one beside the folder"),
    ] = None
    technology: Annotated[
        str | None, msgspec.Meta(description="wifi, ble or zigbee; default: the folder's name")
    ] = None


class RssiDistances:
    """Importer ``rssi-distances``: ``/indoor/radio`` and ``/reference/position`` along the x axis from the anchor."""

    name: ClassVar[str] = "rssi-distances"
    title: ClassVar[str] = "signal strengths at known distances, a text file each (Node A: -31)"
    Options = RssiDistancesOptions
    folders: ClassVar[bool] = True

    def sniff(self, head: bytes, path: Path) -> float:
        """A folder whose text files have rows ``Node A: -31``; or one such file."""
        if path.is_dir():
            files = sorted(path.glob("*.txt"))
            return 0.9 if files and all(_ROW.match(_first_row(f)) for f in files[:3]) else 0.0
        rows = [r for r in head[:2000].decode("utf-8", "replace").splitlines() if r.strip()][:5]
        return 0.8 if len(rows) > 2 and all(_ROW.match(r) for r in rows) else 0.0

    def read(self, paths: Sequence[Path], options: RssiDistancesOptions) -> Import:
        """Read a folder, or single files of one."""
        files = [f for p in paths for f in (sorted(p.glob("*.txt")) if p.is_dir() else [p])]
        if not files:
            raise MarchaError(f"{paths[0]}: the folder has no .txt file")
        for file in files:
            _first_row(file)  # a file that is not there is named before anything else
        report = ReportBuilder()
        folder = files[0].resolve().parent
        technology = technology_of(options.technology or folder.name)
        if technology == "unknown":
            raise UsageError(f"{folder}: its name says no technology; give technology=wifi, ble or zigbee")
        sheet, stated = _sheet(folder, technology, options)
        metres = _distances(files, options, stated)
        points: list[SurveyPoint] = []
        for file in sorted(files, key=lambda f: metres[f]):
            powers_of = _parse(file, report)
            for node, powers in powers_of.items():
                powers = signed_powers(powers, file.name, report)
                where = (metres[file], 0.0, 0.0)
                points.append(
                    SurveyPoint(where, {local_address(f"{technology} {node}"): (technology, powers)})
                )
        nodes = {m for p in points for m in p.powers}
        if stated:
            ours = {
                metres[f]: np.concatenate([v for _, v in _powers_at(points, metres[f])]).mean() for f in files
            }
            label = f"{folder.name} text files against {sheet.name if sheet else 'the spreadsheet'}"
            compare_powers(ours, {d: p for d, p in stated.values() if p is not None}, label, report)
        names = {local_address(f"{technology} {n}"): n for n in _nodes(files)}
        anchors = [
            {"mac": m, "technology": technology, "x": 0.0, "y": 0.0, "name": names[m]} for m in sorted(nodes)
        ]
        return survey_import(points, anchors, report, "distances along the x axis from the anchor, m")


def _powers_at(points: Sequence[SurveyPoint], metres: float) -> list[tuple[str, Sequence[float]]]:
    return [v for p in points if p.where[0] == metres for v in p.powers.values()]


def _first_row(path: Path) -> str:
    return next((r for r in read_text(path).splitlines() if r.strip()), "")


def _nodes(files: Sequence[Path]) -> list[str]:
    return sorted({m["node"] for f in files for r in read_text(f).splitlines() if (m := _ROW.match(r))})


def _parse(path: Path, report: ReportBuilder) -> dict[str, list[float]]:
    powers: dict[str, list[float]] = {}
    for line, row in enumerate(read_text(path).splitlines(), start=1):
        if match := _ROW.match(row):
            powers.setdefault(match["node"], []).append(float(match["rssi"]))
        elif row.strip():
            detail = f"{path.name}: {row[:40]!r} is not 'Node A: -31'; dropped"
            report.drop("bad_row", detail, line=line, subject=path.name)
    if not powers:
        raise MarchaError(f"{path}: no row 'Node A: -31'; nothing to convert")
    return powers


Stated = dict[int, tuple[float, float | None]]


def _sheet(folder: Path, technology: str, options: RssiDistancesOptions) -> tuple[Path | None, Stated]:
    """Return the spreadsheet and by point its distance and, where stated, its power."""
    if options.spreadsheet is not None:
        candidates = [Path(options.spreadsheet)]
    else:
        around = [f for d in (folder, folder.parent, folder.parent.parent) for f in sorted(d.glob("*.xlsx"))]
        candidates = [f for f in around if is_workbook(f)]
    fitting: list[tuple[Path, Stated]] = []
    for file in candidates:
        for name, table in read_workbook(file).items():
            columns = {c.strip().lower(): c for c in table.columns}
            if technology_of(name) != technology or not {"distance", "point"} <= set(columns):
                continue
            rows = table.filter(
                pl.col(columns["point"]).is_not_null() & pl.col(columns["distance"]).is_not_null()
            )
            power = rows[columns["rssi"]].to_list() if "rssi" in columns else [None] * rows.height
            stated = zip(
                rows[columns["point"]].to_list(), rows[columns["distance"]].to_list(), power, strict=True
            )
            fitting.append((file, {int(k): (float(d), p) for k, d, p in stated}))
    if len(fitting) > 1:
        raise UsageError(
            f"{folder}: {len(fitting)} spreadsheets say distances of {technology}; name one: spreadsheet=…"
        )
    if not fitting and options.spreadsheet is not None:
        raise UsageError(
            f"{options.spreadsheet}: no sheet of {technology} with the columns Distance and Point"
        )
    return fitting[0] if fitting else (None, {})


def _distances(files: Sequence[Path], options: RssiDistancesOptions, stated: Stated) -> dict[Path, float]:
    """Return the distance of each file.

    Raises
    ------
    UsageError
        Nothing says it.
    """
    try:
        listed = [float(d) for d in options.distances.split(",") if d.strip()]
    except ValueError:
        raise UsageError(f"distances={options.distances!r}: metres between commas") from None
    distances: dict[Path, float] = {}
    for file in files:
        if match := _METRES.match(file.stem):
            distances[file] = float(match["metres"])
        elif file.stem.isdigit() and 1 <= int(file.stem) <= len(listed):
            distances[file] = listed[int(file.stem) - 1]
        elif file.stem.isdigit() and int(file.stem) in stated:
            distances[file] = stated[int(file.stem)][0]
        else:
            raise UsageError(
                f"{file}: nothing says how far point {file.stem} is; give distances=0.1,0.2,… or spreadsheet=FILE.xlsx"
            )
        if distances[file] <= 0:
            raise UsageError(f"{file}: a distance is positive, not {distances[file]:g} m")
    return distances
