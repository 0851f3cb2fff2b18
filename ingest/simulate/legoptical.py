"""The cameras of a simulated capture: markers on every segment, their clock, hidden stretches."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .legmotion import SIDES, Body, FloatArray

if TYPE_CHECKING:
    from .leg import LegCapture, Optical

CLUSTER = np.array([[0.03, 0.0, 0.04], [-0.03, 0.0, 0.04], [0.03, 0.01, -0.04], [-0.03, 0.02, -0.03]])
"""Four markers of a rigid plate about the middle of a segment (m)."""
EPICONDYLES_M, MALLEOLI_M = 0.05, 0.035
"""Half the distance of the medial and the lateral marker of knee and ankle (m)."""


def landmarks(body: Body, side: str) -> dict[str, dict[str, FloatArray]]:
    """Return the markers of one leg by segment: name and place in the segment's frame (m)."""
    out = SIDES[side]
    thigh, shank = np.array([0.0, 0.0, -body.thigh_m]), np.array([0.0, 0.0, -body.shank_m])
    wide, narrow = np.array([out * EPICONDYLES_M, 0.0, 0.0]), np.array([out * MALLEOLI_M, 0.0, 0.0])
    down = np.array([0.0, 0.0, -body.ankle_height_m])
    by_segment = {
        "thigh": {"hip": np.zeros(3), "knee_lat": thigh + wide, "knee_med": thigh - wide},
        "shank": {"knee": np.zeros(3), "ankle_lat": shank + narrow, "ankle_med": shank - narrow},
        "foot": {
            "heel": down - np.array([0.0, body.heel_m, 0.0]),
            "toe": down + np.array([0.0, body.toe_m, 0.0]),
        },
    }
    middle = {"thigh": 0.5 * thigh, "shank": 0.5 * shank, "foot": np.array([0.0, 0.08, -0.02])}
    for name, marks in by_segment.items():
        place = middle[name] + (out * 0.06 if name != "foot" else 0.0, 0.0, 0.0)
        marks |= {f"{name}_{k + 1}": place + p for k, p in enumerate(CLUSTER)}
    return by_segment


def trunk_markers(body: Body) -> dict[str, FloatArray]:
    """Return the markers of the trunk: the front of the pelvis, the shoulders, a plate on the back."""
    marks = {
        "asis_left": np.array([-0.12, 0.10, 0.08]),
        "asis_right": np.array([0.12, 0.10, 0.08]),
        "shoulder_left": np.array([-0.18, 0.0, body.trunk_m]),
        "shoulder_right": np.array([0.18, 0.0, body.trunk_m]),
    }
    back = np.array([0.0, -0.12, 0.5 * body.trunk_m])
    return marks | {f"trunk_{k + 1}": back + p for k, p in enumerate(CLUSTER)}


def capture(leg: LegCapture) -> Optical:
    """Return what the cameras of ``leg`` saw."""
    from .leg import JOINTS, Optical, joint_angle

    o, rng = leg.options, leg._rng("optical")
    stop = min(o.duration_s, o.optical_stop_s or o.duration_s)
    # The cameras count their own time: their frames are even on their clock, not on the other.
    speed = 1 + o.optical_drift_ppm * 1e-6
    first = max(0.0, np.ceil((o.optical_start_s - o.optical_offset_s) * speed * o.optical_rate_hz - 1e-9))
    last = np.floor((stop - o.optical_offset_s) * speed * o.optical_rate_hz + 1e-9)
    own = np.arange(first, last + 1) / o.optical_rate_hz
    t = own / speed + o.optical_offset_s
    poses = leg.chain.pose(t)
    names: list[str] = []
    places: list[FloatArray] = []

    def add(segment: str, prefix: str, marks: dict[str, FloatArray]) -> None:
        pose = poses[segment]
        for name, place in marks.items():
            names.append(prefix + name)
            places.append(pose.pos + pose.rot @ place)

    add("trunk", "", trunk_markers(leg.chain.body))
    for side in leg.sides:
        prefix = f"{side}_" if len(leg.sides) > 1 else ""
        for part, marks in landmarks(leg.chain.body, side).items():
            add(f"{side}_{part}", prefix, marks)
    pos = np.stack(places, axis=1) + o.optical_noise_m * rng.standard_normal((t.size, len(names), 3))
    for k in range(len(names)):
        pos[_hidden(t, o.dropout_share, o.dropout_s, rng), k] = np.nan
    upper = {
        leg._named(p, s): poses[leg._key(leg._named(p, s))].rot
        for s in leg.sides
        for p in ("trunk", "thigh", "shank", "foot")
    }
    angle = {
        leg._named(joint, s): joint_angle(upper[leg._named(up, s)], upper[leg._named(low, s)])
        for s in leg.sides
        for joint, (up, low) in JOINTS.items()
    }
    return Optical(np.round(own * 1e9).astype(np.int64), t, tuple(names), pos, upper, angle)


def _hidden(t: FloatArray, share: float, mean_s: float, rng: np.random.Generator) -> np.ndarray:
    """Return which samples fall into stretches of exponential length in which a marker is not seen."""
    if not share or not t.size:
        return np.zeros(t.size, dtype=bool)
    span = t[-1] - t[0]
    count = rng.poisson(share * span / mean_s)
    start = t[0] + span * rng.random(count)
    end = start + mean_s * rng.exponential(size=count)
    depth = np.zeros(t.size + 1, dtype=int)
    np.add.at(depth, np.searchsorted(t, start), 1)
    np.add.at(depth, np.searchsorted(t, end), -1)
    return np.cumsum(depth)[:-1] > 0
