"""Tables by annotation: epochs, strides normalized to 0–100 %, mean and band, gait parameters per interval."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import msgspec
import numpy as np
import polars as pl
from numpy.typing import NDArray

from ..recording.errors import UsageError
from .trajectory import inside

PAUSE_S = 3.0
"""A stride that takes longer is standing in between."""

_FIGURES = ("distance_m", "cadence_per_min", "{}_time_s", "{}_length_m", "speed_m_s")
_VARIATION = ("{}_time_cv", "{}_length_cv")
GAIT = {
    True: tuple(n.format("stride") for n in (*_FIGURES, "stance_share", *_VARIATION)),
    False: tuple(n.format("step") for n in (*_FIGURES, *_VARIATION)),
}
"""Gait parameters of one foot (True), and of a sensor on the body."""


class Band(msgspec.Struct, frozen=True):
    """A quantity over the stride.

    Attributes
    ----------
    percent : ndarray, shape (n,)
        0 to 100.
    strides : ndarray, shape (m, n)
        One row a stride.
    mean, sd : ndarray, shape (n,)
        Over the strides; the standard deviation has n - 1 below, NaN for a single stride.
    """

    percent: NDArray[np.float64]
    strides: NDArray[np.float64]
    mean: NDArray[np.float64]
    sd: NDArray[np.float64]


def epochs(table: pl.DataFrame, annotations: pl.DataFrame) -> pl.DataFrame:
    """Return the rows of a table that lie in annotations, with the annotation's id, tier and label.

    Parameters
    ----------
    table : polars.DataFrame
        ``t_ns`` and columns.
    annotations : polars.DataFrame
        Columns of :data:`marcha.recording.annotations.COLUMNS`; both ends belong to an annotation. A row in
        several overlapping ones is there once for each.
    """
    t_ns = table["t_ns"].to_numpy()
    order = np.argsort(t_ns, kind="stable")
    first = np.searchsorted(t_ns[order], annotations["start_ns"].to_numpy(), side="left")
    last = np.searchsorted(t_ns[order], annotations["end_ns"].to_numpy(), side="right")
    counts = last - first
    rows = np.concatenate([order[a:b] for a, b in zip(first, last, strict=True)] or [np.zeros(0, np.int64)])
    which = np.repeat(np.arange(annotations.height), counts)
    return pl.concat([annotations[which].select("id", "tier", "label"), table[rows]], how="horizontal")


def normalized(
    table: pl.DataFrame, column: str, starts_ns: Sequence[int] | NDArray[np.int64], points: int = 101
) -> Band:
    """Return a quantity over the stride: each from one start to the next, on the same shares of it.

    Parameters
    ----------
    table : polars.DataFrame
        ``t_ns``, increasing, and the column.
    column : str
        What is looked at; NaN makes the points of the stride that need it NaN.
    starts_ns : sequence of int
        Starts of strides, increasing (initial contacts); n + 1 of them make n strides. Strides that the
        table does not cover whole are left out.
    points : int
        Points from 0 to 100 %, both included.

    Raises
    ------
    UsageError
        The starts do not increase, or there are fewer than two points.
    """
    starts = np.asarray(starts_ns, np.int64)
    if points < 2 or (np.diff(starts) <= 0).any():
        raise UsageError("strides: the starts must increase, and a stride has two points at least")
    t_ns, values = table["t_ns"].to_numpy(), table[column].to_numpy().astype(float)
    share = np.linspace(0.0, 1.0, points)
    rows = []
    for a, b in pairwise(starts):
        if len(t_ns) and t_ns[0] <= a and b <= t_ns[-1]:
            rows.append(np.interp(share * float(b - a), (t_ns - a).astype(float), values))
    strides = np.array(rows) if rows else np.zeros((0, points))
    nothing = np.full(points, np.nan)
    mean = strides.mean(axis=0) if rows else nothing
    sd = strides.std(axis=0, ddof=1) if len(rows) > 1 else nothing
    return Band(100.0 * share, strides, mean, sd)


def gait_parameters(steps: pl.DataFrame, annotations: pl.DataFrame, *, one_foot: bool = True) -> pl.DataFrame:
    """Return one row an annotation with the gait parameters of the steps that end in it.

    Parameters
    ----------
    steps : polars.DataFrame
        Rows of a ``marcha_msgs/msg/Step`` channel.
    annotations : polars.DataFrame
        Intervals; a step belongs to one where its end lies in it.
    one_foot : bool
        See :func:`gait_of`.

    Returns
    -------
    polars.DataFrame
        ``id, tier, label`` and the figures of :func:`gait_of`; null where there are too few strides.
    """
    names, counts = GAIT[one_foot], ("strides" if one_foot else "steps",)
    rows = [
        {k: mark[k] for k in ("id", "tier", "label")}
        | gait_of(steps, np.array([[mark["start_ns"], mark["end_ns"] + 1]], np.int64), one_foot=one_foot)
        for mark in annotations.iter_rows(named=True)
    ]
    schema: dict[str, type[pl.DataType]] = dict.fromkeys(("id", "tier", "label"), pl.String)
    schema |= dict.fromkeys(counts, pl.Int64) | dict.fromkeys(names, pl.Float64)
    return pl.DataFrame(rows, schema=schema)


def gait_of(
    steps: pl.DataFrame, spans: NDArray[np.int64] | None = None, *, one_foot: bool = True
) -> dict[str, float]:
    """Return the gait parameters of the steps that end in stretches of time.

    Parameters
    ----------
    steps : polars.DataFrame
        ``start_ns, end_ns, length_m`` of steps.
    spans : ndarray of int64, shape (k, 2), or None
        Half open, apart, in order; everything where it is None.
    one_foot : bool
        Whether they are those of one foot: each is a stride, from the start of a swing to its end. Else
        those of a sensor on the body, which sees the steps of both feet.

    Returns
    -------
    dict
        ``strides, distance_m, cadence_per_min`` (steps of both feet), ``stride_time_s, stride_length_m,
        speed_m_s, stance_share`` and ``…_cv`` (standard deviation over mean) of time and length; for a sensor on
        the body ``steps``, ``step_time_s`` and so on, without a stance. Times are from one end to the next
        inside a stretch; what takes longer than :data:`PAUSE_S` is standing and has no part in them. What has
        too few strides is left out.
    """
    word = "stride" if one_foot else "step"
    table = steps.sort("end_ns")
    end, start = table["end_ns"].to_numpy(), table["start_ns"].to_numpy()
    length = table["length_m"].to_numpy()
    if spans is None:
        where = np.zeros(len(end), np.int64)
    else:
        where = np.where(inside(end, spans), np.searchsorted(spans[:, 0], end, side="right"), -1)
    here = where >= 0
    time = np.diff(end) * 1e-9
    timed = np.r_[False, here[1:] & (where[1:] == where[:-1]) & (time <= PAUSE_S)][: len(end)]
    time = time[timed[1:]]
    figures: dict[str, float] = {f"{word}s": int(here.sum()), "distance_m": float(np.nansum(length[here]))}
    if here.any():
        figures[f"{word}_length_m"] = float(length[here].mean())
    if len(time):
        whole = float(time.sum())
        figures["cadence_per_min"] = (120.0 if one_foot else 60.0) * len(time) / whole
        figures[f"{word}_time_s"] = whole / len(time)
        figures["speed_m_s"] = float(length[timed].sum()) / whole
        if one_foot:
            figures["stance_share"] = 1.0 - float((end - start)[timed].sum() * 1e-9) / whole
    for name, values in ((f"{word}_time_cv", time), (f"{word}_length_cv", length[here])):
        if len(values) > 1 and values.mean():
            figures[name] = float(values.std(ddof=1) / values.mean())
    return figures
