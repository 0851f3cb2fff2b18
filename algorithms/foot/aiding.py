"""Aids beside the zero velocity: height on flat ground, straight walking, magnetometer, barometer.

All are off by default and then change no bit. A filter with position and attitude errors calls :func:`aid`
after its zero-velocity update; every aid is one scalar measurement of an error state, taken by
:func:`.kalman.update`, so cross-covariances carry it to the other states (a heading error shifts the
position, too). A height leaves attitude and gyroscope bias alone (they are considered, after Schmidt): its
error is mostly the accelerometer's, which the filters do not model, and blaming the tilt for it would turn
the heading by degrees. Aids act in stance only, once a foot has stood for ``aid_after_s``; so one stance is
one measurement of height and of heading, not as many as it has samples.

Height update on flat ground ("HUPT"): where a stance is within ``hupt_max_m`` of the height of the one
before, both are on one level, and the height of the level's first stance is measured. Otherwise the foot has
climbed: nothing is measured, and a new level begins. After Abdulrahim, Hide, Moore, Hill 2012, "Using
constraints for shoe mounted indoor pedestrian navigation", Journal of Navigation 65(1); ours: the reference
is the level's first stance, not the one before, whose remaining error would add up.

Straight walking: the last ``straight_strides`` strides were long enough, and the directions of their
displacements lie within ``straight_max_deg`` of their mean. Then the newest direction ψ measures the heading
error, with the standard deviation ``sigma_heading`` / (1 − spread / ``straight_max_deg``): the less straight,
the less it counts.

- ``hdr``: error = ψ − mean direction of the straight so far. After Borenstein and Ojeda 2009, "Heuristic
  reduction of gyro drift for personnel tracking systems", Journal of Navigation 62(1), in the Kalman form of
  Jiménez, Seco, Prieto, Guevara 2010, "Indoor pedestrian navigation using an INS/EKF framework for yaw drift
  reduction and a foot-mounted IMU" (WPNC), where the reference is the mean of the two strides before.
- ``ihde``: error = ψ − the nearest dominant direction of the building, if within ``heading_gate_deg``. After
  Jiménez, Seco, Zampella, Prieto, Guevara 2011, "Improved heuristic drift elimination (iHDE) for pedestrian
  navigation in complex buildings" (IPIN). Ours: where a shoe's sensor points is not known, so the directions
  are laid along the first straight (``heading_grid``), which itself is treated as ``hdr``; and the function
  that gives the confidence.

Magnetometer: direction of the horizontal field in n against that of the first stance; taken where norm and
dip are like there. It needs a calibrated sensor in the axes of the IMU. Barometer: height over the first
stance by the standard atmosphere (ISO 2533), h = T/Λ (1 − (p/p₀)^(RΛ/gM)), Λ = 0.0065 K/m, R = 8.314462618
J/(mol K), M = 0.0289644 kg/mol, g = 9.80665 m/s².
"""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

import msgspec

from ..contract import FloatArray, Input, Remark
from ..numerics import kalman
from ..numerics.compiled import compiled
from ..parameters import meta
from . import common as foot
from . import layout as la
from .layout import (
    POS,
    R_DT,
    R_EXTRA,
    R_STILL,
    ROT,
    STANCE_S,
    STARTED,
    STEP_MIN_M,
)

HEADING_AIDS = ("none", "hdr", "ihde")
NONE, HDR, IHDE = 0, 1, 2
MOST_STRIDES = 8
LAPSE_K_M = 0.0065
BARO_EXPONENT = 8.314462618 * LAPSE_K_M / (9.80665 * 0.0289644)

_take = la.Allocator(la.CORE)

# Configuration
ON = _take()  # any aid is on
AFTER_S = _take()
EVERY_S = _take()
HUPT = _take()
HUPT_MAX = _take()
R_HUPT = _take()
HEADING = _take()  # index into HEADING_AIDS
SECTOR = _take()  # angle between dominant directions
STRAIGHT_STRIDES = _take()
STRAIGHT_MAX = _take()
STRIDE_MIN = _take()
HEADING_GATE = _take()
R_HEADING = _take()
MAG = _take()
MAG_NORM_MAX = _take()
MAG_DIP_MAX = _take()
R_MAG = _take()
BARO = _take()  # offset of the pressure among the extra columns plus 1, 0 off
BARO_SCALE = _take()  # T/Λ
R_BARO = _take()

