"""Which panels a recording gets, and how they are arranged.

The layout follows from what the views say that they show (:class:`marcha.viz.canvas.Entry`), so a raw
recording, one run, many runs and several recordings side by side all get the tabs they can fill.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import rerun.blueprint as rrb
from rerun.blueprint.api import VisualizerLike
from rerun.encodings import EntityPathLike

from . import top_view
from .canvas import COMPARE, DETECTOR, FIGURES, OVERVIEW, REPORT, SPACE, TABS, Canvas, Entry, Floats
from .shapes import EQUATOR_M, metres_a_degree
from .timeaxis import SINCE_START
from .trace import STANDING_M, Trace, framed

TRAIL_S = 60.0
"""Length of the trail behind the cursor where a recording is too long to show all of it."""

TRAIL_ROWS = 60_000
"""Up to this many samples the trail reaches back to the start."""

HEIGHT = "height above the start (m)"
DISTANCE = "distance to the reference (m)"
BACKGROUND = (24, 28, 34)
SPATIAL = ("space", "map")
MAP_POINTS = 250.0
"""Points of the screen that the tracks on a map should take."""

GRID_PLOTS = 4
"""More plots of a tab than these stand in two columns."""

Part = rrb.View | rrb.Container


def blueprint(canvases: Sequence[Canvas], *, live: bool = False, ruler: bool = False) -> rrb.Blueprint:
    """Return the blueprint of recordings that share one view.

    Parameters
    ----------
    canvases : sequence of Canvas
        Begun (live) or drawn (saved): extents and lengths are known only then.
    live : bool
        Whether data still comes: the cursor follows it.
    ruler : bool
        Whether the time panel is open, so that ranges can be dragged on its ruler.
    """
    entries = [e for c in canvases for e in c.entries]
    tabs = [_tab(name, canvases, entries) for name in tab_names(entries)]
    root = rrb.Tabs(*[t for t in tabs if t is not None], active_tab=0)
    return rrb.Blueprint(
        root,
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(
            state="expanded" if ruler else "collapsed",
            timeline=SINCE_START,
            play_state="following" if live else "paused",
        ),
        auto_layout=False,
        auto_views=False,
    )


def tab_names(entries: Iterable[Entry]) -> list[str]:
    """Return the tabs in their order: the known ones, those of plug-ins before *Compare* and *Report*."""
    used = dict.fromkeys(e.tab for e in entries)
    if any(e.kind == "space" and e.panel == SPACE for e in entries):
        used[COMPARE] = None  # the tracks from above
    others = [t for t in used if t not in TABS]
    order = [*TABS[:-2], *others, *TABS[-2:]]
    return [t for t in order if t in used]


def _tab(name: str, canvases: Sequence[Canvas], entries: Sequence[Entry]) -> rrb.Container | None:
    """Return one tab: what lies in space on the left, what runs over time on the right."""
    mine = [e for e in entries if e.tab == name]
    if name == COMPARE:
        tracks = [e for e in entries if e.kind == "space" and e.panel == SPACE]
        left = [_above(canvases, tracks)] if tracks else []
        mine.sort(key=lambda e: 0 if e.panel == DISTANCE else 1 if e.stack == "error" else 2)
        right = _panels(mine, canvases) or _panels([e for e in entries if e.panel == HEIGHT], canvases)
        return _beside(name, left, right, [1, 1])
    if name == DETECTOR:
        return _detector(mine, canvases)
    if name == REPORT:
        documents = _panels([e for e in mine if e.kind == "document"], canvases)
        logs = _panels([e for e in mine if e.kind == "log"], canvases)
        first: list[Part] = [documents[0] if len(documents) == 1 else rrb.Tabs(*documents)]
        return _beside(name, first, logs, [3, 2])
    if name == FIGURES:
        return rrb.Tabs(*_panels(mine, canvases), name=name)
    spatial = _panels([e for e in mine if e.kind in SPATIAL], canvases)
    over_time = [e for e in mine if e.kind not in SPATIAL]
    if name == OVERVIEW:
        order = {"verdict": -1, HEIGHT: 0, "lanes": 1}
        over_time.sort(key=lambda e: order.get(e.panel, 2))
    if not (spatial or over_time):
        return None
    plots = _panels(over_time, canvases)
    if spatial or name == OVERVIEW:
        return _beside(name, spatial, plots, [3, 2], _shares(plots, over_time))
    return rrb.Grid(*plots, grid_columns=2 if len(plots) >= GRID_PLOTS else 1, name=name)


def _beside(
    name: str,
    left: Sequence[Part],
    right: Sequence[Part],
    shares: Sequence[float],
    rows: Sequence[float] | None = None,
) -> rrb.Container:
    parts = [rrb.Vertical(*left)] if left else []
    if right:
        parts.append(rrb.Vertical(*right, row_shares=rows))
    if len(parts) == 1:
        return rrb.Vertical(*(left or right), row_shares=None if left else rows, name=name)
    return rrb.Horizontal(*parts, column_shares=list(shares), name=name)


def _panels(entries: Sequence[Entry], canvases: Sequence[Canvas]) -> list[Part]:
    """Return one view for every panel, panels of one stack behind each other."""
    panels: dict[tuple[str, str], list[Entry]] = {}
    for entry in entries:
        panels.setdefault((entry.kind, entry.panel), []).append(entry)
    parts: list[Part] = []
    stacks: dict[str, list[Part]] = {}
    places: dict[str, int] = {}
    for own in panels.values():
        view, stack = _view(own, canvases), own[0].stack
        if not stack:
            parts.append(view)
            continue
        if stack not in stacks:
            places[stack] = len(parts)
            parts.append(view)
        stacks.setdefault(stack, []).append(view)
    for stack, views in stacks.items():
        if len(views) > 1:
            parts[places[stack]] = rrb.Tabs(*views, name=stack)
    return parts


def _view(entries: Sequence[Entry], canvases: Sequence[Canvas]) -> Part:
    """Return the view of one panel."""
    kind, panel = entries[0].kind, entries[0].panel
    contents = [e.path if e.alone or kind != "plot" else f"{e.path}/**" for e in entries]
    if kind == "plot":
        return _plot(panel, contents, _span(entries, canvases))
    if kind == "lanes":
        link = rrb.TimeAxis(link="LinkToGlobal")
        name = "stances, states and annotations"
        return rrb.StateTimelineView(origin="/", contents=contents, name=name, time_view=link)
    if kind == "map":
        past = _past(entries, canvases)
        provider = rrb.MapProvider.OpenStreetMap
        zoom = _zoom([c for canvas in canvases for c in canvas.geo])
        return rrb.MapView(
            origin="/", contents=contents, name=panel, zoom=zoom, background=provider, overrides=past
        )
    if kind == "space":
        return _space(panel, entries, canvases)
    if kind == "picture":
        return rrb.Spatial2DView(origin=entries[0].path, contents=contents, name=panel)
    if kind == "log":
        return rrb.TextLogView(origin="/", contents=contents, name=panel)
    return rrb.TextDocumentView(origin=entries[0].path, contents=contents, name=panel)


def _zoom(corners: Sequence[Floats]) -> float | None:
    """Return the zoom of a map (powers of two of the whole globe in 256 points) at which all is seen."""
    if not corners:
        return None
    low, high = np.min(corners, axis=0), np.max(corners, axis=0)
    size = max(float(np.max((high - low) * metres_a_degree(low[:1])[0])), 10.0)
    a_point = size / MAP_POINTS
    globe = 2 * np.pi * EQUATOR_M * np.cos(np.radians(low[0])) / 256
    return float(np.clip(np.log2(globe / a_point), 1.0, 22.0))


def _plot(name: str, contents: Sequence[str], span: tuple[float, float] | None) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(
        origin="/",
        contents=contents,
        name=name,
        axis_x=rrb.TimeAxis(link="LinkToGlobal"),
        axis_y=rrb.ScalarAxis(range=span) if span is not None else None,
        plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.RightTop),
    )


def _span(entries: Sequence[Entry], canvases: Sequence[Canvas]) -> tuple[float, float] | None:
    """Return the range of a plot's vertical axis where the viewer's own choice would mislead."""
    panel = entries[0].panel
    if panel in (HEIGHT, DISTANCE):
        traces, everything = _framed(canvases)
        if everything:
            return None
        if panel == DISTANCE:
            worst = max((t.worst_m for t in traces), default=0.0)
            return (-0.1 * worst, 1.3 * worst) if worst else None
        z = np.concatenate([t.positions[:, 2] for t in traces])
        margin = 0.1 * (np.ptp(z) + STANDING_M)
        return (float(z.min() - margin), float(z.max() + margin))
    if any(e.path.endswith("/error") for e in entries):
        return None  # it shows how wide the band is
    zoom = {path: span for c in canvases for path, span in c.zoom.items()}
    return next((zoom[e.path] for e in entries if e.path in zoom), None)


def _back() -> rrb.VisibleTimeRanges:
    """Return the range of time from the start to the cursor."""
    boundary = rrb.TimeRangeBoundary
    end = boundary.cursor_relative()
    return rrb.VisibleTimeRanges(timeline=SINCE_START, start=boundary.infinite(), end=end)


def _past(
    entries: Sequence[Entry], canvases: Sequence[Canvas]
) -> dict[EntityPathLike, VisualizerLike | Iterable[VisualizerLike]]:
    """Return what of its past each entity shows: trails and footprints all up to the cursor."""
    boundary = rrb.TimeRangeBoundary
    start, end = boundary.cursor_relative(seconds=-TRAIL_S), boundary.cursor_relative()
    short = rrb.VisibleTimeRanges(timeline=SINCE_START, start=start, end=end)
    whole = all(t.seen <= TRAIL_ROWS for c in canvases for t in c.traces.values())
    return {e.path: short if not whole and e.path.endswith("/trail") else _back() for e in entries if e.past}


def _space(panel: str, entries: Sequence[Entry], canvases: Sequence[Canvas]) -> Part:
    """Return the 3D view of a panel; where there is a floor plan, the tracks from above lie before it."""
    if panel != SPACE:
        points = [c for canvas in canvases for c in canvas.solid.get(panel, [])]
        corners = np.array(points or [np.full(3, -0.5), np.full(3, 0.5)], dtype=float)
        return _solid(panel, entries, canvases, corners.min(axis=0), corners.max(axis=0), least=0.8)
    low, high = extent(canvases)
    solid = _solid(panel, entries, canvases, low, high)
    if not any(c.flat for c in canvases):
        return solid
    return rrb.Tabs(_above(canvases, entries), solid, active_tab=0)


def _solid(
    name: str,
    entries: Sequence[Entry],
    canvases: Sequence[Canvas],
    low: Floats,
    high: Floats,
    least: float = 2.0,
) -> rrb.Spatial3DView:
    across = high - low if least < 2.0 else (high - low)[:2]  # a walk's height is small beside its way
    centre, size = (low + high) / 2, max(float(np.linalg.norm(across)), least)
    followed = next((c.followed[name] for c in canvases if name in c.followed), None)
    return rrb.Spatial3DView(
        origin="/",
        contents=[e.path for e in entries],
        name=name,
        eye_controls=rrb.EyeControls3D(
            position=centre + np.array([-0.12, -0.78, 0.62]) * size,
            look_target=centre,
            eye_up=(0.0, 0.0, 1.0),
            tracking_entity=followed,
        ),
        background=rrb.Background(kind="SolidColor", color=BACKGROUND),
        line_grid=rrb.LineGrid3D(visible=True, spacing=1.0, color=(255, 255, 255, 24)),
        spatial_information=rrb.SpatialInformation(target_frame="tf#/", show_axes=True),
        overrides=_past(entries, canvases),
    )


def _above(canvases: Sequence[Canvas], entries: Sequence[Entry]) -> rrb.Spatial2DView:
    """Return the 2D view of all tracks from above."""
    bounds = [0.0, top_view.PIXELS]
    return rrb.Spatial2DView(
        origin=top_view.CAMERA,
        contents=[*(e.path for e in entries), top_view.GRID, top_view.TICKS],
        name="from above",
        background=rrb.Background(kind="SolidColor", color=BACKGROUND),
        visual_bounds=rrb.VisualBounds2D(x_range=bounds, y_range=bounds),
        overrides=_past(entries, canvases),
    )


def _framed(canvases: Sequence[Canvas]) -> tuple[list[Trace], bool]:
    """Return the tracks that a view should be zoomed to, and whether those are all."""
    traces = [[t for t in c.traces.values() if t.count] for c in canvases]
    chosen = [t for own in traces for t in framed(own)]
    return chosen, len(chosen) == sum(len(own) for own in traces)


def extent(canvases: Sequence[Canvas]) -> tuple[Floats, Floats]:
    """Return the corners (3,), (3,) of tracks and anchors as shown; 10 m by 10 m where nothing is known."""
    traces, _ = _framed(canvases)
    points = [t.shown for t in traces]
    for canvas in canvases:
        plan = canvas.plan
        points += [a.position[None, :] for a in plan.anchors.values()]
        if not plan.anchors:
            flat = list(plan.outlines)
            if plan.picture is not None:
                left, right, low, high = plan.corners
                flat.append(np.array([[left, low], [right, high]]))
            points += [np.column_stack([p, np.zeros(len(p))]) for p in flat]
    if not points:
        return np.array([-5.0, -5.0, 0.0]), np.array([5.0, 5.0, 1.0])
    everything = np.concatenate(points)
    return everything.min(axis=0), everything.max(axis=0)


def _lane_share(entries: Sequence[Entry]) -> float:
    return 0.4 + 0.19 * sum(e.kind == "lanes" for e in entries)


def _shares(plots: Sequence[Part], entries: Sequence[Entry]) -> list[float]:
    """Return the heights of panels: lanes need little."""
    return [_lane_share(entries) if isinstance(p, rrb.StateTimelineView) else 1.0 for p in plots]


def _detector(entries: Sequence[Entry], canvases: Sequence[Canvas]) -> rrb.Container | None:
    """Return, side by side, every run's statistics against their thresholds, above all lanes."""
    plots = [e for e in entries if e.kind == "plot"]
    if not plots:
        return None  # lanes alone are in the overview
    runs = [
        rrb.Vertical(*_panels([e for e in plots if e.owner == owner], canvases), name=owner)
        for owner in dict.fromkeys(e.owner for e in plots)
    ]
    top = rrb.Horizontal(*runs) if len(runs) <= 3 else rrb.Tabs(*runs)
    lanes = _panels([e for e in entries if e.kind == "lanes"], canvases)
    shares = [3.0, *[_lane_share(entries)] * len(lanes)]
    return rrb.Vertical(top, *lanes, row_shares=shares, name=DETECTOR)
