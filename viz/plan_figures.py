"""Figures of a floor plan: anchors and what lies between them, triples, fixes about true points, particles."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..recording import Recording
from ..recording.errors import UsageError
from . import style
from .canvas import is_estimate
from .floor import FloorPlan, plan_of
from .shapes import ELLIPSE95, circle
from .text import printable
from .trace import Trace

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]
MOMENTS = 6
"""Panels of clouds of particles over the time of a run."""
MOST_LINES = 66
"""Distances between so many pairs of anchors are drawn; of more only the nearest."""
STAYS_S, SAME_M = 4.0, 0.3
"""A true position that stays within so much for so long is a point at which somebody stood."""


def draw_floor(ax: Axes, plan: FloorPlan, *, names: bool = True) -> None:
    """Draw picture, outlines and anchors by technology."""
    if plan.picture is not None:
        ax.imshow(plan.picture, extent=plan.corners, alpha=0.6)
    for line in plan.outlines:
        ax.plot(line[:, 0], line[:, 1], color="#777777", linewidth=0.8)
    for i, kind in enumerate(dict.fromkeys(a.technology for a in plan.anchors.values())):
        where = np.array([a.position for a in plan.anchors.values() if a.technology == kind])
        label = f"anchors {kind}".strip() if names else None
        ax.plot(where[:, 0], where[:, 1], "s^vPX*"[i % 6], color="black", label=label)
    ax.set_aspect("equal", adjustable="datalim")
    ax.set_xlabel("x (m)", fontsize=9)
    ax.set_ylabel("y (m)", fontsize=9)
    ax.tick_params(labelsize=8)


def true_positions(rec: Recording) -> Trace | None:
    """Return the reference's positions, None where the recording has none."""
    for topic in ("/reference/pose", "/reference/position"):
        if topic in rec.channels and rec.channels[topic].count:
            table = rec.table(topic)
            trace = Trace(topic, style.REFERENCE)
            z = table["pos_z"].fill_nan(0.0)
            position = table.select("pos_x", "pos_y").with_columns(pos_z=z).to_numpy()
            trace.add(table["t_ns"].to_numpy(), position, None)
            return trace
    return None


def runs_with(rec: Recording, output: str) -> list[str]:
    """Return the runs (``/estimate/<run>``) that wrote an output."""
    return [
        t.rpartition("/")[0]
        for t, c in rec.channels.items()
        if is_estimate(t) and t.endswith(f"/{output}") and c.count
    ]


def _nothing(rec: Recording, what: str) -> UsageError:
    return UsageError(f"{rec.path}: nothing for this figure: {what}")


def anchors(rec: Recording, fig: Figure) -> None:
    """Floor plan with the anchors by technology and the distances between them."""
    plan = plan_of(rec)
    if not plan.anchors:
        raise _nothing(rec, "no anchor table")
    fig.set_size_inches(10.0, 6.5)
    ax = fig.subplots()
    pairs = [
        (float(np.linalg.norm(a.position[:2] - b.position[:2])), a, b)
        for a, b in itertools.combinations(plan.anchors.values(), 2)
    ]
    for far, a, b in sorted(pairs, key=lambda p: p[0])[:MOST_LINES]:
        ends = np.array([a.position[:2], b.position[:2]])
        ax.plot(ends[:, 0], ends[:, 1], color="#9ab", linewidth=0.7, zorder=0)
        if len(pairs) <= MOST_LINES / 2:
            x, y = ends.mean(axis=0).tolist()
            ax.text(x, y, f"{far:.1f}", fontsize=7, color="#456", ha="center", va="center")
    draw_floor(ax, plan)
    for one in plan.anchors.values():
        model = f"\n{one.p_d0:.1f} dBm, η {one.eta:.2f}" if np.isfinite(one.p_d0 + one.eta) else ""
        text = f"{printable(one.mac)}{model}"
        x, y = one.position[:2].tolist()
        ax.annotate(text, (x, y), xytext=(5, 5), textcoords="offset points", fontsize=7)
    ax.set_title("anchors, and the distances between them (m)", fontsize=10, loc="left")
    ax.legend(fontsize=8)


