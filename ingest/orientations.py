"""Reference angles of joints from the orientations of segments that a source has."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import chain
from typing import Annotated

import msgspec
import numpy as np
import polars as pl
from numpy.typing import NDArray

from ..recording.errors import UsageError
from .anatomy import JOINTS, SIDES
from .contract import ChannelSpec, CommonOptions, ReportBuilder
from .jointangles import FUNCTIONAL, AxisTurn, FloatArray
from .leg import JOINTS as JOINT_SCHEMA
from .leg import QUAT
from .optical import ANGLES_TOPIC

DEVICE_TOPIC = "/reference/device/joint"
"""Angles of the orientations that the sensors' own filter states: beside an optical reference it does not count."""
GAP_NS = 100_000_000
"""Orientations are not interpolated between samples farther apart."""
ROWS = 65_536
"""Rows of a window of angles; the first says what is constant."""
MOST_WINDOWS = 4
"""So many windows of one segment wait for the orientations of another one."""


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
    streams: Sequence[Iterable[tuple[str, pl.DataFrame]]],
    options: OrientationOptions,
    report: ReportBuilder,
    topic: str = ANGLES_TOPIC,
) -> tuple[list[ChannelSpec], Iterable[tuple[str, pl.DataFrame]]]:
    """Return channels and blocks of sources of one clock, and the angles of their orientations, ``topic``.

    Only where there are such angles are sources read side by side.
    """
    axis = axis_of(options.flexion_axis) if options.flexion_axis is not None else None
    joints = joints_of(c.topic for c in channels)
    if not joints:
        return list(channels), chain.from_iterable(streams)
    how = FUNCTIONAL if axis is None else f"twist about {options.flexion_axis} of the frames as they are"
    spec = ChannelSpec(
        topic, JOINT_SCHEMA, "", tuple(joints), {"sign": "upper - lower segment", "definition": how}
    )

    def say(joint: str) -> None:
        report.note("reference_angle", f"{topic} {joint}: {how}", subject=joint)

    wanted = {t for pair in joints.values() for t in pair}
    return [*channels, spec], _behind(_in_step(streams), wanted, topic, _Angles(joints, axis, say))


def _in_step(streams: Sequence[Iterable[tuple[str, pl.DataFrame]]]) -> Iterator[tuple[str, pl.DataFrame]]:
    """Yield the blocks of sources of one clock, always of the one that is behind: little waits for the others."""
    blocks = [iter(stream) for stream in streams]
    times = dict.fromkeys(range(len(streams)), -(2**63))
    while times:
        behind = min(times, key=lambda k: times[k])
        block = next(blocks[behind], None)
        if block is None:
            del times[behind]
            continue
        if block[1].height:
            times[behind] = int(block[1]["t_ns"][-1])
        yield block


def _behind(
    blocks: Iterable[tuple[str, pl.DataFrame]], wanted: set[str], own: str, angles: _Angles
) -> Iterator[tuple[str, pl.DataFrame]]:
    for topic, table in blocks:
        yield topic, table
        if topic in wanted:
            angles.add(topic, table)
            yield from ((own, window) for window in angles.windows(final=False))
    yield from ((own, window) for window in angles.windows(final=True))


class _Angles:
    """Angles of joints, window by window of the times of one segment, from orientations that come in blocks.

    The first window says what is constant (:class:`.jointangles.AxisTurn`).
    """

    def __init__(
        self,
        joints: dict[str, tuple[str, str]],
        axis: FloatArray | None,
        say: Callable[[str], None],
    ) -> None:
        self._joints, self._say = joints, say
        self._turns = {n: AxisTurn(axis, -1.0 if n.endswith("hip") else 1.0) for n in joints}
        self._tables: dict[str, pl.DataFrame] = {}  # from the row before the next window on
        self._pairs: dict[str, tuple[str, str]] = {}  # joints whose segments both have orientations
        self._row = 0  # of the table whose times are taken: begin of the next window

    def add(self, topic: str, table: pl.DataFrame) -> None:
        """Take a block of orientations."""
        before = self._tables.get(topic)
        self._tables[topic] = table if before is None else pl.concat([before, table])

    def windows(self, *, final: bool) -> Iterator[pl.DataFrame]:
        """Yield the angles of the windows for which all orientations are there."""
        while True:
            late = final or any(t.height > MOST_WINDOWS * ROWS for t in self._tables.values())
            if not self._pairs:
                pairs = {n: pair for n, pair in self._joints.items() if set(pair) <= set(self._tables)}
                if not pairs or not (late or len(pairs) == len(self._joints)):
                    return
                self._pairs = pairs
                for name in pairs:
                    self._say(name)
            first = next(iter(self._pairs.values()))[0]
            times = self._tables[first]["t_ns"].to_numpy()[self._row :]
            t_ns = times[:ROWS]
            if not t_ns.size or not (final or times.size > ROWS):
                return
            if not late and any(table["t_ns"][-1] < t_ns[-1] for table in self._tables.values()):
                return
            yield self._window(t_ns)
            self._row += t_ns.size
            if times.size > ROWS:
                self._forget(first, times[ROWS])

    def _window(self, t_ns: NDArray[np.int64]) -> pl.DataFrame:
        angles = {name: np.full(len(t_ns), np.nan) for name in self._joints}
        for name, pair in self._pairs.items():
            upper, lower = (resampled(self._tables[topic], t_ns) for topic in pair)
            angle = self._turns[name].angle(t_ns.astype(np.float64) * 1e-9, upper, lower)
            angles[name] = angles[name] if angle is None else angle
        return pl.DataFrame({"t_ns": t_ns, **angles})

    def _forget(self, first: str, t_ns: int) -> None:
        """Keep of every table what a time needs: the row before it (the first of that row's time) and all later."""
        for topic, table in self._tables.items():
            t = table["t_ns"].to_numpy()
            before = max(0, int(np.searchsorted(t, t_ns)) - 1)
            k = int(np.searchsorted(t, t[before]))
            self._tables[topic] = table[k:]
            if topic == first:
                self._row -= k


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
