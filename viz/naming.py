"""How a column is called where people see it, and in which unit."""

from __future__ import annotations

from ..recording.schemas import SCHEMAS, Column
from . import style

ANGLES = ("rad", "rad/s")


def unit_of(schema: str, column: str) -> str:
    """Return the unit that a message type gives a column; empty where it says none."""
    registered = SCHEMAS.get(schema)
    columns: list[Column] = [] if registered is None else list(registered.columns)
    if registered is not None and registered.names:  # a named schema's columns are suffixes behind the name
        matching = [c for c in columns if c.name and column.endswith(c.name)]
        columns = matching or [c for c in columns if not c.name]
        return columns[0].unit if columns else ""
    return next((c.unit for c in columns if c.name == column), "")


def shown_as(column: str, unit: str = "") -> style.ColumnStyle:
    """Return how a column is shown: by its own entry in the style, in degrees where it is an angle, or with
    its unit.
    """
    if column in style.COLUMNS:
        return style.COLUMNS[column]
    if unit in ANGLES or (unit in ("", "-", "as named") and column.endswith("_rad")):
        name = column.removesuffix("_rad")
        return style.ColumnStyle(f"{name} ({'°' if unit != 'rad/s' else '°/s'})", style.DEGREES)
    unit = "" if unit in ("-", "as named") else unit
    for suffix, of_suffix in style.SUFFIXES.items():
        if not unit and column.endswith(suffix):
            return style.ColumnStyle(f"{column.removesuffix(suffix)} ({of_suffix})")
    return style.ColumnStyle(f"{column} ({unit})" if unit else column)


def unit_in(name: str) -> str:
    """Return the unit at the end of a shown name."""
    return name.rsplit("(", 1)[-1][:-1] if name.endswith(")") and "(" in name else ""
