"""Anchor tables in whatever order, names and units: they become the attachment ``anchors.csv`` (m, dBm at 1 m).

A table has a header that names at least an address, and x and y or latitude and longitude. Degrees are laid out in
metres as the plan is that is given with them, else from their own south-west corner, x to the east.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from ..recording.errors import MarchaError, UsageError
from .contract import ReportBuilder, SourceAttachment
from .headers import UNIT, TableHeader, header_of, numbers, read_cells
from .radio import anchor_table, local_address, technology_of
from .text import start_of
from .units import conversion

PLACE_WORD = r"(pos(ition)?|posi[cç][aã]o|coord(inate)?|coordenada)"
ANCHOR_ROLES = {
    "mac": r"mac|((mac|hardware) )?address|bssid",
    "x": rf"({PLACE_WORD} ?)?x( (m|cm|mm|ft))?",
    "y": rf"({PLACE_WORD} ?)?y( (m|cm|mm|ft))?",
    "z": rf"({PLACE_WORD} ?)?z( (m|cm|mm|ft))?|(height|h|altura)( (m|cm|mm|ft))?",
    "lat": r"lat(itude)?( deg)?",
    "lon": r"(lon|lng|long)(itude)?( deg)?",
    "p_d0": r"p d0|p0|rssi d0|(mean )?(rssi|power)( (at )?(1 ?m|d0))?|(measured|tx|calibrated) ?power|a",
    "eta": r"eta|η|n|exponent|path ?loss( ?exponent)?|propagation( constant)?",
    "technology": r"technology|tech|type|kind|radio|tecnologia|tipo",
    "name": r"name|label|nome",
    "floor": r"(floor|level|storey|story|andar|piso)( (no|number|nr))?",
}
NAMED = r"(beacon|anchor|node|device|ap)( (id|mac|address))?|id|uuid"
"""What stands for the address where no column is called one."""
LENGTHS = ("x", "y", "z")
NOT_ANCHORS = {"time": r"time|time ?stamp|t|t ns|ms|date", "sensor": r"sensor.*"}
"""Columns of logs, which are no anchor tables whatever else they have."""
DEGREES_SPAN = 0.05
"""Coordinates that span less than this are degrees: 0.05 m is no building, 0.05° are 5 km."""
EARTH_M = 6_378_137.0 * math.pi / 180.0
"""Metres in a degree of the sphere that web maps are drawn on."""
RECEIVED_DBM = (-100.0, -15.0)
"""What a receiver at 1 m hears: a transmitter's own power (dBm, −20 … 20 as its maker states it) is mostly above."""


@dataclass(frozen=True)
class GeographicLayout:
    """How degrees become metres of the plan.

    Attributes
    ----------
    low : tuple of float
        Longitude and latitude (°) of the plan's origin.
    scale : tuple of float
        Metres of a degree of longitude and of latitude.
    """

    low: tuple[float, float]
    scale: tuple[float, float]

    def metres(self, lon_deg: float, lat_deg: float) -> tuple[float, float]:
        """Return x, y (m) of a place, to 0.1 mm."""
        return (
            round(self.scale[0] * (lon_deg - self.low[0]), 4),
            round(self.scale[1] * (lat_deg - self.low[1]), 4),
        )


def layout_of(
    low: Sequence[float], high: Sequence[float], width_m: float | None = None, height_m: float | None = None
) -> GeographicLayout:
    """Return the layout of what lies between two corners (longitude, latitude in degrees), on its size where stated."""
    scale = [EARTH_M * math.cos(math.radians((low[1] + high[1]) / 2)), EARTH_M]
    for k, size in enumerate((width_m, height_m)):
        if size is not None and high[k] > low[k]:
            scale[k] = size / (high[k] - low[k])
    return GeographicLayout((low[0], low[1]), (scale[0], scale[1]))


def is_anchor_header(header: TableHeader) -> bool:
    """Whether a header names addresses and places, and neither times nor powers of a log."""
    there = set(header.roles(ANCHOR_ROLES))
    if not ({"x", "y"} <= there or {"lat", "lon"} <= there):
        return False  # most tables; a column that may be an address does not make one a place
    return "mac" in set(_roles(header)) and not header.roles(NOT_ANCHORS)


def doubt_of_header(head: bytes) -> str:
    """Return what is missing of a table that names addresses of beacons and no times: it may be one of anchors."""
    header = header_of(head)
    if header is None or header.roles(NOT_ANCHORS) or "mac" not in _roles(header):
        return ""
    names = ", ".join(header.names[:8])
    return f"a table of addresses without x and y, or lat and lon ({names}): name them so to have a table of anchors"


def _roles(header: TableHeader) -> dict[str, int]:
    called = header.roles(ANCHOR_ROLES)
    return called if "mac" in called else header.roles({**ANCHOR_ROLES, "mac": NAMED})


