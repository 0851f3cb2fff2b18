"""Views of linked segments: joint angles beside their reference with the error in its sigma band, orientations
of segments, the segments themselves as a moving figure, optical markers.
"""

# ruff: noqa: D102 - begin, draw and end are documented once, in View

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import polars as pl
import rerun as rr
from numpy.typing import NDArray

from ...recording.rotations import xyzw_from_wxyz
from ...replay.alignment import match
from .. import style
from ..canvas import ESTIMATES, JOINTS, RAW, Canvas, ChannelLike, Floats, Times, columns_of, entity
from ..curve import Curve
from ..text import printable
from .base import View, role_of
from .common import EULER, Values, euler_deg, slug

FIGURE, MARKERS = "segments", "markers"
AXIS_ENDS = tuple(f"_{a}" for a in EULER)
JOINT_ENDS = ("_abduction", "_rotation")
LABELS = 12
"""Most markers whose names stand beside them without being asked; beyond, the one under the mouse says its own."""
ROOM = 1.4
"""How much of the view markers may leave free around them."""
MAX_GAP_S = 0.1
"""A reference is not interpolated over longer gaps."""

BONES: dict[str, tuple[float, float, float]] = {
    "trunk": (0.0, 0.0, 0.5),
    "pelvis": (0.0, 0.0, 0.15),
    "thigh": (0.0, 0.0, -0.42),
    "shank": (0.0, 0.0, -0.41),
    "foot": (0.0, 0.2, 0.0),
}
"""Where a segment ends, seen from its proximal joint, in its own frame (x right, y forward, z up), m. A
channel's metadata ``bone_x``, ``bone_y``, ``bone_z`` say it for other segments."""

OTHER_BONE = (0.0, 0.0, -0.3)
PARENTS = {"shank": "thigh", "foot": "shank"}
"""Which segment a segment hangs on; trunk and thighs meet at the hips."""


def series_of(canvas: Canvas) -> dict[tuple[str, str], Curve]:
    """Return the canvas's angles over time by topic and joint."""
    return canvas.store.setdefault("joint angles", {})


class Angles(View):
    """Joint angles, one panel a joint that runs, reference and encoder share; rates and torques."""

    title = "joint angles beside their reference, error, rates, torques"
    schemas = ("sensor_msgs/msg/JointState",)
    KINDS = ((".vel", "angular rate", "°/s", style.DEGREES), (".effort", "torque", "N m", 1.0))

    def begin(self) -> None:
        canvas = self.canvas
        self.columns: dict[str, tuple[str, float]] = {}
        color = style.DEVICE if self.role == "raw" else self.color
        tab = JOINTS
        self.joints = [c for c in self.channel.columns if not c.endswith((".vel", ".effort"))]
        for joint in self.joints:
            kinds = (("", "angle", "°", style.DEGREES), *self.KINDS)
            for suffix, title, unit, factor in kinds:
                if joint + suffix in self.channel.columns:
                    path = f"{self.path}/{slug(joint)}{suffix.replace('.', '/')}"
                    self.columns[joint + suffix] = (path, factor)
                    canvas.lines(path, [f"{self.owner} {joint} ({unit})"], [color])
                    panel = f"{joint} {title} ({unit})"
                    stack = f"{hinge_of(joint)} {title}"
                    canvas.show("plot", path, tab=tab, panel=panel, owner=self.owner, stack=stack, alone=True)
            series_of(canvas)[self.channel.topic, joint] = Curve()

    def draw(self, t_ns: Times, block: pl.DataFrame) -> None:
        for column, (path, factor) in self.columns.items():
            if column not in block.columns:  # declared by a recording of other makers, in no message
                continue
            values = columns_of(block, [column], [factor])[:, 0]
            self.canvas.scalars(path, t_ns, values)
            if column in self.joints:
                series_of(self.canvas)[self.channel.topic, column].add(t_ns, values)

    def end(self) -> None:
        if self.role == "estimate":
            draw_errors(self, self.joints)


