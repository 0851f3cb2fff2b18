"""A person who walks with a phone: smooth functions of time for the walker, the phone and its attitude.

Frames
    n: level, x east, y north, z up, origin on the ground at the start. w: the walker, x forward, y left, z
    up, turned by the course. b: the phone in Android's axes, x right, y to its top, z out of the screen.
Model
    Contacts of the feet happen at given times. The gait's phase grows by one from contact to contact; the
    trunk bounces once a step, lowest shortly after contact (inverted pendulum: the rise follows from the
    lengths of step and leg), sways once in two steps, and every contact rings through it. A placement hangs
    the phone on the trunk: on a pivot (hand, hip, shoulder, neck) with a lever that swings with the stride.
Specific force and angular rate are central differences of these functions over 2 ms: exact to 1e-5 m/s².
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline, PchipInterpolator
from scipy.spatial.transform import Rotation

from .gait import FloatArray

LEG_M, RISE_SHARE = 0.9, 0.6
"""Length of the leg, and share of a stiff-legged pendulum's rise that a walker's trunk shows."""
STRIKE_HZ, STRIKE_S = 11.0, 0.03
"""Frequency and length (standard deviation) of what a contact makes the phone ring with."""
TURN_M = 1.5
"""Way along which a corner is turned."""
STEP_H = 1e-3
"""Step of the central differences (s)."""


@dataclass(frozen=True)
class Placement:
    """Where and how a person carries the phone.

    Attributes
    ----------
    title : str
        In words.
    pivot : tuple of float
        What the phone hangs on, in w (m above the ground).
    lever : tuple of float
        From there to the phone, in w, before it swings (m).
    mount : callable
        Attitude of the phone in w (``rot_wb``) from random numbers, before it swings.
    swing_deg, swing_2_deg : float
        Swing about the walker's left axis, once a stride and once a step (deg).
    roll_deg, yaw_deg : float
        Sway about the forward and the up axis, once a stride (deg).
    bounce : float
        Vertical motion of the trunk that arrives at the phone, as a factor.
    strike, strike_other : float
        Acceleration that a contact of the phone's side, of the other side rings with (m/s²).
    wander_deg : float
        Slow wander of the attitude (deg).
    """

    title: str
    pivot: tuple[float, float, float]
    lever: tuple[float, float, float]
    mount: Callable[[np.random.Generator], Rotation]
    swing_deg: float = 0.0
    swing_2_deg: float = 0.0
    roll_deg: float = 0.0
    yaw_deg: float = 0.0
    bounce: float = 1.0
    strike: float = 0.5
    strike_other: float = 0.5
    wander_deg: float = 1.0


def _axes(x: tuple[float, ...], y: tuple[float, ...]) -> Rotation:
    """Return the attitude of a phone whose x and y axes point along ``x`` and ``y`` of the walker."""
    return Rotation.from_matrix(np.column_stack([x, y, np.cross(x, y)]))


def _tilted(rotation: Rotation, rng: np.random.Generator, spread_deg: float) -> Rotation:
    return Rotation.from_rotvec(np.radians(spread_deg) * rng.standard_normal(3)) * rotation


def _hand(rng: np.random.Generator) -> Rotation:
    level = _axes((0.0, -1.0, 0.0), (1.0, 0.0, 0.0))  # pointing forward, screen up
    return _tilted(level * Rotation.from_euler("x", 25 + 8 * rng.standard_normal(), degrees=True), rng, 3)


def _pocket(rng: np.random.Generator) -> Rotation:
    """Upright or upside down along the thigh, the screen to the leg or away from it."""
    end = float(rng.choice([-1.0, 1.0]))
    side = float(rng.choice([-1.0, 1.0]))
    return _tilted(_axes((0.0, side, 0.0), (0.0, 0.0, end)), rng, 12)


def _bag(rng: np.random.Generator) -> Rotation:
    return Rotation.from_quat(rng.standard_normal(4))  # uniform


def _armband(rng: np.random.Generator) -> Rotation:
    return _tilted(_axes((1.0, 0.0, 0.0), (0.0, 0.0, 1.0)), rng, 8)  # screen outward on the right arm


def _neck(rng: np.random.Generator) -> Rotation:
    return _tilted(_axes((0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), rng, 6)  # screen forward


def _swinging(rng: np.random.Generator) -> Rotation:
    return _tilted(_axes((1.0, 0.0, 0.0), (0.0, 0.0, -1.0)), rng, 12)  # top down, screen to the leg


PLACEMENTS: dict[str, Placement] = {
    "hand": Placement(
        "held before the body, screen up", (0.0, 0.0, 1.1), (0.35, 0.0, 0.0), _hand, 0.0, 1.2, 1.0, 2.0, 0.9
    ),
    "pocket": Placement(
        "front trouser pocket, right",
        (0.0, -0.12, 0.95),
        (0.06, 0.0, -0.22),
        _pocket,
        22.0,
        5.0,
        4.0,
        6.0,
        1.0,
        4.0,
        1.2,
    ),
    "bag": Placement(
        "bag at the hip", (0.0, 0.2, 0.95), (0.0, 0.0, -0.25), _bag, 3.0, 4.0, 4.0, 4.0, 1.15, 1.2, 1.2, 2.0
    ),
    "armband": Placement(
        "band on the right upper arm",
        (0.0, -0.2, 1.4),
        (0.0, -0.05, -0.15),
        _armband,
        13.0,
        2.0,
        2.0,
        4.0,
        1.0,
        0.8,
        0.8,
    ),
    "neck": Placement(
        "pouch on the chest", (0.08, 0.0, 1.45), (0.04, 0.0, -0.3), _neck, 1.0, 3.0, 4.0, 4.0, 1.0, 0.7, 0.7
    ),
    "swinging": Placement(
        "in the right hand, arm swinging",
        (0.0, -0.2, 1.4),
        (0.05, -0.03, -0.65),
        _swinging,
        20.0,
        4.0,
        3.0,
        6.0,
        1.0,
        0.8,
        0.8,
        2.0,
    ),
}
"""The six placements."""


@dataclass(frozen=True)
class Schedule:
    """When the person does what.

    Attributes
    ----------
    contact_s : ndarray
        Time of every contact, the two feet in turn (s), shape (n,).
    bout : ndarray
        Number of the bout that a contact ends a step of, int, shape (n,).
    start_s : ndarray
        When each bout begins (s).
    length_m, height_m : ndarray
        Way and climb of each step (m), shape (n,).
    corners : list of (float, float)
        Way from the start to a corner's middle (m), and its turn (rad, to the left positive).
    course_rad : float
        Course at the start, from x to y.
    handled : list of (float, float)
        Intervals in which the phone is handled (s).
    end_s : float
        End of the recording (s).
    """

    contact_s: FloatArray
    bout: NDArray[np.int64]
    start_s: FloatArray
    length_m: FloatArray
    height_m: FloatArray
    corners: list[tuple[float, float]]
    course_rad: float
    handled: list[tuple[float, float]]
    end_s: float


def _smooth(u: FloatArray) -> FloatArray:
    """0 to 1 for u from 0 to 1, with two continuous derivatives (degree 5)."""
    u = np.clip(u, 0.0, 1.0)
    return u * u * u * (10 + u * (6 * u - 15))


class Walker:
    """Course, way, gait phase and trunk of a person by time."""

    def __init__(self, schedule: Schedule, step_s: float, rng: np.random.Generator) -> None:
        self.schedule = s = schedule
        self._bouts = [
            (float(start), float(s.contact_s[s.bout == b][-1])) for b, start in enumerate(s.start_s)
        ]
        self._step_s = step_s
        self._gait = [self._steady_phase(b) for b in range(len(self._bouts))]
        self._way = self._progress()
        self.total_m = float(s.length_m.sum())
        self._path = self._course_line()
        n = len(s.contact_s)
        if n > 1:
            half = np.minimum(s.length_m / 2, 0.9 * LEG_M)
            rise = RISE_SHARE * (LEG_M - np.sqrt(LEG_M**2 - half**2)) / 2
            rise *= 1 + 0.08 * rng.standard_normal(n)
            # Level pieces at both ends: a kink of the rise would be a blow.
            knots = np.concatenate(([s.contact_s[0] - step_s], s.contact_s, [s.contact_s[-1] + step_s]))
            self._rise = PchipInterpolator(knots, np.concatenate((rise[:1], rise, rise[-1:])))
        self._strength = np.clip(1 + 0.25 * rng.standard_normal(max(n, 1)), 0.3, 1.9)

    def _steady_phase(self, bout: int) -> CubicSpline:
        """Return the phase of a bout by time: whole at its contacts, steady before and behind them."""
        s, mine = self.schedule, self.schedule.bout == bout
        knots = np.concatenate(([s.start_s[bout]], s.contact_s[mine]))
        first = int(np.argmax(mine))
        ends: Any = ((1, 1 / (knots[1] - knots[0])), (1, 1 / (knots[-1] - knots[-2])))
        return CubicSpline(knots, first + np.arange(len(knots)), bc_type=ends)

    def _progress(self) -> Callable[[FloatArray], FloatArray]:
        """Return the way (m) by time: the integral of a speed that starts and ends smoothly in every bout."""
        s = self.schedule
        grid = np.arange(-1.0, max(s.end_s, s.contact_s[-1] if len(s.contact_s) else 0.0) + 1.0, 0.01)
        speed = np.zeros_like(grid)
        for b, (start, end) in enumerate(self._bouts):
            mine = s.bout == b
            knots = np.concatenate(([start], s.contact_s[mine]))
            pace = PchipInterpolator((knots[1:] + knots[:-1]) / 2, s.length_m[mine] / np.diff(knots))
            inside = (grid > start) & (grid < end)
            t = np.clip(grid[inside], (knots[0] + knots[1]) / 2, (knots[-2] + knots[-1]) / 2)
            ramp = _smooth((grid[inside] - start) / self._step_s) * _smooth(
                (end - grid[inside]) / self._step_s
            )
            raw = pace(t) * ramp
            speed[inside] = raw * (s.length_m[mine].sum() / (raw.sum() * 0.01))
        return CubicSpline(grid, speed).antiderivative()

    def _course_line(self) -> CubicSpline:
        """Return x, y, z (m) by the way: corners and the ends of slopes are rounded."""
        s = self.schedule
        grid = np.arange(-1.0, self.total_m + 1.0, 0.005)
        course = self.course_at(grid)
        slope = np.zeros_like(grid)
        if s.height_m.any():
            ends = np.cumsum(s.length_m)
            segment = np.minimum(np.searchsorted(ends, grid), len(ends) - 1)
            slope = np.where((grid >= 0) & (grid <= ends[-1]), s.height_m[segment] / s.length_m[segment], 0.0)
            window = np.hanning(161)
            slope = np.convolve(slope, window / window.sum(), mode="same")
        rate = np.column_stack((np.cos(course), np.sin(course), slope))
        path = np.vstack((np.zeros(3), np.cumsum((rate[1:] + rate[:-1]) * 0.0025, axis=0)))
        return CubicSpline(grid, path - path[200])  # the way 0 is 200 grid points in

    def course_at(self, way: FloatArray) -> FloatArray:
        """Return the course (rad) at a way from the start (m).

        Shapes: ``way`` and result (n,).
        """
        out = np.full_like(way, self.schedule.course_rad)
        for corner, turn in self.schedule.corners:
            out += turn * _smooth((way - corner) / TURN_M + 0.5)
        return out

    def course(self, t: FloatArray) -> FloatArray:
        """Return the course (rad, from x to y, unwrapped) at the times ``t`` (s).

        Shapes: ``t`` and result (n,).
        """
        return self.course_at(self._way(t))

    def ground(self, t: FloatArray) -> FloatArray:
        """Return the walker's place on the ground in n (m), shape (n, 3)."""
        return self._path(self._way(t))

    def walking(self, t: FloatArray) -> NDArray[np.bool_]:
        """Whether the person walks.

        Shapes: ``t`` (s) and result (n,).
        """
        out = np.zeros(len(t), dtype=bool)
        for a, b in self._bouts:
            out |= (t >= a) & (t <= b)
        return out

    def phase(self, t: FloatArray) -> FloatArray:
        """Return the gait's phase: whole at contacts, growing by one a step; it jumps in pauses only."""
        out = np.zeros_like(t)
        middles = [(a[1] + b[0]) / 2 for a, b in itertools.pairwise(self._bouts)]
        which = np.searchsorted(middles, t)
        for b, (start, end) in enumerate(self._bouts):
            here = which == b
            # Half a step beyond both ends the gait has died away: the phase needs not run further.
            out[here] = self._gait[b](np.clip(t[here], start - self._step_s / 2, end + self._step_s / 2))
        return out

    def envelope(self, t: FloatArray) -> FloatArray:
        """Return how much of the gait's oscillation there is: 0 standing, 1 walking.

        Shapes: ``t`` (s) and result (n,).
        """
        out = np.zeros_like(t)
        for a, b in self._bouts:
            out += _smooth((t - a) / self._step_s) * _smooth((b + 0.4 * self._step_s - t) / self._step_s)
        return np.minimum(out, 1.0)

    def trunk(self, t: FloatArray) -> FloatArray:
        """Return the trunk's motion about its place, in w (m): forward, left, up.

        Shapes: ``t`` (n,) in s, result (n, 3).
        """
        if len(self.schedule.contact_s) < 2:
            return np.zeros((len(t), 3))
        turn, grown = 2 * np.pi * self.phase(t), self.envelope(t)
        s, step = self.schedule, self._step_s
        rise = self._rise(np.clip(t, s.contact_s[0] - step, s.contact_s[-1] + step)) * grown
        up = -rise * (np.cos(turn - 0.6) + 0.12 * np.cos(2 * turn - 0.4) + 0.03 * np.cos(3 * turn))
        forward = 0.012 * grown * (np.sin(turn - 1.0) + 0.1 * np.sin(2 * turn))
        left = 0.018 * grown * np.sin(turn / 2 - 0.3)
        return np.column_stack((forward, left, up))

    def ringing(self, t: FloatArray, strike: float, other: float) -> FloatArray:
        """Return the displacement (m) that contacts make, as one number along the ringing's direction.

        Shapes: ``t`` (s) and result (n,).
        """
        contacts = self.schedule.contact_s
        out = np.zeros_like(t)
        if not len(contacts):
            return out
        omega = 2 * np.pi * STRIKE_HZ
        next_contact = np.searchsorted(contacts, t)
        for k in (next_contact - 2, next_contact - 1, next_contact):
            there = (k >= 0) & (k < len(contacts))
            i = k[there]
            tau = t[there] - contacts[i] - 0.035
            size = np.where(i % 2 == 0, strike, other) * self._strength[i] / omega**2
            out[there] -= size * np.exp(-0.5 * (tau / STRIKE_S) ** 2) * np.cos(omega * tau)
        return out


