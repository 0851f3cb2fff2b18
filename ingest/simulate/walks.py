"""A walk as arrays: scenario, seed and options to truth, ideal readings and measured readings."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Annotated, Any, Literal, TypeVar

import msgspec
import numpy as np
import polars as pl
from numpy.typing import NDArray

from ...recording.errors import UsageError
from ...recording.options import options_of
from ..checks import STANDARD_GRAVITY
from .gait import (
    FloatArray,
    GaitModel,
    Motion,
    Mount,
    Style,
)
from .scenarios import SCENARIOS, Route, route
from .sensors import (
    IDEAL,
    MPU6050_1,
    MPU6050_2,
    UNKIND,
    ImuErrors,
    SimulatedImu,
)

T = TypeVar("T", bound=msgspec.Struct)

BLOCK = 1 << 16
"""Samples that are made at a time: bounds memory."""

_Positive = Annotated[float, msgspec.Meta(gt=0)]
_NonNegative = Annotated[float, msgspec.Meta(ge=0)]
_Share = Annotated[float, msgspec.Meta(ge=0, le=1)]


class Options(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Everything that can be chosen about a simulated recording, beside scenario and seed.

    Fields of ``style`` may be given directly (``stance_roll_deg=5``); fields of :class:`ImuErrors` too:
    they hold for both sensors (``gyr_noise=0``) or, with a dot, for one (``imu1.gyr_noise=0``,
    ``mount2.pitch_deg=20``).

    Attributes
    ----------
    laps : int or None
        Rounds of the route (default 1); or give ``duration_s``.
    duration_s : float or None
        Least length of the recording (s): as many whole rounds as fill it. For ``still`` the length
        (default 30).
    length_m : float or None
        Length of one round (m), footfall to footfall; default by scenario.
    aspect : float
        Long side of the rectangle by its short side.
    clockwise : bool
        Sense of the turns, seen from above.
    direction : str
        Stairs: ``up``, ``down`` or ``up-down``.
    stair_steps, tread_m, riser_m
        Stairs: steps of a flight, their depth and height (m). The foot takes two at a stride.
    stride_m, stride_s : float
        Mean length (m) and time (s) of a stride.
    stride_sd : float
        Relative standard deviation of both.
    rest_s : float
        Rest at the start and at the end (s).
    gravity : float
        Local gravity (m/s²).
    rate_hz : float
        Nominal sample rate.
    config : str
        Full-scale codes ``A1 G1 A2 G2`` of the device, as its file names say them.
    start_ms : int
        The device's ``millis()`` at the first sample; near 2³² it rolls over in the course of the walk.
    late_share, late_max_ms
        Share of the intervals that are late, and by how much at most (ms, at least 1).
    drop_share, duplicate_share : float
        Share of the rows that are lost, and that are written twice.
    style : Style
        How the foot moves.
    errors : str
        ``mpu6050``: the errors of the real device where none are given; ``unkind``: with what wear, strap and missing
        calibration add, and a foot whose arch gives; ``none``: no error at all.
    gait : str
        ``walk``, ``fast`` or ``run``: stride, its time and the share of it that the foot stands, where they are not
        given.
    slope : float
        Ramp: rise over run.
    ride_m, ride_s : float
        Lift: climb of a ride (m) and its time (s).
    imu1, imu2 : ImuErrors or None
        Errors of the sensors.
    mount1, mount2 : Mount
        Where they sit in the box. Sensor 1 is the box's origin: its truth is the route itself.
    """

    laps: Annotated[int, msgspec.Meta(ge=1)] | None = None
    duration_s: _Positive | None = None
    length_m: _Positive | None = None
    aspect: _Positive = 1.5
    clockwise: bool = True
    direction: Literal["up", "down", "up-down"] = "up-down"
    stair_steps: Annotated[int, msgspec.Meta(ge=1)] = 12
    tread_m: _Positive = 0.29
    riser_m: _Positive = 0.17
    stride_m: _Positive = 1.38
    stride_s: Annotated[float, msgspec.Meta(ge=0.4)] = 1.4
    stride_sd: Annotated[float, msgspec.Meta(ge=0, le=0.2)] = 0.03
    rest_s: _NonNegative = 3.0
    gravity: _Positive = 9.81
    rate_hz: Annotated[float, msgspec.Meta(gt=0, le=1000)] = 100.0
    config: Annotated[str, msgspec.Meta(pattern=r"^[0-3]{4}$")] = "3333"
    start_ms: Annotated[int, msgspec.Meta(ge=0, lt=2**32)] = 126_769
    late_share: _Share = 0.0015
    late_max_ms: Annotated[int, msgspec.Meta(ge=1)] = 14
    drop_share: Annotated[float, msgspec.Meta(ge=0, le=0.5)] = 0.0
    duplicate_share: Annotated[float, msgspec.Meta(ge=0, le=0.5)] = 0.0
    style: Style = Style()
    errors: Literal["mpu6050", "unkind", "none"] = "mpu6050"
    gait: Literal["walk", "fast", "run"] = "walk"
    slope: Annotated[float, msgspec.Meta(gt=0, le=0.5)] = 0.08
    ride_m: _Positive = 3.0
    ride_s: _Positive = 8.0
    imu1: ImuErrors | None = None
    imu2: ImuErrors | None = None
    mount1: Mount = Mount(roll_deg=6.9, pitch_deg=24.1)
    mount2: Mount = Mount(roll_deg=7.2, pitch_deg=32.7, lever_m=(0.0, 0.02, 0.0))

    def imu(self, sensor: int) -> ImuErrors:
        """Return the errors of sensor 1 or 2."""
        errors = (self.imu1, self.imu2)[sensor - 1]
        return errors if errors is not None else self._defaults(sensor)

    def mount(self, sensor: int) -> Mount:
        """Return where sensor 1 or 2 sits."""
        return (self.mount1, self.mount2)[sensor - 1]

    def full_scale(self, sensor: int) -> tuple[float, float]:
        """Return one count of the accelerometer (m/s²) and of the gyroscope (rad/s) of sensor 1 or 2."""
        acc, gyr = (int(c) for c in self.config[2 * sensor - 2 : 2 * sensor])
        return 2**acc / 16384 * STANDARD_GRAVITY, float(np.radians(1 / (131.0, 65.5, 32.8, 16.4)[gyr]))

    def _defaults(self, sensor: int) -> ImuErrors:
        if self.errors == "none":
            return IDEAL
        device = (MPU6050_1, MPU6050_2)[sensor - 1]
        return msgspec.structs.replace(device, **UNKIND) if self.errors == "unkind" else device


