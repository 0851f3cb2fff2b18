"""RTK survey as text: date, time, latitude, longitude in degrees, minutes, seconds, height.

``2015-10-30 19:02:30.600   36     48 50.59499   -119     44 51.25312        72.598``; the sign stands at the
degrees. A survey is reference: ``/reference/fix``.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar

import msgspec
import numpy as np
import polars as pl

from ..cells import Cells
from ..columns import careful_block
from ..contract import HEAD_BYTES, ChannelSpec, CommonOptions, Import, ReportBuilder
from ..inertial import one_file
from ..mapping import TextLayout
from ..phonelog import FIX, Stream, require_rows
from ..text import start_of
from ..timestamps import TimestampRepair

_ROW = re.compile(
    rb"(?m)^\s*\d{4}[-/]\d\d[-/]\d\d\s+\d\d:\d\d:\d\d(\.\d+)?\s+-?\d{1,2}\s+\d{1,2}\s+\d{1,2}\.\d+\s+-?\d{1,3}\s+"
    rb"\d{1,2}\s+\d{1,2}\.\d+\s+-?\d+(\.\d+)?\s*$"
)
NAMES = ("date", "time", "lat_d", "lat_m", "lat_s", "lon_d", "lon_m", "lon_s", "height")


class RtkPosOptions(CommonOptions, frozen=True, kw_only=True):
    """How good the survey is: the file does not say it.

    Attributes
    ----------
    sigma_m : float or None
        Standard deviation of a position, each axis (m).
    """

    sigma_m: Annotated[
        Annotated[float, msgspec.Meta(gt=0)] | None,
        msgspec.Meta(description="standard deviation of a position, each axis, m (RTK fixed: 0.02)"),
    ] = None


class RtkPos:
    """Importer ``rtk-pos``: ``/reference/fix``."""

    name: ClassVar[str] = "rtk-pos"
    title: ClassVar[str] = "RTK survey in degrees, minutes, seconds (.pos)"
    Options = RtkPosOptions

    def sniff(self, head: bytes, path: Path) -> float:
        """Rows of a date, a time and two angles of three numbers."""
        return 0.9 if len(_ROW.findall(head.replace(b"\r\n", b"\n"))) >= 2 else 0.0

    def read(self, paths: Sequence[Path], options: RtkPosOptions) -> Import:
        """Read one file."""
        path = one_file(paths, self.name)
        report = ReportBuilder()
        return Import(
            channels=[ChannelSpec("/reference/fix", FIX, "wgs84", metadata={"source": "RTK survey"})],
            blocks=_blocks(path, options, report),
            report=report,
            metadata={
                "device": {
                    "clock": "utc",
                    "time": "date and time of the file, taken as UTC: GPS time would be 18 s ahead of it today",
                    "name": "RTK survey",
                    "converted": "degrees, minutes, seconds to degrees",
                }
            },
        )


def _blocks(path: Path, options: RtkPosOptions, report: ReportBuilder) -> Iterator[tuple[str, pl.DataFrame]]:
    head = start_of(path, HEAD_BYTES).replace(b"\r\n", b"\n").split(b"\n")
    first = next((k for k, row in enumerate(head) if _ROW.match(row)), 0)
    cells = Cells(path, TextLayout(separator="blanks", header=False, skip_rows=first))
    clock = TimestampRepair(report, tick_ns=1, subject="survey: ")
    kept = Stream((), report)
    places = {f"c{i}": name for i, name in enumerate(NAMES)}
    kinds: dict[str, Any] = {c: pl.String if n in ("date", "time") else pl.Float64 for c, n in places.items()}
    for frame in clock.stream(_frames(cells, places, kinds, report) if cells.width == len(NAMES) else ()):
        kept.rows += frame.height
        yield "/reference/fix", _degrees(frame, options.sigma_m)
    require_rows(path, [kept])


def _frames(
    cells: Cells, places: dict[str, str], kinds: dict[str, Any], report: ReportBuilder
) -> Iterator[pl.DataFrame]:
    for text in cells.rows(range(len(NAMES)), report):
        frame = careful_block(text, places, kinds, "lat_s", report)
        stamp = (frame["date"].str.replace_all("/", "-") + " " + frame["time"]).str.to_datetime(
            "%Y-%m-%d %H:%M:%S%.f", strict=False, time_unit="ns"
        )
        bad = stamp.is_null()
        if bad.any():
            first = int(bad.arg_true()[0])
            report.drop(
                "bad_row",
                f"{frame['date'][first]} {frame['time'][first]}: no date and time; row dropped",
                count=int(bad.sum()),
                line=frame["line"][first],
            )
        yield frame.drop("date", "time").with_columns(t=stamp.cast(pl.Int64)).filter(~bad)


def _degrees(frame: pl.DataFrame, sigma_m: float | None) -> pl.DataFrame:
    out = {"t_ns": frame["t_ns"]}
    for axis in ("lat", "lon"):
        degrees = frame[f"{axis}_d"].to_numpy()
        size = np.abs(degrees) + frame[f"{axis}_m"].to_numpy() / 60 + frame[f"{axis}_s"].to_numpy() / 3600
        out[f"{axis}_deg"] = pl.Series(np.where(np.signbit(degrees), -size, size))
    out["alt_m"] = frame["height"]
    table = pl.DataFrame(out)
    if sigma_m is None:
        return table
    return table.with_columns(pl.lit(sigma_m).alias(c) for c in ("sd_east_m", "sd_north_m", "sd_up_m"))
