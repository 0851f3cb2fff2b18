"""Where a simulated person with a phone goes: legs, corners, pauses, and the contact of every step."""

from __future__ import annotations

from typing import Annotated, NamedTuple

import msgspec
import numpy as np

from ...recording.errors import UsageError
from .phone_motion import Schedule


class Leg(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A straight piece of a route.

    Attributes
    ----------
    length_m : float
        Its length (m).
    turn_deg : float
        Turn at its end (deg, to the right positive, as directions are given).
    climb_m : float
        Height that it gains (m).
    pause_s, handled_s : float
        How long the person stands at its end, and how long of that the phone is handled (s).
    """

    length_m: Annotated[float, msgspec.Meta(gt=0)]
    turn_deg: float = 0.0
    climb_m: float = 0.0
    pause_s: Annotated[float, msgspec.Meta(ge=0)] = 0.0
    handled_s: Annotated[float, msgspec.Meta(ge=0)] = 0.0


class PhoneRoute(NamedTuple):
    """A scenario: what it is, its legs, whether it ends where it began."""

    title: str
    legs: tuple[Leg, ...]
    closed: bool = False
    handled: bool = False


def _loop(long: float, short: float) -> tuple[Leg, ...]:
    """A rectangle that starts in the middle of a long side, so that rounded corners leave it closed."""
    return (Leg(long / 2, 90), Leg(short, 90), Leg(long, 90), Leg(short, 90), Leg(long / 2))


PHONE_ROUTES: dict[str, PhoneRoute] = {
    "phone-10m": PhoneRoute("a phone carried 10 m straight", (Leg(10.0),)),
    "phone-50m": PhoneRoute("a phone carried 50 m straight", (Leg(50.0),)),
    "phone-turns": PhoneRoute(
        "a phone carried 20 m, right, 20 m, left, 10 m", (Leg(20.0, 90), Leg(20.0, -90), Leg(10.0))
    ),
    "phone-100m": PhoneRoute(
        "a phone carried 100 m with four turns",
        (Leg(20.0, 90), Leg(20.0, 90), Leg(20.0, -90), Leg(20.0, -90), Leg(20.0)),
    ),
    "phone-loop": PhoneRoute(
        "a phone carried round a closed rectangle of 116 m", _loop(36.0, 22.0), closed=True
    ),
    "phone-city": PhoneRoute(
        "a phone carried 400 m round blocks, with pauses, in two of which it is handled",
        (
            Leg(60.0, 90, pause_s=8.0),
            Leg(45.0, -90),
            Leg(70.0, -45, pause_s=20.0, handled_s=15.0),
            Leg(50.0, 135, pause_s=5.0),
            Leg(60.0, 90),
            Leg(45.0, -60, pause_s=12.0, handled_s=8.0),
            Leg(70.0),
        ),
    ),
    "phone-floors": PhoneRoute(
        "a phone carried along corridors and up two flights of stairs",
        (Leg(20.0, 90), Leg(6.0, 180, 3.4), Leg(6.0, -90, 3.4), Leg(25.0, 90), Leg(15.0)),
    ),
    "phone-rest": PhoneRoute("a phone that nobody moves", ()),
    "phone-handled": PhoneRoute("a phone that is handled by somebody who stands", (), handled=True),
}
"""Scenarios of the phone, by name."""

PHONE_SCENARIOS: dict[str, str] = {name: route.title for name, route in PHONE_ROUTES.items()}
"""Scenarios of the phone: name to one line."""


def read_legs(text: str) -> tuple[Leg, ...]:
    """Return the legs of ``20:right 90,20:left 90,10``: lengths (m) and the turn behind each.

    Raises
    ------
    UsageError
        A leg cannot be read.
    """
    legs = []
    for part in text.split(","):
        length, _, turn = part.strip().partition(":")
        words = turn.split()
        try:
            angle = float(words[-1]) if words else 0.0
            if words and words[0] == "left":
                angle = -angle
            elif len(words) > 1 and words[0] != "right":
                raise ValueError
            legs.append(msgspec.convert({"length_m": float(length), "turn_deg": angle}, Leg))
        except (ValueError, msgspec.ValidationError):
            raise UsageError(
                f"route: {part.strip()!r} is no leg; write length:turn in m and degrees, "
                "such as 20:right 90,20:left 90,10"
            ) from None
    return tuple(legs)


def schedule(
    route: PhoneRoute,
    *,
    step_m: float,
    step_s: float,
    step_sd: float,
    rest_s: float,
    duration_s: float,
    course_rad: float,
    rng: np.random.Generator,
) -> Schedule:
    """Return the contacts of every step of a route.

    Parameters
    ----------
    route : PhoneRoute
        Legs and pauses.
    step_m, step_s, step_sd : float
        Mean length (m) and time (s) of a step, and the relative standard deviation of both.
    rest_s : float
        Standing at both ends (s).
    duration_s : float
        Length of a recording without legs (s).
    course_rad : float
        Course of the first leg, from east to north.
    rng : numpy.random.Generator
        Draws the steps.
    """
    t, way = rest_s, 0.0
    contacts: list[float] = []
    bout: list[int] = []
    starts: list[float] = []
    lengths: list[float] = []
    heights: list[float] = []
    corners: list[tuple[float, float]] = []
    handled: list[tuple[float, float]] = []
    walking = False
    for leg in route.legs:
        count = max(2, round(leg.length_m / step_m))
        spread = np.clip(1 + step_sd * rng.standard_normal(count), 0.6, 1.4)
        times = step_s * np.clip(1 + step_sd * rng.standard_normal(count), 0.6, 1.4)
        if not walking:
            starts.append(t)
            spread[0] *= 0.6  # the first step starts from both feet side by side
        stops = leg.pause_s > 0 or leg is route.legs[-1]
        if stops:
            spread[-1] *= 0.6
        lengths += (leg.length_m * spread / spread.sum()).tolist()
        contacts += (t + np.cumsum(times)).tolist()
        bout += [len(starts) - 1] * count
        climb = leg.climb_m / count
        heights += [climb] * count
        t, way, walking = contacts[-1], way + leg.length_m, True
        if leg.turn_deg:
            corners.append((way, -np.radians(leg.turn_deg)))
        if leg.pause_s:
            middle = t + (leg.pause_s - leg.handled_s) / 2
            if leg.handled_s:
                handled.append((middle, middle + leg.handled_s))
            t, walking = t + leg.pause_s, False
    end = t + rest_s if route.legs else duration_s
    if route.handled:
        handled = [(0.0, end)]
    return Schedule(
        np.array(contacts),
        np.array(bout, dtype=np.int64),
        np.array(starts),
        np.array(lengths),
        np.array(heights),
        corners,
        course_rad,
        handled,
        float(end),
    )
