"""What an estimator is: named inputs, named outputs, and what it does with a message.

An estimator is pure numerics. It knows no file, no clock and no viewer. The engine (``marcha.replay``) owns
order, gaps, missing values, units and frames.

Inputs
    An estimator declares named inputs (:class:`Input`) by message type and columns, required or optional, one
    channel or many. Every message of every attached channel reaches it once, in log-time order (ties: by the
    order of the channels in the recording), with the time that it speaks of. Text, integer and boolean columns
    keep their types. An input that is ``regular`` (samples of a sensor) is guarded: messages without a finite
    value or not later than the one before are counted and left out, and the gap policy watches it.

Outputs
    Named as well (:class:`Output`), each with a message type of its own. A message may be answered with any
    number of results (:class:`Result`), each with the time that it speaks of; it is logged at the time when it
    was known, so replay stays causal.

Context
    Before the first message :meth:`PlainEstimator.start` gets the :class:`Context`: attached channels with
    their measured rates, the recording's metadata, attachments (anchor tables, floor plans), static channels,
    calibrations. Nothing else comes from outside.

Chains
    An input may name the estimator that serves it by default (``stage``): its output reaches this input in the
    same pass, directly after the message that caused it.

Four bases, from the plainest to the fastest; all give the same bits at any speed, in blocks and after a seek:
:class:`PlainEstimator` (one message at a time, NumPy is enough), :class:`KernelEstimator` (the same as a
compiled kernel over blocks of merged messages), and, for filters that take one row a sample of one sensor,
:class:`RowEstimator` and :class:`RowKernel`.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Mapping
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, Self, runtime_checkable

import msgspec
import numpy as np
from numpy.typing import NDArray

from .declarations import ALL_COLUMNS as ALL_COLUMNS
from .declarations import Annotate as Annotate
from .declarations import ChannelInfo as ChannelInfo
from .declarations import Context as Context
from .declarations import FloatArray as FloatArray
from .declarations import Input as Input
from .declarations import IntArray as IntArray
from .declarations import Message as Message
from .declarations import Output as Output
from .declarations import Remark as Remark
from .declarations import Result as Result

if TYPE_CHECKING:
    import polars as pl


class AlgorithmError(ValueError):
    """A mistake of the caller (unknown name, parameter out of range): one line, no traceback."""


@runtime_checkable
class Estimator(Protocol):
    """The least that the engine asks of an estimator; a plain class with NumPy is enough.

    ``take`` gets one message and returns its results. ``inputs`` and ``outputs`` may be class attributes or set
    in ``__init__`` or ``start``. Everything else has a default in :class:`PlainEstimator`.
    """

    name: ClassVar[str]
    inputs: tuple[Input, ...]
    outputs: tuple[Output, ...]

    def take(self, message: Message) -> Iterable[Result] | None:
        """Take one message, return any number of results."""
        ...


class PlainEstimator:
    """Convenient base of a user's estimator: subclass it, set the class attributes, write ``take``.

    Attributes
    ----------
    name, inputs, outputs
        See :class:`Estimator`.
    offline : bool
        True for smoothers that need the whole recording: results come from ``finish`` only, logged at the end.
    Params : type of msgspec.Struct
        Parameters with unit, effect, default and source in their ``Meta``; built from keyword arguments. A
        parameter ``rate_hz`` whose value is 0 is set to the measured rate of the first input.
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
        self.params: Any = params if params is not None else self.Params()

    def start(self, context: Context) -> None:
        """Look at the context, once, before the first message. Raise AlgorithmError where it does not do."""

    def take(self, message: Message) -> Iterable[Result] | None:
        """Take one message, return any number of results."""
        raise NotImplementedError

    def finish(self) -> Iterable[Result] | None:
        """Return the results still held back after the last message, or before a restart."""
        return None

    def snapshot(self) -> Any:
        """Return a copy of the state; ``restore`` takes it back."""
        return copy.deepcopy({k: v for k, v in self.__dict__.items() if k != "params"})

    def restore(self, snapshot: Any) -> None:
        """Go back to the state of ``snapshot``."""
        self.__dict__.update(copy.deepcopy(snapshot))

    def remarks(self) -> list[Remark]:
        """Return what a user must know about the run so far."""
        return []

    @classmethod
    def make(cls, **params: Any) -> Self:
        """Build from keyword parameters; see :func:`marcha.algorithms.make`."""
        return cls(msgspec.convert(params, cls.Params))


