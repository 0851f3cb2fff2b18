"""How far two tables of annotations agree: what matches, what is missed or added, boundaries, overlap, κ."""

from __future__ import annotations

import math
from typing import Any

import msgspec
import numpy as np
import polars as pl
from numpy.typing import NDArray

from ..recording.errors import UsageError

Ints = NDArray[np.int64]


class Agreement(msgspec.Struct, frozen=True, kw_only=True):
    """Two annotators, or one and an algorithm, compared.

    Attributes
    ----------
    matched, missed, added : int
        Pairs; annotations of the first without a partner; of the second.
    precision, recall, f1 : float
        Shares of the second's, and of the first's, that match; NaN where there are none.
    start_mean_s, start_sd_s, start_max_s, end_mean_s, end_sd_s, end_max_s : float
        Boundaries of the second minus those of the first, over the pairs: mean, standard deviation (n - 1),
        largest size.
    overlap : float
        Mean over the pairs of intervals of intersection over union; NaN without one.
    kappa : float
        Cohen's κ over time (Cohen 1960): at every moment each says one category, a label or none; NaN where
        chance alone would agree, and for instants, which take no time.
    agreement : float
        Share of the time at which both say the same.
    """

    matched: int
    missed: int
    added: int
    precision: float
    recall: float
    f1: float
    start_mean_s: float
    start_sd_s: float
    start_max_s: float
    end_mean_s: float
    end_sd_s: float
    end_max_s: float
    overlap: float
    kappa: float
    agreement: float


def compare(
    first: pl.DataFrame,
    second: pl.DataFrame,
    span: tuple[int, int],
    *,
    tolerance_s: float = 0.25,
    labels: bool = True,
) -> tuple[Agreement, pl.DataFrame]:
    """Compare two tables of annotations.

    Intervals may be partners where they overlap; where one of two is an instant, where it lies no further
    than the tolerance from the other's start. The pairs with the largest overlap come first, then those with
    the nearest starts; each annotation has at most one partner.

    Parameters
    ----------
    first, second : polars.DataFrame
        Columns of :data:`marcha.recording.annotations.COLUMNS`; the first is what is taken for true.
    span : (int, int)
        Time that κ speaks of [ns].
    tolerance_s : float
        How far instants may lie apart.
    labels : bool
        Whether partners have the same label.

    Returns
    -------
    Agreement
        The figures.
    polars.DataFrame
        One row an annotation of either: ``status`` (matched, missed, added), ``label``, ``first_id``,
        ``second_id``, ``start_error_s``, ``end_error_s``, ``overlap``.

    Raises
    ------
    UsageError
        The tolerance is negative or no number.
    """
    if not tolerance_s >= 0 or math.isinf(tolerance_s):
        raise UsageError(f"tolerance {tolerance_s} s: must be a number of 0 or more")
    a, b = (t.sort("start_ns", maintain_order=True) for t in (first, second))
    pairs = _pairs(a, b, round(tolerance_s * 1e9), labels)
    left = [i for i in range(a.height) if i not in {p[0] for p in pairs}]
    right = [j for j in range(b.height) if j not in {p[1] for p in pairs}]
    start, end = (
        np.array([b[k][j] - a[k][i] for i, j, _ in pairs], float) * 1e-9 for k in ("start_ns", "end_ns")
    )
    overlaps = np.array([share for i, j, share in pairs if _is_interval(a, i) and _is_interval(b, j)])
    agreed, kappa = _kappa(a, b, span)
    agreement = Agreement(
        matched=len(pairs),
        missed=len(left),
        added=len(right),
        precision=_share(len(pairs), b.height),
        recall=_share(len(pairs), a.height),
        f1=_share(2 * len(pairs), a.height + b.height),
        **_spread("start", start),
        **_spread("end", end),
        overlap=float(overlaps.mean()) if len(overlaps) else math.nan,
        kappa=kappa,
        agreement=agreed,
    )
    return agreement, _listing(a, b, pairs, left, right)


def _is_interval(table: pl.DataFrame, row: int) -> bool:
    return table["end_ns"][row] > table["start_ns"][row]


def _share(part: int, whole: int) -> float:
    return part / whole if whole else math.nan


def _spread(name: str, errors: NDArray[np.float64]) -> dict[str, float]:
    n = len(errors)
    return {
        f"{name}_mean_s": float(errors.mean()) if n else math.nan,
        f"{name}_sd_s": float(errors.std(ddof=1)) if n > 1 else math.nan,
        f"{name}_max_s": float(np.abs(errors).max()) if n else math.nan,
    }


