"""Reference angles of joints from the orientations of segments that a source has."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Annotated

import msgspec
import numpy as np
import polars as pl
from numpy.typing import NDArray

from ..recording.errors import UsageError
from .anatomy import FUNCTIONAL, JOINTS, SIDES, FloatArray, functional, twist
from .contract import ChannelSpec, CommonOptions, ReportBuilder
from .leg import JOINTS as JOINT_SCHEMA
from .leg import QUAT
from .optical import ANGLES_TOPIC

DEVICE_TOPIC = "/reference/device/joint"
"""Angles of the orientations that the sensors' own filter states: beside an optical reference it does not count."""
GAP_NS = 100_000_000
"""Orientations are not interpolated between samples farther apart."""


class OrientationOptions(CommonOptions, frozen=True, kw_only=True):
    """How reference angles are made of orientations.

    Attributes
    ----------
    flexion_axis : str or None
        Axis of the joints in the frames of the orientations.
    """

    flexion_axis: Annotated[
        str | None,
        msgspec.Meta(
            description="reference angles from orientations: the turn about this axis of their frames (x, -y, or three "
            "numbers); without it about the main axis of the motion, zero in the first second"
        ),
    ] = None


def axis_of(text: str) -> FloatArray:
    """Return a unit vector for ``x``, ``-z`` or ``0.1,0.9,0``.

    Raises
    ------
    UsageError
        It is none of these.
    """
    plain = text.strip()
    if plain.lstrip("-") in ("x", "y", "z"):
        return (-1.0 if plain.startswith("-") else 1.0) * np.eye(3)["xyz".index(plain[-1])]
    try:
        axis = np.array([float(part) for part in plain.split(",")])
    except ValueError:
        axis = np.zeros(0)
    if axis.shape != (3,) or not np.linalg.norm(axis) > 0:
        raise UsageError(f"option flexion_axis={text!r}: must be x, -x … or three numbers such as 0.1,0.9,0")
    return axis / np.linalg.norm(axis)


def joints_of(topics: Iterable[str]) -> dict[str, tuple[str, str]]:
    """Return the joints whose two segments have orientations: name to upper and lower topic."""
    have = {t.split("/")[-2]: t for t in topics if t.endswith("/orientation")}
    joints = {}
    for prefix in ("", *(f"{side}_" for side in SIDES)):
        for joint, (up, low) in JOINTS.items():
            above = up if prefix + up not in have else prefix + up
            if above in have and prefix + low in have:
                joints[prefix + joint] = have[above], have[prefix + low]
    return joints


def with_angles(
    channels: Sequence[ChannelSpec],
    blocks: Iterable[tuple[str, pl.DataFrame]],
    options: OrientationOptions,
    report: ReportBuilder,
    topic: str = ANGLES_TOPIC,
) -> tuple[list[ChannelSpec], Iterable[tuple[str, pl.DataFrame]]]:
    """Return channels and blocks of a source with the angles of its orientations, ``topic``, behind them."""
    axis = axis_of(options.flexion_axis) if options.flexion_axis is not None else None
    joints = joints_of(c.topic for c in channels)
    if not joints:
        return list(channels), blocks
    how = FUNCTIONAL if axis is None else f"twist about {options.flexion_axis} of the frames as they are"
    spec = ChannelSpec(
        topic, JOINT_SCHEMA, "", tuple(joints), {"sign": "upper - lower segment", "definition": how}
    )
    return [*channels, spec], _behind(blocks, joints, topic, axis, how, report)


def _behind(
    blocks: Iterable[tuple[str, pl.DataFrame]],
    joints: dict[str, tuple[str, str]],
    own: str,
    axis: FloatArray | None,
    how: str,
    report: ReportBuilder,
) -> Iterator[tuple[str, pl.DataFrame]]:
    wanted = {topic for pair in joints.values() for topic in pair}
    kept: dict[str, list[pl.DataFrame]] = {}
    for topic, table in blocks:
        if topic in wanted:
            kept.setdefault(topic, []).append(table)
        yield topic, table
    tables = {topic: pl.concat(parts) for topic, parts in kept.items()}
    pairs = {name: pair for name, pair in joints.items() if set(pair) <= set(tables)}
    if not pairs:
        return
    first = next(iter(pairs.values()))[0]
    t_ns = tables[first]["t_ns"].to_numpy()
    angles = {}
    for name in joints:
        angle = np.full(len(t_ns), np.nan)
        if name in pairs:
            upper, lower = (resampled(tables[topic], t_ns) for topic in pairs[name])
            if axis is not None:
                angle = twist(upper, lower, axis)
            else:
                fitted = functional(t_ns * 1e-9, upper, lower, -1.0 if name.endswith("hip") else 1.0)
                angle = angle if fitted is None else fitted
            report.note("reference_angle", f"{own} {name}: {how}", subject=name)
        angles[name] = angle
    yield own, pl.DataFrame({"t_ns": t_ns, **angles})


def resampled(table: pl.DataFrame, t_ns: NDArray[np.int64]) -> FloatArray:
    """Return attitudes (n, 3, 3) at given times, by slerp; NaN where the neighbours are more than 0.1 s apart."""
    from scipy.spatial.transform import Rotation, Slerp

    out = np.full((len(t_ns), 3, 3), np.nan)
    quat = table.select(QUAT).to_numpy()
    own = table["t_ns"].to_numpy()
    good = np.isfinite(quat).all(axis=1) & np.r_[True, np.diff(np.maximum.accumulate(own)) > 0]
    own, quat = own[good], quat[good]
    if len(own) < 2:
        return out
    turns = Rotation.from_quat(quat, scalar_first=True)
    k = np.clip(np.searchsorted(own, t_ns, side="right") - 1, 0, len(own) - 2)
    exact = (own[k] == t_ns) | (own[k + 1] == t_ns)
    inside = (t_ns >= own[0]) & (t_ns <= own[-1]) & (exact | (own[k + 1] - own[k] <= GAP_NS))
    zero = own[0]
    out[inside] = Slerp((own - zero) * 1e-9, turns)((t_ns[inside] - zero) * 1e-9).as_matrix()
    return out
