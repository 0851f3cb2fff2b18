"""The floor of the source, walked with a phone: signal strengths of six anchors beside steps and headings.

The source's floor (hybrid indoor positioning, table 5.1): two Wi-Fi and four BLE anchors with their heights and
exponents in a hall with corridors of 25 m × 8 m. P_d0 is published for anchor 3 alone (−57.55 dBm); the others' are
stated here. A power is

    P_d0 − 10 η log10 d + shadowing + blocking + multipath + offset of the phone,

shadowing a Gaussian field over the floor (exponential correlation by distance: Gudmundson 1991), one an anchor;
blocking a loss while somebody stands in the way; multipath new at each reading. Wi-Fi comes by scans, BLE by
advertisements, both when a phone hears them. Every part has random numbers of its own.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import msgspec
import numpy as np
import polars as pl

from ...recording.errors import UsageError
from .gait import FloatArray
from .phone import PhoneWalk, phone_walk
from .walks import checked

_NonNegative = Annotated[float, msgspec.Meta(ge=0)]
_Positive = Annotated[float, msgspec.Meta(gt=0)]


class SimulatedAnchor(msgspec.Struct, frozen=True):
    """One anchor of the floor: name, technology, place (m), P_d0 (dBm at 1 m), η."""

    name: str
    technology: str
    x: float
    y: float
    z: float
    p_d0: float
    eta: float

    @property
    def mac(self) -> str:
        """Address, made of the number."""
        first = "a4:6c:2a:00:00" if self.technology == "wifi" else "a0:e6:f8:00:00"
        return f"{first}:{int(self.name.removeprefix('anchor')):02x}"


WIFI_Z, BLE_Z = 2.6, 0.8
ANCHORS = (
    SimulatedAnchor("anchor1", "wifi", 23.1, 1.5, WIFI_Z, -38.0, 2.43),
    SimulatedAnchor("anchor2", "wifi", 1.5, 6.9, WIFI_Z, -38.0, 2.12),
    SimulatedAnchor("anchor3", "ble", 3.9, 1.5, BLE_Z, -57.55, 1.71),
    SimulatedAnchor("anchor4", "ble", 8.1, 5.7, BLE_Z, -57.55, 1.61),
    SimulatedAnchor("anchor5", "ble", 18.3, 6.3, BLE_Z, -57.55, 1.53),
    SimulatedAnchor("anchor6", "ble", 17.7, 0.9, BLE_Z, -57.55, 1.68),
)
"""Table 5.1 of the source, heights of section 5.1."""
SIZE_M = (25.0, 8.4)
"""The floor, from (0, 0)."""
ROUTES = {
    "floor-walk": ((2.5, 2.2), "9.5:left 90,1.5:right 90,8.5"),
    "floor-loop": ((2.5, 2.0), "20:left 90,4.5:left 90,20:left 90,4.5"),
}
"""Start in the plan and legs, the first along the plan's x axis."""
POINTS = ((5.4, 4.2), (12.0, 3.0), (19.5, 4.5))
"""Three places at which the source measured 20 samples each (table 5.3); their coordinates are not published."""
FLOOR_SCENARIOS = {
    "floor-walk": "the source's floor walked with a phone among six anchors",
    "floor-loop": "a closed loop of 49 m on the source's floor",
    "floor-points": "a phone that stands at three points of the source's floor, 20 windows each",
    "floor-survey": "a survey of the source's floor: a phone that stands on a grid of 2 m",
}
"""Scenarios of the floor: name to one line."""


