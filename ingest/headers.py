"""Small tables whose header says what is what: separator, roles of columns, units of time.

For tables of loggers whose names and order vary. What is not understood is an error that shows the header and how
to name its columns (option ``columns``).
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import polars as pl

from ..recording.errors import MarchaError, UsageError
from .contract import ReportBuilder
from .text import BOM, start_of, text_lines

UNIT = re.compile(r"[\[(]([^\])]*)[\])]")
DECIMAL_COMMA = r"^([+-]?\d+),(\d+)$"
_BETWEEN = re.compile(r"[\s_\-.:]+")
SECONDS = {"s": 1.0, "sec": 1.0, "seconds": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9}
EPOCHS = ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3), (1e8, 1.0))
"""Least number of a time since 1970, and its unit in seconds: 1973 to 5138 in each."""
RATES = (4.0, 600.0)
"""Rates (Hz) of inertial sensors: they span less than a factor of 1000, so that one unit of time fits."""

Roles = Mapping[str, str]
"""Role of a column to the regular expression that its name, in lower case and without unit, matches whole."""


@dataclass(frozen=True)
class TableHeader:
    """The first line of a table.

    Attributes
    ----------
    separator : str
        ``,``, ``;`` or a tab.
    names : tuple of str
        As they stand there.
    """

    separator: str
    names: tuple[str, ...]

    def roles(self, roles: Roles, named: Mapping[str, str] | None = None) -> dict[str, int]:
        """Return the place of each role that the header has; ``named`` (role to name) goes first."""
        columns: dict[str, int] = {}
        for role, name in (named or {}).items():
            if role in roles and name in self.names:
                columns[role] = self.names.index(name)
        for i, name in enumerate(self.names):
            if i not in columns.values():
                bare = plain(name)
                role = next((r for r, p in roles.items() if r not in columns and re.fullmatch(p, bare)), None)
                if role is not None:
                    columns[role] = i
        return columns


@lru_cache(maxsize=1024)
def plain(name: str) -> str:
    """Return a column's name in lower case, without unit, words apart by one blank."""
    bare = UNIT.sub(" ", name.strip().strip('"').lower())
    return _BETWEEN.sub(" ", bare).strip()


def header_of(head: bytes) -> TableHeader | None:
    """Return the header of a text table; None where the first line is none."""
    line = head.removeprefix(BOM).split(b"\n", 1)[0].strip(b"\r")
    try:
        text = line.decode("utf-8")
    except UnicodeDecodeError:
        return None
    separator = max(",;\t", key=text.count)
    names = tuple(c.strip().strip('"') for c in text.split(separator))
    return TableHeader(separator, names) if len(names) > 1 and all(names) and not _number(names[0]) else None


def named_columns(text: str) -> dict[str, str]:
    """Return ``role=name,role=name`` as a mapping.

    Raises
    ------
    UsageError
        It is not written so.
    """
    columns: dict[str, str] = {}
    for part in filter(None, (p.strip() for p in text.split(","))):
        role, equals, name = part.partition("=")
        if not equals:
            raise UsageError(f"columns: {part!r} is not role=name, such as time=ts,rssi=level")
        columns[role.strip()] = name.strip()
    return columns


def read_cells(
    path: Path, places: Mapping[str, int], header: TableHeader, report: ReportBuilder
) -> pl.DataFrame:
    """Return all cells of a table, as :func:`cell_windows` reads them."""
    return pl.concat(cell_windows(path, places, header, report))


def cell_windows(
    path: Path, places: Mapping[str, int], header: TableHeader, report: ReportBuilder
) -> Iterator[pl.DataFrame]:
    """Yield the cells of a table as text by role, with ``line``; rows of another width are dropped and said.

    Raises
    ------
    MarchaError
        The file cannot be read or has no row.
    """
    width, commas, empty = len(header.names), 0, True
    for first, lines in text_lines(path, 1):
        rows = pl.DataFrame(
            {"row": pl.Series(lines, dtype=pl.String), "line": np.arange(first, first + len(lines))}
        ).filter(pl.col("row").str.strip_chars() != "")
        if rows.is_empty():
            continue
        empty = False
        fits = rows["row"].str.count_matches(header.separator, literal=True) == width - 1
        if not fits.all():
            bad = rows.filter(~fits)
            report.drop(
                "bad_row",
                f"{path.name}: {bad['row'][0][:40]!r}: not {width} cells as the header has; dropped",
                count=bad.height,
                line=bad["line"][0],
                subject=path.name,
            )
        rows = rows.filter(fits)
        parts = rows["row"].str.split_exact(header.separator, width - 1).struct.unnest()
        cells = {role: parts[f"field_{i}"].str.strip_chars(' "') for role, i in places.items()}
        if header.separator != ",":
            count = sum(int(text.str.contains(DECIMAL_COMMA).sum()) for text in cells.values())
            if count:
                commas += count
                cells = {r: text.str.replace(DECIMAL_COMMA, "${1}.${2}") for r, text in cells.items()}
        yield pl.DataFrame({"line": rows["line"], **cells})
    if empty:
        raise MarchaError(f"{path}: a header and no row; nothing to convert")
    report.note("decimal_comma", f"{path.name}: decimal commas are read as points", count=commas)


