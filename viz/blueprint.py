"""Which views a recording gets, and how they are arranged.

The layout follows from what the scenes show (:class:`marcha.viz.scene.Entry`), so a raw recording, one
run, many runs and
several recordings side by side all get the tabs they can fill: Overview, Raw, Detector, Compare, Report.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np
import rerun.blueprint as rrb
from rerun.blueprint.api import VisualizerLike
from rerun.encodings import EntityPathLike

from . import plan
from .scene import (
    TIMELINE,
    Entry,
    Floats,
    Scene,
)
from .track import STANDING_M, Track, framed

TRAIL_S = 60.0
"""Length of the trail behind the cursor where a recording is too long to show all of it."""

TRAIL_ROWS = 60_000
"""Up to this many samples the trail reaches back to the start."""

SPATIAL = ("track", "trail", "foot", "mark", "footprints")
BACKGROUND = (24, 28, 34)


def blueprint(scenes: Sequence[Scene], *, live: bool = False) -> rrb.Blueprint:
    """Return the blueprint of scenes that share one view.

    Parameters
    ----------
    scenes : sequence of Scene
        Begun (live) or drawn (saved): extents and lengths are known only then.
    live : bool
        Whether data still comes: the cursor follows it.
    """
    entries = [e for s in scenes for e in s.entries]
    tabs = [
        _overview(scenes, entries),
        _raw(entries),
        _detector(scenes, entries),
        _compare(scenes, entries),
        _report(entries),
    ]
    root = rrb.Tabs(*[t for t in tabs if t is not None], active_tab=0)
    return rrb.Blueprint(
        root,
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="following" if live else "paused"),
        auto_layout=False,
        auto_views=False,
    )


def _of(entries: Iterable[Entry], *roles: str) -> list[Entry]:
    return [e for e in entries if e.role in roles]


def _below(entries: Iterable[Entry]) -> list[str]:
    """Return contents of a view: the entities and what lies below them."""
    return [f"{e.path}/**" for e in entries]


def _plot(
    name: str, entries: Sequence[Entry], *, alone: bool = False, span: tuple[float, float] | None = None
) -> rrb.TimeSeriesView:
    """Return a plot of entities and what lies below them (``alone``: without that), zoomed to ``span``."""
    return rrb.TimeSeriesView(
        origin="/",
        contents=[e.path for e in entries] if alone else _below(entries),
        name=name,
        axis_x=rrb.TimeAxis(link="LinkToGlobal"),
        axis_y=rrb.ScalarAxis(range=span) if span is not None else None,
        plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.RightTop),
    )


def _lanes(entries: Sequence[Entry]) -> list[rrb.StateTimelineView]:
    found = _of(entries, "stance", "annotation")
    if not found:
        return []
    name = "stance" if not _of(found, "annotation") else "stance and annotations"
    return [
        rrb.StateTimelineView(
            origin="/",
            contents=[e.path for e in found],
            name=name,
            time_view=rrb.TimeAxis(link="LinkToGlobal"),
        )
    ]


def _spatial(entries: Sequence[Entry]) -> list[str]:
    return [e.path for e in _of(entries, *SPATIAL)]


def _past(scenes: Sequence[Scene], entries: Sequence[Entry]) -> dict[EntityPathLike, VisualizerLike]:
    """Return what of its past each entity shows: trails and footprints all up to the cursor."""
    boundary = rrb.TimeRangeBoundary
    end = boundary.cursor_relative()
    past = rrb.VisibleTimeRanges(timeline=TIMELINE, start=boundary.infinite(), end=end)
    short = rrb.VisibleTimeRanges(
        timeline=TIMELINE, start=boundary.cursor_relative(seconds=-TRAIL_S), end=end
    )
    whole = all(t.seen <= TRAIL_ROWS for s in scenes for t in s.tracks.values())
    return {
        e.path: past if whole or e.role == "footprints" else short
        for e in _of(entries, "trail", "footprints")
    }


def _space(scenes: Sequence[Scene], entries: Sequence[Entry]) -> rrb.Spatial3DView:
    """Return the 3D view of all tracks."""
    low, high = extent(scenes)
    centre, size = (low + high) / 2, max(float(np.linalg.norm((high - low)[:2])), 2.0)
    return rrb.Spatial3DView(
        origin="/",
        contents=_spatial(entries),
        name="track",
        eye_controls=rrb.EyeControls3D(
            position=centre + np.array([-0.12, -0.78, 0.62]) * size,
            look_target=centre,
            eye_up=(0.0, 0.0, 1.0),
        ),
        background=rrb.Background(kind="SolidColor", color=BACKGROUND),
        line_grid=rrb.LineGrid3D(visible=True, spacing=1.0, color=(255, 255, 255, 24)),
        spatial_information=rrb.SpatialInformation(target_frame="tf#/", show_axes=True),
        overrides=_past(scenes, entries),
    )


def _plan(scenes: Sequence[Scene], entries: Sequence[Entry]) -> rrb.Spatial2DView:
    """Return the 2D view of all tracks from above."""
    bounds = [0.0, plan.PIXELS]
    return rrb.Spatial2DView(
        origin=plan.CAMERA,
        contents=[*_spatial(entries), plan.GRID, plan.TICKS],
        name="from above",
        background=rrb.Background(kind="SolidColor", color=BACKGROUND),
        visual_bounds=rrb.VisualBounds2D(x_range=bounds, y_range=bounds),
        overrides=_past(scenes, entries),
    )


def _framed(scenes: Sequence[Scene]) -> tuple[list[Track], bool]:
    """Return the tracks that a view should be zoomed to, and whether those are all."""
    tracks = [[t for t in s.tracks.values() if t.count] for s in scenes]
    chosen = [t for own in tracks for t in framed(own)]
    return chosen, len(chosen) == sum(len(own) for own in tracks)


def extent(scenes: Sequence[Scene]) -> tuple[Floats, Floats]:
    """Return the corners (3,), (3,) of the tracks as shown; a room of 10 m where nothing is known yet."""
    tracks, _ = _framed(scenes)
    if not tracks:
        return np.array([-5.0, -5.0, 0.0]), np.array([5.0, 5.0, 1.0])
    points = np.concatenate([t.shown for t in tracks])
    return points.min(axis=0), points.max(axis=0)


def _height(scenes: Sequence[Scene], entries: Sequence[Entry]) -> list[rrb.TimeSeriesView]:
    found = _of(entries, "height")
    if not found:
        return []
    tracks, everything = _framed(scenes)
    span = None
    if not everything:
        z = np.concatenate([t.positions[:, 2] for t in tracks])
        margin = 0.1 * (np.ptp(z) + STANDING_M)
        span = (float(z.min() - margin), float(z.max() + margin))
    return [_plot("height above the start (m)", found, span=span)]


def _overview(scenes: Sequence[Scene], entries: Sequence[Entry]) -> rrb.Container | None:
    lanes = _lanes(entries)
    plots: list[rrb.View] = [*_height(scenes, entries), *lanes]
    plots += [_plot(e.title, [e]) for e in _norms(scenes, entries)]
    shares = [0.4 + 0.19 * len(_of(entries, "stance", "annotation")) if p in lanes else 1.0 for p in plots]
    if not _of(entries, "track", "map"):
        return rrb.Vertical(*plots, row_shares=shares, name="Overview") if plots else None
    left: list[rrb.View] = []
    if _of(entries, "track"):
        left.append(_space(scenes, entries))
    if fixes := _of(entries, "map"):
        left.append(rrb.MapView(origin="/", contents=[e.path for e in fixes], name="map"))
    return rrb.Horizontal(
        rrb.Vertical(*left), rrb.Vertical(*plots, row_shares=shares), column_shares=[3, 2], name="Overview"
    )


def _norms(scenes: Sequence[Scene], entries: Sequence[Entry]) -> list[Entry]:
    """Return the norms of the sensor that the first run reads, or of the first sensor."""
    norms = _of(entries, "norm")
    runs = [run for s in scenes for run in s.runs]
    used = [e for e in norms if any(e.owner.rsplit(" ")[-1][1:].replace("/", "_") in run for run in runs)]
    return (used or norms)[:2]


def _raw(entries: Sequence[Entry]) -> rrb.Container | None:
    raw = _of(entries, "raw")
    if not raw:
        return None
    views = [_plot(e.title, [e], alone=True) for e in raw]
    return rrb.Grid(*views, grid_columns=2 if len(views) > 3 else 1, name="Raw")


def _by_owner(entries: Iterable[Entry]) -> Iterator[tuple[str, list[Entry]]]:
    groups: dict[str, list[Entry]] = {}
    for entry in entries:
        groups.setdefault(entry.owner, []).append(entry)
    yield from groups.items()


def _detector(scenes: Sequence[Scene], entries: Sequence[Entry]) -> rrb.Container | None:
    """Return, side by side, every run's statistics against their thresholds, above all stance lanes."""
    statistics = _of(entries, "detector")
    if not statistics:
        return None
    zoom = {path: span for s in scenes for path, span in s.zoom.items()}
    runs = [
        rrb.Vertical(*[_plot(e.title, [e], span=zoom.get(e.path)) for e in found], name=owner)
        for owner, found in _by_owner(statistics)
    ]
    top = rrb.Horizontal(*runs) if len(runs) <= 3 else rrb.Tabs(*runs)
    lanes = _lanes(entries)
    shares = [3.0, *[0.4 + 0.19 * len(_of(entries, "stance", "annotation"))] * len(lanes)]
    return rrb.Vertical(top, *lanes, row_shares=shares, name="Detector")


