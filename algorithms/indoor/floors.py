"""``indoor.floors``: on which floor a receiver is, from the change of air pressure since a known floor."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Annotated, ClassVar

import msgspec

from ..contract import Annotate, Context, Input, Message, Output, PlainEstimator, Remark, Result
from ..parameters import meta

SCALE_M = 8434.5
"""Height over which the pressure of a standard atmosphere at 15 °C falls by e: R T / (M g)."""


class FloorParams(msgspec.Struct, frozen=True, kw_only=True):
    """Parameters of the floors."""

    storey_m: Annotated[float, meta("height of a storey", "m", "", gt=0)] = 3.4
    start: Annotated[int, meta("floor at the start", "", "")] = 0
    smooth_s: Annotated[float, meta("time constant of the pressure's low pass", "s", "", gt=0)] = 2.0
    weather_s: Annotated[
        float,
        meta(
            "time constant with which the height drifts back to the floor: weather is no change of floor",
            "s",
            "",
            gt=0,
        ),
    ] = 300.0
    margin: Annotated[
        float,
        meta(
            "share of a storey beyond the middle between two floors before the answer changes",
            "1",
            "",
            ge=0,
            lt=0.5,
        ),
    ] = 0.15


class IndoorFloors(PlainEstimator):
    """Height over the start by the barometric formula, low-passed; the floor is the nearest one, with a margin.

    Each time the floor is held, the zero of the height drifts slowly to it, so that the weather of a day does not
    carry one to another floor.
    """

    name: ClassVar[str] = "indoor.floors"
    title: ClassVar[str] = "floor of a receiver from its barometer, and when it changes"
    source: ClassVar[str] = "hypsometric equation (US Standard Atmosphere 1976)"
    Params: ClassVar[type[msgspec.Struct]] = FloorParams
    inputs = (Input("pressure", "sensor_msgs/msg/FluidPressure", ("pressure_pa",), regular=True),)
    outputs = (
        Output("floor", "marcha_msgs/msg/NamedValues", ("floor", "height_m")),
        Output(
            "change",
            "marcha_msgs/msg/NamedValues",
            ("from", "to"),
            event=True,
            annotate=Annotate("floor", "instant", label="floor {to}"),
        ),
    )

    def start(self, context: Context) -> None:
        """Begin on the floor that is stated."""
        self.at = self.params.start
        self.zero = math.nan
        self.log_pressure = math.nan
        self.t_ns = 0
        self.changes = 0

    def take(self, message: Message) -> Iterable[Result]:
        """Take one pressure."""
        p = self.params
        pressure = float(message.values[0])
        if pressure <= 0:
            return []
        now = math.log(pressure)
        dt = max(0.0, (message.t_ns - self.t_ns) * 1e-9)
        if math.isnan(self.log_pressure):
            self.log_pressure = self.zero = now
        else:
            self.log_pressure += (1.0 - math.exp(-dt / p.smooth_s)) * (now - self.log_pressure)
        self.t_ns = message.t_ns
        height = SCALE_M * (self.zero - self.log_pressure)
        off = height - (self.at - p.start) * p.storey_m
        results: list[Result] = []
        if abs(off) > (0.5 + p.margin) * p.storey_m:
            to = p.start + round(height / p.storey_m)
            results.append(Result("change", message.t_ns, (float(self.at), float(to))))
            self.at, self.changes = to, self.changes + 1
        elif abs(off) < (0.5 - p.margin) * p.storey_m:
            self.zero -= (1.0 - math.exp(-dt / p.weather_s)) * off / SCALE_M
        return [Result("floor", message.t_ns, (float(self.at), height)), *results]

    def remarks(self) -> list[Remark]:
        """Say that the storey's height is assumed, where floors changed."""
        if getattr(self, "changes", 0):
            detail = f"{self.changes} changes at {self.params.storey_m:g} m a storey; state storey_m where it differs"
            return [Remark("storey_height", detail)]
        return []
