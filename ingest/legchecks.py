"""Checks of sensors on segments by what they measure: swapped, mirrored, upside down, still, silent."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence

import msgspec
import numpy as np
import polars as pl
from numpy.typing import NDArray

from ..recording.errors import Finding
from .contract import ChannelSpec, Report, ReportBuilder

FloatArray = NDArray[np.float64]

#: Readings of a sensor that are looked at: an hour at 100 Hz.
MOST_ROWS = 360_000
#: Rows of all sensors and the encoders together that are looked at: an hour of three sensors, half of seven.
MOST_ROWS_IN_ALL = 4 * MOST_ROWS
_WATCHED = re.compile(r"/leg/[^/]+/imu|/leg/encoder")
#: Below this rate (rad/s, rms about its median) a sensor is still; above the other one moves.
STILL_RATE, MOVING_RATE = 0.02, 0.3
#: A silence of more nominal intervals and more seconds than these is said of the sensor.
SILENT_INTERVALS, SILENT_S = 10.0, 0.5
#: Turn of gravity (rad, over seconds) in a sensor above which a person changes posture.
POSTURE_RAD = np.radians(35.0)
#: How much more the wrong one must move.
SWAP_RATIO = 1.2
#: Steps of an angle above this (rad) are a turn of the counter, not of the joint.
WRAP_RAD = np.radians(300.0)


class LegWatch:
    """Looks at ``/leg/<segment>/imu`` and ``/leg/encoder`` of one source while it streams by.

    Parameters
    ----------
    channels : sequence of ChannelSpec
        Of the source. ``axes = segment`` in a channel's metadata says that its axes are the segment's
        (x right, y forward, z up); ``<joint>.upper`` and ``<joint>.lower`` in the encoder's name segments.
    """

    def __init__(self, channels: Sequence[ChannelSpec]) -> None:
        self._specs = {c.topic: c for c in channels if _WATCHED.fullmatch(c.topic)}
        self._most = min(MOST_ROWS, MOST_ROWS_IN_ALL // max(1, len(self._specs)))
        self._parts: dict[str, list[pl.DataFrame]] = {}
        self._rows: dict[str, int] = {}

    def feed(self, topic: str, table: pl.DataFrame) -> None:
        """Keep what is needed of a block."""
        if topic not in self._specs:
            return
        have = self._rows.get(topic, 0)
        if have < self._most:
            self._parts.setdefault(topic, []).append(table[: self._most - have])
            self._rows[topic] = have + table.height

    def finish(self, report: Report) -> Report:
        """Return the report with what was found."""
        if not self._parts:
            return report
        builder = ReportBuilder()
        encoder = self._table("/leg/encoder") if "/leg/encoder" in self._parts else None
        sensors = {topic: _Sensor(self._table(topic)) for topic in list(self._parts)}
        for topic, sensor in sensors.items():
            _silent(topic, sensor, builder)
            _handed(topic, sensor, builder)
            if self._specs[topic].metadata.get("axes") == "segment":
                _upside_down(topic, sensor, builder)
        _still(sensors, builder)
        _swapped(sensors, builder)
        if encoder is not None:
            _encoder(sensors, encoder, self._specs["/leg/encoder"].metadata, builder)
        findings: list[Finding] = builder.build().findings
        if not findings:
            return report
        order = sorted([*report.findings, *findings], key=lambda f: (f.kind, f.first_line or -1))
        return msgspec.structs.replace(report, findings=order, lossy=report.lossy or builder.build().lossy)

    def _table(self, topic: str) -> pl.DataFrame:
        """Return what was kept of a topic, and keep it no longer."""
        return pl.concat(self._parts.pop(topic))


class _Sensor:
    """Readings of one sensor, where all of them are numbers."""

    def __init__(self, table: pl.DataFrame) -> None:
        def axes(kind: str) -> FloatArray:
            names = [f"{kind}_{a}" for a in "xyz"]
            have = set(names) <= set(table.columns)
            return table.select(names).to_numpy() if have else np.full((table.height, 3), np.nan)

        self.t: FloatArray = table["t_ns"].to_numpy() * 1e-9
        self.acc, self.gyr = axes("acc"), axes("gyr")
        steps = np.diff(self.t)
        steps = steps[steps > 0]
        self.step = float(np.median(steps)) if steps.size else 0.01

    @property
    def rate(self) -> float:
        """Rms of the angular rate about its median (rad/s); NaN without a gyroscope."""
        good = self.gyr[np.isfinite(self.gyr).all(axis=1)]
        if not good.size:
            return float("nan")
        return float(np.sqrt(np.mean(np.sum((good - np.median(good, axis=0)) ** 2, axis=1))))

    def turn(self, window_s: float) -> float:
        """Return how far gravity turns in the sensor (rad): spread of the acceleration's mean direction."""
        acc = self.acc[np.isfinite(self.acc).all(axis=1)]
        rows = max(1, round(window_s / self.step))
        count = len(acc) // rows
        if count < 3:
            return 0.0
        mean = acc[: count * rows].reshape(count, rows, 3).mean(axis=1)
        mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-9)
        # The widest angle between a mean direction and the one that is farthest from the middle.
        middle = mean.mean(axis=0)
        far = mean[np.argmin(mean @ middle)]
        return float(np.percentile(np.arccos(np.clip(mean @ far, -1, 1)), 95))