# Stances
BEGUN = _take()
SETTLED = _take()  # this stance has been looked at
LAST = _take(3)  # position of the newest still sample that belongs to a settled stance
LEVEL = _take()  # height of the level's first stance

# Straight walking
STRIDES = _take()  # usable strides without a break
HEADINGS = _take(MOST_STRIDES)  # directions of the newest ones, a ring
RUN = _take()  # strides of the present straight, 0 none
RUN_MEAN = _take()
GRID = _take()
GRID_KNOWN = _take()

# Magnetometer and barometer: sums since the newest measurement, and the first stance's means
MAG_SUM = _take(3)
MAG_COUNT = _take()
MAG_WAIT = _take()  # s since the newest measurement
MAG_REF = _take(3)
MAG_REF_KNOWN = _take()
BARO_SUM = _take()
BARO_COUNT = _take()
BARO_WAIT = _take()
BARO_REF = _take()
BARO_REF_KNOWN = _take()

# What was done, for remarks
MAG_SEEN = _take()
MAG_USED = _take()
MAG_REFUSED = _take()
BARO_SEEN = _take()
BARO_USED = _take()
HUPT_USED = _take()
HEADING_USED = _take()
LANDINGS = _take()

SIZE = _take.size
"""End of the aids' numbers in the state; a filter's own begin here."""

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


def with_aids(base: type[msgspec.Struct], name: str, module: str) -> type[msgspec.Struct]:
    """Return ``base`` with the fields of :class:`AidingParams` behind its own (a struct has one base)."""
    fields = [(f.name, f.type, f.default) for f in msgspec.structs.fields(AidingParams)]
    return msgspec.defstruct(
        name,
        fields,
        bases=(base,),
        module=module,
        namespace={"__doc__": f"{base.__doc__} With the aids of :class:`.aiding.AidingParams`."},
        frozen=True,
        forbid_unknown_fields=True,
        kw_only=True,
    )


@compiled
def wrap(angle: float) -> float:
    """Return ``angle`` (rad) within ±π."""
    return angle - 2.0 * math.pi * math.floor((angle + math.pi) / (2.0 * math.pi))


@compiled
def pressure_height(pressure: float, reference: float, scale: float) -> float:
    """Return the height (m) over the place where the pressure is ``reference``; ``scale`` = T/Λ in m."""
    return scale * (1.0 - (pressure / reference) ** BARO_EXPONENT)


@compiled
def _collect(s: FloatArray, r: int) -> None:
    """Add the readings that arrived with the sample at ``r``: field (in n once started) and pressure."""
    if s[MAG] > 0.5:
        x, y, z = s[r + R_EXTRA], s[r + R_EXTRA + 1], s[r + R_EXTRA + 2]
        if math.isfinite(x + y + z):
            s[MAG_SEEN] += 1.0
            s[MAG_COUNT] += 1.0
            if s[BEGUN] > 0.5:
                for i in range(3):
                    s[MAG_SUM + i] += s[ROT + 3 * i] * x + s[ROT + 3 * i + 1] * y + s[ROT + 3 * i + 2] * z
            else:
                s[MAG_SUM] += x
                s[MAG_SUM + 1] += y
                s[MAG_SUM + 2] += z
    if s[BARO] > 0.5:
        pressure = s[r + R_EXTRA + int(s[BARO]) - 1]
        if math.isfinite(pressure) and pressure > 0.0:
            s[BARO_SEEN] += 1.0
            s[BARO_COUNT] += 1.0
            s[BARO_SUM] += pressure


@compiled
def _forget_field(s: FloatArray) -> None:
    kalman.clear(s, MAG_SUM, 3)
    s[MAG_COUNT] = 0.0


@compiled
def _forget_pressure(s: FloatArray) -> None:
    s[BARO_SUM] = 0.0
    s[BARO_COUNT] = 0.0


