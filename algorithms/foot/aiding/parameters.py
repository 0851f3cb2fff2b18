"""Parameters of the aids."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec

from ...parameters import meta

MOST_STRIDES = 8

_ABDULRAHIM = "Abdulrahim et al. 2012"
_BORENSTEIN = "Borenstein and Ojeda 2009"
_JIMENEZ = "Jiménez et al. 2011"


class AidingParams(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Parameters of the aids; all aids are off by default."""

    hupt: Annotated[
        bool, meta("Height update: stances on one level have one height; not for ramps", source=_ABDULRAHIM)
    ] = False
    hupt_max_m: Annotated[
        float,
        meta("Height update: greatest change of height on flat ground", "m", "ours: below a stair", gt=0.0),
    ] = 0.1
    sigma_hupt: Annotated[float, meta("Height update: noise of the level's height", "m", "ours", gt=0.0)] = (
        0.01
    )
    heading_aid: Annotated[
        Literal["none", "hdr", "ihde"],
        meta(
            "Heading from straight walking: hdr keeps a straight straight, ihde lays straights along the "
            "building's dominant directions",
            source=f"{_BORENSTEIN}; {_JIMENEZ}",
        ),
    ] = "none"
    heading_directions: Annotated[
        int, meta("ihde: dominant directions in a full turn", "1", f"{_JIMENEZ}: 4 or 8", ge=1, le=36)
    ] = 4
    heading_grid: Annotated[
        Literal["first-straight", "given"],
        meta("ihde: dominant directions along the first straight, or from heading_grid_deg", source="ours"),
    ] = "first-straight"
    heading_grid_deg: Annotated[
        float, meta("ihde: one dominant direction, anticlockwise from x of n", "deg", "ours")
    ] = 0.0
    heading_gate_deg: Annotated[
        float,
        meta(
            "ihde: greatest distance from a dominant direction that is taken for drift", "deg", "ours", gt=0.0
        ),
    ] = 15.0
    straight_strides: Annotated[
        int, meta("Straight walking: strides that must agree", "1", _JIMENEZ, ge=2, le=MOST_STRIDES)
    ] = 5
    straight_max_deg: Annotated[
        float,
        meta(
            "Straight walking: greatest distance of their directions from the mean", "deg", "measured", gt=0.0
        ),
    ] = 5.0
    stride_min_m: Annotated[
        float, meta("Straight walking: shortest stride that has a direction", "m", "ours", gt=0.0)
    ] = 0.5
    sigma_heading: Annotated[
        float,
        meta("Straight walking: noise of a stride's direction", "rad", "measured, 1 to 2 degrees", gt=0.0),
    ] = 0.03
    magnetometer: Annotated[
        bool, meta("Heading from the magnetometer, relative to the start", source="ours")
    ] = False
    sigma_mag_yaw: Annotated[float, meta("Magnetometer: noise of the heading", "rad", "ours", gt=0.0)] = 0.05
    mag_norm_max: Annotated[
        float,
        meta(
            "Magnetometer: greatest relative deviation of the field's norm from the start's",
            "1",
            "ours",
            gt=0.0,
        ),
    ] = 0.1
    mag_dip_max_deg: Annotated[
        float,
        meta("Magnetometer: greatest deviation of the field's dip from the start's", "deg", "ours", gt=0.0),
    ] = 5.0
    barometer: Annotated[bool, meta("Height from the barometer, relative to the start", source="ours")] = (
        False
    )
    sigma_baro: Annotated[float, meta("Barometer: noise of the height", "m", "ours", gt=0.0)] = 0.3
    baro_temperature_k: Annotated[
        float,
        meta(
            "Barometer: air temperature at the start; 1 K off scales heights by 0.35 %",
            "K",
            "ISO 2533",
            gt=0.0,
        ),
    ] = 288.15
    aid_after_s: Annotated[
        float, meta("Stance that must have lasted before an aid measures", "s", "ours", ge=0.0)
    ] = 0.1
    aid_every_s: Annotated[
        float,
        meta("Magnetometer and barometer: time between two measurements in stance", "s", "ours", ge=0.0),
    ] = 1.0
