"""The built-in importers keep the contract."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

from marcha.ingest.formats.mpu6050_packets import Mpu6050Packets
from marcha.ingest.formats.mpu6050_serial import Mpu6050Serial
from marcha.ingest.formats.table import Table
from marcha.ingest.simulate import simulate

from .contracts.importer import ImporterContract


class TestMpu6050Serial(ImporterContract):
    importer = Mpu6050Serial()

    def sample(self, folder: Path) -> Path:
        return simulate("straight", folder, seed=3, overwrite=True).paths[0]


class TestMpu6050Packets(ImporterContract):
    importer = Mpu6050Packets()

    def sample(self, folder: Path) -> Path:
        return simulate("straight", folder, seed=3, format="packets", overwrite=True).paths[0]


class TestTable(ImporterContract):
    importer = Table()
    sniffs: ClassVar[bool] = False

    def sample(self, folder: Path) -> Path:
        text = simulate("straight", folder, seed=3, overwrite=True).paths[0].read_text().split()
        path = folder / "walk.csv"
        path.write_text(
            "\n".join(["t,ax,ay,az,gx,gy,gz", *(",".join(r.split(",")[:7]) for r in text)]) + "\n"
        )
        return path

    def settings(self, folder: Path) -> dict[str, str]:
        mapping = folder / "map.toml"
        mapping.write_text(
            """
[time]
column = "t"
unit = "ms"
[[topic]]
name = "/foot/imu1"
schema = "sensor_msgs/msg/Imu"
[topic.columns]
acc_x = { column = "ax", unit = "g", scale = 4.8828125e-4 }
acc_y = { column = "ay", unit = "g", scale = 4.8828125e-4 }
acc_z = { column = "az", unit = "g", scale = 4.8828125e-4 }
gyr_x = { column = "gx", unit = "deg/s", scale = 0.06097560975609756 }
gyr_y = { column = "gy", unit = "deg/s", scale = 0.06097560975609756 }
gyr_z = { column = "gz", unit = "deg/s", scale = 0.06097560975609756 }
"""
        )
        return {"mapping": str(mapping)}