def read_anchors(
    path: Path, report: ReportBuilder, *, layout: GeographicLayout | None = None, drawn: Path | None = None
) -> tuple[SourceAttachment, tuple[str, ...], GeographicLayout | None]:
    """Return the attachment ``anchors.csv`` of a table, the addresses, and how its degrees were laid out on their own.

    Parameters
    ----------
    path : Path
        The table.
    report : ReportBuilder
        Takes what is repaired: units of length, powers without their sign, degrees.
    layout : GeographicLayout, optional
        Of the plan that is given with it, where that is in degrees.
    drawn : Path, optional
        The plan (outline or picture) that is given with it.

    Raises
    ------
    MarchaError
        A row without address or place, an address twice, or degrees beside a plan in metres; names the line.
    """
    header = header_of(start_of(path, 65536))
    places = _roles(header) if header is not None else {}
    if header is None or not is_anchor_header(header):
        raise MarchaError(
            f"{path}: no header with an address (mac) and x and y, or lat and lon; an anchor table has them"
        )
    cells = read_cells(path, places, header, report)
    wanted = tuple(r for r in (*LENGTHS, "lat", "lon", "p_d0", "eta", "floor") if r in places)
    cells = _in_metres(numbers(cells, wanted, path, report), header, places, path, report)
    cells, own = _on_the_plan(cells, path, report, layout, drawn)
    rows: list[dict[str, Any]] = []
    for row in cells.iter_rows(named=True):
        if not row["mac"] or not (math.isfinite(row["x"]) and math.isfinite(row["y"])):
            raise MarchaError(
                f"{path}, line {row['line']}: an anchor has an address, and x and y (m) or lat and lon; mend the row"
            )
        mac = local_address(row["mac"])
        if any(mac == other["mac"] for other in rows):
            raise MarchaError(f"{path}, line {row['line']}: {row['mac']} is there twice; keep one of them")
        if "p_d0" in row:
            row["p_d0"] = _received(row["p_d0"], row["line"], path, report)
        name = row.get("name") or (row["mac"] if mac != row["mac"].lower() else "")
        technology = technology_of(row.get("technology") or "")
        rows.append({**row, "mac": mac, "name": name, "technology": technology})
    return anchor_table(rows), tuple(r["mac"] for r in rows), own


def _in_metres(
    cells: pl.DataFrame, header: TableHeader, places: dict[str, int], path: Path, report: ReportBuilder
) -> pl.DataFrame:
    """Return the cells with lengths in metres: the unit stands in the column's name."""
    for role in (r for r in LENGTHS if r in places):
        name = header.names[places[role]]
        unit = (
            UNIT.findall(name) or [name.replace("_", " ").split()[-1] if " " in name or "_" in name else "m"]
        )[-1]
        try:
            factor = conversion(unit.strip().lower(), "m")[0]
        except UsageError as error:
            if UNIT.findall(name):
                raise MarchaError(f"{path}, line 1: column {name!r}: {error}") from None
            factor = 1.0  # "pos x": the last word is no unit
        if factor != 1.0:
            report.note(
                "converted_unit", f"{path.name} {name}: taken to metres", count=cells.height, subject=role
            )
            cells = cells.with_columns(pl.col(role) * factor)
    return cells


def _on_the_plan(
    cells: pl.DataFrame,
    path: Path,
    report: ReportBuilder,
    layout: GeographicLayout | None,
    drawn: Path | None,
) -> tuple[pl.DataFrame, GeographicLayout | None]:
    """Return the cells with x and y in metres of the plan, and the layout where it is the anchors' own."""
    if not {"x", "y"} <= set(cells.columns):
        lon, lat = "lon", "lat"
    else:
        placed = cells.filter(pl.col("x").is_finite() & pl.col("y").is_finite()).select("x", "y").to_numpy()
        if len(placed) < 2 or not 0 < float(np.ptp(placed, axis=0).max()) < DEGREES_SPAN:
            return cells, None
        lon, lat = "x", "y"
    good = cells.filter(pl.col(lat).is_finite() & pl.col(lon).is_finite())
    wrong = good.filter((pl.col(lat).abs() > 90) | (pl.col(lon).abs() > 180))
    if wrong.height:
        raise MarchaError(
            f"{path}, line {wrong['line'][0]}: {wrong[lat][0]:g}, {wrong[lon][0]:g} are no latitude and longitude in "
            "degrees; give x and y in metres of the plan"
        )
    own = None
    if layout is None:
        if drawn is not None:
            raise MarchaError(
                f"{path}: anchors in degrees, and {drawn.name} is in metres: nothing says how they lie on it; give x "
                "and y (m) of the anchors on the plan, or a plan in degrees (GeoJSON)"
            )
        if good.is_empty():
            raise MarchaError(
                f"{path}, line {cells['line'][0]}: an anchor has latitude and longitude; mend the row"
            )
        corners = good.select(lon, lat).to_numpy()
        layout = own = layout_of(corners.min(axis=0).tolist(), corners.max(axis=0).tolist())
    report.note(
        "degrees",
        f"{path.name}: places in degrees are laid out in metres "
        + ("from their south-west corner, x to the east" if own else "as the plan is"),
        count=cells.height,
    )
    where = [layout.metres(x, y) for x, y in cells.select(lon, lat).iter_rows()]
    return cells.with_columns(
        x=pl.Series([w[0] for w in where], dtype=pl.Float64),
        y=pl.Series([w[1] for w in where], dtype=pl.Float64),
    ), own


def _received(power: float, line: int, path: Path, report: ReportBuilder) -> float:
    """Return the power received at 1 m (dBm); a lost sign is put back, a transmitter's own power is no such power."""
    if math.isnan(power):
        return power
    low, high = RECEIVED_DBM
    if low <= -power <= high:
        report.repair(
            "repaired_sign",
            f"{path.name}: power at 1 m {power:g} is stored without its sign: taken as {-power:g} dBm",
            line=line,
            subject=f"{path.name} p_d0",
            rows=0,
        )
        return -power
    if not low <= power <= high:
        report.repair(
            "bad_power",
            f"{path.name}: {power:g} dBm is not received at 1 m ({low:g} … {high:g} dBm; a transmitter's own power?): "
            "taken as not known",
            line=line,
            subject=f"{path.name} p_d0 range",
            rows=0,
        )
        return math.nan
    return power
