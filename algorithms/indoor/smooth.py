"""``indoor.smooth``: the filter of ``indoor.fused`` run forward and backward over a whole recording."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable
from typing import Any, ClassVar

import msgspec
import numpy as np
import polars as pl

from ..contract import FloatArray, IntArray, Message, PlainEstimator, Remark, Result
from .cloud import Cloud, scatter
from .fused import IndoorFused, IndoorFusedParams
from .steps import detect_steps

STEPS, ACCELERATIONS, ORIENTATIONS, PRESSURES = 2, 3, 4, 5
"""Inputs of ``indoor.fused`` by number."""


class IndoorSmooth(PlainEstimator):
    """Forward and backward filters combined; offline.

    The backward filter takes the same powers, ranges and steps in reversed order of time (a step goes the other way).
    Both expect the same radio map and so share its error: they are combined by covariance intersection with equal
    weights (Julier and Uhlmann 1997), which is never too sure whatever they share.
    """

    name: ClassVar[str] = "indoor.smooth"
    title: ClassVar[str] = "indoor.fused forward and backward over the whole recording; offline"
    source: ClassVar[str] = (
        "Fraser and Potter 1969 (two-filter smoother); Julier and Uhlmann 1997 (combination)"
    )
    Params: ClassVar[type[msgspec.Struct]] = IndoorFusedParams
    presets: ClassVar = IndoorFused.presets
    offline: ClassVar[bool] = True
    inputs = IndoorFused.inputs
    outputs = IndoorFused.outputs[:2]

    def start(self, context: Any) -> None:
        """Prepare both filters; the backward one starts anywhere."""
        self.ahead, self.back = IndoorFused(self.params), IndoorFused(self.params)
        self.ahead.start(context)
        self.back.start(context)
        cloud: Cloud = self.back.state
        p = self.params
        if len(self.back.storeys) > 1:
            cloud.s["start_floor"] = -1
        scatter(
            cloud,
            math.nan,
            0.0,
            p.start_sd_m,
            math.radians(p.heading_sd_deg),
            p.scale_sd,
        )
        self.kept: list[tuple[int, int, int, tuple[Any, ...]]] = []

    def take(self, message: Message) -> Iterable[Result]:
        """Keep a message for the end."""
        index = next(i for i, one in enumerate(self.inputs) if one.name == message.input)
        channel = self.ahead.channel_index(index, message.channel)
        self.kept.append((index, channel, message.t_ns, message.values))
        return ()

    def finish(self) -> Iterable[Result]:
        """Return the whole track."""
        if not self.kept:
            return []
        inputs = np.array([k[0] for k in self.kept])
        channels = np.array([k[1] for k in self.kept])
        t_ns = np.array([k[2] for k in self.kept], dtype=np.int64)
        values = np.full((len(self.kept), 4), np.nan)
        for index, channel in sorted(set(zip(inputs.tolist(), channels.tolist(), strict=True))):
            mine = np.flatnonzero((inputs == index) & (channels == channel))
            rows = [self.kept[k][3] for k in mine.tolist()]
            table = pl.DataFrame(
                rows, schema=list(self.inputs[index].columns), orient="row", infer_schema_length=None
            )
            encoded = self.ahead.encode(index, channel, table)
            values[mine, : encoded.shape[1]] = encoded
        self.kept = []
        order = np.argsort(t_ns, kind="stable")
        inputs, channels, t_ns, values = inputs[order], channels[order], t_ns[order], values[order]
        when, ahead, stepped = self._forward(inputs, channels, t_ns, values)
        if not len(when):
            return []
        back = self._backward(inputs, channels, t_ns, values, stepped)
        results: list[Result] = []
        for t, one in zip(when.tolist(), ahead, strict=True):
            x, y, z, sx, sy, _ = one
            other = back.get(t)
            if other is not None:
                w = np.array([1 / sx**2, 1 / sy**2]), np.array([1 / other[3] ** 2, 1 / other[4] ** 2])
                total = 0.5 * (w[0] + w[1])
                x, y = (0.5 * (w[0] * (x, y) + w[1] * other[:2]) / total).tolist()
                sx, sy = np.sqrt(1.0 / total).tolist()
            results += [Result("position", t, (x, y, z)), Result("sigma", t, (sx, sy, math.nan))]
        return results

    def _run(
        self, filter_: IndoorFused, inputs: Any, channels: Any, t_ns: IntArray, values: FloatArray
    ) -> tuple[IntArray, IntArray, FloatArray]:
        n = len(t_ns)
        causes, when, out = np.zeros(n, np.int64), np.zeros(n, np.int64), np.full((n, 6), np.nan)
        count = filter_.run(filter_.state, inputs, channels, t_ns, values, causes, when, out)
        return causes[:count], when[:count], out[:count]

    def _forward(
        self, inputs: Any, channels: Any, t_ns: IntArray, values: FloatArray
    ) -> tuple[IntArray, FloatArray, dict[int, float]]:
        """Return times and results, and the heading of steps that the filter detected itself, by message."""
        one = self.ahead.state.s[0]
        azimuth = np.full(len(t_ns), np.nan)
        if one["own_steps"]:
            walk = self.ahead.state.walk.copy()
            detect_steps(walk[0], inputs == ACCELERATIONS, inputs == ORIENTATIONS, t_ns, values, azimuth)
        turned = azimuth - one["x_axis"] if one["mirrored"] else one["x_axis"] - azimuth
        headings = {int(m): float(turned[m]) for m in np.flatnonzero(np.isfinite(azimuth))}
        _, when, out = self._run(self.ahead, inputs, channels, t_ns, values)
        last = np.append(np.diff(when) > 0, True)  # of several at one time the last knows all of it
        return when[last], out[last], headings

    def _backward(
        self, inputs: Any, channels: Any, t_ns: IntArray, values: FloatArray, stepped: dict[int, float]
    ) -> dict[int, FloatArray]:
        """Return what the filter says that has only seen what comes after a time, by that time."""
        keep = np.flatnonzero(
            (inputs <= STEPS) | (inputs == PRESSURES) | np.isin(np.arange(len(inputs)), list(stepped))
        )[::-1]
        kinds, backward = inputs[keep].copy(), values[keep].copy()
        for row, m in enumerate(keep.tolist()):
            if m in stepped:
                kinds[row], backward[row, :2] = STEPS, (self.params.step_m, stepped[m])
            if kinds[row] == STEPS:
                backward[row, 1] += math.pi
        mirrored = t_ns[-1] + t_ns[0] - t_ns[keep]
        _, when, out = self._run(self.back, kinds, channels[keep], mirrored, backward)
        real = t_ns[-1] + t_ns[0] - when
        # the state before the message at a time: what the forward filter has there is not taken twice
        states: dict[int, FloatArray] = {}
        for k in range(1, len(real)):
            if real[k] < real[k - 1]:
                states[int(real[k])] = out[k - 1]
        return states

    def snapshot(self) -> Any:
        """Return what was taken so far."""
        return list(self.kept), self.ahead.snapshot(), self.back.snapshot()

    def restore(self, snapshot: Any) -> None:
        """Go back to what was taken at ``snapshot``."""
        kept, ahead, back = snapshot
        self.kept = list(kept)
        self.ahead.restore(ahead)
        self.back.restore(back)

    def remarks(self) -> list[Remark]:
        """Say what a user must know of the run."""
        if not hasattr(self, "ahead"):
            return []
        remarks = self.ahead.remarks()
        return [dataclasses.replace(r, fatal=False) if self.kept else r for r in remarks]
