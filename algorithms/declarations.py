"""What an estimator declares and is given: inputs, outputs, messages, results, its context."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import polars as pl

    from .calibration import Calibration


FloatArray = NDArray[np.float64]


IntArray = NDArray[np.int64]


ALL_COLUMNS = ("*",)
"""As :attr:`Input.columns`: all columns that the attached channel has (joints or values with names)."""


@dataclass(frozen=True)
class Input:
    """One stream that an estimator reads.

    Attributes
    ----------
    name : str
        Role: ``imu``, ``thigh``, ``radio`` … ``--input name=topic`` attaches a channel to it.
    schema : str
        Message type of the channels that fit, for example ``sensor_msgs/msg/Imu``.
    columns : tuple of str
        Columns of that channel's table, in the order of a message's values; :data:`ALL_COLUMNS` for all.
    optional : bool
        Whether the estimator runs without it.
    many : bool
        Whether every channel that fits is attached, else one. Messages say which channel they come from.
    regular : bool
        Whether these are samples of a sensor at a steady rate. Messages that lack a finite value in a column, or
        whose time is not after that of the channel's message before, are then counted and not handed over, and
        the gap policy applies. Without it every message is handed over as it is.
    stage : str
        Name of the estimator that serves this input where neither the chain nor ``--input`` names another one.
    reference : bool
        Whether it reads a reference (``/reference/…``) instead of a raw channel: for calibrations.
    """

    name: str
    schema: str
    columns: tuple[str, ...]
    optional: bool = False
    many: bool = False
    regular: bool = False
    stage: str = ""
    reference: bool = False


@dataclass(frozen=True)
class Annotate:
    """How the rows of an output become annotations, in the tier ``<run>/<tier>``.

    Attributes
    ----------
    tier : str
        ``stance``, ``step``, ``turn`` …
    kind : {"state", "interval", "instant"}
        ``state``: stretches in which the boolean column ``column`` is true, first to last such row.
        ``interval``: a row is one, from its column ``start_ns`` to ``end_ns``. ``instant``: a row is one, at its
        time.
    column : str
        See ``state``.
    label : str
        Text of an annotation; ``{column}`` stands for a value of the row.
    """

    tier: str
    kind: Literal["state", "interval", "instant"]
    column: str = ""
    label: str = ""


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
        True where a result exists only now and then (a step). Of a kernel's result vector, rows whose first
        column is NaN are then not written; of other outputs those that are NaN throughout.
    metadata : tuple of (str, str)
        What the channel's metadata should say, for example thresholds of a detector's statistics.
    frame : str
        Frame of the values: ``nav``, or the name of an input for the frame of the channel attached to it.
    annotate : Annotate or None
        Where its rows should become annotations too.
    """

    name: str
    schema: str
    columns: tuple[str, ...]
    event: bool = False
    metadata: tuple[tuple[str, str], ...] = ()
    frame: str = "nav"
    annotate: Annotate | None = None


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


class Message(NamedTuple):
    """One message as an estimator sees it.

    Attributes
    ----------
    input : str
        Name of the input.
    t_ns : int
        Time that it speaks of.
    values : tuple
        In the order of the input's columns: floats, integers, texts, booleans.
    log_ns : int
        Time when it was known.
    channel : str
        Topic that it comes from.
    """

    input: str
    t_ns: int
    values: tuple[Any, ...]
    log_ns: int
    channel: str


class Result(NamedTuple):
    """One answer: output, time that it speaks of, values in the order of the output's columns."""

    output: str
    t_ns: int
    values: Sequence[Any]


@dataclass(frozen=True)
class ChannelInfo:
    """An attached channel.

    Attributes
    ----------
    topic, schema, frame_id : str
        As in the recording.
    columns : tuple of str
        The columns that arrive as a message's values.
    rate_hz : float
        Measured on its first samples, or declared by a live source; 0 where it is not known.
    metadata : mapping of str to str
        Of the channel.
    """

    topic: str
    schema: str
    frame_id: str = ""
    columns: tuple[str, ...] = ()
    rate_hz: float = 0.0
    metadata: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Context:
    """What an estimator may know before the first message.

    Attributes
    ----------
    channels : mapping of str to tuple of ChannelInfo
        By input name; empty for an optional input that is not there.
    metadata : mapping of str to mapping of str to str
        Metadata records of the recording by name.
    attachments : mapping of str to bytes
        By name, read when asked for.
    static : mapping of str to polars.DataFrame
        Static channels (frames) by topic.
    calibrations : mapping of str to Calibration
        By name of the calibration.
    """

    channels: Mapping[str, tuple[ChannelInfo, ...]] = field(default_factory=dict)
    metadata: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    attachments: Mapping[str, bytes] = field(default_factory=dict)
    static: Mapping[str, pl.DataFrame] = field(default_factory=dict)
    calibrations: Mapping[str, Calibration] = field(default_factory=dict)

    def has(self, name: str) -> bool:
        """Return whether a channel is attached to input ``name``."""
        return bool(self.channels.get(name))

    def rate_hz(self, name: str) -> float:
        """Return the rate of the first channel of input ``name`` in hertz, 0 where it is not known."""
        attached = self.channels.get(name)
        return attached[0].rate_hz if attached else 0.0