def draw_errors(view: View, names: Sequence[str]) -> None:
    """Log the error of every angle of a run that has a reference."""
    canvas, topic = view.canvas, view.channel.topic
    for name in names:
        other = angle_reference(canvas, view.channel, name)
        if other is None:
            continue
        t_ns, error = difference(series_of(canvas)[topic, name], series_of(canvas)[other])
        if t_ns.size:
            path = f"{view.path}/{slug(name)}/error"
            canvas.lines(path, [f"{view.owner} {name} error (°)"], [view.color])
            canvas.scalars(path, t_ns, error)
            stack = error_stack(name)
            canvas.show("plot", path, tab=JOINTS, panel=error_panel(name), owner=view.owner, stack=stack)


class Attitudes(Values):
    """Angles of segments as named values (``thigh_roll``), beside those of the reference's orientation."""

    title = "angles of segments, beside the reference's"
    priority = 1

    @classmethod
    def fits(cls, channel: ChannelLike) -> bool:
        names = channel.columns
        return super().fits(channel) and bool(names) and all(c.endswith(AXIS_ENDS) for c in names)

    def begin(self) -> None:
        super().begin()
        for name in self.shown:
            series_of(self.canvas)[self.channel.topic, name] = Curve()
            entity_path = f"{self.path}/{slug(name)}"
            self.canvas.lines(entity_path, [f"{self.owner} {name.replace('_', ' ')} (°)"], [self.color])

    def _show(self, name: str, path: str, panel: str) -> None:
        segment, _, axis = name.rpartition("_")
        panel = f"{segment} {axis} (°)"
        self.canvas.show("plot", path, tab=JOINTS, panel=panel, owner=self.owner, stack=segment, alone=True)

    def draw(self, t_ns: Times, block: pl.DataFrame) -> None:
        super().draw(t_ns, block)
        for name, shown in self.shown.items():
            values = columns_of(block, [name], [shown.factor])[:, 0]
            series_of(self.canvas)[self.channel.topic, name].add(t_ns, values)

    def end(self) -> None:
        super().end()
        if self.role == "estimate":
            draw_errors(self, list(self.shown))


def hinge_of(joint: str) -> str:
    """Return the joint without its axis: the three angles of a knee lie behind each other, flexion first."""
    for end in JOINT_ENDS:
        joint = joint.removesuffix(end)
    return joint


def error_stack(name: str) -> str:
    """Return the stack of an angle's error: the axes of a segment or a joint lie behind each other."""
    return f"{name.rpartition('_')[0] if name.endswith(AXIS_ENDS) else hinge_of(name)} error"


def error_panel(joint: str) -> str:
    """Return the name of the panel of a joint's error."""
    return f"{joint.replace('_', ' ')} error and ±1σ (°)"


def angle_reference(canvas: Canvas, channel: ChannelLike, joint: str) -> tuple[str, str] | None:
    """Return topic and name of the angle that a run's joint is compared with.

    A reference before an encoder, the same name before an only one.
    """
    for role in ("reference", "raw"):
        candidates = [k for k in series_of(canvas) if role_of(k[0]) == role and k[0] != channel.topic]
        same = [k for k in candidates if k[1] == joint]
        if same:
            return same[0]
        candidates = [k for k in candidates if not k[1].endswith(AXIS_ENDS)]
        own = [k for k in series_of(canvas) if k[0] == channel.topic]
        if len(candidates) == len(own) == 1 and not joint.endswith(AXIS_ENDS):
            return candidates[0]
    return None


def difference(own: Curve, truth: Curve) -> tuple[Times, Floats]:
    """Return times (n,) and estimate minus reference (n,), ° in [−180, 180), where both are known."""
    t, v = own.finite()
    t_ref, v_ref = truth.finite()
    if len(t_ref) < len(t):  # the denser one is interpolated, at the times of the sparser one
        pairs = match(t_ref, t, MAX_GAP_S)
        t_ns, error = t_ref[pairs.index], pairs.linear(v[:, None])[:, 0] - v_ref[pairs.index]
    else:
        pairs = match(t, t_ref, MAX_GAP_S)
        t_ns, error = t[pairs.index], v[pairs.index] - pairs.linear(v_ref[:, None])[:, 0]
    return t_ns, (error + 180.0) % 360.0 - 180.0