class KernelEstimator(PlainEstimator):
    """Base of estimators that take merged blocks of messages with a compiled kernel.

    A subclass builds ``self.state`` (a NumPy structured array of shape (1,)) in ``start`` or ``__init__`` and
    sets ``run``, a module-level compiled function wrapped in ``staticmethod``::

        run(state, inputs, channels, t_ns, values, out_message, out_t_ns, out_values) -> int

    with, for n messages, ``inputs`` (n,) indices into ``self.inputs``, ``channels`` (n,) indices into the
    channels attached to that input, ``t_ns`` (n,) int64 and ``values`` (n, widest input) float64 (NaN beyond
    the columns of a message's input). It writes result k as ``out_message[k]`` (the place in the block of the
    message after which it is known, never decreasing), ``out_t_ns[k]`` and ``out_values[k]`` (all columns of all
    outputs, one after another; NaN where an output has nothing to say), and returns the number of results. One
    message may be answered with up to ``max_results`` rows. Blocks may be cut anywhere: the same bits come out.

    ``run_end(state, out_t_ns, out_values) -> int`` gives what is held back at the end, up to ``max_held`` rows.
    """

    run: ClassVar[Callable[..., Any]]
    run_end: ClassVar[Callable[..., Any] | None] = None
    max_results: int = 1
    max_held: int = 0
    state: NDArray[Any]

    def encode(self, index: int, channel: int, table: pl.DataFrame) -> FloatArray:
        """Return the values of one channel's messages as the kernel takes them, shape (n, columns of the input).

        Override it for texts (an address becomes the number of an anchor). A message is encoded by itself:
        nothing may be kept from one to the next.
        """
        columns = self.columns_of(index, table)
        out = np.empty((table.height, len(columns)))
        for i, name in enumerate(columns):
            out[:, i] = table[name].to_numpy()
        return out

    def columns_of(self, index: int, table: pl.DataFrame) -> tuple[str, ...]:
        """Return the columns that input ``index`` reads of ``table``."""
        wanted = self.inputs[index].columns
        return tuple(c for c in table.columns if c not in TIMES) if wanted == ALL_COLUMNS else wanted

    @cached_property
    def width(self) -> int:
        """Number of result columns."""
        return len(output_columns(self))

    def take(self, message: Message) -> Iterable[Result] | None:
        """Take one message, return its results."""
        import polars as pl

        index = next(i for i, one in enumerate(self.inputs) if one.name == message.input)
        columns = self.inputs[index].columns
        if columns == ALL_COLUMNS:
            columns = tuple(f"column_{i}" for i in range(len(message.values)))
        table = pl.DataFrame({c: [v] for c, v in zip(columns, message.values, strict=True)})
        values = self.encode(index, self.channel_index(index, message.channel), table)
        places = np.zeros(self.max_results, np.int64), np.zeros(self.max_results, np.int64)
        out = np.full((self.max_results, self.width), np.nan)
        channels = np.array([self.channel_index(index, message.channel)])
        count = self.run(
            self.state, np.array([index]), channels, np.array([message.t_ns], np.int64), values, *places, out
        )
        return self.results(places[1][:count], out[:count])

    def channel_index(self, index: int, topic: str) -> int:
        """Return the place of ``topic`` among the channels attached to input ``index``."""
        return self.topics.get(self.inputs[index].name, (topic,)).index(topic)

    topics: Mapping[str, tuple[str, ...]] = {}
    """Topics attached to each input, set by :meth:`start`; call it with ``super().start(context)``."""

    def start(self, context: Context) -> None:
        """Note which channels are attached."""
        self.topics = {name: tuple(c.topic for c in attached) for name, attached in context.channels.items()}

    def results(self, t_ns: IntArray, values: FloatArray) -> list[Result]:
        """Return rows of the result vector as single results."""
        answers: list[Result] = []
        for when, row in zip(t_ns.tolist(), values, strict=True):
            first = 0
            for output in self.outputs:
                part = row[first : first + len(output.columns)]
                first += len(output.columns)
                if not (np.isnan(part[0]) if output.event else np.isnan(part).all()):
                    answers.append(Result(output.name, when, tuple(part.tolist())))
        return answers

    def finish(self) -> Iterable[Result] | None:
        """Return the results still held back."""
        t_ns, values = self.held()
        return self.results(t_ns, values)

    def held(self) -> tuple[IntArray, FloatArray]:
        """Return times (n,) and result vectors (n, width) still held back."""
        t_ns, values = np.zeros(self.max_held, np.int64), np.full((self.max_held, self.width), np.nan)
        count = (
            int(self.run_end(self.state, t_ns, values)) if self.run_end is not None and self.max_held else 0
        )
        return t_ns[:count], values[:count]

    def snapshot(self) -> Any:
        """Return a copy of the packed state."""
        return self.state.copy()

    def restore(self, snapshot: Any) -> None:
        """Go back to the state of ``snapshot``."""
        self.state[:] = snapshot


