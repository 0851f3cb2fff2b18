"""The study's pictures: box plots, Q-Q plots, tracks, run times and consistency.

Every function returns a matplotlib figure; none shows or saves one. One colour means one filter throughout.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import matplotlib
import numpy as np
import polars as pl
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import LogFormatter

from . import config as cfg
from .analysis import by_number, order
from .cells import StudyCell
from .pairs import subsets
from .report import NEES_TITLES
from .statistics import normal_quantiles

#: Okabe and Ito (2008): told apart with every kind of colour vision.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#F0E442")
GREY = "#666666"

#: Quartiles of fewer values say nothing: those groups are drawn as points.
BOX_LEAST = 5

#: A scale begins at 0 where the smallest value is below this share of the largest: correlations near 1 do not.
NEAR_ZERO = 0.5

#: Dots per inch of the PNG.
DPI = 120

#: matplotlib's settings for all figures; text stays text in SVG.
STYLE: Any = {
    "font.size": 10,
    "axes.titlesize": 11,
    "axes.titley": 1.0,  # where it would be put anyway, after a search for ticks that it might touch
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e3e3e3",
    "svg.fonttype": "none",
    "svg.hashsalt": "marcha",
    "figure.constrained_layout.use": True,
}

Samples = Mapping[str, np.ndarray]


def colour(index: int) -> str:
    """Return the colour of the level with this number."""
    return COLOURS[index % len(COLOURS)]


def _samples(frame: pl.DataFrame, factor: str, levels: Sequence[str]) -> dict[str, np.ndarray]:
    good = frame.filter(~pl.col("outlier") & pl.col("value").is_finite())
    samples = {level: good.filter(pl.col(factor) == level)["value"].to_numpy() for level in levels}
    return {level: values for level, values in samples.items() if len(values)}


def _box(
    ax: Axes, samples: Samples, colours: Sequence[str], positions: Sequence[float], width: float
) -> None:
    """Draw boxes (quartiles, whiskers to 1.5 interquartile ranges), means and, below 20, every value."""
    chosen = [k for k, values in enumerate(samples.values()) if len(values) >= BOX_LEAST]
    everything = list(samples.values())
    if chosen:
        parts = ax.boxplot(
            [everything[k] for k in chosen],
            positions=[positions[k] for k in chosen],
            widths=width,
            patch_artist=True,
            manage_ticks=False,
            medianprops={"color": "black"},
            flierprops={"marker": ".", "markersize": 4, "markerfacecolor": GREY, "markeredgecolor": GREY},
        )
        for box, k in zip(parts["boxes"], chosen, strict=True):
            box.set(facecolor=colours[k], alpha=0.65)
    for position, values, face in zip(positions, everything, colours, strict=True):
        if len(values) < 20:
            spread = np.linspace(-0.2, 0.2, len(values)) * width if len(values) > 1 else np.zeros(1)
            small = len(values) < BOX_LEAST
            ax.plot(
                position + spread,
                values,
                "o" if small else ".",
                color=face if small else "black",
                markersize=5 if small else 3,
                alpha=0.8,
            )
    means = [values.mean() for values in everything]
    ax.plot(positions, means, "D", markersize=4, markerfacecolor="white", markeredgecolor="black")


def _axis_label(frame: pl.DataFrame) -> str:
    metric, unit = frame["metric"][0], frame["unit"][0]
    return f"{metric} ({unit})" if unit else metric


class _PlainLogFormatter(LogFormatter):
    """Plain numbers where a logarithmic axis is labelled; powers of ten are typeset, which is slow."""

    def __call__(self, x: float, pos: int | None = None) -> str:
        return f"{x:g}" if super().__call__(x, pos) else ""


def _log_scale(ax: Axes) -> None:
    ax.set_yscale("log")
    ax.yaxis.set_major_formatter(_PlainLogFormatter())
    ax.yaxis.set_minor_formatter(_PlainLogFormatter(minor_thresholds=(1.5, 0.7)))


def _name_ticks(ax: Axes, labels: Sequence[str], inches: float) -> None:
    """Label the positions 0, 1 … of the horizontal axis, slanted where they would overlap."""
    long = 0.09 * max(map(len, labels), default=0) > inches / max(1, len(labels))
    ax.set_xticks(range(len(labels)), labels, rotation=25 if long else 0, ha="right" if long else "center")


def _scale(ax: Axes, frame: pl.DataFrame, log: bool) -> None:
    values = frame.filter(~pl.col("outlier") & pl.col("value").is_finite())["value"]
    if log and len(values) and float(values.min()) > 0:  # pyright: ignore[reportArgumentType]
        _log_scale(ax)
    elif len(values) and 0 <= float(values.min()) < NEAR_ZERO * float(values.max()):  # pyright: ignore[reportArgumentType]
        # The margin of a scale that begins at 0 is a share of all of it: the topmost marker is drawn whole.
        ax.set_ylim(0, max(ax.get_ylim()[1], 1.06 * float(ax.dataLim.y1)))


def box_by(frame: pl.DataFrame, config: cfg.StudyConfig, factor: str, log: bool = False) -> Figure:
    """Box plot by one factor of one metric (its rows of :func:`~marcha.study.analysis.values`)."""
    levels = order(frame, config)[factor]
    samples = _samples(frame, factor, levels)
    figure = Figure(figsize=(max(4.5, 1.6 + 0.9 * len(samples)), 3.8))
    ax = figure.subplots()
    colours = [colour(levels.index(s)) if factor == "filter" else "#9db4c8" for s in samples]
    _box(ax, samples, colours, range(len(samples)), 0.6)
    long = sum(map(len, samples)) > 45
    labels = [f"{level}\nn = {len(v)}" for level, v in samples.items()]
    ax.set_xticks(range(len(samples)), labels, rotation=30 if long else 0, ha="right" if long else "center")
    ax.grid(axis="x", visible=False)
    ax.set(xlabel=factor, ylabel=_axis_label(frame), title=f"{frame['metric'][0]} by {factor}")
    _scale(ax, frame, log)
    return figure


def box_by_both(frame: pl.DataFrame, config: cfg.StudyConfig, log: bool = False) -> Figure:
    """Box plot of one metric by configuration, and by filter within each."""
    levels = order(frame, config)
    filters, configurations = levels["filter"], levels["configuration"]
    inches = max(4.5, 0.42 * len(filters) * len(configurations))
    figure = Figure(figsize=(1.5 + inches, 4.0))
    ax = figure.subplots()
    width = 0.8 / max(1, len(filters))
    for i, configuration in enumerate(configurations):
        samples = _samples(frame.filter(pl.col("configuration") == configuration), "filter", filters)
        numbers = [filters.index(s) for s in samples]
        positions = [i - 0.4 + width * (k + 0.5) for k in numbers]
        _box(ax, samples, [colour(k) for k in numbers], positions, 0.8 * width)
    _name_ticks(ax, configurations, inches)
    ax.set_xlim(-0.5, len(configurations) - 0.5)
    for i in range(1, len(configurations)):
        ax.axvline(i - 0.5, color="#c8c8c8", linewidth=0.8)
    ax.grid(axis="x", visible=False)
    ax.set(xlabel="configuration", ylabel=_axis_label(frame))
    ax.set_title(f"{frame['metric'][0]} by configuration and filter")
    handles = [Patch(facecolor=colour(k), alpha=0.65, label=name) for k, name in enumerate(filters)]
    mean = Line2D(
        [], [], marker="D", linestyle="", markersize=4, markerfacecolor="white", color="black", label="mean"
    )
    figure.legend(
        handles=[*handles, mean], loc="outside lower center", ncols=min(5, len(handles) + 1), frameon=False
    )
    _scale(ax, frame, log)
    return figure


def qq(frame: pl.DataFrame, config: cfg.StudyConfig) -> Figure | None:
    """Normal Q-Q plot of one metric, a panel a configuration; None where every group is too small.

    Values are standardized with their group's mean and standard deviation, so that all filters fit one panel. Where
    no configuration has walks enough, all configurations are one panel, clipped walks another one.
    """
    levels = order(frame, config)
    filters = levels["filter"]
    good = frame.filter(~pl.col("outlier") & pl.col("value").is_finite())
    parts = {c: good.filter(configuration=c) for c in levels["configuration"]}
    groups = _fitting(parts, filters, config.statistics.min_samples)
    if not groups:
        parts = {
            f"all configurations{'' if name == 'all' else f', {name}'}": part for name, part in subsets(good)
        }
        groups = _fitting(parts, filters, config.statistics.min_samples)
    if not groups:
        return None
    columns = min(4, len(groups))
    rows = -(-len(groups) // columns)
    figure = Figure(figsize=(max(5.0, 0.8 + 2.9 * columns), 1.1 + 2.7 * rows))
    axes = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True).ravel()
    for ax, (configuration, samples) in zip(axes, groups.items(), strict=False):
        reach = 2.0
        for name, values in samples.items():
            quantiles = normal_quantiles(len(values))
            standardized = np.sort((values - values.mean()) / values.std(ddof=1))
            ax.plot(quantiles, standardized, ".", color=colour(filters.index(name)), markersize=5)
            reach = max(reach, float(quantiles[-1]))
        ax.plot([-reach, reach], [-reach, reach], color="black", linewidth=0.9)
        ax.set_title(configuration)
    for ax in axes[len(groups) :]:
        ax.set_visible(False)
    for ax in axes[max(0, len(groups) - columns) : len(groups)]:
        ax.set_xlabel("quantile of the normal distribution")
    for ax in axes[::columns]:
        ax.set_ylabel("standardized value")
    drawn = [k for k, f in enumerate(filters) if any(f in samples for samples in groups.values())]
    handles = [Line2D([], [], marker="o", linestyle="", color=colour(k), label=filters[k]) for k in drawn]
    figure.legend(handles=handles, loc="outside lower center", ncols=5, frameon=False)
    figure.suptitle(f"Q-Q plots of {frame['metric'][0]}")
    return figure


def _fitting(
    parts: Mapping[str, pl.DataFrame], filters: Sequence[str], least: int
) -> dict[str, dict[str, np.ndarray]]:
    """Return the values by part and filter, of the groups that have ``least`` values and are not all alike."""
    groups: dict[str, dict[str, np.ndarray]] = {}
    for name, part in parts.items():
        samples = {
            f: v for f, v in _samples(part, "filter", filters).items() if len(v) >= least and np.ptp(v) > 0
        }
        if samples:
            groups[name] = samples
    return groups


def tracks(cells: Sequence[StudyCell], config: cfg.StudyConfig) -> Figure | None:
    """Overlaid tracks seen from above, a panel a configuration × filter."""
    drawn: dict[tuple[str, str], list[StudyCell]] = {}
    for cell in cells:
        if cell.status == "ok" and len(cell.positions) > 1:
            drawn.setdefault((cell.label, cell.configuration), []).append(cell)
    if not drawn:
        return None
    labels, configurations = {f for f, _ in drawn}, sorted({c for _, c in drawn}, key=by_number)
    filters = [f for f in dict.fromkeys(m.label for m in cfg.methods(config)) if f in labels]
    # One filter on many configurations goes across the page, not down.
    across = len(filters) < 3 < len(configurations)
    rows, columns = (filters, configurations) if across else (configurations, filters)
    figure = Figure(figsize=(0.8 + 2.4 * len(columns), 0.9 + 2.4 * len(rows)))
    axes = figure.subplots(len(rows), len(columns), squeeze=False, sharex=True, sharey=True)
    middle, reach = _frame([cell for own in drawn.values() for cell in own])
    for i, row in enumerate(rows):
        for k, column in enumerate(columns):
            name, configuration = (row, column) if across else (column, row)
            ax = axes[i, k]
            _overlay(ax, drawn.get((name, configuration), []), colour(filters.index(name)), middle, reach)
            if i == 0:
                ax.set_title(column)
            if k == 0:
                ax.set_ylabel(f"{row}\ny (m)")
            if i == len(rows) - 1:
                ax.set_xlabel("x (m)")
    axes[0, 0].set(xlim=(middle[0] - reach, middle[0] + reach), ylim=(middle[1] - reach, middle[1] + reach))
    figure.suptitle("Tracks from above")
    return figure


def level_boxes(frame: pl.DataFrame, config: cfg.StudyConfig, factor: str) -> Figure:
    """Every metric of one filter, a panel each: by configuration, and by level of ``factor`` within each.

    With one configuration it is figure 36 of the foot dissertation (two detectors).
    """
    levels = order(frame, config)
    names, configurations = levels[factor], levels["configuration"]
    metrics = frame["metric"].unique(maintain_order=True).to_list()
    columns = min(2, len(metrics))
    rows = -(-len(metrics) // columns)
    inches = max(2.6, 0.45 * len(names) * len(configurations))
    figure = Figure(figsize=(0.8 + (0.9 + inches) * columns, 1.2 + 2.6 * rows))
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    width = 0.8 / len(names)
    for ax, metric in zip(axes, metrics, strict=False):
        own = frame.filter(metric=metric)
        for i, configuration in enumerate(configurations):
            samples = _samples(own.filter(configuration=configuration), factor, names)
            numbers = [names.index(s) for s in samples]
            positions = [i - 0.4 + width * (k + 0.5) for k in numbers]
            _box(ax, samples, [colour(k) for k in numbers], positions, 0.8 * width)
        _name_ticks(ax, configurations, inches)
        ax.set_xlim(-0.5, len(configurations) - 0.5)
        ax.grid(axis="x", visible=False)
        ax.set_ylabel(_axis_label(own))
        _scale(ax, own, False)
    for ax in axes[len(metrics) :]:
        ax.set_axis_off()
    handles: list[Any] = [Patch(facecolor=colour(k), alpha=0.65, label=name) for k, name in enumerate(names)]
    handles.append(
        Line2D([], [], marker="D", linestyle="", markerfacecolor="white", color="black", label="mean")
    )
    figure.legend(handles=handles, loc="outside lower center", ncols=min(6, len(handles)), frameon=False)
    figure.suptitle(f"{frame['filter'][0]}: each metric by {factor}")
    return figure


def level_tracks(cells: Sequence[StudyCell], config: cfg.StudyConfig, factor: str) -> Figure | None:
    """Overlaid tracks of one filter, a row a configuration, a column a level of ``factor`` (figure 35)."""
    drawn = [c for c in cells if c.status == "ok" and len(c.positions) > 1]
    if not drawn:
        return None
    names = dict.fromkeys(m.levels[factor] for m in cfg.methods(config))
    names = [n for n in names if any(c.levels[factor] == n for c in drawn)]
    rows = sorted({c.configuration for c in drawn}, key=by_number)
    figure = Figure(figsize=(0.8 + 3.2 * len(names), 0.9 + 3.2 * len(rows)))
    axes = figure.subplots(len(rows), len(names), squeeze=False)
    for i, row in enumerate(rows):
        own = [c for c in drawn if c.configuration == row]
        middle, reach = _frame(own)  # a walk of 300 m needs another frame than one of 10 m
        for k, name in enumerate(names):
            ax = axes[i, k]
            _overlay(ax, [c for c in own if c.levels[factor] == name], colour(k), middle, reach)
            ax.set(xlim=(middle[0] - reach, middle[0] + reach), ylim=(middle[1] - reach, middle[1] + reach))
            if i == 0:
                ax.set_title(name)
            if k == 0:
                ax.set_ylabel(f"{row}\ny (m)")
            if i == len(rows) - 1:
                ax.set_xlabel("x (m)")
    figure.suptitle(f"{drawn[0].label}: tracks from above by {factor}")
    return figure


def _frame(cells: Sequence[StudyCell]) -> tuple[np.ndarray, float]:
    """Return middle and half width of a frame in which a diverged track does not shrink all others to a dot."""
    points = np.concatenate([cell.positions[:, :2] for cell in cells])
    points = points[~np.isnan(points).any(axis=1)]
    low, high = np.percentile(points, (1, 99), axis=0)
    return (low + high) / 2, 0.62 * max(float((high - low).max()), 0.5)


WALKS_A_PANEL = 6
"""Tracks of one person in a panel, as in the phone dissertation (figures 4.12 and 4.13)."""


def by_walk(cells: Sequence[StudyCell], config: cfg.StudyConfig, column: str, unit: str) -> Figure | None:
    """Estimated and true figure of every walk above, their difference below; a column a configuration.

    ``column`` is a metric with a signed ``<name>_difference…`` beside it (phone dissertation, figures 4.10, 4.11).
    """
    difference = column.replace("_m", "_difference_m") if column.endswith("_m") else f"{column}_difference"
    measured = [c for c in cells if c.status == "ok" and {column, difference} <= set(c.metrics)]
    if not measured:
        return None
    configurations = list(dict.fromkeys(c.configuration for c in measured))
    figure = Figure(figsize=(1.2 + 3.6 * len(configurations), 4.6))
    axes = figure.subplots(2, len(configurations), squeeze=False, sharex="col", height_ratios=(2, 1))
    for k, configuration in enumerate(configurations):
        own = [c for c in measured if c.configuration == configuration]
        x = np.arange(1, len(own) + 1)
        value = np.array([c.metrics[column] for c in own])
        error = np.array([c.metrics[difference] for c in own])
        above, below = axes[:, k]
        above.bar(x - 0.2, value - error, 0.4, color=GREY, label="true")
        above.bar(x + 0.2, value, 0.4, color=colour(0), label="estimated")
        below.bar(x, error, 0.6, color=colour(1))
        below.axhline(0, color="black", linewidth=0.6)
        above.set_title(f"{configuration}, mean |error| {np.abs(error).mean():.3g} {unit}", fontsize=9)
        below.set_xlabel("walk")
        below.xaxis.get_major_locator().set_params(integer=True)
        if k == 0:
            above.set_ylabel(unit)
            below.set_ylabel(f"error ({unit})")
            above.legend(fontsize=8, loc="lower right")
    figure.suptitle(f"{column.removesuffix('_m').replace('_', ' ')} by walk, {measured[0].label}")
    return figure


def walk_panels(cells: Sequence[StudyCell], config: cfg.StudyConfig) -> Figure | None:
    """Six tracks a panel, in the order of the walks; a row a configuration, one filter."""
    drawn = [c for c in cells if c.status == "ok" and len(c.positions) > 1]
    rows = {
        name: [c for c in drawn if c.configuration == name]
        for name in dict.fromkeys(c.configuration for c in drawn)
    }
    wide = max((-(-len(own) // WALKS_A_PANEL) for own in rows.values()), default=0)
    if not wide:
        return None
    figure = Figure(figsize=(0.8 + 2.6 * wide, 0.9 + 2.6 * len(rows)))
    axes = figure.subplots(len(rows), wide, squeeze=False)
    for i, (name, own) in enumerate(rows.items()):
        for k in range(wide):
            ax, part = axes[i, k], own[k * WALKS_A_PANEL : (k + 1) * WALKS_A_PANEL]
            if not part:
                ax.set_axis_off()
                continue
            for j, cell in enumerate(part):
                ax.plot(*cell.positions[:, :2].T, color=colour(j), linewidth=1.0)
                ax.plot(*cell.positions[-1, :2], "o", color=colour(j), markersize=3)
            ax.plot(0, 0, "+", color="black", markersize=8)
            ax.set_aspect("equal", adjustable="datalim")
            first = k * WALKS_A_PANEL + 1
            ax.set_title(f"{name}, walks {first}–{first + len(part) - 1}", fontsize=8)
            ax.tick_params(labelsize=7)
            if k == 0:
                ax.set_ylabel("y (m)")
            if i == len(rows) - 1:
                ax.set_xlabel("x (m)")
    figure.suptitle(f"Tracks walk by walk, {drawn[0].label}")
    return figure


def _overlay(ax: Axes, cells: Sequence[StudyCell], face: str, middle: np.ndarray, reach: float) -> None:
    """Draw one panel of tracks."""
    alpha = min(1.0, max(0.15, 4 / max(1, len(cells))))
    paths = [cell.positions[:, :2] for cell in cells]
    outside = sum(bool((np.abs(path - middle) > reach).any()) for path in paths)
    if paths:
        styles = ["--" if cell.clipped else "-" for cell in cells]
        ax.add_collection(LineCollection(paths, colors=face, linewidths=0.9, alpha=alpha, linestyles=styles))
        ends = np.array([path[-1] for path in paths])
        ax.plot(*ends.T, "o", color="black", markersize=2.5, alpha=max(alpha, 0.4))
    ax.plot(0, 0, "+", color="black", markersize=8)
    ax.set_aspect("equal", adjustable="box")
    note = f"n = {len(cells)}" + (f", {outside} leave the frame" if outside else "")
    ax.text(0.02, 0.98, note, transform=ax.transAxes, va="top", fontsize=8, color=GREY)


def consistency(table: pl.DataFrame, config: cfg.StudyConfig) -> Figure:
    """Mean normalized error squared by configuration and filter, with the interval of a consistent filter.

    ``table`` is that of :func:`~marcha.study.analysis.consistency`.
    """
    metrics = table["metric"].unique(maintain_order=True).to_list()
    levels = order(table, config)
    filters, configurations = levels["filter"], levels["configuration"]
    inches = max(3.4, 0.17 * len(filters) * len(configurations))
    across = inches < 5
    figure = Figure(
        figsize=(
            1.0 + (0.8 + inches) * (len(metrics) if across else 1),
            4.1 if across else 0.9 + 3.0 * len(metrics),
        )
    )
    shape = (1, len(metrics)) if across else (len(metrics), 1)
    axes = figure.subplots(*shape, squeeze=False).ravel()
    for ax, metric in zip(axes, metrics, strict=True):
        part = table.filter(metric=metric)
        for row in part.iter_rows(named=True):
            i, k = configurations.index(row["configuration"]), filters.index(row["filter"])
            x = i - 0.4 + 0.8 * (k + 0.5) / len(filters)
            ax.plot([x, x], [row["low"], row["high"]], color="#9cc79c", linewidth=7, solid_capstyle="butt")
            face = "white" if row["clipped"] else colour(k)
            ax.plot(x, row["mean"], "o", color=colour(k), markerfacecolor=face, markersize=6)
        _name_ticks(ax, configurations, inches)
        ax.set_xlim(-0.5, len(configurations) - 0.5)
        _log_scale(ax)
        ax.set(title=NEES_TITLES.get(metric, metric), xlabel="configuration", ylabel="mean NEES (1)")
    handles = [
        Line2D([], [], marker="o", linestyle="", color=colour(k), label=f) for k, f in enumerate(filters)
    ]
    band = Patch(facecolor="#9cc79c", label="interval of a consistent filter")
    hollow = Line2D(
        [], [], marker="o", linestyle="", color=GREY, markerfacecolor="white", label="clipped input"
    )
    more = [band, hollow] if table["clipped"].any() else [band]
    figure.legend(handles=[*handles, *more], loc="outside lower center", ncols=5, frameon=False)
    figure.suptitle("Consistency of the filters' covariance")
    return figure


def images(draw: Callable[..., Figure | None], *arguments: Any) -> tuple[bytes, bytes] | None:
    """Return what ``draw(*arguments)`` draws as (PNG, SVG); None where it draws nothing."""
    with matplotlib.rc_context(matplotlib.rcParamsDefault | STYLE):
        figure = draw(*arguments)
        if figure is None:
            return None
        figure.set_dpi(DPI)
        canvas = FigureCanvasAgg(figure)  # there before the layout, whose text extents it remembers
        engine = figure.get_layout_engine()
        if engine is not None:  # laid out once for both formats
            engine.execute(figure)
        figure.set_layout_engine("none")
        png, svg = io.BytesIO(), io.BytesIO()
        # Not savefig: it draws everything twice.
        canvas.print_png(png)
        FigureCanvasSVG(figure).print_svg(svg, metadata={"Date": None})
    return png.getvalue(), svg.getvalue()