GAITS: dict[str, dict[str, float]] = {
    "walk": {},
    "fast": {"stride_m": 1.75, "stride_s": 0.95, "stance_share": 0.25},
    "run": {"stride_m": 2.3, "stride_s": 0.75, "stance_share": 0.14},
}
"""Strides of the gaits; a run's foot stands for a tenth of a second."""
UNKIND_STYLE = {"strike_mm": 0.5, "arch_mm": 5.3}
"""A foot that strikes, and whose arch gives. It does not roll about its ball: real ones do so farther back."""


def make_options(scenario: str, overrides: dict[str, Any]) -> Options:
    """Return checked options from keywords, values as objects or as text.

    Raises
    ------
    UsageError
        Unknown scenario or option, or a value that breaks its rule.
    """
    if scenario not in SCENARIOS:
        raise UsageError(f"scenario {scenario!r} is unknown: choose one of {', '.join(SCENARIOS)}")
    flat: dict[str, Any] = {}
    parts: dict[str, dict[str, Any]] = {"style": {}, "imu1": {}, "imu2": {}, "mount1": {}, "mount2": {}}
    for name, raw in overrides.items():
        head, _, tail = name.partition(".")
        value = plain(raw)
        if tail and head in parts:
            parts[head][tail] = value
        elif name in parts:
            parts[name].update(value)
        elif name in Style.__struct_fields__:
            parts["style"][name] = value
        elif name in ImuErrors.__struct_fields__:
            for imu in ("imu1", "imu2"):
                parts[imu].setdefault(name, value)
        else:
            flat[name] = value
    for name, value in GAITS.get(str(flat.get("gait", "walk")), {}).items():
        part = parts["style"] if name in Style.__struct_fields__ else flat
        part.setdefault(name, value)
    if flat.get("errors") == "unkind":
        parts["style"] = UNKIND_STYLE | parts["style"]
    options = checked(scenario, Options, flat)
    changed: dict[str, Any] = {}
    for name, values in parts.items():
        if values:
            old = options.imu(int(name[-1])) if name.startswith("imu") else getattr(options, name)
            changed[name] = checked(scenario, type(old), msgspec.to_builtins(old) | values, f"{name}.")
    if options.laps is not None and options.duration_s is not None:
        raise UsageError(f"simulate {scenario}: laps and duration_s exclude each other: give one of them")
    return msgspec.structs.replace(options, **changed)


