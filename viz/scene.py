"""One recording on one Rerun stream: channels become entities, logged in columns.

A :class:`Scene` draws one recording (read from a file or arriving live). Each channel is drawn by a registered
view (:mod:`marcha.viz.registry`), which logs its style once, its rows in blocks, and what can only be drawn
when all is known (the whole track) at the end. ``docs/viewing.md`` lists the entities.

Estimates stand at the time that they speak of, not at the time when they were known.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

import numpy as np
import polars as pl
import rerun as rr

from . import style
from .canvas import (
    ALIGNMENT,
    COMPARE,
    OVERVIEW,
    REPORT,
    Canvas,
    ChannelLike,
    Times,
    entity,
)
from .registry import views_of, warn
from .timeaxis import TimeAxis
from .trace import axes_error, compared, distance, reference_of
from .views.base import View
from .views.common import General
from .views.plan import draw_plan

BLOCK_ROWS = 1000
"""Rows a block: small enough for bounded memory, large enough for speed (measured: 2.5 million rows/s)."""


class Scene:
    """Draws one recording into a Rerun stream.

    Parameters
    ----------
    stream, channels, axis, prefix, first_color, alignment, metadata, attachments
        See :class:`marcha.viz.canvas.Canvas`.

    Attributes
    ----------
    canvas : Canvas
        Where everything is drawn.
    views : dict of str to list of View
        The views of each topic.
    """

    def __init__(
        self,
        stream: rr.RecordingStream,
        channels: Iterable[ChannelLike],
        axis: TimeAxis,
        prefix: str = "",
        first_color: int = 0,
        alignment: str = ALIGNMENT,
        metadata: Mapping[str, Mapping[str, str]] | None = None,
        attachments: Mapping[str, Callable[[], bytes]] | None = None,
    ) -> None:
        self.canvas = Canvas(stream, channels, axis, prefix, first_color, alignment, metadata, attachments)
        self.views = {c.topic: views_of(self.canvas, c) for c in self.canvas.channels}
        self._failed: set[View] = set()

    def begin(self) -> None:
        """Log what holds at all times: colours, names, axes, the floor plan."""
        canvas = self.canvas
        canvas.static(canvas.prefix or "/", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
        draw_plan(canvas)
        for view in self._all():
            self._do(view, View.begin.__name__)
        title = canvas.prefix[1:] or "report"
        canvas.show("document", f"{canvas.prefix}/report", tab=REPORT, panel=title, owner=canvas.prefix[1:])

    def write(self, topic: str, table: pl.DataFrame) -> None:
        """Draw rows of one channel (``t_ns`` and its columns)."""
        views = self.views.get(topic)
        if not views or table.height == 0:
            return
        canvas = self.canvas
        t_ns = table["t_ns"].to_numpy()
        low, high = int(t_ns.min()), int(t_ns.max())
        canvas.first_ns = low if canvas.first_ns is None else min(low, canvas.first_ns)
        canvas.last_ns = high if canvas.last_ns is None else max(high, canvas.last_ns)
        for start in range(0, table.height, BLOCK_ROWS):
            times, block = t_ns[start : start + BLOCK_ROWS], table.slice(start, BLOCK_ROWS)
            for view in list(views):
                self._do(view, View.draw.__name__, times, block)

    def annotate(self, annotations: pl.DataFrame) -> None:
        """Draw annotations (``tier, start_ns, end_ns, label``): intervals as lanes, instants as points, and
        a line in the log for each.

        Intervals of a tier that overlap get a lane each level. Stances and steps that a replay wrote are left
        out: the run's own channels show them.
        """
        canvas = self.canvas
        for number, ((tier,), rows) in enumerate(annotations.group_by("tier", maintain_order=True)):
            tier = str(tier)
            if tier.rpartition("/")[0] in canvas.runs:
                continue
            path = f"{canvas.prefix}/annotation/{entity(tier)}"
            rows = rows.sort("start_ns", maintain_order=True)
            start, end = rows["start_ns"].to_numpy(), rows["end_ns"].to_numpy()
            labels = rows["label"].to_list()
            lasting = np.flatnonzero(end > start)
            levels = overlap_levels(start[lasting], end[lasting])
            for level in range(int(levels.max(initial=-1)) + 1):
                lane = path if level == 0 else f"{path}/overlap{level + 1}"
                chosen = lasting[levels == level]
                self._lane(lane, start[chosen], end[chosen], [labels[i] for i in chosen])
                canvas.show("lanes", lane, tab=OVERVIEW, panel="lanes", owner=tier, alone=True)
            instants = np.flatnonzero(end <= start)
            if instants.size:
                points = f"{path}/instants"
                canvas.points(points, tier, style.run_color(number), "diamond", 5.0)
                canvas.scalars(points, start[instants], np.full(instants.size, float(number + 1)))
                canvas.show("plot", points, tab=OVERVIEW, panel="events (a row a tier)", owner=tier)
            log = f"{canvas.prefix}/log/annotation/{entity(tier)}"
            text = [
                f"{tier}: {label}" + (f", {(b - a) / 1e9:.2f} s" if b > a else "")
                for label, a, b in zip(labels, start, end, strict=True)
            ]
            canvas.text(log, start, text)
            canvas.show("log", log, tab=REPORT, panel="steps and annotations", owner=tier)

    def _lane(self, path: str, start: Times, end: Times, labels: list[str]) -> None:
        # an interval that another one follows at once needs no gap between them
        gap = np.flatnonzero(~np.isin(end, start))
        times = np.concatenate([start, end[gap]])
        states = [*(label or "(no label)" for label in labels), *[""] * len(gap)]
        order = np.argsort(times, kind="stable")
        self.canvas.states(path, times[order], [states[i] for i in order])

    def end(self) -> None:
        """Draw what needs the whole: tracks, thresholds, errors against the reference."""
        for view in self._all():
            self._do(view, View.end.__name__)
        self._compare()

    def _compare(self) -> None:
        """Turn every run's track onto the reference and log its error over time."""
        canvas = self.canvas
        for path, trace in canvas.traces.items():
            _, mark, rest = path.partition("/run/")
            topic = reference_of(rest.split("/")[0], canvas.references) if mark else None
            reference = canvas.traces.get(canvas.base(topic)) if topic is not None else None
            found = compared(trace, reference, canvas.alignment) if reference is not None else None
            if found is None:
                continue
            far = distance(found)
            trace.place, trace.worst_m = found.transform, float(far.max())
            turn = rr.Transform3D(translation=trace.place.translation, mat3x3=trace.place.rotation)
            canvas.static(path, turn)
            at, owner = path + "/error", trace.owner
            canvas.lines(at, [f"error {a} (m)" for a in "xyz"], style.AXES)
            canvas.columns(at, found.t_ns, rr.Scalars.columns(scalars=axes_error(found)))
            title = f"{owner}: error and ±1σ of the position (m)"
            canvas.show("plot", at, tab=COMPARE, panel=title, owner=owner, stack="error")
            at = path + "/distance"
            canvas.lines(at, [f"{owner} distance (m)"], [trace.color])
            canvas.columns(at, found.t_ns, rr.Scalars.columns(scalars=far))
            canvas.show("plot", at, tab=COMPARE, panel="distance to the reference (m)", owner=owner)

    def _all(self) -> list[View]:
        return [view for views in self.views.values() for view in list(views)]

    def _do(self, view: View, step: str, *arguments: object) -> None:
        """Let a view do a step. One that fails is named, and the general view takes its place."""
        try:
            getattr(view, step)(*arguments)
        except Exception as error:
            if isinstance(view, General) or type(view).__module__.startswith(
                View.__module__.rpartition(".")[0]
            ):
                raise  # a defect of ours, or the viewer went away
            warn(type(view), view.channel, error)
            views = self.views[view.channel.topic]
            views.remove(view)
            if not views:
                views.append(General(self.canvas, view.channel))
                views[0].begin()
                if step == View.draw.__name__:
                    views[0].draw(*arguments)  # type: ignore[arg-type]


def overlap_levels(start: Times, end: Times) -> Times:
    """Return for intervals, sorted by their start, the first lane (n,) that is free when they begin."""
    levels = np.zeros(len(start), dtype=np.int64)
    free: list[int] = []  # when each lane is free again
    for i, (a, b) in enumerate(zip(start.tolist(), end.tolist(), strict=True)):
        level = next((k for k, until in enumerate(free) if until <= a), len(free))
        if level == len(free):
            free.append(b)
        else:
            free[level] = b
        levels[i] = level
    return levels
