"""Calibration ``joint``: hinge axes, joint positions and sensor-to-segment rotations from spans of recordings."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from itertools import pairwise
from typing import Annotated, Any, ClassVar, Literal

import msgspec
import numpy as np

from ..calibration import Calibration, Calibrator, Stretch
from ..contract import AlgorithmError, FloatArray, Input
from ..parameters import meta
from . import axisfit, handedness, hingefit, mounting, vectorfit
from .common import (
    IMU_COLUMNS,
    given_mount,
    imu,
    joint_name,
    mirrored_remark,
    mount_of,
    per_segment,
    states_axis,
    vector,
)
from .merge import SEGMENTS

MOST_ROWS = 20_000


class JointCalibrationParams(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How axes, positions and mountings are found."""

    method: Annotated[
        Literal["hinge", "functional", "static"],
        meta(
            "Flexion axes by the hinge's constraint (Gauss-Newton), by the main direction of the rate in spans with "
            "one segment's movement (functional), or as the parameter axis says (static)",
            source="joint dissertation, eqs 68–72",
        ),
    ] = "hinge"
    static: Annotated[
        str,
        meta("Spans whose label has this word are a standing pose: there the long axes point up"),
    ] = "static"
    axis: Annotated[
        str,
        meta(
            "Flexion axis in the sensors' frames, roughly: fixes the common sign of the axes (as in the estimators); "
            "empty: not stated",
            source="source: x",
        ),
    ] = ""
    up: Annotated[str, meta("Long axis in the sensors' frames, where there is no standing pose")] = ""
    sd_gyr: Annotated[float, meta("Misfit of the rates across the axes", "rad/s", "ours", gt=0.0)] = 0.05
    sd_acc: Annotated[
        float, meta("Misfit of the forces along the axes; 0: rates alone (eq 68)", "m/s²", "ours", ge=0.0)
    ] = 0.5
    gravity: Annotated[float, meta("Local gravity", "m/s²", "source", gt=0.0, le=30.0)] = 9.81
    band_hz: Annotated[
        float,
        meta(
            "Misfits of whole vectors are low-passed here: below the resonance of soft tissue; 0: norms and axes alone "
            "(eqs 68–72)",
            "Hz",
            "ours",
            ge=0.0,
            le=20.0,
        ),
    ] = 1.5
    max_sd_deg: Annotated[
        float, meta("Largest standard deviation of an axis that is called observable", "deg", "ours", gt=0.0)
    ] = 3.0


