"""Annotations on a canvas: intervals as lanes, instants as points; added and taken away while they are shown.

What was sent to a viewer cannot be taken back. An interval is taken away by a gap at its start, and no other is drawn
over a change that a lane has had, since the viewer would show it in two pieces; points are drawn anew and the
old ones hidden.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right, insort
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import rerun as rr

from . import style
from .canvas import OVERVIEW, REPORT, Canvas, entity

Row = Mapping[str, Any]
"""One annotation: ``id, tier, start_ns, end_ns, label``."""


class _Lane:
    """One entity with intervals that do not overlap."""

    def __init__(self, path: str) -> None:
        self.path = path
        self.changes: list[int] = []  # times at which it ever changed, sorted
        self.starts: list[int] = []
        self.rows: dict[int, tuple[int, str]] = {}  # start to end and label

    def takes(self, start: int, end: int) -> bool:
        """Return whether an interval has room: none that is there, and no earlier change, inside it."""
        if bisect_left(self.changes, end) > bisect_right(self.changes, start):
            return False
        before = bisect_right(self.starts, start) - 1
        return before < 0 or self.rows[self.starts[before]][0] <= start

    def add(self, start: int, end: int, label: str) -> None:
        insort(self.starts, start)
        self.rows[start] = (end, label)
        for t in (start, end):
            index = bisect_left(self.changes, t)
            if index == len(self.changes) or self.changes[index] != t:
                self.changes.insert(index, t)

    def remove(self, start: int) -> None:
        self.starts.remove(start)
        del self.rows[start]

    def state(self, t: int) -> str:
        """Return what is drawn from a time on: a label, or the empty state of a gap."""
        index = bisect_right(self.starts, t) - 1
        if index < 0:
            return ""
        end, label = self.rows[self.starts[index]]
        return (label or "(no label)") if t < end else ""


class _Tier:
    """Lanes and points of one tier."""

    def __init__(self, path: str, number: int) -> None:
        self.path, self.number = path, number
        self.lanes: list[_Lane] = []
        self.instants: dict[str, int] = {}
        self.points = ""  # entity of the instants that are seen
        self.version = 0


class AnnotationLanes:
    """Draws annotations on a canvas, the same set of them at any time.

    Parameters
    ----------
    canvas : Canvas
        Where to draw. Tiers of its runs (stances and steps that a replay wrote) are left out: the runs' own channels
        show them.
    """

    def __init__(self, canvas: Canvas) -> None:
        self.canvas = canvas
        self.tiers: dict[str, _Tier] = {}
        self._at: dict[str, tuple[_Tier, _Lane, int]] = {}

    def show(self, *, lanes: bool = True, points: bool = True) -> None:
        """Say that panels show annotations, those of tiers to come too."""
        under = f"{self.canvas.prefix}/annotation"
        if lanes:
            self.canvas.show("lanes", f"{under}/**", tab=OVERVIEW, panel="lanes", alone=True)
        if points:
            self.canvas.show("plot", under, tab=OVERVIEW, panel="events (a row a tier)")

    def show_drawn(self) -> None:
        """Say that panels show annotations, where there is one to see."""
        lanes = [(name, lane.path) for name, tier in self.tiers.items() for lane in tier.lanes]
        for (
            name,
            path,
        ) in lanes:  # each by itself too: the height of the panel follows from how many there are
            self.canvas.show("lanes", path, tab=OVERVIEW, panel="lanes", owner=name, alone=True)
        self.show(lanes=bool(lanes), points=any(t.instants for t in self.tiers.values()))

    def update(self, added: Iterable[Row] = (), removed: Iterable[Row] = ()) -> None:
        """Take annotations away and draw others; one that changed is in both, under its id."""
        lanes: dict[int, tuple[_Lane, set[int]]] = {}
        tiers: dict[str, _Tier] = {}
        for row in removed:
            if row["id"] in self._at:
                _, lane, start = self._at.pop(row["id"])
                lane.remove(start)
                lanes.setdefault(id(lane), (lane, set()))[1].update((row["start_ns"], row["end_ns"]))
            elif (tier := self.tiers.get(row["tier"])) and row["id"] in tier.instants:
                del tier.instants[row["id"]]
                tiers[row["tier"]] = tier
        for row in sorted(added, key=lambda r: (r["start_ns"], r["end_ns"])):
            if row["tier"].rpartition("/")[0] in self.canvas.runs:
                continue
            tier = self._tier(row["tier"])
            start, end = row["start_ns"], row["end_ns"]
            if end > start:
                lane = self._lane(tier, start, end)
                lane.add(start, end, row["label"])
                self._at[row["id"]] = (tier, lane, start)
                lanes.setdefault(id(lane), (lane, set()))[1].update((start, end))
            else:
                tier.instants[row["id"]] = start
                tiers[row["tier"]] = tier
        for lane, times in lanes.values():
            self.canvas.states(lane.path, np.array(sorted(times)), [lane.state(t) for t in sorted(times)])
        for name, tier in tiers.items():
            self._points(name, tier)

    def log(self, rows: Iterable[Row]) -> None:
        """Write a line in the log for each annotation."""
        lines: dict[str, list[tuple[int, str]]] = {}
        for row in rows:
            tier, start, end = row["tier"], row["start_ns"], row["end_ns"]
            if tier.rpartition("/")[0] not in self.canvas.runs:
                text = f"{tier}: {row['label']}" + (f", {(end - start) / 1e9:.2f} s" if end > start else "")
                lines.setdefault(tier, []).append((start, text))
        for tier, entries in lines.items():
            path = f"{self.canvas.prefix}/log/annotation/{entity(tier)}"
            entries.sort(key=lambda line: line[0])
            self.canvas.text(path, np.array([t for t, _ in entries]), [text for _, text in entries])
            self.canvas.show("log", path, tab=REPORT, panel="steps and annotations", owner=tier)

    def _tier(self, name: str) -> _Tier:
        if name not in self.tiers:
            path = f"{self.canvas.prefix}/annotation/{entity(name)}"
            self.tiers[name] = _Tier(path, len(self.tiers))
        return self.tiers[name]

    def _lane(self, tier: _Tier, start: int, end: int) -> _Lane:
        free = next((lane for lane in tier.lanes if lane.takes(start, end)), None)
        if free is None:
            level = len(tier.lanes)
            free = _Lane(tier.path if level == 0 else f"{tier.path}/overlap{level + 1}")
            tier.lanes.append(free)
        return free

    def _points(self, name: str, tier: _Tier) -> None:
        """Draw the instants of a tier anew, and hide those that were drawn before."""
        if tier.points:
            self.canvas.static(tier.points, rr.SeriesPoints(visible_series=[False]))
            tier.version, tier.points = tier.version + 1, ""
        if not tier.instants:
            return
        tier.points = f"{tier.path}/instants{tier.version or ''}"
        self.canvas.points(tier.points, name, style.run_color(tier.number), "diamond", 5.0)
        times = np.array(sorted(tier.instants.values()))
        self.canvas.scalars(tier.points, times, np.full(times.size, float(tier.number + 1)))