def numbers(cells: pl.DataFrame, roles: tuple[str, ...], path: Path, report: ReportBuilder) -> pl.DataFrame:
    """Return cells with these roles as floats; empty ones are NaN, what is no number becomes NaN and is said."""
    for role in roles:
        text = cells[role]
        value = text.cast(pl.Float64, strict=False)
        empty = text == ""
        broken = (value.is_null() & ~empty).to_numpy()
        if empty.any():
            first = int(empty.arg_true()[0])
            report.note(
                "missing_cell",
                f"{path.name} {role}: no value",
                count=int(empty.sum()),
                line=cells["line"][first],
                subject=f"{path.name} {role} empty",
            )
        if broken.any():
            first = int(np.flatnonzero(broken)[0])
            report.repair(
                "missing_cell",
                f"{path.name} {role}: {text[first]!r} is no number: no value",
                count=int(broken.sum()),
                line=cells["line"][first],
                subject=f"{path.name} {role}",
            )
        cells = cells.with_columns(value.fill_null(np.nan).alias(role))
    return cells


@dataclass(frozen=True)
class TimeUnit:
    """How a table writes time.

    Attributes
    ----------
    seconds : float
        One unit in seconds; 0 for a calendar time.
    clock : str
        ``unix`` or ``device``.
    """

    seconds: float
    clock: str


def time_unit(
    cells: pl.DataFrame, name: str, path: Path, report: ReportBuilder, *, of: str = ""
) -> TimeUnit | None:
    """Return the unit of a column of times; None where neither header, size nor rate tells.

    Parameters
    ----------
    cells : polars.DataFrame
        ``time`` as text.
    name : str
        The column's name: a unit in brackets or behind an underscore counts.
    path : Path
        File, for messages.
    report : ReportBuilder
        Told a unit that follows from the rate alone (``assumed_unit``).
    of : str
        Column that tells sensors apart, so that the rate is that of one.
    """
    first = cells["time"].cast(pl.Float64, strict=False)
    if first.null_count() > 0.5 * first.len():
        return TimeUnit(0.0, "unix")
    values = first.drop_nulls()
    size = float(np.median(values.to_numpy()))
    clock = "unix" if any(size >= least for least, _ in EPOCHS) else "device"
    unit_name = (UNIT.findall(name.lower()) or [re.split(r"[_\s]", name.lower())[-1]])[-1].strip()
    if unit_name in SECONDS:
        unit = SECONDS[unit_name]
        return TimeUnit(unit, "unix" if size * unit >= 1e8 else "device")
    if clock == "unix":
        return TimeUnit(next(unit for least, unit in EPOCHS if size >= least), "unix")
    steps = cells.with_columns(pl.col("time").cast(pl.Float64, strict=False)).drop_nulls("time")
    steps = steps.with_columns(d=pl.col("time").diff().over(of) if of else pl.col("time").diff())
    between = steps.filter(pl.col("d") > 0)["d"].to_numpy()
    middle = float(np.median(between)) if between.size else 0.0
    unit = next(
        (u for u in (1.0, 1e-3, 1e-6, 1e-9) if middle and RATES[0] <= 1 / (middle * u) <= RATES[1]), None
    )
    if unit is None:
        return None
    word = {1.0: "s", 1e-3: "ms", 1e-6: "µs", 1e-9: "ns"}[unit]
    report.note(
        "assumed_unit",
        f"{path.name} {name}: neither header nor size says the unit of time: {word}, by the sensors' rate",
    )
    return TimeUnit(unit, "device")


def times_ns(cells: pl.DataFrame, unit: TimeUnit, path: Path, report: ReportBuilder) -> pl.DataFrame:
    """Return the cells with ``t_ns`` for ``time``; rows without a time are dropped and said.

    Whole and fractional parts are read apart: an epoch in nanoseconds does not fit a float.
    """
    text = cells["time"]
    if unit.seconds == 0.0:
        when = (
            text.str.strip_suffix("Z")
            .str.replace("T", " ")
            .str.to_datetime(time_unit="ns", strict=False, format="%Y-%m-%d %H:%M:%S%.f")
        )
        t = when.cast(pl.Int64)
    else:
        # units per nanosecond as whole numbers; fractions beyond a nanosecond are cut
        digits = {1.0: 9, 1e-3: 6, 1e-6: 3, 1e-9: 0}[unit.seconds]
        plainly = text.str.contains(r"^[+-]?\d+(\.\d*)?$")
        whole = text.str.extract(r"^([+-]?\d+)", 1).cast(pl.Int64, strict=False)
        fraction = (
            (text.str.extract(r"\.(\d*)$", 1).fill_null("") + "0" * digits).str.slice(0, digits)
            if digits
            else pl.Series(["0"] * len(text), dtype=pl.String)
        )
        exact = whole * 10**digits + fraction.cast(pl.Int64, strict=False).fill_null(0)
        rough = (
            (text.cast(pl.Float64, strict=False) * (unit.seconds * 1e9)).round(0).cast(pl.Int64, strict=False)
        )
        t = pl.select(pl.when(plainly & ~text.str.starts_with("-")).then(exact).otherwise(rough)).to_series()
    lost = t.is_null()
    if lost.any():
        first = int(lost.arg_true()[0])
        report.drop(
            "bad_row",
            f"{path.name}: time {text[first]!r} cannot be read; row dropped",
            count=int(lost.sum()),
            line=cells["line"][first],
            subject=f"{path.name} time",
        )
    return cells.with_columns(t.alias("t_ns")).filter(~lost).drop("time")


def head_of(path: Path) -> TableHeader | None:
    """Return the header of a file; None where it is no table with one."""
    return header_of(start_of(path))


def _number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
