"""Parameters that all foot estimators share, and how parts add theirs."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import msgspec

from ..parameters import meta
from .detectors import DETECTORS
from .detectors.contract import DISSERTATION


class FootParams(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Detector, rest at the start, mechanization and steps: what every foot estimator needs.

    The thresholds of the detectors are added by :func:`with_parts`.
    """

    rate_hz: Annotated[
        float,
        meta(
            "Sample rate that turns windows in seconds into samples; 0: the engine fills in the measured "
            "rate, make() alone takes 100 (the source's device) and remarks when the data disagree",
            "Hz",
            ge=0.0,
            le=100_000.0,
        ),
    ] = 0.0
    detector: Annotated[
        Literal["gait", "c1c2c3", "pitch", "shoe", "are", "mv", "mag"],
        meta(
            "Which detector decides that the foot is still",
            source=f"gait: ours; c1c2c3, pitch: {DISSERTATION}; others: Skog et al. 2010",
        ),
    ] = "gait"
    window_s: Annotated[
        float,
        meta(
            "Length of the statistic's window; 0: the detector's own (c1c2c3 0.1, pitch 0.2, gait 0.075, others 0.05)",
            "s",
            f"{DISSERTATION}: n = 5…10 and 20 samples at 100 Hz; Skog et al. 2010: 5 samples",
            ge=0.0,
            le=10.0,
        ),
    ] = 0.0
    window_side: Annotated[
        Literal["centred", "trailing"],
        meta("Window and median around the sample (adds latency) or behind it (none)", source=DISSERTATION),
    ] = "centred"
    cleaning: Annotated[
        Literal["own", "median", "fill-burst", "none"],
        meta(
            "Cleaning of the raw decisions: majority, or fill short gaps and then drop short bursts; own: the "
            "detector's (gait none, others median)",
            source=DISSERTATION,
        ),
    ] = "own"
    cleaning_s: Annotated[
        float,
        meta("Length of the cleaning window", "s", f"{DISSERTATION}: 10 samples at 100 Hz", gt=0.0, le=10.0),
    ] = 0.1
    init: Annotated[
        Literal["adaptive", "fixed"],
        meta(
            "Rest at the start: as long as there is one, between init_min_s and init_s, or exactly init_s",
            source="fixed: dissertation, section 3.6; adaptive: ours",
        ),
    ] = "adaptive"
    init_min_s: Annotated[
        float, meta("adaptive: shortest rest from which it starts", "s", "ours", gt=0.0, le=600.0)
    ] = 0.1
    init_s: Annotated[
        float,
        meta(
            "Length of the rest from which it starts; adaptive: the longest that is waited for",
            "s",
            "dissertation, section 3.6: 200 samples",
            gt=0.0,
            le=600.0,
        ),
    ] = 2.0
    rest_acc: Annotated[
        float,
        meta("Rest at the start: greatest distance of f from its mean", "m/s²", "ours, measured", gt=0.0),
    ] = 0.5
    rest_gyr: Annotated[
        float,
        meta("Rest at the start: greatest distance of ω from its mean", "rad/s", "ours, measured", gt=0.0),
    ] = 0.15
    rest_bias_max: Annotated[
        float,
        meta(
            "Rest at the start: greatest mean ‖ω‖ that may be a bias",
            "rad/s",
            "MPU-6050: ±20 °/s an axis",
            gt=0.0,
        ),
    ] = 0.6
    rest_bias: Annotated[
        bool,
        meta(
            "Take the gyroscope's bias from the rest; false leaves it in, as a program without that step does",
            source="dissertation, section 3.6",
        ),
    ] = True
    rest_bias_sigma: Annotated[
        float,
        meta(
            "adaptive: standard deviation of an axis' bias before the rest is seen; a restless rest counts the "
            "less; 0: nothing is known",
            "rad/s",
            "1 °/s: industrial MEMS",
            ge=0.0,
        ),
    ] = 0.0175
    unclip: Annotated[
        bool,
        meta(
            "Put back what a gyroscope at its ceiling cut off a turn, from the slopes on both sides, as far as the "
            "detector's look-ahead reaches",
            source="ours: cubic Hermite interpolation",
        ),
    ] = True
    gravity: Annotated[float, meta("Local gravity", "m/s²", "dissertation", gt=0.0, le=30.0)] = 9.81
    gravity_from_rest: Annotated[
        bool,
        meta(
            "Take the mean ‖f‖ of the rest for gravity: absorbs a scale error of the accelerometer",
            source="ours",
        ),
    ] = False
    integration: Annotated[
        Literal["trapezoid", "euler"],
        meta(
            "Rule for velocity and position", source="trapezoid: the authors' program; euler: eqs 3.19–3.27"
        ),
    ] = "trapezoid"
    step_min_s: Annotated[float, meta("Shortest swing that is a step", "s", "ours", ge=0.0)] = 0.15
    step_min_m: Annotated[float, meta("Shortest displacement that is a step", "m", "ours", ge=0.0)] = 0.1


def with_parts(base: type[msgspec.Struct], name: str, module: str, *parts: type[msgspec.Struct]) -> Any:
    """Return ``base`` with the fields of all detectors and of ``parts`` behind its own.

    A struct has one base, and each part states its own parameters.
    """
    every = (*(d.Params for d in DETECTORS), *parts)
    fields: list[Any] = [(f.name, f.type, f.default) for p in every for f in msgspec.structs.fields(p)]
    return msgspec.defstruct(
        name,
        fields,
        bases=(base,),
        module=module,
        namespace={"__doc__": base.__doc__},
        frozen=True,
        forbid_unknown_fields=True,
        kw_only=True,
    )
