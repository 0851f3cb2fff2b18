"""Steps from vertical acceleration, and the heading of a phone, as the source takes them.

Source: hybrid indoor positioning, sections 3.4 and 4.5. Gravity by a low pass of each axis (eqs 3.24–3.26); eq 3.24
prints the linear acceleration of the sample before instead of the acceleration, which would settle at half of
gravity: corrected here.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ..contract import FloatArray
from ..numerics.compiled import compiled

STATE = np.dtype(
    [
        ("t_ns", "i8"),  # of the sample before, −1 before the first
        ("grav", "f8", 3),  # low-passed specific force, m/s²
        ("rising_ns", "i8"),  # when the linear acceleration passed +threshold, −1 while it has not
        ("azimuth", "f8"),  # of the phone's y axis, clockwise from north, rad; NaN while not known
        ("index", "i8"),  # steps so far
        ("threshold", "f8"),  # m/s²
        ("least_ns", "i8"),
        ("most_ns", "i8"),
        ("gravity_s", "f8"),  # time constant t of the low pass
        ("along_gravity", "i8"),
    ]
)


@compiled
def take_acceleration(s: Any, t_ns: int, x: float, y: float, z: float) -> bool:
    """Take one specific force (m/s², phone's axes); return whether a step ends with it.

    grav = α grav + (1 − α) acc with α = t / (t + δt); linear = acc − grav. A step is the passage of the linear
    vertical acceleration above the threshold and then below its negative, ``least_ns`` to ``most_ns`` later.
    """
    if s.t_ns < 0:
        s.t_ns = t_ns
        s.grav[0], s.grav[1], s.grav[2] = x, y, z
        return False
    dt = (t_ns - s.t_ns) * 1e-9
    s.t_ns = t_ns
    alpha = s.gravity_s / (s.gravity_s + dt)
    s.grav[0] = alpha * s.grav[0] + (1.0 - alpha) * x
    s.grav[1] = alpha * s.grav[1] + (1.0 - alpha) * y
    s.grav[2] = alpha * s.grav[2] + (1.0 - alpha) * z
    if s.along_gravity == 1:
        norm = math.sqrt(s.grav[0] ** 2 + s.grav[1] ** 2 + s.grav[2] ** 2)
        vertical = (
            (x - s.grav[0]) * s.grav[0] + (y - s.grav[1]) * s.grav[1] + (z - s.grav[2]) * s.grav[2]
        ) / max(norm, 1e-9)
    else:
        vertical = z - s.grav[2]
    if vertical > s.threshold:
        if s.rising_ns < 0:
            s.rising_ns = t_ns
        return False
    if s.rising_ns >= 0:
        since = t_ns - s.rising_ns
        if since > s.most_ns:
            s.rising_ns = -1
        elif vertical < -s.threshold:
            s.rising_ns = -1
            return since >= s.least_ns
    return False


def make_state(
    *, threshold: float, least_s: float, most_s: float, gravity_s: float, along_gravity: bool
) -> np.ndarray[Any, Any]:
    """Return the state of the detector before the first sample, shape (1,)."""
    state = np.zeros(1, STATE)
    s = state[0]
    s["t_ns"] = s["rising_ns"] = -1
    s["azimuth"] = np.nan
    s["threshold"], s["gravity_s"] = threshold, gravity_s
    s["least_ns"], s["most_ns"] = round(least_s * 1e9), round(most_s * 1e9)
    s["along_gravity"] = int(along_gravity)
    return state


@compiled
def detect_steps(s: Any, acceleration: Any, orientation: Any, t_ns: Any, values: Any, out: Any) -> None:
    """Fill ``out`` with the azimuth (rad) of the step that ends with each message, NaN where none does.

    ``acceleration`` and ``orientation`` say of each message whether it is one; ``values`` are x, y, z or w, x, y, z.
    """
    for m in range(t_ns.size):
        out[m] = math.nan
        if orientation[m]:
            w, x, y, z = values[m, 0], values[m, 1], values[m, 2], values[m, 3]
            s.azimuth = math.atan2(2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z))
        elif acceleration[m] and take_acceleration(s, t_ns[m], values[m, 0], values[m, 1], values[m, 2]):
            out[m] = s.azimuth


def azimuth_of(w: float, x: float, y: float, z: float) -> float:
    """Return the azimuth (rad, clockwise from north) of the y axis under a rotation to east, north, up."""
    east, north = 2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z)
    return math.atan2(east, north)


def compass(mag: FloatArray, up: FloatArray) -> float:
    """Return the azimuth of the phone's y axis from the magnetic field and the upward direction, phone's axes.

    Shapes: both (3,), the field in any unit; rad.

    East is field × up, north up × east; NaN where the field is vertical.
    """
    east = np.cross(mag, up)
    north = np.cross(up, east)
    length = np.linalg.norm(east)
    if length < 1e-12 * max(float(np.linalg.norm(mag)), 1e-30) or not np.isfinite(length):
        return math.nan
    return math.atan2(float(east[1] / length), float(north[1] / np.linalg.norm(north)))


def plan_heading(azimuth: float, x_axis_azimuth: float, mirrored: bool) -> float:
    """Return the heading in the plan from its x towards its y (rad).

    On a right-handed plan (y is left of x, seen from above) θ = azimuth of the plan's x axis − azimuth; on
    one whose y points down the picture it is the negative of that.
    """
    theta = azimuth - x_axis_azimuth if mirrored else x_axis_azimuth - azimuth
    return math.remainder(theta, 2.0 * math.pi)
