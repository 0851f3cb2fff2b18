"""Units that tables use, to those of the recording."""

from __future__ import annotations

import math

from ..recording.errors import UsageError
from .checks import STANDARD_GRAVITY

_DEG = math.pi / 180.0
_FOOT = 0.3048

#: For each unit of the recording, the units that become it: value · factor + offset.
UNITS: dict[str, dict[str, tuple[float, float]]] = {
    "m/s²": {
        "m/s2": (1.0, 0.0),
        "g": (STANDARD_GRAVITY, 0.0),
        "mg": (STANDARD_GRAVITY / 1000, 0.0),
        "cm/s2": (0.01, 0.0),
        "mm/s2": (0.001, 0.0),
        "ft/s2": (_FOOT, 0.0),
    },
    "rad/s": {
        "rad/s": (1.0, 0.0),
        "mrad/s": (0.001, 0.0),
        "deg/s": (_DEG, 0.0),
        "dps": (_DEG, 0.0),
        "mdps": (_DEG / 1000, 0.0),
        "rpm": (math.pi / 30, 0.0),
    },
    "T": {
        "T": (1.0, 0.0),
        "mT": (1e-3, 0.0),
        "uT": (1e-6, 0.0),
        "nT": (1e-9, 0.0),
        "G": (1e-4, 0.0),
        "gauss": (1e-4, 0.0),
        "mG": (1e-7, 0.0),
    },
    "Pa": {
        "Pa": (1.0, 0.0),
        "hPa": (100.0, 0.0),
        "mbar": (100.0, 0.0),
        "kPa": (1000.0, 0.0),
        "bar": (1e5, 0.0),
        "mmHg": (101325 / 760, 0.0),
        "psi": (6894.757293168, 0.0),
    },
    "°C": {"degC": (1.0, 0.0), "C": (1.0, 0.0), "K": (1.0, -273.15), "degF": (5 / 9, -160 / 9)},
    "m": {
        "m": (1.0, 0.0),
        "mm": (1e-3, 0.0),
        "cm": (1e-2, 0.0),
        "km": (1e3, 0.0),
        "in": (0.0254, 0.0),
        "ft": (_FOOT, 0.0),
        "us-survey-ft": (1200 / 3937, 0.0),
    },
    "m/s": {
        "m/s": (1.0, 0.0),
        "mm/s": (1e-3, 0.0),
        "cm/s": (1e-2, 0.0),
        "km/h": (1 / 3.6, 0.0),
        "ft/s": (_FOOT, 0.0),
        "mph": (0.44704, 0.0),
        "kn": (1852 / 3600, 0.0),
    },
    "rad": {"rad": (1.0, 0.0), "mrad": (1e-3, 0.0), "deg": (_DEG, 0.0)},
    "°": {"deg": (1.0, 0.0), "rad": (1 / _DEG, 0.0), "arcsec": (1 / 3600, 0.0)},
    "dBm": {"dBm": (1.0, 0.0)},
    "Hz": {"Hz": (1.0, 0.0), "kHz": (1e3, 0.0), "MHz": (1e6, 0.0), "GHz": (1e9, 0.0)},
    "N m": {"Nm": (1.0, 0.0), "Nmm": (1e-3, 0.0)},
    "ns": {"ns": (1.0, 0.0), "us": (1e3, 0.0), "ms": (1e6, 0.0), "s": (1e9, 0.0)},
    "-": {},
    "as named": {},
}


def plain(unit: str) -> str:
    """Return a unit as :data:`UNITS` spells it (``µ`` and ``μ``: ``u``, ``°``: ``deg``, ``²``: ``2``)."""
    text = unit.replace(" ", "").replace("·", "").replace("*", "").replace("^", "").replace("**", "")
    for odd, even in (("µ", "u"), ("μ", "u"), ("°", "deg"), ("²", "2"), ("degrees", "deg"), ("sec", "s")):
        text = text.replace(odd, even)
    return text if text != "arcs" else "arcsec"


def conversion(unit: str, wanted: str) -> tuple[float, float]:
    """Return (factor, offset) from a unit that a table uses to one of the recording.

    Raises
    ------
    UsageError
        The one cannot become the other.
    """
    factors = UNITS.get(wanted, {})
    text = plain(unit)
    if text in factors:
        return factors[text]
    if text == plain(wanted) or (not factors and text in ("", "-", "1")):
        return 1.0, 0.0
    listed = ", ".join(factors) or "none: leave it out, or use scale"
    raise UsageError(f"unit {unit!r} cannot become {wanted}; known here: {listed}")