@compiled
def _begin(s: FloatArray) -> None:
    """Turn the field collected in the rest into n; the start is the first stance and the first level."""
    x, y, z = s[MAG_SUM], s[MAG_SUM + 1], s[MAG_SUM + 2]
    for i in range(3):
        s[MAG_SUM + i] = s[ROT + 3 * i] * x + s[ROT + 3 * i + 1] * y + s[ROT + 3 * i + 2] * z
        s[LAST + i] = s[POS + i]
    s[LEVEL] = s[POS + 2]
    s[BEGUN] = 1.0
    s[SETTLED] = 1.0


@compiled
def _lift(s: FloatArray) -> None:
    """End the stance: what the first one with readings saw is what later ones are compared with."""
    s[SETTLED] = 0.0
    if s[MAG_REF_KNOWN] < 0.5 and s[MAG_COUNT] > 0.0:
        for i in range(3):
            s[MAG_REF + i] = s[MAG_SUM + i] / s[MAG_COUNT]
        s[MAG_REF_KNOWN] = 1.0
    if s[BARO_REF_KNOWN] < 0.5 and s[BARO_COUNT] > 0.0:
        # Where nothing arrived in the rest, the first reading stands for the height of its own stance.
        s[BARO_REF] = s[BARO_SUM] / s[BARO_COUNT]
        height = s[LAST + 2] / s[BARO_SCALE]
        s[BARO_REF] /= (1.0 - height) ** (1.0 / BARO_EXPONENT)
        s[BARO_REF_KNOWN] = 1.0
    _forget_field(s)
    _forget_pressure(s)


@compiled
def _flat(s: FloatArray, p: int, n: int, pos: int, dx: int, work: int) -> bool:
    """Height update of a landing."""
    if abs(s[POS + 2] - s[LAST + 2]) >= s[HUPT_MAX]:
        s[LEVEL] = s[POS + 2]
        return False
    kalman.update(s, p, n, dx, work, pos + 2, s[POS + 2] - s[LEVEL], s[R_HUPT], pos)
    s[HUPT_USED] += 1.0
    return True


@compiled
def _end_straight(s: FloatArray) -> None:
    if s[HEADING] == IHDE and s[GRID_KNOWN] < 0.5 and s[RUN] >= s[STRAIGHT_STRIDES]:
        s[GRID] = s[RUN_MEAN]
        s[GRID_KNOWN] = 1.0
    s[RUN] = 0.0


@compiled
def _straight(s: FloatArray, p: int, n: int, att: int, dx: int, work: int) -> bool:
    """Heading from straight walking, at a landing: note the stride's direction, measure if it is straight."""
    x, y = s[POS] - s[LAST], s[POS + 1] - s[LAST + 1]
    if math.sqrt(x * x + y * y) < s[STRIDE_MIN]:
        s[STRIDES] = 0.0
        _end_straight(s)
        return False
    heading = math.atan2(y, x)
    strides = int(s[STRIDES])
    s[HEADINGS + strides % MOST_STRIDES] = heading
    s[STRIDES] = strides + 1.0
    wanted = int(s[STRAIGHT_STRIDES])
    if strides + 1 < wanted:
        return False
    mean = 0.0
    for i in range(wanted):
        mean += wrap(s[HEADINGS + (strides - i) % MOST_STRIDES] - heading)
    mean /= wanted
    spread = 0.0
    for i in range(wanted):
        spread = max(spread, abs(wrap(s[HEADINGS + (strides - i) % MOST_STRIDES] - heading) - mean))
    if s[RUN] == 0.0:
        # The mean of the strides before the newest one.
        s[RUN] = wanted - 1.0
        s[RUN_MEAN] = heading + mean * wanted / (wanted - 1.0)
    deviation = wrap(heading - s[RUN_MEAN])
    if spread >= s[STRAIGHT_MAX] or abs(deviation) >= s[STRAIGHT_MAX]:
        if s[RUN] >= s[STRAIGHT_STRIDES]:
            _end_straight(s)
        s[RUN] = 0.0
        return False
    used = True
    if s[HEADING] == IHDE and s[GRID_KNOWN] > 0.5:
        away = heading - s[GRID]
        deviation = away - s[SECTOR] * math.floor(away / s[SECTOR] + 0.5)
        used = abs(deviation) < s[HEADING_GATE]
    before = s[dx + att + 2]
    if used:
        trust = 1.0 - spread / s[STRAIGHT_MAX]
        kalman.update(s, p, n, dx, work, att + 2, deviation, s[R_HEADING] / (trust * trust), 0)
        s[HEADING_USED] += 1.0
    s[RUN] += 1.0
    corrected = heading - (s[dx + att + 2] - before)
    s[RUN_MEAN] += wrap(corrected - s[RUN_MEAN]) / s[RUN]
    return used


