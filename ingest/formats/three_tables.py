"""The three tables of a hybrid indoor positioning logger: inertial readings, signal strengths, anchors.

``timestamp, sensor, x, y, z`` (accelerometer with gravity in m/s², magnetometer in µT, orientation in degrees),
``timestamp, mac, rssi`` (dBm) and ``mac, rssi at 1 m, eta, x, y``, with the floor plan beside them: a folder, or the
files given together. Columns are found by their header, in whatever order, names and unit of time; the option
``columns`` names those that are not.

Source: hybrid indoor positioning, chapter 5 (its headers are pictures).
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import msgspec
import numpy as np
import polars as pl

from ...recording.errors import MarchaError, UsageError
from ..anchors import is_anchor_header
from ..checks import SensorCheck, check_plausible
from ..contract import ChannelSpec, CommonOptions, Import, ReportBuilder
from ..floor import kind_of
from ..headers import (
    TableHeader,
    TimeUnit,
    cell_windows,
    head_of,
    header_of,
    named_columns,
    numbers,
    time_unit,
    times_ns,
)
from ..inertial import ACC, FIELD, GYR, IMU, MAG
from ..phonelog import AXES, QUATERNION, quaternion_of
from ..radio import RADIO, local_address, ordered, signed_powers, technology_of, without_stale
from ..timestamps import nanoseconds

TIME = r"(time|time ?stamp|t|ts|date|datetime|instant|tempo|epoch)( (ns|us|µs|ms|s))?"
INERTIAL = {
    "time": TIME,
    "sensor": r"sensor|sensor (type|name)|type|kind",
    "x": r"x|(value|values|v) ?0|axis x|x axis|x value",
    "y": r"y|(value|values|v) ?1|axis y|y axis|y value",
    "z": r"z|(value|values|v) ?2|axis z|z axis|z value",
}
SIGNALS = {
    "time": TIME,
    "mac": r"mac|mac address|bssid|address|beacon|device|ap|anchor",
    "rssi": r"rssi|rss|level|power|signal|signal strength|strength|dbm|rssi dbm",
    "technology": r"technology|tech|type|kind|radio",
    "seen": r"(last )?seen|last seen (ns|us|ms|s)|last ?heard",
    "frequency": r"frequency|freq|channel frequency",
}
SENSORS = {"acc": r"acc.*", "mag": r"mag.*", "orientation": r"ori.*", "gyr": r"gyr.*"}
MICROTESLA = 1e-6
AXIS_ORDERS = {"x": (0, 1, 2), "z": (2, 0, 1), "y": (1, 0, 2)}
"""Columns of azimuth, pitch and roll by that of the azimuth."""
_CHANNELS: dict[str, tuple[str, str, dict[str, str]]] = {
    "acc": ("/phone/acc", IMU, {"gravity": "included"}),
    "mag": ("/phone/mag", MAG, {}),
    "orientation": (
        "/phone/orientation",
        QUATERNION,
        {"north": "magnetic", "source": "azimuth, pitch, roll in degrees"},
    ),
    "gyr": ("/phone/gyr", IMU, {}),
}
"""Topic, schema and metadata of each sensor."""


class ThreeTablesOptions(CommonOptions, frozen=True, kw_only=True):
    """How the tables are written, where their headers do not say it.

    Attributes
    ----------
    columns : str
        ``role=name`` of columns that are not found by their header: time, sensor, x, y, z, mac, rssi, technology,
        seen, frequency.
    time_unit : str
        Unit of the times, where neither header, size nor rate tells it.
    azimuth : str
        Column of the orientation that is the azimuth, where no column runs over 0 to 360.
    """

    columns: Annotated[
        str, msgspec.Meta(description="role=name,… of columns that the header does not say")
    ] = ""
    time_unit: Annotated[
        Literal["s", "ms", "us", "ns"] | None,
        msgspec.Meta(description="unit of the times, where nothing tells it"),
    ] = None
    azimuth: Annotated[
        Literal["x", "y", "z"] | None, msgspec.Meta(description="the azimuth's column of the orientation")
    ] = None


class ThreeTables:
    """Importer ``three-tables``: ``/phone/acc``, ``/phone/mag``, ``/phone/orientation``, ``/phone/radio``."""

    name: ClassVar[str] = "three-tables"
    title: ClassVar[str] = "inertial, radio and anchor tables (CSV with headers) with the floor plan"
    Options = ThreeTablesOptions
    joins: ClassVar[bool] = True
    folders: ClassVar[bool] = True
    floors: ClassVar[bool] = True

    def sniff(self, head: bytes, path: Path) -> float:
        """A header with sensor, x, y, z or with address and power beside the time; a folder with both tables."""
        if path.is_dir():
            kinds = {_kind(head_of(f), f) for f in path.iterdir() if f.is_file() and f.suffix != ".toml"}
            return 0.95 if len(kinds & {"inertial", "radio", "anchors"}) > 1 else 0.0
        header = header_of(head)
        if (kind := _kind(header, path)) not in ("inertial", "radio"):
            return 0.0
        assert header is not None
        row = head.split(b"\n", 2)[1].decode("utf-8", "replace") if head.count(b"\n") > 1 else ""
        cells = [c.strip(' "\r') for c in row.split(header.separator)]
        places = header.roles(INERTIAL if kind == "inertial" else SIGNALS)
        if kind == "radio":
            return 0.85
        word = cells[places["sensor"]].lower() if places["sensor"] < len(cells) else ""
        return 0.9 if any(re.search(p, word) for p in SENSORS.values()) else 0.0

    def read(self, paths: Sequence[Path], options: ThreeTablesOptions) -> Import:
        """Read the tables of one walk."""
        files = [f for p in paths for f in (sorted(p.iterdir()) if p.is_dir() else [p]) if f.is_file()]
        named = named_columns(options.columns)
        report = ReportBuilder()
        tables: dict[str, tuple[Path, TableHeader]] = {}
        beside = [f for f in files if kind_of(f)]
        for file in files:
            if file in beside or (file.suffix in (".toml", ".md", ".txt") and head_of(file) is None):
                continue
            header = head_of(file)
            kind = _kind(header, file, named)
            if not kind or header is None:
                columns = f" (columns {', '.join(header.names)[:60]})" if header is not None else ""
                report.note(
                    "unused_file",
                    f"{file.name}: no table that is known{columns}: left out; an anchor table has mac, x, y",
                    subject=file.name,
                )
            elif kind in tables:
                raise UsageError(
                    f"{file}: {tables[kind][0].name} is the {kind} table already; convert walks one by one"
                )
            else:
                tables[kind] = file, header
        if not tables:
            _refuse(files, paths)
        made, clock = _read(tables, named, options, report)
        metadata = {
            "device": {
                "clock": clock,
                "name": "three tables",
                "frames": AXES,
                "converted": "magnetic field from µT, orientation from degrees",
                "reference_frame": "the plan's x and y, m",
            }
        }
        specs = [ChannelSpec(t, s, "phone", metadata=m) for t, (s, m, _) in made.items()]
        return Import(
            channels=specs,
            blocks=((t, table) for t, (*_, tables) in made.items() for table in tables),
            report=report,
            metadata=metadata,
        )


Made = dict[str, tuple[str, dict[str, str], Iterable[pl.DataFrame]]]
ROWS = 65_536
"""Rows of a sensor that are looked at together."""


def _read(
    tables: dict[str, tuple[Path, TableHeader]],
    named: dict[str, str],
    options: ThreeTablesOptions,
    report: ReportBuilder,
) -> tuple[Made, str]:
    """Return schema, metadata and tables by topic, and the clock."""
    made: Made = {}
    unit: TimeUnit | None = None
    for kind, roles, of in (("inertial", INERTIAL, "sensor"), ("radio", SIGNALS, "")):
        if kind not in tables:
            continue
        path, header = tables[kind]
        places = header.roles(roles, named)
        windows = cell_windows(path, places, header, report)
        first = next(windows)
        own = _unit(first, header.names[places["time"]], path, options, report, of=of) or unit
        if own is None:
            raise UsageError(f"{path}: nothing says the unit of time; give time_unit=s, ms, us or ns")
        if unit is not None and own.clock != unit.clock:
            raise MarchaError(
                f"{path}: its times are those of another clock than the inertial table's (one since 1970, one not); "
                "write both by one clock"
            )
        unit = own
        timed = (times_ns(cells, own, path, report) for cells in chain([first], windows))
        if kind == "inertial":
            made |= _inertial(timed, path, options, report)
        else:
            made |= _radio(pl.concat(timed), unit, path, report)
    return made, unit.clock if unit is not None else "device"


def _kind(header: TableHeader | None, path: Path, named: dict[str, str] | None = None) -> str:
    """Return ``inertial``, ``radio`` or ``anchors`` of a header; empty for none of them."""
    if header is None:
        return ""
    if {"time", "sensor", "x", "y", "z"} <= set(header.roles(INERTIAL, named)):
        return "inertial"
    if is_anchor_header(header):
        return "anchors"
    return "radio" if {"time", "mac", "rssi"} <= set(header.roles(SIGNALS, named)) else ""


def _refuse(files: Sequence[Path], paths: Sequence[Path]) -> None:
    for file in files:
        header = head_of(file)
        if header is not None:
            raise MarchaError(
                f"{file}, line 1: columns {', '.join(header.names)[:80]!r} are neither time, sensor, x, y, z nor time, "
                "mac, rssi; name them with columns=time=…,mac=…,rssi=…"
            )
    raise MarchaError(f"{files[0] if files else paths[0]}: no table with a header; nothing to convert")


def _unit(
    cells: pl.DataFrame, name: str, path: Path, options: ThreeTablesOptions, report: ReportBuilder, *, of: str
) -> TimeUnit | None:
    if options.time_unit is not None:
        seconds = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}[options.time_unit]
        middle = cells["time"].cast(pl.Float64, strict=False).median()
        return TimeUnit(
            seconds, "unix" if isinstance(middle, float) and middle * seconds >= 1e8 else "device"
        )
    if of:
        return time_unit(cells, name, path, report, of=of)
    # powers come at no rate: the unit follows from header or size, else it is that of the inertial table
    return time_unit(cells.head(1), name, path, report)


def _inertial(
    windows: Iterable[pl.DataFrame], path: Path, options: ThreeTablesOptions, report: ReportBuilder
) -> Made:
    parts: dict[str, list[pl.DataFrame]] = {kind: [] for kind in SENSORS}
    for window in windows:
        cells = numbers(window, ("x", "y", "z"), path, report)
        word = cells["sensor"].str.to_lowercase()
        kinds = pl.select(
            pl.coalesce(pl.when(word.str.contains(p)).then(pl.lit(k)) for k, p in SENSORS.items())
        ).to_series()
        unread = kinds.is_null()
        if unread.any():
            first = int(unread.arg_true()[0])
            report.drop(
                "unused_row",
                f"{path.name}: sensor {cells['sensor'][first]!r} is not imported",
                count=int(unread.sum()),
                line=cells["line"][first],
                subject=f"{path.name} sensor",
            )
        for kind, held in parts.items():
            own = cells.filter(kinds == kind).drop("sensor")
            held.append(own.filter(pl.all_horizontal(pl.col("x", "y", "z").is_finite())))
            report.drop(
                "bad_row",
                f"{path.name} {kind}: a value is missing: row dropped",
                count=own.height - held[-1].height,
                subject=f"{path.name} {kind}",
            )
    made: Made = {}
    for kind in SENSORS:
        part = pl.concat(parts.pop(kind))
        if part.is_empty():
            continue
        part = ordered(part, f"{path.name} {kind}", report)
        report.keep(part.height)
        topic, schema, about = _CHANNELS[kind]
        order = _order(part, path, options, report) if kind == "orientation" else AXIS_ORDERS["x"]
        made[topic] = schema, about, _tables(kind, part, order, report)
    return made


def _tables(
    kind: str, part: pl.DataFrame, order: Sequence[int], report: ReportBuilder
) -> Iterator[pl.DataFrame]:
    """Yield the tables of one sensor, its readings checked."""
    topic = _CHANNELS[kind][0]
    names = {"acc": ACC, "gyr": GYR, "mag": FIELD}.get(kind, ())
    check = SensorCheck(report, topic, names) if kind in ("acc", "gyr") else None
    for rows in part.iter_slices(ROWS):
        xyz = rows.select("x", "y", "z").to_numpy()
        lines = rows["line"].to_numpy().astype(np.int64)
        t = rows.select("t_ns")
        if kind == "orientation":
            azimuth, pitch, roll = (np.radians(xyz[:, k]) for k in order)
            yield t.with_columns(pl.Series(k, v) for k, v in quaternion_of(azimuth, pitch, roll).items())
            continue
        if check is not None:
            columns = [np.ascontiguousarray(c) for c in xyz.T]
            check.feed(list(xyz.T), lines)
            check.feed_si(columns if kind == "acc" else (), columns if kind == "gyr" else (), lines)
        else:
            xyz = xyz * MICROTESLA
            check_plausible(report, topic, {c: xyz[:, i] for i, c in enumerate(names)}, lines)
        yield t.with_columns(pl.Series(c, xyz[:, i]) for i, c in enumerate(names))
    if check is not None:
        check.finish()


def _order(
    part: pl.DataFrame, path: Path, options: ThreeTablesOptions, report: ReportBuilder
) -> Sequence[int]:
    """Return the columns of azimuth, pitch, roll: the one that runs over 0 to 360 is the azimuth.

    Android gives azimuth, pitch, roll; the source's text names them by axis: x pitch, y roll, z azimuth.
    """
    if options.azimuth is not None:
        return AXIS_ORDERS[options.azimuth]
    wide = part.select((pl.col("x", "y", "z").max() > 180.0) & (pl.col("x", "y", "z").min() >= 0.0)).row(
        0, named=True
    )
    if sum(wide.values()) == 1:
        return AXIS_ORDERS[next(a for a, runs in wide.items() if runs)]
    report.note(
        "axis_doubt",
        f"{path.name} orientation: no single column runs over 0 to 360, so none is surely the azimuth: Android's "
        "order azimuth, pitch, roll is taken; give azimuth=x, y or z where it is another",
    )
    return AXIS_ORDERS["x"]


def _radio(cells: pl.DataFrame, unit: TimeUnit, path: Path, report: ReportBuilder) -> Made:
    cells = numbers(cells, tuple(r for r in ("rssi", "frequency") if r in cells.columns), path, report)
    empty = (cells["mac"] == "") | ~cells["rssi"].is_finite()
    if empty.any():
        report.drop(
            "bad_row",
            f"{path.name}: a row without address or power; dropped",
            count=int(empty.sum()),
            line=cells["line"][int(empty.arg_true()[0])],
            subject=f"{path.name} empty",
        )
        cells = cells.filter(~empty)
    cells = cells.with_columns(
        rssi=pl.Series(signed_powers(cells["rssi"].to_list(), path.name, report), dtype=pl.Float64),
        mac=pl.Series([local_address(m) for m in cells["mac"].to_list()], dtype=pl.String),
        seen=_seen(cells, unit),
    )
    positive = cells["rssi"] > 0
    if positive.any():
        first = int(positive.arg_true()[0])
        report.drop(
            "bad_power",
            f"{path.name}: {cells['rssi'][first]:g} dBm among negative powers; row dropped",
            count=int(positive.sum()),
            line=cells["line"][first],
        )
        cells = cells.filter(~positive)
    cells = without_stale(ordered(cells, path.name, report), path.name, report)
    report.keep(cells.height)
    words = cells["technology"].to_list() if "technology" in cells.columns else [""] * cells.height
    technologies = {w: technology_of(w) for w in set(words)}
    technology = pl.Series([technologies[w] for w in words], dtype=pl.String)
    table = cells.select("t_ns", "mac", rssi_dbm="rssi", last_seen_ns="seen").with_columns(
        technology=technology
    )
    if "frequency" in cells.columns:
        hertz = (
            pl.when(pl.col("frequency") < 1e5).then(pl.col("frequency") * 1e6).otherwise(pl.col("frequency"))
        )
        table = table.with_columns(cells.select(frequency_hz=hertz))
    return {"/phone/radio": (RADIO, {}, [table])}


def _seen(cells: pl.DataFrame, unit: TimeUnit) -> pl.Series:
    """Return when transmitters were last heard (ns), 0 where that is not known."""
    if "seen" not in cells.columns or unit.seconds == 0.0:
        return pl.Series("seen", np.zeros(cells.height, np.int64))
    value: Any = cells["seen"].cast(pl.Float64, strict=False).fill_null(0.0).to_numpy()
    return pl.Series("seen", nanoseconds(value, unit.seconds * 1e9))
