"""One recording on one Rerun stream: channels become entities, logged in columns.

A :class:`Scene` draws one recording (read from a file or arriving live). Each channel is drawn by a registered
view (:mod:`marcha.viz.registry`), which logs its style once, its rows in blocks, and what can only be drawn
when all is known (the whole track) at the end. ``docs/viewing.md`` lists the entities.

Estimates stand at the time that they speak of, not at the time when they were known.
"""

from __future__ import annotations

import polars as pl
import rerun as rr

from . import style
from .annotation_lanes import AnnotationLanes
from .canvas import (
    COMPARE,
    OVERVIEW,
    REPORT,
    Canvas,
)
from .registry import views_of, warn
from .report import verdicts
from .trace import axes_error, compared, distance
from .views.base import View
from .views.common import General
from .views.plan import draw_plan

BLOCK_ROWS = 1000
"""Rows a block: small enough for bounded memory, large enough for speed (measured: 2.5 million rows/s)."""


class Scene:
    """Draws one recording into a Rerun stream.

    Parameters
    ----------
    canvas : Canvas
        Where everything is drawn.

    Attributes
    ----------
    lanes : AnnotationLanes
        Annotations that are drawn.
    views : dict of str to list of View
        The views of each topic.
    """

    def __init__(self, canvas: Canvas) -> None:
        self.canvas = canvas
        self.lanes = AnnotationLanes(canvas)
        self.views = {c.topic: views_of(canvas, c) for c in canvas.channels}
        self._failed: set[View] = set()

    def begin(self) -> None:
        """Log what holds at all times: colours, names, axes, the floor plan."""
        canvas = self.canvas
        canvas.static(canvas.prefix or "/", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
        draw_plan(canvas)
        for view in self._all():
            self._do(view, View.begin.__name__)
        unusable = {
            name.removeprefix("run/"): lineage
            for name, lineage in canvas.metadata.items()
            if name.startswith("run/") and lineage.get("fatal") == "true"
        }
        if unusable:  # in front of the pictures, which look right
            path, text = f"{canvas.prefix}/verdict", "\n".join(verdicts(unusable))
            canvas.static(path, rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN))
            canvas.show("document", path, tab=OVERVIEW, panel="verdict", owner=canvas.prefix[1:])
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

        Intervals of a tier that overlap get a lane each. Stances and steps that a replay wrote are left out: the
        run's own channels show them.
        """
        rows = annotations.select("id", "tier", "start_ns", "end_ns", "label").to_dicts()
        self.lanes.update(rows)
        self.lanes.log(rows)
        self.lanes.show_drawn()

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
            topic = canvas.reference_of(rest.split("/")[0]) if mark else None
            reference = canvas.traces.get(canvas.base(topic)) if topic is not None else None
            if topic is None or reference is None:
                continue
            comparison = compared(trace, reference, canvas.alignment_of(rest.split("/")[0], topic))
            if comparison is None:
                continue
            far = distance(comparison)
            trace.place, trace.worst_m = comparison.transform, float(far.max())
            turn = rr.Transform3D(translation=trace.place.translation, mat3x3=trace.place.rotation)
            canvas.static(path, turn)
            error_path, owner = path + "/error", trace.owner
            canvas.lines(error_path, [f"error {a} (m)" for a in "xyz"], style.AXES)
            canvas.columns(error_path, comparison.t_ns, rr.Scalars.columns(scalars=axes_error(comparison)))
            title = f"{owner}: error and ±1σ of the position (m)"
            canvas.show("plot", error_path, tab=COMPARE, panel=title, owner=owner, stack="error")
            error_path = path + "/distance"
            canvas.lines(error_path, [f"{owner} distance (m)"], [trace.color])
            canvas.columns(error_path, comparison.t_ns, rr.Scalars.columns(scalars=far))
            canvas.show("plot", error_path, tab=COMPARE, panel="distance to the reference (m)", owner=owner)

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