@compiled
def _magnetic(s: FloatArray, p: int, n: int, att: int, dx: int, work: int) -> bool:
    """Heading from the mean field since the last such measurement."""
    x, y, z = s[MAG_SUM] / s[MAG_COUNT], s[MAG_SUM + 1] / s[MAG_COUNT], s[MAG_SUM + 2] / s[MAG_COUNT]
    u, v, w = s[MAG_REF], s[MAG_REF + 1], s[MAG_REF + 2]
    flat, flat_ref = math.sqrt(x * x + y * y), math.sqrt(u * u + v * v)
    norm, norm_ref = math.sqrt(flat * flat + z * z), math.sqrt(flat_ref * flat_ref + w * w)
    _forget_field(s)
    s[MAG_WAIT] = 0.0
    dip = math.atan2(-z, flat) - math.atan2(-w, flat_ref)
    if flat == 0.0 or abs(norm - norm_ref) >= s[MAG_NORM_MAX] * norm_ref or abs(dip) >= s[MAG_DIP_MAX]:
        s[MAG_REFUSED] += 1.0
        return False
    kalman.update(s, p, n, dx, work, att + 2, wrap(math.atan2(y, x) - math.atan2(v, u)), s[R_MAG], 0)
    s[MAG_USED] += 1.0
    return True


@compiled
def _barometric(s: FloatArray, p: int, n: int, pos: int, dx: int, work: int) -> None:
    """Height from the mean pressure since the last such measurement; the level moves along."""
    height = pressure_height(s[BARO_SUM] / s[BARO_COUNT], s[BARO_REF], s[BARO_SCALE])
    _forget_pressure(s)
    s[BARO_WAIT] = 0.0
    before = s[dx + pos + 2]
    kalman.update(s, p, n, dx, work, pos + 2, s[POS + 2] - height, s[R_BARO], pos)
    s[LEVEL] -= s[dx + pos + 2] - before
    s[BARO_USED] += 1.0


@compiled
def aid(s: FloatArray, r: int, p: int, n: int, att: int, pos: int, dx: int, work: int) -> bool:
    """Take what the aids know at the sample at ``r`` into the covariance at ``s[p]`` and the correction at
    ``s[dx]``; return whether there is a correction, which the filter then feeds back.

    Call it for every released sample, after the zero-velocity update has been fed back, where ``s[ON]``.
    ``n`` is the number of error states, ``att`` and ``pos`` the first of attitude and position (in n); what
    comes before ``pos`` (attitude, gyroscope bias) is considered by the heights.
    """
    still = s[r + R_STILL] > 0.5
    if s[STARTED] < 0.5:
        if still:
            _collect(s, r)
        else:
            _forget_field(s)
            _forget_pressure(s)
        return False
    if s[BEGUN] < 0.5:
        _begin(s)
    s[MAG_WAIT] += s[r + R_DT]
    s[BARO_WAIT] += s[r + R_DT]
    if not still:
        _lift(s)
        return False
    _collect(s, r)
    kalman.clear(s, dx, n)
    used = False
    if s[SETTLED] < 0.5 and s[STANCE_S] >= s[AFTER_S]:
        s[SETTLED] = 1.0
        x, y, z = s[POS] - s[LAST], s[POS + 1] - s[LAST + 1], s[POS + 2] - s[LAST + 2]
        # Less than a step is a break in one stance, not a new one.
        if math.sqrt(x * x + y * y + z * z) >= s[STEP_MIN_M]:
            s[LANDINGS] += 1.0
            if s[HUPT] > 0.5 and _flat(s, p, n, pos, dx, work):
                used = True
            if s[HEADING] > NONE and _straight(s, p, n, att, dx, work):
                used = True
    if s[SETTLED] > 0.5:
        if (
            s[MAG_REF_KNOWN] > 0.5
            and s[MAG_COUNT] > 0.0
            and s[MAG_WAIT] >= s[EVERY_S]
            and _magnetic(s, p, n, att, dx, work)
        ):
            used = True
        if s[BARO_REF_KNOWN] > 0.5 and s[BARO_COUNT] > 0.0 and s[BARO_WAIT] >= s[EVERY_S]:
            _barometric(s, p, n, pos, dx, work)
            used = True
        for i in range(3):
            s[LAST + i] = s[POS + i] - s[dx + pos + i]
    return used


