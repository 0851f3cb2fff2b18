"""Metrics by annotation: every cell's labels of one tier beside each other, compared walk by walk.

A label and what lies between belong to the same walk, so the tests are paired: a cell that does not have both
takes no part.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Any

import msgspec
import numpy as np
import polars as pl

from ..replay.metrics import BETWEEN
from . import config as cfg
from .analysis import factors
from .cells import StudyCell
from .statistics import PairedComparison, holm, paired


def _keys(config: cfg.StudyConfig) -> tuple[str, ...]:
    """Return the columns that say which metric of which method in which configuration."""
    return ("metric", "unit", *factors(config))


def label_values(cells: Sequence[StudyCell], config: cfg.StudyConfig) -> pl.DataFrame:
    """Return one row a finished cell, metric and label, in the metric's unit.

    Columns: ``metric, unit, label, filter``, the factors, ``configuration, recording, input, value``. The label
    :data:`~marcha.replay.metrics.BETWEEN` is what no annotation of the tier covers.
    """
    rows = [
        {
            "metric": cfg.metric_title(metric),
            "unit": metric.unit,
            "label": label,
            "filter": cell.label,
            **{name: cell.levels.get(name, "") for name in cfg.factor_names(config)},
            "configuration": cell.configuration,
            "recording": cell.recording,
            "input": cell.input,
            "value": abs(value) if metric.absolute else value,
        }
        for cell in cells
        if cell.status == "ok"
        for label, figures in cell.by_label.items()
        for metric in config.metrics
        if np.isfinite(value := figures.get(metric.column, np.nan) * metric.scale)
    ]
    texts = ("metric", "unit", "label", *factors(config), "recording", "input")
    return pl.DataFrame(rows, schema={**dict.fromkeys(texts, pl.String), "value": pl.Float64})


def label_means(values: pl.DataFrame, config: cfg.StudyConfig) -> pl.DataFrame:
    """Return mean, sd (n − 1) and n by metric, method, configuration and label."""
    return values.group_by(*_keys(config), "label", maintain_order=True).agg(
        n=pl.len(), mean=pl.col("value").mean(), sd=pl.col("value").std()
    )


def label_comparisons(values: pl.DataFrame, config: cfg.StudyConfig) -> pl.DataFrame:
    """Compare every pair of labels within each method and configuration, paired by walk and input.

    A family, corrected by Holm, is a metric of one method in one configuration. Columns: metric,
    unit, filter, factors, configuration, ``a, b`` and the fields of
    :class:`~marcha.study.statistics.PairedComparison`.
    """
    options, keys = config.statistics, _keys(config)
    rows: list[dict[str, Any]] = []
    for key, part in values.group_by(*keys, maintain_order=True):
        labels = sorted(part["label"].unique(), key=lambda label: (label == BETWEEN, label))
        wide = part.pivot("label", index=["recording", "input"], values="value")
        family = []
        for a, b in combinations(labels, 2):
            both = wide.select(a, b).drop_nulls()
            result = paired(
                both[a].to_numpy(),
                both[b].to_numpy(),
                confidence=options.confidence,
                min_samples=options.min_samples,
            )
            family.append((a, b, result))
        t_holm = holm([r.t_p for _, _, r in family])
        rank_holm = holm([r.rank_p for _, _, r in family])
        for (a, b, result), t, rank in zip(family, t_holm, rank_holm, strict=True):
            result = msgspec.structs.replace(result, t_p_holm=float(t), rank_p_holm=float(rank))
            rows.append(dict(zip(keys, key, strict=True)) | {"a": a, "b": b} | msgspec.structs.asdict(result))
    fields = msgspec.structs.fields(PairedComparison)
    kinds: dict[str, type[pl.DataType]] = {
        f.name: pl.String if f.name == "note" else pl.Float64 for f in fields
    }
    schema = {**dict.fromkeys((*keys, "a", "b"), pl.String), **kinds, "n": pl.Int64}
    return pl.DataFrame(rows, schema=schema)
