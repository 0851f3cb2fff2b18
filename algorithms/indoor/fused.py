"""``indoor.fused``: the best causal position from each power as it comes, steps, walls and a radio map."""

from __future__ import annotations

import math
from typing import Annotated, Any, ClassVar

import msgspec
import numpy as np
import polars as pl

from ..contract import (
    AlgorithmError,
    Annotate,
    Context,
    FloatArray,
    Input,
    KernelEstimator,
    Output,
    Remark,
)
from ..parameters import meta
from .anchors import Anchors, anchors_of, device_of
from .cloud import (
    A_V_ETA,
    ANCHOR_COLUMNS,
    COLUMNS,
    D_ETA,
    D_POWER,
    ERRORS,
    GAIN,
    LOGW,
    PATTERN,
    SETTINGS,
    SHOWN,
    V_ETA,
    Cloud,
    scatter,
)
from .floorplan import STAIRS, raster_of
from .lateration import flatness
from .particles import run
from .pdr import ORIENTATION, plan_frame
from .radio_map import FURTHER_DB, RadioMap, map_of
from .steps import make_state
from .trilateration import POSITION, RANGES, SIGMA

STRANGE_DB = 4.0
"""What receivers differ by (standard deviation)."""
STRANGE_SHARE = 0.3
"""Probability that a calibrated receiver (or tag) is another than it was: battery, case, hand."""
SLAB_SD_DB = 5.0
"""Standard deviation of the loss through slabs, beside the shadowing."""
LIKELY = 0.8
"""Probability from which on an offset, or a turning carrier, is said."""
ON_A_LINE = 0.01
"""Anchors flatter than this are on a line."""


