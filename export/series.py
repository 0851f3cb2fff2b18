"""Several channels on one time: what formats with one column of time need."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ..recording import Recording
from ..recording.errors import UsageError
from ..recording.rotations import QUAT
from ..recording.selection import Selection

Times = NDArray[np.int64]
Floats = NDArray[np.float64]


class Together(NamedTuple):
    """Channels on the times of one of them.

    Attributes
    ----------
    t_ns : ndarray of int64, shape (n,)
        The times.
    columns : dict of str to dict of str to ndarray
        Topic to column to its values, shape (n,).
    resampled : list of str
        Topics whose values were interpolated; those of the others are as they were.
    """

    t_ns: Times
    columns: dict[str, dict[str, Floats]]
    resampled: list[str]


def together(rec: Recording, topics: list[str], selection: Selection) -> Together:
    """Return channels on the times of that with the most rows, within the time that all have.

    Numbers are interpolated linearly, quaternions along the shorter arc (slerp). A stretch without readings
    that is longer than three usual intervals is NaN.

    Raises
    ------
    UsageError
        The channels share no time.
    """
    tables = {t: _sorted(rec.table(t, start_ns=selection.start_ns, end_ns=selection.end_ns)) for t in topics}
    tables = {t: table for t, table in tables.items() if table.height}
    if not tables:
        raise UsageError(f"{rec.path}: the chosen channels have no rows in that time")
    leader = max(tables, key=lambda t: tables[t].height)
    first = max(int(table["t_ns"][0]) for table in tables.values())
    last = min(int(table["t_ns"][-1]) for table in tables.values())
    all_ns = tables[leader]["t_ns"].to_numpy()
    t_ns = all_ns[(all_ns >= first) & (all_ns <= last)]
    if not len(t_ns):
        raise UsageError(f"{rec.path}: {', '.join(tables)} share no time; choose fewer with --topic")
    out: dict[str, dict[str, Floats]] = {}
    resampled = []
    for topic, table in tables.items():
        own = table["t_ns"].to_numpy()
        inside = (own >= first) & (own <= last)
        numbers = {
            n: table[n].to_numpy().astype(float)
            for n in table.columns
            if table[n].dtype.is_numeric() and n != "t_ns"
        }
        if np.array_equal(own[inside], t_ns):
            out[topic] = {n: v[inside] for n, v in numbers.items()}
            continue
        resampled.append(topic)
        out[topic] = _resampled(own, numbers, t_ns)
    return Together(t_ns, out, resampled)


def evenly(table: pl.DataFrame, rate_hz: float) -> pl.DataFrame:
    """Return a table at even times from its first row on: numbers linearly, quaternions by slerp.

    A gap of more than three usual intervals stays one: it has no rows. Frequencies above half the rate are not taken
    out before: choose one that the signal allows.
    """
    rows = _sorted(table)
    own = rows["t_ns"].to_numpy()
    count = int((own[-1] - own[0]) * rate_hz / 1e9 + 1e-9) + 1
    t_ns = own[0] + np.rint(np.arange(count) * (1e9 / rate_hz)).astype(np.int64)
    t_ns = t_ns[t_ns <= own[-1]]
    numbers = {n: rows[n].to_numpy().astype(float) for n in rows.columns if n != "t_ns"}
    out = pl.DataFrame({"t_ns": t_ns, **_resampled(own, numbers, t_ns)}).select(rows.columns)
    inside_gap = _far(own, t_ns)
    return out.filter(pl.Series(~inside_gap)) if inside_gap.any() else out


def _far(own: Times, t_ns: Times) -> NDArray[np.bool_]:
    """Return which times lie in a gap of more than three usual intervals."""
    if len(own) < 2:
        return np.zeros(len(t_ns), bool)
    k = np.clip(np.searchsorted(own, t_ns, side="left"), 1, len(own) - 1)
    usual = float(np.median(np.diff(own)))
    return (own[k] - own[k - 1] > 3 * usual) & (t_ns != own[k]) & (t_ns != own[k - 1])


def _sorted(table: pl.DataFrame) -> pl.DataFrame:
    return table.unique("t_ns", keep="first", maintain_order=True).sort("t_ns")


def _resampled(own: Times, numbers: dict[str, Floats], t_ns: Times) -> dict[str, Floats]:
    zero = own[0]
    x, x_new = (own - zero).astype(float), (t_ns - zero).astype(float)
    out = {n: np.interp(x_new, x, v) for n, v in numbers.items() if n not in QUAT}
    if all(n in numbers for n in QUAT):
        out |= _slerp(x, np.column_stack([numbers[n] for n in QUAT]), x_new)
    far = _far(own, t_ns)
    for values in out.values():
        values[far] = np.nan
    return out


def _slerp(x: Floats, q: Floats, x_new: Floats) -> dict[str, Floats]:
    """Return quaternions at other times (Shoemake 1985)."""
    if len(x) < 2:
        return {n: np.full(len(x_new), q[0, i]) for i, n in enumerate(QUAT)}
    k = np.clip(np.searchsorted(x, x_new, side="right") - 1, 0, len(x) - 2)
    share = (x_new - x[k]) / (x[k + 1] - x[k])
    a, b = q[k], q[k + 1]
    dot = np.sum(a * b, axis=1)
    b = np.where(dot[:, None] < 0, -b, b)
    angle = np.arccos(np.clip(np.abs(dot), -1.0, 1.0))
    small = angle < 1e-8
    sine = np.where(small, 1.0, np.sin(angle))
    wa = np.where(small, 1 - share, np.sin((1 - share) * angle) / sine)
    wb = np.where(small, share, np.sin(share * angle) / sine)
    mixed = wa[:, None] * a + wb[:, None] * b
    mixed /= np.linalg.norm(mixed, axis=1, keepdims=True)
    return {n: mixed[:, i] for i, n in enumerate(QUAT)}


def rate_hz(t_ns: Times) -> float:
    """Return the usual number of rows a second: one over the mean interval; 0 for fewer than two."""
    return (len(t_ns) - 1) * 1e9 / float(t_ns[-1] - t_ns[0]) if len(t_ns) > 1 and t_ns[-1] > t_ns[0] else 0.0


def evenness(t_ns: Times) -> float:
    """Return the largest departure of an interval from the mean one, as a share of it.

    Shape of ``t_ns``: (n,).
    """
    steps = np.diff(t_ns)
    return float(np.abs(steps / steps.mean() - 1).max()) if len(steps) else 0.0
