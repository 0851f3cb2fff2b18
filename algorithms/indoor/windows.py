"""Ranges from the powers of a window: the part that windowed trilateration and the hybrid share."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import msgspec
import numpy as np

from ..contract import FloatArray, Remark
from ..parameters import meta
from .anchors import Anchors
from .lateration import corrected, flatness, least_squares, triples
from .pathloss import distance_m, plane_range_m

SOURCE = "hybrid indoor positioning"


class RangingParams(msgspec.Struct, frozen=True, kw_only=True):
    """Parameters of windowed ranging and trilateration."""

    window_s: Annotated[float, meta("length of a window", "s", f"{SOURCE}, table 5.6", gt=0)] = 5.0
    method: Annotated[
        Literal["triples", "wls"],
        meta(
            "mean of all triples (the source), or weighted least squares of all anchors",
            "",
            f"{SOURCE}, eq 4.6",
        ),
    ] = "triples"
    correction: Annotated[
        Literal["none", "votes", "both"],
        meta("correction by vote; both: also of ranges that are too long", "", f"{SOURCE}, eqs 4.3–4.4"),
    ] = "votes"
    reach_m: Annotated[
        float,
        meta("anchors estimated beyond it are left out (0: none); before the correction", "m", SOURCE, ge=0),
    ] = 10.0
    least_dbm: Annotated[float, meta("weaker powers are left out", "dBm", f"{SOURCE}, section 3.1")] = -120.0
    least_anchors: Annotated[int, meta("fewest anchors of a fix", "", "", ge=3)] = 3
    flat: Annotated[
        float, meta("triples, and sets of anchors, flatter than this are on a line", "1", "", ge=0, le=1)
    ] = 0.01
    height_m: Annotated[float, meta("height of the receiver", "m", SOURCE)] = 1.2
    without: Annotated[str, meta("anchors left out, by address or name", "", f"{SOURCE}, table 5.7")] = ""


@dataclass
class WindowRanges:
    """Ranges of a window.

    Attributes
    ----------
    end_ns : int
        End of the window.
    anchors : ndarray
        Numbers of the anchors, shape (n,).
    slope : ndarray
        Ranges along the slope (m).
    plane, better : ndarray
        Ranges in the plane (m), before and after the correction.
    sigma : ndarray
        Standard deviation of ``slope`` (m).
    triples : ndarray
        Solution of each three anchors (m) once there was a fix by their mean, shape (m, 2).
    """

    end_ns: int
    anchors: np.ndarray[Any, Any]
    slope: FloatArray
    plane: FloatArray
    better: FloatArray
    sigma: FloatArray
    triples: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))


@dataclass
class Windows:
    """Collects powers in windows of fixed length from the first one on."""

    params: Any
    anchors: Anchors
    start_ns: int | None = None
    powers: dict[int, list[float]] = field(default_factory=dict)
    distances: dict[int, list[float]] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)
    unknown: dict[str, int] = field(default_factory=dict)

    def close(self, t_ns: int) -> WindowRanges | None:
        """Return the ranges of the window that ``t_ns`` is beyond, None where there is none to close."""
        length = round(self.params.window_s * 1e9)
        if self.start_ns is None:
            self.start_ns = t_ns
        if t_ns < self.start_ns + length:
            return None
        end = self.start_ns + length
        self.start_ns += (t_ns - self.start_ns) // length * length
        return self.ranges(end)

    def ranges(self, end_ns: int) -> WindowRanges:
        """Return the ranges of what was collected, and forget it."""
        p, a = self.params, self.anchors
        heard = sorted(set(self.powers) | set(self.distances))
        numbers = np.array(heard, dtype=np.int64)
        slope, sigma = np.empty(len(heard)), np.empty(len(heard))
        for i, k in enumerate(heard):
            if k in self.distances:
                slope[i], sigma[i] = np.mean(self.distances[k]), 0.3
            else:
                slope[i] = distance_m(np.mean(self.powers[k]), a.p_d0[k], a.eta[k])
                sigma[i] = slope[i] * a.relative_sigma[k]
        self.powers, self.distances = {}, {}
        if p.reach_m > 0:
            near = slope <= p.reach_m
            self.counts["beyond reach"] = self.counts.get("beyond reach", 0) + int((~near).sum())
            numbers, slope, sigma = numbers[near], slope[near], sigma[near]
        plane = plane_range_m(slope, a.above(p.height_m)[numbers])
        better = corrected(a.plane[numbers], plane, p.correction) if numbers.size else plane
        return WindowRanges(end_ns, numbers, slope, plane, better, sigma)

    def power(self, mac: str, rssi_dbm: float) -> None:
        """Add a power; those of unknown anchors are counted."""
        number = self.anchors.number.get(mac)
        if number is None:
            self.unknown[mac] = self.unknown.get(mac, 0) + 1
        elif np.isfinite(rssi_dbm) and rssi_dbm < 0 and rssi_dbm >= self.params.least_dbm:
            self.powers.setdefault(number, []).append(rssi_dbm)
        else:
            self.counts["left out"] = self.counts.get("left out", 0) + 1

    def distance(self, mac: str, metres: float) -> None:
        """Add a measured range."""
        number = self.anchors.number.get(mac)
        if number is None:
            self.unknown[mac] = self.unknown.get(mac, 0) + 1
        elif np.isfinite(metres) and metres >= 0:
            self.distances.setdefault(number, []).append(metres)

    def fix(self, ranges: WindowRanges) -> tuple[FloatArray, FloatArray] | None:
        """Return position (2,) and covariance (2, 2), None where the anchors do not do; the reason is counted."""
        p, where = self.params, self.anchors.plane[ranges.anchors]
        if ranges.anchors.size < p.least_anchors:
            self.counts["too few anchors"] = self.counts.get("too few anchors", 0) + 1
            return None
        if flatness(where) < p.flat:
            self.counts["anchors on a line"] = self.counts.get("anchors on a line", 0) + 1
            return None
        self.counts["fixes"] = self.counts.get("fixes", 0) + 1
        relative = ranges.sigma / np.maximum(ranges.slope, 1e-3)
        fit = least_squares(where, np.maximum(ranges.better, 0.1), relative)
        covariance = fit.covariance if fit is not None else np.full((2, 2), np.nan)
        if p.method == "wls":
            if fit is None:
                return None
            scale = max(1.0, fit.chi2) if np.isfinite(fit.chi2) else 1.0
            return fit.position, covariance * scale
        ranges.triples = triples(where, ranges.better, least_flatness=p.flat)
        return (ranges.triples.mean(axis=0), covariance) if len(ranges.triples) else None

    def remarks(self) -> list[Remark]:
        """Return what a user must know of the windows so far."""
        remarks = list(self.anchors.remarks)
        got = self.counts.get("fixes", 0)
        for kind, name, remedy in (
            ("too_few_anchors", "too few anchors", "add anchors, lengthen window_s or raise reach_m"),
            ("collinear_anchors", "anchors on a line", "add an anchor beside the line"),
        ):
            if count := self.counts.get(name, 0):
                remarks.append(
                    Remark(kind, f"{name} in {count} of {count + got} windows: no fix; {remedy}", got == 0)
                )
        if self.unknown:
            some = ", ".join(list(self.unknown)[:3])
            remarks.append(
                Remark(
                    "unknown_anchor",
                    f"{len(self.unknown)} addresses are in no anchor table: {some}; left out",
                )
            )
        if count := self.counts.get("left out", 0):
            remarks.append(
                Remark("bad_power", f"{count} powers are not negative dBm above the least; left out")
            )
        return remarks
