"""The source's estimators: FKC, local and global filters, SMp, SMe and SMeA."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

import numpy as np

from ..contract import AlgorithmError, Context, Input, Output, Remark
from ..parameters import meta
from . import hingefit, linear, linear_loop, selfaligned, turnfit
from .common import JointEstimator, MergeParams, encoder, imu, joint_name, mounts, per_segment, states_axis
from .mounting import NOTHING, SIGNS, guess_remarks, mounting_remarks

TABLE5 = "table 5"
AXES = ("roll", "pitch", "yaw")
TUNED: dict[str, Any] = {
    "integration": "quaternion",
    "average_s": 1.0,
    "sigma2_acc_thigh": 0.02,
    "sigma2_acc_shank": 0.02,
    "grow_acc": 5.0,
    "sigma2_joint": 1e-3,
    "sigma2_start_bias": 1e-3,
    "zeta": 1.0,
}
"""For walking at any pace: the force is averaged over a stride, the joint row and the gyroscope's bias are trusted."""
NAMED = "marcha_msgs/msg/NamedValues"
JOINT_STATE = "sensor_msgs/msg/JointState"


class FilterParams(MergeParams, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Noise and rules of all filters of the source."""

    sigma2_gyr: Annotated[float, meta("σ_g² in Q", "rad²/s²", TABLE5, ge=0.0)] = 1e-7
    sigma2_bias: Annotated[float, meta("σ_bg² in Q", "rad²/s²", TABLE5, ge=0.0)] = 1e-7
    tau_s: Annotated[float, meta("Time constant of the gyroscope's bias", "s", TABLE5, gt=0.0)] = 1e15
    sigma2_acc_trunk: Annotated[
        float,
        meta("σ_a² of the trunk's angles from the accelerometer", "rad²", "ours: as the thigh's", gt=0.0),
    ] = 0.0014
    sigma2_acc_thigh: Annotated[float, meta("The same of the thigh", "rad²", TABLE5, gt=0.0)] = 0.0014
    sigma2_acc_shank: Annotated[float, meta("The same of the shank", "rad²", TABLE5, gt=0.0)] = 0.0017
    sigma2_acc_foot: Annotated[
        float, meta("The same of the foot", "rad²", "ours: as the shank's", gt=0.0)
    ] = 0.0017
    zeta: Annotated[
        float,
        meta(
            "ζ: an accelerometer is usable while |‖a‖ − g| does not exceed it",
            "m/s²",
            "eq 46; value not printed, 0 … 1; ours by simulated walks",
            ge=0.0,
        ),
    ] = 0.5
    average_s: Annotated[
        float,
        meta(
            "Time over which the levelled force is averaged before its angles and norm are taken; 0: every sample",
            "s",
            "ours: 0 as in the source",
            ge=0.0,
            le=60.0,
        ),
    ] = 0.0
    grow_acc: Annotated[
        float,
        meta(
            "Growth of σ_a² with the variance of the levelled force over average_s, in g²",
            "1",
            "ours: 0 as in the source",
            ge=0.0,
        ),
    ] = 0.0
    sigma2_start_bias: Annotated[
        float, meta("Variance of the bias at the start", "rad²/s²", "appendix: P_0 = I", gt=0.0)
    ] = 1.0
    unusable: Annotated[
        Literal["drop", "zero", "hold"],
        meta(
            "Row of an accelerometer that is not usable: left out; z = 0 with the row kept (algorithm 3); z keeps "
            "its last value (section 3.1)",
            source="ours: drop",
        ),
    ] = "drop"
    tilt: Annotated[
        Literal["atan2", "arcsine"],
        meta("Angle from the accelerometer: by two axes, or eq 8's arcsine of one", source="ours: atan2"),
    ] = "atan2"
    flexion: Annotated[
        Literal["roll", "pitch"],
        meta("Which angle joins the segments", source="text after eq 50: roll; eq 45 prints pitch's place"),
    ] = "roll"


class SpatialParams(FilterParams, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Of the filters with roll, pitch and yaw."""

    integration: Annotated[
        Literal["axis", "euler", "quaternion"],
        meta(
            "How θ_g is carried: each axis by itself, by the angles' kinematics, by a rotation", source="eq 7"
        ),
    ] = "axis"
    yaw: Annotated[
        Literal["none", "acc-tilt"],
        meta(
            "Yaw row: none (an accelerometer does not see yaw), or atan2(√(a_x² + a_y²), a_z), which is no heading",
            source="not defined in the source",
        ),
    ] = "none"


class EncoderParams(FilterParams, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Planar filter with encoders."""

    sigma2_joint: Annotated[float, meta("σ_e² of the joint row", "rad²", TABLE5, gt=0.0)] = 0.5


class SpatialEncoderParams(SpatialParams, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Spatial filter with encoders."""

    sigma2_joint: Annotated[float, meta("σ_e² of the joint row", "rad²", TABLE5, gt=0.0)] = 0.5


class LocalParams(FilterParams, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Planar filters of the appendix."""

    rule: Annotated[
        Literal["norm", "dynamic"],
        meta(
            "When an accelerometer is usable: by its norm (algorithm 3), or while the dynamic acceleration of each "
            "axis is below 0.5 g",
            source="appendix",
        ),
    ] = "norm"


class GlobalParams(LocalParams, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """With rows between the segments."""

    sigma2_joint: Annotated[float, meta("σ_a² of a joint's row", "rad²", TABLE5, gt=0.0)] = 0.5


class SmeaParams(SpatialParams, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Of SMeA: the joint row is the self-aligned angle."""

    sigma2_joint: Annotated[
        float, meta("σ_k² of the joint row in TS, σ_gk² in T and S", "rad²", TABLE5, gt=0.0)
    ] = 0.5
    sigma2_alpha: Annotated[
        float,
        meta(
            "σ² of the joint angle from the accelerometers, gravity across the axis", "rad²", TABLE5, gt=0.0
        ),
    ] = 0.0014
    fusion: Annotated[
        Literal["fkc", "seel"], meta("Joint angle by eq 77, or Seel's weighted mean", source="eq 77")
    ] = "fkc"
    seel_weight: Annotated[float, meta("Seel's λ", "1", "Seel et al. 2014", gt=0.0, le=1.0)] = 0.01
    identify: Annotated[
        Literal["off", "axes", "position"],
        meta(
            "Find the hinge axes, or axes and joint position, over a growing window; off: by the joint calibration, "
            "else the parameter axis",
            source="eqs 68–72",
        ),
    ] = "position"
    sd_gyr: Annotated[
        float, meta("Identification: misfit of the rates across the axes", "rad/s", "ours", gt=0.0)
    ] = 0.05
    sd_acc: Annotated[
        float,
        meta(
            "Identification: misfit of the forces along the axes; 0: rates alone (eq 68)",
            "m/s²",
            "ours",
            ge=0.0,
        ),
    ] = 0.5


class SourceFilter(JointEstimator):
    """Base of the six: lays the parameters out for :mod:`.linear`."""

    dtype = linear.DTYPE
    kind: ClassVar[int] = linear.LOCAL
    axes: ClassVar[int] = 1
    run = staticmethod(linear_loop.run)
    run_end = staticmethod(linear_loop.run_end)

    def set_up(self, context: Context) -> None:
        """Write parameters into the state and set ``outputs``."""
        s, p, n = self.state[0], self.params, len(self.segments)
        s["kind"], s["axes"] = self.kind, self.axes
        s["flex"] = 1 if p.flexion == "pitch" else 0
        s["yaw"] = getattr(p, "yaw", "none") == "acc-tilt"
        s["arcsine"] = p.tilt == "arcsine"
        s["integration"] = ("axis", "euler", "quaternion").index(getattr(p, "integration", "axis"))
        s["unusable"] = ("drop", "zero", "hold").index(p.unusable)
        s["dynamic"] = getattr(p, "rule", "norm") == "dynamic"
        s["average"], s["grow"], s["p_bias"] = p.average_s, p.grow_acc, p.sigma2_start_bias
        s["zeta"], s["gravity"], s["decay"] = p.zeta, p.gravity, 1.0 / p.tau_s
        s["q"] = p.sigma2_gyr, p.sigma2_bias
        r = np.ones(linear.ROWS)
        for i, segment in enumerate(self.segments):
            r[i * self.axes : (i + 1) * self.axes] = getattr(p, f"sigma2_acc_{segment}", p.sigma2_acc_thigh)
        r[n * self.axes : n * self.axes + n - 1] = getattr(p, "sigma2_joint", 0.5)
        s["r"] = s["sigma2"] = r
        s["mount"][:n] = mounts(p, self.segments, context)
        self.outputs = outputs_of(self)

    def remarks(self) -> list[Remark]:
        """Say how often no accelerometer was usable, and what the encoder did."""
        remarks = super().remarks()
        s = self.state[0]
        if s["steps"] and s["blind"] > 0.5 * s["steps"]:
            remarks.append(
                Remark(
                    "no_accelerometer",
                    f"no accelerometer was usable in {int(s['blind'])} of {int(s['steps'])} steps; "
                    f"raise zeta ({self.params.zeta:g} m/s²) or check the unit and scale of the accelerometers",
                )
            )
        if s["jumped_turns"]:
            remarks.append(
                Remark(
                    "encoder_turns",
                    f"{int(s['jumped_turns'])} encoder values were off by whole turns and were moved by them",
                )
            )
        return remarks


def outputs_of(estimator: SourceFilter) -> tuple[Output, ...]:
    """Return the outputs of a filter for its segments, in the order of :func:`.linear_loop.emit`."""
    segments, joints = estimator.segments, estimator.joint_names()
    yaw = getattr(estimator.params, "yaw", "none") == "acc-tilt"
    shown = AXES[: 3 if yaw else 2] if estimator.axes == 3 else (estimator.params.flexion,)
    angles = tuple(f"{s}_{a}" for s in segments for a in shown)
    note = (("yaw", "acc-tilt: no heading"),) if yaw else ()
    outputs = [Output("joint", JOINT_STATE, joints)] if joints else []
    outputs.append(Output("attitude", NAMED, angles, metadata=(("unit", "rad"), *note)))
    outputs += [
        Output("sigma", NAMED, (*joints, *angles), metadata=(("unit", "rad"),)),
        Output("bias", NAMED, angles, metadata=(("unit", "rad/s"),)),
        Output(
            "jump",
            NAMED,
            ("state", *(f"rho_{s}" for s in segments)),
            metadata=(("states", ",".join((*segments, "all"))),),
        ),
        Output("use", NAMED, (*segments, *joints)),
        Output("gains", NAMED, tuple(f"{s}.{r}" for s in segments for r in (*segments, *joints))),
        Output("cross", NAMED, tuple(f"{a}{w}" for a in angles for w in ("", "_weighted"))),
    ]
    if estimator.kind == linear.SELF:
        pair = segments[:2]
        outputs += [
            Output(
                "alpha", NAMED, ("angle", "accelerometers", "gyroscopes", "sd"), metadata=(("unit", "rad"),)
            ),
            Output("axes", NAMED, tuple(f"{s}_{a}" for s in pair for a in "xyz")),
        ]
    return tuple(outputs)


class JointFkc(SourceFilter):
    """Complementary Kalman filter of one sensor and one axis (eqs 9–24, algorithm 1).

    Departures: eq 24's G is T·I (A has no inverse); the exported bias is −Δb, which is the gyroscope's.
    """

    name: ClassVar[str] = "joint.fkc"
    title: ClassVar[str] = "complementary Kalman filter of one axis of one sensor"
    source: ClassVar[str] = "joint dissertation, eqs 9–24"
    Params = FilterParams
    inputs: tuple[Input, ...] = (imu("imu"),)


class JointLocal(SourceFilter):
    """Local filters, planar: each segment by itself (FKL, eqs 85–90)."""

    name: ClassVar[str] = "joint.local"
    title: ClassVar[str] = "local Kalman filters of trunk, thigh, shank, foot, planar"
    source: ClassVar[str] = "joint dissertation, eqs 85–90"
    Params = LocalParams
    inputs: tuple[Input, ...] = (imu("trunk", True), imu("thigh"), imu("shank", True), imu("foot", True))


class JointGlobal(SourceFilter):
    """Global filter, planar: with rows of the differences between neighbours (FKG, eqs 91–93, algorithm 3).

    Departures: algorithm 3's z_e index is the joint's; Ψ_s is "sample valid", Υ_j "both accelerometers usable".
    """

    name: ClassVar[str] = "joint.global"
    title: ClassVar[str] = "global Kalman filter of trunk, thigh, shank, foot, planar"
    source: ClassVar[str] = "joint dissertation, eqs 91–93"
    Params = GlobalParams
    kind: ClassVar[int] = linear.GLOBAL
    least = 2
    inputs: tuple[Input, ...] = (imu("trunk", True), imu("thigh"), imu("shank"), imu("foot", True))


class JointSmp(SourceFilter):
    """Markov-jump filter, planar: only the accelerometer that is least disturbed, and the encoders (eqs 25–37)."""

    name: ClassVar[str] = "joint.smp"
    title: ClassVar[str] = "Markov-jump filter with encoders, planar (SMp)"
    source: ClassVar[str] = "joint dissertation, eqs 25–37, table 1"
    Params = EncoderParams
    kind: ClassVar[int] = linear.ONE
    least = 2
    inputs: tuple[Input, ...] = (
        imu("trunk", True),
        imu("thigh"),
        imu("shank"),
        imu("foot", True),
        encoder(),
    )


class JointSme(SourceFilter):
    """Markov-jump filter, spatial, of two, three or four segments with encoders (SMe, eqs 38–67, 82).

    Departures: joint rows are [r −r] (eqs 44, 67, 76 print the opposite, against eqs 30 and 64); eq 46 with the
    absolute value; no yaw row by default.
    """

    name: ClassVar[str] = "joint.sme"
    title: ClassVar[str] = "Markov-jump filter with encoders, roll, pitch, yaw (SMe)"
    source: ClassVar[str] = "joint dissertation, eqs 38–67, tables 2 and 3"
    Params = SpatialEncoderParams
    presets: ClassVar[dict[str, dict[str, Any]]] = {"tuned": TUNED}
    kind: ClassVar[int] = linear.ONE
    axes: ClassVar[int] = 3
    least = 2
    inputs: tuple[Input, ...] = (
        imu("trunk", True),
        imu("thigh"),
        imu("shank"),
        imu("foot", True),
        encoder(),
    )


class JointSmea(SourceFilter):
    """Markov-jump filter of two segments without an encoder: the joint row is a self-aligned angle (SMeA, eqs 68–84).

    The joint row uses the same accelerometers and gyroscopes as the other rows. It is not independent of them, as
    the filter assumes, so the stated standard deviations are too small. Results lag two samples behind
    (derivative of the rates).

    Departures: the zero rows of eq 76's 7-row C̄ are dropped; α_acc by atan2 (acos has no sign); pairing of
    the axes by agreement of eqs 73 and 74; α_acc's variance grows as gravity turns along the axis.
    """

    name: ClassVar[str] = "joint.smea"
    title: ClassVar[str] = "Markov-jump filter with self-aligned joint angle, no encoder (SMeA)"
    source: ClassVar[str] = "joint dissertation, eqs 68–84, table 4"
    Params = SmeaParams
    presets: ClassVar[dict[str, dict[str, Any]]] = {
        "tuned": {**TUNED, "sigma2_joint": 1e-2, "sigma2_alpha": 1e-2}
    }
    kind: ClassVar[int] = linear.SELF
    axes: ClassVar[int] = 3
    lookahead = 2
    latency = 2
    least = 2
    inputs: tuple[Input, ...] = (imu("thigh"), imu("shank"))

    def set_up(self, context: Context) -> None:
        """Write the parameters of the self-aligned angle."""
        super().set_up(context)
        s, p = self.state[0], self.params
        s["r_self"] = p.sigma2_joint, p.sigma2_joint
        s["alpha_seel"] = p.fusion == "seel"
        s["alpha_lambda"] = p.seel_weight
        s["alpha_r"] = p.sigma2_alpha
        s["alpha_q"] = p.sigma2_gyr, p.sigma2_bias
        s["alpha_decay"] = 1.0 / p.tau_s
        set_up_axes(s, p, self.segments, context, p.sd_gyr, p.sd_acc)

    def remarks(self) -> list[Remark]:
        """Say whether the axes are known."""
        return super().remarks() + axis_remarks(self.state[0], self.segments)


def set_up_axes(
    s: Any, p: Any, segments: tuple[str, ...], context: Context, sd_gyr: float, sd_acc: float
) -> None:
    """Write axes, positions and the identification's settings into a packed state with its mountings laid."""
    flex = int(s["flex"]) if "flex" in s.dtype.names else 0
    s["given_axis"] = s["mount"][:2, flex]
    s["axis"] = s["given_axis"]
    s["up"] = s["given_up"] = s["mount"][:2, 2]
    s["stated"] = [states_axis(p, name, context.channels) for name in segments[:2]]
    s["up_stated"] = [bool(per_segment(p.up, name)) for name in segments[:2]]
    s["below"] = 1.0, 0.0 if segments[1] == "foot" else -1.0
    s["is_knee"] = joint_name(*segments[:2]) == "knee"
    s["learn"] = ("off", "axes", "position").index(p.identify)
    s["stride"], s["fit_at"] = 1, 2.0
    s["sd_gyr"], s["sd_acc"], s["gravity"] = sd_gyr, sd_acc, p.gravity
    s["known"] = s["learn"] == 0
    s["about"] = 1.0
    if s["learn"]:
        s["guessed"] = np.where(s["stated"], 0, 2)
    calibration = context.calibrations.get("joint")
    if calibration is not None and calibration.usable and "hinges" in calibration.values:
        for hinge in calibration.values["hinges"]:
            if tuple(hinge["segments"]) == segments[:2]:
                s["axis"] = s["given_axis"] = np.array(hinge["axes"])
                s["pos"] = np.array(hinge["positions_m"])
                s["guessed"] = hinge.get("long_axes_guessed", [False, False])
                s["sign_by"] = SIGNS.index(hinge.get("sign_by", SIGNS[0]))
                s["pos_sd"] = hinge["position_sd_m"]
                s["skew"] = hinge.get("skewness", 0.0)
                s["learn"], s["known"] = 0, 1
    elif p.identify == "off" and calibration is not None and not calibration.usable:
        raise AlgorithmError(
            "the joint calibration says not observable; calibrate on other motion or set axis"
        )
    selfaligned.set_base(s)


def axis_remarks(s: Any, segments: tuple[str, ...], fatal: bool = True) -> list[Remark]:
    """Say whether the identified axes may be used.

    Where they may not, this is fatal if the mounting is not known either; with ``fatal`` always, and what is guessed is
    too: nothing else gives the angle, and the stated uncertainty does not hold it.
    """
    if s["learn"] == 0:
        return guess_remarks(s, segments, fatal) if s["sign_by"] == NOTHING else []
    guess = fatal
    fatal = fatal or bool((s["guessed"] == 2).any() or s["held"])
    if not s["fits"]:
        return [
            Remark("axis_unknown", "too short to find the hinge axes: at least 2 s of motion", fatal=fatal)
        ]
    sd = np.degrees(s["axis_sd"])
    if s["known"]:
        return [
            Remark(
                "axis_found",
                f"hinge axes: {segments[0]} {np.round(s['axis'][0], 3).tolist()} ± {sd[0]:.1f}°, "
                f"{segments[1]} {np.round(s['axis'][1], 3).tolist()} ± {sd[1]:.1f}°",
            ),
            *mounting_remarks(s, segments, guess),
        ]
    if s["hand"]:  # said by JointEstimator.remarks
        return []
    still = [n for n, rate in zip(segments, s["rate_rms"], strict=False) if rate <= hingefit.STILL_RATE]
    why = (
        f"{still[0]} never turns"
        if still
        else f"both turn as one body (relative turn {s['turn_rms']:.2f} rad/s)"
        if s["turn_rms"] <= 0.1
        else f"the motion is not that of a hinge (misfit {s['block_cost']:.1f} of at most {turnfit.FITS})"
        if s["block_cost"] > turnfit.FITS
        else f"sd {sd[0]:.1f}° and {sd[1]:.1f}°, pairing {s['pairing']:.2f} of at least 0.55"
        + (" (each axis is plain, their signs are not: axis near the vertical?)" if max(sd) < 3.0 else "")
    )
    if s["stated"].any():
        shares = " and ".join(f"{100 * a:.0f} %" for a in s["about"])
        why += f"; {shares} of the rotation is about the stated axes (the rest is in the stated uncertainty)"
    return [
        Remark(
            "not_observable",
            f"hinge axes are not observable: {why}; give them by axis, or calibrate on motion of both segments",
            fatal=fatal,
        ),
        *([] if fatal else guess_remarks(s, segments)),
    ]