def checked(scenario: str, kind: type[T], values: dict[str, Any], prefix: str = "") -> T:
    """Return ``values`` as a structure; text is converted.

    Raises
    ------
    UsageError
        A field is unknown, or a value breaks its rule.
    """
    more = "" if prefix else ", and the fields of style and errors (docs/formats.md)"
    return options_of(kind, values, f"simulate {scenario}", prefix=prefix, more=more)


def plain(value: Any) -> Any:
    """Return a structure or NumPy value as built-in types, and "0.1,0,0" as a list."""
    if isinstance(value, str):
        return value.split(",") if "," in value else value
    return msgspec.to_builtins(value, enc_hook=lambda v: v.tolist())


@dataclass(frozen=True)
class Walk:
    """One sensor of one simulated walk.

    Attributes
    ----------
    t_ns : ndarray
        Device clock (ns) of every sample, int64, shape (n,); never rolls over.
    t : ndarray
        Time since the first sample (s).
    pos, vel : ndarray
        True position (m) and velocity (m/s) in n: z up, x along the first stride, origin at sensor 1's start.
    quat_wxyz : ndarray
        True attitude ``rot_nb``, shape (n, 4).
    acc_b, gyr_b : ndarray
        Ideal specific force (m/s²) and angular rate (rad/s) in the sensor frame.
    still : ndarray
        Whether the foot stands, bool.
    steps : polars.DataFrame
        One row a swing: ``start_ns``, ``end_ns``, ``index``, ``length_m`` (horizontal), ``height_m``,
        ``heading_rad``.
    closed : bool
        Whether the walk ends where it began.
    length_m : float
        Horizontal length from footfall to footfall (m).
    simulation : Simulation
        Where it came from.
    sensor : int
        1 or 2.
    """

    t_ns: NDArray[np.int64]
    t: FloatArray
    pos: FloatArray
    vel: FloatArray
    quat_wxyz: FloatArray
    acc_b: FloatArray
    gyr_b: FloatArray
    still: NDArray[np.bool_]
    steps: pl.DataFrame
    closed: bool
    length_m: float
    simulation: Simulation
    sensor: int

    def measured(self, errors: ImuErrors | None = None) -> tuple[FloatArray, FloatArray]:
        """Return what the sensor reports: acceleration (m/s²) and angular rate (rad/s), each (n, 3).

        Without ``errors`` those of the options: the values that :func:`marcha.ingest.simulate.simulate`
        writes.
        """
        imu = self.simulation.imu(self.sensor, errors)
        parts = [
            imu.read(self.acc_b[i : i + BLOCK], self.gyr_b[i : i + BLOCK])
            for i in range(0, len(self.t), BLOCK)
        ]
        reading = np.concatenate(parts)
        return reading[:, :3], reading[:, 3:]


