"""A phone that is carried: what its sensors say, and the truth, as arrays.

:func:`phone_walk` gives accelerometer, gyroscope, magnetometer, barometer and GNSS of a walk with turns in
one of six placements, with the steps, headings, attitude and track that are true. Equal scenario, seed and
options give equal numbers; every error has its own stream of random numbers, so that switching one off leaves
the others as they are.

Frames: n is local level, x east, y **true** north, z up, origin on the ground at the start. b is the phone in
Android's axes (x right, y to its top, z out of the screen): at rest, screen up, the accelerometer reads +1 g
on z.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
import polars as pl
from numpy.typing import NDArray

from ...recording.errors import UsageError
from .gait import FloatArray
from .phone_motion import PLACEMENTS, Phone, Walker
from .phone_routes import PHONE_ROUTES, PhoneRoute, read_legs, schedule
from .phone_world import earth_field, fixes_of, magnetic_disturbance, pressure_of
from .sensors import IDEAL, ImuErrors, SimulatedImu
from .walks import checked

_Positive = Annotated[float, msgspec.Meta(gt=0)]
_NonNegative = Annotated[float, msgspec.Meta(ge=0)]
Vector = tuple[float, float, float]
Interval = tuple[float, float]

PHONE_ERRORS = ImuErrors(
    acc_bias_sigma=0.06,
    gyr_bias_sigma=0.004,
    acc_bias_walk=2e-4,
    gyr_bias_walk=2e-5,
    acc_noise=2.5e-3,
    gyr_noise=2.0e-4,
    acc_scale=(0.002, -0.001, 0.003),
)
"""Errors of a phone: an accelerometer as it left the factory, a gyroscope that the system calibrates."""

ACC_LSB, GYR_LSB, MAG_LSB = 39.2266 / 2**15, 34.9 / 2**15, 0.15e-6
"""One count of the sensors: ±4 g, ±2000 °/s, 0.15 µT."""
BASE_HZ = 200.0
"""A reading is the mean over its interval, of so many instants a second: what sensors' filters do."""


