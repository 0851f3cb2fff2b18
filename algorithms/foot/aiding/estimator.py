"""Base of the foot estimators with aids."""

from __future__ import annotations

import math
from typing import Any

import msgspec

from ...contract import Input, Remark
from ..estimator import IMU, FootEstimator
from .record import HEADING_AIDS, NO_HEADING
from .stance import LAPSE_K_M

MAGNETIC_FIELD = Input(
    "magnetometer", "sensor_msgs/msg/MagneticField", ("mag_x", "mag_y", "mag_z"), optional=True
)
FLUID_PRESSURE = Input("barometer", "sensor_msgs/msg/FluidPressure", ("pressure_pa",), optional=True)


class AidedEstimator(FootEstimator):
    """Declares the inputs that the aids need, and says what they did.

    ``Params`` has the fields of :class:`.AidingParams`, the state a field ``aids`` (:data:`.record.AIDS`).
    """

    def __init__(self, params: msgspec.Struct | None = None) -> None:
        super().__init__(params)
        p: Any = self.params
        extra: list[Input] = [MAGNETIC_FIELD] if p.magnetometer else []
        if p.barometer:
            extra.append(FLUID_PRESSURE)
        self.inputs = (IMU, *extra)

    def configure(self, record: Any, params: Any) -> None:
        """Write the constants of the aids."""
        p, a = params, record.aids
        a.after_s, a.every_s = p.aid_after_s, p.aid_every_s
        h, straight, m, b = a.height, a.straight, a.magnetometer, a.barometer
        h.on, h.change_max, h.variance = p.hupt, p.hupt_max_m, p.sigma_hupt**2
        straight.kind = HEADING_AIDS.index(p.heading_aid)
        straight.sector = 2.0 * math.pi / p.heading_directions
        straight.wanted, straight.deviation_max = p.straight_strides, math.radians(p.straight_max_deg)
        straight.stride_min, straight.gate = p.stride_min_m, math.radians(p.heading_gate_deg)
        straight.variance = p.sigma_heading**2
        straight.grid, straight.grid_known = math.radians(p.heading_grid_deg), p.heading_grid == "given"
        m.on, m.variance = p.magnetometer, p.sigma_mag_yaw**2
        m.norm_max, m.dip_max = p.mag_norm_max, math.radians(p.mag_dip_max_deg)
        b.on, b.column = p.barometer, 3 if p.magnetometer else 0
        b.scale, b.variance = p.baro_temperature_k / LAPSE_K_M, p.sigma_baro**2
        a.on = bool(p.hupt or straight.kind or p.magnetometer or p.barometer)

    def remarks(self) -> list[Remark]:
        """Return the common remarks, and every aid that is on but did nothing."""
        s, remarks = self.record, super().remarks()
        p: Any = self.params
        aids = s.aids
        m, b = aids.magnetometer, aids.barometer
        if not aids.on or not s.started:
            return remarks
        for name, seen, used, kind in (
            ("magnetometer", m.seen, m.used, MAGNETIC_FIELD.schema),
            ("barometer", b.seen, b.used, FLUID_PRESSURE.schema),
        ):
            if not getattr(p, name) or used:
                continue
            why = f"none of the {seen} readings in stance could be used"
            if seen == 0:
                why = f"no reading of {kind} arrived in stance; name its channel as an input"
            elif name == "magnetometer" and m.refused:
                why = (
                    f"{m.refused} measurements were refused: norm or dip of the field is not the "
                    "start's; calibrate it, or widen mag_norm_max and mag_dip_max_deg"
                )
            remarks.append(Remark("aid_unused", f"{name} is on but did nothing: {why}"))
        if aids.height.on and aids.height.used == 0 and aids.landings > 0:
            remarks.append(
                Remark(
                    "aid_unused",
                    f"hupt is on but did nothing: all {aids.landings} steps climb by more than hupt_max_m",
                )
            )
        if aids.straight.kind > NO_HEADING and aids.straight.used == 0 and aids.landings > 0:
            remarks.append(
                Remark(
                    "aid_unused",
                    f"heading_aid is on but did nothing: never {p.straight_strides} strides straight on",
                )
            )
        return remarks
