"""How a stance detector decides: its conditions over the signals, each as 0 or 1, their AND, the cleaned result."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ..recording import Recording
from ..recording.names import is_estimate
from ..replay.trajectory import stances_of
from . import style
from .panels import TIME, dress, nothing, seconds
from .text import printable
from .thinned import pieces

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

NAMED, STANCE = "marcha_msgs/msg/NamedValues", "marcha_msgs/msg/Stance"
SHOWN_S = 8.0
"""s that are shown, from a second before the first swing on: more strides cannot be told apart on paper."""
UNITS = {
    "acc_norm": "m/s²",
    "acc_var": "m²/s⁴",
    "gyr_norm": "rad/s",
    "pitch_dev": "deg",
    "pitch_var": "deg²",
    "are": "rad²/s²",
    "mv": "m²/s⁴",
    "mag": "m²/s⁴",
}
Bools = NDArray[np.bool_]


def conditions(rec: Recording, fig: Figure) -> None:
    """Conditions of each stance detector over its signals, each as 0 or 1, their AND, the cleaned result."""
    runs = {}
    for topic, channel in rec.channels.items():
        stance = topic.rpartition("/")[0] + "/stance"
        if (
            is_estimate(topic)
            and channel.schema == NAMED
            and "detector" in channel.metadata
            and channel.count
            and stance in rec.channels
            and rec.channels[stance].count
        ):
            runs.setdefault(channel.metadata["detector"], (topic, stance))
    if not runs:
        raise nothing(rec, "no stance detector; replay a foot estimator first")
    tables = {name: _shown(rec, values, stance) for name, (values, stance) in runs.items()}
    heights = [h for both in tables.values() for h in [*([1.0] * len(statistics_of(both.columns))), 1.5]]
    fig.set_size_inches(10.0, 1.0 + 1.7 * sum(heights))
    panels = iter(fig.subplots(len(heights), 1, squeeze=False, height_ratios=heights)[:, 0])
    for name, both in tables.items():
        topic = runs[name][0]
        _detector(panels, name, printable(topic.split("/")[2]), both, rec.channels[topic].metadata, rec)


def _shown(rec: Recording, values: str, stance: str) -> pl.DataFrame:
    """Return a detector's rows with what came of them, of the time that is shown."""
    stances = stances_of(pieces(rec, stance))
    start_ns = rec.channels[values].start_ns or 0
    first_ns = int(stances[0, 1]) - 10**9 if len(stances) else start_ns
    inside = pl.col("t_ns").is_between(first_ns, first_ns + round(SHOWN_S * 1e9))
    statistics, still = (pl.concat([p.filter(inside) for p in pieces(rec, t)]) for t in (values, stance))
    return statistics.join(still.select("t_ns", "still"), on="t_ns", how="inner").sort("t_ns")


def statistics_of(columns: Sequence[str]) -> list[str]:
    """Return which columns of a stance detector's output are statistics with a condition each."""
    return [c for c in columns if c not in ("t_ns", "threshold", "still")]


def condition(statistic: str, values: pl.DataFrame, metadata: Mapping[str, str]) -> Bools:
    """Return where a detector's condition on one statistic is met.

    Parameters
    ----------
    statistic : str
        Column of ``values``.
    values : polars.DataFrame
        Rows of a channel ``detector``; a column ``threshold`` is a limit that follows the gait.
    metadata : mapping
        The channel's: ``threshold.<statistic>``, and ``.min`` for a floor.

    Returns
    -------
    ndarray of bool, shape (n,)
        False where the statistic is not known.
    """
    x = values[statistic].to_numpy()
    if "threshold" in values.columns:
        return x < values["threshold"].to_numpy()
    low, high = (_number(metadata, f"threshold.{statistic}{end}") for end in (".min", ""))
    met = np.isfinite(x)
    if low is not None:
        met &= x > low
    if high is not None:
        met &= x < high
    return met


def _detector(
    panels: Any,
    name: str,
    run: str,
    both: pl.DataFrame,
    metadata: dict[str, str],
    rec: Recording,
) -> None:
    t = seconds(rec, both["t_ns"])
    still = both["still"].cast(pl.Boolean).to_numpy()
    lanes: list[tuple[str, Bools]] = []
    for statistic in statistics_of(both.columns):
        ax = next(panels)
        x = both[statistic].to_numpy()
        ax.plot(t, x, color=style.NORM, linewidth=0.9, label=statistic)
        low, high = (_number(metadata, f"threshold.{statistic}{end}") for end in (".min", ""))
        if "threshold" in both.columns:
            limit = both["threshold"].to_numpy()
            ax.plot(
                t,
                limit,
                color=style.AXES[0],
                linewidth=0.9,
                linestyle="--",
                label="threshold, follows the gait",
            )
            ax.set_yscale("log")
        for limit, label in ((low, "above"), (high, "below")):
            if limit is not None:
                ax.axhline(
                    limit,
                    color=style.AXES[0],
                    linewidth=0.9,
                    linestyle="--",
                    label=f"still {label} {limit:g}",
                )
        if high is not None and "threshold" not in both.columns:
            ax.set_ylim(min(0.0, float(np.nanmin(x))), max(4.0 * high if low is None else 2.5 * high, 1e-9))
        _boxes(ax, t, still)
        title = f"{run}: {statistic} (detector {name}); grey: stance"
        dress(ax, title, "", UNITS.get(statistic, ""), legend={"loc": "upper right"})
        lanes.append((statistic, condition(statistic, both, metadata)))
    every = np.logical_and.reduce([met for _, met in lanes])
    lanes += [("all of them", every)] if len(lanes) > 1 else []
    lanes.append(("cleaned: still", still))
    ax = next(panels)
    for k, (label, met) in enumerate(reversed(lanes)):
        colour = style.run_color(0) if label.startswith("cleaned") else style.NORM
        ax.fill_between(t, k, k + 0.75 * met, step="mid", color=colour, linewidth=0)
    ax.set_yticks([k + 0.4 for k in range(len(lanes))], [label for label, _ in reversed(lanes)], fontsize=8)
    ax.set_ylim(-0.2, len(lanes))
    dress(ax, f"{run}: each condition as 0 or 1, and what came of them", TIME, "", legend=None)


def _number(metadata: Mapping[str, str], key: str) -> float | None:
    return float(metadata[key]) if key in metadata else None


def _boxes(ax: Axes, t: NDArray[np.float64], still: Bools) -> None:
    edges = np.flatnonzero(np.diff(np.concatenate(([False], still, [False])).astype(np.int8)))
    for a, b in zip(edges[::2], edges[1::2], strict=True):
        ax.axvspan(float(t[a]), float(t[min(b, len(t) - 1)]), color="#000000", alpha=0.08, linewidth=0)
