"""What the aids remember of a walk: their part of a filter's state."""

from __future__ import annotations

from ...numerics.records import record_type
from .parameters import MOST_STRIDES

HEADING_AIDS = ("none", "hdr", "ihde")
NO_HEADING, HDR, IHDE = 0, 1, 2

HEIGHT = record_type(
    ("on", "?"),
    ("change_max", "f8"),
    ("variance", "f8"),
    ("level", "f8"),  # height of the level's first stance, m
    ("used", "i8"),
)

STRAIGHT = record_type(
    ("kind", "i8"),  # index into HEADING_AIDS
    ("sector", "f8"),  # angle between dominant directions, rad
    ("wanted", "i8"),  # strides that must agree
    ("deviation_max", "f8"),
    ("stride_min", "f8"),
    ("gate", "f8"),
    ("variance", "f8"),
    ("n_strides", "i8"),  # usable strides without a break
    ("headings", "f8", (MOST_STRIDES,)),  # directions of the newest ones, a ring
    ("run", "i8"),  # strides of the present straight, 0 none
    ("run_heading", "f8"),  # its mean direction
    ("grid", "f8"),
    ("grid_known", "?"),
    ("used", "i8"),
)

MAGNETOMETER = record_type(
    ("on", "?"),
    ("norm_max", "f8"),
    ("dip_max", "f8"),
    ("variance", "f8"),
    ("total", "f8", (3,)),  # since the newest measurement, T
    ("count", "i8"),
    ("wait", "f8"),  # s since the newest measurement
    ("reference", "f8", (3,)),  # mean of the first stance
    ("known", "?"),
    ("seen", "i8"),
    ("used", "i8"),
    ("refused", "i8"),
)

BAROMETER = record_type(
    ("on", "?"),
    ("column", "i8"),  # of the pressure among a sample's extra ones
    ("scale", "f8"),  # T/Λ, m
    ("variance", "f8"),
    ("total", "f8"),  # Pa
    ("count", "i8"),
    ("wait", "f8"),
    ("reference", "f8"),
    ("known", "?"),
    ("seen", "i8"),
    ("used", "i8"),
)

AIDS = record_type(
    ("on", "?"),  # any aid is on
    ("after_s", "f8"),
    ("every_s", "f8"),
    ("begun", "?"),
    ("settled", "?"),  # this stance has been looked at
    ("place", "f8", (3,)),  # position of the newest still sample that belongs to a settled stance
    ("landings", "i8"),
    ("height", HEIGHT),
    ("straight", STRAIGHT),
    ("magnetometer", MAGNETOMETER),
    ("barometer", BAROMETER),
)
