"""Figures of radio positioning: the anchors' geometry, range circles, powers over distance, steps of the source."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ..recording import Recording
from ..recording.errors import UsageError
from ..recording.names import is_estimate
from . import style
from .floor import plan_of
from .panels import nothing, seconds
from .plan_figures import draw_floor, true_positions
from .shapes import circle
from .text import printable
from .thinned import first_rows

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]
RADIO, RANGING = "marcha_msgs/msg/RadioSignal", "marcha_msgs/msg/Ranging"
MOST_ANCHORS = 6
BOUND_LIMIT_M = 10.0
"""Bounds above this are drawn as this: there is no position there."""


def _title(ax: Axes, text: str) -> None:
    ax.set_title(text, fontsize=10, loc="left")


def geometry(rec: Recording, fig: Figure) -> None:
    """Cramér–Rao bound, dilution and anchors in reach over the plan, and what one more anchor would bring."""
    from ..replay.geometry import REACH_M, geometry_of

    maps, plan = geometry_of(rec), plan_of(rec)
    fig.set_size_inches(13.0, 7.5)
    axes = fig.subplots(2, 2).ravel()
    half = (maps.x[1] - maps.x[0]) / 2
    extent = (maps.x[0] - half, maps.x[-1] + half, maps.y[0] - half, maps.y[-1] + half)
    medians = [float(np.nanmedian(np.minimum(b, 1e3))) for b in (maps.bound_m, maps.extra_bound_m)]
    panels = (
        (
            maps.bound_m,
            f"least error of one power each (Cramér–Rao), median {medians[0]:.1f} m",
            "m",
            BOUND_LIMIT_M,
        ),
        (maps.dilution, "dilution of precision", "1", 5.0),
        (maps.heard, f"anchors within {REACH_M:g} m", "", max(4.0, float(np.nanmax(maps.heard)))),
        (maps.extra_bound_m, f"with one more anchor (★), median {medians[1]:.1f} m", "m", BOUND_LIMIT_M),
    )
    for ax, (values, title, unit, top) in zip(axes, panels, strict=True):
        clipped = np.where(np.isnan(values), np.nan, np.minimum(values, top))
        picture = ax.imshow(clipped.T, origin="lower", extent=extent, cmap="viridis", vmin=0.0, vmax=top)
        fig.colorbar(picture, ax=ax, label=unit, shrink=0.8)
        draw_floor(ax, plan, names=False)
        _title(ax, title)
    axes[3].plot(*maps.extra, "*", color="red", markersize=14)


def radiomap(rec: Recording, fig: Figure) -> None:
    """Expected power of the anchors over the plan: the survey's radio map, else the log-distance models."""
    from ..replay.geometry import power_map_of

    power_map, plan = power_map_of(rec), plan_of(rec)
    shown = list(range(min(len(power_map.anchors), MOST_ANCHORS)))
    rows = (len(shown) + 2) // 3
    fig.set_size_inches(13.0, 3.4 * rows)
    axes = fig.subplots(rows, min(3, len(shown)), squeeze=False).ravel()
    extent = (power_map.x[0], power_map.x[-1], power_map.y[0], power_map.y[-1])
    low, high = float(power_map.mean_dbm[shown].min()), float(power_map.mean_dbm[shown].max())
    for ax, k in zip(axes, shown, strict=False):
        picture = ax.imshow(
            power_map.mean_dbm[k].T, origin="lower", extent=extent, cmap="magma", vmin=low, vmax=high
        )
        fig.colorbar(picture, ax=ax, label="dBm", shrink=0.7)
        draw_floor(ax, plan, names=False)
        ax.plot(*power_map.anchors.plane[k], "*", color="cyan", markersize=11)
        kind = "surveyed" if power_map.surveyed else f"η {power_map.anchors.eta[k]:.2f}"
        _title(ax, f"{power_map.anchors.technology[k]} {printable(power_map.anchors.macs[k])}, {kind}")
    for ax in axes[len(shown) :]:
        ax.set_axis_off()


