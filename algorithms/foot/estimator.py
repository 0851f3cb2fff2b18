"""Base of the foot estimators: builds the state, names the outputs, drives the kernels."""

from __future__ import annotations

from typing import Any, ClassVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from ..contract import AlgorithmError, Annotate, FloatArray, Input, Output, Remark, RowKernel
from ..numerics.records import attributes, kernel_view
from . import ceiling, detectors
from .remarks import remarks
from .sample import SAMPLE

IMU = Input(
    "imu", "sensor_msgs/msg/Imu", ("acc_x", "acc_y", "acc_z", "gyr_x", "gyr_y", "gyr_z"), regular=True
)
SOURCE_RATE_HZ = 100.0
"""Sample rate of the source's device, for a bare ``make()``; a different measured rate is remarked."""

PUBLISHED: dict[str, Any] = {
    "detector": "c1c2c3",
    "init": "fixed",
    "rest_acc": 0.8,
    "rest_gyr": 0.3,
    "rest_bias_sigma": 0.0,
    "unclip": False,
}
"""The source's detector and its rest of a fixed length."""
ADAPTIVE: dict[str, Any] = {"detector": "gait", "init": "adaptive", "rest_acc": 0.5, "rest_gyr": 0.15}
"""A start for every walk and stances in every gait, without a threshold to set."""

POSE = Output(
    "pose",
    "geometry_msgs/msg/PoseStamped",
    ("pos_x", "pos_y", "pos_z", "quat_w", "quat_x", "quat_y", "quat_z"),
)
VELOCITY = Output("velocity", "geometry_msgs/msg/Vector3Stamped", ("vel_x", "vel_y", "vel_z"))
STANCE = Output(
    "stance",
    "marcha_msgs/msg/Stance",
    ("still",),
    frame="imu",
    annotate=Annotate("stance", "state", "still", "stance"),
)
STEP = Output(
    "step",
    "marcha_msgs/msg/Step",
    ("swing_s", "index", "length_m", "height_m", "heading_rad"),
    event=True,
    annotate=Annotate("step", "interval", label="step {index}"),
)
SIGMA = Output(
    "sigma",
    "marcha_msgs/msg/NavigationSigma",
    tuple(f"sigma_{what}_{axis}" for what in ("pos", "vel", "att") for axis in "xyz"),
)


class FootEstimator(RowKernel):
    """Base of the foot estimators.

    A subclass sets ``RECORD`` (the type of its state, :data:`.core.CORE` last), ``Params``, ``has_sigma``,
    the kernels ``kernel(state, ring, row, out)``, ``run(state, ring, rows, out)`` and ``flush_kernel(state,
    ring, out)``, and fills its own numbers in :meth:`configure`.

    ``state`` is one buffer of bytes that holds the record and the ring of the newest samples (their number
    depends on the detector's windows); ``record`` shows the record with its fields as attributes.
    """

    RECORD: ClassVar[np.dtype[Any]]
    has_sigma: ClassVar[bool] = True
    extra_inputs: ClassVar[tuple[Input, ...]] = ()
    presets: ClassVar[dict[str, dict[str, Any]]] = {
        "adaptive": ADAPTIVE,
        "published": PUBLISHED,
        "short-rest": PUBLISHED | {"init_s": 0.3},
        "live": PUBLISHED | {"window_side": "trailing", "cleaning": "median"},
        "shoe-tuned": {"detector": "shoe", "shoe_max": 1e5},
        "are-tuned": {"detector": "are", "are_max": 0.3},
        "mv-tuned": {"detector": "mv", "mv_max": 0.3, "window_s": 0.15},
        "mag-tuned": {"detector": "mag", "mag_max": 0.4, "window_s": 0.15},
    }
    state: NDArray[np.uint8]  # type: ignore[assignment]

    def __init__(self, params: msgspec.Struct | None = None) -> None:
        super().__init__(params)
        p: Any = self.params
        self.rate_hz: float = p.rate_hz or SOURCE_RATE_HZ
        self.inputs = (IMU, *self.extra_inputs)
        record: Any = attributes(np.zeros(1, self.RECORD))[0]
        try:
            held = detectors.configure(record.detector, p, self.rate_hz)
        except AlgorithmError as error:
            raise AlgorithmError(f"{self.name}: {error}") from None
        rest, steps = record.rest, record.steps
        rest.length, rest.acc_max, rest.gyr_max = p.init_s, p.rest_acc, p.rest_gyr
        rest.bias_max, rest.gravity, rest.gravity_from_rest = p.rest_bias_max, p.gravity, p.gravity_from_rest
        rest.adaptive, rest.shortest = p.init == "adaptive", min(p.init_min_s, p.init_s)
        rest.takes_bias = p.rest_bias
        rest.bias_prior = p.rest_bias_sigma**2
        rest.quietest = np.inf
        rest.index = -1
        steps.min_s, steps.min_m = p.step_min_s, p.step_min_m
        record.trapezoid = p.integration == "trapezoid"
        self.latency = int(record.detector.latency)
        self.outputs = (
            POSE,
            VELOCITY,
            STANCE,
            STEP,
            *((SIGMA,) if self.has_sigma else ()),
            Output(
                "detector",
                "marcha_msgs/msg/NamedValues",
                detectors.BY_NAME[p.detector].statistics,
                metadata=(("detector", p.detector), *detectors.limits(p)),
                frame="imu",
            ),
        )
        record.ceiling.on = p.unclip
        record.ceiling.edge = max(2, round(ceiling.EDGE_S * self.rate_hz))
        for axis in record.ceiling.axes:
            axis["pending"][0] = -1
        self.configure(record, p)
        ring = 1 << (held + 2).bit_length()
        self.state = np.zeros(self.RECORD.itemsize + ring * SAMPLE.itemsize, np.uint8)
        self.state[: self.RECORD.itemsize] = np.frombuffer(record.tobytes(), np.uint8)
        self._views = self.views(self.state)

    def configure(self, record: Any, params: Any) -> None:
        """Write the filter's own constants and initial values into the record of its state."""

    def views(self, state: NDArray[np.uint8]) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return a state, shape (bytes,), as a kernel takes it: an array of its one record, and the ring."""
        first = self.RECORD.itemsize
        count = (len(state) - first) // SAMPLE.itemsize
        return kernel_view(state, self.RECORD, 0), kernel_view(state, SAMPLE, first, count)

    @property
    def record(self) -> Any:
        """The record of the state, its fields as attributes; a view."""
        return attributes(self._views[0])[0]

    def step(self, row: FloatArray) -> FloatArray | None:
        """Take one row, return one result or None."""
        out = np.empty(self.width)
        state, ring = self._views
        return out if self.kernel(state, ring, row, out) else None

    def run_block(self, rows: FloatArray, out: FloatArray) -> int:
        """Take ``rows`` (n, inputs), fill ``out`` (n, outputs); rows without a result are NaN."""
        return int(self.run(*self._views, rows, out))

    def flush(self) -> FloatArray:
        """Return the results of the last ``latency`` rows, shape (≤ latency, columns)."""
        out = np.empty((self.latency, self.width))
        if self.flush_kernel is None or self.latency == 0:
            return out[:0]
        return out[: int(self.flush_kernel(*self._views, out))]

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name != "_views"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._views = self.views(self.state)

    def remarks(self) -> list[Remark]:
        """Return what the data did that the results' user must know."""
        return remarks(self.record, self.params, self.rate_hz, self.has_sigma)