class AngleSigma(Values):
    """Stated standard deviations of joint angles: a band about zero in the panel of the joint's error."""

    title = "stated standard deviations of joint angles, as bands"
    priority = 1

    @classmethod
    def fits(cls, channel: ChannelLike) -> bool:
        return (
            super().fits(channel)
            and channel.topic.endswith("/sigma")
            and role_of(channel.topic) == "estimate"
        )

    def begin(self) -> None:
        parent = self.channel.topic.rpartition("/")[0]
        joints = {
            c
            for other in self.canvas.channels
            if other.schema == "sensor_msgs/msg/JointState" and other.topic.startswith(f"{parent}/")
            for c in other.columns
        }
        self.bands = {c: j for c in self.channel.columns if (j := plain_name(c)) in joints}
        super().begin()
        for column, joint in self.bands.items():
            path = f"{self.path}/{slug(column)}/band"
            archetype = rr.Measurements.from_fields(
                names=f"{self.owner} ±1σ {joint}", units="°", colors=style.rgb(self.color), widths=0.5
            )
            self.canvas.static(path, archetype)
            stack = error_stack(joint)
            self.canvas.show(
                "plot", path, tab=JOINTS, panel=error_panel(joint), owner=self.owner, stack=stack
            )

    def draw(self, t_ns: Times, block: pl.DataFrame) -> None:
        super().draw(t_ns, block)
        for column in self.bands:
            sigma = columns_of(block, [column], [style.DEGREES])[:, 0]
            if np.isfinite(sigma).any():
                columns = rr.Measurements.columns(values=np.zeros(len(t_ns)), variances=sigma * sigma)
                self.canvas.columns(f"{self.path}/{slug(column)}/band", t_ns, columns)


def plain_name(column: str) -> str:
    """Return the joint that a column of sigma speaks of: ``sigma_knee_rad`` is the knee's."""
    return column.removeprefix("sigma_").removesuffix("_rad")


class Orientation(View):
    """An orientation as roll, pitch and yaw; of a segment also as a bone of the moving figure."""

    title = "orientations as roll, pitch, yaw, and segments as a moving figure"
    schemas = ("geometry_msgs/msg/QuaternionStamped",)
    needs = ("quat_w", "quat_x", "quat_y", "quat_z")

    def begin(self) -> None:
        canvas = self.canvas
        self.segment = segment_of(self.channel.topic)
        color = self.color if self.role != "raw" else style.DEVICE
        if self.segment is None:
            canvas.lines(self.path, [f"{a} (°)" for a in EULER], style.AXES)
            panel = f"{self.owner} {self.what} (°)" if self.role == "estimate" else f"{self.owner} (°)"
            tab = ESTIMATES if self.role == "estimate" else RAW
            canvas.show("plot", self.path, tab=tab, panel=panel, owner=self.owner, alone=True)
            return
        for axis in EULER:
            series_of(canvas)[self.channel.topic, f"{self.segment}_{axis}"] = Curve()
            path = f"{self.path}/{axis}"
            canvas.lines(path, [f"{self.owner} {axis} (°)"], [color])
            panel = f"{self.segment} {axis} (°)"
            canvas.show("plot", path, tab=JOINTS, panel=panel, owner=self.owner, stack=self.segment)
        holder = holder_of(canvas, self.channel)
        self.figure = f"{holder}/figure"
        side, kind = split_side(self.segment)
        self.bone = bone_of(self.channel, kind)
        self.tips = tips_of(canvas, self.figure)
        parent = side + PARENTS.get(kind, "")
        above = [
            segment_of(c.topic) for c in canvas.channels if canvas.group(c.topic).startswith(f"{holder}/")
        ]
        self.above = parent if kind in PARENTS and parent in above else previous(canvas, self.channel)
        self.waiting: list[tuple[Times, Floats]] = []
        self.entity = f"{self.figure}/{slug(self.segment)}"
        ends = np.array([[0.0, 0.0, 0.0], self.bone], dtype=np.float32)
        rgb = style.rgb(color)
        bone = rr.LineStrips3D([ends], colors=rgb, radii=0.02 if self.role != "reference" else 0.012)
        canvas.static(f"{self.entity}/bone", bone)
        canvas.static(f"{self.entity}/axes", rr.TransformAxes3D(0.12))
        label = rr.Points3D([ends[1] * 0.5], labels=[self.segment], colors=rgb, radii=0.005, show_labels=True)
        canvas.static(f"{self.entity}/name", label)
        for part in ("bone", "axes", "name"):
            entity_path = f"{self.entity}/{part}"
            canvas.show("space", entity_path, tab=JOINTS, panel=FIGURE, owner=self.owner)

    def draw(self, t_ns: Times, block: pl.DataFrame) -> None:
        turn = columns_of(block, [f"quat_{a}" for a in "wxyz"])
        angles = euler_deg(turn)
        if self.segment is None:
            self.canvas.scalars(self.path, t_ns, angles)
            return
        for i, axis in enumerate(EULER):
            self.canvas.scalars(f"{self.path}/{axis}", t_ns, angles[:, i])
            series_of(self.canvas)[self.channel.topic, f"{self.segment}_{axis}"].add(t_ns, angles[:, i])
        good = np.isfinite(turn).all(axis=1)
        self.waiting.append((t_ns[good], turn[good]))
        self._bones(whole=False)

    def end(self) -> None:
        if self.segment is not None:
            self._bones(whole=True)
            if self.role == "estimate":
                draw_errors(self, [f"{self.segment}_{axis}" for axis in EULER])

    def _bones(self, whole: bool) -> None:
        """Log the bone where the end of the one above is known; hold it where that one has ended."""
        if not self.waiting:
            return
        t_ns = np.concatenate([t for t, _ in self.waiting])
        turn = np.concatenate([q for _, q in self.waiting])
        above = self.tips.get(self.above or "")
        ready = np.ones(len(t_ns), bool)
        if self.above is not None and not whole:
            ready = np.zeros(len(t_ns), bool) if above is None else t_ns <= above.t_ns[-1]
        self.waiting = [(t_ns[~ready], turn[~ready])]
        t_ns, turn = t_ns[ready], turn[ready]
        if not t_ns.size:
            return
        start = np.zeros((len(t_ns), 3)) if above is None else above.at(t_ns)
        end = start + rotated(turn, np.asarray(self.bone))
        tip = self.tips.setdefault(self.segment or "", Tips())
        tip.add(t_ns, end)
        self.canvas.reach(self.canvas.solid.setdefault(FIGURE, []), np.concatenate([start, end]))
        columns = rr.Transform3D.columns(
            translation=start.astype(np.float32), quaternion=xyzw_from_wxyz(turn).astype(np.float32)
        )
        self.canvas.columns(self.entity, t_ns, columns)


