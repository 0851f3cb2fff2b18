"""Offline smoother of a hinge: the whole recording at once, axes and position from all of it. Not causal."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, ClassVar

import msgspec
import numpy as np

from ..calibration import Calibration, Stretch
from ..contract import (
    AlgorithmError,
    Context,
    FloatArray,
    Input,
    IntArray,
    Message,
    Output,
    PlainEstimator,
    Remark,
    Result,
)
from ..numerics.compiled import compiled
from ..parameters import meta
from .calibrate import JointCalibrationParams, JointCalibrator
from .common import IMU_COLUMNS, imu, joint_name, mount_of, per_segment, side_of, vector
from .source import JOINT_STATE, NAMED

GAP_S = 0.1
"""Longest pause that is interpolated; behind a longer one the smoother begins anew."""
SEGMENTS = ("thigh", "shank")


class SmoothParams(JointCalibrationParams, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Of the identification (as calibration ``joint``) and of the smoother's noise."""

    noise_gyr: Annotated[float, meta("Noise of the angular rate", "rad/s/√Hz", "ours", gt=0.0)] = 0.002
    walk_bias: Annotated[float, meta("Random walk of the bias", "rad/s/√s", "ours", gt=0.0)] = 1e-4
    sd_angle: Annotated[
        float,
        meta("Misfit of the angle from the accelerometers, gravity across the axis", "rad", "ours", gt=0.0),
    ] = 0.05
    tau_angle: Annotated[float, meta("Correlation time of that misfit", "s", "ours", gt=0.0)] = 0.2
    grow_angle: Annotated[
        float, meta("Growth of sd_angle with |‖f‖ − g| of the joint's centre, in g", "rad", "ours", ge=0.0)
    ] = 0.3


@compiled
def smooth(
    dt: FloatArray, z: FloatArray, r: FloatArray, q: FloatArray, work: FloatArray, out: FloatArray
) -> None:
    """Write the smoothed Δ = α − ∫ω and its variance to ``out`` (n, 2): Rauch, Tung and Striebel (1965).

    States Δ and the rate's bias b, Δ' = b; measurements z of Δ with variances r; q: growth of both variances a
    second. ``work`` (n, 8) holds the states, their covariances, and those before the measurement.
    """
    n = z.shape[0]
    x, p, before = work[:, 0:2], work[:, 2:5], work[:, 5:8]
    d, b, p00, p01, p11 = z[0], 0.0, r[0], 0.0, 1e-4
    for k in range(n):
        t = dt[k] if k > 0 else 0.0
        d += t * b
        p00, p01, p11 = p00 + t * (2.0 * p01 + t * p11) + q[0] * t, p01 + t * p11, p11 + q[1] * t
        before[k, 0], before[k, 1], before[k, 2] = p00, p01, p11
        total = p00 + r[k]
        k0, k1, e = p00 / total, p01 / total, z[k] - d
        d, b = d + k0 * e, b + k1 * e
        p11 -= k1 * p01
        p01 *= 1.0 - k0
        p00 *= 1.0 - k0
        x[k, 0], x[k, 1] = d, b
        p[k, 0], p[k, 1], p[k, 2] = p00, p01, p11
    out[n - 1, 0], out[n - 1, 1] = x[n - 1, 0], p[n - 1, 0]
    d, b, s00, s01, s11 = x[n - 1, 0], x[n - 1, 1], p[n - 1, 0], p[n - 1, 1], p[n - 1, 2]
    for k in range(n - 2, -1, -1):
        t = dt[k + 1]
        m00, m01, m11 = before[k + 1, 0], before[k + 1, 1], before[k + 1, 2]
        det = m00 * m11 - m01 * m01
        f00, f01 = p[k, 0] + t * p[k, 1], p[k, 1]
        f10, f11 = p[k, 1] + t * p[k, 2], p[k, 2]
        g00, g01 = (f00 * m11 - f01 * m01) / det, (f01 * m00 - f00 * m01) / det
        g10, g11 = (f10 * m11 - f11 * m01) / det, (f11 * m00 - f10 * m01) / det
        ed, eb = d - (x[k, 0] + t * x[k, 1]), b - x[k, 1]
        d, b = x[k, 0] + g00 * ed + g01 * eb, x[k, 1] + g10 * ed + g11 * eb
        c00, c01, c11 = s00 - m00, s01 - m01, s11 - m11
        h00, h01 = g00 * c00 + g01 * c01, g00 * c01 + g01 * c11
        h10, h11 = g10 * c00 + g11 * c01, g10 * c01 + g11 * c11
        s00, s01 = p[k, 0] + h00 * g00 + h01 * g01, p[k, 1] + h00 * g10 + h01 * g11
        s11 = p[k, 2] + h10 * g10 + h11 * g11
        out[k, 0], out[k, 1] = d, s00


