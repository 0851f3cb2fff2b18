"""``indoor.pdr``: the source's dead reckoning, steps of one length along the phone's azimuth."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Iterable
from typing import Annotated, Any, ClassVar, Literal

import msgspec
import numpy as np

from ..contract import AlgorithmError, Context, Input, Message, Output, PlainEstimator, Remark, Result
from ..parameters import meta
from .steps import azimuth_of, compass, make_state, plan_heading, take_acceleration

SOURCE = "hybrid indoor positioning"
IMU = Input("imu", "sensor_msgs/msg/Imu", ("acc_x", "acc_y", "acc_z"), regular=True)
ORIENTATION = Input(
    "orientation",
    "geometry_msgs/msg/QuaternionStamped",
    ("quat_w", "quat_x", "quat_y", "quat_z"),
    optional=True,
)
MAG = Input("mag", "sensor_msgs/msg/MagneticField", ("mag_x", "mag_y", "mag_z"), optional=True)
STEP_COLUMNS = ("start_ns", "end_ns", "index", "length_m", "height_m", "heading_rad")
STEP = Output("step", "marcha_msgs/msg/Step", STEP_COLUMNS, event=True, frame="plan")
POSE = Output(
    "pose",
    "geometry_msgs/msg/PoseStamped",
    ("pos_x", "pos_y", "pos_z", "quat_w", "quat_x", "quat_y", "quat_z"),
    frame="plan",
)
FROM_START = "plan-axes"
"""Frame of a track that has the plan's axes and its origin where it starts."""


class IndoorStepParams(msgspec.Struct, frozen=True, kw_only=True):
    """Parameters of the source's steps and headings."""

    threshold: Annotated[
        float, meta("linear acceleration to pass up and down", "m/s²", f"{SOURCE}, table 4.2", gt=0)
    ] = 0.55
    least_s: Annotated[
        float, meta("shortest time between both passages", "s", f"{SOURCE}, section 4.5.1", ge=0)
    ] = 0.15
    most_s: Annotated[
        float, meta("longest time between both passages", "s", f"{SOURCE}, section 4.5.1", gt=0)
    ] = 0.4
    gravity_s: Annotated[
        float, meta("time constant of gravity's low pass (0.8 at 50 Hz)", "s", f"{SOURCE}, eq 3.26", gt=0)
    ] = 0.08
    vertical: Annotated[
        Literal["z", "gravity"], meta("vertical: the phone's z (held level), or along gravity", "", SOURCE)
    ] = "z"
    step_m: Annotated[float, meta("length of a step", "m", SOURCE, gt=0)] = 0.70
    x_axis_azimuth_deg: Annotated[
        float,
        meta("azimuth of the plan's x axis, clockwise from north; 0: as the plan states", "deg", SOURCE),
    ] = 0.0
    known_start: Annotated[bool, meta("start at start_x, start_y of the plan", "")] = False
    start_x: Annotated[float, meta("start in the plan", "m", "")] = 0.0
    start_y: Annotated[float, meta("start in the plan", "m", "")] = 0.0


def plan_frame(context: Context, x_axis_azimuth_deg: float) -> tuple[float, bool, bool]:
    """Return the azimuth of the plan's x axis (rad), whether the plan is mirrored, and whether north is stated."""
    for name in ("plan.geojson", "plan.json"):
        if name in context.attachments:
            try:
                plan = json.loads(context.attachments[name])
            except ValueError as error:
                raise AlgorithmError(f"attachment {name}: not JSON: {error}") from None
            stated = plan.get("x_axis_azimuth_deg")
            if stated is not None or "handedness" in plan:
                azimuth = float(stated if stated is not None else x_axis_azimuth_deg)
                return math.radians(azimuth), plan.get("handedness") == "left", stated is not None
    stated = context.metadata.get("plan", {}).get("x_axis_azimuth_deg")
    azimuth = float(stated) if stated is not None and x_axis_azimuth_deg == 0 else x_axis_azimuth_deg
    mirrored = context.metadata.get("plan", {}).get("handedness") == "left"
    return math.radians(azimuth), mirrored, stated is not None or x_axis_azimuth_deg != 0


