"""Estimators: pure numerics that know no file, no clock and no viewer. See :mod:`.contract`."""

from .calibration import Calibration, Calibrator, Stretch
from .contract import (
    ALL_COLUMNS,
    AlgorithmError,
    Annotate,
    ChannelInfo,
    Context,
    Estimator,
    Input,
    KernelEstimator,
    Message,
    Output,
    PlainEstimator,
    Remark,
    Result,
    RowEstimator,
    RowKernel,
    input_columns,
    output_columns,
)
from .parameters import Parameter, describe
from .registry import available, find, make

__all__ = [
    "ALL_COLUMNS",
    "AlgorithmError",
    "Annotate",
    "Calibration",
    "Calibrator",
    "ChannelInfo",
    "Context",
    "Estimator",
    "Input",
    "KernelEstimator",
    "Message",
    "Output",
    "Parameter",
    "PlainEstimator",
    "Remark",
    "Result",
    "RowEstimator",
    "RowKernel",
    "Stretch",
    "available",
    "describe",
    "find",
    "input_columns",
    "make",
    "output_columns",
]