class IndoorFusedParams(msgspec.Struct, frozen=True, kw_only=True):
    """Parameters of the particle filter."""

    particles: Annotated[int, meta("number of particles", "", "", ge=10)] = 1000
    seed: Annotated[int, meta("of the random numbers", "", "", ge=0)] = 1
    use_map: Annotated[bool, meta("expect powers of the radio map where the calibration has one", "")] = True
    fast_db: Annotated[float, meta("fading from power to power", "dB", "Rappaport 2002, table 4.6", gt=0)] = (
        5.0
    )
    slow_db: Annotated[
        float, meta("shadowing that stays over correlation_m", "dB", "Gudmundson 1991", gt=0)
    ] = 3.0
    correlation_m: Annotated[
        float, meta("distance over which shadowing stays", "m", "Gudmundson 1991", gt=0)
    ] = 4.0
    pooled_db: Annotated[
        float,
        meta(
            "doubt of the power at 5 m of anchors without values of their own, where a calibration does not state what "
            "its anchors differ by; learned on the way",
            "dB",
            "Rappaport 2002, table 4.6",
            ge=0,
        ),
    ] = 4.0
    pooled_eta: Annotated[
        float, meta("the same of η; learned on the way", "1", "hybrid indoor positioning, table 5.1", ge=0)
    ] = 0.4
    offset_db: Annotated[
        float,
        meta(
            "doubt of the offset of this receiver (or tag) to the calibrated ones; learned on the way; −1: 4 where "
            "a calibration does not know it, and for three tenths of the particles where it does",
            "dB",
            "Lui et al. 2011",
            ge=-1,
        ),
    ] = -1.0
    pattern_db: Annotated[
        float,
        meta(
            "how much stronger or weaker a receiver (or tag) that turns is on one side, standard deviation along each "
            "axis of the plan",
            "dB",
            "",
            ge=0,
        ),
    ] = 3.0
    turning: Annotated[
        float,
        meta(
            "probability that it turns about itself; the powers decide (0: alike all round, never)",
            "1",
            "",
            ge=0,
            le=1,
        ),
    ] = 0.5
    pattern_s: Annotated[
        float, meta("time over which one that turns as it likes looks the same way", "s", "", gt=0)
    ] = 3.0
    freedom: Annotated[float, meta("degrees of freedom of Student's t", "", "Lange et al. 1989", gt=0)] = 4.0
    range_sd_m: Annotated[float, meta("of ranges that are measured as such", "m", "", gt=0)] = 0.3
    speed: Annotated[
        float, meta("standard deviation of the velocity where steps are not known", "m/s", "", gt=0)
    ] = 0.5
    speed_s: Annotated[float, meta("time after which a velocity is forgotten", "s", "", gt=0)] = 5.0
    step_m: Annotated[float, meta("length of a step", "m", "hybrid indoor positioning", gt=0)] = 0.70
    step_sd: Annotated[float, meta("relative spread of a step's length", "1", "", ge=0)] = 0.1
    scale_sd: Annotated[float, meta("relative doubt of the mean step; learned on the way", "1", "", ge=0)] = (
        0.1
    )
    turn_sd_deg: Annotated[
        float, meta("spread of a step's heading", "deg", "hybrid indoor positioning", ge=0)
    ] = 6.0
    heading_sd_deg: Annotated[
        float,
        meta(
            "doubt of the heading's offset; 180: not known at all; learned on the way",
            "deg",
            "",
            ge=0,
            le=180,
        ),
    ] = 15.0
    x_axis_azimuth_deg: Annotated[
        float, meta("azimuth of the plan's x axis; 0: as the plan states", "deg", "")
    ] = 0.0
    threshold: Annotated[
        float, meta("linear acceleration of a step", "m/s²", "hybrid indoor positioning", gt=0)
    ] = 0.55
    height_m: Annotated[
        float, meta("height of the receiver; 0: of the calibration, else 1.2", "m", "", ge=0)
    ] = 0.0
    storey_m: Annotated[float, meta("height of a storey; 0: as the plan states, else 3.4", "m", "", ge=0)] = (
        0.0
    )
    floor_db: Annotated[
        float,
        meta(
            "loss of the slab between two floors; each further one 4 dB", "dB", "ITU-R P.1238, table 3", ge=0
        ),
    ] = 15.0
    floor_change_s: Annotated[
        float,
        meta("mean time between changes of floor, on the stairs of the plan, or anywhere", "s", "", gt=0),
    ] = 60.0
    margin_m: Annotated[float, meta("how far outside of the anchors one may be", "m", "", ge=0)] = 2.0
    walls: Annotated[bool, meta("walls and passable areas of the plan hold", "")] = True
    known_start: Annotated[bool, meta("start at start_x, start_y; else anywhere", "")] = False
    start_x: Annotated[float, meta("start in the plan", "m", "")] = 0.0
    start_y: Annotated[float, meta("start in the plan", "m", "")] = 0.0
    start_floor: Annotated[int, meta("floor of the known start", "", "")] = 0
    start_sd_m: Annotated[float, meta("doubt of the start", "m", "", gt=0)] = 1.0
    without: Annotated[str, meta("anchors left out, by address or name", "")] = ""


PARTICLES = Output(
    "particles", "marcha_msgs/msg/NamedValues", ("particle_x", "particle_y"), event=True, frame="plan"
)
FLOOR_OUTPUT = Output("floor", "marcha_msgs/msg/NamedValues", ("floor", "probability"))
CHANGE = Output(
    "change",
    "marcha_msgs/msg/NamedValues",
    ("from", "to"),
    event=True,
    annotate=Annotate("floor", "instant", label="floor {to}"),
)
PRESSURE = Input("pressure", "sensor_msgs/msg/FluidPressure", ("pressure_pa",), optional=True, regular=True)


