"""Figures of a recording for papers and pages: PNG and SVG, the same bytes for the same recording.

Matplotlib's object interface is used throughout; its global state (pyplot, rcParams) stays as the caller
has it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ..recording import Recording
from ..recording.atomic import AtomicFile
from ..recording.errors import MarchaError, UsageError
from ..replay.references import shown_reference
from ..replay.trajectory import stances_of
from ..replay.view import Comparison
from . import style
from .panels import GRID, TIME
from .text import printable
from .thinned import acc_norm, pieces, thinned
from .trace import ALIGNMENT, Trace, compared, distance, framed

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]

WALK = "walk"
"""The figure of tracks, heights, stances and errors."""

POINTS = 20_000
"""Most points of a line: more than any printer resolves."""

POSE = "geometry_msgs/msg/PoseStamped"
POSITION_SIGMA = ("sigma_pos_x", "sigma_pos_y", "sigma_pos_z")


def available_figures() -> dict[str, str]:
    """Return the figures by name, with one line each."""
    from .domain_figures import FIGURES

    lines = {name: (draw.__doc__ or "").strip().splitlines()[0] for name, draw in FIGURES.items()}
    return {WALK: "Tracks, height, stances under the accelerometer's norm, errors.", **lines}


def figure(recs: Recording | Sequence[Recording], *, kind: str = WALK, alignment: str = ALIGNMENT) -> Figure:
    """Return the figure of a recording: tracks, height, stances under the accelerometer's norm, errors.

    Parameters
    ----------
    recs : Recording or sequence of Recording
        With estimates, or raw (then only the signals are drawn). Several get one row each: tracks, height,
        errors.
    kind : str
        Another figure by its name, of one recording; see :func:`available_figures`.
    alignment : str
        How tracks are laid upon the reference; see :func:`marcha.replay.alignment.align`.

    Returns
    -------
    matplotlib.figure.Figure
        With the Agg canvas; save it with :func:`save_figure` for reproducible bytes.

    Raises
    ------
    UsageError
        No figure of this name, several recordings for one of another kind than ``walk``, or nothing in the
        recording for it, also of what is left of a damaged one.
    """
    chosen = [recs] if isinstance(recs, Recording) else list(recs)
    try:
        return _figure(chosen, kind, alignment)
    except MarchaError:
        raise
    except Exception as error:
        lost = next((f"{r.path}: {r.findings[0].detail}" for r in chosen if r.findings), "")
        if not lost:
            raise  # a defect of ours
        raise UsageError(f"{lost}; what is left does for no figure {kind!r} ({error})") from error


def _figure(chosen: list[Recording], kind: str, alignment: str) -> Figure:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    if kind != WALK:
        from .domain_figures import FIGURES

        if kind not in FIGURES:
            raise UsageError(f"figure {kind!r} is unknown; there are {', '.join(available_figures())}")
        if len(chosen) != 1:
            raise UsageError(f"figure {kind!r} is of one recording, not of {len(chosen)}")
        own = Figure(dpi=120, layout="constrained", facecolor="white")
        FigureCanvasAgg(own)
        FIGURES[kind](chosen[0], own)
        own.suptitle(printable(chosen[0].path.stem), fontsize=12, fontweight="bold")
        return own
    walks = [_walk(rec, alignment) for rec in chosen]
    if len(walks) == 1:
        size = (12.0, 7.0 if walks[0].tracks else 4.0)
    else:
        size = (13.0, 4.0 * len(walks))
    fig = Figure(figsize=size, dpi=120, layout="constrained", facecolor="white")
    FigureCanvasAgg(fig)
    if len(walks) == 1:
        _one(fig, walks[0])
        return fig
    for row, walk in zip(fig.subfigures(len(walks), 1, squeeze=False)[:, 0], walks, strict=True):
        row.suptitle(walk.rec.path.stem, fontsize=11, fontweight="bold")
        plan, *others = row.subplots(1, 3 if walk.with_errors else 2)
        _plan(plan, walk)
        for ax, draw in zip(others, (_heights, _errors), strict=False):
            _time(ax, draw, walk)
            ax.set_xlabel(TIME, fontsize=9)
    handles = {}
    for walk in walks:
        for track in walk.shown:
            handles.setdefault(track.owner, _key(track, walk))
    fig.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=4, fontsize=8)
    return fig


def save_figure(
    recs: Recording | Sequence[Recording],
    path: Path | str,
    *,
    overwrite: bool = False,
    kind: str = WALK,
    alignment: str = ALIGNMENT,
) -> Path:
    """Write the figure of one or several recordings as PNG or SVG, by the suffix.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    UsageError
        Another suffix.
    OutputExists
        The file exists and ``overwrite`` is false.
    """
    import matplotlib

    path = Path(path)
    suffix = path.suffix.lower().lstrip(".")
    if suffix not in ("png", "svg"):
        raise UsageError(f"{path}: figures are .png or .svg, not {path.suffix or 'without suffix'}")
    file = AtomicFile(path, overwrite=overwrite)
    try:
        # neither dates nor versions nor random ids: the same recording gives the same bytes
        metadata = {"Software": None} if suffix == "png" else {"Date": None, "Creator": None}
        with matplotlib.rc_context({"svg.hashsalt": "marcha", "svg.fonttype": "path"}):
            figure(recs, kind=kind, alignment=alignment).savefig(file.part, format=suffix, metadata=metadata)
    except BaseException:
        file.abort()
        raise
    file.commit()
    return path


# -- what is drawn ---------------------------------------------------------------------------------


@dataclass
class _Walk:
    """A recording and what its figure needs of it."""

    rec: Recording
    tracks: dict[str, Trace]
    references: dict[str, Trace]
    compared: dict[str, Comparison]
    alignment: str

    @property
    def zero_ns(self) -> int:
        return self.rec.start_ns or 0

    @property
    def shown(self) -> list[Trace]:
        return [*self.references.values(), *self.tracks.values()]

    @property
    def with_errors(self) -> bool:
        return bool(self.compared) or any(_position_sigma(self.rec, t) for t in self.tracks)

    def seconds(self, t_ns: NDArray[np.int64]) -> Floats:
        return (t_ns - self.zero_ns) / 1e9


def _topic(run: str, what: str) -> str:
    return f"/estimate/{run}/{what}"


def _position_sigma(rec: Recording, run: str) -> str:
    """Return the topic of a run's standard deviations if it has those of the position, else an empty one."""
    topic = _topic(run, "sigma")
    return topic if topic in rec.channels and {*POSITION_SIGMA} <= {*rec.channels[topic].columns} else ""


