"""Android text: lines of ``@`` in front, then ``ms,ax,ay,az,mx,my,mz,lat,lon,alt#``.

Milliseconds since 1970, acceleration with gravity (m/s²), field (µT), the last fix on every row. A variant has no
height. Equations and figures: the log of the phone of "dead reckoning with GPS", chapter 4.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import ClassVar

import polars as pl

from ..contract import CommonOptions, Import, ReportBuilder, SourceAttachment
from ..inertial import one_file
from ..phonelog import (
    ACC,
    AXES,
    FIELD,
    MAG,
    MICROTESLA,
    Stream,
    StreamChannel,
    declared,
    fix_part,
    imu_part,
    require_rows,
    whole_ns,
    xyz,
)
from ..text import start_of
from ..typedrows import typed_blocks

_CELL = rb",[ \t]*(?:-?[0-9.eE+-]+|(?i:nan|null)|)[ \t]*"
_ROW = re.compile(rb"(?m)^\d{12,14}(?:" + _CELL + rb"){6}(?:(?:" + _CELL + rb"){2,3})?#[ \t]*$")
_KIND = r"^\d{12,14}(?:,[^,]*){6}(,?)"
"""Kind of a row: whether a comma, and so the places of a fix, follow its first seven cells."""
NAMES = ("t", "ax", "ay", "az", "mx", "my", "mz", "lat", "lon", "alt")
WITHOUT_FIX = 7
"""Cells of a row that has no place for a fix."""


class AndroidTextOptions(CommonOptions, frozen=True, kw_only=True):
    """No options of its own."""


class AndroidText:
    """Importer ``android-text``: ``/phone/acc``, ``/phone/mag``, ``/phone/gnss``."""

    name: ClassVar[str] = "android-text"
    title: ClassVar[str] = "Android text: @ header, rows of acceleration, field and fix that end in #"
    Options = AndroidTextOptions

    def sniff(self, head: bytes, path: Path) -> float:
        """Rows of seven (before the first fix), nine or ten cells that end in #."""
        return 0.95 if len(_ROW.findall(head.replace(b"\r\n", b"\n"))) >= 2 else 0.0

    def read(self, paths: Sequence[Path], options: AndroidTextOptions) -> Import:
        """Read one file."""
        path = one_file(paths, self.name)
        head = start_of(path, 65536).replace(b"\r\n", b"\n")
        widths = {row[0].count(b",") + 1 for row in _ROW.finditer(head)} - {WITHOUT_FIX}
        names = NAMES[: max(widths, default=len(NAMES))]
        report = ReportBuilder()
        attachments: list[SourceAttachment] = []
        places = {k: k for k in ("lat", "lon", "alt") if k in names}
        parts = [
            imu_part("/phone/acc", xyz(ACC, ("ax", "ay", "az")), gravity="included"),
            StreamChannel("/phone/mag", MAG, xyz(FIELD, ("mx", "my", "mz"), MICROTESLA)),
            fix_part(places),
        ]
        stream = Stream(parts, report, attachments=attachments)
        entries = [
            x.lstrip("@ ").strip() for x in head.decode("utf-8", "replace").split("\n") if x.startswith("@")
        ]
        pairs = (x.partition(":") for x in entries)
        return Import(
            channels=declared([stream]),
            blocks=_blocks(path, names, stream, report),
            report=report,
            attachments=attachments,
            metadata={
                "device": {
                    "clock": "utc",
                    "time": "milliseconds since 1970",
                    "frames": AXES,
                    "converted": "magnetic field from µT",
                    "name": "Android text",
                    **{f"header {k.strip()}": v.strip() for k, _, v in pairs if v.strip()},
                }
            },
        )


def _blocks(
    path: Path, names: Sequence[str], stream: Stream, report: ReportBuilder
) -> Iterator[tuple[str, pl.DataFrame]]:
    tables = typed_blocks(
        path,
        _KIND,
        ",",
        lambda kind, width: names if kind else names[:WITHOUT_FIX],
        report,
        required=lambda kind: "t",
        comment="@",
        ending="# \t",
    )
    nothing = [pl.lit(float("nan")).alias(name) for name in names[WITHOUT_FIX:]]
    for block in tables:
        frames = [
            (frame if kind else frame.with_columns(nothing)).select("line", *names)
            for kind, frame in block.items()
        ]
        if frames:
            together = pl.concat(frames).sort("line")
            yield from stream.push(together.with_columns(t=whole_ns(together["t"], 1e3)))
    yield from stream.finish()
    require_rows(path, [stream])
