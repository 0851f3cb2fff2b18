"""Single stages of a phone's track, to be recombined by name: attitude, length, heading, sum."""

from __future__ import annotations

import math
from typing import Annotated, Any, ClassVar, Literal

import msgspec
import numpy as np

from ..contract import Context, Input, KernelEstimator, Message, Output, PlainEstimator, Result
from ..numerics.compiled import compiled
from ..parameters import meta
from . import attitude, direction, lengths, ring, steps
from .lengths import LengthParams
from .pdr import GYR, MAG, POSE, SourceParams, calibrated_field, configure_attitude
from .steps import ACC

STEP_COLUMNS = ("start_ns", "end_ns", "index", "length_m", "height_m", "heading_rad")
STEPS = Output("step", "marcha_msgs/msg/Step", STEP_COLUMNS, event=True)
ATTITUDE = Output(
    "attitude", "geometry_msgs/msg/QuaternionStamped", ("quat_w", "quat_x", "quat_y", "quat_z"), frame="nav"
)


def step_input(stage: str) -> Input:
    """Return the input of steps, served by ``stage`` where nothing else is named."""
    return Input("step", "marcha_msgs/msg/Step", STEP_COLUMNS, stage=stage)


class AttitudeParams(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Time constants of the attitude."""

    rate_hz: Annotated[
        float, meta("Rate of the accelerometer; 0: the measured one, or 50", "Hz", ge=0.0, le=2000.0)
    ] = 0.0
    tau_acc_s: Annotated[float, meta("Time constant of the inclination", "s", "VQF: 3", gt=0.1)] = 3.0
    tau_mag_s: Annotated[float, meta("Time constant of the heading by the field", "s", "VQF: 9", gt=0.1)] = (
        9.0
    )
    rest_deg_s: Annotated[
        float, meta("Greatest change of the rate at rest", "deg/s", "VQF: 2", gt=0.0, le=10.0)
    ] = 0.5
    declination_deg: Annotated[float, meta("Magnetic declination, east positive", "deg")] = 0.0


_ATTITUDE_FIELDS = [*attitude.FIELDS, ("declination", "f8")]


@compiled
def _run_attitude(
    state: Any, inputs: Any, channels: Any, t_ns: Any, values: Any, out_message: Any, out_t_ns: Any, out: Any
) -> int:
    s, count = state[0], 0
    for i in range(t_ns.shape[0]):
        x, y, z = values[i, 0], values[i, 1], values[i, 2]
        if inputs[i] == 0:
            attitude.take_gyr(s, t_ns[i], x, y, z)
        elif inputs[i] == 2:
            attitude.take_mag(s, t_ns[i], x, y, z)
        else:
            attitude.take_acc(s, x, y, z)
            a, b, c, d = attitude.quat6(s)
            turn = 0.5 * (s.delta - (s.declination if s.mag_n > 0 else 0.0))
            e, f = math.cos(turn), math.sin(turn)
            out_message[count], out_t_ns[count] = i, t_ns[i]
            out[count, 0], out[count, 1] = e * a - f * d, e * b - f * c
            out[count, 2], out[count, 3] = e * c + f * b, e * d + f * a
            for j in range(3):
                out[count, 4 + j] = s.bias[j]
            out[count, 7], out[count, 8] = s.disturbed, s.mag_norm if s.mag_n > 0 else np.nan
            count += 1
    return count


class PhoneAttitude(KernelEstimator):
    """Attitude by VQF's equations, each sensor at its own times; see :mod:`.attitude`."""

    name: ClassVar[str] = "phone.attitude"
    title: ClassVar[str] = "attitude, gyroscope bias, magnetic disturbance"
    source: ClassVar[str] = "Laidig and Seel 2023 (VQF)"
    Params = AttitudeParams
    inputs = (GYR, ACC, MAG)
    outputs = (
        ATTITUDE,
        Output(
            "state",
            "marcha_msgs/msg/NamedValues",
            ("bias_x_rad_s", "bias_y_rad_s", "bias_z_rad_s", "disturbed", "field_t"),
        ),
    )
    run = staticmethod(_run_attitude)

    def __init__(self, params: msgspec.Struct | None = None) -> None:
        super().__init__(params)
        self.state = np.zeros(1, np.dtype(_ATTITUDE_FIELDS))

    def start(self, context: Context) -> None:
        """Set the filter's constants by the measured rate; take the magnetometer's calibration."""
        super().start(context)
        p, s = self.params, self.state[0]
        self.state[:] = np.zeros(1, self.state.dtype)
        rate = p.rate_hz or context.rate_hz("acc") or 50.0
        if context.has("gyr"):
            attitude.configure(s, rate, tau_acc=p.tau_acc_s, tau_mag=p.tau_mag_s, rest_deg_s=p.rest_deg_s)
        else:
            attitude.without_gyroscope(s, rate)
        s["declination"] = math.radians(p.declination_deg)
        s["ref_norm"] = calibrated_field(context) or 0.0


class _OverSteps(PlainEstimator):
    """Base of stages that look at a step's own samples, kept in the ring until the step is known."""

    fields: ClassVar[list[tuple[Any, ...]]] = ring.FIELDS
    outputs = (STEPS,)

    def __init__(self, params: msgspec.Struct | None = None) -> None:
        super().__init__(params)
        self.state = np.zeros(1, np.dtype(self.fields))

    def start(self, context: Context) -> None:
        """Begin with an empty ring."""
        self.state[:] = np.zeros(1, self.state.dtype)

    def snapshot(self) -> Any:
        """Return a copy of the state."""
        return self.state.copy()

    def restore(self, snapshot: Any) -> None:
        """Go back to the state of ``snapshot``."""
        self.state[:] = snapshot


# not steps.FIELDS first: a record that begins like another one makes the compiler warn
_LENGTH_FIELDS = [*lengths.FIELDS, *steps.FIELDS]


@compiled
def _push(s: Any, t_ns: int, x: float, y: float, z: float) -> None:
    ring.push(s, t_ns, math.sqrt(x * x + y * y + z * z))


@compiled
def _measure(s: Any, start_ns: int, end_ns: int) -> float:
    ring.features(s, start_ns, end_ns, s.gravity, s.features)
    return lengths.length_of(s, s.features)


class PhoneLength(_OverSteps):
    """Lengths of steps that another stage found, by any model of :mod:`.lengths`."""

    name: ClassVar[str] = "phone.length"
    title: ClassVar[str] = "lengths of steps by any model"
    source: ClassVar[str] = "phone dissertation, eqs 3.10–3.16"
    Params = LengthParams
    inputs = (ACC, step_input("phone.steps"))
    fields: ClassVar[list[tuple[Any, ...]]] = _LENGTH_FIELDS

    def start(self, context: Context) -> None:
        """Set the model."""
        super().start(context)
        lengths.configure(self.state[0], self.params)
        self.state[0]["gravity"] = self.params.gravity

    def take(self, message: Message) -> list[Result] | None:
        """Keep a sample, or measure a step."""
        if message.input == "acc":
            _push(self.state[0], message.t_ns, *message.values)
            return None
        start, end, index, _, height, heading = message.values
        length = _measure(self.state[0], start, end)
        return [Result("step", message.t_ns, (start, end, index, length, height, heading))]


_HEADING_FIELDS = [*attitude.FIELDS, *direction.FIELDS, *steps.FIELDS]


@compiled
def _carry(s: Any, role: int, t_ns: int, x: float, y: float, z: float) -> None:
    if role == 0:
        attitude.take_gyr(s, t_ns, x, y, z)
        direction.take_gyr(s, t_ns, z)
    elif role == 1:
        attitude.take_acc(s, x, y, z)
        i = ring.push(s, t_ns, math.sqrt(x * x + y * y + z * z))
        direction.describe(s, i, t_ns, x, y, z)
    else:
        s.raw_mag[0], s.raw_mag[1], s.raw_mag[2] = x, y, z
        attitude.take_mag(s, t_ns, x, y, z)


@compiled
def _head(s: Any, start_ns: int, end_ns: int) -> float:
    return direction.heading_of(s, start_ns, end_ns)


class HeadingParams(SourceParams, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Which heading; see ``phone.pdr``."""

    heading: Annotated[
        Literal["auto", "device", "walking", "magnetometer", "tilt-compensated", "gyroscope"],
        meta("Heading of a step, as of phone.pdr", source="phone dissertation, table 3.2"),
    ] = "auto"


class PhoneHeading(_OverSteps):
    """Headings of steps that another stage found; modes as of ``phone.pdr``."""

    name: ClassVar[str] = "phone.heading"
    title: ClassVar[str] = "walking direction of steps"
    source: ClassVar[str] = "phone dissertation, table 3.2; walking: Kourogi and Kurata 2014"
    Params = HeadingParams
    inputs = (ACC, GYR, MAG, step_input("phone.steps"))
    fields: ClassVar[list[tuple[Any, ...]]] = _HEADING_FIELDS

    def start(self, context: Context) -> None:
        """Set mode, time constants and calibration."""
        super().start(context)
        p, s = self.params, self.state[0]
        rate = p.rate_hz or context.rate_hz("acc") or 50.0
        s["has_mag"] = context.has("mag") and p.magnetometer != "off"
        configure_attitude(self.name, s, p, rate, context.has("gyr"))
        s["mode"] = direction.MODES.index(p.heading)
        s["declination"] = math.radians(p.declination_deg)
        s["median_w"] = min(64, max(1, round(p.median_s * (context.rate_hz("mag") or rate))))
        s["ref_norm"] = calibrated_field(context) or 0.0

    def take(self, message: Message) -> list[Result] | None:
        """Keep a sample, or find a step's heading."""
        if message.input != "step":
            role = {"gyr": 0, "acc": 1, "mag": 2}[message.input]
            _carry(self.state[0], role, message.t_ns, *message.values)
            return None
        start, end, index, length, height, _ = message.values
        heading = _head(self.state[0], start, end)
        return [Result("step", message.t_ns, (start, end, index, length, height, heading))]


class SumParams(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """None."""


class PhoneSum(PlainEstimator):
    """Position by eq 3.20 from steps that have length and heading: the last stage of a chain."""

    name: ClassVar[str] = "phone.track"
    title: ClassVar[str] = "sum of steps with length and heading"
    source: ClassVar[str] = "phone dissertation, eq 3.20"
    Params = SumParams
    inputs = (step_input("phone.pdr"),)
    outputs = (POSE,)

    def __init__(self, params: msgspec.Struct | None = None) -> None:
        super().__init__(params)
        self.place = [0.0, 0.0, 0.0]

    def take(self, message: Message) -> list[Result] | None:
        """Add a step; one without a length or heading does not move."""
        _, _, _, length, height, heading = message.values
        if length is None or heading is None or not (math.isfinite(length) and math.isfinite(heading)):
            return None
        self.place[0] += length * math.cos(heading)
        self.place[1] += length * math.sin(heading)
        self.place[2] += height if height is not None and math.isfinite(height) else 0.0
        quat = (math.cos(heading / 2), 0.0, 0.0, math.sin(heading / 2))
        return [Result("pose", message.t_ns, (*self.place, *quat))]


__all__ = ["PhoneAttitude", "PhoneHeading", "PhoneLength", "PhoneSum"]
