"""Estimators: pure numerics that know no file, no clock and no viewer. See :mod:`.contract`."""

from .contract import (
    AlgorithmError,
    Estimator,
    Input,
    KernelEstimator,
    Output,
    PlainEstimator,
    Remark,
    input_columns,
    output_columns,
)
from .parameters import Parameter, describe
from .registry import available, find, make

__all__ = [
    "AlgorithmError",
    "Estimator",
    "Input",
    "KernelEstimator",
    "Output",
    "Parameter",
    "PlainEstimator",
    "Remark",
    "available",
    "describe",
    "find",
    "input_columns",
    "make",
    "output_columns",
]
