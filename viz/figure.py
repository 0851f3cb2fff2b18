"""One picture of several recordings: every run's track from above and its height, beside the reference."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..recording.errors import MarchaError, OutputExists
from . import style
from .scene import is_estimate
from .track import Floats, Track, compare

if TYPE_CHECKING:
    from ..recording import Recording

POSE = "geometry_msgs/msg/PoseStamped"
MARGIN = 0.25
"""Room about the reference, as a share of its longer side; a track that runs farther leaves the picture."""


def write_figure(recs: Sequence[Recording], path: Path, *, overwrite: bool = False) -> None:
    """Draw plan view and height over time of every recording, one row each.

    Estimates are turned about the vertical and moved onto the reference, where the recording has one.

    Parameters
    ----------
    recs : sequence of Recording
        Recordings with pose channels.
    path : Path
        Picture to write; the suffix names the format (.png, .svg, .pdf).
    overwrite : bool
        Whether an existing picture may be replaced.

    Raises
    ------
    MarchaError
        A recording has no pose channel, or the format is unknown.
    OutputExists
        ``path`` exists and ``overwrite`` is false.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    path = Path(path)
    if path.exists() and not overwrite:
        raise OutputExists(path)
    figure = Figure(figsize=(11, 3.6 * len(recs)), layout="constrained")
    canvas = FigureCanvasAgg(figure)
    kind = path.suffix.removeprefix(".").lower()
    if kind not in canvas.get_supported_filetypes():
        known = ", ".join(sorted(canvas.get_supported_filetypes()))
        raise MarchaError(f"{path}: {path.suffix or 'no suffix'} is no picture format; choose one of {known}")
    axes = figure.subplots(len(recs), 2, squeeze=False, width_ratios=(1, 1.4))
    for rec, (plan, height) in zip(recs, axes, strict=True):
        _draw(rec, plan, height)
    part = path.with_name(f".{path.name}.part")
    try:
        figure.savefig(part, format=kind, dpi=130, metadata={"Software": None} if kind == "png" else None)
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def _draw(rec: Recording, plan: Any, height: Any) -> None:
    tracks = _tracks(rec)
    reference = next((track for topic, track in tracks if not is_estimate(topic)), None)
    runs = [track for topic, track in tracks if is_estimate(topic)]
    if not runs and reference is None:
        raise MarchaError(f"{rec.path}: has no pose channel to draw; replay it through an estimator first")
    zero = rec.start_ns or 0
    everything = [*runs, *([reference] if reference else [])]
    frame = _frame(reference.shown if reference else np.concatenate([t.shown for t in runs]))
    for track in everything:
        shown = track.shown
        if reference is not None and track is not reference and (fit := compare(track, reference, "se2")):
            shown = fit.place.points(track.positions)
        inside = bool(((shown >= frame[0]) & (shown <= frame[1])).all())
        look: dict[str, Any] = {"color": track.color, "lw": 1.2, "label": track.owner}
        if track is reference:
            look |= {"lw": 3.5, "alpha": 0.45, "zorder": 0}
        elif not inside:
            look["label"] += " (leaves the picture)"
        plan.plot(shown[:, 0], shown[:, 1], **look)
        height.plot((track.t_ns - zero) / 1e9, shown[:, 2], **look)
    plan.set(
        xlim=frame[:, 0],
        ylim=frame[:, 1],
        xlabel="x (m)",
        ylabel="y (m)",
        title=rec.path.stem,
        aspect="equal",
    )
    height.set(ylim=frame[:, 2], xlabel="time (s)", ylabel="height (m)")
    height.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), fontsize=8, frameon=False)
    for ax in (plan, height):
        ax.grid(alpha=0.25)


def _tracks(rec: Recording) -> list[tuple[str, Track]]:
    """Return the poses of the first reference and of every run, thinned."""
    found: list[tuple[str, Track]] = []
    poses = [c.topic for c in rec.channels.values() if c.schema == POSE and c.count]
    references = sorted(t for t in poses if not is_estimate(t))[:1]
    for topic in [*references, *(t for t in poses if is_estimate(t))]:
        if is_estimate(topic):
            number = sum(is_estimate(t) for t, _ in found)
            track = Track(topic.split("/")[2], style.run_color(number))
        else:
            track = Track(topic, style.REFERENCE)
        for window in rec.windows([topic]):
            table = window.tables.get(topic)
            if table is not None:
                positions = table.select("pos_x", "pos_y", "pos_z").to_numpy()
                track.add(table["t_ns"].to_numpy(), positions)
        if track.count:
            found.append((topic, track))
    return found


def _frame(points: Floats) -> Floats:
    """Return the corners (2, 3) of the picture: x and y with a margin, z with at least a metre."""
    low, high = points.min(axis=0), points.max(axis=0)
    room = MARGIN * max(float((high - low)[:2].max()), 1.0)
    pad = np.array([room, room, max(room / 2, 0.5)])
    return np.stack([low - pad, high + pad])
