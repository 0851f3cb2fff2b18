"""What the importers of radio logs share: addresses, powers without their sign, anchor tables, survey points."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import msgspec
import numpy as np
import polars as pl

from .contract import ChannelSpec, Report, ReportBuilder, SourceAttachment

RADIO = "marcha_msgs/msg/RadioSignal"
POINT = "geometry_msgs/msg/PointStamped"
ANCHOR_COLUMNS = ("mac", "technology", "x", "y", "z", "p_d0", "eta", "name", "floor")
REFERENCE = ChannelSpec(
    "/reference/position", POINT, "plan", metadata={"frame": "the plan's x, y and height, m"}
)

WEAKEST_DBM = -120.0
DISAGREE_DB = 3.0
"""Mean difference above which two files of the same powers disagree: twice what averages of 50 samples leave."""


def address(text: str) -> str:
    """Return a hardware address as ``aa:bb:cc:dd:ee:ff``; empty where the text is none."""
    digits = re.sub(r"[:\-.\s]", "", text).lower()
    if not re.fullmatch(r"[0-9a-f]{12}", digits):
        return ""
    return ":".join(digits[i : i + 2] for i in range(0, 12, 2))


def local_address(text: str) -> str:
    """Return an address, or for a name that is none a locally administered one made of it (``A`` and so on)."""
    mac = address(text)
    if mac:
        return mac
    from hashlib import blake2b

    digits = "02" + blake2b(text.strip().lower().encode(), digest_size=5).hexdigest()
    return ":".join(digits[i : i + 2] for i in range(0, 12, 2))


def technology_of(text: str) -> str:
    """Return ``wifi``, ``ble``, ``zigbee``, ``uwb`` or ``unknown`` of a word that people write."""
    word = re.sub(r"[^a-z0-9]", "", text.lower())
    patterns = {
        "wifi": "wifi|wlan|80211",
        "ble": "ble|bluetooth|beacon",
        "zigbee": "zigbee|xbee",
        "uwb": "uwb",
    }
    return next((name for name, pattern in patterns.items() if re.search(pattern, word)), "unknown")


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


class RadioWatch:
    """Looks at the transmitters of a source while it streams by: unknown ones, and phones used as hotspots.

    Parameters
    ----------
    channels : sequence of ChannelSpec
        Of the source.
    """

    def __init__(self, channels: Sequence[ChannelSpec]) -> None:
        self._topics = {c.topic for c in channels if c.schema == RADIO}
        self._heard: list[pl.DataFrame] = []

    def feed(self, topic: str, table: pl.DataFrame) -> None:
        """Count the powers of a block by transmitter."""
        if topic in self._topics:
            if "technology" not in table.columns:
                table = table.with_columns(technology=pl.lit("unknown"))
            self._heard.append(table.group_by("mac", "technology", maintain_order=True).len())

    def finish(self, report: Report, anchors: Sequence[str]) -> Report:
        """Return the report with what was found; ``anchors`` are the addresses of the anchor table."""
        if not self._heard:
            return report
        heard = pl.concat(self._heard).group_by("mac", "technology", maintain_order=True).sum()
        builder = ReportBuilder()
        strange = heard.filter(~pl.col("mac").is_in(list(anchors)))
        hotspots = strange.filter((pl.col("technology") == "wifi") & _is_local(pl.col("mac")))
        if anchors and strange.height:
            builder.note(
                "unknown_anchor",
                f"{strange.height} of {heard.height} transmitters are not in the anchor table, {strange['mac'][0]} "
                "the first: kept, not used for positions; add those that are anchors to the table",
                count=int(strange["len"].sum()),
            )
        if hotspots.height:
            builder.note(
                "hotspot",
                f"{hotspots.height} Wi-Fi addresses are set by software, {hotspots['mac'][0]} the first: phones used "
                "as hotspots move and are no anchors (further networks of one access point look alike)",
                count=int(hotspots["len"].sum()),
            )
        findings = builder.build().findings
        order = sorted([*report.findings, *findings], key=lambda f: (f.kind, f.first_line or -1))
        return msgspec.structs.replace(report, findings=order)


def addresses(attachments: Iterable[SourceAttachment]) -> list[str]:
    """Return the addresses of an import's ``anchors.csv``; none where there is none."""
    table = next((a.data for a in attachments if a.name == "anchors.csv"), b"")
    rows = csv.DictReader(table.decode("utf-8", "replace").splitlines())  # a bare return ends a line as well
    return [row["mac"] for row in rows if row.get("mac")]


def _is_local(mac: pl.Expr) -> pl.Expr:
    """Whether the second bit of the first octet says that an address is locally administered (IEEE 802)."""
    return mac.str.slice(1, 1).is_in(["2", "3", "6", "7", "a", "b", "e", "f"])


def without_stale(frame: pl.DataFrame, label: str, report: ReportBuilder) -> pl.DataFrame:
    """Return powers without those that a scan only repeats: same transmitter, power and time last heard.

    A phone hands over its list at every scan, also what it last heard before: counted again, an old power would
    weigh as a new one.

    Parameters
    ----------
    frame : polars.DataFrame
        ``mac, rssi, seen`` (ns, 0 where not known) and ``line``, in order.
    label : str
        Which rows, said first.
    report : ReportBuilder
        Takes ``stale_scan``.
    """
    again = (frame["seen"].fill_null(0) > 0) & ~frame.select(
        pl.struct("mac", "rssi", "seen").is_first_distinct()
    ).to_series()
    if again.any():
        report.drop(
            "stale_scan",
            f"{label}: handed over again by a later scan (same transmitter, power and time last heard): the first "
            "is kept",
            count=int(again.sum()),
            line=int(frame["line"][int(again.arg_true()[0])]),
            subject=label,
        )
    return frame.filter(~again)


def compare_powers(
    ours: Mapping[Any, float], theirs: Mapping[Any, float], label: str, report: ReportBuilder
) -> None:
    """Report two files that state different powers of the same points (``files_disagree``).

    Parameters
    ----------
    ours, theirs : mapping
        Mean power (dBm) by point.
    label : str
        What is compared, in words.
    report : ReportBuilder
        Takes the finding.
    """
    both = sorted(set(ours) & set(theirs))
    if not both:
        return
    difference = float(np.mean([ours[k] - theirs[k] for k in both]))
    if abs(difference) > DISAGREE_DB:
        report.note(
            "files_disagree",
            f"{label}: {abs(difference):.1f} dB {'stronger' if difference > 0 else 'weaker'} on the mean of "
            f"{len(both)} points; kept as they are: calibrate from one of them and use it with its own kind",
            count=len(both),
        )


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