class IndoorFused(KernelEstimator):
    """Rao–Blackwellised particle filter over powers, ranges and steps; see :mod:`.particles`."""

    name: ClassVar[str] = "indoor.fused"
    title: ClassVar[str] = "each signal strength as it comes, steps, walls and radio map: particle filter"
    source: ClassVar[str] = "Doucet et al. 2000 (Rao–Blackwellised particles); Gudmundson 1991 (shadowing)"
    Params: ClassVar[type[msgspec.Struct]] = IndoorFusedParams
    presets: ClassVar = {
        "no-map": {"use_map": False},
        "turning": {"turning": 1.0},
        # Steps between walls alone: nothing but particles keeps the ways round a corner apart.
        "walls": {"particles": 4000, "known_start": True, "start_sd_m": 0.3},
    }
    inputs = (
        Input("radio", "marcha_msgs/msg/RadioSignal", ("mac", "rssi_dbm"), optional=True, many=True),
        RANGES,
        Input("steps", "marcha_msgs/msg/Step", ("length_m", "heading_rad"), optional=True),
        Input("imu", "sensor_msgs/msg/Imu", ("acc_x", "acc_y", "acc_z"), optional=True, regular=True),
        ORIENTATION,
        PRESSURE,
    )
    outputs = (POSITION, SIGMA, PARTICLES, FLOOR_OUTPUT, CHANGE)
    max_results = 1 + SHOWN
    run = staticmethod(run)
    state: Any

    def start(self, context: Context) -> None:
        """Lay out anchors, map and plan, and scatter the particles."""
        super().start(context)
        p = self.params
        self.start_remarks: list[Remark] = []
        heard = context.has("radio") or context.has("ranges")
        stepped = context.has("steps") or (context.has("imu") and context.has("orientation"))
        try:
            anchors = anchors_of(context, without=p.without, need_model=context.has("radio"))
        except AlgorithmError:
            if not (stepped and p.known_start):
                raise
            none = np.zeros(0)
            anchors = Anchors([], [], np.zeros((0, 3)), none, none, none)
            self.start_remarks.append(
                Remark("no_anchors", "no anchor positions: steps and walls from the known start only")
            )
        if not heard and not (stepped and p.known_start):
            raise AlgorithmError(f"{self.name} needs signal strengths or ranges, or steps from a known start")
        self.anchors = anchors
        self.storeys = storeys = anchors.storeys(context, p.storey_m)
        self.start_remarks += storeys.remarks
        raster = raster_of(context, storeys.numbers, anchors.plane) if p.walls else None
        steps = context.channels.get("steps", ())
        north = plan_frame(context, p.x_axis_azimuth_deg)[2]  # without it headings are taken as the plan's
        self.from_east = bool(steps) and steps[0].frame_id != "plan" and north
        calibration = context.calibrations.get("radio")
        strange = calibration is not None and device_of(context.metadata) not in calibration.values.get(
            "offsets_db", {}
        )
        self.strange = strange or p.offset_db > 0
        self.offset_db = p.offset_db if p.offset_db >= 0 else STRANGE_DB if calibration is not None else 0.0
        self.unknown: set[str] = set()
        self.heard: set[int] = set()
        height = p.height_m or (float(calibration.values.get("height_m", 1.2)) if calibration else 1.2)
        radio_map = map_of(context, anchors, height, storeys, p.floor_db) if p.use_map else None
        # a mirror image, or a ring about one anchor, is told apart by these alone
        self.sided = p.known_start or radio_map is not None or raster is not None or (stepped and north)
        self.state = self.cloud(context, anchors, radio_map, raster, height, stepped)

    def cloud(
        self,
        context: Context,
        anchors: Anchors,
        radio_map: RadioMap | None,
        raster: tuple[FloatArray, float, Any] | None,
        height: float,
        stepped: bool,
    ) -> Cloud:
        """Return the state before the first message.

        ``raster``: corner (2,) and cell (m), cells of shape (floors, nx, ny).
        """
        p = self.params
        s = np.zeros(1, SETTINGS)
        if raster is not None:
            low, cell, cells = raster
            high = low + cell * np.array(cells.shape[1:])
        else:
            around = anchors.plane if len(anchors) else np.array([[p.start_x, p.start_y]])
            margin = p.margin_m if len(anchors) else 500.0
            low, high = around.min(axis=0) - margin, around.max(axis=0) + margin
            cell, cells = 0.0, np.ones((1, 1, 1), np.uint8)
        x_axis, mirrored, oriented = plan_frame(context, p.x_axis_azimuth_deg)
        if stepped and not context.has("steps") and not oriented and p.heading_sd_deg < 90:
            self.start_remarks.append(
                Remark(
                    "plan_north", "the plan does not say where north is: its x axis is taken to point north"
                )
            )
        one = s[0]
        values: dict[str, Any] = {
            "t_ns": -1,
            "rng": np.uint64(0x9E3779B97F4A7C15) ^ np.uint64(p.seed * 2654435761 + 1),
            "spare": math.nan,
            "walking": int(stepped),
            "own_steps": int(not context.has("steps")),
            "known_start": int(p.known_start),
            "x_axis": x_axis,
            "mirrored": int(mirrored),
            "low": low,
            "high": high,
            "cell": cell,
            "speed": p.speed,
            "speed_s": p.speed_s,
            "drift": 0.1,
            "fast": p.fast_db,
            "freedom": p.freedom,
            "offset": self.offset_db,
            "offset_share": 1.0 if self.strange else STRANGE_SHARE,
            "pattern": p.pattern_db,
            "pattern_s": p.pattern_s,
            "turning": p.turning if p.pattern_db > 0 else 0.0,
            "range_sd": p.range_sd_m,
            "wall": math.log(1e-4),
            "step_m": p.step_m,
            "step_sd": p.step_sd,
            "turn_sd": math.radians(p.turn_sd_deg),
            "turn_walk": math.radians(1.0),
            "height": height,
            "slab": p.floor_db,
            "further": FURTHER_DB if p.floor_db > 0 else 0.0,
            "slab_sd": SLAB_SD_DB,
            "change_hz": 1.0 / p.floor_change_s,
            "stairs": int((cells == STAIRS).any()),
            "lowest": self.storeys.numbers[0],
            "start_floor": self.start_floor(),
            "floor": -1,
            "pressure_ns": -1,
            "weighed_ns": -1,
        }
        for key, value in values.items():
            one[key] = value
        n, k = p.particles, len(anchors)
        table = np.zeros((k, ANCHOR_COLUMNS))
        table[:, :2], table[:, 2] = anchors.plane, np.nan_to_num(self.storeys.above - height)
        table[:, 3], table[:, 4] = anchors.p_d0, anchors.eta
        table[:, 5], table[:, 6] = p.slow_db, p.correlation_m
        doubt = anchors.doubt(p.pooled_db, p.pooled_eta)
        table[:, 7], table[:, 8], table[:, 9] = doubt[:, 0, 0], doubt[:, 1, 1], doubt[:, 0, 1]
        table[:, 11] = self.storeys.of_anchor
        mean = sd = np.zeros((1, 0, 2, 2))
        if radio_map is not None:
            mean, sd = radio_map.mean, radio_map.sd
            table[:, 10] = radio_map.mapped
            table[radio_map.mapped, 7:10] = 0.0  # the map's own doubt has them
            one["map_low"], one["map_cell"] = radio_map.low, radio_map.cell
        walk = make_state(threshold=p.threshold, least_s=0.15, most_s=0.4, gravity_s=0.08, along_gravity=True)
        cloud = Cloud(
            s,
            walk,
            np.zeros((n, COLUMNS)),
            np.zeros((n, COLUMNS)),
            np.zeros((n, k, ERRORS)),
            np.zeros((n, k, ERRORS)),
            table,
            self.storeys.levels,
            mean,
            sd,
            cells,
        )
        x = p.start_x if p.known_start else math.nan
        offset = math.radians(p.heading_sd_deg)
        scatter(cloud, x, p.start_y, p.start_sd_m, offset, p.scale_sd)
        return cloud

    def start_floor(self) -> int:
        """Return the index of the floor of a known start, −1 where any may be it."""
        p, numbers = self.params, self.storeys.numbers
        if not p.known_start or len(numbers) == 1:
            return -1 if len(numbers) > 1 else 0
        if p.start_floor not in numbers:
            raise AlgorithmError(
                f"start_floor={p.start_floor}: there are floors {numbers[0]} to {numbers[-1]}"
            )
        return numbers.index(p.start_floor)

    def encode(self, index: int, channel: int, table: pl.DataFrame) -> FloatArray:
        """Return messages as numbers; an address becomes the anchor's number, −1 where it is not known.

        Headings of steps that are given from east (anticlockwise) are turned to the plan's x axis.
        """
        if index > 1:
            values = super().encode(index, channel, table)
            if index == 2 and self.from_east:
                one = self.state.s[0]
                turned = values[:, 1] - (0.5 * math.pi - one["x_axis"])
                values[:, 1] = -turned if one["mirrored"] else turned
            return values
        number = self.anchors.number
        macs = table["mac"].to_list()
        out = np.empty((table.height, 2))
        out[:, 0] = [number.get(mac, -1) for mac in macs]
        out[:, 1] = table[self.inputs[index].columns[1]].to_numpy()
        self.unknown.update(mac for mac in set(macs) if mac not in number)
        self.heard.update(np.unique(out[np.isfinite(out[:, 1]), 0]).astype(int).tolist())
        return out

    def snapshot(self) -> Any:
        """Return a copy of the state."""
        return tuple(part.copy() for part in self.state[:6])

    def restore(self, snapshot: Any) -> None:
        """Go back to the state of ``snapshot``."""
        for part, saved in zip(self.state[:6], snapshot, strict=True):
            part[...] = saved

    def remarks(self) -> list[Remark]:
        """Say what a user must know of the run."""
        s = self.state.s[0]
        remarks = [*self.start_remarks, *self.anchors.remarks]
        if s["received"] == 0 and len(self.anchors):
            alone = bool(s["known_start"]) and s["steps"] > 0
            detail = (
                "no power of a known anchor: dead reckoning only"
                if alone
                else ("no power of a known anchor: no position; check anchors.csv")
            )
            remarks.append(Remark("nothing_heard", detail, not alone))
        elif s["received"] == 0 and s["steps"] == 0:
            remarks.append(Remark("nothing_heard", "no step: no position", True))
        if self.unknown and len(self.anchors):
            some = ", ".join(sorted(self.unknown)[:3])
            remarks.append(
                Remark(
                    "unknown_anchor",
                    f"{len(self.unknown)} addresses are in no anchor table: {some}; left out",
                )
            )
        return remarks + self._geometry() + self._learned()

    def _geometry(self) -> list[Remark]:
        """Say that the anchors heard do not tell where one is: too few, or on a line."""
        heard = sorted(self.heard - {-1})
        if not heard or (len(heard) >= 3 and flatness(self.anchors.plane[heard]) >= ON_A_LINE):
            return []
        kind, what = (
            ("too_few_anchors", f"{len(heard)} anchors were heard")
            if len(heard) < 3
            else ("collinear_anchors", f"the {len(heard)} anchors heard are on a line")
        )
        detail = f"{what}: a position and its mirror image fit alike; add an anchor beside them"
        if self.sided:
            detail = f"{what}: only start, steps, walls or a radio map tell the sides apart; look at the stated sigma"
        return [Remark(kind, detail, not self.sided)]

    def _learned(self) -> list[Remark]:
        """Say what P_d0, η and the receiver's offset were learned to be."""
        if self.state.s[0]["received"] == 0:
            return []
        weight = np.exp(self.state.p[:, LOGW])
        weight /= weight.sum()
        remarks: list[Remark] = []
        doubted = np.flatnonzero(self.anchors.borrowed & (self.state.a[:, A_V_ETA] > 0))
        told = [k for k in doubted.tolist() if k in self.heard]
        words: list[str] = []
        for k in told:
            b = self.state.b[:, k]
            power, eta = weight @ b[:, D_POWER], weight @ b[:, D_ETA]
            sd = math.sqrt(weight @ (b[:, V_ETA] + (b[:, D_ETA] - eta) ** 2))
            values = self.anchors.p_d0[k] + power, self.anchors.eta[k] + eta
            words.append(f"{self.anchors.macs[k]} {values[0]:.1f} dBm, η {values[1]:.2f} ± {sd:.2f}")
        if words:
            more = " …" if len(words) > 4 else ""
            remarks.append(Remark("learned_anchors", f"learned on the way: {'; '.join(words[:4])}{more}"))
        gain, turns = self.state.p[:, GAIN], self.state.p[:, PATTERN] > 0
        mean = float(weight @ gain)
        sd = math.sqrt(weight @ (gain - mean) ** 2)
        differs = float(weight @ (gain != 0.0)) > LIKELY and abs(mean) > 2.0 * sd
        if self.offset_db > 0 and (self.strange or differs):
            remarks.append(
                Remark(
                    "learned_offset", f"this receiver hears {mean:+.1f} ± {sd:.1f} dB against the calibrated"
                )
            )
        if 0 < self.params.turning < 1 and (share := float(weight @ turns)) > LIKELY:
            detail = (
                f"receiver (or tag) turns about itself with a probability of {100 * share:.0f} % at the end"
            )
            remarks.append(Remark("turning_carrier", detail))
        return remarks
