"""Where the foot stands in each scenario: footfalls of a route, and the time that each stride takes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from .gait import FloatArray

if TYPE_CHECKING:
    from . import Options


@dataclass(frozen=True)
class Route:
    """Footfalls of a walk.

    Attributes
    ----------
    footfalls : ndarray
        x, y, z (m), heading (rad, unwrapped), one row a footfall, shape (m + 1, 4).
    durations : ndarray
        Time of each stride (s), shape (m,).
    closed : bool
        Whether the last footfall is where the first was.
    rides : ndarray
        Climb of the lift in which the foot stands after each stride (m, 0: none), shape (m,). Footfalls do not
        count it.
    """

    footfalls: FloatArray
    durations: FloatArray
    closed: bool
    rides: FloatArray


class _Vary:
    """Draws stride lengths and times about their means."""

    def __init__(self, options: Options, rng: np.random.Generator) -> None:
        self.options = options
        self.rng = rng

    def shares(self, count: int) -> FloatArray:
        """Return ``count`` random positive shares, about equal, of sum 1."""
        spread = np.clip(1.0 + self.options.stride_sd * self.rng.standard_normal(count), 0.5, 1.5)
        return spread / spread.sum()

    def strides(self, length_m: float) -> int:
        """Return how many strides cover ``length_m`` best."""
        return max(1, round(length_m / self.options.stride_m))

    def times(self, count: int) -> FloatArray:
        """Return the times of ``count`` strides (s)."""
        spread = np.clip(1.0 + self.options.stride_sd * self.rng.standard_normal(count), 0.5, 1.5)
        return self.options.stride_s * spread


def _laps(options: Options, strides_per_lap: int) -> int:
    """Return the number of laps: as asked, or as many as fill ``duration_s``."""
    if options.duration_s is None:
        return options.laps or 1
    walking = options.duration_s - 2 * options.rest_s
    return max(1, int(np.ceil(walking / (strides_per_lap * options.stride_s))))


def _polyline(legs: list[tuple[float, float, int, float]], vary: _Vary) -> FloatArray:
    """Return the footfalls along ``legs`` (heading rad, length m, strides, climb m).

    Every corner has a footfall: the foot turns half of a corner in the swing to it, half in the swing
    away from it.
    """
    headings = np.concatenate([np.full(n, h) for h, _, n, _ in legs])
    lengths = np.concatenate([d * vary.shares(n) for _, d, n, _ in legs])
    climbs = np.concatenate([np.full(n, z / n) for _, _, n, z in legs])
    out = np.zeros((len(headings) + 1, 4))
    out[1:, 0] = np.cumsum(lengths * np.cos(headings))
    out[1:, 1] = np.cumsum(lengths * np.sin(headings))
    out[1:, 2] = np.cumsum(climbs)
    out[0, 3], out[-1, 3] = headings[0], headings[-1]
    out[1:-1, 3] = (headings[:-1] + headings[1:]) / 2
    return out


def _rectangle(options: Options, vary: _Vary) -> FloatArray:
    total = options.length_m or 22.1
    long = total / 2 * options.aspect / (1 + options.aspect)
    sides = [(long, vary.strides(long)), (total / 2 - long, vary.strides(total / 2 - long))] * 2
    turn = -np.pi / 2 if options.clockwise else np.pi / 2
    laps = _laps(options, sum(n for _, n in sides))
    return _polyline([(turn * k, *sides[k % 4], 0.0) for k in range(4 * laps)], vary)


def _straight(options: Options, vary: _Vary) -> FloatArray:
    length = options.length_m or 20.0
    count = vary.strides(length)
    laps = _laps(options, count)
    return _polyline([(0.0, length * laps, count * laps, 0.0)], vary)


def _figure_eight(options: Options, vary: _Vary) -> FloatArray:
    """Two touching circles, walked one after the other, in opposite senses."""
    length = options.length_m or 25.0
    count = max(6, vary.strides(length / 2))
    first = -1.0 if options.clockwise else 1.0
    senses = np.tile([first, -first], _laps(options, 2 * count))
    turns = np.concatenate([s * 2 * np.pi * vary.shares(count) for s in senses])
    radius = (
        length / 2 / (2 * count * np.sin(np.pi / count))
    )  # the chords add up to the length, strides being even
    heading = np.concatenate(([0.0], np.cumsum(turns)))
    chord = 2 * radius * np.sin(np.abs(turns) / 2)
    middle = heading[:-1] + turns / 2
    out = np.zeros((len(heading), 4))
    out[1:, 0], out[1:, 1] = np.cumsum(chord * np.cos(middle)), np.cumsum(chord * np.sin(middle))
    out[:, 3] = heading
    return out


def _stairs(options: Options, vary: _Vary) -> FloatArray:
    """Flights that the foot climbs two steps at a stride; ``up-down`` comes back on a flight beside."""
    count = max(1, -(-options.stair_steps // 2))
    run, climb = options.stair_steps * options.tread_m, options.stair_steps * options.riser_m
    if options.direction != "up-down":
        laps = _laps(options, count)
        climb = climb if options.direction == "up" else -climb
        return _polyline([(0.0, run * laps, count * laps, climb * laps)], vary)
    legs, turn, landing = [], -np.pi / 2 if options.clockwise else np.pi / 2, 0.8
    for k in range(_laps(options, 2 * count + 2)):
        heading = 4 * k * turn
        legs += [(heading, run, count, climb), (heading + turn, landing, 1, 0.0)]
        legs += [(heading + 2 * turn, run, count, -climb), (heading + 3 * turn, landing, 1, 0.0)]
    return _polyline(legs, vary)


def _ramp(options: Options, vary: _Vary) -> FloatArray:
    """Up a ramp, across, down a ramp beside it and back: closed."""
    across = options.stride_m
    length = max(across, (options.length_m or 30.0) / 2 - across)
    climb = length * options.slope
    turn = -np.pi / 2 if options.clockwise else np.pi / 2
    count, side = vary.strides(length), 1
    legs = []
    for k in range(_laps(options, 2 * (count + side))):
        heading = 4 * k * turn
        legs += [(heading, length, count, climb), (heading + turn, across, side, 0.0)]
        legs += [(heading + 2 * turn, length, count, -climb), (heading + 3 * turn, across, side, 0.0)]
    return _polyline(legs, vary)


def _lift(options: Options, vary: _Vary) -> FloatArray:
    """To a lift, up, back on the upper floor, down: closed. Rides are in :func:`_lift_rides`."""
    across = options.stride_m
    length = max(across, (options.length_m or 30.0) / 2 - across)
    turn = -np.pi / 2 if options.clockwise else np.pi / 2
    count = vary.strides(length)
    legs = []
    for k in range(_laps(options, 2 * count + 2)):
        heading = 4 * k * turn
        legs += [(heading, length, count, 0.0), (heading + turn, across, 1, 0.0)]
        legs += [(heading + 2 * turn, length, count, 0.0), (heading + 3 * turn, across, 1, 0.0)]
    return _polyline(legs, vary)


def _lift_rides(options: Options, vary: _Vary, strides: int) -> FloatArray:
    """Return a ride up in the middle of each round of :func:`_lift`, and one down at its end."""
    half = vary.strides(max(options.stride_m, (options.length_m or 30.0) / 2 - options.stride_m)) + 1
    rides = np.zeros(strides)
    rides[half - 1 :: 2 * half] = options.ride_m
    rides[2 * half - 1 :: 2 * half] = -options.ride_m
    return rides


def _still(options: Options, vary: _Vary) -> FloatArray:
    del vary
    return np.zeros((1, 4))


_ROUTES: dict[str, tuple[str, Callable[[Options, _Vary], FloatArray]]] = {
    "rectangle": ("a closed rectangle, clockwise, 22.1 m a lap", _rectangle),
    "straight": ("one straight line, 20 m", _straight),
    "figure-eight": ("two touching circles, closed, 25 m a lap", _figure_eight),
    "stairs": ("a flight of stairs, up and down again", _stairs),
    "ramp": ("up a ramp and down another, closed, 30 m a lap", _ramp),
    "lift": ("to a lift, up, back on the upper floor, down again, closed, 30 m a lap", _lift),
    "still": ("a recording that never moves", _still),
}

SCENARIOS: dict[str, str] = {name: title for name, (title, _) in _ROUTES.items()}
"""Scenarios of the simulator: name to one line."""


def route(scenario: str, options: Options, rng: np.random.Generator) -> Route:
    """Return the footfalls of ``scenario`` (a key of :data:`SCENARIOS`)."""
    vary = _Vary(options, rng)
    footfalls = _ROUTES[scenario][1](options, vary)
    closed = bool(np.linalg.norm(footfalls[-1, :3] - footfalls[0, :3]) < 1e-6)
    strides = len(footfalls) - 1
    rides = _lift_rides(options, vary, strides) if scenario == "lift" else np.zeros(strides)
    return Route(footfalls, vary.times(strides), closed, rides)
