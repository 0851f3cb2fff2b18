"""Results of an estimator as columns of its messages' types."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..algorithms.contract import (
    Output,
)
from ..recording.schemas import SCHEMAS
from .blocks import Columns

_INTEGERS = {"index": np.uint32, "status": np.int8, "service": np.uint16}


def typed(output: Output, name: str, values: Any) -> Any:
    """Return a result column in the type of its message's field."""
    schema = SCHEMAS.get(output.schema)
    column = (
        None if schema is None or schema.names else next((c for c in schema.columns if c.name == name), None)
    )
    if column is None:
        return values.astype(np.float64) if values.dtype.kind in "iufb" else values
    if column.kind == "flag":
        return values > 0.5 if values.dtype.kind == "f" else values.astype(bool)
    if column.kind == "time":
        return values.astype(np.int64)
    if column.kind in ("mac", "technology", "text"):
        return values.astype(object) if values.dtype.kind == "U" else values
    return values.astype(_INTEGERS.get(name, np.float64), copy=False)


def with_swing_times(steps: Columns) -> Columns:
    """Turn the swing's length of a step, which ends at the row's time, into its two times.

    Row kernels know no clock: they state ``swing_s`` instead of ``start_ns`` and ``end_ns``.
    """
    if "swing_s" not in steps:
        return steps
    t_ns = steps["t_ns"]
    times = {"start_ns": t_ns - np.round(steps["swing_s"] * 1e9).astype(np.int64), "end_ns": t_ns}
    rest = {name: values for name, values in steps.items() if name not in ("t_ns", "t_log_ns", "swing_s")}
    return {"t_ns": t_ns, "t_log_ns": steps["t_log_ns"], **times, **rest}
