"""The plainest engine there can be: one message at a time, in log-time order. The real one must equal it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import polars as pl
from marcha.algorithms import ALL_COLUMNS, ChannelInfo, Context, Message
from marcha.algorithms.contract import TIMES


def context_of(
    estimator: Any,
    tables: Mapping[str, Mapping[str, pl.DataFrame]],
    metadata: Mapping[str, Mapping[str, str]] | None = None,
    attachments: Mapping[str, bytes] | None = None,
    calibrations: Mapping[str, Any] | None = None,
) -> Context:
    """Return the context of channels given as ``{input name: {topic: table}}``."""
    channels: dict[str, tuple[ChannelInfo, ...]] = {}
    for need in estimator.inputs:
        infos = []
        for topic, table in tables.get(need.name, {}).items():
            columns = tuple(c for c in table.columns if c not in TIMES)
            intervals = np.diff(table["t_ns"].to_numpy())
            rate = 1e9 / float(np.median(intervals)) if intervals.size and np.median(intervals) > 0 else 0.0
            wanted = columns if need.columns == ALL_COLUMNS else need.columns
            infos.append(ChannelInfo(topic, need.schema, "", wanted, rate))
        channels[need.name] = tuple(infos)
    return Context(channels, metadata or {}, attachments or {}, {}, calibrations or {})


def messages_of(estimator: Any, tables: Mapping[str, Mapping[str, pl.DataFrame]]) -> list[Message]:
    """Return all messages by log time; ties by the order of the inputs and channels given."""
    found: list[tuple[int, Message]] = []
    for need in estimator.inputs:
        for topic, table in tables.get(need.name, {}).items():
            columns = [c for c in table.columns if c not in TIMES]
            wanted = columns if need.columns == ALL_COLUMNS else list(need.columns)
            logs = table["t_log_ns"] if "t_log_ns" in table.columns else table["t_ns"]
            rows = table.select(wanted).rows()
            last: int | None = None
            for t_ns, log_ns, values in zip(table["t_ns"].to_list(), logs.to_list(), rows, strict=True):
                if need.regular:
                    if not all(v is not None and np.isfinite(v) for v in values):
                        continue
                    if last is not None and t_ns <= last:
                        continue
                    last = t_ns
                found.append((log_ns, Message(need.name, t_ns, values, log_ns, topic)))
    return [m for _, m in sorted(found, key=lambda pair: pair[0])]


def drive(
    estimator: Any,
    tables: Mapping[str, Mapping[str, pl.DataFrame]],
    context: Context | None = None,
    **about: Any,
) -> dict[str, pl.DataFrame]:
    """Run an estimator over tables given as ``{input name: {topic: table}}``.

    Returns
    -------
    dict of str to polars.DataFrame
        By output: ``t_ns``, ``t_log_ns`` and its columns.
    """
    estimator.start(context if context is not None else context_of(estimator, tables, **about))
    results: list[tuple[int, Any]] = []
    newest = 0
    for message in messages_of(estimator, tables):
        newest = message.log_ns
        results += [(message.log_ns, r) for r in estimator.take(message) or ()]
    results += [(newest, r) for r in estimator.finish() or ()]
    out: dict[str, pl.DataFrame] = {}
    for output in estimator.outputs:
        mine = [(r.t_ns, log, *r.values) for log, r in results if r.output == output.name]
        out[output.name] = pl.DataFrame(
            mine, schema=["t_ns", "t_log_ns", *output.columns], orient="row", infer_schema_length=None
        )
    return out
