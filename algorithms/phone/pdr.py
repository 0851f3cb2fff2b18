"""Dead reckoning with a phone: without fixes, and fused with them."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import msgspec
import numpy as np

from ..contract import (
    ALL_COLUMNS,
    AlgorithmError,
    Context,
    Input,
    KernelEstimator,
    Message,
    Output,
    Remark,
    Result,
)
from ..parameters import meta
from . import attitude, direction, geodesy, lengths, mixture, ring, steps, track
from .lengths import LengthParams
from .steps import ACC, DETECTOR, STEP

if TYPE_CHECKING:
    import polars as pl

    from ..contract import FloatArray

GYR = Input("gyr", "sensor_msgs/msg/Imu", ("gyr_x", "gyr_y", "gyr_z"), optional=True, regular=True)
MAG = Input("mag", "sensor_msgs/msg/MagneticField", ("mag_x", "mag_y", "mag_z"), optional=True, regular=True)
PRESSURE = Input("pressure", "sensor_msgs/msg/FluidPressure", ("pressure_pa",), optional=True)
GNSS = Input("gnss", "sensor_msgs/msg/NavSatFix", ALL_COLUMNS)
VELOCITY = Input("velocity", "geometry_msgs/msg/Vector3Stamped", ("vel_x", "vel_y"), optional=True)
ROLES = {
    "gyr": track.GYR,
    "acc": track.ACC,
    "mag": track.MAG,
    "pressure": track.PRESSURE,
    "gnss": track.GNSS,
    "velocity": track.VELOCITY,
}

FIELD_ALONE = 3.0
"""Factor of a heading's deviations where no gyroscope smooths the field: sway, iron and tilt are in it."""

POSE = Output(
    "pose",
    "geometry_msgs/msg/PoseStamped",
    ("pos_x", "pos_y", "pos_z", "quat_w", "quat_x", "quat_y", "quat_z"),
)
SIGMA = Output(
    "sigma",
    "marcha_msgs/msg/NavigationSigma",
    ("sigma_pos_x", "sigma_pos_y", "sigma_pos_z", "sigma_att_x", "sigma_att_y", "sigma_att_z"),
)
HEADING = Output(
    "heading",
    "marcha_msgs/msg/NamedValues",
    (
        "device_rad",
        "walking_rad",
        "magnetic_rad",
        "disturbed",
        "offset_rad",  # of the shaking's fore end from the device's heading
        "offset_used",
        "opposite_p",
    ),
    event=True,
)
FIX = Output(
    "fix",
    "sensor_msgs/msg/NavSatFix",
    ("lat_deg", "lon_deg", "alt_m", "sd_east_m", "sd_north_m", "sd_up_m"),
    event=True,
)
STATE = Output(
    "state",
    "marcha_msgs/msg/NamedValues",
    ("heading_correction_rad", "length_scale", "hypotheses", "correlation_en", "fixes", "outliers"),
    event=True,
)


DOUBTFUL = 0.03
"""Mean probability of walking the opposite way from which on a run says so."""