def ranges(rec: Recording, fig: Figure) -> None:
    """Range circles of one window before and after the correction by vote, with the fix and the true position."""
    runs = [
        t.rpartition("/")[0]
        for t, c in rec.channels.items()
        if is_estimate(t) and c.schema == RANGING and t.endswith("/corrected") and c.count
    ]
    if not runs:
        raise nothing(rec, "no run with ranges (indoor.trilateration, indoor.hybrid)")
    plan, run = plan_of(rec), runs[0]
    before, after = rec.table(f"{run}/ranges"), rec.table(f"{run}/corrected")
    joined = before.join(after, on=["t_ns", "mac"], suffix="_after")
    changed = joined.group_by("t_ns").agg(
        n=pl.len(), moved=(pl.col("distance_m") - pl.col("distance_m_after")).abs().max()
    )
    t_ns = int(changed.sort("moved", "n", descending=True)["t_ns"][0])
    fig.set_size_inches(13.0, 5.5)
    fixes = rec.table(f"{run}/position") if f"{run}/position" in rec.channels else None
    fix = fixes.filter(pl.col("t_ns") == t_ns) if fixes is not None else None
    truth = true_positions(rec)
    for ax, table, title in zip(
        fig.subplots(1, 2),
        (before, after),
        ("before the correction", "after the correction by vote"),
        strict=True,
    ):
        draw_floor(ax, plan)
        rows = table.filter(pl.col("t_ns") == t_ns)
        for i, (mac, distance) in enumerate(rows.select("mac", "distance_m").iter_rows()):
            anchor = plan.anchors.get(mac)
            if anchor is None:
                continue
            ring = circle(anchor.position[None, :], np.full((1, 2), distance))[0]
            ax.plot(
                ring[:, 0],
                ring[:, 1],
                color=style.run_color(i),
                linewidth=1.0,
                label=f"{printable(mac)}: {distance:.1f} m",
            )
        if fix is not None and fix.height:
            ax.plot(fix["pos_x"][0], fix["pos_y"][0], "x", color="red", markersize=9, label="fix")
        if truth is not None:
            ax.plot(*truth.at(np.array([t_ns]))[0][:2], "o", color=style.REFERENCE, label="true position")
        _title(ax, f"{title}, window to {(t_ns - (rec.start_ns or 0)) / 1e9:.0f} s")
        ax.legend(fontsize=7, loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=3)


