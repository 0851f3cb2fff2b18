"""What the two MPU-6050 importers share: full scales, units, topics."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import msgspec

from ...recording.errors import UsageError
from ..checks import STANDARD_GRAVITY
from ..contract import ChannelSpec, CommonOptions

AXES = ("acc_x", "acc_y", "acc_z", "gyr_x", "gyr_y", "gyr_z")
IMU = "sensor_msgs/msg/Imu"

#: Full-scale code to (± g, counts per g) and (± °/s, counts per °/s): register map RM-MPU-6000A, 4.4 and 4.5.
ACC_SCALES = {0: (2, 16384.0), 1: (4, 8192.0), 2: (8, 4096.0), 3: (16, 2048.0)}
GYR_SCALES = {0: (250, 131.0), 1: (500, 65.5), 2: (1000, 32.8), 3: (2000, 16.4)}

_NAME = re.compile(r"conf[-_ ]?([0-3]{4})(?![0-9])", re.IGNORECASE)

AccRange = Annotated[
    Literal[2, 4, 8, 16] | None, msgspec.Meta(description="full scale of the accelerometer, ± g")
]
GyrRange = Annotated[
    Literal[250, 500, 1000, 2000] | None, msgspec.Meta(description="full scale of the gyroscope, ± °/s")
]


class Mpu6050Options(CommonOptions, frozen=True, kw_only=True):
    """Full scales: ``conf`` or the single fields, else the file's name (``conf-A1G1A2G2…``).

    Attributes
    ----------
    conf : str, optional
        Four digits 0–3: full-scale codes of accelerometer 1, gyroscope 1, accelerometer 2, gyroscope 2.
    accel1_g, accel2_g : int, optional
        Full scale in g: 2, 4, 8 or 16.
    gyro1_dps, gyro2_dps : int, optional
        Full scale in °/s: 250, 500, 1000 or 2000.
    mounting : str
        Where the box sits; goes into the recording as it is.
    """

    conf: Annotated[
        Annotated[str, msgspec.Meta(pattern="^[0-3]{4}$")] | None,
        msgspec.Meta(description="full-scale codes A1G1A2G2, four digits 0–3"),
    ] = None
    accel1_g: AccRange = None
    gyro1_dps: GyrRange = None
    accel2_g: AccRange = None
    gyro2_dps: GyrRange = None
    mounting: Annotated[str, msgspec.Meta(description="where the box sits, as text")] = "shoe"


class Scale(msgspec.Struct, frozen=True):
    """Full scales of one sensor.

    Attributes
    ----------
    acc_g, gyr_dps : int
        Full scale, ± g and ± °/s.
    acc, gyr : float
        m/s² and rad/s of one count.
    source : str
        Where this is known from.
    """

    acc_g: int
    gyr_dps: int
    acc: float
    gyr: float
    source: str

    def metadata(self, tick_ms: int = 1) -> dict[str, str]:
        """Return the channel's device configuration."""
        return {
            "device": "MPU-6050",
            "full_scale_acc_g": str(self.acc_g),
            "full_scale_gyr_deg_s": str(self.gyr_dps),
            "resolution_acc_m_s2": repr(self.acc),
            "resolution_gyr_rad_s": repr(self.gyr),
            "full_scale_from": self.source,
            "time_resolution_ms": str(tick_ms),
            "nominal_rate_hz": "100",
        }

    def limits(self) -> dict[str, tuple[float, float, str]]:
        """Return each axis' limits in counts, for :class:`~marcha.ingest.checks.SensorCheck`."""
        return {
            c: (-32768.0, 32767.0, f"{self.acc_g} g" if c.startswith("acc") else f"{self.gyr_dps} °/s")
            for c in AXES
        }


def scales(
    paths: Sequence[Path], options: Mpu6050Options, sensors: Sequence[int] = (1, 2)
) -> dict[int, Scale]:
    """Return the full scales of ``sensors``; options go before the file's name.

    Raises
    ------
    UsageError
        Where neither says it: a wrong scale would distort every result silently.
    """
    names = {m[1] for p in paths if (m := _NAME.search(p.name))}
    if len(names) > 1:
        raise UsageError(
            f"{paths[0]}: the files' names give different full scales ({', '.join(sorted(names))})"
        )
    name = next(iter(names), None)
    result = {}
    for sensor in sensors:
        k = (sensor - 1) % 2
        fields = (f"accel{k + 1}_g", f"gyro{k + 1}_dps")
        values, sources = [], set()
        for j, (field, table) in enumerate(zip(fields, (ACC_SCALES, GYR_SCALES), strict=True)):
            chosen = getattr(options, field)
            code = options.conf or name
            if chosen is not None:
                values.append(next(row for row in table.values() if row[0] == chosen))
                sources.add(f"option {field}")
            elif code is not None:
                values.append(table[int(code[2 * k + j])])
                sources.add("option conf" if options.conf else "file name")
            else:
                raise UsageError(
                    f"{paths[0]}: the full scale of sensor {sensor} is unknown: name the file conf-A1G1A2G2… "
                    f"or give --set conf=A1G1A2G2 (codes 0–3) or --set {fields[0]}=… --set {fields[1]}=…"
                )
        (acc_g, per_g), (dps, per_dps) = values
        result[sensor] = Scale(
            acc_g, dps, STANDARD_GRAVITY / per_g, math.radians(1.0) / per_dps, ", ".join(sorted(sources))
        )
    return result


def channel(sensor: int, scale: Scale) -> ChannelSpec:
    """Return the channel of one sensor: ``/foot/imu<n>``, in the sensor's own axes."""
    return ChannelSpec(f"/foot/imu{sensor}", IMU, f"imu{sensor}", AXES, scale.metadata())