def _pairs(a: pl.DataFrame, b: pl.DataFrame, tolerance: int, labels: bool) -> list[tuple[int, int, float]]:
    """Return (row of a, row of b, intersection over union) of the pairs, by the first's start."""
    start_a, end_a = a["start_ns"].to_list(), a["end_ns"].to_list()
    start_b, end_b = b["start_ns"].to_list(), b["end_ns"].to_list()
    label_a, label_b = a["label"].to_list(), b["label"].to_list()
    options = []
    reach = np.maximum.accumulate(b["end_ns"].to_numpy()) if b.height else np.zeros(0, np.int64)
    starts = b["start_ns"].to_numpy()
    for i in range(a.height):
        low = int(np.searchsorted(reach, start_a[i] - tolerance))
        high = int(np.searchsorted(starts, end_a[i] + tolerance, side="right"))
        for j in range(low, high):
            if labels and label_a[i] != label_b[j]:
                continue
            both = min(end_a[i], end_b[j]) - max(start_a[i], start_b[j])
            away = abs(start_b[j] - start_a[i])
            if start_a[i] == end_a[i] or start_b[j] == end_b[j]:
                if away <= tolerance:
                    options.append((0.0, away, i, j))
            elif both > 0:
                union = max(end_a[i], end_b[j]) - min(start_a[i], start_b[j])
                options.append((-both / union, away, i, j))
    used_a: set[int] = set()
    used_b: set[int] = set()
    pairs = []
    for share, _, i, j in sorted(options):
        if i not in used_a and j not in used_b:
            used_a.add(i)
            used_b.add(j)
            pairs.append((i, j, -share))
    return sorted(pairs)


def _kappa(a: pl.DataFrame, b: pl.DataFrame, span: tuple[int, int]) -> tuple[float, float]:
    """Return the share of time with agreement, and κ."""
    cuts = [np.array(span, np.int64)]
    cuts += [t[k].to_numpy() for t in (a, b) for k in ("start_ns", "end_ns")]
    edges = np.unique(np.clip(np.concatenate(cuts), *span))
    time = np.diff(edges).astype(float)
    if not time.sum():
        return math.nan, math.nan
    labelled = [_categories(t, edges) for t in (a, b)]
    weight = time / time.sum()
    agreed = float(weight[[x == y for x, y in zip(*labelled, strict=True)]].sum())
    chance = 0.0
    shares = [dict.fromkeys(set(labelled[0]) | set(labelled[1]), 0.0) for _ in labelled]
    for share, categories in zip(shares, labelled, strict=True):
        for category, w in zip(categories, weight.tolist(), strict=True):
            share[category] += w
    chance = sum(shares[0][c] * shares[1][c] for c in shares[0])
    return agreed, (agreed - chance) / (1 - chance) if chance < 1 - 1e-12 else math.nan


def _categories(table: pl.DataFrame, edges: Ints) -> list[frozenset[str]]:
    """Return what is said between each two edges: the set of labels."""
    out: list[frozenset[str]] = []
    begins: dict[int, list[str]] = {}
    ends: dict[int, list[str]] = {}
    first, last = int(edges[0]), int(edges[-1])
    for start, end, label in table.select("start_ns", "end_ns", "label").iter_rows():
        if end > start:
            begins.setdefault(min(max(start, first), last), []).append(label)
            ends.setdefault(min(max(end, first), last), []).append(label)
    active: dict[str, int] = {}
    for edge in edges[:-1].tolist():
        for label in ends.get(edge, ()):
            active[label] = active.get(label, 0) - 1
        for label in begins.get(edge, ()):
            active[label] = active.get(label, 0) + 1
        out.append(frozenset(label for label, n in active.items() if n > 0))
    return out


def _listing(
    a: pl.DataFrame,
    b: pl.DataFrame,
    pairs: list[tuple[int, int, float]],
    left: list[int],
    right: list[int],
) -> pl.DataFrame:
    rows: list[dict[str, Any]] = []
    for i, j, share in pairs:
        rows.append(
            {
                "status": "matched",
                "start_ns": a["start_ns"][i],
                "label": a["label"][i],
                "first_id": a["id"][i],
                "second_id": b["id"][j],
                "start_error_s": (b["start_ns"][j] - a["start_ns"][i]) * 1e-9,
                "end_error_s": (b["end_ns"][j] - a["end_ns"][i]) * 1e-9,
                "overlap": share,
            }
        )
    for status, table, members, key in (("missed", a, left, "first_id"), ("added", b, right, "second_id")):
        rows += [
            {
                "status": status,
                "start_ns": table["start_ns"][k],
                "label": table["label"][k],
                key: table["id"][k],
            }
            for k in members
        ]
    schema = {
        "status": pl.String,
        "start_ns": pl.Int64,
        "label": pl.String,
        "first_id": pl.String,
        "second_id": pl.String,
        "start_error_s": pl.Float64,
        "end_error_s": pl.Float64,
        "overlap": pl.Float64,
    }
    return pl.DataFrame(rows, schema=schema).sort("start_ns", maintain_order=True)