def _silent(topic: str, sensor: _Sensor, report: ReportBuilder) -> None:
    steps = np.diff(sensor.t)
    long = np.flatnonzero(steps > max(SILENT_S, SILENT_INTERVALS * sensor.step))
    if long.size:
        longest = int(long[np.argmax(steps[long])])
        report.loss(
            "sensor_gap",
            f"{topic}: no readings for {steps[longest]:.3g} s from {sensor.t[longest]:.3f} s on (the longest); nothing "
            "is filled in",
            count=long.size,
            subject=topic,
        )


def _handed(topic: str, sensor: _Sensor, report: ReportBuilder) -> None:
    """Gravity turns in a sensor as its gyroscope says: da/dt = -w x a; a wrong sign is a mirrored axis."""
    size = max(1, round(0.04 / sensor.step))
    if len(sensor.t) < 50 * size:
        return
    kernel = np.ones(size) / size
    acc, gyr = (
        np.column_stack([np.convolve(x[:, k], kernel, "same") for k in range(3)])
        for x in (sensor.acc, sensor.gyr)
    )
    span = sensor.t[2 * size :] - sensor.t[: -2 * size]
    slope = (acc[2 * size :] - acc[: -2 * size]) / np.maximum(span, 1e-6)[:, None]
    a, w = acc[size:-size], gyr[size:-size]
    quiet = np.abs(np.linalg.norm(a, axis=1) - 9.8) < 1.5
    even = np.abs(span - 2 * size * sensor.step) < sensor.step
    good = quiet & even & np.isfinite(slope).all(axis=1) & (np.abs(w) < 1e4).all(axis=1)
    if good.sum() < 200:
        return
    slope, a, w = slope[good], a[good], w[good] - np.median(w[good], axis=0)
    units = np.eye(3)
    design = np.stack([-np.cross(w[:, k, None] * units[k], a).ravel() for k in range(3)], axis=1)
    moves = np.sqrt((w**2).mean(axis=0)) > 0.1
    if not moves.any():
        return
    normal = design.T @ design + 1e-9 * np.eye(3)
    sign = np.linalg.solve(normal, design.T @ slope.ravel())
    residual = slope.ravel() - design @ sign
    # Neighbours are alike: a tenth of the samples counts.
    sd = np.sqrt(np.diag(np.linalg.inv(normal)) * residual.var() * 10)
    wrong = [k for k in range(3) if moves[k] and sd[k] < 0.15 and sign[k] + 3 * sd[k] < -0.2]
    if not wrong:
        return
    names = ", ".join(f"gyr_{'xyz'[k]}" for k in wrong)
    if len(wrong) == 2:
        why = f"acc_{'xyz'[3 - sum(wrong)]} has the wrong sign: the axes are mirrored (left-handed)"
    elif len(wrong) == 3:
        why = "the axes are mirrored (left-handed), or the gyroscope's signs are wrong"
    else:
        why = "its sign is wrong, or the axes are mirrored"
    report.note(
        "mirrored",
        f"{topic}: gravity turns against {names} ({', '.join(f'{sign[k]:.2f}' for k in wrong)} of what it "
        f"says): {why}",
        count=len(wrong),
        subject=topic,
    )


def _upside_down(topic: str, sensor: _Sensor, report: ReportBuilder) -> None:
    up = float(np.nanmedian(sensor.acc[:, 2])) if np.isfinite(sensor.acc[:, 2]).any() else 0.0
    if up < -4.9:
        report.note(
            "upside_down",
            f"{topic}: the median of acc_z is {up:.1f} m/s² although z should point up along the segment: the "
            "sensor is upside down; turn it in the mapping (mounting)",
            subject=topic,
        )


def _still(sensors: Mapping[str, _Sensor], report: ReportBuilder) -> None:
    rates = {topic: s.rate for topic, s in sensors.items()}
    if not any(r > MOVING_RATE for r in rates.values()):
        return
    for topic, rate in rates.items():
        if rate < STILL_RATE:
            report.note(
                "still_sensor",
                f"{topic}: its rate is {rate:.2g} rad/s (rms) while others move: a fixed link, or a sensor that "
                "is not on its segment",
                subject=topic,
            )


