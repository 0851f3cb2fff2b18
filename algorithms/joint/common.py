"""What joint estimators share: inputs by segment, the encoder's columns, mountings, remarks about the sensors."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
import numpy as np

from ..contract import (
    ALL_COLUMNS,
    AlgorithmError,
    ChannelInfo,
    Context,
    FloatArray,
    Input,
    KernelEstimator,
    Remark,
)
from ..parameters import meta
from . import handedness, merge
from .merge import ENCODER, JOINTS, SEGMENTS

if TYPE_CHECKING:
    import polars as pl

OTHER_AXIS_DEG = 45.0
"""A joint that turns about an axis so far off the one that is used is not the joint whose angle is drawn."""
IMU_COLUMNS = ("acc_x", "acc_y", "acc_z", "gyr_x", "gyr_y", "gyr_z")


def imu(name: str, optional: bool = False) -> Input:
    """Return the input of a segment's sensor."""
    return Input(name, "sensor_msgs/msg/Imu", IMU_COLUMNS, optional=optional, regular=True)


def encoder(optional: bool = False) -> Input:
    """Return the input of the joints' encoders."""
    return Input("encoder", "sensor_msgs/msg/JointState", ALL_COLUMNS, optional=optional)


class MergeParams(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How sensors of different rates meet, and how they sit on their segments."""

    hold_s: Annotated[
        float,
        meta(
            "How long a sample of the first segment waits for the other sensors before they count as missing",
            "s",
            "ours",
            gt=0.0,
            le=10.0,
        ),
    ] = 0.25
    gap_s: Annotated[
        float,
        meta(
            "Longest pause that is interpolated; after a longer one a segment begins anew",
            "s",
            "ours",
            gt=0.0,
        ),
    ] = 0.2
    gravity: Annotated[float, meta("Local gravity", "m/s²", "source", gt=0.0, le=30.0)] = 9.81
    axis: Annotated[
        str,
        meta(
            "Flexion axis in the frame of every sensor: x, -x, y … or three numbers; per segment after its name "
            "(thigh=x shank=-y). Empty: not stated; x is taken, and of a hinge that is found what the sensors show. A "
            "joint calibration goes before it",
            source="source: x",
        ),
    ] = ""
    up: Annotated[
        str,
        meta(
            "Long axis of the segment, upwards, in the sensor's frame, written as axis; empty: z for axis x, "
            "x for y, y for z",
            source="source: z",
        ),
    ] = ""


def vector(text: str, name: str) -> FloatArray:
    """Return the unit vector that ``text`` names: ``x``, ``-z``, ``0.1,0.9,0``."""
    plain = text.strip().lstrip("+")
    sign = -1.0 if plain.startswith("-") and plain[1:] in ("x", "y", "z") else 1.0
    word = plain.lstrip("-")
    if word in ("x", "y", "z"):
        return sign * np.eye(3)["xyz".index(word)]
    try:
        values = np.array([float(part) for part in plain.replace(",", " ").split()])
    except ValueError:
        values = np.zeros(0)
    if values.shape != (3,) or not np.isfinite(values).all() or np.linalg.norm(values) < 1e-6:
        raise AlgorithmError(
            f"{name} = {text!r} is no direction; must be x, -x, y, -y, z, -z or three numbers like 0.1,0.9,0"
        )
    return values / np.linalg.norm(values)


def per_segment(text: str, segment: str) -> str:
    """Return the part of ``text`` that is about ``segment``: ``thigh=x shank=-y`` or one for all."""
    if "=" not in text:
        return text
    parts = dict(part.split("=", 1) for part in text.split() if "=" in part)
    unknown = sorted(set(parts) - {*SEGMENTS, "imu"})
    if unknown:
        raise AlgorithmError(f"axis: no segment {unknown[0]!r}; must be one of {', '.join(SEGMENTS)}")
    return parts.get(segment, "")


def mount_of(axis: FloatArray, up: FloatArray | None) -> FloatArray:
    """Return the rotation from sensor to segment, rows x = flexion axis, y, z = long axis made square to it."""
    if up is not None:
        long = up
    elif np.abs(axis).max() > 0.999:
        long = np.abs(np.roll(axis, 2))
    else:
        long = np.eye(3)[int(np.argmin(np.abs(axis)))]
    z = long - (long @ axis) * axis
    if np.linalg.norm(z) < 0.1:
        raise AlgorithmError("up lies along axis; they must be two directions at least 6° apart")
    z = z / np.linalg.norm(z)
    return np.array([axis, np.cross(z, axis), z])


def mounts(params: Any, segments: Sequence[str], context: Context | None) -> FloatArray:
    """Return sensor-to-segment rotations (n, 3, 3): by the joint calibration, else by the parameters."""
    result = np.zeros((len(segments), 3, 3))
    for i, segment in enumerate(segments):
        mount = calibrated_mount(context, segment)
        result[i] = given_mount(params, segment) if mount is None else mount
    return result


def calibrated_mount(context: Context | None, segment: str) -> FloatArray | None:
    """Return the sensor-to-segment rotation (3, 3) of the joint calibration; None where it has none."""
    calibration = context.calibrations.get("joint") if context is not None else None
    key = f"rot_sb_{segment}"
    if calibration is None or not calibration.usable or key not in calibration.values:
        return None
    return calibration.array(key)


def given_mount(params: Any, segment: str) -> FloatArray:
    """Return the sensor-to-segment rotation (3, 3) that the parameters ``axis`` and ``up`` say."""
    axis = vector(per_segment(params.axis, segment) or "x", "axis")
    up = per_segment(params.up, segment)
    return mount_of(axis, vector(up, "up") if up else None)


def states_axis(params: Any, segment: str, channels: Mapping[str, Sequence[ChannelInfo]]) -> bool:
    """Return whether the parameter ``axis``, or the recording (axes = segment), says how a sensor's axes lie."""
    in_segment = any(c.metadata.get("axes") == "segment" for c in channels.get(segment, ()))
    return in_segment or bool(per_segment(params.axis, segment))


def joint_name(upper: str, lower: str) -> str:
    """Return the name of the joint between two segments: hip, knee, ankle, or both names."""
    a, b = (SEGMENTS.index(s) if s in SEGMENTS else -9 for s in (upper, lower))
    return JOINTS[a] if b == a + 1 and a >= 0 else f"{upper}-{lower}"


def mirrored_remark(segments: Sequence[str]) -> Remark:
    """Return the remark of sensors whose gyroscope contradicts their accelerometer."""
    return Remark(
        "sensor_mirrored",
        f"{' and '.join(segments)}: gravity turns against the gyroscope: left-handed axes (one axis mirrored) or the "
        "wrong sign of the gyroscope; its angles would be wrong",
        fatal=True,
    )


def side_of(context: Context, segments: Sequence[str]) -> str:
    """Return ``left_`` or ``right_`` where the channels are of one leg (``/leg/left_thigh/imu``), else empty."""
    topics = [c.topic for name in segments for c in context.channels.get(name, ())]
    parts = [part for topic in topics for part in topic.split("/")]
    return next((s for s in ("left_", "right_") if any(part.startswith(s) for part in parts)), "")


class JointEstimator(KernelEstimator):
    """Base of the joint estimators: which segments are there, the merging of their messages, remarks."""

    max_results = 2
    max_held = merge.RING + merge.LINE
    dtype: np.dtype[Any]
    lookahead = 0
    least = 1
    """Fewest segments that make sense."""

    def __init__(self, params: msgspec.Struct | None = None) -> None:
        super().__init__(params)
        self.segments: tuple[str, ...] = tuple(i.name for i in self.inputs if i.name != "encoder")
        self.encoder_columns: tuple[str, ...] = ()
        self.state = np.zeros(1, self.dtype)
        self.context = Context()
        self._lay(Context())

    def start(self, context: Context) -> None:
        """Take the segments that are attached, their mountings and calibrations."""
        super().start(context)
        self.context = context
        roles = [i.name for i in self.inputs if i.name != "encoder"]
        self.segments = tuple(n for n in roles if context.has(n)) or tuple(roles)
        if len(self.segments) < self.least:
            raise AlgorithmError(
                f"{self.name}: {len(self.segments)} segment attached ({', '.join(self.segments)}), needs at least "
                f"{self.least} of {', '.join(roles)}; attach one with --input NAME=TOPIC"
            )
        self.encoder_columns = context.channels["encoder"][0].columns if context.has("encoder") else ()
        self.state = np.zeros(1, self.dtype)
        self._lay(context)

    def joint_names(self) -> tuple[str, ...]:
        """Return the names of the joints between the attached segments, with the side that their topics name."""
        pairs = zip(self.segments, self.segments[1:], strict=False)
        return tuple(self.side + joint_name(a, b) for a, b in pairs)

    @property
    def side(self) -> str:
        """``left_`` or ``right_`` where the channels are of one leg, else empty."""
        return side_of(self.context, self.segments)

    def _lay(self, context: Context) -> None:
        s, p = self.state[0], self.params
        s["n"] = len(self.segments)
        s["on"][: len(self.segments)] = 1
        s["on"][ENCODER] = context.has("encoder")
        for index, need in enumerate(self.inputs):
            s["stream"][index] = (
                ENCODER
                if need.name == "encoder"
                else self.segments.index(need.name)
                if need.name in self.segments
                else 0
            )
        s["hold_ns"], s["gap_ns"] = round(p.hold_s * 1e9), round(p.gap_s * 1e9)
        s["lookahead"] = self.lookahead
        s["seen"] = merge.NEVER
        s["newest"] = merge.NEVER
        self.set_up(context)

    def set_up(self, context: Context) -> None:
        """Write parameters into the state and set ``outputs``."""

    def encode(self, index: int, channel: int, table: pl.DataFrame) -> FloatArray:
        """Return a channel's values; of an encoder those of the joints between the attached segments."""
        if self.inputs[index].name != "encoder":
            return super().encode(index, channel, table)
        out = np.full((table.height, 3), np.nan)
        columns = [c for c in table.columns if c not in ("t_ns", "t_log_ns")]
        names = self.encoder_columns or tuple(columns)
        plain = [i for i, c in enumerate(names) if not c.endswith((".vel", ".effort"))]
        joints = self.joint_names()
        for j, joint in enumerate(joints):
            fit = [i for i in plain if joint in names[i].lower()]
            if not fit and len(joints) == 1 and len(plain) == 1:
                fit = plain
            if fit and fit[0] < len(columns):
                out[:, j] = table[columns[fit[0]]].to_numpy()
        return out

    def finds_axes(self) -> bool:
        """Whether the axes are found from the motion; remarks on them are the estimator's own then."""
        return "learn" in (self.dtype.names or ()) and bool(self.state[0]["learn"])

    def _other_axes(self, pairs: Sequence[handedness.Neighbours | None]) -> list[Remark]:
        """Say where a joint turns about another axis than the one that is used."""
        used = mounts(self.params, self.segments, self.context)[:, 0]
        remarks = []
        for i, (joint, pair) in enumerate(zip(self.joint_names(), pairs, strict=True)):
            if pair is None or not pair.sharp:
                continue
            for name, axis, own in zip(self.segments[i : i + 2], pair.axes, used[i : i + 2], strict=True):
                off_deg = math.degrees(math.acos(min(1.0, abs(float(axis @ own)))))
                if off_deg <= OTHER_AXIS_DEG:
                    continue
                calibrated = calibrated_mount(self.context, name) is not None
                stated = calibrated or states_axis(self.params, name, self.context.channels)
                which = (
                    "the stated axis" if stated else "x, taken where axis is not stated: its angles are wrong"
                )
                remarks.append(
                    Remark(
                        "mounting_doubtful",
                        f"{joint}: the {name}'s sensor turns about {np.round(axis, 2).tolist()}, {off_deg:.0f}° off "
                        f"{which}; correct axis, or calibrate (marcha calibrate joint)",
                        fatal=not stated,
                    )
                )
        return remarks

    def snapshot(self) -> Any:
        """Return a copy of the packed state."""
        return self.state.copy()

    def remarks(self) -> list[Remark]:
        """Say which sensors were missing or dead."""
        s = self.state[0]
        total = int(s["samples"])
        remarks: list[Remark] = []
        if total == 0:
            return remarks
        if int(s["given"]) == 0 or ("on_line" in (self.dtype.names or ()) and s["on_line"] == 0):
            remarks.append(
                Remark(
                    "no_overlap",
                    f"{', '.join(self.segments)} have no time in common; align their clocks or choose other channels",
                    fatal=True,
                )
            )
        for i, name in enumerate(self.segments):
            if s["dead"][i] > 0.1 * total:
                remarks.append(
                    Remark(
                        "sensor_dead",
                        f"{name}: {int(s['dead'][i])} of {total} samples are exactly 0, gravity too: is the sensor "
                        "connected?",
                        fatal=True,
                    )
                )
            stuck = int(s["stuck"][i])
            if stuck and s["dead"][i] == 0:
                share = stuck / int(s["count"][i])
                moving = int(s["stuck_moving"][i]) / int(s["count"][i])
                remarks.append(
                    Remark(
                        "sensor_stuck",
                        f"{name}: {stuck} messages ({100 * share:.0f} %) repeat the one before exactly, for longer "
                        "than a second: the sensor did not answer, "
                        + (
                            "and the angles there are wrong"
                            if moving
                            else "or its filter hides that it rests"
                        ),
                        fatal=moving > 0.1,
                    )
                )
        hand = int(s["hand"]) if "hand" in (self.dtype.names or ()) else 0
        pairs = handedness.pairs_of(s, self.segments, self.params.gravity)
        mirrored = handedness.left_handed_of(s, self.segments, hand)
        mirrored = mirrored or handedness.left_handed_neighbours(pairs, self.segments)
        if mirrored:
            remarks.append(mirrored_remark(mirrored))
        elif not self.finds_axes():
            remarks += self._other_axes(pairs)
        streams: Mapping[int, str] = {**dict(enumerate(self.segments)), ENCODER: "encoder"}
        for i, name in streams.items():
            missed = int(s["missed"][i])
            if s["on"][i] and missed > max(2, total // 1000):
                remarks.append(
                    Remark(
                        "sensor_missing",
                        f"{name} had no value at {missed} of {total} samples of {self.segments[0]}; "
                        "its angles are left out there",
                    )
                )
        return remarks