class RowEstimator(PlainEstimator):
    """Base of estimators that take one row of numbers a sample of their first input.

    The row
        ``[dt_s, <columns of the first input>, <columns of every further input>]`` as float64. ``dt_s`` is the
        time since the previous row, 0 for the first. Columns of the first input are always finite. Columns of
        a further input carry its newest message that arrived since the previous row, NaN where none arrived:
        a sampled view, causal, never interpolated. Messages that were overtaken by a newer one are counted.

    The result
        one float64 vector in the order of ``outputs`` (all columns of all outputs, one after another), or None
        where there is nothing to say yet. With ``latency`` L, the result of call k speaks of row k − L; the
        first L calls return None, and ``flush`` returns the last L results. A column that has no value is NaN.
        An offline one has ``process(rows) -> results`` instead, called once with all rows.
    """

    def step(self, row: FloatArray) -> FloatArray | None:
        """Take one row, return one result or None."""
        raise NotImplementedError

    def flush(self) -> FloatArray:
        """Return the results of the last ``latency`` rows, shape (≤ latency, columns)."""
        return np.empty((0, len(output_columns(self))))


class RowKernel(RowEstimator):
    """Base of row estimators whose step is a compiled kernel over one packed state.

    A subclass sets ``kernel(state, row, out) -> bool`` and ``run(state, rows, out) -> int``, both module-level
    compiled functions of its module wrapped in ``staticmethod``, and ``flush_kernel(state, out) -> int`` where
    ``latency`` is not 0, and builds ``self.state`` in ``__init__``. ``kernel`` returns whether ``out`` was
    filled; ``run`` fills ``out[i]`` from ``rows[i]`` (a row without a result is NaN throughout) and returns the
    number of results. Both give equal bits.
    """

    kernel: ClassVar[Callable[..., Any]]
    run: ClassVar[Callable[..., Any]]
    flush_kernel: ClassVar[Callable[..., Any] | None] = None
    state: NDArray[Any]

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

    def snapshot(self) -> Any:
        """Return a copy of the packed state."""
        return self.state.copy()

    def restore(self, snapshot: Any) -> None:
        """Go back to the state of ``snapshot``."""
        self.state[:] = snapshot


TIMES = ("t_ns", "t_log_ns")
"""Columns of every table that are no values."""


def input_columns(estimator: Any) -> tuple[str, ...]:
    """Return the names of a row's entries: ``dt_s`` and every input's columns."""
    return ("dt_s", *(c for i in estimator.inputs for c in i.columns))


def output_columns(estimator: Any) -> tuple[str, ...]:
    """Return the names of a result vector's entries, ``<output>.<column>``."""
    return tuple(f"{o.name}.{c}" for o in estimator.outputs for c in o.columns)