class FloorOptions(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Everything that can be chosen about a simulated floor; others go to the phone that is carried.

    Attributes
    ----------
    shadow_db, shadow_m : float
        Standard deviation (dB) of the shadowing and distance (m) over which it stays.
    multipath_db : float
        Standard deviation (dB) of what is new at each reading.
    blocked_db, blocked_share, blocked_s : float
        Loss (dB) while a path is blocked, share of the time in which it is, mean length of a stretch (s).
    offset_db : float
        Of this phone against the calibration.
    pattern_db, pattern_s : float
        A carrier that turns about itself: how much stronger or weaker (dB) an anchor is heard by its direction, and
        the time of a turn (s).
    silent : str
        Names of anchors that are never heard, between blanks.
    wifi_s, wifi_jitter_s : float
        Time between two Wi-Fi scans and its standard deviation (s).
    ble_s : float
        Mean time between two advertisements of a beacon that are heard (s).
    weakest_dbm : float
        Weaker signals are not heard.
    plan_azimuth_deg : float
        Azimuth of the plan's x axis, clockwise from magnetic north.
    azimuth_bias_deg, azimuth_noise_deg : float
        Error of the phone's azimuth over a walk (standard deviation) and of a reading.
    start_x, start_y : float or None
        Start in the plan, else the scenario's.
    window_s : float
        Length of one of the 20 samples at a point (scenario floor-points), and of the stay at a point of the survey.
    """

    shadow_db: _NonNegative = 2.0
    shadow_m: _Positive = 3.0
    multipath_db: _NonNegative = 3.0
    blocked_db: _NonNegative = 4.0
    blocked_share: Annotated[float, msgspec.Meta(ge=0, lt=1)] = 0.05
    blocked_s: _Positive = 3.0
    offset_db: float = 0.0
    pattern_db: _NonNegative = 0.0
    pattern_s: _Positive = 4.0
    silent: str = ""
    wifi_s: _Positive = 2.0
    wifi_jitter_s: _NonNegative = 0.3
    ble_s: _Positive = 0.3
    weakest_dbm: float = -95.0
    plan_azimuth_deg: float = 74.0
    azimuth_bias_deg: _NonNegative = 6.0
    azimuth_noise_deg: _NonNegative = 2.0
    start_x: float | None = None
    start_y: float | None = None
    window_s: _Positive = 5.0


@dataclass(frozen=True)
class FloorWalk:
    """A simulated walk on the floor.

    Attributes
    ----------
    phone : PhoneWalk
        Inertial readings and what is true of them.
    position : ndarray
        The walker in the plan (m) at the phone's samples, shape (n, 2).
    radio : polars.DataFrame
        ``t_ns, mac, technology, rssi_dbm, last_seen_ns`` and ``true_m``: the distance.
    azimuth_deg : ndarray
        Azimuth, pitch, roll (deg) as the phone states them, shape (n, 3).
    options : FloorOptions
        What was chosen.
    """

    phone: PhoneWalk
    position: FloatArray
    radio: pl.DataFrame
    azimuth_deg: FloatArray
    options: FloorOptions


def floor_walk(scenario: str = "floor-walk", *, seed: int = 0, **options: Any) -> FloorWalk:
    """Simulate a walk, or a stay, on the source's floor.

    Parameters
    ----------
    scenario : str
        A key of :data:`FLOOR_SCENARIOS`.
    seed : int
        Of all random numbers.
    **options
        Fields of :class:`FloorOptions`, of :class:`PhoneOptions` and of :class:`ImuErrors`.

    Raises
    ------
    UsageError
        Unknown scenario or option, or a value that breaks its rule.
    """
    if scenario not in FLOOR_SCENARIOS:
        raise UsageError(f"scenario {scenario!r} is unknown: choose one of {', '.join(FLOOR_SCENARIOS)}")
    own = {k: options.pop(k) for k in list(options) if k in FloorOptions.__struct_fields__}
    o = checked(scenario, FloorOptions, own)
    x_axis = np.radians(o.plan_azimuth_deg)
    still = scenario in ("floor-points", "floor-survey")
    stops = np.array(POINTS if scenario == "floor-points" else _grid())
    if still:
        stay = o.window_s * (20 if scenario == "floor-points" else 1)
        phone = phone_walk("phone-rest", seed=seed, **{"duration_s": stay * len(stops), **options})
        station = np.minimum((np.arange(len(phone.t_ns)) * len(stops)) // len(phone.t_ns), len(stops) - 1)
        position = stops[station]
    else:
        (x0, y0), route = ROUTES[scenario]
        first = np.array(
            [o.start_x if o.start_x is not None else x0, o.start_y if o.start_y is not None else y0]
        )
        declination = np.degrees(phone_walk("phone-rest", seed=0, duration_s=0.5).declination_rad)
        course = {"route": route, "course_deg": o.plan_azimuth_deg + float(declination), "rest_s": REST_S}
        phone = phone_walk("phone-turns", seed=seed, **{**course, **options})
        # plan x = along the x axis, y to the left of it; the walk's own frame is east, true north
        east, north = phone.pos[:, 0], phone.pos[:, 1]
        a = x_axis + phone.declination_rad
        position = first + np.column_stack(
            [east * np.sin(a) + north * np.cos(a), -east * np.cos(a) + north * np.sin(a)]
        )
    radio = _radio(phone.t_ns, position, o, seed)
    return FloorWalk(phone, position, radio, _angles(phone, o, seed), o)


def _rng(seed: int, part: str) -> np.random.Generator:
    return np.random.default_rng([seed, *part.encode()])


def _grid() -> list[tuple[float, float]]:
    return [
        (float(x), float(y)) for x in np.arange(1.0, SIZE_M[0], 2.0) for y in np.arange(1.0, SIZE_M[1], 2.0)
    ]


def _angles(phone: PhoneWalk, o: FloorOptions, seed: int) -> FloatArray:
    """Return Android's azimuth, pitch, roll (deg) of the phone: true attitude about magnetic north, with errors."""
    from scipy.spatial.transform import Rotation

    q = phone.quat_wxyz
    turn = Rotation.from_quat(q[:, [1, 2, 3, 0]])
    magnetic = Rotation.from_euler("z", phone.declination_rad) * turn
    # rot_nb = Rz(−azimuth) Rx(−pitch) Ry(roll), intrinsic
    angles = magnetic.as_euler("ZXY")
    rng = _rng(seed, "azimuth")
    bias = o.azimuth_bias_deg * rng.standard_normal()
    azimuth = -np.degrees(angles[:, 0]) + bias + o.azimuth_noise_deg * rng.standard_normal(len(q))
    return np.column_stack([azimuth % 360.0, -np.degrees(angles[:, 1]), np.degrees(angles[:, 2])])


def shadowing(where: FloatArray, length_m: float, rng: np.random.Generator, waves: int = 400) -> FloatArray:
    """Return a Gaussian field of unit variance and correlation exp(−d / length) at places (n, 2).

    A sum of cosines whose wave numbers have the spectrum of that correlation in the plane (Matérn 1960: ν = ½).
    """
    direction = rng.uniform(0, 2 * np.pi, waves)
    # radial spectrum k / (1 + (k L)²)^{3/2}: its distribution is 1 − (1 + (k L)²)^{−½}
    number = np.sqrt(rng.uniform(0, 1, waves) ** -2.0 - 1.0) / length_m
    phase = rng.uniform(0, 2 * np.pi, waves)
    argument = where @ np.stack([number * np.cos(direction), number * np.sin(direction)]) + phase
    return np.sqrt(2.0 / waves) * np.cos(argument).sum(axis=1)


def _blocked(t: FloatArray, o: FloorOptions, rng: np.random.Generator) -> FloatArray:
    """Return 1 while the path is blocked: stretches of exponential length, free ones between."""
    if not o.blocked_share or not len(t):
        return np.zeros(len(t))
    free_s = o.blocked_s * (1 - o.blocked_share) / o.blocked_share
    count = int(4 * t[-1] / (free_s + o.blocked_s)) + 8
    lengths = np.empty(2 * count)
    lengths[0::2], lengths[1::2] = rng.exponential(free_s, count), rng.exponential(o.blocked_s, count)
    edges = np.cumsum(lengths)
    return (np.searchsorted(edges, t, side="right") % 2).astype(np.float64)


def _radio(t_ns: np.ndarray, position: FloatArray, o: FloorOptions, seed: int) -> pl.DataFrame:
    """Return what the phone hears."""
    t = (t_ns - t_ns[0]) / 1e9
    end = float(t[-1])
    parts: list[pl.DataFrame] = []
    scans = _rng(seed, "scans")
    beats = np.cumsum(
        np.maximum(o.wifi_s + o.wifi_jitter_s * scans.standard_normal(int(end / o.wifi_s * 2) + 4), 0.1)
    )
    beats = beats[beats < end]
    lost = set(o.silent.split())
    if unknown := lost - {a.name for a in ANCHORS}:
        names = ", ".join(a.name for a in ANCHORS)
        raise UsageError(f"silent={min(unknown)!r}: no such anchor; there are {names}")
    for anchor in (a for a in ANCHORS if a.name not in lost):
        rng = _rng(seed, anchor.name)
        if anchor.technology == "wifi":
            seen = np.maximum(beats - rng.uniform(0.0, 0.2, len(beats)), 0.0)
            told = beats
        else:
            gaps = rng.exponential(0.5 * o.ble_s, int(end / o.ble_s * 3) + 8) + 0.5 * o.ble_s
            seen = np.cumsum(gaps)
            seen = seen[seen < end]
            told = seen
        where = np.column_stack([np.interp(seen, t, position[:, k]) for k in (0, 1)])
        plane2 = ((where - [anchor.x, anchor.y]) ** 2).sum(axis=1)
        d = np.sqrt(np.maximum(plane2 + (anchor.z - HELD_Z) ** 2, 0.09))
        power = anchor.p_d0 - 10 * anchor.eta * np.log10(d) + o.offset_db
        power += o.shadow_db * shadowing(where, o.shadow_m, _rng(seed, f"shadow {anchor.name}"))
        bearing = np.arctan2(anchor.y - where[:, 1], anchor.x - where[:, 0])
        power += o.pattern_db * np.cos(2 * np.pi * seen / o.pattern_s - bearing)
        power -= o.blocked_db * _blocked(seen, o, _rng(seed, f"blocked {anchor.name}"))
        power = np.round(power + o.multipath_db * rng.standard_normal(len(seen)))
        heard = power >= o.weakest_dbm
        parts.append(
            pl.DataFrame(
                {
                    "t_ns": (t_ns[0] + np.round(told * 1e9).astype(np.int64))[heard],
                    "mac": [anchor.mac] * int(heard.sum()),
                    "technology": [anchor.technology] * int(heard.sum()),
                    "rssi_dbm": power[heard],
                    "last_seen_ns": (t_ns[0] + np.round(seen * 1e9).astype(np.int64))[heard],
                    "true_m": d[heard],
                }
            )
        )
    return pl.concat(parts).sort("t_ns", maintain_order=True)


REST_S = 12.0
"""Standing (s) at both ends: the final position is where the person has stopped for two windows."""
HELD_Z = 1.2
"""Height (m) of the phone in the hand."""
