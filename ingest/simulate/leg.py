"""Simulated captures of trunk and legs: inertial sensors, joint encoders and cameras, with the truth.

:func:`leg` gives arrays; :func:`marcha.ingest.simulate.simulate` writes the same capture as raw logs.
A segment has x to the right (the flexion axis), y forward, z up; a joint's angle is the roll of its upper
segment minus that of its lower one (knee flexion is positive).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from ...recording.errors import UsageError
from ..checks import STANDARD_GRAVITY
from .legmotion import PERSON, SIDES, Body, Chain, FloatArray, MotionTask, Pose, derivatives
from .sensors import IDEAL, ImuErrors, SimulatedImu
from .tissue import SoftTissue, tissue
from .walks import checked, plain

SCENARIOS: dict[str, str] = {
    "walking": "trunk and legs, level walking: exoskeleton capture, encoders, cameras",
    "sit-to-stand": "trunk and legs, standing up and sitting down",
    "squats": "trunk and legs, squats",
}
"""Scenarios of legs: name to one line."""

JOINTS = {"hip": ("trunk", "thigh"), "knee": ("thigh", "shank"), "ankle": ("shank", "foot")}
"""Joints: upper and lower segment."""

_Positive = Annotated[float, msgspec.Meta(gt=0)]
_NonNegative = Annotated[float, msgspec.Meta(ge=0)]
Vector = tuple[float, float, float]

#: Table 5 of the source: variance of an accelerometer's angle (rad²), of a gyroscope's rate and of its bias'
#: drive ((rad/s)²), read as what a sample of a sensor has at 50 Hz.
SOURCE_ACC_VAR, SOURCE_GYR_VAR = 0.0014, 1e-7

NOISE: dict[str, ImuErrors] = {
    "source": ImuErrors(
        acc_noise=float(np.sqrt(SOURCE_ACC_VAR / 50.0) * STANDARD_GRAVITY),
        gyr_noise=float(np.sqrt(SOURCE_GYR_VAR / 50.0)),
        acc_bias_sigma=0.05,
        gyr_bias_sigma=0.01,
        acc_bias_walk=0.0,
        gyr_bias_walk=float(np.sqrt(SOURCE_GYR_VAR * 0.02)),
        quantize=False,
        clip=False,
    ),
    "mems": ImuErrors(gyr_bias_sigma=0.01, quantize=False, clip=False),
    "none": IDEAL,
}
"""Kinds of sensors: the variances of the source's table 5, those of an MPU-6050, or no error at all."""

_LEVERS: dict[str, Vector] = {
    "trunk": (0.0, -0.10, 0.25),
    "thigh": (0.07, 0.03, -0.22),
    "shank": (0.05, 0.02, -0.20),
    "foot": (0.0, 0.08, -0.03),
}
"""Where a sensor sits on its segment (m): outwards, forward, up from the proximal joint."""
_TISSUE = {"trunk": 0.5, "thigh": 1.0, "shank": 0.5, "foot": 0.2}
"""Share of the soft tissue's motion on each segment."""