class SourceSteps:
    """The step detector with a heading beside it, one message at a time."""

    def __init__(self, params: Any, context: Context) -> None:
        self.params = params
        self.state = make_state(
            threshold=params.threshold,
            least_s=params.least_s,
            most_s=params.most_s,
            gravity_s=params.gravity_s,
            along_gravity=params.vertical == "gravity",
        )
        self.x_axis, self.mirrored, self.north = plan_frame(context, params.x_axis_azimuth_deg)
        self.oriented = context.has("orientation")
        self.previous_ns = -1
        self.unknown = 0

    def take(self, message: Message) -> tuple[int, int, int, float, float] | None:
        """Return (start, end, index, length, heading in the plan) where a step ends with this message."""
        s = self.state[0]
        if message.input == "orientation":
            s["azimuth"] = azimuth_of(*(float(v) for v in message.values))
        elif message.input == "mag" and not self.oriented and s["t_ns"] >= 0:
            s["azimuth"] = compass(np.array(message.values, dtype=np.float64), s["grav"].copy())
        elif message.input == "imu" and take_acceleration(
            s, message.t_ns, *(float(v) for v in message.values)
        ):
            azimuth = float(s["azimuth"])
            if math.isnan(azimuth):
                self.unknown += 1
                return None
            start = (
                self.previous_ns if self.previous_ns >= 0 else message.t_ns - round(self.params.most_s * 1e9)
            )
            self.previous_ns = message.t_ns
            s["index"] += 1
            heading = plan_heading(azimuth, self.x_axis, self.mirrored)
            return (
                max(start, message.t_ns - 2_000_000_000),
                message.t_ns,
                int(s["index"]) - 1,
                self.params.step_m,
                heading,
            )
        return None

    def remarks(self) -> list[Remark]:
        """Say what a user must know of steps and headings."""
        remarks = []
        if not self.north:
            remarks.append(
                Remark(
                    "plan_north",
                    "the plan does not say where north is: its x axis is taken to point north; state "
                    "x_axis_azimuth_deg",
                )
            )
        if self.unknown:
            remarks.append(
                Remark(
                    "no_heading",
                    f"{self.unknown} steps before any orientation or magnetic field: left out",
                    self.state[0]["index"] == 0,
                )
            )
        return remarks


class IndoorPdr(PlainEstimator):
    """Steps from vertical acceleration, one length, heading from the phone's azimuth."""

    name: ClassVar[str] = "indoor.pdr"
    title: ClassVar[str] = "the source's dead reckoning: threshold steps of 0.7 m along the azimuth"
    source: ClassVar[str] = "hybrid indoor positioning, sections 3.4 and 4.5, eqs 3.22–3.26"
    Params: ClassVar[type[msgspec.Struct]] = IndoorStepParams
    inputs = (IMU, ORIENTATION, MAG)
    outputs = (POSE, STEP)

    def start(self, context: Context) -> None:
        """Read the plan's frame."""
        if not context.has("orientation") and not context.has("mag"):
            raise AlgorithmError(
                f"{self.name} needs an orientation or a magnetometer beside the accelerometer for its heading"
            )
        self.steps = SourceSteps(self.params, context)
        self.x, self.y = self.params.start_x, self.params.start_y
        if not self.params.known_start:
            self.outputs = (dataclasses.replace(POSE, frame=FROM_START), STEP)

    def take(self, message: Message) -> Iterable[Result]:
        """Take one message; answer at the end of a step."""
        step = self.steps.take(message)
        if step is None:
            return ()
        start, end, index, length, heading = step
        self.x += length * math.cos(heading)
        self.y += length * math.sin(heading)
        half = heading / 2.0
        return (
            Result("pose", end, (self.x, self.y, 0.0, math.cos(half), 0.0, 0.0, math.sin(half))),
            Result("step", end, (start, end, index, length, 0.0, heading)),
        )

    def remarks(self) -> list[Remark]:
        """Say what a user must know of the run."""
        return self.steps.remarks()