class Tips:
    """Where a segment ends, over the newest stretch of time: what hangs on it begins there."""

    KEPT = 20_000

    def __init__(self) -> None:
        self.t_ns: Times = np.empty(0, dtype=np.int64)
        self.places: Floats = np.empty((0, 3))

    def add(self, t_ns: Times, places: Floats) -> None:
        """Append places (n, 3), m."""
        self.t_ns = np.concatenate([self.t_ns, t_ns])[-self.KEPT :]
        self.places = np.concatenate([self.places, places])[-self.KEPT :]

    def at(self, t_ns: Times) -> Floats:
        """Return places (n, 3) at other times."""
        zero = self.t_ns[0]
        own, t = (self.t_ns - zero) / 1e9, (t_ns - zero) / 1e9
        return np.column_stack([np.interp(t, own, p) for p in self.places.T])


def tips_of(canvas: Canvas, figure: str) -> dict[str, Tips]:
    """Return the ends of the segments of one figure."""
    return canvas.store.setdefault(f"tips {figure}", {})


def rotated(quat_wxyz: Floats, vector: Floats) -> Floats:
    """Return a body vector (3,) in the navigation frame, for orientations (n, 4): shape (n, 3)."""
    w, u = quat_wxyz[:, :1], quat_wxyz[:, 1:]
    cross = np.cross(u, vector)
    return vector + 2 * (w * cross + np.cross(u, cross))


def segment_of(topic: str) -> str | None:
    """Return the segment that an orientation's topic speaks of; None where it is no segment's.

    ``/estimate/<run>/thigh``, ``/reference/left_shank``, ``/leg/thigh/orientation``,
    ``/reference/thigh/orientation``, ``segment3``.
    """
    for part in reversed(topic.split("/")[1:]):
        kind = split_side(part)[1]
        if kind in BONES or (kind.startswith("segment") and kind[7:].strip("_").isdigit()):
            return part
    return None


