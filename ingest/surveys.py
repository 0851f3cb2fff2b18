"""Surveys that state no times: powers by point, laid one after another on a clock of their own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import polars as pl

from .contract import ChannelSpec, Import, ReportBuilder
from .radio import RADIO, REFERENCE, anchor_table, survey

PACKET_NS = 100_000_000
"""Time between two packets of one transmitter that a file gives without time."""
STAY_NS, GAP_NS = 10_000_000_000, 1_000_000_000
"""Least stay at a point, and the time to the next: longer than windows of estimators, which then hear one point."""


@dataclass(frozen=True)
class SurveyPoint:
    """A place and what was heard there.

    Attributes
    ----------
    where : tuple of float
        x, y, z (m).
    powers : mapping of str to (str, sequence of float)
        By address: technology and powers (dBm) in the order of the file.
    """

    where: tuple[float, float, float]
    powers: Mapping[str, tuple[str, Sequence[float]]]


def survey_import(
    points: Sequence[SurveyPoint], anchors: Sequence[Mapping[str, Any]], report: ReportBuilder, frame: str
) -> Import:
    """Return ``/indoor/radio`` and ``/reference/position`` of points without times.

    Parameters
    ----------
    points : sequence of SurveyPoint
        In the order in which they are laid on the clock.
    anchors : sequence of mapping
        Rows of ``anchors.csv``; none where positions are not known.
    report : ReportBuilder
        Counts the powers.
    frame : str
        What the coordinates are.
    """
    parts: list[pl.DataFrame] = []
    stretches: list[tuple[int, int, Sequence[float]]] = []
    start = 0
    for point in points:
        rows = [
            (start + k * PACKET_NS, mac, power, technology)
            for mac, (technology, powers) in point.powers.items()
            for k, power in enumerate(powers)
        ]
        if not rows:
            continue
        names = {"t_ns": pl.Int64, "mac": pl.String, "rssi_dbm": pl.Float64, "technology": pl.String}
        parts.append(pl.DataFrame(rows, schema=names, orient="row").sort("t_ns", maintain_order=True))
        end = max(int(parts[-1]["t_ns"][-1]) + PACKET_NS, start + STAY_NS)
        stretches.append((start, end, point.where))
        start = end + GAP_NS
    radio = pl.concat(parts)
    report.keep(radio.height)
    report.note(
        "assumed_times",
        "the powers have no times: points follow each other on a clock of their own, packets of one transmitter "
        f"{PACKET_NS * 1e-9:g} s apart",
    )
    return Import(
        channels=[ChannelSpec("/indoor/radio", RADIO, "plan"), REFERENCE],
        blocks=iter([("/indoor/radio", radio), (REFERENCE.topic, survey(stretches))]),
        report=report,
        metadata={
            "device": {"clock": "device", "name": "survey of signal strengths", "reference_frame": frame},
            "plan": {"handedness": "right", "frame": frame},
        },
        attachments=[anchor_table(anchors)] if anchors else [],
    )
