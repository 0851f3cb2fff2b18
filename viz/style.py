"""Colours, names and units of everything drawn, the same in the viewer and in the figures.

The palette starts from Okabe and Ito (2008), which people with colour-vision deficiencies can tell apart;
its yellow and
black are left out and the others moved in lightness until each has a contrast of 3:1 or more both on white
and on the viewer's dark background (WCAG 2.1, non-text contrast).
"""

from __future__ import annotations

from typing import NamedTuple

AXES = ("#D55E00", "#009E73", "#2F8FD0")
"""x, y, z."""

RUNS = ("#2F8FD0", "#D55E00", "#009E73", "#B86FA5", "#C98500", "#1AA3A3", "#8F7BE0", "#7C9B00", "#A9745B")
"""One colour a run, in the order of the runs; beyond the last they start again."""

REFERENCE = "#8A8A8A"
THRESHOLD = "#E0556F"
NORM = "#8F7BE0"
DEVICE = "#B86FA5"
"""What a device states itself: angles of an encoder, orientations, fixes."""

STILL = "#009E73"
MOVING = "#8A8A8A"


DEGREES = 57.29577951308232
"""Degrees a radian."""


class ColumnStyle(NamedTuple):
    """How a column is shown: a short name with its unit, and the factor from SI to that unit."""

    name: str
    factor: float = 1.0


COLUMNS = {
    **{f"acc_{a}": ColumnStyle(f"acceleration {a} (m/s²)") for a in "xyz"},
    **{f"gyr_{a}": ColumnStyle(f"angular rate {a} (rad/s)") for a in "xyz"},
    **{f"mag_{a}": ColumnStyle(f"magnetic field {a} (µT)", 1e6) for a in "xyz"},
    **{f"pos_{a}": ColumnStyle(f"position {a} (m)") for a in "xyz"},
    **{f"vel_{a}": ColumnStyle(f"velocity {a} (m/s)") for a in "xyz"},
    **{f"sigma_pos_{a}": ColumnStyle(f"position {a} (m)") for a in "xyz"},
    **{f"sigma_vel_{a}": ColumnStyle(f"velocity {a} (m/s)") for a in "xyz"},
    **{f"sigma_att_{a}": ColumnStyle(f"attitude {a} (°)", DEGREES) for a in "xyz"},
    "acc_norm": ColumnStyle("‖acc‖ (m/s²)"),
    "acc_var": ColumnStyle("variance of ‖acc‖ (m²/s⁴)"),
    "gyr_norm": ColumnStyle("‖gyr‖ (rad/s)"),
    "pitch_dev": ColumnStyle("pitch − pitch at rest (°)"),
    "pitch_var": ColumnStyle("variance of pitch (°²)"),
    "shoe": ColumnStyle("SHOE (–)"),
    "are": ColumnStyle("angular rate energy (rad²/s²)"),
    "mv": ColumnStyle("moving variance (m²/s⁴)"),
    "mag": ColumnStyle("magnitude deviation (m²/s⁴)"),
    "pressure_pa": ColumnStyle("pressure (hPa)", 0.01),
    "temperature_c": ColumnStyle("temperature (°C)"),
    "height_m": ColumnStyle("height (m)"),
    "length_m": ColumnStyle("length (m)"),
}
"""Columns with a name of their own; others are shown as ``column (unit)`` of their schema."""


SUFFIXES = {
    "_deg": "°",
    "_dbm": "dBm",
    "_m_s": "m/s",
    "_hz": "Hz",
    "_s": "s",
    "_m": "m",
    "_pa": "Pa",
    "_percent": "%",
}
"""Units that the end of a name says."""


def run_color(index: int) -> str:
    """Return the colour of the run with this number, as ``#RRGGBB``."""
    return RUNS[index % len(RUNS)]


def axis_color(index: int) -> str:
    """Return the colour of a column: x, y, z first, then the palette of the runs."""
    return AXES[index] if index < len(AXES) else RUNS[index % len(RUNS)]


def rgb(color: str) -> tuple[int, int, int]:
    """Return ``#RRGGBB`` as three numbers from 0 to 255."""
    return int(color[1:3], 16), int(color[3:5], 16), int(color[5:7], 16)
