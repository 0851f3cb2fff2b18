"""CSV of one inertial sensor a file, whose header names time, acceleration and rate with their units.

For loggers without a format of their own: ``time_ms,ax_g,…,gx_dps,…``, ``Tempo (ms);Aceleração X (g);…``. Words
are English or Portuguese; units stand in the header or are said by an option, and are never guessed.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterator, Sequence
from functools import lru_cache
from itertools import chain
from pathlib import Path
from typing import Annotated, ClassVar, NamedTuple

import msgspec
import polars as pl

from ...recording.errors import MarchaError, UsageError
from ..columns import Header, find_header, float_blocks, require_header, with_ticks
from ..contract import CommonOptions, Import, ReportBuilder
from ..inertial import (
    ACC,
    FIELD,
    GYR,
    IMU,
    MAG,
    SI,
    ChannelColumns,
    SourceColumn,
    complete,
    note_unused,
    segments_of,
    tables,
)
from ..leg import Segments
from ..timestamps import TimestampRepair
from ..units import conversion

WANTED = "time_ms,ax_g,ay_g,az_g,gx_dps,gy_dps,gz_dps"
_QUANTITIES = {
    "t": re.compile(r"t|time ?stamp|time|tempo|device time|sensor time"),
    "acc": re.compile(r"(?:a|acc|accel|acel|acceleration|accelerometer|aceleracao|acelerometro)"),
    "gyr": re.compile(
        r"(?:g|w|gyr|gyro|gyroscope|giro|giroscopio|omega|angular (?:rate|velocity)|velocidade angular)"
    ),
    "mag": re.compile(r"(?:m|mag|magn|magnetometer|magnetometro)"),
}
_UNIT_WORDS = {"g": "g", "mg": "mg", "ms2": "m/s2", "mps2": "m/s2", "dps": "deg/s", "degs": "deg/s"} | {
    "rads": "rad/s",
    "radps": "rad/s",
    "ut": "uT",
    "s": "s",
    "ms": "ms",
    "us": "us",
    "ns": "ns",
}
"""Units that stand behind an underscore or a blank."""
_PLACE = re.compile(r"(?i)lat(?:itude)?|lng|lon(?:g(?:itude)?)?")
_BRACKETS = re.compile(r"[\[(]([^\])]*)[\])]")
_PARTS = re.compile(r"[A-Z]?[a-z0-9]+|[A-Z]+(?![a-z])")

Unit = Annotated[str | None, msgspec.Meta(description="unit, where the header does not say")]


class InertialCsvOptions(CommonOptions, frozen=True, kw_only=True):
    """Names of the segments, one a file, and units that the header does not say.

    Attributes
    ----------
    segments : str or None
        New names.
    time_unit, acc_unit, gyr_unit, mag_unit : str or None
        Such as ``ms``, ``g``, ``deg/s``, ``uT``.
    """

    segments: Segments = None
    time_unit: Unit = None
    acc_unit: Unit = None
    gyr_unit: Unit = None
    mag_unit: Unit = None


class _Meaning(NamedTuple):
    quantity: str
    axis: str
    unit: str


class InertialCsv:
    """Importer ``inertial-csv``: ``/leg/<segment>/imu``, and ``…/mag`` where there is a magnetometer."""

    name: ClassVar[str] = "inertial-csv"
    title: ClassVar[str] = "CSV of one inertial sensor a file, units in its header (English, Portuguese)"
    Options = InertialCsvOptions
    joins: ClassVar[bool] = True

    def sniff(self, head: bytes, path: Path) -> float:
        """A time, three axes of acceleration and three of angular rate; formats of known devices go first."""
        return 0.5 if find_header(head, _is_header) else 0.0

    def read(self, paths: Sequence[Path], options: InertialCsvOptions) -> Import:
        """Read the sensors of one session: their times are taken to be of one clock."""
        report = ReportBuilder()
        names = segments_of(paths, options.segments, report)
        plans: list[ChannelColumns] = []
        streams: list[Iterator[tuple[str, pl.DataFrame]]] = []
        for path, segment in zip(paths, names, strict=True):
            header = require_header(path, _is_header, WANTED)
            columns = _columns(path, header, options)
            of_file = _plans(segment, columns)
            used = [columns["t"].name, *(s.name for p in of_file for s in p.columns.values())]
            note_unused(header.names, used, report, header.line)
            frames = _frames(path, header, columns["t"], report)
            streams.append(tables(path, frames, of_file, TimestampRepair(report, tick_ns=1), report))
            plans += of_file
        return Import(
            channels=[p.spec() for p in plans],
            blocks=chain.from_iterable(streams),
            report=report,
            metadata={
                "device": {
                    "clock": "device",
                    "time": "the files' time column",
                    "name": "inertial sensors, a CSV each",
                    "frames": "sensors: their own axes",
                }
            },
        )


def _plans(segment: str, columns: dict[str, SourceColumn]) -> list[ChannelColumns]:
    frame = f"{segment}_imu"
    inertial = complete(columns, ACC) | complete(columns, GYR)
    plans = [ChannelColumns(f"/leg/{segment}/imu", IMU, inertial, frame)]
    if field := complete(columns, FIELD):
        plans.append(ChannelColumns(f"/leg/{segment}/mag", MAG, field, frame))
    return plans


@lru_cache(maxsize=1024)
def _meaning(name: str) -> _Meaning | None:
    """Return quantity, axis ('' of time) and unit (where it is not said) of a column; None of any other."""
    bracket = _BRACKETS.search(name)
    unit = bracket[1].strip() if bracket else ""
    bare = unicodedata.normalize("NFKD", _BRACKETS.sub(" ", name)).encode("ascii", "ignore").decode()
    words = [w.lower() for w in _PARTS.findall(bare)]
    if not unit and len(words) > 1 and words[-1] in _UNIT_WORDS:
        unit = _UNIT_WORDS[words.pop()]
    text = " ".join(words)
    if _QUANTITIES["t"].fullmatch(text):
        return _Meaning("t", "", unit)
    if match := re.fullmatch(r"(.+?) ?([xyz])", text):
        for quantity in ("acc", "gyr", "mag"):
            if _QUANTITIES[quantity].fullmatch(match[1]):
                return _Meaning(quantity, match[2], unit)
    return None


def _is_header(cells: Sequence[str]) -> bool:
    if any(_PLACE.fullmatch(c.strip()) for c in cells):  # a phone's log, which an importer of its own reads
        return False
    named = [f"{m.quantity}_{m.axis}" for c in cells if (m := _meaning(c))]
    return len(set(named)) == len(named) and {"t_", *ACC, *GYR} <= set(named)


def _columns(path: Path, header: Header, options: InertialCsvOptions) -> dict[str, SourceColumn]:
    """Return the columns of time (``t``), ``acc_x`` … with their factors to SI.

    Raises
    ------
    MarchaError
        A unit is unknown, or is neither in the header nor stated.
    """
    stated = {
        "t": options.time_unit,
        "acc": options.acc_unit,
        "gyr": options.gyr_unit,
        "mag": options.mag_unit,
    }
    usual = {"t": "time_unit=ms", "acc": "acc_unit=g", "gyr": "gyr_unit=deg/s", "mag": "mag_unit=uT"}
    columns: dict[str, SourceColumn] = {}
    silent: dict[str, str] = {}
    for name in header.names:
        meaning = _meaning(name)
        if meaning is None:
            continue
        quantity = meaning.quantity
        unit = meaning.unit or stated[quantity]
        if unit is None:
            silent.setdefault(quantity, name)
            continue
        try:
            factor, _ = conversion(re.sub(r"^gra?us?/", "deg/", unit), SI[quantity])
        except UsageError as error:
            raise MarchaError(f"{path}, line {header.line}: column {name!r}: {error}") from None
        columns[f"{quantity}_{meaning.axis}".rstrip("_")] = SourceColumn(name, factor)
    if silent:
        raise MarchaError(
            f"{path}, line {header.line}: no unit in {', '.join(repr(n) for n in silent.values())}; say it, for "
            f"example {' '.join('--set ' + usual[q] for q in silent)}"
        )
    return columns


def _frames(path: Path, header: Header, time: SourceColumn, report: ReportBuilder) -> Iterator[pl.DataFrame]:
    for frame in float_blocks(path, header, time.name, report):
        yield with_ticks(frame, time.name, time.factor, report).drop(time.name)
