"""What all foot-mounted estimators share: parameters, a sample's way through the state, results, remarks.

A row is taken (:func:`take`) into the ring, watched for the rest at the start, and judged by the detector;
once the decision about sample k − latency is there, :func:`release` hands that sample to the filter, which
ends with :func:`emit`. A filter's kernel is therefore four lines; see ``foot_9iez.py``.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, ClassVar, Literal

import msgspec
import numpy as np

from ..contract import (
    AlgorithmError,
    Annotate,
    FloatArray,
    Input,
    Output,
    Remark,
    RowKernel,
)
from ..numerics.compiled import compiled, inlined
from ..numerics.rotations import quat_from_rot
from ..parameters import meta
from . import detectors, strapdown
from . import layout as la
from .detectors import (
    PITCH,
    decide,
    record,
    start_tilt,
    track_tilt,
)
from .layout import (
    BIAS_GYR,
    C_HI,
    DECIDED,
    INIT_INDEX,
    KIND,
    LATENCY,
    O_POSE,
    O_REST,
    O_STEP,
    O_STILL,
    O_VEL,
    POS,
    R_ACC,
    R_DT,
    R_EXTRA,
    R_GYR,
    R_NORM_ACC,
    R_NORM_GYR,
    R_PITCH,
    R_STAT,
    R_STILL,
    RELEASED,
    REPAIRED,
    ROT,
    ROW_MAX,
    ROW_MIN,
    STANCE_S,
    STARTED,
    STEP_INDEX,
    STEP_LAND,
    STEP_MIN_M,
    STEP_MIN_S,
    STEP_SWING,
    STEP_WAS_STILL,
    STILL_COUNT,
    TAKEN,
    TIME,
    TIME_OUT,
    VEL,
)

IMU_COLUMNS = ("acc_x", "acc_y", "acc_z", "gyr_x", "gyr_y", "gyr_z")
IMU = Input("imu", "sensor_msgs/msg/Imu", IMU_COLUMNS, regular=True)
MAGNETIC_FIELD = Input(
    "magnetometer", "sensor_msgs/msg/MagneticField", ("mag_x", "mag_y", "mag_z"), optional=True
)
FLUID_PRESSURE = Input("barometer", "sensor_msgs/msg/FluidPressure", ("pressure_pa",), optional=True)
SOURCE_RATE_HZ = 100.0
"""Sample rate of the source's device, for a bare ``make()``; a different measured rate is remarked."""

RESTLESS = 0.03
"""rad/s: above this spread of the rate the rest at the start is remarked."""

_SKOG = "Skog et al. 2010, settings of the authors' program"
_SOURCE = "dissertation, section 4.4"


