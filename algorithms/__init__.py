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
from .registry import CALIBRATIONS, available, build_params, find, make

__all__ = [
    "ALL_COLUMNS",
    "CALIBRATIONS",
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
    "build_params",
    "describe",
    "find",
    "input_columns",
    "make",
    "output_columns",
]
