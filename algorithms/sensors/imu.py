"""Calibration of accelerometer and gyroscope from still positions and the rotations between them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, ClassVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from ..calibration import Calibration, Calibrator, Stretch
from ..contract import AlgorithmError, FloatArray, Input
from ..numerics.compiled import compiled
from ..parameters import meta

ACC = ("acc_x", "acc_y", "acc_z")
GYR = ("gyr_x", "gyr_y", "gyr_z")
_TEDALDI = "Tedaldi, Pretto, Menegatti 2014, ICRA"


class ImuCalibrationParams(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What counts as still, and what is fitted."""

    gravity: Annotated[float, meta("Local gravity", "m/s²", "standard gravity", gt=9.0, lt=10.0)] = 9.80665
    still_s: Annotated[float, meta("Shortest still position that counts", "s", _TEDALDI, gt=0.0, le=60.0)] = (
        1.0
    )
    still_acc: Annotated[
        float,
        meta("Still: greatest spread of f in a window", "m/s²", "ours, measured on shoes at rest", gt=0.0),
    ] = 0.15
    still_gyr: Annotated[
        float,
        meta("Still: greatest spread of ω in a window", "rad/s", "ours, measured on shoes at rest", gt=0.0),
    ] = 0.02


MAX_OFFSET = 0.2
"""rad/s: a steady rate above this is a turn, not the offset of a gyroscope."""


class ImuCalibration(Calibrator):
    """Offset, scale and skew of the accelerometer, offset and matrix of the gyroscope.

    Still positions are found by the spread within windows. The accelerometer's ``M (f − b)``, M upper
    triangular, makes the norm of every position's mean equal to gravity (nine unknowns: nine positions
    in different directions, or six for offsets and scales alone). The gyroscope's offset is its mean where it is
    still; with an accelerometer that is calibrated its matrix turns gravity from each position to the next as
    measured there (Tedaldi et al. 2014, eqs 10 and 17). What the positions cannot determine is left out, and
    said.
    """

    name: ClassVar[str] = "imu"
    title: ClassVar[str] = "accelerometer and gyroscope from still positions and the rotations between them"
    source: ClassVar[str] = _TEDALDI
    Params: ClassVar[type[msgspec.Struct]] = ImuCalibrationParams
    inputs = (Input("imu", "sensor_msgs/msg/Imu", (*ACC, *GYR), regular=True),)

    def calibrate(self, stretches: Sequence[Stretch]) -> Calibration:
        """Return what the still positions say.

        Raises
        ------
        AlgorithmError
            The sensor is never still.
        """
        p: Any = self.params
        means: list[FloatArray] = []
        rates: list[FloatArray] = []
        weights: list[int] = []
        noise: list[float] = []  # variance of a position's mean, along one axis
        turns: list[tuple[int, FloatArray, FloatArray]] = []  # from position, time steps, rates to the next
        topic = ""
        for stretch in stretches:
            topic = stretch.channels["imu"][0].topic
            table = stretch.tables["imu"][0]
            t = table["t_ns"].to_numpy() / 1e9
            acc, gyr = table.select(ACC).to_numpy(), table.select(GYR).to_numpy()
            spans = still_spans(t, acc, gyr, p.still_s, p.still_acc, p.still_gyr)
            for k, (a, b) in enumerate(spans):
                if k:
                    before = spans[k - 1][1]
                    turns.append((len(means) - 1, np.diff(t[before - 1 : a + 1]), gyr[before : a + 1]))
                means.append(acc[a:b].mean(axis=0))
                rates.append(gyr[a:b].mean(axis=0))
                weights.append(b - a)
                noise.append(float(acc[a:b].var(axis=0).mean()) / (b - a))
        if not means:
            raise AlgorithmError(
                f"{topic or 'the IMU'} is never still for {p.still_s:g} s (spread below {p.still_acc:g} m/s² and "
                f"{p.still_gyr:g} rad/s); hold it in several positions, or raise still_acc and still_gyr"
            )
        force, rate, weight = np.array(means), np.array(rates), np.array(weights, float)
        bias = np.average(rate, axis=0, weights=weight)
        values: dict[str, Any] = {"gyr_offset_rad_s": bias.tolist(), "still_positions": len(means)}
        covariance: dict[str, list[list[float]]] = {}
        remarks: list[str] = []
        if len(means) > 1:
            covariance["gyr_offset_rad_s"] = (np.cov(rate.T, aweights=weight) / len(means)).tolist()
        fitted = _fit_accelerometer(force, p.gravity, float(np.mean(noise)))
        if fitted is None:
            remarks.append(
                f"accelerometer left as it is: {len(means)} still position(s) do not determine it; "
                "hold each of the six sides up, better nine directions"
            )
        else:
            matrix, offset, spread, skewed = fitted
            values |= {"acc_matrix": matrix.tolist(), "acc_offset_m_s2": offset.tolist()}
            covariance["acc_offset_m_s2"] = spread.tolist()
            residual = np.linalg.norm((force - offset) @ matrix.T, axis=1) - p.gravity
            values["acc_residual_rms_m_s2"] = float(np.sqrt(np.mean(residual**2)))
            if not skewed:
                remarks.append("fewer than nine directions: scales and offsets of the accelerometer, no skew")
            turned = _fit_gyroscope((force - offset) @ matrix.T, turns, bias)
            if turned is None:
                remarks.append(
                    "gyroscope: offset only; its scale needs rotations between positions about every axis"
                )
            else:
                values["gyr_matrix"] = turned[0].tolist()
                values["gyr_residual_rms_deg"] = turned[1]
        return Calibration(
            kind=self.name, subject=topic, values=values, covariance=covariance, remarks=remarks
        )


