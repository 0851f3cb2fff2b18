"""Channels of any length as they are drawn: read in windows, and only what a picture can show is kept."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ..recording import Recording

Floats = NDArray[np.float64]
Times = NDArray[np.int64]

DRAWN = 65536
"""Rows of a channel that are drawn as they are; of more only the extremes of equal parts."""

READ = 1 << 17
"""Most rows that a figure computes on whole: 22 minutes at 100 Hz."""


def pieces(rec: Recording, topic: str) -> Iterator[pl.DataFrame]:
    """Yield a channel's rows in windows."""
    return (
        window.tables[topic].drop("t_log_ns", strict=False)
        for window in rec.windows([topic])
        if topic in window.tables
    )


def acc_norm(table: pl.DataFrame) -> Floats:
    """Return the norm of the accelerometer (n, 1), m/s²."""
    return np.linalg.norm(table.select("acc_x", "acc_y", "acc_z").to_numpy(), axis=1, keepdims=True)


def thinned(
    rec: Recording, topic: str, values: Callable[[pl.DataFrame], Floats], rows: int = DRAWN
) -> tuple[Times, Floats]:
    """Return times and values of a channel as they are drawn.

    Parameters
    ----------
    rec : Recording
        The recording.
    topic : str
        A channel.
    values : callable
        From a table of consecutive rows to the values (n, m) that are drawn; called in order.
    rows : int
        A channel of more rows is cut into parts of equal counts, of which the rows stay that hold the least or
        the greatest of a value: peaks are drawn as high as they are.

    Returns
    -------
    ndarray of int64, shape (k,)
        Times, ns.
    ndarray, shape (k, m)
        Values; k is about ``rows`` at most.
    """
    times: list[Times] = []
    kept: list[Floats] = []
    for table in pieces(rec, topic):
        t_ns, drawn = table["t_ns"].to_numpy(), values(table)
        part = -(-rec.channels[topic].count * 2 * drawn.shape[1] // rows)
        if rec.channels[topic].count > rows:
            keep = _extremes(drawn, part)
            t_ns, drawn = t_ns[keep], drawn[keep]
        times.append(t_ns)
        kept.append(drawn)
    if not times:
        return np.empty(0, np.int64), values(rec.table(topic))
    return np.concatenate(times), np.concatenate(kept)


def _extremes(values: Floats, part: int) -> NDArray[np.intp]:
    """Return the rows, ascending, that hold the least or greatest of a column within each ``part`` rows."""
    n, columns = values.shape
    starts = np.arange(0, n, part)
    whole = np.full((len(starts) * part, columns), np.nan)
    whole[:n] = values
    cut = whole.reshape(len(starts), part, columns)
    low = np.where(np.isnan(cut), np.inf, cut).argmin(axis=1)
    high = np.where(np.isnan(cut), -np.inf, cut).argmax(axis=1)
    return np.unique(np.concatenate([starts[:, None] + low, starts[:, None] + high]).ravel())


def first_rows(rec: Recording, topic: str, rows: int = READ) -> tuple[pl.DataFrame, bool]:
    """Return the first rows of a channel, at most so many, and whether these are all."""
    parts: list[pl.DataFrame] = []
    missing = rows
    for table in pieces(rec, topic):
        parts.append(table.head(missing))
        missing -= parts[-1].height
        if missing <= 0:
            break
    if not parts:
        return rec.table(topic), True
    return pl.concat(parts), rec.channels[topic].count <= rows


def every(rec: Recording, topic: str, rows: int) -> pl.DataFrame:
    """Return about ``rows`` rows of a channel, evenly chosen."""
    stride, seen = max(1, rec.channels[topic].count // rows), 0
    parts: list[pl.DataFrame] = []
    for table in pieces(rec, topic):
        parts.append(table[-seen % stride :: stride])
        seen += table.height
    return pl.concat(parts) if parts else rec.table(topic)