def powers(rec: Recording, fig: Figure) -> None:
    """Received power over distance: means with the fitted models and other exponents, histograms by distance."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    from ..replay import calibrate

    models = calibrate("radio", [rec], {"method": "regression"})[0].values["anchors"]
    try:
        source = {a["mac"]: a for a in calibrate("radio", [rec], {"method": "source"})[0].values["anchors"]}
    except UsageError:
        source = {}
    fitted = [a for a in models if a.get("p_d0") is not None][:MOST_ANCHORS]
    if not fitted:
        raise nothing(rec, "no anchor with powers at four distances")
    anchors = plan_of(rec).anchors
    topic = next(t for t, c in rec.channels.items() if c.schema == RADIO and c.count and not is_estimate(t))
    table, truth = rec.table(topic), true_positions(rec)
    assert truth is not None  # the calibration found positions
    fig.set_size_inches(12.0, 3.2 * len(fitted))
    axes = fig.subplots(len(fitted), 2, squeeze=False)
    for (left, right), one in zip(axes, fitted, strict=True):
        rows = table.filter(pl.col("mac") == one["mac"])
        anchor = anchors[one["mac"]]
        gone = np.linalg.norm(truth.at(rows["t_ns"].to_numpy()) - anchor.position, axis=1)
        rssi = rows["rssi_dbm"].cast(pl.Float64).to_numpy()
        means = np.array([[np.linalg.norm(np.array(p[:3]) - anchor.position), p[3]] for p in one["points"]])
        left.plot(gone, rssi, ".", color="#bbbbbb", markersize=3, label="powers")
        left.plot(means[:, 0], means[:, 1], "o", color="black", markersize=4, label="trimmed means")
        d = np.geomspace(max(0.1, means[:, 0].min()), means[:, 0].max(), 80)
        line = one["p_d0"] - 10 * one["eta"] * np.log10(d)
        left.plot(
            d, line, color=style.run_color(0), label=f"regression: {one['p_d0']:.1f} dBm, η {one['eta']:.2f}"
        )
        if (other := source.get(one["mac"], {})).get("p_d0") is not None:
            line = other["p_d0"] - 10 * other["eta"] * np.log10(d)
            left.plot(
                d,
                line,
                color=style.run_color(1),
                label=f"source: {other['p_d0']:.1f} dBm, η {other['eta']:.2f}",
            )
        for eta in (2.0, 3.0):
            line = one["p_d0"] - 10 * eta * np.log10(d)
            left.plot(d, line, color="#888888", linewidth=0.8, linestyle=":", label=f"η {eta:g}")
        left.set_xscale("log")
        left.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        left.xaxis.set_major_formatter(FuncFormatter(lambda metres, _: f"{metres:g}"))
        left.xaxis.set_minor_formatter(NullFormatter())
        left.set_xlabel("distance (m)", fontsize=9)
        left.set_ylabel("dBm", fontsize=9)
        left.legend(fontsize=7)
        _title(left, f"{anchor.technology} {printable(one['mac'])}: residual {one['residual_db']:.1f} dB")
        edges = np.unique(np.round(np.quantile(gone, np.linspace(0, 1, 7)), 1))
        bins = np.arange(np.floor(rssi.min()) - 0.5, np.ceil(rssi.max()) + 1.5, 1.0)
        for k, (a, b) in enumerate(itertools.pairwise(edges)):
            inside = (gone >= a) & (gone <= b)
            if inside.any():
                right.hist(
                    rssi[inside],
                    bins=bins,
                    histtype="step",
                    color=style.run_color(k),
                    label=f"{a:.1f} – {b:.1f} m",
                )
        right.set_xlabel("dBm", fontsize=9)
        right.set_ylabel("packets", fontsize=9)
        right.legend(fontsize=7)
        _title(right, "histograms by distance")


def threshold(rec: Recording, fig: Figure) -> None:
    """Linear vertical acceleration with the step threshold and the steps taken, and the azimuth over the walk."""
    acc = next(
        (t for t, c in rec.channels.items() if "acc_z" in c.columns and c.count and not is_estimate(t)), None
    )
    if acc is None:
        raise nothing(rec, "no accelerometer")
    table, whole = first_rows(rec, acc)
    t_ns = table["t_ns"].to_numpy()
    t, values = seconds(rec, t_ns), table.select("acc_x", "acc_y", "acc_z").to_numpy()
    linear = values[:, 2] - _low_pass(t, values[:, 2])
    runs = [t for t, c in rec.channels.items() if is_estimate(t) and c.schema.endswith("/Step") and c.count]
    fig.set_size_inches(12.0, 6.5)
    top, below = fig.subplots(2, 1, sharex=True)
    top.plot(t, linear, color=style.NORM, linewidth=0.8, label="z − low pass (0.08 s)")
    for sign in (1, -1):
        top.axhline(
            sign * THRESHOLD,
            color="red",
            linewidth=0.8,
            linestyle="--",
            label="±0.55 m/s²" if sign > 0 else None,
        )
    for k, topic in enumerate(runs[:3]):
        ends = rec.table(topic)["t_ns"].to_numpy()
        ends = ends if whole else ends[ends <= t_ns[-1]]
        name = f"{printable(topic.split('/')[2])}: {len(ends)} steps"
        top.plot(
            seconds(rec, ends),
            np.interp(ends, t_ns, linear),
            "d",
            color=style.run_color(k),
            label=name,
        )
    top.set_ylabel("m/s²", fontsize=9)
    top.legend(fontsize=8)
    part = "" if whole else f", the first {t[-1]:.0f} s"
    _title(top, f"linear vertical acceleration of {printable(acc)}{part}")
    turn = next(
        (t for t, c in rec.channels.items() if c.schema.endswith("/QuaternionStamped") and c.count), None
    )
    if turn is not None:
        q, _ = first_rows(rec, turn)
        w, x, y, z = q.select("quat_w", "quat_x", "quat_y", "quat_z").to_numpy().T
        azimuth = np.degrees(np.unwrap(np.arctan2(2 * (x * y - w * z), 1 - 2 * (x * x + z * z))))
        below.plot(seconds(rec, q["t_ns"]), azimuth, color=style.DEVICE, linewidth=0.8)
        _title(below, f"azimuth of {printable(turn)} (clockwise from north, unwrapped)")
    below.set_ylabel("°", fontsize=9)
    below.set_xlabel("time (s)", fontsize=9)


THRESHOLD, GRAVITY_S = 0.55, 0.08
"""The source's threshold (m/s²) and the time constant of its low pass (s)."""


def _low_pass(t: Floats, values: Floats) -> Floats:
    """Return the source's gravity: α grav + (1 − α) acc with α of the mean interval (eqs 3.24–3.26)."""
    from scipy.signal import lfilter

    dt = float(np.mean(np.diff(t))) if len(t) > 1 else 0.02
    alpha = GRAVITY_S / (GRAVITY_S + dt)
    out, _ = lfilter([1 - alpha], [1, -alpha], values, zi=[alpha * values[0]])
    return np.asarray(out)
