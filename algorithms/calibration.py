"""What a calibration is: a look at recordings, once, that states values which later estimators are given."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

import msgspec
import numpy as np

from .contract import AlgorithmError, ChannelInfo, FloatArray, Input

if TYPE_CHECKING:
    import polars as pl


class Calibration(msgspec.Struct, kw_only=True, forbid_unknown_fields=True):
    """The result of a calibration, as it lies in its file (JSON) and in a recording's metadata.

    Attributes
    ----------
    kind : str
        Name of the calibration that made it: ``imu``, ``magnetometer``, ``radio``, ``joint``.
    version : str
        Distribution and version that it comes from.
    subject : str
        What it is for: the topic of a channel, or a device, segment or anchor set.
    values : dict
        Numbers, or nested lists and dicts of numbers and texts, by name with unit (``gyr_bias_x_rad_s`` …).
    covariance : dict of str to list of list of float
        Covariance of a group of values, where it can be stated.
    computed_from : list of dict of str to str
        Per stretch: ``recording``, ``blake2b``, ``start_ns``, ``end_ns``.
    params : dict
        Parameters of the calibration.
    remarks : list of str
        What the user must know.
    usable : bool
        False where the data could not determine it ("not observable"); such a one is never applied.
    """

    kind: str
    version: str = ""
    subject: str = ""
    values: dict[str, Any] = {}
    covariance: dict[str, list[list[float]]] = {}
    computed_from: list[dict[str, str]] = []
    params: dict[str, Any] = {}
    remarks: list[str] = []
    usable: bool = True

    def array(self, name: str) -> FloatArray:
        """Return a value as an array of floats; AlgorithmError where it is not there."""
        if name not in self.values:
            raise AlgorithmError(
                f"calibration {self.kind}: no value {name!r}; it has {', '.join(self.values)}"
            )
        return np.asarray(self.values[name], dtype=np.float64)


@dataclass(frozen=True)
class Stretch:
    """Part of a recording that a calibration looks at.

    Attributes
    ----------
    channels : mapping of str to tuple of ChannelInfo
        Attached channels by input name.
    tables : mapping of str to tuple of polars.DataFrame
        Their messages (``t_ns``, ``t_log_ns``, columns) in the same order.
    metadata : mapping of str to mapping of str to str
        Metadata records of the recording.
    attachments : mapping of str to bytes
        By name.
    label : str
        File name, with the label of the interval where it is one.
    """

    channels: Mapping[str, tuple[ChannelInfo, ...]]
    tables: Mapping[str, tuple[pl.DataFrame, ...]]
    metadata: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    attachments: Mapping[str, bytes] = field(default_factory=dict)
    label: str = ""


class Calibrator:
    """Base of a calibration: subclass it, set the class attributes, write ``calibrate``.

    Attributes
    ----------
    name, title, source : str
        As of an estimator.
    inputs : tuple of Input
        Channels that it reads; attached as those of estimators are.
    Params : type of msgspec.Struct
        Parameters.
    """

    name: ClassVar[str] = ""
    title: ClassVar[str] = ""
    source: ClassVar[str] = ""
    Params: ClassVar[type[msgspec.Struct]] = msgspec.defstruct("NoParams", [], frozen=True)
    inputs: tuple[Input, ...] = ()

    def __init__(self, params: msgspec.Struct | None = None) -> None:
        self.params: Any = params if params is not None else self.Params()

    def calibrate(self, stretches: Sequence[Stretch]) -> Calibration:
        """Return what the stretches say. AlgorithmError where they cannot be used at all."""
        raise NotImplementedError
