"""What the panels of all figures share: how they look, their time, and what is said where there is nothing to draw."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ..recording import Recording
from ..recording.errors import UsageError
from ..recording.names import is_estimate
from . import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes

GRID = {"color": "#DDDDDD", "linewidth": 0.6}
TIME = "time since the start (s)"
MOST_ELLIPSES = 25
"""Along a track: more hide it."""
BEST: Mapping[str, Any] = {"loc": "best"}
"""A legend where it hides least."""


def dress(ax: Axes, title: str, x: str, y: str, *, legend: Mapping[str, Any] | None = BEST) -> None:
    """Give a panel its title, the labels of its axes, a grid behind what is drawn, and a legend if anything has a name.

    Parameters
    ----------
    ax : Axes
        The panel, drawn.
    title, x, y : str
        Title, and what the axes are, with units.
    legend : mapping, optional
        Where and how, in the words of Matplotlib; None for no legend.
    """
    ax.set_title(title, fontsize=10, loc="left")
    ax.set_xlabel(x, fontsize=9)
    ax.set_ylabel(y, fontsize=9)
    ax.tick_params(labelsize=8)
    ax.grid(**GRID)
    ax.set_axisbelow(True)
    if legend is not None and ax.get_legend_handles_labels()[0]:
        ax.legend(fontsize=8, **legend)


def seconds(rec: Recording, t_ns: NDArray[np.int64] | pl.Series) -> NDArray[np.float64]:
    """Return times (n,), ns, as seconds since the start of the recording (n,)."""
    return (np.asarray(t_ns) - (rec.start_ns or 0)) / 1e9


def run_color(rec: Recording, run: str) -> str:
    """Return the colour of a run, by its place among the recording's runs."""
    runs = list(dict.fromkeys(t.split("/")[2] for t in rec.channels if is_estimate(t)))
    return style.run_color(runs.index(run))


def nothing(rec: Recording, why: str) -> UsageError:
    """Return the error of a recording that has nothing for a figure."""
    return UsageError(f"{rec.path}: nothing for this figure: {why}")
