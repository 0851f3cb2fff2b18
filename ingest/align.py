"""One clock for a recording of two: the optical clock is moved to the inertial one."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np
import polars as pl
from numpy.typing import NDArray

from .. import recording as mr
from ..recording.errors import MarchaError, UsageError
from ..recording.files import require_other
from .anatomy import cluster_attitude
from .clockfit import ClockFit, FloatArray, Pair, from_events, from_rates, stated_fit, turn_rate
from .leg import JOINTS, MARKERS_TOPIC, marker_names

GYR = ("gyr_x", "gyr_y", "gyr_z")
FASTEST_RAD_S = 1e4
"""No sensor of a limb turns faster: a damaged number."""


def align(
    source: Path | str,
    out: Path | str,
    segment: str | None = None,
    *,
    offset_s: float | None = None,
    drift_ppm: float = 0.0,
    events: Sequence[tuple[float, float]] = (),
    overwrite: bool = False,
) -> ClockFit:
    """Write a recording again with the optical clock moved to the inertial one.

    Parameters
    ----------
    source, out : path
        Recordings; the metadata record ``clocks`` of the source says which topics share the optical clock.
    segment : str, optional
        Compares the rates of this segment alone: ``/leg/<segment>/imu`` with an orientation or cluster of that
        name. Without it of all segments that both have.
    offset_s, drift_ppm : float
        Inertial minus optical time, and drift, where they are known: nothing is compared then.
    events : sequence of (float, float)
        Inertial and optical time (s) of what both saw; one gives the offset, more the drift too.
    overwrite : bool
        Replace an existing recording.

    Raises
    ------
    MarchaError
        A channel is missing, the clocks are one already, or nothing agrees.
    UsageError
        Two ways at once.
    """
    if sum((offset_s is not None, bool(events), segment is not None)) > 1:
        raise UsageError("offset, event and segment are three ways to align; give one")
    rec = mr.open(source)
    clocks = rec.metadata.get("clocks", {})
    inertial, optical = _two_clocks(rec, clocks, source, segment)
    segments: list[str] = []
    if offset_s is not None:
        fit = stated_fit(offset_s, drift_ppm)
    elif events:
        fit = from_events(events)
    else:
        pairs = _pairs(rec, clocks, inertial, optical, segment, source)
        fit, segments = from_rates(list(pairs.values())), list(pairs)
    moved = {name for name, clock in clocks.items() if clock == optical and name in rec.channels}
    _write(rec, Path(out), fit, moved, inertial, ", ".join(segments), overwrite)
    return fit


def _two_clocks(
    rec: mr.Recording, clocks: dict[str, str], source: Path | str, segment: str | None
) -> tuple[str, str]:
    """Return the names of the inertial and of the optical clock."""
    sensors = [t for t in rec.channels if t.startswith("/leg/") and t.endswith("/imu")]
    if segment is not None:
        if f"/leg/{segment}/imu" not in rec.channels:
            raise MarchaError(f"{source}: has no channel /leg/{segment}/imu; name another segment")
        sensors = [f"/leg/{segment}/imu"]
    if not sensors:
        raise MarchaError(f"{source}: has no inertial sensor /leg/<segment>/imu")
    own = clocks.get(sensors[0], "")
    others = {
        c: t for t, c in clocks.items() if t.startswith("/reference/") and c != own and t in rec.channels
    }
    if not others:
        raise MarchaError(
            f"{source}: has no optical channel of {segment or 'a segment'} on a clock of its own; nothing to align"
        )
    if len(others) > 1:
        raise MarchaError(
            f"{source}: references on several clocks ({', '.join(others)}); convert them one by one"
        )
    return own, next(iter(others))


def _pairs(
    rec: mr.Recording,
    clocks: dict[str, str],
    inertial: str,
    optical: str,
    segment: str | None,
    source: Path | str,
) -> dict[str, Pair]:
    """Return what can be compared, by segment; a joint's angle where there is no segment."""
    names = [
        t.split("/")[2]
        for t in rec.channels
        if t.startswith("/leg/") and t.endswith("/imu") and clocks.get(t) == inertial
    ]
    pairs = {}
    for name in names if segment is None else [segment]:
        rates = _optical_rates(rec, clocks, optical, name)
        if rates is not None:
            table = rec.table(f"/leg/{name}/imu")
            pairs[name] = Pair(table["t_ns"].to_numpy() * 1e-9, table.select(GYR).to_numpy(), *rates)
    if not pairs and segment is None:
        pairs = _joint_pairs(rec, clocks, optical, names)
    if not pairs:
        raise MarchaError(
            f"{source}: no orientation, cluster of three markers {segment or 'SEGMENT'}_… or joint angle on the other "
            "clock to compare with; give --offset or --event"
        )
    return pairs


def _optical_rates(
    rec: mr.Recording, clocks: dict[str, str], optical: str, segment: str
) -> tuple[FloatArray, FloatArray] | None:
    """Return times and body rates of a segment as the cameras saw it."""
    from scipy.spatial.transform import Rotation

    for topic in (f"/reference/{segment}/orientation", f"/reference/optical/{segment}/orientation"):
        if topic in rec.channels and clocks.get(topic) == optical and rec.channels[topic].count > 30:
            table = rec.table(topic)
            quat = table.select("quat_w", "quat_x", "quat_y", "quat_z").to_numpy()
            good = np.isfinite(quat).all(axis=1)
            rot = Rotation.from_quat(quat[good], scalar_first=True).as_matrix()
            return turn_rate(table["t_ns"].to_numpy()[good] * 1e-9, rot)
    if MARKERS_TOPIC not in rec.channels or clocks.get(MARKERS_TOPIC) != optical:
        return None
    table = rec.table(MARKERS_TOPIC)
    names = [n for n in marker_names(table.columns) if n.startswith(f"{segment}_")]
    if len(names) < 3:
        return None
    pos = table.select(f"{n}.{a}" for n in names for a in "xyz").to_numpy().reshape(table.height, -1, 3)
    rot, *_ = cluster_attitude(pos)
    good = np.isfinite(rot).all(axis=(1, 2))
    if good.sum() < 30:
        return None
    return turn_rate(table["t_ns"].to_numpy()[good] * 1e-9, rot[good])