@dataclass(frozen=True)
class Simulation:
    """One walk of the device: the route, the foot, the clock, the sensors; made block by block."""

    scenario: str
    seed: int
    options: Options

    @cached_property
    def route(self) -> Route:
        """Footfalls and times of the strides."""
        return route(self.scenario, self.options, self._rng("route"))

    @cached_property
    def gait(self) -> GaitModel:
        """The foot's motion."""
        o = self.options
        rest = o.rest_s
        if self.scenario == "still":
            rest = (o.duration_s or 30.0) / 2
        walked = self.route
        return GaitModel(walked.footfalls, walked.durations, rest, o.gravity, o.style, walked.rides, o.ride_s)

    @property
    def length_m(self) -> float:
        """Horizontal length from footfall to footfall (m)."""
        return float(self.steps["length_m"].sum())

    @cached_property
    def steps(self) -> pl.DataFrame:
        """One row a swing, in the columns of ``marcha_msgs/msg/Step``."""
        feet, start = self.route.footfalls, self.options.start_ms * 1_000_000
        move = np.diff(feet[:, :3], axis=0)
        return pl.DataFrame(
            {
                "start_ns": start + np.round(self.gait.lift_s * 1e9).astype(np.int64),
                "end_ns": start + np.round(self.gait.land_s * 1e9).astype(np.int64),
                "index": np.arange(len(move)),
                "length_m": np.hypot(move[:, 0], move[:, 1]),
                "height_m": move[:, 2],
                "heading_rad": np.arctan2(move[:, 1], move[:, 0]),
            }
        )

    def times(self) -> Iterator[FloatArray]:
        """Yield the sample times (s since the start), at most ``BLOCK`` at a time."""
        o, rng = self.options, self._rng("clock")
        done, late_s = 0, 0.0
        while True:
            late = rng.random(BLOCK) < o.late_share
            extra = late * rng.integers(1, o.late_max_ms, BLOCK, endpoint=True) * 1e-3
            if not done:
                extra[0] = 0.0
            slip = late_s + np.cumsum(extra)
            t = np.arange(done, done + BLOCK) / o.rate_hz + slip
            done, late_s = done + BLOCK, slip[-1]
            t = t[: np.searchsorted(t, self.gait.end_s, side="right")]
            if len(t):
                yield t
            if len(t) < BLOCK:
                return

    def clock_ns(self, t: FloatArray) -> NDArray[np.int64]:
        """Return the device clock (ns, without roll-over) at the times ``t`` (s).

        Shapes: ``t`` and result (n,).
        """
        return self.options.start_ms * 1_000_000 + np.round(t * 1e9).astype(np.int64)

    def motion(self, t: FloatArray, sensor: int) -> Motion:
        """Return truth and ideal readings of sensor 1 or 2 at the times ``t`` (s).

        Shape of ``t``: (n,).
        """
        return self.gait.motion(t, self.options.mount(sensor))

    def imu(self, sensor: int, errors: ImuErrors | None = None) -> SimulatedImu:
        """Return sensor 1 or 2, at its first sample."""
        o = self.options
        rng = self._rng(f"imu{sensor}")
        acc_lsb, gyr_lsb = o.full_scale(sensor)
        return SimulatedImu(errors or o.imu(sensor), o.rate_hz, acc_lsb, gyr_lsb, rng)

    def line_rng(self) -> np.random.Generator:
        """Return the random numbers of the serial line: lost and doubled rows."""
        return self._rng("line")

    def _rng(self, part: str) -> np.random.Generator:
        """Return an own stream for a part, so that switching one error leaves all others as they are."""
        return np.random.default_rng([self.seed, *part.encode()])


def walk(scenario: str, *, seed: int = 0, sensor: Literal[1, 2] = 1, **options: Any) -> Walk:
    """Simulate a walk as arrays.

    Parameters
    ----------
    scenario : str
        A key of :data:`SCENARIOS`.
    seed : int
        Of all random numbers.
    sensor : int
        Which of the two sensors.
    **options
        Fields of :class:`Options`.

    Returns
    -------
    Walk
        Truth and ideal readings at the device's sample times.

    Raises
    ------
    UsageError
        Unknown scenario or option, or a value that breaks its rule.
    """
    simulation = Simulation(scenario, seed, make_options(scenario, options))
    blocks = [simulation.motion(t, sensor) for t in simulation.times()]
    whole = {f.name: np.concatenate([getattr(b, f.name) for b in blocks]) for f in fields(Motion)}
    return Walk(
        t_ns=simulation.clock_ns(whole["t"]),
        steps=simulation.steps,
        closed=simulation.route.closed,
        length_m=simulation.length_m,
        simulation=simulation,
        sensor=sensor,
        **whole,
    )