def _reference(rec: Recording, run: str) -> str | None:
    """Return the topic of the poses that a run is compared with, None where there are none."""
    topic = shown_reference(rec.channels, run, rec.metadata)
    return topic if topic is not None and rec.channels[topic].schema == POSE else None


def _walk(rec: Recording, alignment: str) -> _Walk:
    """Read every run's track, in the order of the recording, and the reference's, and compare them."""
    poses = [t for t, c in rec.channels.items() if c.schema == POSE]
    runs = [t for t in poses if t.startswith("/estimate/") and t.endswith("/pose")]
    truth = {t: _reference(rec, t.split("/")[2]) for t in runs}
    traces = {t: Trace(t.split("/")[2], style.run_color(i)) for i, t in enumerate(runs)}
    for topic in truth.values() if runs else [_reference(rec, "")]:
        if topic is not None:
            traces[topic] = Trace(" ".join(topic.split("/")[1:-1]), style.REFERENCE)
    for window in rec.windows(list(traces)) if traces else ():
        for topic, table in window.tables.items():
            position = table.select("pos_x", "pos_y", "pos_z").to_numpy()
            turn = table.select([f"quat_{a}" for a in "wxyz"]).to_numpy() if "quat_w" in table else None
            traces[topic].add(table["t_ns"].to_numpy(), position, turn)
    traces = {t: track for t, track in traces.items() if track.count}
    found_errors: dict[str, Comparison] = {}
    for topic, reference in truth.items():
        if topic in traces and reference in traces:
            track = traces[topic]
            result = compared(track, traces[reference], alignment)
            if result is not None:
                track.place, track.worst_m = result.transform, float(distance(result).max())
                found_errors[track.owner] = result
    tracks = {traces[t].owner: traces[t] for t in runs if t in traces}
    beside = {t: track for t, track in traces.items() if t.startswith("/reference/")}
    return _Walk(rec, tracks, beside, found_errors, alignment)