def _compare(scenes: Sequence[Scene], entries: Sequence[Entry]) -> rrb.Container | None:
    tracks = _of(entries, "track")
    if not tracks:
        return None
    plots: list[rrb.View | rrb.Container] = []
    if distance := _of(entries, "distance"):
        tracks, everything = _framed(scenes)
        worst = max((t.worst_m for t in tracks), default=0.0)
        span = None if everything or worst == 0.0 else (-0.1 * worst, 1.3 * worst)
        plots.append(_plot("distance to the reference (m)", distance, span=span))
    errors = _of(entries, "error", "sigma")
    if errors:
        zoom = {path: span for s in scenes for path, span in s.zoom.items()}
        views = [
            _plot(f"{owner}: error and ±1σ of the position (m)", found)
            if _of(found, "error")
            else _plot(f"{owner}: ±1σ of the position (m)", found, span=zoom.get(found[0].path))
            for owner, found in _by_owner(errors)
        ]
        plots.append(views[0] if len(views) == 1 else rrb.Tabs(*views))
    if speed := _of(entries, "speed"):
        plots.append(_plot("speed (m/s)", speed))
    if steps := _of(entries, "step"):
        plots.append(_plot("step length (m)", steps))
    if not plots:
        plots += _height(scenes, entries)
    return rrb.Horizontal(
        _plan(scenes, entries),
        rrb.Vertical(*plots),
        column_shares=[1, 1],
        name="Compare",
    )


def _report(entries: Sequence[Entry]) -> rrb.Container:
    reports = [
        rrb.TextDocumentView(origin=e.path, contents=[e.path], name=e.title) for e in _of(entries, "report")
    ]
    documents = reports[0] if len(reports) == 1 else rrb.Tabs(*reports)
    events = [e.path for e in _of(entries, "log")]
    if not events:
        return rrb.Vertical(documents, name="Report")
    log = rrb.TextLogView(origin="/", contents=events, name="steps and annotations")
    return rrb.Horizontal(documents, log, column_shares=[3, 2], name="Report")
