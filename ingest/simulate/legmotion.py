"""How trunk and legs move in a simulated capture: joint angles over time, and the chain that they bend.

Frames. Navigation n: x forward at the start, y left, z up. Segment s (trunk, thigh, shank, foot): origin in
its proximal joint (trunk: between the hips), x to the right (the flexion axis), y forward, z up along the
segment when the person stands. A segment's attitude is ``rot_ns = Rz(yaw) Ry(list) Rx(roll)`` with the
person's x, y, z; ``roll`` is the source's flexion angle: positive where the distal end swings forward.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.signal import butter, sosfiltfilt

FloatArray = NDArray[np.float64]

SIDES = {"left": -1.0, "right": 1.0}
"""Sign of a side on the x axis."""
STEP_S = 5e-4
"""Step of the difference quotients that give rates and accelerations (s): their error is below 1e-6."""
KNOT_S = 0.004
"""Spacing of the knots of the pelvis's path (s)."""
PELVIS_HZ = 3.5
"""Bandwidth of the pelvis's path."""

# Angles of level walking at a natural speed in percent of the cycle from heel contact, degrees: the shape of
# the curves in Winter, Biomechanics and Motor Control of Human Movement (2009), read at these points.
_HIP = ((0, 30), (10, 25), (20, 16), (30, 6), (40, -3), (50, -10), (60, -2), (70, 18), (80, 30), (90, 34))
_KNEE = (
    (0, 5), (5, 9), (10, 15), (15, 18), (20, 17), (30, 11), (40, 6), (50, 10), (55, 20), (60, 35),
    (65, 50), (70, 60), (73, 62), (80, 53), (85, 38), (90, 20), (95, 7),
)  # fmt: skip
_ANKLE = (
    (0, 0), (5, -4), (10, -3), (20, 4), (30, 7), (40, 9), (45, 10), (50, 8), (55, 0), (60, -12),
    (65, -18), (70, -14), (80, -1), (90, 1),
)  # fmt: skip
_HARMONICS = 9


@dataclass(frozen=True)
class Body:
    """Lengths of the segments (m): those of an adult of 1.75 m."""

    trunk_m: float = 0.50
    thigh_m: float = 0.43
    shank_m: float = 0.43
    hips_m: float = 0.18
    ankle_height_m: float = 0.08
    heel_m: float = 0.05
    toe_m: float = 0.17


class SegmentAngles(NamedTuple):
    """Attitudes of the segments of one side at given times (rad)."""

    trunk: FloatArray  # (n, 3): roll, list, yaw
    thigh: FloatArray
    shank: FloatArray  # (n, 3): knee flexion, varus, axial rotation against the thigh
    foot: FloatArray  # (n, 3): dorsiflexion, inversion, axial rotation against the shank


def _fourier(points: tuple[tuple[float, float], ...]) -> NDArray[np.complex128]:
    """Return complex Fourier coefficients (rad) of a periodic curve through ``points`` (percent, degrees)."""
    nodes = np.array([*points, (points[0][0] + 100, points[0][1])], dtype=float)
    spline = CubicSpline(nodes[:, 0] / 100, np.radians(nodes[:, 1]), bc_type="periodic")
    spectrum = np.asarray(np.fft.rfft(spline(np.arange(128) / 128)) / 128, dtype=np.complex128)
    spectrum[1:] *= 2
    return spectrum[: _HARMONICS + 1]


_CURVES = {name: _fourier(points) for name, points in (("hip", _HIP), ("knee", _KNEE), ("ankle", _ANKLE))}


def _curve(name: str, phase: FloatArray) -> FloatArray:
    """Return a joint angle (rad) at a gait phase (cycles)."""
    turn = np.exp(2j * np.pi * phase)
    out: NDArray[np.complex128] = np.zeros(phase.shape, dtype=np.complex128)
    for coefficient in _CURVES[name][::-1]:
        out = out * turn + coefficient
    return np.real(out)


def smooth(x: FloatArray) -> FloatArray:
    """Return the step 0 → 1 of least jerk for x from 0 to 1 (third derivative bounded at the ends).

    Any shape.
    """
    x = np.clip(x, 0.0, 1.0)
    return x**3 * (10 + x * (6 * x - 15))


