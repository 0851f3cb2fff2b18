"""Orientations of a chain and angles of its joints by rotations: ``joint.hinge`` and ``joint.relative``."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

import numpy as np

from ..contract import AlgorithmError, Context, FloatArray, Input, Output, Remark
from ..parameters import meta
from . import chain, chain_loop
from .chain_zero import spread_of_zero
from .common import JointEstimator, MergeParams, encoder, imu, mounts
from .source import JOINT_STATE, NAMED, axis_remarks, set_up_axes

QUATERNION = "geometry_msgs/msg/QuaternionStamped"
QUAT = ("quat_w", "quat_x", "quat_y", "quat_z")
LATE_S = 0.5
"""A hinge's angle that begins later is remarked."""
TYPES = ("hinge", "two-axis", "free")


class ChainParams(MergeParams, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Noise of the chain: white noise of sensors, coloured noise of motion, both independent of the rate."""

    sd_gyr: Annotated[
        float, meta("Noise of the angular rate, with what the bias model leaves", "rad/s/√Hz", "ours", gt=0.0)
    ] = 0.002
    grow_gyr: Annotated[
        float, meta("Growth of that noise with the rate (scale, clipping)", "1/√Hz", "ours", ge=0.0)
    ] = 0.01
    sd_bias: Annotated[float, meta("Gyroscope bias at the start", "rad/s", "ours", gt=0.0)] = 0.01
    walk_bias: Annotated[float, meta("Random walk of the bias", "rad/s/√s", "ours", ge=0.0)] = 1e-4
    sd_force: Annotated[float, meta("Acceleration of a segment in gravity's row", "m/s²", "ours", gt=0.0)] = (
        0.5
    )
    tau_force: Annotated[float, meta("Correlation time of that acceleration", "s", "ours", gt=0.0)] = 0.2
    grow_force: Annotated[float, meta("Growth of sd_force with |‖f‖ − g|", "1", "ours", ge=0.0)] = 1.0
    sd_joint: Annotated[float, meta("Misfit of the joint centre's acceleration", "m/s²", "ours", gt=0.0)] = (
        0.3
    )
    tau_joint: Annotated[float, meta("Correlation time of that misfit", "s", "ours", gt=0.0)] = 0.05
    grow_joint: Annotated[
        float,
        meta("Growth of sd_joint with the lever's acceleration (error of the lever)", "1", "ours", ge=0.0),
    ] = 0.15
    sway_deg: Annotated[
        float, meta("Sway of the hinge's axis: soft tissue, axis error", "deg", "ours", gt=0.0)
    ] = 2.0
    tau_sway: Annotated[float, meta("Correlation time of the sway", "s", "ours", gt=0.0)] = 0.2
    sd_rest: Annotated[float, meta("Rate at rest against the bias", "rad/s", "ours", gt=0.0)] = 0.003
    sd_mount_deg: Annotated[
        float,
        meta(
            "How well the long axis of a segment is known in its sensor, about the flexion axis: a constant error of "
            "both sensors in the stated standard deviation where zero = mounting. 0: known (a robot)",
            "deg",
            "ours",
            ge=0.0,
        ),
    ] = 3.0
    sd_acc_bias: Annotated[
        float,
        meta(
            "Constant error of an accelerometer: tilts the angle, and no filter averages it out",
            "m/s²",
            "ours",
            ge=0.0,
        ),
    ] = 0.05
    zero: Annotated[
        Literal["mounting", "start", "encoder"],
        meta(
            "Where the flexion is zero: where the mountings say, in the mean pose of the first zero_s seconds, or so "
            "that its mean over them is the encoder's",
            source="ours",
        ),
    ] = "mounting"
    zero_s: Annotated[float, meta("Length of that stretch", "s", "ours", gt=0.0)] = 2.0


class HingeParams(ChainParams, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Of a hinge that finds its axes."""

    identify: Annotated[
        Literal["off", "axes", "position"],
        meta(
            "Find the axes, or axes and joint position, over a growing window",
            source="joint dissertation, eqs 68–72",
        ),
    ] = "position"
    misfit_gyr: Annotated[
        float, meta("Identification: misfit of the rates across the axes", "rad/s", "ours", gt=0.0)
    ] = 0.05
    misfit_acc: Annotated[
        float, meta("Identification: misfit of the forces along the axes", "m/s²", "ours", ge=0.0)
    ] = 0.5


class RelativeParams(ChainParams, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Of a chain."""

    joint: Annotated[
        str,
        meta("Kind of every joint: hinge, two-axis or free; per joint after its name (hip=free knee=hinge)"),
    ] = "free"
    position: Annotated[
        str,
        meta(
            "Vectors from the joint's centre to the sensor above and below, in their frames, six numbers; per joint "
            "after its name (knee=0,0,0.2,0,0,-0.15). A joint calibration goes before it; empty: not known",
            "m",
        ),
    ] = ""
    anchor: Annotated[
        str,
        meta(
            "Vector from a point that does not move (pivot) to the first sensor, three numbers; empty: none",
            "m",
        ),
    ] = ""


class ChainEstimator(JointEstimator):
    """Base: lays the chain's parameters out for :mod:`.chain`."""

    dtype = chain.DTYPE
    lookahead = 2
    latency = 2
    least = 2
    run = staticmethod(chain_loop.run)
    run_end = staticmethod(chain_loop.run_end)

    def set_up(self, context: Context) -> None:
        """Write parameters into the state and set ``outputs``."""
        s, p, n = self.state[0], self.params, len(self.segments)
        s["gravity"] = p.gravity
        s["mount"][:n] = mounts(p, self.segments, context)
        s["q_gyr"], s["q_bias"], s["p_bias"] = p.sd_gyr**2, p.walk_bias**2, p.sd_bias**2
        s["k_gyr"] = p.grow_gyr**2
        s["sd_mount"] = np.radians(p.sd_mount_deg)
        s["mount_var"] = 2.0 * s["sd_mount"] ** 2
        s["tilt_var"] = 2.0 * (p.sd_acc_bias / p.gravity) ** 2
        s["zero"], s["zero_s"] = ("mounting", "start", "encoder").index(p.zero), p.zero_s
        if p.zero == "encoder" and not context.has("encoder") and context.channels:
            raise AlgorithmError(
                f"{self.name}: zero = 'encoder' needs an encoder; attach one or use mounting"
            )
        s["r_force"] = 2.0 * p.sd_force**2 * p.tau_force
        s["k_force"] = 2.0 * p.grow_force**2 * p.tau_force
        s["r_joint"] = 2.0 * p.sd_joint**2 * p.tau_joint
        s["k_joint"] = 2.0 * p.grow_joint**2 * p.tau_joint
        s["two_tau"] = 2.0 * p.tau_joint
        s["misfit"], s["misfits"] = 1.0, chain.FIRST_MISFITS
        s["r_sway"] = 2.0 * np.radians(p.sway_deg) ** 2 * p.tau_sway
        s["r_rest"] = 2.0 * p.sd_rest**2 * 0.5
        s["learn"], s["known"], s["about"] = 0, 1, 1.0
        for j in range(n - 1):
            s["j"][j] = s["mount"][j : j + 2, 0]
        self.set_up_joints(context)
        self.outputs = self.outputs_of()

    def set_up_joints(self, context: Context) -> None:
        """Write what is known of the joints."""

    def outputs_of(self) -> tuple[Output, ...]:
        """Return the outputs in the order of :func:`.chain_loop.emit`."""
        joints, types = self.joint_names(), self.state["type"][0]
        angles: list[str] = []
        for j, name in enumerate(joints):
            angles += [name] if types[j] == chain.HINGE else [name, f"{name}_abduction", f"{name}_rotation"]
        return (
            *(Output(s, QUATERNION, QUAT) for s in self.segments),
            Output("joint", JOINT_STATE, tuple(angles)),
            Output(
                "sigma",
                NAMED,
                (*joints, *(f"{s}_tilt" for s in self.segments)),
                metadata=(("unit", "rad"),),
            ),
            Output(
                "bias",
                NAMED,
                tuple(f"{s}_{a}" for s in self.segments for a in "xyz"),
                metadata=(("unit", "rad/s"),),
            ),
            Output(
                "axes",
                NAMED,
                tuple(f"{j}.{side}_{a}" for j in joints for side in ("upper", "lower") for a in "xyz"),
            ),
        )


class JointHinge(ChainEstimator):
    """Angle of a hinge between two segments, from their sensors alone.

    Rotations of both segments with the hinge's axes and the joint centre's acceleration as measurements; axes
    and position are found over a growing window or given by a joint calibration. Before they are found the
    axis of the parameters is used. Results lag two samples behind. Ours.
    """

    name: ClassVar[str] = "joint.hinge"
    title: ClassVar[str] = "hinge angle by rotations with axis, position and bias found on the way"
    source: ClassVar[str] = "ours; after Seel et al. 2014, Weygers and Kok 2020, Olsson et al. 2020"
    Params = HingeParams
    inputs: tuple[Input, ...] = (imu("thigh"), imu("shank"), encoder(True))

    def set_up_joints(self, context: Context) -> None:
        """Write axes and the identification's settings."""
        s, p = self.state[0], self.params
        set_up_axes(s, p, self.segments, context, p.misfit_gyr, p.misfit_acc)
        s["type"] = chain.HINGE
        s["j"][0] = s["axis"]
        s["lever"][0] = s["pos"]
        s["placed"][0] = bool(np.any(s["pos"]))
        spread_of_zero(s)

    def remarks(self) -> list[Remark]:
        """Say whether the axes are known, and since when."""
        s = self.state[0]
        remarks = super().remarks() + axis_remarks(s, self.segments, fatal=False)
        late_s = (int(s["begin_ns"]) - int(s["first_ns"])) * 1e-9
        if late_s > LATE_S:
            remarks.append(
                Remark(
                    "angle_begins",
                    f"{self.joint_names()[0]}: no angle in the first {late_s:.1f} s: axis is not stated and was found "
                    "then; give axis, or use joint.smooth, which looks at the whole recording first",
                )
            )
        return remarks


class JointRelative(ChainEstimator):
    """Orientations of two to four segments and angles of hinge, two-axis and free joints (6D).

    Angles are Cardan angles of the lower segment's frame M in the upper one, the joint coordinate system of Grood and
    Suntay (1983): M = Rx(−flexion) Ry(−abduction) Rz(−rotation), as the reference angles of markers have it. Relative
    heading is observable by a hinge or two-axis joint, or by the joint's position under motion; without any of them
    it drifts, and a remark says so. Ours.
    """

    name: ClassVar[str] = "joint.relative"
    title: ClassVar[str] = "orientations and angles of a chain with hinge, two-axis and free joints (6D)"
    source: ClassVar[str] = "ours; after Kok et al. 2014, Weygers and Kok 2020, Laidig et al. 2017"
    Params = RelativeParams
    inputs: tuple[Input, ...] = (
        imu("trunk", True),
        imu("thigh"),
        imu("shank"),
        imu("foot", True),
        encoder(True),
    )

    def set_up_joints(self, context: Context) -> None:
        """Write kinds, axes and positions of the joints."""
        s, p = self.state[0], self.params
        calibration = context.calibrations.get("joint")
        hinges = (
            calibration.values.get("hinges", []) if calibration is not None and calibration.usable else []
        )
        for j, name in enumerate(self.joint_names()):
            kind = for_joint(p.joint, name) or "free"
            if kind not in TYPES:
                raise AlgorithmError(f"joint = {kind!r} is not allowed; must be one of {', '.join(TYPES)}")
            s["type"][j] = TYPES.index(kind)
            if kind == "two-axis":
                s["j"][j] = s["mount"][j, 0], s["mount"][j + 1, 2]
            place = for_joint(p.position, name)
            if place:
                s["lever"][j] = numbers(place, 6, "position").reshape(2, 3)
                s["placed"][j] = 1
            for hinge in hinges:
                if tuple(hinge["segments"]) == self.segments[j : j + 2]:
                    if kind == "hinge":
                        s["j"][j] = np.array(hinge["axes"])
                    s["lever"][j] = np.array(hinge["positions_m"])
                    s["placed"][j] = bool(np.any(s["lever"][j]))
        if p.anchor:
            s["anchor"], s["anchored"] = numbers(p.anchor, 3, "anchor"), 1

    def remarks(self) -> list[Remark]:
        """Say which relative headings are not observable."""
        s = self.state[0]
        blind = [
            name
            for j, name in enumerate(self.joint_names())
            if s["type"][j] == chain.FREE and not s["placed"][j]
        ]
        remarks = super().remarks()
        if blind:
            remarks.append(
                Remark(
                    "heading_not_observable",
                    f"{', '.join(blind)}: a free joint without a position says nothing about relative heading; its "
                    "angles drift (only tilt is kept); give joint=hinge, position, or a joint calibration",
                )
            )
        return remarks


def for_joint(text: str, joint: str) -> str:
    """Return the part of ``text`` about ``joint``: ``hip=free knee=hinge`` (of both legs), or one for all."""
    if "=" not in text:
        return text.strip()
    by_joint = dict(part.split("=", 1) for part in text.split() if "=" in part)
    return by_joint.get(joint, by_joint.get(joint.removeprefix("left_").removeprefix("right_"), ""))


def numbers(text: str, count: int, name: str) -> FloatArray:
    """Return ``count`` numbers separated by commas or spaces."""
    try:
        values = np.array([float(part) for part in text.replace(",", " ").split()])
    except ValueError:
        values = np.zeros(0)
    if values.shape != (count,) or not np.isfinite(values).all():
        raise AlgorithmError(
            f"{name} = {text!r} is not allowed; must be {count} numbers separated by commas (m)"
        )
    return values
