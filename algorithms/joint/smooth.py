"""Offline smoother of a hinge: the whole recording at once, axes and position from all of it. Not causal."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, Any, ClassVar

import numpy as np
import polars as pl

from ..calibration import Calibration, Stretch
from ..contract import AlgorithmError, Context, FloatArray, IntArray, Output, Remark
from ..parameters import meta
from . import chain_smooth
from .calibrate import JointCalibrationParams, JointCalibrator
from .chain_zero import axis_var, innovation_scale
from .common import IMU_COLUMNS, per_segment, states_axis
from .mounting import mounting_remarks
from .relative import ChainEstimator, HingeParams, JointHinge
from .source import JOINT_STATE, NAMED, axis_remarks

SEGMENT = 2048
"""Samples whose covariances are held at once; the forward pass is run again segment by segment, backwards."""


class SmoothParams(HingeParams, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Of ``joint.hinge``; ``identify`` is over the whole recording, as calibration ``joint`` does it."""

    grow_gyr: Annotated[
        float,
        meta(
            "Growth of the gyroscope's noise with the rate; less than online, for the future takes drift out too",
            "1/√Hz",
            "ours",
            ge=0.0,
        ),
    ] = 0.002
    band_hz: Annotated[
        float, meta("Identification: misfits are low-passed here", "Hz", "ours", ge=0.0, le=20.0)
    ] = 1.5
    max_sd_deg: Annotated[
        float, meta("Largest standard deviation of an axis that is called observable", "deg", "ours", gt=0.0)
    ] = 3.0