def _joint_pairs(
    rec: mr.Recording, clocks: dict[str, str], optical: str, segments: Sequence[str]
) -> dict[str, Pair]:
    """Return the rate of a reference's knee, hip or ankle beside the rates of both segments about their main axes."""
    from .anatomy import JOINTS as BETWEEN

    topics = [
        t
        for t, c in rec.channels.items()
        if t.startswith("/reference/") and c.schema == JOINTS and clocks.get(t) == optical
    ]
    pairs = {}
    for topic in topics:
        table = rec.table(topic)
        for joint, (upper, lower) in BETWEEN.items():
            column = next(
                (c for c in table.columns if joint in c.lower() and not c.endswith((".vel", ".effort"))), None
            )
            if column is None or not {upper, lower} <= set(segments):
                continue
            t, angle = table["t_ns"].to_numpy() * 1e-9, table[column].to_numpy()
            good = np.isfinite(angle)
            step = np.diff(t[good])
            near = (step > 0) & (step < 1.8 * np.median(step))
            rate = (np.diff(np.unwrap(angle[good])) / np.maximum(step, 1e-9))[near]
            sensors = [rec.table(f"/leg/{s}/imu") for s in (upper, lower)]
            base = sensors[0]["t_ns"].to_numpy() * 1e-9
            main = [_about_main_axis(s, base) for s in sensors]
            middle = (0.5 * (t[good][1:] + t[good][:-1]))[near]
            options = [main[0] - main[1], main[0] + main[1]]
            for k, turn in enumerate(options):
                pairs[f"{joint} {'+-'[k]}"] = Pair(base, turn[:, None], middle, rate[:, None])
    if not pairs:
        return {}
    # The signs of the two main axes are not known: the sum or the difference, whichever agrees better.
    scored = {}
    for name, pair in pairs.items():
        try:
            scored[name] = from_rates([pair]).correlation
        except MarchaError:
            continue
    best = max(scored, key=lambda n: scored[n]) if scored else next(iter(pairs))
    return {best.split()[0]: pairs[best]}


def _about_main_axis(table: pl.DataFrame, t: FloatArray) -> FloatArray:
    """Return the rate about its main axis (n,), at times ``t``."""
    gyr = table.select(GYR).to_numpy()
    gyr = gyr - np.nanmedian(gyr, axis=0)
    good = (np.abs(gyr) < FASTEST_RAD_S).all(axis=1)
    axis = np.linalg.eigh(gyr[good].T @ gyr[good])[1][:, 2]
    return np.interp(t, table["t_ns"].to_numpy()[good] * 1e-9, gyr[good] @ axis)


def _write(
    rec: mr.Recording,
    out: Path,
    fit: ClockFit,
    moved: set[str],
    inertial: str,
    segments: str,
    overwrite: bool,
) -> None:
    """Write every channel, those of ``moved`` at inertial times; nothing is lost: all begin later where needed."""

    def shifted(t: NDArray[np.int64]) -> NDArray[np.int64]:
        return t + np.rint(fit.offset_s * 1e9 + fit.drift_ppm * 1e-6 * t).astype(np.int64)

    starts = [
        int(shifted(np.array([c.start_ns]))[0]) for n, c in rec.channels.items() if n in moved and c.count
    ]
    later = max(0, -min(starts, default=0))
    require_other(out, [rec.path])
    with mr.create(out, overwrite=overwrite) as written:
        for name, channel in rec.channels.items():
            if name.startswith("/annotation/"):
                continue
            values = rec.table(name)
            t = values["t_ns"].to_numpy()
            values = values.with_columns(t_ns=(shifted(t) if name in moved else t) + later)
            written.add_channel(
                name,
                channel.schema,
                frame_id=channel.frame_id,
                columns=tuple(values.columns[1:]),
                metadata=channel.metadata,
            )
            if values.height:
                written.add_table(name, channel.schema, values, frame_id=channel.frame_id)
        marks = rec.annotations
        if marks.height:
            written.add_annotations(marks.with_columns(pl.col("start_ns", "end_ns") + later))
        for item in rec.attachments:
            written.add_attachment(item.name, rec.attachment(item.name), item.media_type)
        for name, record in rec.metadata.items():
            if name == "clocks":
                clocks = {t: inertial if t in moved else c for t, c in record.items()}
                if len(set(clocks.values())) > 1:
                    written.add_metadata(name, clocks)
            elif name != "alignment":
                written.add_metadata(name, dict(record))
        fitted = {k: v if isinstance(v, str) else f"{v:.9g}" for k, v in msgspec.to_builtins(fit).items()}
        facts = {"moved": ", ".join(sorted(moved)), "segment": segments, "all_later_s": f"{later * 1e-9:.9g}"}
        written.add_metadata("alignment", {**facts, **fitted})