def _one(fig: Figure, walk: _Walk) -> None:
    """Lay out the figure of one recording: the plan on the left, everything over time on the right."""
    fig.suptitle(walk.rec.path.stem, fontsize=12, fontweight="bold")
    signals: Any = fig
    panels = [_signals]
    if walk.shown:
        left, signals = fig.subfigures(1, 2, squeeze=False, width_ratios=[1.0, 1.1])[0]
        ax = left.subplots()
        _plan(ax, walk)
        left.legend(*ax.get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize=8)
        sensed = any("acc_x" in c.columns or c.schema.endswith("/Stance") for c in walk.rec.channels.values())
        panels = [_heights, *([_signals] if sensed else []), *([_errors] if walk.with_errors else [])]
    axes = signals.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    for draw, ax in zip(panels, axes, strict=True):
        _time(ax, draw, walk)
    axes[-1].set_xlabel(TIME, fontsize=9)


def _time(ax: Axes, draw: Callable[[Axes, _Walk], None], walk: _Walk) -> None:
    draw(ax, walk)
    ax.grid(**GRID)
    ax.set_axisbelow(True)


def _thin(*columns: NDArray[Any]) -> list[NDArray[Any]]:
    stride = max(1, len(columns[0]) // POINTS)
    return [c[::stride] for c in columns]


def _label(ax: Axes, title: str, y: str) -> None:
    ax.set_title(title, fontsize=10, loc="left")
    ax.set_ylabel(y, fontsize=9)
    ax.tick_params(labelsize=8)


def _line(track: Trace, walk: _Walk) -> dict[str, Any]:
    """Return how a track's line looks: the reference lies wide and pale under the runs."""
    if track not in walk.references.values():
        return {"color": track.color, "linewidth": 1.4}
    return {"color": track.color, "linewidth": 3.0, "alpha": 0.6, "marker": "o" if track.sparse else ""}


def _key(track: Trace, walk: _Walk) -> Any:
    from matplotlib.lines import Line2D

    return Line2D([], [], **_line(track, walk))


def _plan(ax: Axes, walk: _Walk) -> None:
    """Draw all tracks from above, with equal axes, start and end marked."""
    for track in walk.shown:
        x, y = _thin(*track.shown[:, :2].T)
        ax.plot(x, y, **_line(track, walk), label=track.owner)
        ax.plot(x[-1], y[-1], "s", color=track.color, markersize=6, markeredgecolor="white", zorder=4)
    start = walk.shown[0].shown[0]
    ax.plot(start[0], start[1], "o", color="black", markersize=11, fillstyle="none", zorder=5, label="start")
    ax.plot([], [], "s", color="#666666", label="end")
    inside = np.concatenate([t.shown[:, :2] for t in framed(walk.shown)])
    low, high = inside.min(axis=0), inside.max(axis=0)
    margin = 0.08 * max(float(np.max(high - low)), 1.0)
    ax.set_xlim(low[0] - margin, high[0] + margin)
    ax.set_ylim(low[1] - margin, high[1] + margin)
    ax.set_aspect("equal", adjustable="box")
    ax.grid(**GRID)
    ax.set_axisbelow(True)
    _label(ax, f"from above{f' (alignment {walk.alignment})' if walk.compared else ''}", "y (m)")
    ax.set_xlabel("x (m)", fontsize=9)


def _heights(ax: Axes, walk: _Walk) -> None:
    for track in walk.shown:
        t, z = _thin(walk.seconds(track.t_ns), track.shown[:, 2])
        ax.plot(t, z, color=track.color, linewidth=1.0)
    z = np.concatenate([t.shown[:, 2] for t in framed(walk.shown)])
    margin = 0.1 * (float(np.ptp(z)) + 0.1)
    ax.set_ylim(float(z.min()) - margin, float(z.max()) + margin)
    _label(ax, "height", "z (m)")


def _signals(ax: Axes, walk: _Walk) -> None:
    """Draw the accelerometer's norm, and under it one lane of stances for each run and the reference."""
    rec, runs = walk.rec, list(walk.tracks)
    imus = [t for t, c in rec.channels.items() if "acc_x" in c.columns]
    read = [t for t in imus if any(t.strip("/").replace("/", "_") in run for run in runs)]
    drawn, high = (read or imus)[: 1 if runs else None], 0.0
    for i, topic in enumerate(drawn):
        t_ns, values = thinned(rec, topic, acc_norm, POINTS)
        t, norm = walk.seconds(t_ns), values[:, 0]
        ax.plot(t, norm, color=style.NORM if runs else style.run_color(i), linewidth=0.8, label=topic)
        high = max(high, float(np.nanmax(norm, initial=0.0)))
    lanes = [(f"{t.rpartition('/')[0]}/stance", style.REFERENCE) for t in walk.references]
    lanes = lanes or [("/reference/stance", style.REFERENCE)]
    lanes += [(_topic(run, "stance"), style.run_color(i)) for i, run in enumerate(runs)]
    lanes = [(topic, color) for topic, color in lanes if topic in rec.channels]
    height = 0.09 * max(high, 1.0)
    for k, (topic, color) in enumerate(lanes):
        bars = _stances(walk, topic)
        ax.broken_barh(bars, (-(k + 1.2) * height, 0.8 * height), facecolors=color, linewidth=0)
    title = f"norm of the accelerometer{f' of {drawn[0]}' if len(drawn) == 1 else ''}"
    _label(ax, title + (", and stances (bars: foot still)" if lanes else ""), "‖acc‖ (m/s²)")
    if lanes:
        ax.set_ylim(-(len(lanes) + 0.6) * height, 1.05 * max(high, 1.0))
        ax.set_yticks([v for v in ax.get_yticks() if 0.0 <= v <= high])
    if len(drawn) > 1:
        ax.legend(fontsize=8, framealpha=0.9, loc="upper right")


def _stances(walk: _Walk, topic: str) -> list[tuple[float, float]]:
    """Return the stances of a channel as (start, duration), s."""
    spans = stances_of(pieces(walk.rec, topic))
    starts, ends = walk.seconds(spans[:, 0]), walk.seconds(spans[:, 1])
    return list(zip(starts.tolist(), (ends - starts).tolist(), strict=True))


def _sigma(table: pl.DataFrame) -> Floats:
    axes = table.select(POSITION_SIGMA).to_numpy()  # a phone says nothing of the height: NaN
    stated = np.isfinite(axes).any(axis=1)
    return np.where(stated, np.sqrt(np.nansum(axes**2, axis=1)), np.nan)[:, None]


def _errors(ax: Axes, walk: _Walk) -> None:
    """Draw every run's distance to the reference as a line, and its filter's own sigma as an area."""
    inside, top = framed(walk.shown), 0.0
    for run, track in walk.tracks.items():
        if run in walk.compared:
            comparison = walk.compared[run]
            far = distance(comparison)
            t, d = _thin(walk.seconds(comparison.t_ns), far)
            ax.plot(t, d, color=track.color, linewidth=1.2)
            top = max(top, float(far.max())) if track in inside else top
        if topic := _position_sigma(walk.rec, run):
            t_ns, values = thinned(walk.rec, topic, _sigma, POINTS)
            t, sigma = walk.seconds(t_ns), values[:, 0]
            ax.fill_between(t, 0.0, sigma, color=track.color, alpha=0.2, linewidth=0)
            top = max(top, float(np.nanmax(sigma, initial=0.0))) if track in inside else top
    ax.set_ylim(0.0, 1.1 * top if top > 0.0 else 1.0)
    title = "distance to the reference (area: the filter's own 1σ)"
    _label(ax, title if walk.compared else "the filter's own 1σ of the position", "distance (m)")
