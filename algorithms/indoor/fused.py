"""``indoor.fused``: the best causal position from each power as it comes, steps, walls and a radio map."""

from __future__ import annotations

import math
from typing import Annotated, Any, ClassVar

import msgspec
import numpy as np
import polars as pl

from ..contract import AlgorithmError, Context, FloatArray, Input, KernelEstimator, Remark
from ..parameters import meta
from .anchors import Anchors, anchors_of
from .floorplan import raster_of
from .particles import COLUMNS, SETTINGS, Cloud, run, scatter
from .pdr import ORIENTATION, plan_frame
from .radio_map import RadioMap, map_of
from .steps import make_state
from .trilateration import POSITION, RANGES, SIGMA


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
    pooled_db: Annotated[float, meta("further slow error of anchors without calibration", "dB", "", ge=0)] = (
        4.0
    )
    offset_db: Annotated[
        float, meta("offset of this receiver against the calibrated one; learned on the way", "dB", "", ge=0)
    ] = 0.0
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
    margin_m: Annotated[float, meta("how far outside of the anchors one may be", "m", "", ge=0)] = 2.0
    walls: Annotated[bool, meta("walls and passable areas of the plan hold", "")] = True
    known_start: Annotated[bool, meta("start at start_x, start_y; else anywhere", "")] = False
    start_x: Annotated[float, meta("start in the plan", "m", "")] = 0.0
    start_y: Annotated[float, meta("start in the plan", "m", "")] = 0.0
    start_sd_m: Annotated[float, meta("doubt of the start", "m", "", gt=0)] = 1.0
    without: Annotated[str, meta("anchors left out, by address or name", "")] = ""


class IndoorFused(KernelEstimator):
    """Rao–Blackwellised particle filter over powers, ranges and steps; see :mod:`.particles`."""

    name: ClassVar[str] = "indoor.fused"
    title: ClassVar[str] = "each signal strength as it comes, steps, walls and radio map: particle filter"
    source: ClassVar[str] = "Doucet et al. 2000 (Rao–Blackwellised particles); Gudmundson 1991 (shadowing)"
    Params: ClassVar[type[msgspec.Struct]] = IndoorFusedParams
    presets: ClassVar = {
        "no-map": {"use_map": False},
        # Steps between walls alone: nothing but particles keeps the ways round a corner apart.
        "walls": {"particles": 4000, "known_start": True, "start_sd_m": 0.3},
    }
    inputs = (
        Input("radio", "marcha_msgs/msg/RadioSignal", ("mac", "rssi_dbm"), optional=True, many=True),
        RANGES,
        Input("steps", "marcha_msgs/msg/Step", ("length_m", "heading_rad"), optional=True),
        Input("imu", "sensor_msgs/msg/Imu", ("acc_x", "acc_y", "acc_z"), optional=True, regular=True),
        ORIENTATION,
    )
    outputs = (POSITION, SIGMA)
    run = staticmethod(run)
    state: Any

    def start(self, context: Context) -> None:
        """Lay out anchors, map and plan, and scatter the particles."""
        super().start(context)
        p = self.params
        self.start_remarks: list[Remark] = []
        heard = context.has("radio") or context.has("ranges")
        stepped = context.has("steps") or (context.has("imu") and context.has("orientation"))
        raster = raster_of(context) if p.walls else None
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
        steps = context.channels.get("steps", ())
        north = plan_frame(context, p.x_axis_azimuth_deg)[2]  # without it headings are taken as the plan's
        self.from_east = bool(steps) and steps[0].frame_id != "plan" and north
        calibration = context.calibrations.get("radio")
        height = p.height_m or (float(calibration.values.get("height_m", 1.2)) if calibration else 1.2)
        radio_map = map_of(context, anchors, height) if p.use_map else None
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
        """Return the state before the first message; ``raster``: corner (2,) and cell (m), cells of shape (nx, ny)."""
        p = self.params
        s = np.zeros(1, SETTINGS)
        if raster is not None:
            low, cell, cells = raster
            high = low + cell * np.array(cells.shape)
        else:
            around = anchors.plane if len(anchors) else np.array([[p.start_x, p.start_y]])
            margin = p.margin_m if len(anchors) else 500.0
            low, high = around.min(axis=0) - margin, around.max(axis=0) + margin
            cell, cells = 0.0, np.ones((1, 1), np.uint8)
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
            "range_sd": p.range_sd_m,
            "wall": math.log(1e-4),
            "step_m": p.step_m,
            "step_sd": p.step_sd,
            "turn_sd": math.radians(p.turn_sd_deg),
            "turn_walk": math.radians(1.0),
            "height": height,
        }
        for key, value in values.items():
            one[key] = value
        n, k = p.particles, len(anchors)
        table = np.zeros((k, 7))
        table[:, :2], table[:, 2] = anchors.plane, anchors.above(height)
        table[:, 3], table[:, 4] = anchors.p_d0, anchors.eta
        table[:, 5] = np.where(anchors.borrowed, math.hypot(p.slow_db, p.pooled_db), p.slow_db)
        table[:, 6] = np.where(anchors.borrowed, 3 * p.correlation_m, p.correlation_m)
        mean = sd = np.zeros((0, 2, 2))
        if radio_map is not None:
            mean, sd = radio_map.mean, radio_map.sd
            one["map_low"], one["map_cell"] = radio_map.low, radio_map.cell
        walk = make_state(threshold=p.threshold, least_s=0.15, most_s=0.4, gravity_s=0.08, along_gravity=True)
        cloud = Cloud(
            s,
            walk,
            np.zeros((n, COLUMNS)),
            np.zeros((n, COLUMNS)),
            np.zeros((n, k, 3)),
            np.zeros((n, k, 3)),
            table,
            mean,
            sd,
            cells,
        )
        x = p.start_x if p.known_start else math.nan
        offset = math.radians(p.heading_sd_deg)
        scatter(cloud, x, p.start_y, p.start_sd_m, offset, p.scale_sd, p.offset_db)
        return cloud

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
        out = np.empty((table.height, 2))
        out[:, 0] = [number.get(mac, -1) for mac in table["mac"].to_list()]
        out[:, 1] = table[self.inputs[index].columns[1]].to_numpy()
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
        if s["received"] == 0 and s["steps"] == 0:
            remarks.append(
                Remark(
                    "nothing_heard",
                    "no power of a known anchor and no step: no position; check anchors.csv",
                    True,
                )
            )
        return remarks
