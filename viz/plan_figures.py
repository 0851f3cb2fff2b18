"""Figures of a floor plan: anchors and what lies between them, triples, fixes about true points, particles."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..recording import Recording
from ..recording.names import is_estimate
from . import style
from .floor import FloorPlan, plan_of
from .panels import nothing
from .shapes import ELLIPSE95, circle
from .text import printable
from .trace import Trace

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.transforms import Bbox

Floats = NDArray[np.float64]
MOMENTS = 6
"""Panels of clouds of particles over the time of a run."""
MOST_LINES = 30
"""Distances between so many pairs of anchors are drawn; of more those of each to its nearest ones."""
NEAREST = 3
AROUND = ((6, 6), (6, -6), (-6, 6), (-6, -6), (0, 10), (0, -10), (14, 14), (-14, -14), (14, -14), (-14, 14))
"""Where a label may stand beside its anchor (points)."""
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
        channel = rec.channels.get(topic)
        if channel is not None and channel.count and {"pos_x", "pos_y", "pos_z"} <= set(channel.columns):
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


def anchors(rec: Recording, fig: Figure) -> None:
    """Floor plan with the anchors by technology and the distances between them."""
    plan = plan_of(rec)
    if not plan.anchors:
        raise nothing(rec, "no anchor table")
    fig.set_size_inches(10.0, 6.5)
    ax = fig.subplots()
    pairs = [
        (float(np.linalg.norm(a.position[:2] - b.position[:2])), a, b)
        for a, b in itertools.combinations(plan.anchors.values(), 2)
    ]
    pairs.sort(key=lambda p: p[0])
    few = len(pairs) <= MOST_LINES
    if not few:  # of each anchor those to its nearest
        near = {a.mac: [p for p in pairs if a in p[1:]][:NEAREST] for a in plan.anchors.values()}
        pairs = [p for p in pairs if any(p in mine for mine in near.values())]
    draw_floor(ax, plan)
    ax.legend(fontsize=8, loc="upper left", bbox_to_anchor=(1.01, 1.0))
    between = [
        (f"{far:.1f}", a.position[:2] + share * (b.position[:2] - a.position[:2]))
        for (far, a, b), share in zip(pairs, itertools.cycle((0.5, 0.4, 0.6)))
    ]
    for _, a, b in pairs:
        ends = np.array([a.position[:2], b.position[:2]])
        ax.plot(ends[:, 0], ends[:, 1], color="#9ab", linewidth=0.7, zorder=0)
    words = []
    for one in plan.anchors.values():
        model = f"\n{one.p_d0:.1f} dBm, η {one.eta:.2f}" if np.isfinite(one.p_d0 + one.eta) else ""
        words.append((f"{printable(one.mac)}{model}", one.position[:2]))
    taken = place_labels(ax, words)
    place_labels(ax, between, color="#456", offsets=((0, 0), *AROUND), taken=taken)
    which = "the distances between them" if few else f"the distances of each to its nearest {NEAREST}"
    ax.set_title(f"anchors, and {which} (m)", fontsize=10, loc="left")


def place_labels(
    ax: Axes,
    labels: Sequence[tuple[str, Floats]],
    *,
    color: str = "black",
    offsets: Sequence[tuple[int, int]] = AROUND,
    taken: Sequence[Bbox] = (),
) -> list[Bbox]:
    """Write labels beside places so that they cover each other as little as can be; return the boxes that are taken.

    Parameters
    ----------
    ax : Axes
        With its limits set by what is drawn already.
    labels : sequence of (str, ndarray)
        Text, and the place (2,) that it belongs to.
    color : str
        Of the text.
    offsets : sequence of (int, int)
        Points (1/72 inch) from the place to the label's near side, in order of preference.
    taken : sequence of Bbox
        Boxes (pixels) that are there.
    """
    from matplotlib.transforms import Bbox

    boxes = list(taken)
    ax.get_figure(root=True).draw_without_rendering()  # type: ignore[union-attr]
    markers = [Bbox.from_extents(*(p - 5), *(p + 5)) for p in (ax.transData.transform(w) for _, w in labels)]
    for text, where in labels:
        best: tuple[float, Any, Bbox | None] = (np.inf, None, None)
        for right, up in offsets:
            note = ax.annotate(
                text,
                (float(where[0]), float(where[1])),
                xytext=(right, up),
                textcoords="offset points",
                fontsize=7,
                color=color,
                ha="left" if right > 0 else "right" if right < 0 else "center",
                va="bottom" if up > 0 else "top" if up < 0 else "center",
            )
            box = note.get_window_extent()
            crossed = [Bbox.intersection(box, other) for other in (*boxes, *markers)]
            covered = sum(c.width * c.height for c in crossed if c is not None)
            if covered < best[0]:
                if best[1] is not None:
                    best[1].remove()
                best = covered, note, box
            else:
                note.remove()
            if covered == 0:
                break
        if best[2] is not None:
            boxes.append(best[2])
    return boxes


def triples(rec: Recording, fig: Figure) -> None:
    """Solutions of each three anchors in a window with their mean, the ranges' circles, and the true position."""
    runs = runs_with(rec, "triples")
    if not runs:
        raise nothing(rec, "no run with triples (indoor.trilateration, indoor.hybrid)")
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
        ax.set_aspect("equal", adjustable="box")
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
        raise nothing(rec, "no true positions")
    stays = _stays(truth)
    runs = [r for r in runs_with(rec, "position") if f"{r}/ranges" in rec.channels] or runs_with(
        rec, "position"
    )
    if not stays or not runs:
        raise nothing(rec, "nobody stood at a point, or no run has positions")
    fig.set_size_inches(13.0, 4.6 * len(runs))
    axes = np.ravel(fig.subplots(len(runs), 1, squeeze=False))
    low, high = _frame(plan, 3.0)
    for ax, run in zip(axes, runs, strict=True):
        draw_floor(ax, plan, names=False)
        table = rec.table(f"{run}/position")
        outside = 0
        t, where = table["t_ns"].to_numpy(), table.select("pos_x", "pos_y").to_numpy()
        for k, (first, last, place) in enumerate(stays):
            mine = where[(t > first) & (t <= last)]
            color = style.run_color(k)
            ax.plot(*place, "*", color=color, markersize=14, markeredgecolor="black")
            if len(mine):
                error = np.linalg.norm(mine - place, axis=1)
                name = f"({place[0]:.1f}, {place[1]:.1f}): {len(mine)} fixes, mean error {error.mean():.2f} m"
                ax.plot(mine[:, 0], mine[:, 1], ".", color=color, label=name)
                outside += int(((mine < low) | (mine > high)).any(axis=1).sum())
        if plan:  # one bad fix must not make the floor small
            ax.set_aspect("equal", adjustable="box")
            ax.set_xlim(low[0], high[0])
            ax.set_ylim(low[1], high[1])
        beyond = f", {outside} fixes beyond the picture" if plan and outside else ""
        ax.set_title(f"{_correction(rec, run)}{printable(run[10:])}{beyond}", fontsize=10, loc="left")
        ax.legend(fontsize=7, loc="upper left", bbox_to_anchor=(1.01, 1.0))


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
        raise nothing(rec, "no run with particles (indoor.fused)")
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