def still_spans(
    t: FloatArray, acc: FloatArray, gyr: FloatArray, least_s: float, acc_max: float, gyr_max: float
) -> list[tuple[int, int]]:
    """Return half-open sample ranges in which the sensor is still for at least ``least_s``.

    Parameters
    ----------
    t : ndarray, shape (n,)
        Seconds.
    acc, gyr : ndarray, shape (n, 3)
        m/s², rad/s.
    least_s, acc_max, gyr_max : float
        Shortest stretch, and the greatest standard deviation (norm over the axes) in a window of a quarter of it.
    """
    if len(t) < 8:
        return []
    width = max(4, round(0.25 * least_s / max(float(np.median(np.diff(t))), 1e-6)))
    if len(t) < width:
        return []
    rate, spread = _window_mean(gyr, width), _spread(gyr, width)
    quiet = (_spread(acc, width) < acc_max) & (spread < gyr_max) & (np.linalg.norm(rate, axis=1) < MAX_OFFSET)
    covered = np.zeros(len(t) + 1, np.int64)  # a sample is still where a quiet window holds it
    starts = np.flatnonzero(quiet)
    np.add.at(covered, starts, 1)
    np.add.at(covered, np.minimum(starts + width, len(t)), -1)
    still = np.concatenate(([0], (np.cumsum(covered)[:-1] > 0).astype(np.int8), [0]))
    edges = np.diff(still)
    begins, ends = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)
    margin = width // 2  # a window at the edge may hold the first of the motion
    spans = [(int(a) + margin, int(b) - margin) for a, b in zip(begins, ends, strict=True)]
    return [(a, b) for a, b in spans if b - a > 2 and t[b - 1] - t[a] >= least_s - 2 * margin * (t[1] - t[0])]


def _spread(values: FloatArray, width: int) -> FloatArray:
    """Return the standard deviation (norm over the axes) in every window of ``width`` samples."""
    centred = values - values.mean(axis=0)
    sums = np.cumsum(np.vstack((np.zeros(3), centred)), axis=0)
    squares = np.cumsum(np.vstack((np.zeros(3), centred**2)), axis=0)
    mean = (sums[width:] - sums[:-width]) / width
    variance = (squares[width:] - squares[:-width]) / width - mean**2
    return np.sqrt(np.maximum(variance, 0.0).sum(axis=1))


def _window_mean(values: FloatArray, width: int) -> FloatArray:
    sums = np.cumsum(np.vstack((np.zeros(3), values)), axis=0)
    return (sums[width:] - sums[:-width]) / width