@dataclass(frozen=True)
class Handling:
    """Moves of a phone that is picked up, looked at, turned and put away: smooth steps at random times."""

    start_s: FloatArray = field(default_factory=lambda: np.zeros(0))
    length_s: FloatArray = field(default_factory=lambda: np.zeros(0))
    shift: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    turn: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))

    @classmethod
    def drawn(cls, intervals: list[tuple[float, float]], rng: np.random.Generator) -> Handling:
        """Draw the moves of some intervals: one every 1.5 to 6 s, back to where the phone was at the end."""
        starts, lengths, shifts, turns = [], [], [], []
        for a, b in intervals:
            t, place, pose = a + 0.5, np.zeros(3), np.zeros(3)
            while t < b - 2.5:
                d = rng.uniform(0.6, 1.4)
                new_place, new_pose = rng.uniform(-0.25, 0.25, 3), rng.uniform(-0.7, 0.7, 3)
                starts.append(t)
                lengths.append(d)
                shifts.append(new_place - place)
                turns.append(new_pose - pose)
                place, pose = new_place, new_pose
                t += d + rng.uniform(0.9, 4.6)
            if place.any():
                starts.append(max(b - 1.3, t - 0.9))
                lengths.append(1.2)
                shifts.append(-place)
                turns.append(-pose)
        if not starts:
            return cls()
        return cls(np.array(starts), np.array(lengths), np.array(shifts), np.array(turns))

    def _sum(self, t: FloatArray, steps: FloatArray) -> FloatArray:
        out = np.zeros((len(t), 3))
        for start, length, step in zip(self.start_s, self.length_s, steps, strict=True):
            out += _smooth((t - start) / length)[:, None] * step
        return out

    def shifted(self, t: FloatArray) -> FloatArray:
        """Return where the phone is beside its usual place, in w (m).

        Shapes: ``t`` (n,) in s, result (n, 3).
        """
        return self._sum(t, self.shift)

    def turned(self, t: FloatArray) -> FloatArray:
        """Return the rotation vector by which it is turned, in w (rad)."""
        return self._sum(t, self.turn)