class JointCalibrator(Calibrator):
    """Finds how sensors sit on their segments and where the joints are.

    Values: ``hinges``, one per pair of neighbouring segments (``joint``, ``segments``, ``axes`` in both sensors'
    frames, ``axes_sd_deg``, ``positions_m`` from the joint's centre to each sensor, ``position_sd_m``, ``pairing``,
    ``gyr_bias_rad_s``, ``acc_bias_m_s2``, ``biases_bounded``, ``skewness``, ``sign_by``
    (stated, swings, pose, nothing), ``long_axes``, ``long_axes_guessed``, ``usable``, ``why``), and
    ``rot_sb_<segment>``, the rotation from the sensor's to the segment's frame (x flexion axis, z long axis upwards,
    y = z × x), row by row.
    """

    name: ClassVar[str] = "joint"
    title: ClassVar[str] = "hinge axes, joint positions, sensor-to-segment rotations"
    source: ClassVar[str] = "joint dissertation, eqs 68–72 (after Seel et al. 2014); Olsson et al. 2020"
    Params = JointCalibrationParams
    inputs: tuple[Input, ...] = tuple(imu(s, optional=True) for s in SEGMENTS)

    def calibrate(self, stretches: Sequence[Stretch]) -> Calibration:
        """Return what the stretches say about axes, positions and mountings."""
        p = self.params
        spans = [{s: _table(one, s) for s in SEGMENTS if one.tables.get(s)} for one in stretches]
        segments = [s for s in SEGMENTS if any(s in span for span in spans)]
        if len(segments) < (2 if p.method == "hinge" else 1):
            raise AlgorithmError(
                f"joint calibration: {len(segments)} segment ({', '.join(segments) or 'none'}); attach at least two "
                f"of {', '.join(SEGMENTS)} with --input NAME=TOPIC"
            )
        standing = [bool(p.static) and p.static in one.label for one in stretches]
        moving = [s for s, still in zip(spans, standing, strict=True) if not still] or spans
        pairs = list(pairwise(segments))
        stated = {s: any(states_axis(p, s, one.channels) for one in stretches) for s in segments}
        hinges = [self.hinge(a, b, moving, stated) for a, b in pairs] if p.method == "hinge" else []
        axes: dict[str, FloatArray] = {}
        remarks: list[str] = []
        for hinge in hinges:
            if not hinge["usable"]:
                remarks.append(f"{hinge['joint']}: not observable: {hinge['why']}")
                continue
            if hinge["biases_bounded"]:
                remarks.append(
                    f"{hinge['joint']}: what does not fit a hinge looks like a bias larger than sensors have: tissue "
                    "moves, or the joint turns about more than one axis"
                )
            for segment, axis in zip(hinge["segments"], hinge["axes"], strict=True):
                if segment not in axes or hinge["joint"] == "knee":
                    axes[segment] = np.array(axis)
        for segment in segments:
            if p.method == "functional":
                axis, sd = self.functional(segment, moving)
                if sd > p.max_sd_deg:
                    remarks.append(f"{segment}: not observable: its rate has no main direction ({sd:.1f}°)")
                else:
                    axes[segment] = axis
            elif p.method == "static":
                axes[segment] = vector(per_segment(p.axis, segment) or "x", "axis")
        poses = [span for span, still in zip(spans, standing, strict=True) if still]
        ups = self.long_axes(hinges, remarks, {s for s in axes if any(s in pose for pose in poses)}, stated)
        values: dict[str, Any] = {}
        if hinges:
            values["hinges"] = [{k: v for k, v in h.items() if k != "cov"} for h in hinges if h["usable"]]
        for segment, axis in axes.items():
            up = self.standing(segment, poses, remarks)
            if up is None:
                up = ups.get(segment, given_mount(p, segment)[2])
            values[f"rot_sb_{segment}"] = mount_of(axis, up).tolist()
        return Calibration(
            kind="joint",
            subject=",".join(segments),
            values=values,
            covariance={k: v for h in hinges if h["usable"] for k, v in h["cov"].items()},
            params=msgspec.to_builtins(p),
            remarks=remarks,
            usable=bool(axes),
        )

    def hinge(
        self, upper: str, lower: str, spans: Sequence[dict[str, Any]], stated: Mapping[str, bool]
    ) -> dict[str, Any]:
        """Return axes, position and verdict of the joint between two segments."""
        p = self.params
        joint = joint_name(upper, lower)
        parts = [paired_rows(s[upper], s[lower]) for s in spans if upper in s and lower in s]
        rows, rate = (
            (np.vstack([r for r, _ in parts]), float(np.median([f for _, f in parts])))
            if parts
            else (np.zeros((0, 24)), 0.0)
        )
        result: dict[str, Any] = {"joint": joint, "segments": [upper, lower], "usable": False}
        if len(rows) < 60:
            return {
                **result,
                "why": f"{len(rows)} samples in common of at least 60 (do their times overlap?)",
            }
        judged = np.zeros(1, handedness.PAIR)
        handedness.look_through(judged[0], rows, 1.0 / rate)
        step = max(1, math.ceil(len(rows) / MOST_ROWS))
        rows = np.ascontiguousarray(rows[::step])
        work = np.zeros(1, axisfit.WORK_DTYPE)
        w = work[0]
        hint = np.array([given_mount(p, segment)[0] for segment in (upper, lower)])
        lag = max(1, round(0.3 * rate / step))
        paired = False
        for _ in range(3):
            w["axis"] = hint
            paired = axisfit.fit_axes(work[0], rows, len(rows), lag, p.sd_gyr, p.sd_acc, p.gravity)
            axisfit.fit_position(work[0], rows, len(rows), 3.0)  # nearly least squares: a wide basin
            axisfit.fit_position(work[0], rows, len(rows), 0.5)
        best = vectorfit.Hinge(
            axes=w["axis"].copy(),
            positions=w["pos"].copy(),
            axes_cov=np.array(
                [
                    w["tangent"][i].T @ w["cov_axes"][2 * i : 2 * i + 2, 2 * i : 2 * i + 2] @ w["tangent"][i]
                    for i in (0, 1)
                ]
            ),
            axes_sd=w["axis_sd"].copy(),
            position_sd=float(w["pos_sd"]),
            upper_sd=float(w["upper_sd"]),
            pairing=float(w["pairing"]) if paired else 0.5,
            biases=np.zeros((2, 3)),
            acc_biases=np.zeros((2, 3)),
        )
        stretches = unbroken([(s[upper], s[lower]) for s in spans if upper in s and lower in s])
        if p.band_hz > 0.0 and stretches:
            best = vectorfit.fit(stretches, best.axes, p.band_hz, p.sd_gyr, p.sd_acc)
        if w["pairing"] < hingefit.DOUBTFUL:
            few = np.ascontiguousarray(rows[:: max(1, len(rows) // 1000)])
            short = max(1, round(lag * len(few) / len(rows)))
            w["hand"] = handedness.neighbours(few, short, p.gravity).hand
        mirrored = handedness.left_handed_of(judged[0], (upper, lower), int(w["hand"]))
        oriented = np.zeros(1, mounting.RECORD)
        o = oriented[0]
        for i, segment in enumerate((upper, lower)):
            mount = given_mount(p, segment)
            o["given_axis"][i], o["given_up"][i] = mount[0], mount[2]
            o["stated"][i], o["up_stated"][i] = stated[segment], bool(per_segment(p.up, segment))
        o["is_knee"] = joint == "knee"
        o["axis"], o["pos"] = best.axes, best.positions
        o["upper_sd"], o["gravity"] = best.upper_sd, p.gravity
        mounting.orient(oriented[0], rows, len(rows), lag)
        best = best._replace(axes=o["axis"].copy())
        sd = np.degrees(best.axes_sd)
        still = [n for n, r in zip((upper, lower), w["rate_rms"], strict=True) if r <= hingefit.STILL_RATE]
        why = ""
        if mirrored:
            why = mirrored_remark(mirrored).detail
        elif still:
            why = f"{' and '.join(still)} never turns"
        elif w["turn_rms"] <= 0.1:
            why = f"both turn as one body ({w['turn_rms']:.2f} rad/s between them, at least 0.1)"
        elif sd.max() > p.max_sd_deg:
            why = f"standard deviation {sd.max():.1f}° above {p.max_sd_deg:g}°: more motion about other directions"
        elif best.pairing <= hingefit.PAIRED:
            why = f"the axes' signs cannot be paired ({best.pairing:.2f} of at least 0.55): axis near the vertical?"
        placed = best.position_sd < 0.05
        return {
            **result,
            "usable": not why,
            "why": why,
            "axes": best.axes.tolist(),
            "axes_sd_deg": sd.tolist(),
            "positions_m": (best.positions if placed else 0.0 * best.positions).tolist(),
            "position_sd_m": best.position_sd,
            "pairing": best.pairing,
            "gyr_bias_rad_s": best.biases.tolist(),
            "acc_bias_m_s2": best.acc_biases.tolist(),
            "biases_bounded": best.bounded,
            "skewness": float(o["skew"]),
            "sign_by": mounting.SIGNS[int(o["sign_by"])],
            "long_axes": o["up"].tolist(),
            "long_axes_guessed": [bool(g) for g in o["guessed"]],
            "samples": len(rows),
            "cov": {
                f"axis_{joint}_{segment}": best.axes_cov[i].tolist()
                for i, segment in enumerate((upper, lower))
            },
        }

    def functional(self, segment: str, spans: Sequence[dict[str, Any]]) -> tuple[FloatArray, float]:
        """Return the main direction of a segment's rate and its spread in degrees."""
        rate = np.vstack([s[segment][1][:, 3:] for s in spans if segment in s])
        rate = rate - np.median(rate, axis=0)
        power, directions = np.linalg.eigh(rate.T @ rate / len(rate))
        axis = directions[:, 2]
        hint = vector(per_segment(self.params.axis, segment) or "x", "axis")
        axis = axis if axis @ hint >= 0.0 else -axis
        if power[2] < 0.01:
            return axis, 90.0
        # Spread of the axis: rate across it against rate about it, over independent half seconds.
        count = max(1.0, sum(s[segment][0][-1] - s[segment][0][0] for s in spans if segment in s) * 2e-9)
        return axis, float(np.degrees(math.atan(math.sqrt(power[1] / power[2] / count))))

    def long_axes(
        self,
        hinges: Sequence[dict[str, Any]],
        remarks: list[str],
        stood: Collection[str],
        stated: Mapping[str, bool],
    ) -> dict[str, FloatArray]:
        """Return the long axes of both segments of every usable hinge, and remark what is guessed."""
        long: dict[str, FloatArray] = {}
        for hinge in hinges:
            if not hinge["usable"]:
                continue
            pair = hinge["segments"]
            hinge["long_axes_guessed"] = [
                g and s not in stood for g, s in zip(hinge["long_axes_guessed"], pair, strict=True)
            ]
            for segment, up in zip(pair, hinge["long_axes"], strict=True):
                if segment not in long or hinge["joint"] == "knee":
                    long[segment] = np.array(up)
            about = {
                "guessed": hinge["long_axes_guessed"],
                "sign_by": mounting.SIGNS.index(hinge["sign_by"]),
                "stated": [stated[s] for s in pair],
                "skew": hinge["skewness"],
            }
            remarks += [r.detail for r in mounting.guess_remarks(about, pair)]
        return long

    def standing(
        self, segment: str, poses: Sequence[dict[str, Any]], remarks: list[str]
    ) -> FloatArray | None:
        """Return the long axis in the sensor's frame: gravity while standing; None without such a span."""
        force = [s[segment][1][:, :3] for s in poses if segment in s]
        if not force:
            return None
        f = np.vstack(force)
        mean = f.mean(axis=0)
        spread = float(np.linalg.norm(f - mean, axis=1).std())
        if spread > 0.5:
            remarks.append(f"{segment}: the standing pose is not still ({spread:.1f} m/s²)")
        return mean / np.linalg.norm(mean)


def _table(stretch: Stretch, segment: str) -> tuple[Any, FloatArray]:
    """Return times and finite samples (n, 6) of a segment's sensor in a stretch, times ascending."""
    table = stretch.tables[segment][0]
    t = table["t_ns"].to_numpy()
    values = table.select(IMU_COLUMNS).to_numpy()
    good = np.isfinite(values).all(axis=1) & np.r_[True, np.diff(np.maximum.accumulate(t)) > 0]
    return t[good], values[good]


def unbroken(
    pairs: Sequence[tuple[tuple[Any, FloatArray], tuple[Any, FloatArray]]],
) -> list[vectorfit.Span]:
    """Return the longest stretches of both sensors without a gap, at the upper's times; at least 3 s, at most six.

    Of each sensor times (ns), shape (n,), and values, shape (n, k).
    """
    spans = []
    for upper, lower in pairs:
        t, s = upper[0].astype(np.float64) * 1e-9, lower[0].astype(np.float64) * 1e-9
        if len(t) < 5 or len(s) < 5:
            continue
        k = np.clip(np.searchsorted(s, t), 1, len(s) - 1)
        good = (t >= s[0]) & (t <= s[-1]) & (s[k] - s[k - 1] < 0.1)
        other = np.stack([np.interp(t, s, lower[1][:, c]) for c in range(6)], axis=1)
        broken = np.flatnonzero((np.diff(t) > 0.1) | (good[1:] != good[:-1])) + 1
        for part in np.split(np.arange(len(t)), broken):
            if len(part) > 20 and good[part[0]] and t[part[-1]] - t[part[0]] >= 3.0:
                spans.append(vectorfit.Span(t[part] - t[part[0]], upper[1][part], other[part]))
    return sorted(spans, key=lambda span: -len(span.t))[:6]


def paired_rows(upper: tuple[Any, FloatArray], lower: tuple[Any, FloatArray]) -> tuple[FloatArray, float]:
    """Return samples of both segments at the upper's times, columns of :mod:`.axisfit`, and the rate in Hz.

    Samples further than 0.1 s from a neighbour, and two beside such a gap, are left out (derivative).
    """
    t = upper[0].astype(np.float64) * 1e-9
    s = lower[0].astype(np.float64) * 1e-9
    if len(t) < 5 or len(s) < 5:
        return np.zeros((0, axisfit.COLUMNS)), 0.0
    other = np.stack([np.interp(t, s, lower[1][:, c]) for c in range(6)], axis=1)
    k = np.clip(np.searchsorted(s, t), 1, len(s) - 1)
    good = (t >= s[0]) & (t <= s[-1]) & (s[k] - s[k - 1] < 0.1)
    parts = []
    dt = np.diff(t, prepend=t[0])
    for values in (upper[1], other):
        g = values[:, 3:]
        slope = np.zeros_like(g)
        span = (t[4:] - t[:-4])[:, None]
        slope[2:-2] = (g[:-4] - 8.0 * g[1:-3] + 8.0 * g[3:-1] - g[4:]) / (3.0 * span)
        turned = np.cumsum(0.5 * dt[:, None] * (g + np.roll(g, 1, axis=0)), axis=0)
        parts += [g, values[:, :3], slope, turned]
    whole = np.zeros(len(t), bool)
    steady = (dt < 0.1) & good
    whole[2:-2] = steady[:-4] & steady[1:-3] & steady[2:-2] & steady[3:-1] & steady[4:]
    whole &= np.arange(len(t)) > 2
    return np.hstack(parts)[whole], float(1.0 / np.median(dt[1:]))
