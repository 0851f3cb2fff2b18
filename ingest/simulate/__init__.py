"""Simulated walks with known truth, written as the raw logs of a real device.

:func:`simulate` writes the serial text or binary packets of a shoe-mounted box with two MPU-6050, and the
truth beside it; :func:`walk` gives the same walk as arrays, without files. Equal scenario, seed and options
give equal bytes.
"""

from .gait import Mount, Style
from .leg import LegCapture, LegOptions, leg
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
    "IDEAL",
    "SCENARIOS",
    "ImuErrors",
    "LegCapture",
    "LegOptions",
    "Line",
    "Mount",
    "Options",
    "Simulated",
    "Simulation",
    "Style",
    "Walk",
    "leg",
    "simulate",
    "walk",
]
