"""From the tidy table of cells to groups, outliers and families of comparisons.

A value is left out as an outlier once, in the finest group it belongs to (filter × the study's factors ×
configuration), and stays out of every pooled group.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import Any

import msgspec
import polars as pl

from ..replay.metrics import nees_bounds
from . import config as cfg
from .statistics import (
    GroupComparison,
    GroupSummary,
    compare,
    corrected,
    outlier_mask,
    summarize,
)

SUBSETS = ("all", "unclipped", "clipped")


def factors(config: cfg.StudyConfig) -> tuple[str, ...]:
    """Return what a group is made of; an empty string in a table stands for "all of them together"."""
    return ("filter", *cfg.factor_names(config), "configuration")


def base_levels(levels: dict[str, list[str]], config: cfg.StudyConfig) -> dict[str, str]:
    """Return the first level of every factor: the one that stands for it where others are compared."""
    return {name: levels[name][0] if levels[name] else "" for name in cfg.factor_names(config)}


def at_base(base: dict[str, str]) -> list[pl.Expr]:
    """Return what picks the rows at these levels, those of filters that are not part of a factor included."""
    return [pl.col(name).is_in([level, ""]) for name, level in base.items()]


def values(table: pl.DataFrame, config: cfg.StudyConfig) -> pl.DataFrame:
    """Return one row a finished cell and metric: its value in the metric's unit, and if it is an outlier.

    Columns: ``metric, unit, filter``, the factors, ``configuration, recording, input, clipped, value, outlier``.
    """
    of = factors(config)
    done = table.filter(pl.col("status") == "ok")
    frames: list[pl.DataFrame] = []
    for metric in config.metrics:
        if metric.column not in done.columns:
            continue
        value = pl.col(metric.column).cast(pl.Float64) * metric.scale
        frames.append(
            done.select(
                pl.lit(cfg.metric_title(metric)).alias("metric"),
                pl.lit(metric.unit).alias("unit"),
                *(pl.col(c) for c in (*of, "recording", "input", "clipped")),
                (value.abs() if metric.absolute else value).alias("value"),
            )
        )
    if not frames:
        return pl.DataFrame(
            schema=dict.fromkeys(["metric", "unit", *of, "recording", "input"], pl.String)
        ).with_columns(clipped=pl.lit(False), value=pl.lit(0.0), outlier=pl.lit(False))
    sigma = config.statistics.outlier_sigma
    return pl.concat(frames).with_columns(
        pl.col("value")
        .map_batches(lambda s: pl.Series(outlier_mask(s.to_numpy(), sigma)), return_dtype=pl.Boolean)
        .over("metric", *of)
        .alias("outlier")
    )


def failures(table: pl.DataFrame, config: cfg.StudyConfig) -> pl.DataFrame:
    """Count the cells whose results must not be used, by method and configuration.

    They are in no mean, no test and no picture: a run that stood still, ran away or could not be read has no
    error, least of all one of 0. Columns: ``filter``, the factors, ``configuration, cells, failed, share`` and
    ``reasons`` (the first words of each, with their number).
    """
    of = factors(config)
    reason = pl.col("error").str.split(";").list.first().str.slice(0, 60)
    failed = table.group_by(of, maintain_order=True).agg(
        cells=pl.len(),
        failed=(pl.col("status") != "ok").sum(),
        reasons=reason.filter(pl.col("status") != "ok").value_counts(sort=True),
    )
    failed = failed.filter(pl.col("failed") > 0).with_columns(share=pl.col("failed") / pl.col("cells"))
    texts = [
        "; ".join(f"{r['error']} ({r['count']}×)" for r in reasons) for reasons in failed["reasons"].to_list()
    ]
    return failed.select(*of, "cells", "failed", "share").with_columns(
        reasons=pl.Series("reasons", texts, pl.String)
    )


def order(frame: pl.DataFrame, config: cfg.StudyConfig) -> dict[str, list[str]]:
    """Return the levels of every factor in the order in which they are shown."""
    methods = cfg.methods(config)
    present = {f: set(frame[f].to_list()) for f in factors(config)}
    listed = {
        "filter": dict.fromkeys(m.label for m in methods),
        **{f: dict.fromkeys(m.levels[f] for m in methods) for f in cfg.factor_names(config)},
        "configuration": dict.fromkeys(sorted(present["configuration"], key=by_number)),
    }
    return {f: [level for level in listed[f] if level in present[f]] for f in factors(config)}


def by_number(label: str) -> list[tuple[int, str]]:
    """Return a key that puts ``50 m`` before ``100 m``."""
    parts = re.split(r"(\d+)", label)
    return [(int(part), "") if k % 2 else (0, part) for k, part in enumerate(parts)]


def _subset(frame: pl.DataFrame, subset: str) -> pl.DataFrame:
    if subset == "all":
        return frame
    return frame.filter(pl.col("clipped") if subset == "clipped" else ~pl.col("clipped"))


def groups(frame: pl.DataFrame, config: cfg.StudyConfig) -> pl.DataFrame:
    """Summarize every metric by filter, factors and configuration, for all, unclipped and clipped inputs.

    Columns: ``metric, unit, subset``, the factors (empty where pooled) and the fields of
    :class:`~marcha.study.statistics.GroupSummary`.
    """
    rows: list[dict[str, Any]] = []
    names = cfg.factor_names(config)
    pooled = [factors(config), ("filter", *names), ("configuration", *names)]
    subsets = SUBSETS if frame["clipped"].n_unique() > 1 else SUBSETS[:1]
    for subset in subsets:
        part = _subset(frame, subset)
        for by in pooled:
            for key, group in part.group_by(["metric", "unit", *by], maintain_order=True):
                kept = group.filter(~pl.col("outlier"))["value"].to_numpy()
                summary = summarize(kept, sigma=0, min_samples=config.statistics.min_samples)
                summary = msgspec.structs.replace(summary, outliers=int(group["outlier"].sum()))
                rows.append(
                    {
                        "metric": key[0],
                        "unit": key[1],
                        "subset": subset,
                        **dict.fromkeys(factors(config), ""),
                        **dict(zip(by, key[2:], strict=True)),
                        **msgspec.structs.asdict(summary),
                    }
                )
    fields = {
        f.name: pl.String if f.name == "note" else pl.Float64 for f in msgspec.structs.fields(GroupSummary)
    }
    fields |= dict.fromkeys(("n", "outliers", "missing"), pl.Int64)
    schema = {**dict.fromkeys(("metric", "unit", "subset", *factors(config)), pl.String), **fields}
    return pl.DataFrame(rows, schema=schema)


def outliers(frame: pl.DataFrame, config: cfg.StudyConfig) -> pl.DataFrame:
    """Return the values that were left out."""
    return frame.filter(pl.col("outlier")).select(
        "metric", *factors(config), "recording", "input", "value", "unit", "clipped"
    )


def comparisons(frame: pl.DataFrame, config: cfg.StudyConfig) -> pl.DataFrame:
    """Compare every pair of levels of one factor, family by family.

    Families, each corrected by Holm on its own: filters within each configuration and pooled; configurations
    within each filter and pooled (both at the first level of every factor); the levels of each factor within
    each filter × configuration (the other factors at their first).

    Columns: ``metric, unit, factor`` (what is compared), ``within`` (what is held fixed), ``a, b`` and the
    fields of :class:`~marcha.study.statistics.GroupComparison`.
    """
    frame = frame.filter(~pl.col("outlier") & pl.col("value").is_finite())
    levels = order(frame, config)
    base = base_levels(levels, config)
    rows: list[dict[str, Any]] = []
    for (metric, unit), part in frame.group_by("metric", "unit", maintain_order=True):
        for factor, fixed in _families(levels, base):
            held = {k: v for k, v in fixed.items() if k in base}
            family = part.filter(*(pl.col(k) == v for k, v in fixed.items() if k not in base), *at_base(held))
            samples = {
                level: family.filter(pl.col(factor) == level)["value"].to_numpy() for level in levels[factor]
            }
            present = [level for level in levels[factor] if len(samples[level])]
            pairs = [(a, b) for i, a in enumerate(present) for b in present[i + 1 :]]
            options = config.statistics
            results = [
                compare(
                    samples[a],
                    samples[b],
                    confidence=options.confidence,
                    min_samples=options.min_samples,
                    nonparametric=options.nonparametric,
                )
                for a, b in pairs
            ]
            within = ", ".join(v for v in fixed.values() if v)
            for (a, b), result in zip(pairs, corrected(results), strict=True):
                rows.append(
                    {
                        "metric": metric,
                        "unit": unit,
                        "factor": factor,
                        "within": within,
                        "a": a,
                        "b": b,
                        **msgspec.structs.asdict(result),
                    }
                )
    kinds = {
        f.name: pl.String if f.name == "note" else pl.Float64 for f in msgspec.structs.fields(GroupComparison)
    }
    kinds |= dict.fromkeys(("n_a", "n_b"), pl.Int64)
    schema = {**dict.fromkeys(("metric", "unit", "factor", "within", "a", "b"), pl.String), **kinds}
    return pl.DataFrame(rows, schema=schema)


def _families(levels: dict[str, list[str]], base: dict[str, str]) -> Iterator[tuple[str, dict[str, str]]]:
    """Yield (factor that is compared, levels that are held fixed)."""
    for factor, other in (("filter", "configuration"), ("configuration", "filter")):
        if len(levels[factor]) < 2:
            continue
        for level in levels[other]:
            yield factor, {other: level, **base}
        if len(levels[other]) > 1:
            yield factor, base
    for factor in base:
        if len(levels[factor]) < 2:
            continue
        others = {name: level for name, level in base.items() if name != factor}
        for label in levels["filter"]:
            for configuration in levels["configuration"]:
                yield factor, {"filter": label, "configuration": configuration, **others}


def beside_published(group_table: pl.DataFrame, config: cfg.StudyConfig) -> pl.DataFrame:
    """Put published means beside the measured ones.

    Columns: ``table, by, metric, unit, filter``, the factors, ``configuration, published, published_sd,
    published_max, published_min, measured, measured_sd, measured_max, measured_min, n, ratio, origin, note``.
    Measured values are null where the study has none, published ones where they are not known.
    """
    measured = {
        (r["metric"], *(r[f] for f in factors(config))): r
        for r in group_table.filter((pl.col("subset") == "all") & (pl.col("configuration") != "")).iter_rows(
            named=True
        )
    }
    rows: list[dict[str, Any]] = []
    units = {cfg.metric_title(m): m.unit for m in config.metrics}
    for table in config.published:
        for row_label, cells in table.rows.items():
            label = row_label if table.by == "estimator" else table.estimator
            levels = {name: table.levels.get(name, "") for name in cfg.factor_names(config)}
            if table.by != "estimator":
                levels[table.by] = row_label
            for configuration, value in cells.items():
                measured_row = measured.get((table.metric, label, *levels.values(), configuration))
                more = {
                    f"published_{name}": None
                    if (published_value := part.get(row_label, {}).get(configuration)) is None
                    else published_value * table.scale
                    for name, part in (("sd", table.sd), ("max", table.maximum), ("min", table.minimum))
                }
                published = value * table.scale
                rows.append(
                    {
                        "table": table.table,
                        "by": table.by,
                        "metric": table.metric,
                        "unit": units[table.metric],
                        "filter": label,
                        **levels,
                        "configuration": configuration,
                        "published": published,
                        **more,
                        "measured": measured_row["mean"] if measured_row else None,
                        "measured_sd": measured_row["sd"] if measured_row else None,
                        "measured_max": measured_row["maximum"] if measured_row else None,
                        "measured_min": measured_row["minimum"] if measured_row else None,
                        "n": measured_row["n"] if measured_row else 0,
                        "ratio": measured_row["mean"] / published if measured_row and published else None,
                        "origin": table.origin,
                        "note": table.note,
                    }
                )
    floats = tuple(f"{of}{part}" for of in ("published", "measured") for part in ("", "_sd", "_max", "_min"))
    schema = {
        **dict.fromkeys(("table", "by", "metric", "unit", *factors(config)), pl.String),
        **dict.fromkeys(floats, pl.Float64),
        "n": pl.Int64,
        "ratio": pl.Float64,
        "origin": pl.String,
        "note": pl.String,
    }
    return pl.DataFrame(rows, schema=schema)


def json_rows(frame: pl.DataFrame) -> list[dict[str, Any]]:
    """Return a table's rows with numbers that JSON can hold: what is not finite becomes null."""
    return frame.with_columns(
        pl.col(pl.Float64).replace([float("inf"), float("-inf")], None).fill_nan(None)
    ).to_dicts()