def triples(rec: Recording, fig: Figure) -> None:
    """Solutions of each three anchors in a window with their mean, the ranges' circles, and the true position."""
    runs = runs_with(rec, "triples")
    if not runs:
        raise _nothing(rec, "no run with triples (indoor.trilateration, indoor.hybrid)")
    run, plan, truth = runs[0], plan_of(rec), true_positions(rec)
    solutions, ranged = rec.table(f"{run}/triples"), rec.table(f"{run}/corrected")
    times = np.unique(solutions["t_ns"].to_numpy())
    chosen = times[np.unique(np.linspace(0, len(times) - 1, min(4, len(times))).round().astype(int))]
    fig.set_size_inches(13.0, 4.2 * ((len(chosen) + 1) // 2))
    axes = np.ravel(fig.subplots((len(chosen) + 1) // 2, min(2, len(chosen)), squeeze=False))
    for ax, t in zip(axes, chosen.tolist(), strict=False):
        draw_floor(ax, plan, names=False)
        points = solutions.filter(solutions["t_ns"] == t).select("triple_x", "triple_y").to_numpy()
        for mac, distance in ranged.filter(ranged["t_ns"] == t).select("mac", "distance_m").iter_rows():
            if (anchor := plan.anchors.get(mac)) is not None:
                ring = circle(anchor.position[None, :], np.full((1, 2), distance))[0]
                ax.plot(ring[:, 0], ring[:, 1], color="#9ab", linewidth=0.8)
        ax.plot(points[:, 0], points[:, 1], ".", color=style.run_color(0), label=f"{len(points)} triples")
        ax.plot(*points.mean(axis=0), "x", color="red", markersize=10, label="their mean")
        if truth is not None:
            ax.plot(*truth.at(np.array([t]))[0][:2], "o", color=style.REFERENCE, label="true position")
        low, high = _frame(plan, 3.0)
        outside = int((((points < low) | (points > high)).any(axis=1)).sum())
        ax.set_xlim(low[0], high[0])
        ax.set_ylim(low[1], high[1])
        beyond = f", {outside} triples beyond the picture" if outside else ""
        second = (t - (rec.start_ns or 0)) / 1e9
        ax.set_title(f"{printable(run[10:])}, window to {second:.0f} s{beyond}", fontsize=9, loc="left")
        ax.legend(fontsize=7, loc="upper right")
    for ax in axes[len(chosen) :]:
        ax.set_axis_off()


def _frame(plan: FloorPlan, margin_m: float) -> tuple[Floats, Floats]:
    points = [a.position[None, :2] for a in plan.anchors.values()] + list(plan.outlines)
    every = np.concatenate(points) if points else np.zeros((1, 2))
    return every.min(axis=0) - margin_m, every.max(axis=0) + margin_m


def points(rec: Recording, fig: Figure) -> None:
    """Fixes of each run about the true points at which somebody stood, with their mean errors."""
    truth, plan = true_positions(rec), plan_of(rec)
    if truth is None:
        raise _nothing(rec, "no true positions")
    stays = _stays(truth)
    runs = [r for r in runs_with(rec, "position") if f"{r}/ranges" in rec.channels] or runs_with(
        rec, "position"
    )
    if not stays or not runs:
        raise _nothing(rec, "nobody stood at a point, or no run has positions")
    fig.set_size_inches(13.0, 4.6 * len(runs))
    axes = np.ravel(fig.subplots(len(runs), 1, squeeze=False))
    for ax, run in zip(axes, runs, strict=True):
        draw_floor(ax, plan, names=False)
        table = rec.table(f"{run}/position")
        t, where = table["t_ns"].to_numpy(), table.select("pos_x", "pos_y").to_numpy()
        for k, (first, last, place) in enumerate(stays):
            mine = where[(t > first) & (t <= last)]
            color = style.run_color(k)
            ax.plot(*place, "*", color=color, markersize=14, markeredgecolor="black")
            if len(mine):
                error = np.linalg.norm(mine - place, axis=1)
                name = f"({place[0]:.1f}, {place[1]:.1f}): {len(mine)} fixes, mean error {error.mean():.2f} m"
                ax.plot(mine[:, 0], mine[:, 1], ".", color=color, label=name)
        ax.set_title(f"{_correction(rec, run)}{printable(run[10:])}", fontsize=10, loc="left")
        ax.legend(fontsize=7, loc="upper right")


def _correction(rec: Recording, run: str) -> str:
    about = rec.metadata.get(f"run/{run[10:]}", {})
    words = {"none": "plain: ", "votes": "corrected by vote: ", "both": "corrected both ways: "}
    return next(
        (w for k, w in words.items() if f'"correction":"{k}"' in about.get("params", "").replace(" ", "")), ""
    )


def _stays(truth: Trace) -> list[tuple[int, int, Floats]]:
    """Return first and last time and the place (2,) of each stay."""
    t, where = truth.t_ns, truth.positions[:, :2]
    if not len(t):
        return []
    moved = np.flatnonzero(np.linalg.norm(np.diff(where, axis=0), axis=1) > SAME_M / 10) + 1
    edges = [0, *moved.tolist(), len(t)]
    return [
        (int(t[a]), int(t[b - 1]), where[a:b].mean(axis=0))
        for a, b in itertools.pairwise(edges)
        if t[b - 1] - t[a] >= STAYS_S * 1e9
    ]


def particles(rec: Recording, fig: Figure) -> None:
    """Cloud of a particle filter at moments of the run, with its 95 % ellipse, the track so far and the truth."""
    runs = runs_with(rec, "particles")
    if not runs:
        raise _nothing(rec, "no run with particles (indoor.fused)")
    run, plan, truth = runs[0], plan_of(rec), true_positions(rec)
    cloud, track, stated = (rec.table(f"{run}/{name}") for name in ("particles", "position", "sigma"))
    times = np.unique(cloud["t_ns"].to_numpy())
    chosen = times[np.unique(np.linspace(0, len(times) - 1, min(MOMENTS, len(times))).round().astype(int))]
    columns = min(3, len(chosen))
    rows = -(-len(chosen) // columns)
    fig.set_size_inches(14.0, 3.8 * rows)
    axes = np.ravel(fig.subplots(rows, columns, squeeze=False))
    for ax, t in zip(axes, chosen.tolist(), strict=False):
        draw_floor(ax, plan, names=False)
        here = cloud.filter(cloud["t_ns"] == t).select("particle_x", "particle_y").to_numpy()
        past = track.filter(track["t_ns"] <= t).select("pos_x", "pos_y").to_numpy()
        sd = stated.filter(stated["t_ns"] <= t).select("sigma_pos_x", "sigma_pos_y").to_numpy()
        ax.plot(
            here[:, 0], here[:, 1], ".", color=style.run_color(0), markersize=3, alpha=0.7, label="particles"
        )
        ax.plot(past[:, 0], past[:, 1], color=style.run_color(1), linewidth=1.0, label="track so far")
        ring = circle(np.array([[*past[-1], 0.0]]), ELLIPSE95 * sd[-1:])[0]
        ax.plot(ring[:, 0], ring[:, 1], color=style.run_color(1), linewidth=0.8, linestyle="--", label="95 %")
        if truth is not None:
            ax.plot(*truth.at(np.array([t]))[0][:2], "o", color=style.REFERENCE, label="true position")
        ax.set_title(f"{(t - (rec.start_ns or 0)) / 1e9:.0f} s", fontsize=9, loc="left")
    for ax in axes[len(chosen) :]:
        ax.set_axis_off()
    axes[0].legend(fontsize=7, loc="upper right")