class JointSmooth(ChainEstimator):
    """Angle of a hinge from two sensors, past and future together. Not causal, for records only.

    Axes and position come from the whole recording as calibration ``joint`` finds them, or from such a calibration.
    With them the filter of ``joint.hinge`` runs forward and a Rauch-Tung-Striebel pass backward over its error
    states: rotations of both segments, so that a joint that wobbles about its hinge does not turn the angle away,
    as it does where rates about fixed axes are integrated. Ours.
    """

    name: ClassVar[str] = "joint.smooth"
    title: ClassVar[str] = "hinge angle of a whole recording, forward and backward"
    source: ClassVar[str] = "ours; Rauch, Tung and Striebel 1965; Weygers and Kok 2020"
    offline: ClassVar[bool] = True
    Params = SmoothParams
    inputs = JointHinge.inputs

    def set_up_joints(self, context: Context) -> None:
        """Write axes; nothing is found on the way."""
        JointHinge.set_up_joints(self, context)  # pyright: ignore[reportArgumentType]
        self.state[0]["learn"], self.state[0]["keep"] = 0, 1

    def outputs_of(self) -> tuple[Output, ...]:
        """Return the angle and its standard deviation."""
        joints = self.joint_names()
        return (
            Output("joint", JOINT_STATE, joints),
            Output("sigma", NAMED, joints, metadata=(("unit", "rad"),)),
        )

    def start(self, context: Context) -> None:
        """Take the joint calibration, and the side of the leg."""
        super().start(context)
        calibration = context.calibrations.get("joint")
        if calibration is not None and not calibration.usable:
            raise AlgorithmError("the joint calibration says not observable; calibrate on other motion")
        self._given = calibration if calibration is not None and calibration.values.get("hinges") else None
        self._kept: list[tuple[IntArray, IntArray, FloatArray]] = []
        self._found: list[Remark] = []

    def run(  # type: ignore[override]
        self,
        state: Any,
        inputs: IntArray,
        channels: IntArray,
        t_ns: IntArray,
        values: FloatArray,
        *results: Any,
    ) -> int:
        """Keep the messages: inputs and times (n,), values (n, widest input)."""
        del state, channels, results
        if len(t_ns):
            self._kept.append((inputs.copy(), t_ns.copy(), values.copy()))
        return 0

    def held(self) -> tuple[IntArray, FloatArray]:
        """Return the smoothed angle and its standard deviation at the thigh's times."""
        nothing = np.zeros(0, np.int64), np.zeros((0, self.width))
        tables = self._tables()
        few = [s for s in self.segments if s not in tables or tables[s].height < 5]
        if few:
            count = tables[few[0]].height if few[0] in tables else 0
            self._found = [Remark("no_data", f"{few[0]}: {count} samples; nothing to smooth", fatal=True)]
            return nothing
        calibration = self._given
        if calibration is None and self.params.identify != "off":
            calibration = self._identified(tables)
            if not calibration.usable:
                self._found = [Remark("not_observable", "; ".join(calibration.remarks), fatal=True)]
                return nothing
            sd = calibration.values["hinges"][0]["axes_sd_deg"]
            self._found = [
                Remark("axis_found", f"hinge axes of the whole recording ± {sd[0]:.1f}° and {sd[1]:.1f}°")
            ]
        if calibration is not None:
            self.state[:] = 0
            self._lay(replace(self.context, calibrations={**self.context.calibrations, "joint": calibration}))
        return self._smoothed()

    def _tables(self) -> Mapping[str, pl.DataFrame]:
        if not self._kept:
            return {}
        which, t_ns, values = (np.concatenate(parts) for parts in zip(*self._kept, strict=True))
        self._kept = [(which, t_ns, values)]
        return {
            need.name: pl.DataFrame(
                {"t_ns": t_ns[mine], **{c: values[mine, k] for k, c in enumerate(IMU_COLUMNS)}}
            )
            for i, need in enumerate(self.inputs[:2])
            if len(mine := np.flatnonzero(which == i))
        }

    def _identified(self, tables: Mapping[str, pl.DataFrame]) -> Calibration:
        p = self.params
        calibrator = JointCalibrator(
            JointCalibrationParams(
                axis=" ".join(
                    f"{s}={per_segment(p.axis, s) or 'x'}"
                    for s in self.segments
                    if states_axis(p, s, self.context.channels)
                ),
                up=p.up,
                sd_gyr=p.misfit_gyr,
                sd_acc=p.misfit_acc,
                gravity=p.gravity,
                band_hz=p.band_hz,
                max_sd_deg=p.max_sd_deg,
            )
        )
        calibration = calibrator.calibrate([Stretch({}, {s: (t,) for s, t in tables.items()})])
        if p.identify == "axes":
            for hinge in calibration.values.get("hinges", ()):
                hinge["positions_m"] = np.zeros((2, 3)).tolist()
        return calibration

    def _smoothed(self) -> tuple[IntArray, FloatArray]:
        """Return times (n,), angles and standard deviations (n, 2)."""
        which, t_ns, values = self._kept[0]
        self._kept = []
        logs = np.zeros(SEGMENT, chain_smooth.LOG)
        starts: list[tuple[Any, int]] = []
        times, encoder = [], []
        message, count = 0, SEGMENT
        while count == SEGMENT:
            starts.append((self.state.copy(), message))
            message, count = chain_smooth.forward(self.state, which, t_ns, values, logs, message)
            times.append(logs["t_ns"][:count].copy())
            encoder.append(logs["enc"][:count].copy())
        smoothed: list[FloatArray] = []
        work, after = np.zeros(1, chain_smooth.WORK), np.zeros(1, chain_smooth.LOG)
        end = self.state.copy()
        for state, first in reversed(starts):
            self.state[:] = state
            _, count = chain_smooth.forward(self.state, which, t_ns, values, logs, first)
            out = np.zeros((count, 2))
            chain_smooth.backward(self.state, logs, count, after, work, out)
            smoothed.insert(0, out)
        self.state[:] = end
        when, angles = np.concatenate(times), np.concatenate(smoothed)
        if len(when):
            self._settle(when, angles, np.concatenate(encoder))
        return when, angles

    def _settle(self, t_ns: IntArray, angles: FloatArray, encoder: FloatArray) -> None:
        """Take out whole turns and the zero, in place; put the zero's uncertainty into the standard deviation."""
        s, p = self.state[0], self.params
        angles[:, 0] = np.unwrap(angles[:, 0])
        spread = float(s["mount_var"])
        off = 0.0
        angles[:, 1] *= np.sqrt(innovation_scale(s, 0))
        if s["zero"]:
            early = t_ns <= t_ns[0] + round(p.zero_s * 1e9)
            apart = angles[:, 0] - (encoder if p.zero == "encoder" else 0.0)
            early &= np.isfinite(apart)
            if early.any():
                off, spread = float(np.mean(apart[early])), float(np.mean(angles[early, 1] ** 2))
        else:
            off = 2 * np.pi * float(np.round(np.median(angles[:, 0]) / (2 * np.pi)))
        angles[:, 0] -= off
        loose = axis_var(self.state[0], 0.0)  # it is a + b angle²
        unknown = loose + (axis_var(self.state[0], 1.0) - loose) * angles[:, 0] ** 2
        angles[:, 1] = np.sqrt(angles[:, 1] ** 2 + spread + s["tilt_var"] + unknown)

    def snapshot(self) -> Any:
        """Return what was taken so far."""
        return list(self._kept), self.state.copy()

    def restore(self, snapshot: Any) -> None:
        """Go back to what was taken at ``snapshot``."""
        kept, self.state[:] = snapshot
        self._kept = list(kept)

    def finds_axes(self) -> bool:
        """Whether the axes are found from the motion."""
        return self.params.identify != "off"

    def remarks(self) -> list[Remark]:
        """Say whether the axes are known."""
        if any(r.fatal for r in self._found):
            return self._found
        s = self.state[0]
        remarks = self._found + (mounting_remarks(s, self.segments) if self._found else [])
        return super().remarks() + (remarks or axis_remarks(s, self.segments, fatal=False))