#: Metrics that are NEES, with the dimension of the error.
NEES = {"nees_position_end": 3, "nees_velocity_end": 3, "nees_attitude_end": 3}


def consistency(table: pl.DataFrame, config: cfg.StudyConfig) -> pl.DataFrame:
    """Test every filter's covariance: mean NEES over walks against its chi-square interval.

    Columns: ``metric, filter``, the factors, ``configuration`` (empty: all of the same ``clipped``), ``clipped``
    (apart, since no filter can know what a sensor did beyond its full scale), ``n, mean, median, low, high,
    verdict``.
    """
    rows: list[dict[str, Any]] = []
    done = table.filter(pl.col("status") == "ok")
    for name, dof in NEES.items():
        if name not in done.columns:
            continue
        finite = done.filter(pl.col(name).is_finite())
        for by in (("clipped", "filter", *cfg.factor_names(config)), ("clipped", *factors(config))):
            for key, part in finite.group_by(*by, maintain_order=True):
                mean, n = float(part[name].mean()), part.height  # pyright: ignore[reportArgumentType]
                low, high = nees_bounds(n, dof, config.statistics.confidence)
                verdict = (
                    "consistent" if low <= mean <= high else "too sure" if mean > high else "too careful"
                )
                rows.append(
                    {
                        "metric": name,
                        **dict.fromkeys(factors(config), ""),
                        **dict(zip(by, key, strict=True)),
                        "n": n,
                        "mean": mean,
                        "median": part[name].median(),
                        "low": low,
                        "high": high,
                        "verdict": verdict,
                    }
                )
    schema = {
        **dict.fromkeys(("metric", *factors(config)), pl.String),
        "clipped": pl.Boolean,
        "n": pl.Int64,
        **dict.fromkeys(("mean", "median", "low", "high"), pl.Float64),
        "verdict": pl.String,
    }
    return pl.DataFrame(rows, schema=schema).sort("clipped", maintain_order=True)


def remarks(cells: Sequence[Any], config: cfg.StudyConfig) -> list[str]:
    """Return what a reader must know before the numbers: failed cells, metrics that no cell has."""
    notes: list[str] = []
    for c in (c for c in cells if c.status != "ok"):
        where, method = (
            f"{c.recording} {c.input}".strip(),
            " ".join(filter(None, (c.label, *c.levels.values()))),
        )
        notes.append(f"failed: {where}, {method}: {c.error}")
    if len(notes) > 12:
        notes = [*notes[:12], f"{len(notes) - 12} more cells failed; `error` in results.csv says why"]
    have = {name for c in cells for name in c.metrics} | {"run_time_s", "samples", "clipped_readings"}
    notes += [
        f"no cell has the metric {m.column} ({cfg.metric_title(m)}): is its truth known (closed, length_m)?"
        for m in config.metrics
        if m.column not in have
    ]
    if config.by and not any(c.by_label for c in cells):
        notes.append(f"no recording has the tier {config.by!r}, and no rule of this name finds anything")
    return notes
