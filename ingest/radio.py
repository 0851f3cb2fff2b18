"""What the importers of radio logs share: addresses, powers without their sign, anchor tables, survey points."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from ..recording.errors import MarchaError
from .contract import ChannelSpec, ReportBuilder, SourceAttachment

RADIO = "marcha_msgs/msg/RadioSignal"
POINT = "geometry_msgs/msg/PointStamped"
ANCHOR_COLUMNS = ("mac", "technology", "x", "y", "z", "p_d0", "eta", "name")
REFERENCE = ChannelSpec(
    "/reference/position", POINT, "plan", metadata={"frame": "the plan's x, y and height, m"}
)

STRONGEST_DBM, WEAKEST_DBM = 0.0, -120.0
SURVEY_GAP_NS = 10_000_000_000
"""Time between two survey points that a file gives without time."""


def address(text: str) -> str:
    """Return a hardware address as ``aa:bb:cc:dd:ee:ff``; empty where the text is none."""
    digits = re.sub(r"[:\-.\s]", "", text).lower()
    if not re.fullmatch(r"[0-9a-f]{12}", digits):
        return ""
    return ":".join(digits[i : i + 2] for i in range(0, 12, 2))


def local_address(text: str) -> str:
    """Return an address, or for a name that is none a locally administered one made of it (``A`` and so on)."""
    found = address(text)
    if found:
        return found
    from hashlib import blake2b

    digits = "02" + blake2b(text.strip().lower().encode(), digest_size=5).hexdigest()
    return ":".join(digits[i : i + 2] for i in range(0, 12, 2))


def signed_powers(values: Sequence[float], label: str, report: ReportBuilder) -> list[float]:
    """Return powers in dBm; where all of a file's are positive their sign was left out, which is repaired."""
    finite = [v for v in values if math.isfinite(v)]
    if finite and min(finite) > 0 and max(finite) <= -WEAKEST_DBM:
        report.repair(
            "repaired_sign",
            f"{label}: powers are stored without their sign: taken as negative dBm",
            count=len(finite),
        )
        return [-v for v in values]
    return list(values)


def anchor_table(anchors: Iterable[Mapping[str, Any]]) -> SourceAttachment:
    """Return the attachment ``anchors.csv`` of anchors given by the columns of :data:`ANCHOR_COLUMNS`."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(ANCHOR_COLUMNS)
    for anchor in anchors:
        cells = [anchor.get(c, "") for c in ANCHOR_COLUMNS]
        writer.writerow(["" if isinstance(c, float) and math.isnan(c) else c for c in cells])
    return SourceAttachment("anchors.csv", out.getvalue().encode(), "text/csv")


def ordered(table: pl.DataFrame, label: str, report: ReportBuilder) -> pl.DataFrame:
    """Return a table by time; rows that went backwards are reported as repaired."""
    if table["t_ns"].is_sorted():
        return table
    t = table["t_ns"].to_numpy()
    late = t < np.maximum.accumulate(t)
    worst = float((np.maximum.accumulate(t) - t).max()) / 1e9
    line = int(np.flatnonzero(late)[0]) + 1
    report.repair(
        "backwards_time",
        f"{label}: time goes back by up to {worst:.3g} s (row {line} the first): put in order of time",
        count=int(late.sum()),
        line=line,
    )
    return table.sort("t_ns", maintain_order=True)


def read_text(path: Path) -> str:
    """Return a text file; MarchaError names it where it cannot be read."""
    try:
        return path.read_bytes().decode("utf-8-sig", "replace")
    except OSError as error:
        raise MarchaError(f"{path}: cannot be read: {error.strerror or error}") from error


def survey(points: Sequence[tuple[int, int, Sequence[float]]]) -> pl.DataFrame:
    """Return ``/reference/position`` of stretches (first, last time in ns, x y z) in which the device stood."""
    times: list[int] = []
    where: list[Sequence[float]] = []
    for first, last, position in points:
        times += [first, max(last, first + 1)]
        where += [position, position]
    order = sorted(range(len(times)), key=lambda i: times[i])
    xyz = np.array([where[i] for i in order], dtype=np.float64).reshape(-1, 3)
    return pl.DataFrame({"t_ns": [times[i] for i in order]}, schema={"t_ns": pl.Int64}).with_columns(
        pos_x=xyz[:, 0], pos_y=xyz[:, 1], pos_z=xyz[:, 2]
    )