class MotionTask:
    """What a person does: angles of the segments at any time, and which foot carries.

    Parameters
    ----------
    scenario : str
        ``walking``, ``sit-to-stand`` or ``squats``.
    duration_s, rest_s, cycle_s : float
        Length of the capture, rest at its start and end, time of one cycle (s).
    spread : float
        Relative standard deviation of the cycles' times and depths.
    range_scale : float
        Factor of all flexion angles.
    off_plane_deg : float
        Amplitude of the leg's motion out of the sagittal plane (list and yaw of the whole leg).
    knee_varus_deg, knee_axial_deg : float
        Amplitudes of the knee's other two degrees of freedom; 0: a hinge.
    turn_deg_s : float
        Rate of the heading while walking.
    rng : numpy.random.Generator
        Draws the cycles.
    """

    def __init__(
        self,
        scenario: str,
        *,
        duration_s: float,
        rest_s: float,
        cycle_s: float,
        spread: float,
        range_scale: float,
        off_plane_deg: float,
        knee_varus_deg: float,
        knee_axial_deg: float,
        turn_deg_s: float,
        rng: np.random.Generator,
    ) -> None:
        self.scenario = scenario
        self.duration_s = duration_s
        self._rest = rest_s
        self._scale = range_scale
        self._off = np.radians(off_plane_deg)
        self._knee = np.radians((knee_varus_deg, knee_axial_deg))
        self._turn = np.radians(turn_deg_s)
        moving = max(duration_s - 2 * rest_s, 0.0)
        count = max(1, round(moving / cycle_s)) if moving else 0
        times = np.clip(1 + spread * rng.standard_normal(count), 0.6, 1.4)
        times *= moving / times.sum() if count else 1.0
        self.starts = rest_s + np.concatenate(([0.0], np.cumsum(times)))
        """Start of every cycle and end of the last one (s), shape (cycles + 1,)."""
        depth = np.clip(1 + spread * rng.standard_normal(count), 0.7, 1.3)
        if count > 2:
            self._phase = CubicSpline(self.starts, np.arange(count + 1.0))
        self._depth = depth
        self._count = count

    def angles(self, t: FloatArray, side: str) -> SegmentAngles:
        """Return the angles of one side at the times ``t`` (s).

        Shape of ``t``: (n,).
        """
        flexion = self._walking if self.scenario == "walking" else self._lifting
        phase, gain, trunk, thigh, knee, ankle = flexion(t, side)
        sway = gain * self._off * SIDES[side]
        heading = self._turn * np.clip(t - self._rest, 0.0, max(self.duration_s - 2 * self._rest, 0.0))
        beat, twice = np.sin(2 * np.pi * phase), np.sin(4 * np.pi * phase)
        zero = np.zeros_like(t)
        shared = beat if side == "left" or self.scenario != "walking" else -beat  # both sides have one trunk
        return SegmentAngles(
            np.column_stack((trunk, 0.3 * self._off * gain * shared, heading)),
            np.column_stack((thigh, sway * beat, heading + sway * np.cos(2 * np.pi * phase))),
            np.column_stack((knee, gain * self._knee[0] * beat, gain * self._knee[1] * twice)),
            np.column_stack((ankle, zero, zero)),
        )

    def load(self, t: FloatArray, side: str) -> tuple[FloatArray, FloatArray]:
        """Return which share of the weight a foot carries (0 … 1), and where: 0 heel … 1 toe.

        Shapes: ``t`` (n,) in s, results (n,).
        """
        if self.scenario != "walking":
            return np.full(t.shape, 0.5), np.full(t.shape, 0.3)
        phase, _, moving = self._gait(t, side)
        p = phase % 1.0
        carried = smooth(p / 0.12) - smooth((p - 0.5) / 0.12)
        place = smooth(p / 0.15) * 0.3 + 0.7 * smooth((p - 0.15) / 0.4)
        place -= smooth((p - 0.65) / 0.3)
        return 0.5 + moving * (carried - 0.5), 0.3 + moving * (place - 0.3)

    def _gait(self, t: FloatArray, side: str) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return phase (cycles), gain of the gait's amplitude, and the same as a switch."""
        if self._count == 0:
            return np.zeros_like(t), np.zeros_like(t), np.zeros_like(t)
        first, last = self.starts[0], self.starts[-1]
        inside = np.clip(t, first, last)
        if self._count > 2:
            phase = self._phase(inside)
        else:
            phase = (inside - first) / (last - first) * self._count
        ramp = min(1.0, (last - first) / 4)
        gain = smooth((t - first) / ramp) * smooth((last - t) / ramp)
        return phase + (0.5 if side == "right" else 0.0), gain, gain

    def _walking(self, t: FloatArray, side: str) -> tuple[FloatArray, ...]:
        phase, gain, _ = self._gait(t, side)
        size = gain * self._scale
        trunk = np.radians(-4.0 + 2.0 * gain * np.cos(4 * np.pi * phase))
        standing = np.radians(3.0) * (1 - gain)
        thigh = size * _curve("hip", phase) + standing
        knee = size * _curve("knee", phase) + 2 * standing
        return phase, gain, trunk, thigh, knee, size * _curve("ankle", phase) + standing

    def _lifting(self, t: FloatArray, side: str) -> tuple[FloatArray, ...]:
        """Sit-to-stand: sits at the start, stands in the middle of a cycle; squats: the other way round."""
        if self._count:
            cycle = np.clip(np.searchsorted(self.starts, t, side="right") - 1, 0, self._count - 1)
            span = np.diff(self.starts)[cycle]
            p = np.clip((t - self.starts[cycle]) / span, 0.0, 1.0)
            # Amplitudes change where they act on nothing: in the middle of the pause between two cycles.
            depth = self._depth[cycle]
        else:
            cycle, p, depth = np.zeros(t.shape, dtype=int), np.zeros_like(t), np.ones_like(t)
        if self.scenario == "squats":
            down = smooth((p - 0.05) / 0.40) - smooth((p - 0.55) / 0.40)
            low = down * depth * self._scale
            thigh, shank = np.radians(3 + 62 * low), np.radians(-3 - 27 * low)
            trunk = np.radians(-4 - 36 * low)
        else:
            up = smooth((p - 0.12) / 0.33) - smooth((p - 0.60) / 0.33)
            bend = smooth(p / 0.22) - smooth((p - 0.22) / 0.23)
            bend = bend + smooth((p - 0.60) / 0.20) - smooth((p - 0.80) / 0.18)
            down = (1 - up) * self._scale
            thigh = np.radians(3 + 80 * down)
            shank = np.radians(-3 - 5 * down - 12 * bend * depth)
            trunk = np.radians(-5 - 32 * bend * depth)
        gain = np.sin(np.pi * p) ** 4
        return cycle + p, gain, trunk, thigh, thigh - shank, -shank