class PdrParams(LengthParams, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Steps, lengths, headings, and how sure they are."""

    heading: Annotated[
        Literal["auto", "device", "walking", "magnetometer", "tilt-compensated", "gyroscope"],
        meta(
            "Walking direction: the device's in a hand and found from the motion elsewhere (auto), always the "
            "device's, always found; magnetometer: source's eq 3.17 with its median; tilt-compensated: the "
            "magnetometer alone on the level; gyroscope: integral of the rate about the phone's z axis",
            source="phone dissertation, table 3.2; walking: Kourogi and Kurata 2014",
        ),
    ] = "auto"
    magnetometer: Annotated[
        Literal["auto", "follow", "start", "off"],
        meta(
            "How the field turns the gyroscope's heading: follow with tau_mag_s, or once, by its average up to "
            "the first step; auto: follow where it is calibrated, else start",
            source="ours",
        ),
    ] = "auto"
    tau_acc_s: Annotated[float, meta("Time constant of the inclination", "s", "VQF: 3", gt=0.1)] = 3.0
    tau_mag_s: Annotated[float, meta("Time constant of the heading by the field", "s", "ours", gt=0.1)] = 20.0
    median_s: Annotated[
        float, meta("magnetometer: trailing window of the median", "s", "phone dissertation, eq 3.18", gt=0.0)
    ] = 1.0
    declination_deg: Annotated[
        float, meta("Magnetic declination, east positive (fused: from the model at the first fix)", "deg")
    ] = 0.0
    sigma_length: Annotated[
        float, meta("Relative standard deviation of one step's length", "1", "ours", gt=0.0)
    ] = 0.08
    sigma_scale: Annotated[
        float, meta("Relative standard deviation of all lengths together", "1", "ours", gt=0.0)
    ] = 0.1
    sigma_step_deg: Annotated[
        float, meta("Standard deviation of one step's heading", "deg", "ours", gt=0.0)
    ] = 4.0
    sigma_turn_deg: Annotated[
        float, meta("Growth of the heading's error, a root of a step", "deg", "ours", gt=0.0)
    ] = 0.4
    sigma_drift: Annotated[
        float,
        meta(
            "Bias of the gyroscope about the vertical that is left (a tenth of it where the field is followed; "
            "below 30 Hz more in proportion, since the hand's own motion is then integrated badly)",
            "rad/s",
            "ours",
            ge=0.0,
        ),
    ] = 0.003
    sigma_heading_deg: Annotated[
        float,
        meta(
            "Standard deviation of the heading at the start; 0: 15 by a calibrated field, 35 by another",
            "deg",
            ge=0.0,
        ),
    ] = 0.0


class PhoneFusedParams(PdrParams, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What fixes are worth, beside steps, lengths and headings."""

    gnss_sd_m: Annotated[
        float, meta("Standard deviation an axis of fixes that state none", "m", "ours", gt=0.0)
    ] = 8.0
    gnss_sd_min_m: Annotated[
        float, meta("Least standard deviation that is believed", "m", "ours", gt=0.0)
    ] = 1.0
    gnss_slow_share: Annotated[
        float, meta("Share of a fix's variance that changes slowly", "1", "ours", ge=0.0, lt=1.0)
    ] = 0.9
    gnss_tau_s: Annotated[float, meta("Correlation time of that share", "s", "ours", gt=0.0)] = 40.0
    gnss_velocity_sd: Annotated[
        float,
        meta(
            "Standard deviation an axis of the receiver's velocity (phones state 0.3 to 0.7 m/s of its size)",
            "m/s",
            "ours",
            gt=0.0,
        ),
    ] = 0.3
    outlier: Annotated[float, meta("Probability that a fix is none", "1", "ours", gt=0.0, lt=0.5)] = 0.02


class PhoneTrack(KernelEstimator):
    """Base of the estimators that walk a track in one kernel."""

    dtype: ClassVar[np.dtype[Any]] = np.dtype(track.FIELDS)
    run = staticmethod(track.run)
    run_end = staticmethod(track.run_end)
    max_results: int = track.EVENTS
    max_held: int = ring.QUEUE + track.WAITING
    fused: ClassVar[bool] = False

    def __init__(self, params: msgspec.Struct | None = None) -> None:
        super().__init__(params)
        self.state = np.zeros(1, self.dtype)
        self._columns: dict[str, tuple[str, ...]] = {}

    def start(self, context: Context) -> None:
        """Set windows by the measured rates; take calibration and channels."""
        super().start(context)
        p, s = self.params, self.state[0]
        self.state[:] = np.zeros(1, self.dtype)
        self._columns = {name: c[0].columns for name, c in context.channels.items() if c}
        rate = p.rate_hz or context.rate_hz("acc") or 50.0
        steps.configure(s, p, rate)
        lengths.configure(s, p)
        turns = context.has("gyr") or not any(one.name == "gyr" for one in self.inputs)
        s["has_mag"] = context.has("mag") and p.magnetometer != "off"
        configure_attitude(self.name, s, p, rate, turns)
        for i, one in enumerate(self.inputs):
            s["role"][i] = ROLES[one.name]
        s["mode"] = direction.MODES.index(p.heading)
        s["declination"] = math.radians(p.declination_deg)
        mag_hz = context.rate_hz("mag") or rate
        s["median_w"] = min(64, max(1, round(p.median_s * min(mag_hz, rate))))
        s["fused"], s["has_gyr"] = self.fused, context.has("gyr")
        calibrated = self._calibrate(context, s)
        if turns and (p.magnetometer == "start" or (p.magnetometer == "auto" and not calibrated)):
            s["tau_mag"] = 1e5
        sigma = math.radians(p.sigma_heading_deg or (15.0 if calibrated or not s["has_mag"] else 35.0))
        mixture.configure(
            s,
            heading_known=not self.fused,
            sigma_heading=sigma,
            sigma_scale=p.sigma_scale,
            sigma_drift=drift_sd(p, rate) * (1.0 if s["tau_mag"] > 1e4 or not s["has_mag"] else 0.1),
        )
        if self.fused and s["has_mag"]:
            mixture.weigh(s, 0.0, sigma, 0.05 if calibrated else 0.2)
        alone = 1.0 if turns else FIELD_ALONE
        s["q_length"], s["q_heading"] = p.sigma_length, math.radians(alone * p.sigma_step_deg)
        s["q_turn"], s["q_scale"] = math.radians(alone * p.sigma_turn_deg), 0.003
        s["q_drift"] = 2e-5
        if self.fused:
            s["gm_share"], s["gm_tau"], s["outlier"] = p.gnss_slow_share, p.gnss_tau_s, p.outlier
            s["sd_default"], s["sd_min"] = p.gnss_sd_m, p.gnss_sd_min_m
            s["sd_velocity"] = p.gnss_velocity_sd

    def _calibrate(self, context: Context, s: Any) -> bool:
        """Write the calibrated field's strength into the state; return whether there is a calibration."""
        field_t = calibrated_field(context)
        if field_t is None:
            return False
        s["ref_norm"] = field_t
        return True

    def take(self, message: Message) -> list[Result]:
        """Take one message, return its results."""
        import polars as pl

        index = next(i for i, one in enumerate(self.inputs) if one.name == message.input)
        columns = self.inputs[index].columns
        if columns == ALL_COLUMNS:
            columns = self._columns[message.input]
        row = dict(zip(columns, message.values, strict=True))
        values = self.encode(
            index, 0, pl.DataFrame({"t_ns": [message.t_ns], **{c: [v] for c, v in row.items()}})
        )
        whose, when = np.zeros(self.max_results, np.int64), np.zeros(self.max_results, np.int64)
        out = np.full((self.max_results, self.width), np.nan)
        place = np.array([index]), np.array([0]), np.array([message.t_ns], np.int64)
        count = self.run(self.state, *place, values, whose, when, out)
        return self.results(when[:count], out[:count])

    def encode(self, index: int, channel: int, table: pl.DataFrame) -> FloatArray:
        """Return the values of messages; of fixes position, deviation an axis and declination there."""
        if self.inputs[index].name != "gnss":
            return super().encode(index, channel, table)
        return encode_fixes(table)

    def remarks(self) -> list[Remark]:
        """Say what a user must know."""
        s = self.state[0]
        remarks = steps.step_remarks(s)
        if s["mode"] == direction.MAGNETOMETER and s["steps"] and s["tilted"] > 0.5 * s["steps"]:
            remarks.append(
                Remark(
                    "not_level",
                    f"at {int(s['tilted'])} of {int(s['steps'])} steps the screen did not look up: eq 3.17 has no "
                    "heading for a phone in a pocket, at the ear or on an arm; take phone.pdr there",
                    fatal=True,
                )
            )
        if s["has_gyr"] and s["gyr_ns"] == 0:
            remarks.append(Remark("no_gyroscope", "no sample of the gyroscope arrived: headings stand still"))
        if s["mag_alone"]:
            remarks.append(
                Remark(
                    "no_gyroscope",
                    "there is no gyroscope: inclination and heading are those of the force and the field, for a "
                    "phone that is carried steadily, away from iron; the stated deviations are larger",
                )
            )
        if s["steps"] and s["doubt"] > DOUBTFUL * s["steps"]:
            remarks.append(
                Remark(
                    "direction_doubtful",
                    f"at {int(s['doubted'])} of {int(s['steps'])} steps the phone did not point ahead (the offset "
                    f"found from the motion is {math.degrees(s['offset']):.0f}° at the end): with probability "
                    f"{s['doubt'] / s['doubted']:.2f} the way is the opposite one"
                    + ("" if self.fused else "; the stated sigma includes it, fixes decide it: phone.fused"),
                )
            )
        if s["turned_about"]:
            remarks.append(
                Remark(
                    "direction_changed",
                    f"{int(s['turned_about'])} times the walking direction that is found from the motion, or whether "
                    "the phone points ahead, changed: the phone was moved, or what came before was wrong",
                )
            )
        if not s["has_mag"] and not self.fused:
            remarks.append(
                Remark("heading_relative", "no magnetometer is used: x is the direction of the first step")
            )
        elif s["tau_mag"] > 1e4 and not self.fused and s["mode"] < direction.MAGNETOMETER:
            remarks.append(
                Remark(
                    "mag_uncalibrated",
                    "the magnetometer is not calibrated: north is what it showed before the first step",
                )
            )
        if not np.isfinite(s["mean"]).all():
            remarks.append(Remark("diverged", "the track is not finite", fatal=True))
        if self.fused:
            if s["fixes"] == 0:
                remarks.append(
                    Remark("no_fixes", "no fix arrived: the track has no place on the Earth", fatal=True)
                )
            if s["relocated"]:
                remarks.append(
                    Remark(
                        "relocated",
                        f"{int(s['relocated'])} times ten fixes in a row lay off: begun anew there",
                    )
                )
            if s["lost_fixes"]:
                remarks.append(
                    Remark("lost_fixes", f"{int(s['lost_fixes'])} fixes came too fast and are left out")
                )
        return remarks


def configure_attitude(name: str, s: Any, p: PdrParams, rate: float, turns: bool) -> None:
    """Configure the attitude in record ``s``; ``turns``: whether a gyroscope is there.

    Raises
    ------
    AlgorithmError
        There is neither a gyroscope nor a magnetometer: no heading can be had.
    """
    if turns:
        attitude.configure(s, rate, tau_acc=p.tau_acc_s, tau_mag=p.tau_mag_s)
    elif s["has_mag"] and p.heading != "gyroscope":
        attitude.without_gyroscope(s, rate)
    else:
        raise AlgorithmError(
            f"{name} needs a gyroscope{'' if p.heading == 'gyroscope' else ' or a magnetometer'} beside the "
            "accelerometer for its headings; phone.steps counts steps without"
        )


def drift_sd(p: PdrParams, rate_hz: float) -> float:
    """Return the standard deviation of the gyroscope's bias about the vertical (rad/s) at this rate."""
    return p.sigma_drift * max(1.0, 30.0 / rate_hz)


def calibrated_field(context: Context) -> float | None:
    """Return the field's strength (T; 0 unknown) by the calibration of the attached magnetometer, None without one.

    The readings themselves arrive corrected: who feeds an estimator applies offset and matrix beforehand.
    """
    topics = [c.topic for c in context.channels.get("mag", ())]
    for one in context.calibrations.values():
        if one.kind == "magnetometer" and one.usable and topics and one.subject in ("", topics[0]):
            return float(one.values.get("field_t") or 0.0)
    return None


def encode_fixes(table: pl.DataFrame) -> FloatArray:
    """Return ``lat (rad), lon (rad), alt (m), sd an axis (m), declination (rad)`` of fixes; NaN where none."""
    n = table.height

    def column(name: str) -> FloatArray:
        if name not in table.columns:
            return np.full(n, np.nan)
        return table[name].cast(float).fill_null(float("nan")).to_numpy()

    lat, lon, alt = column("lat_deg"), column("lon_deg"), column("alt_m")
    status = column("status")
    lat = np.where(status < 0, np.nan, lat)
    sd = np.sqrt((column("sd_east_m") ** 2 + column("sd_north_m") ** 2) / 2)
    times = table["t_ns"].to_list() if "t_ns" in table.columns else [0] * n
    turn = [
        geodesy.declination(a, b, c, t) if np.isfinite(a) and np.isfinite(b) else math.nan
        for a, b, c, t in zip(lat.tolist(), lon.tolist(), alt.tolist(), times, strict=True)
    ]
    return np.column_stack((np.radians(lat), np.radians(lon), alt, sd, np.array(turn)))


class PhonePdr(PhoneTrack):
    """Dead reckoning without fixes: VQF's attitude, steps by rhythm, walking direction, length by cadence.

    Position: eq 3.20 of the phone dissertation with headings from x to y. Without a magnetometer x is the
    direction of the first step, else x is east and y north (magnetic, but for ``declination_deg``). The stated
    sigma follows from those of lengths and headings (``sigma_*``). Height from the barometer where there is one.
    """

    name: ClassVar[str] = "phone.pdr"
    title: ClassVar[str] = "steps, heading and length to a local track, without fixes"
    source: ClassVar[str] = "phone dissertation, eq 3.20; attitude: Laidig and Seel 2023; the rest ours"
    Params = PdrParams
    inputs = (GYR, ACC, MAG, PRESSURE)
    outputs = (STEP, POSE, SIGMA, HEADING, DETECTOR, STATE)


class SourceParams(PdrParams, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The dissertation's choices."""

    method: Annotated[
        Literal[
            "best", "peaks", "gates", "tied", "zero-crossing", "threshold", "autocorrelation", "spectral"
        ],
        meta("Detector of steps", source="phone dissertation, section 3.1.2"),
    ] = "peaks"
    length: Annotated[
        Literal["cadence", "static", "linear", "weinberg", "kim", "scarlett", "equal"],
        meta("Model of a step's length", source="phone dissertation, eq 3.16"),
    ] = "scarlett"
    heading: Annotated[
        Literal["auto", "device", "walking", "magnetometer", "tilt-compensated", "gyroscope"],
        meta("Heading", source="phone dissertation, eq 3.17"),
    ] = "magnetometer"


class PhonePdrSource(PhoneTrack):
    """The dissertation's chain, causal: peaks and valleys, Scarlett with K = 1.5, raw magnetic heading.

    Eqs 3.1–3.9, 3.16 (with the division by N that the print lacks), 3.17 in Android's axes with a trailing
    median (section 2.4.5) and 3.20. Intervals' statistics are those so far; :mod:`.source` has the batch form,
    with the centred median. No declination is taken off unless it is given.
    """

    name: ClassVar[str] = "phone.pdr-source"
    title: ClassVar[str] = "the dissertation's local track: peaks and valleys, Scarlett, magnetometer"
    source: ClassVar[str] = "phone dissertation, eqs 3.1–3.20"
    Params = SourceParams
    inputs = (ACC, Input("mag", MAG.schema, MAG.columns, regular=True))
    outputs = (STEP, POSE, SIGMA, HEADING, DETECTOR, STATE)


class PhoneFused(PhoneTrack):
    """Steps, headings and fixes by their stated accuracy, causal.

    A mixture of Kalman filters over position, heading correction, length scale and the fixes' slow error (see
    :mod:`.mixture`): a lost signal is bridged by steps, an outlier does not bend the track, an unknown initial
    heading is found. x east, y true north of the tangent plane at the first fix; declination there by the World
    Magnetic Model. A fix is used when the steps up to its time are known, 1 to 5 s late.
    """

    name: ClassVar[str] = "phone.fused"
    title: ClassVar[str] = "steps, heading and GNSS fixes fused, causal"
    source: ClassVar[str] = "ours; data association: Bar-Shalom et al. 2009"
    Params = PhoneFusedParams
    inputs = (GYR, ACC, MAG, PRESSURE, GNSS, VELOCITY)
    outputs = (STEP, POSE, SIGMA, HEADING, DETECTOR, STATE, FIX)
    fused: ClassVar[bool] = True