class JointSmooth(PlainEstimator):
    """Angle of a hinge from two sensors, past and future together. Not causal, for records only.

    Axes, position and gyroscope biases come from the whole recording as calibration ``joint`` finds them (or from such
    a calibration); the angle is the integral of the rates about the axes, held by the angle of the joint's
    acceleration as both sensors see it, smoothed forward and backward. Ours.
    """

    name: ClassVar[str] = "joint.smooth"
    title: ClassVar[str] = "hinge angle of a whole recording, forward and backward"
    source: ClassVar[str] = "ours; Rauch, Tung and Striebel 1965; Seel et al. 2014"
    offline: ClassVar[bool] = True
    Params = SmoothParams
    inputs: tuple[Input, ...] = (imu("thigh"), imu("shank"))
    outputs: tuple[Output, ...] = (
        Output("joint", JOINT_STATE, ("knee",)),
        Output("sigma", NAMED, ("knee",), metadata=(("unit", "rad"),)),
    )

    def __init__(self, params: msgspec.Struct | None = None) -> None:
        super().__init__(params)
        self._kept: dict[str, list[tuple[int, Sequence[float]]]] = {s: [] for s in SEGMENTS}
        self._given: Calibration | None = None
        self._remarks: list[Remark] = []

    def start(self, context: Context) -> None:
        """Take the joint calibration, and the side of the leg."""
        calibration = context.calibrations.get("joint")
        if calibration is not None and not calibration.usable:
            raise AlgorithmError("the joint calibration says not observable; calibrate on other motion")
        self._given = calibration
        joint = side_of(context, SEGMENTS) + joint_name(*SEGMENTS)
        self.outputs = (
            Output("joint", JOINT_STATE, (joint,)),
            Output("sigma", NAMED, (joint,), metadata=(("unit", "rad"),)),
        )
        self._kept = {s: [] for s in SEGMENTS}
        self._remarks = []

    def take(self, message: Message) -> None:
        """Keep the message."""
        self._kept[message.input].append((message.t_ns, message.values))

    def finish(self) -> list[Result]:
        """Return the smoothed angle at the thigh's times."""
        import polars as pl

        tables = {}
        for segment, rows in self._kept.items():
            if len(rows) < 5:
                self._remarks = [
                    Remark("no_data", f"{segment}: {len(rows)} samples; nothing to smooth", fatal=True)
                ]
                return []
            values = np.array([r[1] for r in rows], dtype=np.float64)
            tables[segment] = pl.DataFrame(
                {
                    "t_ns": np.array([r[0] for r in rows], np.int64),
                    **{c: values[:, k] for k, c in enumerate(IMU_COLUMNS)},
                }
            )
        calibration = self._given
        if calibration is None or not calibration.values.get("hinges"):
            params = {f: getattr(self.params, f) for f in JointCalibrationParams.__struct_fields__}
            calibrator = JointCalibrator(JointCalibrationParams(**{**params, "method": "hinge"}))
            calibration = calibrator.calibrate([Stretch({}, {s: (t,) for s, t in tables.items()})])
        if not calibration.usable:
            self._remarks = [Remark("not_observable", "; ".join(calibration.remarks), fatal=True)]
            return []
        hinge = next(h for h in calibration.values["hinges"] if tuple(h["segments"]) == SEGMENTS)
        sd = hinge["axes_sd_deg"]
        self._remarks = [
            Remark("axis_found", f"hinge axes of the whole recording ± {sd[0]:.1f}° and {sd[1]:.1f}°")
        ]
        return self._angles(tables["thigh"], tables["shank"], hinge)

    def _angles(self, upper: Any, lower: Any, hinge: dict[str, Any]) -> list[Result]:
        parts = [(t["t_ns"].to_numpy(), t.select(IMU_COLUMNS).to_numpy()) for t in (upper, lower)]
        (t_ns, own), (s_ns, other) = (
            (t[good], v[good])
            for t, v in parts
            for good in (np.isfinite(v).all(axis=1) & np.r_[True, np.diff(np.maximum.accumulate(t)) > 0],)
        )
        s = (s_ns - t_ns[0]) * 1e-9
        t = (t_ns - t_ns[0]) * 1e-9
        k = np.clip(np.searchsorted(s, t), 1, len(s) - 1)
        covered = (t >= s[0]) & (t <= s[-1]) & (s[k] - s[k - 1] <= GAP_S)
        both = np.hstack([own, np.stack([np.interp(t, s, v) for v in other.T], axis=1)])
        results: list[Result] = []
        broken = np.flatnonzero((np.diff(t) > GAP_S) | (covered[1:] != covered[:-1])) + 1
        for part in np.split(np.arange(len(t)), broken):
            if len(part) >= 10 and covered[part[0]]:
                results += self._stretch(t_ns[part], t[part], both[part], hinge)
        return results

    def _stretch(
        self, t_ns: IntArray, t: FloatArray, both: FloatArray, hinge: dict[str, Any]
    ) -> list[Result]:
        p = self.params
        dt = np.diff(t, prepend=2 * t[0] - t[1])
        turn, plane, norm = np.zeros(len(t)), [], []
        for i, segment in enumerate(SEGMENTS):
            axis, o = np.array(hinge["axes"][i]), np.array(hinge["positions_m"][i])
            force, rate = both[:, 6 * i : 6 * i + 3], both[:, 6 * i + 3 : 6 * i + 6]
            rate = rate - np.array(hinge.get("gyr_bias_rad_s", np.zeros((2, 3)))[i])
            force = force - np.array(hinge.get("acc_bias_m_s2", np.zeros((2, 3)))[i])
            slope = np.gradient(rate, t, axis=0)
            centre = rate * (rate @ o)[:, None] - o * np.sum(rate**2, axis=1)[:, None] + np.cross(slope, o)
            up = per_segment(p.up, segment)
            mount = mount_of(axis, vector(up, "up") if up else None)
            inside = (force - centre) @ mount.T
            turn += (1.0 if i == 0 else -1.0) * (rate @ axis)
            plane.append(inside)
            norm.append(np.abs(np.linalg.norm(inside, axis=1) - p.gravity))
        u, v = plane
        z = np.arctan2(u[:, 1] * v[:, 2] - u[:, 2] * v[:, 1], u[:, 1] * v[:, 1] + u[:, 2] * v[:, 2])
        rates = np.cumsum(0.5 * dt * (turn + np.r_[turn[0], turn[:-1]]))
        late = np.unwrap(z - rates)
        across = np.minimum(np.hypot(u[:, 1], u[:, 2]), np.hypot(v[:, 1], v[:, 2])) / p.gravity
        sd = (p.sd_angle + p.grow_angle * 0.5 * (norm[0] + norm[1]) / p.gravity) / np.maximum(0.05, across)
        out = np.empty((len(t), 2))
        variance = sd**2 * 2.0 * p.tau_angle / np.maximum(1e-4, dt)
        growth = np.array([p.noise_gyr**2, p.walk_bias**2])
        smooth(dt, late, variance, growth, np.zeros((len(t), 8)), out)
        angle = rates + out[:, 0]
        angle -= 2 * np.pi * np.round(np.median(angle) / (2 * np.pi))
        spread = np.sqrt(np.maximum(0.0, out[:, 1]))
        return [
            result
            for time_ns, a, b in zip(t_ns.tolist(), angle.tolist(), spread.tolist(), strict=True)
            for result in (Result("joint", time_ns, (a,)), Result("sigma", time_ns, (b,)))
        ]

    def remarks(self) -> list[Remark]:
        """Say whether the axes are known."""
        return self._remarks