def rot_x(a: FloatArray) -> FloatArray:
    """Return rotations about x, shape (n, 3, 3)."""
    return _rot(a, 0)


def rot_y(a: FloatArray) -> FloatArray:
    """Return rotations about y, shape (n, 3, 3)."""
    return _rot(a, 1)


def rot_z(a: FloatArray) -> FloatArray:
    """Return rotations about z, shape (n, 3, 3)."""
    return _rot(a, 2)


def _rot(a: FloatArray, axis: int) -> FloatArray:
    out = np.zeros((*np.shape(a), 3, 3))
    i, j = (axis + 1) % 3, (axis + 2) % 3
    out[..., axis, axis] = 1.0
    out[..., i, i] = out[..., j, j] = np.cos(a)
    out[..., j, i] = np.sin(a)
    out[..., i, j] = -out[..., j, i]
    return out


#: The person's axes (x right, y forward, z up) in n (x forward, y left, z up) at heading 0.
PERSON = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


class Pose(NamedTuple):
    """One segment over time: position (m) of its proximal joint, and ``rot_ns``; (n, 3) and (n, 3, 3)."""

    pos: FloatArray
    rot: FloatArray


class Chain:
    """The moving chain: where each segment is at any time.

    Parameters
    ----------
    task : MotionTask
        What the person does.
    body : Body
        Lengths.
    """

    def __init__(self, task: MotionTask, body: Body) -> None:
        self.task = task
        self.body = body
        knots = np.arange(-0.1, task.duration_s + 0.1 + KNOT_S, KNOT_S)
        self._path = self._pelvis(knots)

    def pose(self, t: FloatArray) -> dict[str, Pose]:
        """Return every segment at the times ``t`` (s): ``trunk``, ``left_thigh``, ``left_shank`` …

        Shape of ``t``: (n,).
        """
        pelvis = np.column_stack([axis(t) for axis in self._path])
        out: dict[str, Pose] = {}
        for side in SIDES:
            for name, (pos, rot) in self._relative(t, side).items():
                key = name if name == "trunk" else f"{side}_{name}"
                out[key] = Pose(pos + pelvis, rot)
        return out

    def _relative(self, t: FloatArray, side: str) -> dict[str, Pose]:
        """Return the segments of one side, positions relative to the middle of the hips."""
        angles = self.task.angles(t, side)
        rot_b = _attitude(angles.trunk)
        rot_t = _attitude(angles.thigh)
        rot_s = rot_t @ _bend(angles.shank, -1.0)
        rot_f = rot_s @ _bend(angles.foot, 1.0)
        hip = 0.5 * self.body.hips_m * SIDES[side] * _attitude(angles.trunk * (0.0, 1.0, 1.0))[..., 0]
        knee = hip - self.body.thigh_m * rot_t[..., 2]
        ankle = knee - self.body.shank_m * rot_s[..., 2]
        return {
            "trunk": Pose(np.zeros_like(hip), rot_b),
            "thigh": Pose(hip, rot_t),
            "shank": Pose(knee, rot_s),
            "foot": Pose(ankle, rot_f),
        }

    def _pelvis(self, t: FloatArray) -> tuple[Callable[[FloatArray], FloatArray], ...]:
        """Return the path of the middle of the hips: loaded feet roll on the ground and hardly slide."""
        body = self.body
        velocity, height = np.zeros((t.size, 2)), np.zeros(t.size)
        total = np.zeros(t.size)
        for side in SIDES:
            share, place = self.task.load(t, side)
            length = body.heel_m + body.toe_m
            sole = np.column_stack(
                (np.zeros_like(t), place * length - body.heel_m, np.full(t.size, -body.ankle_height_m))
            )
            foot = self._relative(t, side)["foot"]
            contact = foot.pos + np.einsum("nij,nj->ni", foot.rot, sole)
            # The material point of the sole: its velocity leaves out that the contact moves along the foot.
            before, after = (self._relative(t + s * STEP_S, side)["foot"] for s in (-1, 1))
            moved = (after.pos - before.pos) + np.einsum("nij,nj->ni", after.rot - before.rot, sole)
            velocity -= share[:, None] * moved[:, :2] / (2 * STEP_S)
            height -= share * contact[:, 2]
            total += share
        # A real trunk is carried softly from foot to foot: knees and soles give way, as loaded feet do here.
        filtered = butter(2, 2 * PELVIS_HZ * KNOT_S, output="sos")
        velocity = sosfiltfilt(filtered, velocity / total[:, None], axis=0)
        height = sosfiltfilt(filtered, height / total)
        x, y = (CubicSpline(t, velocity[:, k]).antiderivative() for k in (0, 1))
        return x, y, CubicSpline(t, height)


