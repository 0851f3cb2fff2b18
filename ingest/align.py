"""One clock for a recording of two: the optical clock against the inertial one, by the angular rates of a segment.

The norm of the angular rate does not depend on frames or mounting. Cross-correlation gives the offset to a sample;
least squares then refine offset, drift and gain: rate_imu(offset + (1 + drift) t) = gain · rate_optical(t).
"""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from .. import recording as mr
from ..recording.errors import MarchaError

FloatArray = NDArray[np.float64]

RATE_HZ = 100.0
"""Common rate of the comparison."""
BAND_HZ = 5.0
"""Both rates are low-passed here."""
LEAST_R = 0.8
"""Below this correlation an alignment is refused."""


class ClockFit(msgspec.Struct, frozen=True):
    """How one clock runs against the other: ``t_imu = offset_s + (1 + drift_ppm 1e-6) t_optical``.

    Attributes
    ----------
    offset_s, drift_ppm : float
        The fit.
    offset_sd_s, drift_sd_ppm : float
        Standard deviations from the residual; neighbours within a cycle of the band count once.
    correlation : float
        Of both rates at the fit: the quality figure.
    overlap_s : float
        Time in which both were measured.
    """

    offset_s: float
    drift_ppm: float
    offset_sd_s: float
    drift_sd_ppm: float
    correlation: float
    overlap_s: float


def fit_clocks(t_imu: FloatArray, gyr: FloatArray, t_optical: FloatArray, rot: FloatArray) -> ClockFit:
    """Fit the optical clock to the inertial one.

    Parameters
    ----------
    t_imu, gyr : ndarray
        Times (s) and angular rates (rad/s, (n, 3)) of a sensor.
    t_optical, rot : ndarray
        Times (s) and attitudes (m, 3, 3) of the same segment; frames without one are left out of both.

    Raises
    ------
    MarchaError
        Too little data or motion, or no agreement.
    """
    from scipy.signal import correlate, correlation_lags

    a0, a = _even(t_imu, gyr)
    middle, rate = _optical_rate(t_optical, rot)
    b0, b = _even(middle, rate)
    if min(len(a), len(b)) < 3 * RATE_HZ:
        raise MarchaError("alignment: inertial and optical need at least 3 s each")
    x, y = (np.nan_to_num(np.linalg.norm(v, axis=1)) for v in (a, b))
    if min(np.std(x), np.std(y)) < 0.05:
        raise MarchaError("alignment: hardly any motion in one of the two; give the offset instead")
    score = correlate(x - x.mean(), y - y.mean(), method="fft")
    lag = int(correlation_lags(len(x), len(y))[np.argmax(score)])
    tb = b0 + np.arange(len(y)) / RATE_HZ
    ta = a0 + np.arange(len(x)) / RATE_HZ
    offset, drift, gain = a0 + lag / RATE_HZ - b0, 0.0, 1.0
    seen = np.isfinite(b).all(axis=1)
    slope = np.gradient(x, 1 / RATE_HZ)
    middle_t = float(tb[seen].mean())
    offset += drift * middle_t
    normal, residual, inside = np.eye(3), np.zeros(1), seen
    for _ in range(8):
        at = tb + offset + drift * (tb - middle_t)
        inside = seen & (at > ta[20]) & (at < ta[-20])
        if inside.sum() < 3 * RATE_HZ:
            raise MarchaError("alignment: the two overlap by less than 3 s: no common motion in time")
        now, rise = np.interp(at[inside], ta, x), np.interp(at[inside], ta, slope)
        residual = gain * y[inside] - now
        design = np.column_stack((rise, rise * (tb[inside] - middle_t), -y[inside]))
        normal = design.T @ design
        step = np.linalg.solve(normal, design.T @ residual)
        offset, drift, gain = offset + step[0], drift + step[1], gain + step[2]
        if abs(step[0]) < 1e-7:
            break
    at = tb[inside] + offset + drift * (tb[inside] - middle_t)
    r = float(np.corrcoef(np.interp(at, ta, x), y[inside])[0, 1])
    if not r >= LEAST_R:
        raise MarchaError(
            f"alignment: the rates agree with r = {r:.2f} only: another segment, or no common motion?"
        )
    sd = np.sqrt(np.diag(np.linalg.inv(normal)) * residual.var() * RATE_HZ / (2 * BAND_HZ))
    return ClockFit(
        offset_s=float(offset - drift * middle_t),
        drift_ppm=float(drift * 1e6),
        offset_sd_s=float(sd[0]),
        drift_sd_ppm=float(sd[1] * 1e6),
        correlation=r,
        overlap_s=float(inside.sum() / RATE_HZ),
    )