def holder_of(canvas: Canvas, channel: ChannelLike) -> str:
    """Return the entity whose segments hang together: ``/run/<run>``, ``/reference`` of ``…/thigh/orientation``."""
    parent = canvas.group(channel.topic).rpartition("/")[0]
    above, _, last = parent.rpartition("/")
    return above if last == entity(segment_of(channel.topic) or "").strip("/") and above else parent


def split_side(name: str) -> tuple[str, str]:
    """Return side and kind of a segment: ``left_thigh`` is ("left_", "thigh")."""
    for side in ("left_", "right_", "l_", "r_"):
        if name.startswith(side):
            return side, name[len(side) :]
    return "", name


def bone_of(channel: ChannelLike, kind: str) -> tuple[float, float, float]:
    """Return where a segment ends, (3,), m: as the channel's metadata says, else as is usual."""
    try:
        x, y, z = (float(channel.metadata[f"bone_{a}"]) for a in "xyz")
    except (KeyError, ValueError):
        return BONES.get(kind, OTHER_BONE)
    return x, y, z


def previous(canvas: Canvas, channel: ChannelLike) -> str | None:
    """Return, for a numbered segment, the one before it in the same figure."""
    name = segment_of(channel.topic) or ""
    if not name.startswith("segment"):
        return None
    parent = holder_of(canvas, channel)
    before = f"segment{name[7:].rstrip('0123456789')}{int(name[7:].strip('_')) - 1}"
    there = [segment_of(c.topic) for c in canvas.channels if canvas.group(c.topic).startswith(parent)]
    return before if before in there else None


class Markers(View):
    """Optical markers as points with their names, which the eye follows, and their heights over time."""

    title = "optical markers as points, and their heights"
    schemas = ("marcha_msgs/msg/OpticalMarkers",)

    def begin(self) -> None:
        canvas = self.canvas
        self.names = [c.removesuffix(".x") for c in self.channel.columns if c.endswith(".x")]
        self.entity = f"{self.path}/points"
        named = [rr.AnnotationInfo(i, printable(name)) for i, name in enumerate(self.names)]
        described = rr.ClassDescription(info=(0, ""), keypoint_annotations=named)
        look = rr.Points3D.from_fields(
            colors=style.rgb(self.color),
            radii=rr.Radius.ui_points(5.0),
            class_ids=0,
            show_labels=len(named) <= LABELS,
        )
        canvas.static(self.entity, rr.AnnotationContext([described]), look)
        canvas.show("space", self.entity, tab=JOINTS, panel=MARKERS, owner=self.owner)
        colors = [style.run_color(i) for i in range(len(self.names))]
        self.heights = f"{self.path}/height"
        canvas.lines(self.heights, [f"{n} z (m)" for n in self.names], colors)
        panel = f"{self.owner} heights of markers (m)"
        canvas.show("plot", self.heights, tab=RAW, panel=panel, owner=self.owner)

    def draw(self, t_ns: Times, block: pl.DataFrame) -> None:
        if not self.names:  # another program's markers, without names
            return
        places = np.stack(
            [columns_of(block, [f"{n}.{a}" for a in "xyz"]) for n in self.names], axis=1
        )  # (rows, markers, 3)
        self.canvas.scalars(self.heights, t_ns, places[:, :, 2])
        seen = np.asarray(np.isfinite(places).all(axis=2))
        self._frame(places, seen)
        columns = rr.Points3D.columns(
            positions=places[seen].astype(np.float32),
            keypoint_ids=np.broadcast_to(np.arange(len(self.names), dtype=np.uint16), seen.shape)[seen],
        ).partition(seen.sum(axis=1))
        self.canvas.columns(self.entity, t_ns, columns)

    def _frame(self, places: Floats, seen: NDArray[np.bool_]) -> None:
        """Zoom to the markers of one moment: over a whole capture the way through the room is the larger."""
        rows = seen.any(axis=1)
        if not rows.any():
            return
        shown = np.where(seen[..., None], places, np.nan)[rows]
        low, high = np.nanmin(shown, axis=1), np.nanmax(shown, axis=1)
        half = ROOM * (high - low) / 2
        self.canvas.reach(self.canvas.solid.setdefault(MARKERS, []), np.concatenate([-half, half]))
        self.canvas.followed.setdefault(MARKERS, self.entity)