def _attitude(angles: FloatArray) -> FloatArray:
    """Return ``rot_ns`` of roll, list and yaw (n, 3)."""
    turned = rot_z(angles[:, 2]) @ PERSON
    return turned @ rot_y(angles[:, 1]) @ rot_x(angles[:, 0])


def _bend(angles: FloatArray, sign: float) -> FloatArray:
    """Return the rotation of a distal segment against its proximal one: flexion about x first."""
    return rot_x(sign * angles[:, 0]) @ rot_y(angles[:, 1]) @ rot_z(angles[:, 2])


def derivatives(
    poses_at: Callable[[FloatArray], Mapping[str, Pose]], t: FloatArray
) -> dict[str, tuple[FloatArray, FloatArray, FloatArray, FloatArray]]:
    """Return position (m), ``rot``, acceleration (m/s², in n) and body rate (rad/s) of moving frames.

    Shapes: ``t`` (n,) in s, results (n, 3), (n, 3, 3), (n, 3), (n, 3).

    Fourth-order central differences of the poses ``at`` gives (Abramowitz & Stegun 1964, table 25.2).
    """
    h = STEP_S
    poses = [poses_at(t + k * h) for k in (-2, -1, 0, 1, 2)]
    out = {}
    for name in poses[2]:
        p = [q[name].pos for q in poses]
        r = [q[name].rot for q in poses]
        acc = (-p[0] + 16 * p[1] - 30 * p[2] + 16 * p[3] - p[4]) / (12 * h * h)
        rate = (r[0] - 8 * r[1] + 8 * r[3] - r[4]) / (12 * h)
        spin = np.swapaxes(r[2], -1, -2) @ rate
        gyr = 0.5 * np.column_stack(
            (
                spin[:, 2, 1] - spin[:, 1, 2],
                spin[:, 0, 2] - spin[:, 2, 0],
                spin[:, 1, 0] - spin[:, 0, 1],
            )
        )
        out[name] = (p[2], r[2], acc, gyr)
    return out
