"""Simulated walks with known truth, written as the raw logs of a real device.

:func:`simulate` writes the serial text or binary packets of a shoe-mounted box with two MPU-6050, and the
truth beside it; :func:`walk` gives the same walk as arrays, without files. :func:`phone_walk` gives a phone
that is carried in one of six placements. Equal scenario, seed and options give equal bytes.
"""

from .floor import FLOOR_SCENARIOS, FloorOptions, FloorWalk, floor_walk
from .gait import Mount, Style
from .leg import LegCapture, LegOptions, leg
from .phone import PhoneOptions, PhoneWalk, phone_walk
from .phone_routes import PHONE_SCENARIOS
from .scenarios import SCENARIOS
from .sensors import IDEAL, ImuErrors
from .walks import (
    Options,
    Simulation,
    Walk,
    walk,
)
from .writer import Line, Simulated, simulate

__all__ = [
    "FLOOR_SCENARIOS",
    "IDEAL",
    "PHONE_SCENARIOS",
    "SCENARIOS",
    "FloorOptions",
    "FloorWalk",
    "ImuErrors",
    "LegCapture",
    "LegOptions",
    "Line",
    "Mount",
    "Options",
    "PhoneOptions",
    "PhoneWalk",
    "Simulated",
    "Simulation",
    "Style",
    "Walk",
    "floor_walk",
    "leg",
    "phone_walk",
    "simulate",
    "walk",
]
