"""The plainest engine there can be: one message at a time, in log-time order. The real one must equal it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import polars as pl
from marcha.algorithms import Context, Message

from .contracts import estimator as contract
from .contracts.estimator import Tables


def context_of(
    estimator: Any,
    tables: Tables,
    metadata: Mapping[str, Mapping[str, str]] | None = None,
    attachments: Mapping[str, bytes] | None = None,
    calibrations: Mapping[str, Any] | None = None,
) -> Context:
    """Return the context of channels given as ``{input name: {topic: table}}``."""
    channels = contract.context_of(estimator, tables).channels
    return Context(channels, metadata or {}, attachments or {}, {}, calibrations or {})


def messages_of(estimator: Any, tables: Tables) -> list[Message]:
    """Return what the engine hands over: of regular inputs only finite values at ascending times of a channel."""
    regular = {need.name for need in estimator.inputs if need.regular}
    last: dict[tuple[str, str], int] = {}
    found: list[Message] = []
    for message in contract.messages_of(estimator, tables):
        if message.input in regular:
            channel = (message.input, message.channel)
            finite = all(v is not None and np.isfinite(v) for v in message.values)
            if not finite or message.t_ns <= last.get(channel, message.t_ns - 1):
                continue
            last[channel] = message.t_ns
        found.append(message)
    return found


def drive(
    estimator: Any,
    tables: Tables,
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
