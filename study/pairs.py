"""Pairs within the design of a study: the same walks through several methods, and what a publication says.

Filters and levels of a factor see the same walks, so they are compared walk by walk (:func:`paired_comparisons`);
walks that reached a sensor's full scale stand apart, for there the errors are not the filter's alone.
Configurations are other walks: their tests are independent ones (:func:`.analysis.comparisons`). A publication that
compares every combination with every other is followed by :func:`all_pairs`, without a correction if it had none.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations
from typing import Any

import msgspec
import numpy as np
import polars as pl

from . import config as cfg
from .analysis import at_base, base_levels, order
from .statistics import PairedComparison, compare, holm, paired

WALK = ("recording", "input")
KEYS = ("metric", "unit", "subset", "factor", "within", "a", "b")


def _usable(frame: pl.DataFrame) -> pl.DataFrame:
    return frame.filter(~pl.col("outlier") & pl.col("value").is_finite())


def subsets(frame: pl.DataFrame) -> Iterator[tuple[str, pl.DataFrame]]:
    """Yield unclipped and clipped walks apart; all together where they are of one kind."""
    if frame["clipped"].n_unique() < 2:
        yield "all", frame
        return
    yield "unclipped", frame.filter(~pl.col("clipped"))
    yield "clipped", frame.filter(pl.col("clipped"))


def _paired(
    part: pl.DataFrame, column: str, pairs: list[tuple[str, str]], options: cfg.Statistics
) -> list[Any]:
    """Compare the levels of ``column`` over the walks that have both."""
    wide = part.pivot(column, index=list(WALK), values="value")
    comparisons: list[PairedComparison] = []
    for a, b in pairs:
        both = wide.select(a, b).drop_nulls()
        comparisons.append(
            paired(
                both[a].to_numpy(),
                both[b].to_numpy(),
                confidence=options.confidence,
                min_samples=options.min_samples,
            )
        )
    t, rank = holm([r.t_p for r in comparisons]), holm([r.rank_p for r in comparisons])
    return [
        msgspec.structs.replace(r, t_p_holm=float(p), rank_p_holm=float(q))
        for r, p, q in zip(comparisons, t, rank, strict=True)
    ]


def paired_comparisons(frame: pl.DataFrame, config: cfg.StudyConfig) -> pl.DataFrame:
    """Compare filters and levels of factors over the same walks, clipped ones apart.

    Families, each corrected by Holm: the filters in one configuration and over all of them (at the first level of
    every factor); the levels of a factor in one filter and configuration, and over all configurations.

    Columns: ``metric, unit, subset, factor, within, a, b`` and the fields of
    :class:`~marcha.study.statistics.PairedComparison`.
    """
    usable = _usable(frame)
    levels = order(usable, config)
    base = base_levels(levels, config)
    rows: list[dict[str, Any]] = []
    for (metric, unit), part in usable.group_by("metric", "unit", maintain_order=True):
        for subset, walks in subsets(part):
            for factor, within, family in _families(walks, levels, base):
                present = [v for v in levels[factor] if (family[factor] == v).any()]
                pairs = list(combinations(present, 2))
                for (a, b), result in zip(
                    pairs, _paired(family, factor, pairs, config.statistics), strict=True
                ):
                    key = dict(zip(KEYS, (metric, unit, subset, factor, within, a, b), strict=True))
                    rows.append(key | msgspec.structs.asdict(result))
    return pl.DataFrame(rows, schema=_schema(KEYS, PairedComparison, ("n",)))


def _families(
    walks: pl.DataFrame, levels: dict[str, list[str]], base: dict[str, str]
) -> Iterator[tuple[str, str, pl.DataFrame]]:
    """Yield what is compared, what is held fixed (as text), and the values."""
    configurations = levels["configuration"]
    everywhere = [""] if len(configurations) > 1 else []
    filters = walks.filter(*at_base(base))
    for configuration in (*configurations, *everywhere):
        held = pl.lit(True) if configuration == "" else pl.col("configuration") == configuration
        if len(levels["filter"]) > 1:
            yield "filter", configuration, filters.filter(held)
        for name in base:
            others = {k: v for k, v in base.items() if k != name}
            for label in levels["filter"] if len(levels[name]) > 1 else ():
                within = ", ".join(t for t in (label, configuration) if t)
                yield name, within, walks.filter(held, pl.col("filter") == label, *at_base(others))


def _schema(keys: tuple[str, ...], kind: type[msgspec.Struct], counts: tuple[str, ...]) -> dict[str, Any]:
    fields = {f.name: pl.String if f.name == "note" else pl.Float64 for f in msgspec.structs.fields(kind)}
    return {**dict.fromkeys(keys, pl.String), **fields, **dict.fromkeys(counts, pl.Int64)}


def all_pairs(frame: pl.DataFrame, config: cfg.StudyConfig) -> pl.DataFrame:
    """Compare every filter × configuration with every other (four by four: 120 pairs) by Welch's t test.

    ``p`` is uncorrected, as in the source; ``p_holm`` is corrected within the metric.

    Columns: ``metric, unit, a, a_configuration, b, b_configuration, n_a, n_b, difference, t, df, p, p_holm``.
    """
    usable = _usable(frame)
    levels = order(usable, config)
    base = base_levels(levels, config)
    cells = [(f, c) for f in levels["filter"] for c in levels["configuration"]]
    rows: list[dict[str, Any]] = []
    for (metric, unit), part in usable.filter(*at_base(base)).group_by("metric", "unit", maintain_order=True):
        samples = {
            k: v["value"].to_numpy()
            for k, v in part.partition_by("filter", "configuration", as_dict=True).items()
        }
        family: list[dict[str, Any]] = []
        for a, b in combinations([c for c in cells if c in samples], 2):
            result = compare(
                samples[a],
                samples[b],
                confidence=config.statistics.confidence,
                min_samples=config.statistics.min_samples,
            )
            family.append(
                {
                    "metric": metric,
                    "unit": unit,
                    "a": a[0],
                    "a_configuration": a[1],
                    "b": b[0],
                    "b_configuration": b[1],
                    "n_a": result.n_a,
                    "n_b": result.n_b,
                    "difference": result.difference,
                    "t": result.welch_t,
                    "df": result.welch_df,
                    "p": result.welch_p,
                }
            )
        for row, p in zip(family, holm([r["p"] for r in family]), strict=True):
            rows.append({**row, "p_holm": float(p)})
    texts = ("metric", "unit", "a", "a_configuration", "b", "b_configuration")
    numbers = dict.fromkeys(("difference", "t", "df", "p", "p_holm"), pl.Float64)
    return pl.DataFrame(
        rows, schema={**dict.fromkeys(texts, pl.String), "n_a": pl.Int64, "n_b": pl.Int64, **numbers}
    )


def verdicts(frame: pl.DataFrame, pairs: pl.DataFrame, config: cfg.StudyConfig) -> pl.DataFrame:
    """Say for every metric which combination has the smallest mean, and which may be equal to it.

    The rule of the source: all that Welch's test, uncorrected, does not tell from the smallest mean. Where no
    combination has walks enough for a test, the smallest mean is named and the note says so.

    Columns: ``metric, smallest, mean, equal`` (combinations, ``filter configuration``), ``published`` (those of
    the publication), ``same`` (yes, no; empty without a published verdict or a test) and ``note``.
    """
    usable = _usable(frame)
    base = base_levels(order(usable, config), config)
    level = 1 - config.statistics.confidence
    by_metric = {v.metric: v.smallest for v in config.verdicts}
    rows: list[dict[str, Any]] = []
    means = usable.filter(*at_base(base)).group_by("metric", "filter", "configuration", maintain_order=True)
    table = means.agg(mean=pl.col("value").mean(), n=pl.len())
    least = config.statistics.min_samples
    for (metric,), every in table.group_by("metric", maintain_order=True):
        enough = every.filter(pl.col("n") >= least)
        part = enough if len(enough) else every
        largest = every.select(pl.col("n").max()).item()
        note = "" if len(enough) else f"not tested: {largest} walks a combination at most, {least} needed"
        best = part.sort("mean").row(0, named=True)
        here = (best["filter"], best["configuration"])
        equal = [
            " ".join(other)
            for r in pairs.filter(pl.col("metric") == metric).iter_rows(named=True)
            for own, other in (
                ((r["a"], r["a_configuration"]), (r["b"], r["b_configuration"])),
                ((r["b"], r["b_configuration"]), (r["a"], r["a_configuration"])),
            )
            if own == here and np.isfinite(r["p"]) and r["p"] >= level
        ]
        published = sorted(by_metric.get(str(metric), []))
        ours = sorted([" ".join(here), *equal])
        rows.append(
            {
                "metric": metric,
                "smallest": " ".join(here),
                "mean": best["mean"],
                "equal": ", ".join(equal),
                "published": ", ".join(published),
                "same": "" if note or not published else "yes" if ours == published else "no",
                "note": note,
            }
        )
    order_of = ("metric", "smallest", "mean", "equal", "published", "same", "note")
    return pl.DataFrame(rows, schema={k: pl.Float64 if k == "mean" else pl.String for k in order_of})


def relations(frame: pl.DataFrame, config: cfg.StudyConfig) -> pl.DataFrame:
    """Check every relation between two rows of a published table over the same walks.

    A relation is that one row is better in a configuration (its value smaller). It reproduces (``yes``) where
    the mean difference over the walks that have both has the published sign and its interval leaves zero out,
    not (``no``) where the sign is the other one so surely, and is ``open`` else.

    Columns: ``table, metric, configuration, a, b, published_ratio, measured_ratio`` (a over b), ``difference,
    low, high, n, reproduces``.
    """
    usable = _usable(frame)
    levels = order(usable, config)
    base = base_levels(levels, config)
    rows: list[dict[str, Any]] = []
    for table in config.published:
        column = "filter" if table.by == "estimator" else table.by
        part = usable.filter(pl.col("metric") == table.metric)
        if column == "filter":
            part = part.filter(*at_base(base | table.levels))
        elif column in usable.columns:
            others = {k: v for k, v in base.items() if k != column} | table.levels
            part = part.filter(pl.col("filter") == table.estimator, *at_base(others))
        else:
            continue
        for a, b in combinations(table.rows, 2):
            for configuration, value in table.rows[a].items():
                if configuration not in table.rows[b] or not table.rows[b][configuration]:
                    continue
                walks = part.filter(pl.col("configuration") == configuration, pl.col(column).is_in([a, b]))
                values = set(walks[column].to_list())
                if values != {a, b}:
                    continue
                wide = walks.pivot(column, index=list(WALK), values="value").drop_nulls()
                x, y = wide[a].to_numpy(), wide[b].to_numpy()
                result = paired(
                    x, y, confidence=config.statistics.confidence, min_samples=config.statistics.min_samples
                )
                rows.append(
                    {
                        "table": table.table,
                        "metric": table.metric,
                        "configuration": configuration,
                        "a": a,
                        "b": b,
                        "published_ratio": value / table.rows[b][configuration],
                        "measured_ratio": float(x.mean() / y.mean()) if len(x) and y.mean() else None,
                        "difference": result.difference,
                        "low": result.difference_low,
                        "high": result.difference_high,
                        "n": result.n,
                        "reproduces": _reproduces(value - table.rows[b][configuration], result),
                    }
                )
    texts = ("table", "metric", "configuration", "a", "b", "reproduces")
    numbers = ("published_ratio", "measured_ratio", "difference", "low", "high")
    kinds = {**dict.fromkeys(texts, pl.String), **dict.fromkeys(numbers, pl.Float64), "n": pl.Int64}
    order_of = [*texts[:5], *numbers, "n", "reproduces"]
    return pl.DataFrame(rows, schema={name: kinds[name] for name in order_of})


def _reproduces(published: float, result: PairedComparison) -> str:
    low, high = result.difference_low, result.difference_high
    if published == 0 or not (np.isfinite(low) and np.isfinite(high)) or low <= 0 <= high:
        return "open"
    return "yes" if (result.difference > 0) == (published > 0) else "no"