class PhoneOptions(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Everything that can be chosen about a simulated phone, beside scenario and seed.

    Attributes
    ----------
    placement : str
        ``hand``, ``pocket``, ``bag``, ``armband``, ``neck`` or ``swinging``.
    route : str or None
        Own legs instead of the scenario's: ``20:right 90,20:left 90,10`` (m, and the turn behind each leg).
    course_deg : float
        Course of the first leg, clockwise from true north (deg).
    step_m, step_s, step_sd : float
        Mean length (m) and time (s) of a step; relative standard deviation of both.
    rest_s : float
        Standing at both ends (s).
    duration_s : float
        Length of a recording in which nobody walks (s).
    rate_hz : float
        Nominal sample rate of accelerometer, gyroscope and magnetometer.
    jitter_s : float
        Standard deviation of a sample's time about the even grid (s).
    start : str
        UTC time of the first sample (ISO 8601).
    lat_deg, lon_deg, alt_m : float
        Where the walk starts.
    gravity : float
        Local gravity (m/s²).
    errors : str
        ``phone``: usual errors where none are given; ``none``: ideal inertial sensor and magnetometer.
    imu : ImuErrors or None
        Errors of accelerometer and gyroscope.
    hard_iron_t : (float, float, float) or None
        Offset of the magnetometer in b (T); None draws one of ``hard_iron_sigma_t`` an axis.
    hard_iron_sigma_t, soft_iron, mag_noise_t : float
        Spread of that offset (T), relative size of the soft iron, noise of a reading (T).
    disturbance_t : float
        Strength of magnetic disturbances met on the way (T); 0 for none.
    disturbances : int
        Number of disturbed places, spread over the walk, each about 8 m long.
    gnss_hz, gnss_sigma_m, gnss_tau_s, gnss_noise_m, gnss_alt_factor : float
        Rate of the fixes; standard deviation an axis (m) and correlation time (s) of their slow error; that
        of the white one (m); how much worse heights are.
    gnss_velocity_sigma : float
        Standard deviation an axis of the receiver's velocity (m/s), which some apps log.
    gnss_loss : tuple of (float, float)
        Start and length (s after the first sample) of losses of signal.
    gnss_outliers : tuple of (float, float)
        Time (s) and size (m) of single wrong fixes, which state the usual accuracy.
    pressure_hz, pressure_noise_pa : float
        Barometer: rate (0 for none) and noise.
    """

    placement: Literal["hand", "pocket", "bag", "armband", "neck", "swinging"] = "hand"
    route: str | None = None
    course_deg: float = 40.0
    step_m: _Positive = 0.7
    step_s: Annotated[float, msgspec.Meta(ge=0.25, le=2)] = 0.55
    step_sd: Annotated[float, msgspec.Meta(ge=0, le=0.15)] = 0.03
    rest_s: _NonNegative = 4.0
    duration_s: _Positive = 120.0
    rate_hz: Annotated[float, msgspec.Meta(ge=5, le=500)] = 50.0
    jitter_s: Annotated[float, msgspec.Meta(ge=0, le=0.02)] = 0.001
    start: str = "2026-03-09T11:51:47.326Z"
    lat_deg: Annotated[float, msgspec.Meta(ge=-80, le=84)] = -22.826485178097396
    lon_deg: Annotated[float, msgspec.Meta(ge=-180, le=180)] = -47.07604455472332
    alt_m: float = 645.0
    gravity: _Positive = 9.786
    errors: Literal["phone", "none"] = "phone"
    imu: ImuErrors | None = None
    hard_iron_t: Vector | None = None
    hard_iron_sigma_t: _NonNegative = 8e-6
    soft_iron: Annotated[float, msgspec.Meta(ge=0, le=0.3)] = 0.02
    mag_noise_t: _NonNegative = 0.4e-6
    disturbance_t: _NonNegative = 0.0
    disturbances: Annotated[int, msgspec.Meta(ge=1, le=50)] = 3
    gnss_hz: Annotated[float, msgspec.Meta(ge=0, le=20)] = 1.0
    gnss_sigma_m: _NonNegative = 2.5
    gnss_tau_s: _Positive = 40.0
    gnss_noise_m: _NonNegative = 0.8
    gnss_alt_factor: _Positive = 1.6
    gnss_velocity_sigma: _NonNegative = 0.3
    gnss_loss: tuple[Interval, ...] = ()
    gnss_outliers: tuple[Interval, ...] = ()
    pressure_hz: Annotated[float, msgspec.Meta(ge=0, le=200)] = 5.0
    pressure_noise_pa: _NonNegative = 1.5


@dataclass(frozen=True)
class PhoneWalk:
    """A simulated phone: what it measured and what is true. All times are ns since 1970 (UTC).

    Attributes
    ----------
    t_ns : ndarray
        Time of the inertial and magnetic samples, int64, shape (n,).
    acc_b, gyr_b, mag_b : ndarray
        Measured: specific force with gravity (m/s²), angular rate (rad/s), magnetic field (T), (n, 3).
    acc_true, gyr_true, mag_true : ndarray
        The same without errors; ``mag_true`` has the disturbances but no iron.
    pos, vel : ndarray
        The walker's place on the ground (m) and velocity (m/s) in n, (n, 3).
    quat_wxyz : ndarray
        Attitude of the phone, ``rot_nb``, (n, 4).
    heading_rad : ndarray
        Course of the walker from east to north, unwrapped (n,); north-clockwise is ``pi/2 - heading_rad``.
    walking : ndarray
        Whether the person walks, bool (n,).
    disturbed : ndarray
        Whether the field is disturbed by more than 1 µT, bool (n,).
    steps : polars.DataFrame
        One row a step in the columns of ``marcha_msgs/msg/Step``: it ends with the contact of the foot.
    fixes : polars.DataFrame
        ``t_ns, lat_deg, lon_deg, alt_m, sd_east_m, sd_north_m, sd_up_m`` as the phone states them, and
        ``east_m, north_m, up_m``: where it was in truth; ``vel_east, vel_north``: the receiver's velocity (m/s).
    pressure : polars.DataFrame
        ``t_ns, pressure_pa``.
    closed, length_m : bool, float
        Whether the walk ends where it began; length of its track (m).
    declination_rad : float
        Of the Earth's field there (rad, east positive).
    hard_iron_t : ndarray
        The magnetometer's offset in b (T).
    options : PhoneOptions
        What was chosen.
    scenario, seed : str, int
        Likewise.
    """

    t_ns: NDArray[np.int64]
    acc_b: FloatArray
    gyr_b: FloatArray
    mag_b: FloatArray
    acc_true: FloatArray
    gyr_true: FloatArray
    mag_true: FloatArray
    pos: FloatArray
    vel: FloatArray
    quat_wxyz: FloatArray
    heading_rad: FloatArray
    walking: NDArray[np.bool_]
    disturbed: NDArray[np.bool_]
    steps: pl.DataFrame
    fixes: pl.DataFrame
    pressure: pl.DataFrame
    closed: bool
    length_m: float
    declination_rad: float
    hard_iron_t: FloatArray
    options: PhoneOptions
    scenario: str
    seed: int


def make_phone_options(scenario: str, values: dict[str, Any]) -> PhoneOptions:
    """Return checked options from keywords, values as objects or as text.

    ``gnss_loss`` and ``gnss_outliers`` as text are ``60:30,200:20`` (start and length, time and size); fields
    of :class:`ImuErrors` may be given directly.

    Raises
    ------
    UsageError
        Unknown scenario or option, or a value that breaks its rule.
    """
    if scenario not in PHONE_ROUTES:
        raise UsageError(f"scenario {scenario!r} is unknown: choose one of {', '.join(PHONE_ROUTES)}")
    flat: dict[str, Any] = {}
    imu: dict[str, Any] = {}
    for name, value in values.items():
        plain = msgspec.to_builtins(value, enc_hook=lambda v: v.tolist())
        if name in ("gnss_loss", "gnss_outliers") and isinstance(plain, str):
            plain = [part.split(":") for part in plain.split(",") if part.strip()]
        elif isinstance(plain, str) and "," in plain and name != "route":
            plain = plain.split(",")
        if name in ImuErrors.__struct_fields__:
            imu[name] = plain
        else:
            flat[name] = plain
    options = checked(scenario, PhoneOptions, flat)
    if imu:
        base = options.imu or (IDEAL if options.errors == "none" else PHONE_ERRORS)
        changed = checked(scenario, ImuErrors, msgspec.to_builtins(base) | imu)
        options = msgspec.structs.replace(options, imu=changed)
    if options.route is not None and not PHONE_ROUTES[scenario].legs:
        raise UsageError(f"simulate {scenario}: nobody walks there, so it has no route")
    return options


def phone_walk(scenario: str = "phone-turns", *, seed: int = 0, **options: Any) -> PhoneWalk:
    """Simulate a phone that is carried.

    Parameters
    ----------
    scenario : str
        A key of :data:`PHONE_SCENARIOS`.
    seed : int
        Of all random numbers.
    **options
        Fields of :class:`PhoneOptions` and of :class:`ImuErrors`.

    Returns
    -------
    PhoneWalk
        Measurements and truth.

    Raises
    ------
    UsageError
        Unknown scenario or option, or a value that breaks its rule.
    """
    o = make_phone_options(scenario, options)
    start_ns = _start_ns(scenario, o.start)

    def rng(part: str) -> np.random.Generator:
        return np.random.default_rng([seed, *part.encode()])

    route = PHONE_ROUTES[scenario]
    if o.route is not None:
        route = PhoneRoute(route.title, read_legs(o.route))
    plan = schedule(
        route,
        step_m=o.step_m,
        step_s=o.step_s,
        step_sd=o.step_sd,
        rest_s=o.rest_s,
        duration_s=o.duration_s,
        course_rad=np.pi / 2 - np.radians(o.course_deg),
        rng=rng("route"),
    )
    walker = Walker(plan, o.step_s, rng("gait"))
    phone = Phone(walker, PLACEMENTS[o.placement], o.gravity, rng("placement"), sway=scenario != "phone-rest")
    t = _times(o, plan.end_s, rng("clock"))
    acc, gyr = _averaged(phone, t, o.rate_hz)
    attitude = phone.attitude(t)
    ground = walker.ground(t)

    field = earth_field(o.lat_deg, o.lon_deg, o.alt_m, start_ns)
    disturbance = magnetic_disturbance(
        ground, walker.total_m, plan, t, o.disturbance_t, o.disturbances, rng("disturbance")
    )
    mag = attitude.inv().apply(field + disturbance)
    ideal = o.errors == "none"
    imu = SimulatedImu(o.imu or (IDEAL if ideal else PHONE_ERRORS), o.rate_hz, ACC_LSB, GYR_LSB, rng("imu"))
    measured = imu.read(acc, gyr)
    mag_b, hard = _magnetometer(mag, o, ideal, rng("mag"))

    t_ns = start_ns + np.round(t * 1e9).astype(np.int64)
    fixes = fixes_of(walker, o, start_ns, plan.end_s, rng("gnss"), rng("gnss velocity"))
    return PhoneWalk(
        t_ns=t_ns,
        acc_b=measured[:, :3],
        gyr_b=measured[:, 3:],
        mag_b=mag_b,
        acc_true=acc,
        gyr_true=gyr,
        mag_true=mag,
        pos=ground,
        vel=(walker.ground(t + 5e-3) - walker.ground(t - 5e-3)) / 1e-2,
        quat_wxyz=np.roll(attitude.as_quat(canonical=True), 1, axis=1),
        heading_rad=walker.course(t),
        walking=walker.walking(t),
        disturbed=np.linalg.norm(disturbance, axis=1) > 1e-6,
        steps=_steps(walker, start_ns),
        fixes=fixes,
        pressure=pressure_of(phone, o, start_ns, plan.end_s, rng("pressure")),
        closed=route.closed,
        length_m=float(walker.total_m),
        declination_rad=float(np.arctan2(field[0], field[1])),
        hard_iron_t=hard,
        options=o,
        scenario=scenario,
        seed=seed,
    )


def _start_ns(scenario: str, text: str) -> int:
    from datetime import UTC, datetime

    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        raise UsageError(f"simulate {scenario}: option start={text!r} is no ISO 8601 time") from None
    moment = moment if moment.tzinfo else moment.replace(tzinfo=UTC)
    return int(moment.timestamp() * 1000) * 1_000_000


def _times(o: PhoneOptions, end_s: float, rng: np.random.Generator) -> FloatArray:
    """Return sample times (s): an even grid with jitter that never turns the order round."""
    t = np.arange(0.0, end_s, 1 / o.rate_hz)
    jitter = np.clip(o.jitter_s * rng.standard_normal(len(t)), -0.4 / o.rate_hz, 0.4 / o.rate_hz)
    jitter[0] = 0.0
    return t + jitter


def _averaged(phone: Phone, t: FloatArray, rate_hz: float) -> tuple[FloatArray, FloatArray]:
    """Return ideal readings, each the mean over one sample interval about its time."""
    count = max(1, round(BASE_HZ / rate_hz))
    places = ((np.arange(count) + 0.5) / count - 0.5) / rate_hz
    acc, gyr = np.zeros((len(t), 3)), np.zeros((len(t), 3))
    for place in places:
        a, g = phone.readings(t + place)
        acc += a / count
        gyr += g / count
    return acc, gyr


def _magnetometer(
    mag: FloatArray, o: PhoneOptions, ideal: bool, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Return measured field (T) and the offset of hard iron."""
    drawn = o.hard_iron_sigma_t * rng.standard_normal(3)
    skew = o.soft_iron * rng.standard_normal((3, 3))
    noise = o.mag_noise_t * rng.standard_normal(mag.shape)
    if o.hard_iron_t is not None:
        hard = np.asarray(o.hard_iron_t)
    else:
        hard = np.zeros(3) if ideal else drawn
    if ideal:
        return mag + hard, hard
    return np.round((mag @ (np.eye(3) + (skew + skew.T) / 2) + hard + noise) / MAG_LSB) * MAG_LSB, hard


def _steps(walker: Walker, start_ns: int) -> pl.DataFrame:
    """Return one row a step, from contact to contact; displacements of the walker, not of a foot."""
    plan = walker.schedule
    begin = np.concatenate(([0.0], plan.contact_s[:-1])) if len(plan.contact_s) else plan.contact_s
    first = np.flatnonzero(np.diff(plan.bout, prepend=-1))
    begin[first] = plan.start_s[: len(first)]
    move = walker.ground(plan.contact_s) - walker.ground(begin) if len(begin) else np.zeros((0, 3))
    return pl.DataFrame(
        {
            "start_ns": start_ns + np.round(begin * 1e9).astype(np.int64),
            "end_ns": start_ns + np.round(plan.contact_s * 1e9).astype(np.int64),
            "index": np.arange(len(begin), dtype=np.uint32),
            "length_m": np.hypot(move[:, 0], move[:, 1]),
            "height_m": move[:, 2],
            "heading_rad": np.arctan2(move[:, 1], move[:, 0]),
        }
    )