class DetectorParams(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Zero-velocity detector: which one, its window, its thresholds, its cleaning."""

    rate_hz: Annotated[
        float,
        meta(
            "Sample rate that turns windows in seconds into samples; 0: the engine fills in the measured "
            "rate, make() alone takes 100 (the source's device) and remarks when the data disagree",
            "Hz",
            ge=0.0,
            le=100_000.0,
        ),
    ] = 0.0
    detector: Annotated[
        Literal["c1c2c3", "pitch", "shoe", "are", "mv", "mag"],
        meta("Which detector decides that the foot is still", source=_SOURCE),
    ] = "c1c2c3"
    window_s: Annotated[
        float,
        meta(
            "Length of the statistic's window; 0: the detector's own (c1c2c3 0.1, pitch 0.2, others 0.05)",
            "s",
            f"{_SOURCE}: n = 5…10 and 20 samples at 100 Hz; {_SKOG}: 5 samples",
            ge=0.0,
            le=10.0,
        ),
    ] = 0.0
    window_side: Annotated[
        Literal["centred", "trailing"],
        meta("Window and median around the sample (adds latency) or behind it (none)", source=_SOURCE),
    ] = "centred"
    cleaning: Annotated[
        Literal["median", "fill-burst", "none"],
        meta(
            "Cleaning of the raw decisions: majority, or fill short gaps and then drop short bursts",
            source=_SOURCE,
        ),
    ] = "median"
    cleaning_s: Annotated[
        float, meta("Length of the cleaning window", "s", f"{_SOURCE}: 10 samples at 100 Hz", gt=0.0, le=10.0)
    ] = 0.1
    c1_min: Annotated[float, meta("C1: least ‖f‖ at rest", "m/s²", _SOURCE, ge=0.0)] = 9.0
    c1_max: Annotated[float, meta("C1: greatest ‖f‖ at rest", "m/s²", _SOURCE, gt=0.0)] = 11.0
    c2_max: Annotated[
        float,
        meta(
            "C2: greatest variance of ‖f‖ in the window", "m²/s⁴", f"{_SOURCE}; literature 3, 15, 20", gt=0.0
        ),
    ] = 3.0
    c3_max: Annotated[float, meta("C3: greatest ‖ω‖ at rest", "rad/s", _SOURCE, gt=0.0)] = 0.6
    pitch_dev_max_deg: Annotated[
        float,
        meta(
            "C1pitch: greatest distance from the pitch at rest", "deg", "dissertation, section 4.4.1", gt=0.0
        ),
    ] = 6.0
    pitch_var_max_deg2: Annotated[
        float,
        meta(
            "C2pitch: greatest variance of pitch in the window", "deg²", "dissertation, section 4.4.1", gt=0.0
        ),
    ] = 6.0
    pitch_tau_s: Annotated[
        float,
        meta(
            "Time constant that pulls the pitch detector's own tilt to the accelerometer at rest",
            "s",
            "ours",
            gt=0.0,
        ),
    ] = 0.5
    shoe_max: Annotated[float, meta("SHOE: greatest statistic at rest", "1", _SKOG, gt=0.0)] = 0.3e5
    shoe_sigma_acc: Annotated[float, meta("SHOE: noise of the accelerometer", "m/s²", _SKOG, gt=0.0)] = 0.01
    shoe_sigma_gyr: Annotated[float, meta("SHOE: noise of the gyroscope", "rad/s", _SKOG, gt=0.0)] = (
        math.radians(0.1)
    )
    are_max: Annotated[
        float, meta("ARE: greatest mean ‖ω‖² in the window", "rad²/s²", f"{_SKOG}: γσω²", gt=0.0)
    ] = 0.3e5 * math.radians(0.1) ** 2
    mv_max: Annotated[
        float, meta("MV: greatest variance of f in the window", "m²/s⁴", f"{_SKOG}: γσa²", gt=0.0)
    ] = 3.0
    mag_max: Annotated[
        float, meta("MAG: greatest mean (‖f‖ − g)² in the window", "m²/s⁴", f"{_SKOG}: γσa²", gt=0.0)
    ] = 3.0


class FootParams(DetectorParams, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Detector, rest at the start, mechanization and steps: what every foot estimator needs."""

    init_s: Annotated[
        float,
        meta(
            "Length of the rest from which it starts",
            "s",
            "dissertation, section 3.6: 200 samples",
            gt=0.0,
            le=600.0,
        ),
    ] = 2.0
    rest_acc: Annotated[
        float,
        meta("Rest at the start: greatest distance of f from its mean", "m/s²", "ours, measured", gt=0.0),
    ] = 0.8
    rest_gyr: Annotated[
        float,
        meta("Rest at the start: greatest distance of ω from its mean", "rad/s", "ours, measured", gt=0.0),
    ] = 0.3
    rest_bias_max: Annotated[
        float,
        meta(
            "Rest at the start: greatest mean ‖ω‖ that may be a bias",
            "rad/s",
            "MPU-6050: ±20 °/s an axis",
            gt=0.0,
        ),
    ] = 0.6
    gravity: Annotated[float, meta("Local gravity", "m/s²", "dissertation", gt=0.0, le=30.0)] = 9.81
    gravity_from_rest: Annotated[
        bool,
        meta(
            "Take the mean ‖f‖ of the rest for gravity: absorbs a scale error of the accelerometer",
            source="ours",
        ),
    ] = False
    integration: Annotated[
        Literal["trapezoid", "euler"],
        meta(
            "Rule for velocity and position", source="trapezoid: the authors' program; euler: eqs 3.19–3.27"
        ),
    ] = "trapezoid"
    step_min_s: Annotated[float, meta("Shortest swing that is a step", "s", "ours", ge=0.0)] = 0.15
    step_min_m: Annotated[float, meta("Shortest displacement that is a step", "m", "ours", ge=0.0)] = 0.1


@inlined
def take(s: FloatArray, row: FloatArray) -> bool:
    """Take a row into the state; return whether a sample can be released to the filter.

    A value that is not finite is replaced by the previous row's (and counted): one NaN must not ruin the run.
    """
    k = int(s[TAKEN])
    r = record(s, k)
    dt = row[0] if k > 0 else 0.0
    s[TAKEN] = k + 1
    s[TIME] += dt
    s[r + R_DT] = dt
    previous = record(s, k - 1) if k > 0 else r
    repaired = False
    for i in range(6):
        value = row[1 + i]
        if not math.isfinite(value):
            repaired = True
            value = s[previous + R_ACC + i] if k > 0 else 0.0
        s[r + R_ACC + i] = value
        if k == 0 or value < s[ROW_MIN + i]:
            s[ROW_MIN + i] = value
        if k == 0 or value > s[ROW_MAX + i]:
            s[ROW_MAX + i] = value
    if repaired:
        s[REPAIRED] += 1.0
    for i in range(4):
        s[r + R_EXTRA + i] = row[7 + i] if 7 + i < row.shape[0] else math.nan
    x, y, z = s[r + R_ACC], s[r + R_ACC + 1], s[r + R_ACC + 2]
    s[r + R_NORM_ACC] = math.sqrt(x * x + y * y + z * z)
    x, y, z = s[r + R_GYR], s[r + R_GYR + 1], s[r + R_GYR + 2]
    s[r + R_NORM_GYR] = math.sqrt(x * x + y * y + z * z)
    if strapdown.watch_rest(s, r, k):
        start_tilt(s)
    if s[INIT_INDEX] < 0.0:
        s[r + R_PITCH] = math.nan
    elif s[KIND] == PITCH:
        track_tilt(s, r)
    s[DECIDED] = k
    decide(s, k, k)
    return k >= int(s[LATENCY])


@compiled
def take_end(s: FloatArray) -> bool:
    """After the last row: decide about the next sample held back, windows cut off; False if none is left."""
    last = int(s[TAKEN]) - 1
    j = int(s[RELEASED])
    if j > last:
        return False
    # Where fewer rows came than the latency, stages are behind by more than one row.
    while s[DECIDED] < j + s[LATENCY]:
        s[DECIDED] += 1.0
        decide(s, int(s[DECIDED]), last)
    return True


@inlined
def release(s: FloatArray) -> int:
    """Count the next sample as released and return its record."""
    j = int(s[RELEASED])
    s[RELEASED] = j + 1
    r = record(s, j)
    s[TIME_OUT] += s[r + R_DT]
    s[STANCE_S] = s[STANCE_S] + s[r + R_DT] if s[r + R_STILL] > 0.5 else 0.0
    return r


@inlined
def starts(s: FloatArray) -> bool:
    """Start the navigation where the released sample completed the rest; return True at that sample only."""
    if s[STARTED] > 0.5 or s[INIT_INDEX] < 0.0 or s[RELEASED] - 1.0 != s[INIT_INDEX]:
        return False
    strapdown.start(s)
    s[STARTED] = 1.0
    s[STEP_WAS_STILL] = 1.0
    return True


@inlined
def emit(s: FloatArray, r: int, out: FloatArray) -> None:
    """Write pose, velocity, stance and step of the sample at ``r``; NaN before the navigation has started."""
    still = s[r + R_STILL]
    out[O_STILL] = still
    for i in range(5):
        out[O_STEP + i] = math.nan
    if s[STARTED] < 0.5:
        for i in range(O_POSE, O_STILL):
            out[i] = math.nan
        return
    for i in range(3):
        out[O_POSE + i] = s[POS + i]
        out[O_VEL + i] = s[VEL + i]
    quat_from_rot(s, ROT, out, O_POSE + 3)
    s[STEP_SWING] += s[r + R_DT]
    if still > 0.5:
        s[STILL_COUNT] += 1.0
        if s[STEP_WAS_STILL] < 0.5:
            _land(s, out)
        s[STEP_SWING] = 0.0
    s[STEP_WAS_STILL] = still


@compiled
def _land(s: FloatArray, out: FloatArray) -> None:
    """At the first still sample after a swing: write the step from the previous landing, if long enough."""
    x, y, z = s[POS] - s[STEP_LAND], s[POS + 1] - s[STEP_LAND + 1], s[POS + 2] - s[STEP_LAND + 2]
    if s[STEP_SWING] < s[STEP_MIN_S] or math.sqrt(x * x + y * y + z * z) < s[STEP_MIN_M]:
        return
    s[STEP_INDEX] += 1.0
    out[O_STEP] = s[STEP_SWING]
    out[O_STEP + 1] = s[STEP_INDEX] - 1.0
    out[O_STEP + 2] = math.sqrt(x * x + y * y)
    out[O_STEP + 3] = z
    out[O_STEP + 4] = math.atan2(y, x)
    for i in range(3):
        s[STEP_LAND + i] = s[POS + i]


@inlined
def emit_sigma(s: FloatArray, p: int, n: int, pos: int, vel: int, att: int, out: FloatArray) -> None:
    """Write the standard deviations of position, velocity and attitude from the covariance at ``s[p]``."""
    for i in range(3):
        if s[STARTED] > 0.5:
            out[O_REST + i] = math.sqrt(max(0.0, s[p + (pos + i) * (n + 1)]))
            out[O_REST + 3 + i] = math.sqrt(max(0.0, s[p + (vel + i) * (n + 1)]))
            out[O_REST + 6 + i] = math.sqrt(max(0.0, s[p + (att + i) * (n + 1)]))
        else:
            out[O_REST + i] = math.nan
            out[O_REST + 3 + i] = math.nan
            out[O_REST + 6 + i] = math.nan


@inlined
def emit_detector(s: FloatArray, r: int, first: int, out: FloatArray) -> None:
    """Write the detector's statistics of the sample at ``r`` to the end of the result."""
    for i in range(out.shape[0] - first):
        out[first + i] = s[r + R_STAT + i]


@inlined
def at_rest(s: FloatArray, r: int, since: float, rate: float) -> bool:
    """Return whether the foot has been still for ``since`` s and turns by less than ``rate`` rad/s at ``r``.

    The condition of a zero angular rate update; stricter than stance, for a walking foot rolls on as it
    stands.
    """
    x = s[r + R_GYR] - s[BIAS_GYR]
    y = s[r + R_GYR + 1] - s[BIAS_GYR + 1]
    z = s[r + R_GYR + 2] - s[BIAS_GYR + 2]
    return s[STANCE_S] >= since and math.sqrt(x * x + y * y + z * z) < rate


SIGMA = Output(
    "sigma",
    "marcha_msgs/msg/NavigationSigma",
    tuple(f"sigma_{what}_{axis}" for what in ("pos", "vel", "att") for axis in "xyz"),
)


class FootEstimator(RowKernel):
    """Base of the foot estimators: builds the packed state, names the outputs, makes the remarks.

    A subclass sets ``kernel``, ``run``, ``flush_kernel``, ``state_size`` (end of its own numbers in the
    state), ``has_sigma``, ``Params`` and fills its own numbers in :meth:`configure`.
    """

    Params: ClassVar[type[msgspec.Struct]] = FootParams
    state_size: ClassVar[int] = la.CORE
    has_sigma: ClassVar[bool] = True
    extra_inputs: ClassVar[tuple[Input, ...]] = ()
    presets: ClassVar[dict[str, dict[str, Any]]] = {
        "short-rest": {"init_s": 0.3},
        "live": {"window_side": "trailing", "cleaning": "median"},
        "shoe-tuned": {"detector": "shoe", "shoe_max": 1e5},
        "are-tuned": {"detector": "are", "are_max": 0.3},
        "mv-tuned": {"detector": "mv", "mv_max": 0.3, "window_s": 0.15},
        "mag-tuned": {"detector": "mag", "mag_max": 0.4, "window_s": 0.15},
    }

    def __init__(self, params: msgspec.Struct | None = None) -> None:
        super().__init__(params)
        p: Any = self.params
        if p.c1_min >= p.c1_max:
            raise AlgorithmError(f"{self.name}: c1_min = {p.c1_min:g} must be below c1_max = {p.c1_max:g}")
        self.rate_hz = p.rate_hz or SOURCE_RATE_HZ
        self.inputs = (IMU, *self.extra_inputs)
        self.state = _core_state(p, self.rate_hz, self.state_size)
        self.latency = int(self.state[LATENCY])
        self.outputs = (
            Output(
                "pose",
                "geometry_msgs/msg/PoseStamped",
                ("pos_x", "pos_y", "pos_z", "quat_w", "quat_x", "quat_y", "quat_z"),
            ),
            Output("velocity", "geometry_msgs/msg/Vector3Stamped", ("vel_x", "vel_y", "vel_z")),
            Output(
                "stance",
                "marcha_msgs/msg/Stance",
                ("still",),
                frame="imu",
                annotate=Annotate("stance", "state", "still", "stance"),
            ),
            Output(
                "step",
                "marcha_msgs/msg/Step",
                ("swing_s", "index", "length_m", "height_m", "heading_rad"),
                event=True,
                annotate=Annotate("step", "interval", label="step {index}"),
            ),
            *((SIGMA,) if self.has_sigma else ()),
            Output(
                "detector",
                "marcha_msgs/msg/NamedValues",
                detectors.STATISTICS[p.detector],
                metadata=(("detector", p.detector), *thresholds(p)),
                frame="imu",
            ),
        )
        self.configure(p)

    def configure(self, params: Any) -> None:
        """Write the filter's own constants and initial values into ``self.state``."""

    def remarks(self) -> list[Remark]:
        """Return what the data did that the results' user must know."""
        return _remarks(self.state, self.params, self.rate_hz)


def thresholds(p: Any) -> tuple[tuple[str, str], ...]:
    """Return the detector's limits as channel metadata: ``threshold.<statistic>``, ``.min`` for a floor."""
    limits = {
        "c1c2c3": {"acc_norm.min": p.c1_min, "acc_norm": p.c1_max, "acc_var": p.c2_max, "gyr_norm": p.c3_max},
        "pitch": {"pitch_dev": p.pitch_dev_max_deg, "pitch_var": p.pitch_var_max_deg2},
        "shoe": {"shoe": p.shoe_max},
        "are": {"are": p.are_max},
        "mv": {"mv": p.mv_max},
        "mag": {"mag": p.mag_max},
    }[p.detector]
    return tuple((f"threshold.{name}", f"{value:g}") for name, value in limits.items())


def _samples(seconds: float, rate_hz: float) -> int:
    return max(1, round(seconds * rate_hz))


def _core_state(p: Any, rate_hz: float, size: int) -> FloatArray:
    default = {"c1c2c3": 0.1, "pitch": 0.2}.get(p.detector, 0.05)
    window = _samples(p.window_s or default, rate_hz)
    clean = _samples(p.cleaning_s, rate_hz) if p.cleaning != "none" else 1
    lo, hi = _split(window, p.window_side)
    c_lo, c_hi = _split(clean, p.window_side)
    if p.cleaning == "fill-burst":
        c_lo, c_hi = 0, 2 * (clean - 1)
    latency = hi + c_hi
    length = 1 << (latency + lo + c_lo + 2).bit_length()
    s = np.zeros(size + length * la.RECORD)
    s[la.KIND] = detectors.KINDS.index(p.detector)
    s[la.W_LO], s[la.W_HI] = lo, hi
    s[la.CLEANING] = detectors.CLEANINGS.index(p.cleaning)
    s[la.C_LEN], s[la.C_LO], s[C_HI] = clean, c_lo, c_hi
    s[LATENCY] = latency
    s[la.LIMITS : la.LIMITS + 4] = {
        "c1c2c3": (p.c1_min, p.c1_max, p.c2_max, p.c3_max),
        "pitch": (p.pitch_dev_max_deg, p.pitch_var_max_deg2, 0.0, 0.0),
        "shoe": (p.shoe_max, 0.0, 0.0, 0.0),
        "are": (p.are_max, 0.0, 0.0, 0.0),
        "mv": (p.mv_max, 0.0, 0.0, 0.0),
        "mag": (p.mag_max, 0.0, 0.0, 0.0),
    }[p.detector]
    s[la.WEIGHT_ACC], s[la.WEIGHT_GYR] = 1.0 / p.shoe_sigma_acc**2, 1.0 / p.shoe_sigma_gyr**2
    s[la.PITCH_TAU] = p.pitch_tau_s
    s[la.RING], s[la.RING_MASK] = size, length - 1
    s[la.LAST_ONE] = -1.0
    s[la.INIT_S], s[la.REST_ACC], s[la.REST_GYR] = p.init_s, p.rest_acc, p.rest_gyr
    s[la.REST_BIAS], s[la.GRAVITY_PARAM] = p.rest_bias_max, p.gravity
    s[la.GRAVITY_FROM_REST] = p.gravity_from_rest
    s[la.TRAPEZOID] = p.integration == "trapezoid"
    s[INIT_INDEX] = -1.0
    s[STEP_MIN_S], s[STEP_MIN_M] = p.step_min_s, p.step_min_m
    return s


def _split(window: int, side: str) -> tuple[int, int]:
    """Return how many samples before and after its own a window of ``window`` samples takes."""
    lo = window - 1 if side == "trailing" else window // 2
    return lo, window - 1 - lo


def _remarks(s: FloatArray, p: Any, rate_hz: float) -> list[Remark]:
    taken, elapsed = int(s[TAKEN]), s[TIME]
    if taken == 0:
        return [Remark("no_data", "no row was given; nothing was estimated", fatal=True)]
    found: list[Remark] = []
    if s[REPAIRED] > 0:
        share = s[REPAIRED] / taken
        found.append(
            Remark(
                "not_finite",
                f"{int(s[REPAIRED])} of {taken} rows held a value that is not finite; the previous one "
                f"was kept",
                fatal=share > 0.01,
            )
        )
    for i, column in enumerate(IMU_COLUMNS):
        low, high = s[ROW_MIN + i], s[ROW_MAX + i]
        if low == high and taken >= 10:
            found.append(
                Remark(
                    "dead_axis",
                    f"{column} is {low:g} in all {taken} rows: that axis is missing or broken; "
                    "an estimate without it is wrong, repair the sensor or its mapping",
                    fatal=True,
                )
            )
    if elapsed > 0 and taken > 10:
        measured = (taken - 1) / elapsed
        if not 0.8 < measured / rate_hz < 1.25:
            found.append(
                Remark(
                    "rate_mismatch",
                    f"windows were laid out for {rate_hz:g} Hz but rows come at {measured:.1f} Hz, so they "
                    f"last {rate_hz / measured:.2f} times as long as asked; give rate_hz={measured:.0f}",
                )
            )
    if s[INIT_INDEX] < 0:
        found.append(
            Remark(
                "no_rest",
                f"no rest of {p.init_s:g} s anywhere in {elapsed:.1f} s (longest {s[la.REST_BEST]:.2f} "
                f"s): bias and "
                "level are unknown, nothing was estimated; stand still at the start, or give a shorter "
                "init_s (preset=short-rest: 0.3 s)",
                fatal=True,
            )
        )
        return found
    start = s[la.INIT_START]
    if start > 0.5:
        found.append(
            Remark(
                "no_rest",
                f"no rest of {p.init_s:g} s at the start; the first one begins at {start:.2f} s, and the "
                f"estimate starts "
                f"at its end, after {100 * (s[INIT_INDEX] + 1) / taken:.0f} % of the rows; a shorter "
                f"init_s may find one "
                "earlier",
            )
        )
    spread = math.sqrt(s[la.REST_SPREAD] / s[la.REST_COUNT])
    if spread > RESTLESS:
        found.append(
            Remark(
                "restless",
                f"in the rest at {start:.2f} s the angular rate spreads by {spread:.3f} rad/s (a sensor "
                f"that lies still: "
                f"below {RESTLESS:g}): the bias taken from it is uncertain; hold still longer, or give a "
                f"shorter init_s",
            )
        )
    ax, ay, az = s[la.INIT_MEAN : la.INIT_MEAN + 3]
    norm = math.sqrt(ax * ax + ay * ay + az * az)
    if abs(norm - p.gravity) > 0.3 * p.gravity:
        found.append(
            Remark(
                "unit_doubt",
                f"‖f‖ at rest is {norm:.3f} m/s², gravity {p.gravity:g}: are the values in g or in counts?",
                fatal=True,
            )
        )
    elif abs(norm - p.gravity) > 0.02 * p.gravity:
        found.append(
            Remark(
                "gravity_norm",
                f"‖f‖ at rest is {norm:.3f} m/s², {100 * (norm / p.gravity - 1):+.1f} % off gravity "
                f"{p.gravity:g}: "
                "the accelerometer's scale or bias is off; calibrate it, or try gravity_from_rest",
            )
        )
    if az < 0:
        roll = math.degrees(math.atan2(ay, az))
        pitch = math.degrees(math.atan2(-ax, math.hypot(ay, az)))
        found.append(
            Remark(
                "upside_down",
                f"the sensor's z axis points down at rest (roll {roll:.0f}°, pitch {pitch:.0f}°); it was "
                f"levelled fully",
            )
        )
    if s[la.MOVED] == 0:
        found.append(
            Remark(
                "never_moved",
                f"nothing moved after the rest ({elapsed:.1f} s in all): there is no walk in it",
            )
        )
    elif s[STARTED] > 0.5 and s[STILL_COUNT] == 0 and taken > s[INIT_INDEX] + 2 * s[LATENCY] + 10:
        found.append(
            Remark(
                "never_still",
                f"the detector {p.detector} never found the foot still: nothing was corrected; check its "
                f"thresholds",
                fatal=True,
            )
        )
    elif s[STEP_INDEX] == 0 and s[la.MOVED] <= rate_hz:
        found.append(
            Remark(
                "no_step",
                f"after the rest it moved for {s[la.MOVED] / rate_hz:.2f} s only: there is no step in it",
            )
        )
    elif s[STEP_INDEX] == 0:
        found.append(
            Remark("no_step", "the sensor moved, but no step was found: wrong detector or wrong mounting?")
        )
    position = s[POS : POS + 3]
    if s[STARTED] > 0.5 and not (np.all(np.isfinite(position)) and np.all(np.abs(position) < 1e6)):
        found.append(Remark("diverged", f"the position ran away to {position} m", fatal=True))
    return found