def configure(s: FloatArray, p: Any) -> None:
    """Write the aids' constants from the parameters ``p`` into the state ``s``."""
    s[AFTER_S], s[EVERY_S] = p.aid_after_s, p.aid_every_s
    s[HUPT], s[HUPT_MAX], s[R_HUPT] = p.hupt, p.hupt_max_m, p.sigma_hupt**2
    s[HEADING] = HEADING_AIDS.index(p.heading_aid)
    s[SECTOR] = 2.0 * math.pi / p.heading_directions
    s[STRAIGHT_STRIDES], s[STRAIGHT_MAX] = p.straight_strides, math.radians(p.straight_max_deg)
    s[STRIDE_MIN], s[HEADING_GATE] = p.stride_min_m, math.radians(p.heading_gate_deg)
    s[R_HEADING] = p.sigma_heading**2
    s[GRID], s[GRID_KNOWN] = math.radians(p.heading_grid_deg), p.heading_grid == "given"
    s[MAG], s[R_MAG] = p.magnetometer, p.sigma_mag_yaw**2
    s[MAG_NORM_MAX], s[MAG_DIP_MAX] = p.mag_norm_max, math.radians(p.mag_dip_max_deg)
    s[BARO] = (4.0 if p.magnetometer else 1.0) if p.barometer else 0.0
    s[BARO_SCALE], s[R_BARO] = p.baro_temperature_k / LAPSE_K_M, p.sigma_baro**2
    s[ON] = bool(p.hupt or s[HEADING] or p.magnetometer or p.barometer)


class AidedEstimator(foot.FootEstimator):
    """Base of the foot estimators with aids: declares the inputs that the aids need, and says what they did.

    ``Params`` comes from :func:`with_aids`, the filter's own numbers begin at :data:`SIZE`.
    """

    def __init__(self, params: msgspec.Struct | None = None) -> None:
        super().__init__(params)
        p: Any = self.params
        extra: list[Input] = [foot.MAGNETIC_FIELD] if p.magnetometer else []
        if p.barometer:
            extra.append(foot.FLUID_PRESSURE)
        self.inputs = (foot.IMU, *extra)
        configure(self.state, p)

    def remarks(self) -> list[Remark]:
        """Return the common remarks, and every aid that is on but did nothing."""
        s, found = self.state, super().remarks()
        p: Any = self.params
        if s[ON] < 0.5 or s[STARTED] < 0.5:
            return found
        for name, seen, used, kind in (
            ("magnetometer", s[MAG_SEEN], s[MAG_USED], foot.MAGNETIC_FIELD.schema),
            ("barometer", s[BARO_SEEN], s[BARO_USED], foot.FLUID_PRESSURE.schema),
        ):
            if not getattr(p, name) or used:
                continue
            why = f"none of the {int(seen)} readings in stance could be used"
            if seen == 0:
                why = f"no reading of {kind} arrived in stance; name its channel as an input"
            elif name == "magnetometer" and s[MAG_REFUSED]:
                why = (
                    f"{int(s[MAG_REFUSED])} measurements were refused: norm or dip of the field is not the "
                    "start's; calibrate it, or widen mag_norm_max and mag_dip_max_deg"
                )
            found.append(Remark("aid_unused", f"{name} is on but did nothing: {why}"))
        if s[HUPT] > 0.5 and s[HUPT_USED] == 0 and s[LANDINGS] > 0:
            found.append(
                Remark(
                    "aid_unused",
                    f"hupt is on but did nothing: all {int(s[LANDINGS])} steps climb by more than hupt_max_m",
                )
            )
        if s[HEADING] > NONE and s[HEADING_USED] == 0 and s[LANDINGS] > 0:
            found.append(
                Remark(
                    "aid_unused",
                    f"heading_aid is on but did nothing: never {p.straight_strides} strides straight on",
                )
            )
        return found