class Phone:
    """Position and attitude of a phone that a walker carries, and what ideal sensors in it read."""

    def __init__(
        self, walker: Walker, placement: Placement, gravity: float, rng: np.random.Generator, *, sway: bool
    ) -> None:
        self.walker, self.placement, self.gravity = walker, placement, gravity
        self.mount = placement.mount(rng)
        self.handling = Handling.drawn(walker.schedule.handled, rng)
        self._pivot, self._lever = np.asarray(placement.pivot), np.asarray(placement.lever)
        ring = np.array([0.5, 0.0, 1.0]) + 0.25 * rng.standard_normal(3)
        self._ring = ring / np.linalg.norm(ring)
        self._lead = rng.uniform(-0.25, 0.25)
        # Slow wander of the attitude: sums of sines between 0.05 and 0.5 Hz; of a person who stands too.
        size = np.radians(placement.wander_deg) * (1.0 if sway else 0.0)
        self._wander_hz = rng.uniform(0.05, 0.5, (5, 3))
        self._wander_at = rng.uniform(0, 2 * np.pi, (5, 3))
        self._wander = size * np.sqrt(2 / 5) * rng.uniform(0.5, 1.5, (5, 3))

    def attitude(self, t: FloatArray) -> Rotation:
        """Return ``rot_nb`` at the times ``t`` (s).

        Shape of ``t``: (n,).
        """
        swing, course = self._swing(t), Rotation.from_euler("z", self.walker.course(t)[:, None])
        return course * swing * self.mount

    def position(self, t: FloatArray) -> FloatArray:
        """Return the phone's position in n (m), shape (n, 3)."""
        p = self.placement
        offset = self.walker.trunk(t) * np.array([1.0, 1.0, p.bounce])
        offset += self._pivot + self.handling.shifted(t) + self._swing(t).apply(self._lever)
        offset += self.walker.ringing(t, p.strike, p.strike_other)[:, None] * self._ring
        course = self.walker.course(t)
        c, s = np.cos(course), np.sin(course)
        out = self.walker.ground(t)
        out[:, 0] += c * offset[:, 0] - s * offset[:, 1]
        out[:, 1] += s * offset[:, 0] + c * offset[:, 1]
        out[:, 2] += offset[:, 2]
        return out

    def readings(self, t: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return ideal specific force (m/s²) and angular rate (rad/s) in b, each (n, 3)."""
        before, now, after = t - STEP_H, t, t + STEP_H
        force = (self.position(after) - 2 * self.position(now) + self.position(before)) / STEP_H**2
        force[:, 2] += self.gravity
        turned = self.attitude(before).inv() * self.attitude(after)
        return self.attitude(now).inv().apply(force), turned.as_rotvec() / (2 * STEP_H)

    def _swing(self, t: FloatArray) -> Rotation:
        p, grown = self.placement, self.walker.envelope(t)
        half = np.pi * self.walker.phase(t) + self._lead
        pitch = grown * (p.swing_deg * np.sin(half) + p.swing_2_deg * np.sin(2 * half + 0.8))
        roll = grown * p.roll_deg * np.sin(half + 0.4)
        yaw = grown * p.yaw_deg * np.sin(half + 1.1)
        angles = np.radians(np.column_stack((yaw, pitch, roll)))
        slow = self.handling.turned(t)
        for hz, phase, size in zip(self._wander_hz, self._wander_at, self._wander, strict=True):
            slow += size * np.sin(2 * np.pi * t[:, None] * hz + phase)
        return Rotation.from_rotvec(slow) * Rotation.from_euler("ZYX", angles)