def _fit_accelerometer(
    force: FloatArray, gravity: float, least_variance: float
) -> tuple[FloatArray, FloatArray, FloatArray, bool] | None:
    """Return matrix, offset, covariance of the offset, and whether skew was fitted; None where undetermined.

    A few more positions than unknowns leave residuals that are small by chance: the variance is at least that of a
    position's mean.
    """
    from scipy.optimize import least_squares

    for skewed in (True, False):
        unknowns = 9 if skewed else 6
        if len(force) < unknowns:
            continue

        def model(x: FloatArray, skewed: bool = skewed) -> tuple[FloatArray, FloatArray]:
            m = np.diag(x[:3])
            if skewed:
                m[0, 1], m[0, 2], m[1, 2] = x[6:]
            return m, x[3:6]

        def residual(x: FloatArray) -> FloatArray:
            m, b = model(x)
            return np.linalg.norm((force - b) @ m.T, axis=1) - gravity

        start = np.concatenate((np.ones(3), np.zeros(unknowns - 3)))
        solution = least_squares(
            residual, start, x_scale=np.concatenate((np.ones(3), np.full(unknowns - 3, 0.1)))
        )
        normal = solution.jac.T @ solution.jac
        if np.linalg.cond(solution.jac) > 1e4:
            continue
        noise = max(float(np.sum(solution.fun**2)) / max(1, len(force) - unknowns), least_variance)
        spread = np.linalg.inv(normal) * noise
        m, b = model(solution.x)
        if np.abs(m - np.eye(3)).max() > 0.3 or np.abs(b).max() > 3.0:
            continue  # far beyond any sensor: the positions do not determine it
        return m, b, spread[3:6, 3:6], skewed
    return None


def _fit_gyroscope(
    gravity_b: FloatArray, turns: Sequence[tuple[int, FloatArray, FloatArray]], bias: FloatArray
) -> tuple[FloatArray, float] | None:
    """Return the gyroscope's matrix and the residual in degrees; None where the rotations do not determine it."""
    from scipy.optimize import least_squares

    direction = gravity_b / np.linalg.norm(gravity_b, axis=1, keepdims=True)
    used = [(i, dt, np.ascontiguousarray(w - bias)) for i, dt, w in turns if len(dt) == len(w) and len(w) > 2]
    if len(used) < 5:  # two equations each, nine unknowns
        return None

    def residual(x: FloatArray) -> FloatArray:
        matrix = np.eye(3) + x.reshape(3, 3)
        parts = []
        for i, dt, w in used:
            turned = np.empty(3)
            turn_back(direction[i], dt, w @ matrix.T, turned)
            parts.append(turned - direction[i + 1])
        return np.concatenate(parts)

    solution = least_squares(residual, np.zeros(9), x_scale=0.05)
    if np.linalg.cond(solution.jac) > 1e3 or np.abs(solution.x).max() > 0.3:
        return None
    error = np.degrees(np.linalg.norm(solution.fun.reshape(-1, 3), axis=1))
    return np.eye(3) + solution.x.reshape(3, 3), float(np.sqrt(np.mean(error**2)))


@compiled
def turn_back(direction: NDArray[Any], dt: NDArray[Any], rate: NDArray[Any], out: NDArray[Any]) -> None:
    """Turn a fixed direction of the room, given in body axes, while the body turns with ``rate`` (n, 3)."""
    x, y, z = direction[0], direction[1], direction[2]
    for k in range(rate.shape[0]):
        ax, ay, az = -rate[k, 0] * dt[k], -rate[k, 1] * dt[k], -rate[k, 2] * dt[k]
        angle = np.sqrt(ax * ax + ay * ay + az * az)
        s = np.sin(angle) / angle if angle > 1e-12 else 1.0
        c = (1.0 - np.cos(angle)) / (angle * angle) if angle > 1e-6 else 0.5
        cx, cy, cz = ay * z - az * y, az * x - ax * z, ax * y - ay * x  # a × v
        dx, dy, dz = ay * cz - az * cy, az * cx - ax * cz, ax * cy - ay * cx  # a × (a × v)
        x, y, z = x + s * cx + c * dx, y + s * cy + c * dy, z + s * cz + c * dz
    out[0], out[1], out[2] = x, y, z