class LegOptions(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Everything that can be chosen about a simulated capture of legs, beside scenario and seed.

    Attributes
    ----------
    duration_s, rest_s, cycle_s : float
        Length, rest at its start and end, mean time of a cycle (s; default by scenario).
    cycle_sd : float
        Relative standard deviation of time and depth from cycle to cycle.
    range_scale : float
        Factor of all flexion angles.
    off_plane_deg, knee_varus_deg, knee_axial_deg, turn_deg_s : float
        Motion out of the sagittal plane; see :class:`marcha.ingest.simulate.legmotion.MotionTask`. With a varus
        and axial rotation of 0 the knee is a hinge.
    sides : str
        ``left``, ``right`` or ``both``: names are ``thigh`` of one leg, ``left_thigh`` of two.
    segments : tuple of str
        Which segments carry a sensor.
    rate_hz : float
        Rate of the inertial sensors and encoders.
    gravity : float
        Local gravity (m/s²).
    noise : str
        ``source``, ``mems`` or ``none``, see :data:`NOISE`; ``imu`` replaces it.
    mount_deg : float
        Standard deviation, per axis, of each sensor's mounting against its segment.
    mounting : str
        ``nominal``: the sensor's axes are the segment's but for ``mount_deg``; ``random``: any attitude.
    lever_m : float
        Standard deviation of each sensor's place on its segment (m).
    soft_tissue : float
        0 none; 1 about what muscle and fat of a thigh do (some millimetres and degrees at heel contact).
    encoder_offset_deg, encoder_misalignment_deg, encoder_eccentric_m, encoder_noise_deg, encoder_counts
        Error of the encoder's zero; tilt of its axis; how far its axis lies from the joint's (forward, up;
        m); noise; counts of a turn (0: not rounded).
    optical_rate_hz, optical_noise_m : float
        Rate of the cameras and noise of a marker's coordinate (m).
    optical_offset_s, optical_drift_ppm : float
        The cameras' clock reads ``(t - optical_offset_s) (1 + optical_drift_ppm 1e-6)`` at time t of the
        inertial clock; it starts at zero.
    optical_start_s, optical_stop_s : float or None
        When the cameras run, on the inertial clock.
    dropout_share, dropout_s : float
        Share of the time in which a marker is hidden, and mean length of such a stretch (s).
    """

    duration_s: _Positive = 60.0
    rest_s: _NonNegative = 3.0
    cycle_s: _Positive | None = None
    cycle_sd: Annotated[float, msgspec.Meta(ge=0, le=0.2)] = 0.03
    range_scale: _Positive = 1.0
    off_plane_deg: _NonNegative = 5.0
    knee_varus_deg: float = 0.0
    knee_axial_deg: float = 0.0
    turn_deg_s: float = 0.0
    sides: Literal["left", "right", "both"] = "left"
    segments: tuple[Literal["trunk", "thigh", "shank", "foot"], ...] = ("trunk", "thigh", "shank", "foot")
    rate_hz: Annotated[float, msgspec.Meta(gt=0, le=1000)] = 50.0
    gravity: _Positive = STANDARD_GRAVITY
    noise: Literal["source", "mems", "none"] = "source"
    imu: ImuErrors | None = None
    mount_deg: _NonNegative = 3.0
    mounting: Literal["nominal", "random"] = "nominal"
    lever_m: _NonNegative = 0.01
    soft_tissue: _NonNegative = 0.0
    encoder_offset_deg: float = 0.0
    encoder_misalignment_deg: float = 0.0
    encoder_eccentric_m: tuple[float, float] = (0.0, 0.0)
    encoder_noise_deg: _NonNegative = 0.05
    encoder_counts: Annotated[int, msgspec.Meta(ge=0)] = 4096
    optical_rate_hz: Annotated[float, msgspec.Meta(gt=0, le=1000)] = 100.0
    optical_noise_m: _NonNegative = 0.0005
    optical_offset_s: float = 0.0
    optical_drift_ppm: float = 0.0
    optical_start_s: _NonNegative = 0.0
    optical_stop_s: _Positive | None = None
    dropout_share: Annotated[float, msgspec.Meta(ge=0, lt=1)] = 0.01
    dropout_s: _Positive = 0.3


@dataclass(frozen=True)
class SimulatedSegment:
    """One sensor and its segment, at the inertial sample times.

    Attributes
    ----------
    acc_b, gyr_b : ndarray
        What the sensor reports: specific force (m/s²), angular rate (rad/s), (n, 3).
    true_acc_b, true_gyr_b : ndarray
        The same without the sensor's errors (soft tissue and mounting are in both).
    pos, rot_ns : ndarray
        True position of the segment's proximal joint (m) and attitude of the segment, (n, 3) and (n, 3, 3).
    roll, pitch, yaw : ndarray
        True angles of the segment (rad), ``rot_ns = Rz(yaw) PERSON Ry(pitch) Rx(roll)``; roll is the flexion
        angle.
    rot_nb : ndarray
        True attitude of the sensor, soft tissue included.
    rot_sb : ndarray
        Mounting: takes vectors of the sensor to the segment, (3, 3).
    lever_s : ndarray
        Place of the sensor on the segment (m), from its proximal joint.
    axis_b : ndarray
        Flexion axis in the sensor's frame, (3,).
    bias_acc, bias_gyr : ndarray
        Bias at the first sample.
    """

    acc_b: FloatArray
    gyr_b: FloatArray
    true_acc_b: FloatArray
    true_gyr_b: FloatArray
    pos: FloatArray
    rot_ns: FloatArray
    roll: FloatArray
    pitch: FloatArray
    yaw: FloatArray
    rot_nb: FloatArray
    rot_sb: FloatArray
    lever_s: FloatArray
    axis_b: FloatArray
    bias_acc: FloatArray
    bias_gyr: FloatArray


@dataclass(frozen=True)
class Joint:
    """One joint, at the inertial sample times.

    Attributes
    ----------
    upper, lower : str
        Names of the segments.
    angle : ndarray
        True angle: the turn of the lower segment about the joint's axis against the upper one, with the
        source's sign (roll of the upper minus roll of the lower); knee flexion is positive (rad).
    encoder : ndarray
        What the encoder reports (rad).
    axis_upper_b, axis_lower_b : ndarray
        The joint's axis in the frame of each sensor; NaN where a segment carries none.
    from_joint_upper_b, from_joint_lower_b : ndarray
        Vector from the joint's centre to each sensor, in that sensor's frame (m): the o of Seel's equations.
    """

    upper: str
    lower: str
    angle: FloatArray
    encoder: FloatArray
    axis_upper_b: FloatArray
    axis_lower_b: FloatArray
    from_joint_upper_b: FloatArray
    from_joint_lower_b: FloatArray


@dataclass(frozen=True)
class Optical:
    """What the cameras saw, and the truth at their times.

    Attributes
    ----------
    t_ns : ndarray
        Time on the cameras' own clock.
    t : ndarray
        The same instants on the inertial clock (s).
    names : tuple of str
        Markers.
    pos : ndarray
        Positions in n (m), (n, markers, 3); NaN where a marker was hidden.
    rot_ns : dict of str to ndarray
        True attitude of each segment.
    angle : dict of str to ndarray
        True angle of each joint (rad).
    """

    t_ns: NDArray[np.int64]
    t: FloatArray
    names: tuple[str, ...]
    pos: FloatArray
    rot_ns: dict[str, FloatArray]
    angle: dict[str, FloatArray]


class LegCapture:
    """A simulated capture; parts are made when they are asked for. Equal seed and options: equal bits.

    Parameters
    ----------
    scenario : str
        A key of :data:`SCENARIOS`.
    seed : int
        Of all random numbers.
    options : LegOptions
        Everything else.
    """

    def __init__(self, scenario: str, seed: int, options: LegOptions) -> None:
        self.scenario, self.seed, self.options = scenario, seed, options
        o = options
        task = MotionTask(
            scenario,
            duration_s=o.duration_s,
            rest_s=min(o.rest_s, o.duration_s / 2),
            cycle_s=o.cycle_s or {"walking": 1.1, "sit-to-stand": 6.0, "squats": 4.0}[scenario],
            spread=o.cycle_sd,
            range_scale=o.range_scale,
            off_plane_deg=o.off_plane_deg,
            knee_varus_deg=o.knee_varus_deg,
            knee_axial_deg=o.knee_axial_deg,
            turn_deg_s=o.turn_deg_s,
            rng=self._rng("task"),
        )
        self.chain = Chain(task, Body())
        self.t: FloatArray = np.arange(np.floor(o.duration_s * o.rate_hz + 1e-9)) / o.rate_hz
        self.t_ns: NDArray[np.int64] = np.round(self.t * 1e9).astype(np.int64)

    @property
    def cycle_starts_s(self) -> FloatArray:
        """Start of every cycle and end of the last (s): heel contact of the left foot where it walks."""
        return self.chain.task.starts

    @property
    def sides(self) -> tuple[str, ...]:
        """Sides that are captured."""
        return tuple(SIDES) if self.options.sides == "both" else (self.options.sides,)

    def _named(self, part: str, side: str) -> str:
        return part if part == "trunk" or self.options.sides != "both" else f"{side}_{part}"

    def _key(self, name: str) -> str:
        """Return the chain's name of a segment."""
        return name if name == "trunk" or "_" in name else f"{self.sides[0]}_{name}"

    def _rng(self, part: str) -> np.random.Generator:
        return np.random.default_rng([self.seed, *part.encode()])

    @cached_property
    def segments(self) -> dict[str, SimulatedSegment]:
        """Every segment that carries a sensor."""
        names = dict.fromkeys(self._named(p, side) for side in self.sides for p in self.options.segments)
        mounts = {name: self._mount(name) for name in names}
        soft = {name: self._tissue(name, *mounts[name]) for name in names}

        def sensors(t: FloatArray) -> dict[str, Pose]:
            poses, out = self.chain.pose(t), {}
            for name in names:
                segment, (rot_sb, lever) = poses[self._key(name)], mounts[name]
                shift, turn = soft[name].at(t)
                pos = segment.pos + np.einsum("nij,nj->ni", segment.rot, lever + shift)
                out[name] = Pose(pos, segment.rot @ turn @ rot_sb)
            return out

        truth = self.chain.pose(self.t)
        return {
            name: self._segment(name, truth[self._key(name)], *mounts[name], *moved)
            for name, moved in derivatives(sensors, self.t).items()
        }

    def _segment(
        self,
        name: str,
        truth: Pose,
        rot_sb: FloatArray,
        lever: FloatArray,
        pos: FloatArray,
        rot_nb: FloatArray,
        acc_n: FloatArray,
        gyr_b: FloatArray,
    ) -> SimulatedSegment:
        del pos
        force = np.einsum("nji,nj->ni", rot_nb, acc_n + np.array([0.0, 0.0, self.options.gravity]))
        errors = self.options.imu or NOISE[self.options.noise]
        imu = SimulatedImu(errors, self.options.rate_hz, 1e-9, 1e-9, self._rng(f"imu {name}"))
        reading = imu.read(force, gyr_b)
        roll, pitch, yaw = euler(truth.rot)
        return SimulatedSegment(
            acc_b=reading[:, :3],
            gyr_b=reading[:, 3:],
            true_acc_b=force,
            true_gyr_b=gyr_b,
            pos=truth.pos,
            rot_ns=truth.rot,
            roll=roll,
            pitch=pitch,
            yaw=yaw,
            rot_nb=rot_nb,
            rot_sb=rot_sb,
            lever_s=lever,
            axis_b=rot_sb[0],
            bias_acc=imu.turn_on_bias[:3],
            bias_gyr=imu.turn_on_bias[3:],
        )

    def _mount(self, name: str) -> tuple[FloatArray, FloatArray]:
        """Return mounting ``rot_sb`` and place of a sensor."""
        from scipy.spatial.transform import Rotation

        rng, o = self._rng(f"mount {name}"), self.options
        turn = np.radians(o.mount_deg) * rng.standard_normal(3)
        any_way, shift = rng.standard_normal(4), o.lever_m * rng.standard_normal(3)
        rot = Rotation.from_rotvec(turn)
        if o.mounting == "random":
            rot = rot * Rotation.from_quat(any_way)
        side = "right" if self._key(name).startswith("right") else "left"
        return rot.as_matrix(), np.asarray(_LEVERS[name.split("_")[-1]]) * (SIDES[side], 1.0, 1.0) + shift

    def _tissue(self, name: str, rot_sb: FloatArray, lever: FloatArray) -> SoftTissue:
        del rot_sb
        amount = self.options.soft_tissue * _TISSUE[name.split("_")[-1]]
        return tissue(lambda t: self.chain.pose(t)[self._key(name)], lever, amount, self.options.duration_s)

    @cached_property
    def joints(self) -> dict[str, Joint]:
        """Every joint of the captured sides: ``hip``, ``knee``, ``ankle`` (``left_knee`` … of two legs)."""
        poses = self.chain.pose(self.t)
        return {
            self._named(joint, side): self._joint(joint, self._named(up, side), self._named(low, side), poses)
            for side in self.sides
            for joint, (up, low) in JOINTS.items()
        }

    def _joint(self, joint: str, upper: str, lower: str, poses: dict[str, Pose]) -> Joint:
        up, low = poses[self._key(upper)], poses[self._key(lower)]
        angle = joint_angle(up.rot, low.rot)
        nan = np.full(3, np.nan)
        side = self._key(lower).split("_")[0]
        hip = 0.5 * self.chain.body.hips_m * SIDES[side]
        centre = {  # of the joint, from the upper segment's proximal joint, in its frame
            "hip": (hip, 0.0, 0.0),
            "knee": (0.0, 0.0, -self.chain.body.thigh_m),
            "ankle": (0.0, 0.0, -self.chain.body.shank_m),
        }[joint]
        u, v = self.segments.get(upper), self.segments.get(lower)
        return Joint(
            upper=upper,
            lower=lower,
            angle=angle,
            encoder=self._encoder(f"{side} {joint}", up.rot, low.rot),
            axis_upper_b=nan if u is None else u.axis_b,
            axis_lower_b=nan if v is None else v.axis_b,
            from_joint_upper_b=nan if u is None else (u.lever_s - centre) @ u.rot_sb,
            from_joint_lower_b=nan if v is None else v.lever_s @ v.rot_sb,
        )

    def _encoder(self, name: str, upper: FloatArray, lower: FloatArray) -> FloatArray:
        """Return what the encoder reports: twist about its tilted axis, off-centre, offset, noise."""
        from scipy.spatial.transform import Rotation

        rng, o = self._rng(f"encoder {name}"), self.options
        tilt = np.radians(o.encoder_misalignment_deg)
        where = rng.uniform(0, 2 * np.pi)
        axis = np.array([np.cos(tilt), np.sin(tilt) * np.cos(where), np.sin(tilt) * np.sin(where)])
        quat = Rotation.from_matrix(np.swapaxes(upper, -1, -2) @ lower).as_quat(canonical=True)
        angle = -2 * np.arctan2(quat[:, :3] @ axis, quat[:, 3])
        ex, ez = o.encoder_eccentric_m
        if ex or ez:  # a bar from the encoder's centre to a cuff 0.25 m below the joint
            cuff_y, cuff_z = -0.25 * np.sin(angle) - ex, -0.25 * np.cos(angle) - ez
            at_zero = np.arctan2(ex, 0.25 + ez)
            angle = np.unwrap(np.arctan2(-cuff_y, -cuff_z)) - at_zero
        angle = angle + np.radians(
            o.encoder_offset_deg + o.encoder_noise_deg * rng.standard_normal(angle.size)
        )
        if o.encoder_counts:
            lsb = 2 * np.pi / o.encoder_counts
            angle = np.round(angle / lsb) * lsb
        return angle

    @cached_property
    def optical(self) -> Optical:
        """What the cameras saw."""
        from .legoptical import capture

        return capture(self)


def joint_angle(rot_upper: FloatArray, rot_lower: FloatArray) -> FloatArray:
    """Return the source's joint angle (rad): the lower segment's turn about x against the upper, negated.

    Shapes: both (…, 3, 3), result (…,).

    First angle of the sequence x, y, z from the upper to the lower segment; for a hinge about x it is the
    difference of the rolls.
    """
    rel = np.swapaxes(rot_upper, -1, -2) @ rot_lower
    return np.arctan2(rel[..., 1, 2], rel[..., 2, 2])


def euler(rot_ns: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return roll and pitch (rad) of a segment, those of an accelerometer at rest, and its heading.

    Shapes: ``rot_ns`` (n, 3, 3), results (n,) in rad.
    """
    own = PERSON.T @ rot_ns
    roll = np.arctan2(own[..., 2, 1], own[..., 2, 2])
    pitch = np.arctan2(-own[..., 2, 0], np.hypot(own[..., 2, 1], own[..., 2, 2]))
    return roll, pitch, np.unwrap(np.arctan2(own[..., 1, 0], own[..., 0, 0]))


def leg(scenario: str = "walking", *, seed: int = 0, **options: Any) -> LegCapture:
    """Simulate a capture of trunk and legs as arrays.

    Parameters
    ----------
    scenario : str
        A key of :data:`SCENARIOS`.
    seed : int
        Of all random numbers.
    **options
        Fields of :class:`LegOptions`, values also as text.

    Returns
    -------
    LegCapture
        ``t``, ``segments``, ``joints`` and ``optical``.

    Raises
    ------
    UsageError
        Unknown scenario or option, or a value that breaks its rule.
    """
    if scenario not in SCENARIOS:
        raise UsageError(f"scenario {scenario!r} is unknown: choose one of {', '.join(SCENARIOS)}")
    values = {name: plain(value) for name, value in options.items()}
    if isinstance(values.get("segments"), str):
        values["segments"] = [values["segments"]]
    return LegCapture(scenario, seed, checked(scenario, LegOptions, values))
