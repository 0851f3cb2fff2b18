"""Figures of a phone's walk: the detector by stages, the transform by stages, the track on a map."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ..recording import Recording
from ..recording.errors import UsageError
from ..recording.names import is_estimate
from ..replay.metrics_place import stated_covariances
from ..replay.source_stages import source_stages
from . import style
from .floor import loaders_of
from .panels import MOST_ELLIPSES, TIME, dress, nothing, seconds
from .shapes import ELLIPSE95, geo_circle, metres_a_degree
from .text import printable
from .thinned import first_rows
from .underlay import map_underlay
from .views.base import role_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]
SHOWN_S = 14.0
"""Time that the detector's panels show: about 25 steps, so that single peaks are seen."""
PEAK, VALLEY, LIMIT = "#D55E00", "#0072B2", "#009E73"
CORNER = {"loc": "upper right", "ncols": 2}


def detector(rec: Recording, fig: Figure) -> None:
    """The source's detector by stages: all extremes, the limits, the clusters and what is left of them, steps."""
    topics = [
        t
        for t, c in rec.channels.items()
        if c.schema == "sensor_msgs/msg/Imu" and "acc_x" in c.columns and c.count and role_of(t) == "raw"
    ]
    if not topics:
        raise nothing(rec, "no accelerometer")
    table, whole = first_rows(rec, topics[0])
    t = seconds(rec, table["t_ns"])
    norm = np.linalg.norm(table.select("acc_x", "acc_y", "acc_z").to_numpy(), axis=1)
    s = source_stages(t, norm)
    first = t[s.steps[len(s.steps) // 4]] if len(s.steps) else t[0]
    shown = (t >= first - 1.0) & (t < first - 1.0 + SHOWN_S)
    fig.set_size_inches(10.0, 11.0)
    panels = list(fig.subplots(4, 1, sharex=True))
    part = "the whole recording" if whole else f"the first {t[-1]:.0f} s"
    marks = (
        ("all peaks and valleys", s.peaks, s.valleys),
        ("beyond the limits mean ± σ", s.high, s.low),
        ("left by the temporal filter", s.kept_high, s.kept_low),
        (f"{len(s.steps)} steps in {part}", s.steps, s.steps[:0]),
    )
    for k, (ax, (title, high, low)) in enumerate(zip(panels, marks, strict=True)):
        ax.plot(t[shown], norm[shown], color=style.NORM, linewidth=0.8, label="‖acc‖")
        if k == 1:
            ax.plot(t[shown], s.upper[shown], color=LIMIT, linewidth=0.9, label="mean + σ")
            ax.plot(t[shown], s.lower[shown], color=LIMIT, linewidth=0.9, linestyle="--", label="mean − σ")
            ax.plot(t[shown], (s.upper + s.lower)[shown] / 2, color="#999999", linewidth=0.7, label="mean")
        if k == 2:  # what the temporal filter took away
            for places, kept in ((s.high, high), (s.low, low)):
                gone = np.setdiff1d(places, kept)
                gone = gone[shown[gone]]
                ax.plot(t[gone], norm[gone], "x", color="#777777", markersize=6)
        for places, color, mark, name in ((high, PEAK, "^", "peak"), (low, VALLEY, "v", "valley")):
            inside = places[shown[places]]
            if len(inside):
                name = "step" if k == 3 else name
                ax.plot(t[inside], norm[inside], mark, color=color, markersize=5, linestyle="", label=name)
        low_y, high_y = float(norm[shown].min()), float(norm[shown].max())
        ax.set_ylim(low_y - 0.06 * (high_y - low_y), high_y + 0.35 * (high_y - low_y))  # room for the legend
        dress(ax, f"{printable(topics[0])}: {title}", TIME, "m/s²", legend=CORNER)


def transform(rec: Recording, fig: Figure) -> None:
    """The local track with the fixes' times, then rotated, scaled and moved onto the fixes, pairs joined."""
    topics = [
        t for t, c in rec.channels.items() if {"rotation_rad", "shift_east_m"} <= set(c.columns) and c.count
    ]
    if not topics:
        raise nothing(rec, "no transform (estimator phone.transform)")
    run = topics[0].split("/")[2]
    inputs = json.loads(rec.metadata.get(f"run/{run}", {}).get("inputs", "{}"))
    if not inputs.get("pose") or not inputs.get("gnss"):
        raise UsageError(f"{rec.path}: run {run} does not say which track it laid on which fixes")
    about = rec.table(topics[0]).row(0, named=True)
    track, seen = rec.table(inputs["pose"][0]), rec.table(inputs["gnss"][0])
    seen = seen.filter(pl.col("lat_deg").is_finite() & pl.col("lon_deg").is_finite())
    t = track["t_ns"].to_numpy()
    when = seen["t_ns"].to_numpy()
    near = (when >= t[0] - 10**9) & (when <= t[-1] + 10**9)
    fixes, when = _utm(seen.filter(pl.Series(near)), int(about["zone"])), when[near]
    local = track.select("pos_x", "pos_y").to_numpy()
    c, w = np.cos(about["rotation_rad"]), np.sin(about["rotation_rad"])
    rotated = local @ np.array([[c, w], [-w, c]])
    scaled = about["scale"] * rotated
    zero = fixes.mean(axis=0)
    moved = scaled + np.array([about["shift_east_m"], about["shift_north_m"]]) - zero
    fixes = fixes - zero
    fig.set_size_inches(12.0, 11.0)
    axes = fig.subplots(2, 2).ravel()
    turn = np.degrees(about["rotation_rad"])
    stages = (
        ("local track, points at the fixes' times", local),
        (f"rotated by {turn:.1f}° (anticlockwise)", rotated),
        (f"scaled by {about['scale']:.3f}", scaled),
        (f"moved onto the fixes, residual {about['rms_m']:.1f} m (RMS)", moved),
    )
    for k, (ax, (title, points)) in enumerate(zip(axes, stages, strict=True)):
        positions = np.column_stack([np.interp(when - t[0], t - t[0], points[:, i]) for i in range(2)])
        ax.plot(
            *points.T,
            ".-",
            color=style.run_color(0),
            markersize=3,
            linewidth=0.8,
            label=_name(inputs["pose"][0]),
        )
        ax.plot(*positions.T, "o", color=PEAK, markersize=5, linestyle="", label="at the fixes' times")
        if k == 3:
            ax.plot(*fixes.T, "s", color=style.DEVICE, markersize=5, linestyle="", label="fixes")
            ax.plot(*np.stack((positions, fixes), axis=2).transpose(1, 2, 0), color="#999999", linewidth=0.7)
        frame = f"UTM zone {int(about['zone'])}, about the fixes' mean" if k == 3 else "local"
        dress(ax, title, f"east, {frame} (m)", "north (m)", legend=CORNER)
        ax.set_aspect("equal", adjustable="datalim")


def _utm(table: pl.DataFrame, zone: int) -> Floats:
    from pyproj import Proj

    south = bool(table["lat_deg"][0] < 0)
    east, north = Proj(proj="utm", zone=zone, south=south, ellps="WGS84")(
        table["lon_deg"].to_numpy(), table["lat_deg"].to_numpy()
    )
    return np.column_stack((east, north))


def _name(topic: str) -> str:
    return printable(topic.split("/")[2] if is_estimate(topic) else topic)


def street_map(rec: Recording, fig: Figure) -> None:
    """Fixes with circles of their accuracy, tracks with 95 % ellipses, reference; streets or aerial picture below."""
    topics = [t for t, c in rec.channels.items() if {"lat_deg", "lon_deg"} <= set(c.columns) and c.count]
    tables = {
        t: table
        for t in topics
        if (
            table := rec.table(t).filter(pl.col("lat_deg").is_finite() & pl.col("lon_deg").is_finite())
        ).height
    }
    if not tables:
        raise nothing(rec, "no fixes")
    fig.set_size_inches(10.0, 9.0)
    ax, under = fig.subplots(), map_underlay(loaders_of(rec))
    points = np.concatenate([t.select("lon_deg", "lat_deg").to_numpy() for t in tables.values()])
    low, high = points.min(axis=0), points.max(axis=0)
    if under.picture is not None:
        ax.imshow(under.picture, extent=under.corners, alpha=0.7, zorder=0)
    for k, line in enumerate(under.streets):
        ax.plot(
            line[:, 1], line[:, 0], color="#C9B48A", linewidth=2.2, zorder=1, label="" if k else "streets"
        )
    runs = list(dict.fromkeys(t.split("/")[2] for t in rec.channels if is_estimate(t)))
    for topic, table in tables.items():
        place = table.select("lat_deg", "lon_deg").to_numpy()
        if is_estimate(topic):
            color = style.run_color(runs.index(topic.split("/")[2]))
            ax.plot(place[:, 1], place[:, 0], color=color, linewidth=1.6, label=_name(topic), zorder=4)
            _ellipses(ax, rec, topic, table, place, color)
        elif role_of(topic) == "reference":
            label = f"{printable(topic)} (reference)"
            ax.plot(
                place[:, 1],
                place[:, 0],
                color=style.REFERENCE,
                linestyle="--",
                linewidth=1.6,
                label=label,
                zorder=5,
            )
        else:
            ax.plot(
                place[:, 1], place[:, 0], ".", color=style.DEVICE, label=f"{printable(topic)}, ±1σ", zorder=3
            )
            if {"sd_east_m", "sd_north_m"} <= set(table.columns):
                for ring in geo_circle(place, table.select("sd_east_m", "sd_north_m").to_numpy()):
                    ax.plot(ring[:, 1], ring[:, 0], color=style.DEVICE, linewidth=0.5, alpha=0.6, zorder=3)
    pad = 0.12 * max(float((high - low).max()), 2e-4)
    ax.set_xlim(low[0] - pad, high[0] + pad)
    ax.set_ylim(low[1] - pad, high[1] + pad)
    ax.set_aspect(1.0 / np.cos(np.radians(low[1])))
    dress(ax, "on the map (ellipses: 95 %)", "longitude (°)", "latitude (°)", legend=CORNER)
    ax.ticklabel_format(useOffset=False)
    ax.tick_params(axis="x", rotation=20)


def _ellipses(ax: Axes, rec: Recording, topic: str, table: pl.DataFrame, place: Floats, color: str) -> None:
    """Draw the ellipses that a run states, its correlation included."""
    beside = f"{topic.rpartition('/')[0]}/state"
    cov = stated_covariances(table, rec.table(beside) if beside in rec.channels else None)
    every = max(1, table.height // MOST_ELLIPSES)
    angle = np.linspace(0, 2 * np.pi, 49)
    unit = np.column_stack((np.cos(angle), np.sin(angle)))
    for k in range(0, table.height, every):
        if not np.isfinite(cov[k]).all():
            continue
        size, axes = np.linalg.eigh(cov[k])
        ring = ELLIPSE95 * (unit * np.sqrt(np.maximum(size, 0))) @ axes.T  # east, north (m)
        around = place[k] + ring[:, ::-1] / metres_a_degree(place[k : k + 1, 0])[0]
        ax.plot(around[:, 1], around[:, 0], color=color, linewidth=0.6, alpha=0.6, zorder=3)