def align(source: Path | str, out: Path | str, segment: str, *, overwrite: bool = False) -> ClockFit:
    """Write a recording again with the optical clock moved to the inertial one.

    Parameters
    ----------
    source, out : path
        Recordings; the metadata record ``clocks`` of the source says which topics share the optical clock.
    segment : str
        Compares ``/leg/<segment>/imu`` with ``/reference/<segment>/orientation``, or its markers ``<segment>_1`` ….
    overwrite : bool
        Replace an existing recording.

    Raises
    ------
    MarchaError
        A channel is missing, the clocks are one already, or nothing agrees.
    """
    rec = mr.open(source)
    clocks = rec.metadata.get("clocks", {})
    imu = f"/leg/{segment}/imu"
    if imu not in rec.channels:
        raise MarchaError(f"{source}: has no channel {imu}; name another segment")
    topic = f"/reference/{segment}/orientation"
    if topic not in rec.channels or clocks.get(topic) == clocks.get(imu):
        topic = "/reference/markers"
    if topic not in rec.channels or clocks.get(topic) == clocks.get(imu):
        raise MarchaError(
            f"{source}: has no optical channel of {segment} on a clock of its own; nothing to align"
        )
    table = rec.table(imu)
    t_imu = table["t_ns"].to_numpy() * 1e-9
    gyr = table.select("gyr_x", "gyr_y", "gyr_z").to_numpy()
    t_optical, rot = _attitudes(rec, topic, segment, source)
    fit = fit_clocks(t_imu, gyr, t_optical, rot)
    moved = {name for name, clock in clocks.items() if clock == clocks[topic]}
    with mr.create(out, overwrite=overwrite) as written:
        for name, channel in rec.channels.items():
            values = rec.table(name)
            if name in moved:
                t = values["t_ns"].to_numpy()
                shifted = t + np.rint(fit.offset_s * 1e9 + fit.drift_ppm * 1e-6 * t).astype(np.int64)
                keep = shifted >= 0
                values = values.with_columns(t_ns=shifted).filter(keep)
            written.add_channel(
                name,
                channel.schema,
                frame_id=channel.frame_id,
                columns=tuple(values.columns[1:]),
                metadata=channel.metadata,
            )
            if values.height:
                written.add_table(name, channel.schema, values, frame_id=channel.frame_id)
        for name, record in rec.metadata.items():
            if name != "clocks":
                written.add_metadata(name, dict(record))
        fitted = {k: f"{v:.9g}" for k, v in msgspec.to_builtins(fit).items()}
        topics = ", ".join(sorted(moved))
        written.add_metadata("alignment", {"method": "rates", "segment": segment, "moved": topics, **fitted})
    return fit


def _attitudes(
    rec: mr.Recording, topic: str, segment: str, source: Path | str
) -> tuple[FloatArray, FloatArray]:
    from scipy.spatial.transform import Rotation

    table = rec.table(topic)
    t = table["t_ns"].to_numpy() * 1e-9
    if topic.endswith("/orientation"):
        quat = table.select("quat_w", "quat_x", "quat_y", "quat_z").to_numpy()
        return t, Rotation.from_quat(quat, scalar_first=True).as_matrix()
    names = [c[:-2] for c in table.columns if c.startswith(f"{segment}_") and c.endswith(".x")]
    if len(names) < 3:
        raise MarchaError(f"{source}: {topic} has {len(names)} markers {segment}_…; a segment needs three")
    pos = table.select(f"{n}.{a}" for n in names for a in "xyz").to_numpy().reshape(len(t), -1, 3)
    whole = np.isfinite(pos).all(axis=(1, 2))
    if whole.sum() < 10:
        raise MarchaError(f"{source}: the markers of {segment} are hardly ever seen together")
    return t[whole], cluster_rotations(pos[whole])


def cluster_rotations(pos: FloatArray) -> FloatArray:
    """Return the attitude of a rigid cluster (n, markers, 3) against its first frame (Kabsch 1976)."""
    centred = pos - pos.mean(axis=1, keepdims=True)
    u, _, vt = np.linalg.svd(np.einsum("nmi,mj->nij", centred, centred[0]))
    u[:, :, 2] *= np.sign(np.linalg.det(u @ vt))[:, None]
    return u @ vt


def _optical_rate(t: FloatArray, rot: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return angular rates (rad/s, in n) between neighbouring frames, at their middle; never across a gap."""
    from scipy.spatial.transform import Rotation

    step = np.diff(t)
    near = (step > 0) & (step < 1.8 * np.median(step))
    turn = Rotation.from_matrix(rot[1:][near] @ np.swapaxes(rot[:-1][near], 1, 2)).as_rotvec()
    return (0.5 * (t[1:] + t[:-1]))[near], turn / step[near][:, None]


def _even(t: FloatArray, values: FloatArray) -> tuple[float, FloatArray]:
    """Return the first time and values at :data:`RATE_HZ`, low-passed without delay; NaN in gaps and near them."""
    from scipy.signal import butter, sosfiltfilt

    good = np.isfinite(values).all(axis=1)
    t, values = t[good], values[good]
    if len(t) < 30:
        raise MarchaError("alignment: fewer than 30 readings on one side")
    grid = np.arange(t[0], t[-1], 1 / RATE_HZ)
    even = np.column_stack([np.interp(grid, t, values[:, k]) for k in range(3)])
    even = sosfiltfilt(butter(2, 2 * BAND_HZ / RATE_HZ, output="sos"), even, axis=0)
    ends = np.flatnonzero(np.diff(t) > max(3 * np.median(np.diff(t)), 2 / RATE_HZ))
    for k in ends:
        even[(grid > t[k] - 0.1) & (grid < t[k + 1] + 0.1)] = np.nan
    return float(grid[0]), even
