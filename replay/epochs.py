"""Tables by annotation: epochs, strides normalized to 0–100 %, mean and band, gait parameters per interval."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import msgspec
import numpy as np
import polars as pl
from numpy.typing import NDArray

from ..recording.errors import UsageError


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


def gait_parameters(steps: pl.DataFrame, annotations: pl.DataFrame) -> pl.DataFrame:
    """Return one row an annotation with the gait parameters of the steps that end in it.

    Parameters
    ----------
    steps : polars.DataFrame
        Rows of a ``marcha_msgs/msg/Step`` channel of one foot: each is a stride, from the start of a swing
        to its end.
    annotations : polars.DataFrame
        Intervals; a step belongs to one where its end lies in it.

    Returns
    -------
    polars.DataFrame
        ``id, tier, label, strides, distance_m, cadence_per_min`` (steps of both feet), ``stride_time_s``,
        ``stride_length_m``, ``speed_m_s``, ``stance_share``, and ``…_cv`` (standard deviation over mean) of
        time and length. Times are from one end of a swing to the next inside the annotation; null where
        there are too few strides.
    """
    table = steps.sort("end_ns").with_columns(
        stride_s=(pl.col("end_ns") - pl.col("end_ns").shift()) * 1e-9,
        swing_s=(pl.col("end_ns") - pl.col("start_ns")) * 1e-9,
        before_ns=pl.col("end_ns").shift(),
    )
    rows = []
    for mark in annotations.iter_rows(named=True):
        part = table.filter(pl.col("end_ns").is_between(mark["start_ns"], mark["end_ns"]))
        timed = part.filter(pl.col("before_ns") >= mark["start_ns"])
        time, length = timed["stride_s"].to_numpy(), part["length_m"].to_numpy()
        whole = float(time.sum()) if len(time) else None
        rows.append(
            {
                "id": mark["id"],
                "tier": mark["tier"],
                "label": mark["label"],
                "strides": part.height,
                "distance_m": float(length.sum()),
                "cadence_per_min": 120.0 * len(time) / whole if whole else None,
                "stride_time_s": whole / len(time) if whole else None,
                "stride_length_m": float(length.mean()) if len(length) else None,
                "speed_m_s": float(timed["length_m"].to_numpy().sum()) / whole if whole else None,
                "stance_share": 1.0 - float(timed["swing_s"].to_numpy().sum()) / whole if whole else None,
                "stride_time_cv": _variation(time),
                "stride_length_cv": _variation(length),
            }
        )
    names = ("distance_m", "cadence_per_min", "stride_time_s", "stride_length_m", "speed_m_s", "stance_share")
    numbers = dict.fromkeys((*names, "stride_time_cv", "stride_length_cv"), pl.Float64)
    schema = {"id": pl.String, "tier": pl.String, "label": pl.String, "strides": pl.Int64, **numbers}
    return pl.DataFrame(rows, schema=schema)


def _variation(values: NDArray[np.float64]) -> float | None:
    return float(values.std(ddof=1) / values.mean()) if len(values) > 1 and values.mean() else None