def _swapped(sensors: Mapping[str, _Sensor], report: ReportBuilder) -> None:
    """Walking: the shank turns faster than the thigh; changing posture: the thigh turns farther."""
    for topic, upper in sensors.items():
        other = topic.replace("thigh", "shank")
        if "thigh" not in topic or other not in sensors:
            continue
        lower = sensors[other]
        if min(upper.rate, lower.rate) < STILL_RATE:  # a fixed link, or a dead sensor: said by _still
            continue
        posture = {name: s.turn(1.5) for name, s in ((topic, upper), (other, lower))}
        if max(posture.values()) > POSTURE_RAD:
            swapped = posture[other] > SWAP_RATIO * posture[topic] > SWAP_RATIO * np.radians(8.0)
            values = [f"{np.degrees(posture[name]):.0f}°" for name in (topic, other)]
            why = "changes of posture turn gravity by {} in the thigh's and {} in the shank's"
        else:
            swapped = upper.rate > MOVING_RATE and upper.rate > SWAP_RATIO * lower.rate
            values = [f"{s.rate:.2g} rad/s" for s in (upper, lower)]
            why = "swinging legs turn at {} (rms) in the thigh's and {} in the shank's"
        if swapped:
            report.note(
                "swapped",
                f"{topic}, {other}: {why.format(*values)} sensor, as if they were exchanged: check which sits where",
                count=2,
                subject=topic,
            )


def _encoder(
    sensors: Mapping[str, _Sensor], table: pl.DataFrame, names: Mapping[str, str], report: ReportBuilder
) -> None:
    """Compare the encoder's rate with the difference of the segments' rates."""
    t = table["t_ns"].to_numpy() * 1e-9
    for joint in table.columns[1:]:
        upper = sensors.get(f"/leg/{names.get(f'{joint}.upper', '')}/imu")
        lower = sensors.get(f"/leg/{names.get(f'{joint}.lower', '')}/imu")
        angle = table[joint].to_numpy()
        good = np.isfinite(angle)
        if upper is None or lower is None or good.sum() < 100 or names.get(f"{joint}.axis") is None:
            continue
        axis = np.array([float(x) for x in names[f"{joint}.axis"].split()])
        rate = np.gradient(angle[good], t[good] + 1e-9 * np.arange(good.sum()))
        both = [np.interp(t[good], s.t, np.nan_to_num(s.gyr @ axis)) for s in (upper, lower)]
        size = max(1, round(0.1 / upper.step))
        smooth = [np.convolve(x, np.ones(size) / size, "same") for x in (rate, both[0] - both[1])]
        if min(np.std(x) for x in smooth) < 0.05:
            continue
        r = float(np.corrcoef(smooth[0], smooth[1])[0, 1])
        if r < -0.3:
            report.note(
                "swapped",
                f"/leg/encoder {joint}: it turns against what the sensors of {names[f'{joint}.upper']} and "
                f"{names[f'{joint}.lower']} say (r = {r:.2f}): they are exchanged, or the encoder's sign is wrong",
                subject=f"encoder {joint}",
            )


def unwrapped(
    blocks: Iterable[tuple[str, pl.DataFrame]], topics: Iterable[str], report: ReportBuilder
) -> Iterator[tuple[str, pl.DataFrame]]:
    """Yield the blocks; angles of ``topics`` that jump by a turn go on without the jump (repair ``angle_wrap``).

    A step of more than 300° between two readings is the counter's, not the joint's.
    """
    wanted, last, turns = set(topics), dict[tuple[str, str], float](), dict[tuple[str, str], float]()
    for topic, table in blocks:
        if topic not in wanted or not table.height:
            yield topic, table
            continue
        changed = {}
        for name in table.columns[1:]:
            angle = table[name].to_numpy()
            good = np.flatnonzero(np.isfinite(angle))
            if not good.size or name.endswith((".vel", ".effort")):
                continue
            key = (topic, name)
            raw = angle[good]
            steps = np.diff(raw, prepend=last.get(key, float(raw[0])))
            jumps = np.where(np.abs(steps) > WRAP_RAD, -2 * np.pi * np.round(steps / (2 * np.pi)), 0.0)
            last[key] = float(raw[-1])
            shift = turns.get(key, 0.0) + np.cumsum(jumps)
            turns[key] = float(shift[-1])
            jumped = np.flatnonzero(jumps)
            if jumped.size:
                when = table["t_ns"][int(good[jumped[0]])] * 1e-9
                report.repair(
                    "angle_wrap",
                    f"{topic} {name}: jumps by {np.degrees(steps[jumped[0]]):.0f}° at {when:.3f} s: goes on without "
                    "the turn",
                    count=jumped.size,
                    rows=int(np.count_nonzero(shift)),
                    subject=f"{topic} {name}",
                )
            if np.any(shift):
                out = angle.copy()
                out[good] = raw + shift
                changed[name] = pl.Series(name, out)
        yield topic, table.with_columns(**changed) if changed else table
