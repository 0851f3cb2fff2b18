"""What an estimator is: parameters, one packed state, one step a sample.

An estimator is pure numerics. It knows no file, no clock and no viewer. The engine (``marcha.replay``)
owns time differences, gaps, missing values, units and frames, and hands over one row of numbers a sample.

The row
    ``[dt_s, <columns of the first input>, <columns of every further input>]`` as float64, in the units of the
    recording (m/s², rad/s, T, Pa). ``dt_s`` is the time since the previous row of the first input, 0 for the
    first. Columns of the first input are always finite. Columns of a further input carry its newest message
    that arrived since the previous row, and NaN where none arrived: sensors at different rates are joined
    causally, never interpolated.

The result
    one float64 vector in the order of ``outputs`` (all columns of all outputs, one after another), or None
    where there is nothing to say yet. With ``latency`` L, the result of call k speaks of row k − L; the
    first L calls return None, and ``flush`` returns the last L results. So a detector may look ahead, and
    replay stays causal: the engine stamps a result with the time that it speaks of and logs it at the time
    when it was known. A column that has no value is NaN. An output marked ``event`` exists only where its
    first column is not NaN.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Protocol, Self, runtime_checkable

import msgspec
import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


class AlgorithmError(ValueError):
    """A mistake of the caller (unknown name, parameter out of range): one line, no traceback."""


@dataclass(frozen=True)
class Input:
    """One stream that an estimator reads.

    Attributes
    ----------
    schema : str
        Message type of the channels that fit, for example ``sensor_msgs/msg/Imu``.
    columns : tuple of str
        Columns of that channel's table, in the order of the row.
    optional : bool
        Whether the estimator runs without it (its columns are NaN then). Never true for the first input.
    """

    schema: str
    columns: tuple[str, ...]
    optional: bool = False


@dataclass(frozen=True)
class Output:
    """One channel that an estimator writes, as ``/estimate/<run>/<name>``.

    Attributes
    ----------
    name : str
        Last part of the topic: ``pose``, ``velocity``, ``stance`` …
    schema : str
        Message type, for example ``geometry_msgs/msg/PoseStamped``.
    columns : tuple of str
        Columns of that message's table.
    event : bool
        True where a result exists only now and then (a step): rows whose first column is NaN are not written.
    metadata : tuple of (str, str)
        What the channel's metadata should say, for example thresholds of a detector's statistics.
    """

    name: str
    schema: str
    columns: tuple[str, ...]
    event: bool = False
    metadata: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class Remark:
    """Something that a user must know about a run ("no rest at the start"), in one line.

    Attributes
    ----------
    kind : str
        Stable lower-case word: ``no_rest``, ``upside_down``, ``never_moved``, ``diverged`` …
    detail : str
        What was seen, the value, the rule and the remedy.
    fatal : bool
        True where the results must not be used.
    """

    kind: str
    detail: str
    fatal: bool = False


@runtime_checkable
class Estimator(Protocol):
    """The least that the engine asks of an estimator; a plain class with NumPy is enough.

    ``step`` takes the row described above and returns the result vector or None. ``inputs`` and ``outputs``
    may be class attributes or set in ``__init__``. Everything else has a default in :class:`PlainEstimator`.
    """

    name: ClassVar[str]
    inputs: tuple[Input, ...]
    outputs: tuple[Output, ...]

    def step(self, row: FloatArray) -> FloatArray | None:
        """Take one row, return one result or None."""
        ...


class PlainEstimator:
    """Convenient base of a user's estimator: subclass it, set the class attributes, write ``step``.

    Attributes
    ----------
    name, inputs, outputs
        See :class:`Estimator`.
    latency : int
        Number of rows by which a result lags behind the row that was just taken.
    offline : bool
        True for smoothers that need the whole recording (``process`` is called once with all rows).
    Params : type of msgspec.Struct
        Parameters with unit, effect, default and source in their ``Meta``; built from keyword arguments.
    title, source : str
        One line for ``marcha estimators``; author, year and equations.
    """

    name: ClassVar[str] = ""
    title: ClassVar[str] = ""
    source: ClassVar[str] = ""
    offline: ClassVar[bool] = False
    Params: ClassVar[type[msgspec.Struct]] = msgspec.defstruct("NoParams", [], frozen=True)
    presets: ClassVar[dict[str, dict[str, Any]]] = {}
    """Named parameter sets ("tuned-…"): name to the values that differ from the defaults."""

    inputs: tuple[Input, ...] = ()
    outputs: tuple[Output, ...] = ()
    latency: int = 0

    def __init__(self, params: msgspec.Struct | None = None) -> None:
        self.params = params if params is not None else self.Params()

    def step(self, row: FloatArray) -> FloatArray | None:
        """Take one row, return one result or None."""
        raise NotImplementedError

    def flush(self) -> FloatArray:
        """Return the results of the last ``latency`` rows, shape (≤ latency, columns)."""
        return np.empty((0, len(output_columns(self))))

    def snapshot(self) -> Any:
        """Return a copy of the state; ``restore`` takes it back."""
        return copy.deepcopy({k: v for k, v in self.__dict__.items() if k != "params"})

    def restore(self, snapshot: Any) -> None:
        """Go back to the state of ``snapshot``."""
        self.__dict__.update(copy.deepcopy(snapshot))

    def remarks(self) -> list[Remark]:
        """Return what a user must know about the run so far."""
        return []


class KernelEstimator(PlainEstimator):
    """Base of estimators whose state is one packed float64 buffer and whose step is a numba kernel.

    A subclass sets ``kernel(state, row, out) -> bool`` and ``run(state, rows, out) -> int``, both
    module-level ``@njit(cache=True, nogil=True)`` functions of its module wrapped in ``staticmethod``, and
    ``flush_kernel(state, out) -> int`` where ``latency`` is not 0, and builds ``self.state`` in
    ``__init__``. ``kernel`` returns whether ``out`` was filled; ``run`` fills ``out[i]`` from ``rows[i]`` (a
    row without a result is NaN throughout) and returns the number of results. Both give equal bits.
    """

    kernel: ClassVar[Callable[..., Any]]
    run: ClassVar[Callable[..., Any]]
    flush_kernel: ClassVar[Callable[..., Any] | None] = None
    state: FloatArray

    def step(self, row: FloatArray) -> FloatArray | None:
        """Take one row, return one result or None."""
        out = np.empty(self.width)
        return out if self.kernel(self.state, row, out) else None

    def run_block(self, rows: FloatArray, out: FloatArray) -> int:
        """Take ``rows`` (n, inputs), fill ``out`` (n, outputs); rows without a result are NaN.

        Both may lie by columns in memory, as the engine's do: a single row is then no contiguous array.
        """
        return int(self.run(self.state, rows, out))

    def flush(self) -> FloatArray:
        """Return the results of the last ``latency`` rows, shape (≤ latency, columns)."""
        out = np.empty((self.latency, self.width))
        if self.flush_kernel is None or self.latency == 0:
            return out[:0]
        return out[: int(self.flush_kernel(self.state, out))]

    @cached_property
    def width(self) -> int:
        """Number of result columns."""
        return len(output_columns(self))

    def snapshot(self) -> FloatArray:
        """Return a copy of the packed state."""
        return self.state.copy()

    def restore(self, snapshot: FloatArray) -> None:
        """Go back to the state of ``snapshot``."""
        self.state[:] = snapshot

    @classmethod
    def make(cls, **params: Any) -> Self:
        """Build from keyword parameters; see :func:`marcha.algorithms.make`."""
        return cls(msgspec.convert(params, cls.Params))


def input_columns(estimator: Estimator) -> tuple[str, ...]:
    """Return the names of the row's entries: ``dt_s`` and every input's columns."""
    return ("dt_s", *(c for i in estimator.inputs for c in i.columns))


def output_columns(estimator: Estimator) -> tuple[str, ...]:
    """Return the names of the result's entries, ``<output>.<column>``."""
    return tuple(f"{o.name}.{c}" for o in estimator.outputs for c in o.columns)
