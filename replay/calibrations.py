"""Calibrations: made from recordings, kept in files and recordings, applied to channels before estimators see them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import polars as pl

from ..algorithms.calibration import Calibration
from ..algorithms.contract import FloatArray
from ..recording.atomic import AtomicFile
from ..recording.errors import Finding, MarchaError

RECORD = "calibration/"
"""Prefix of the metadata records in which a recording keeps calibrations, each as JSON under the key ``json``."""

CORRECTED: dict[str, tuple[tuple[str, tuple[str, str, str], str, str], ...]] = {
    "imu": (
        ("sensor_msgs/msg/Imu", ("acc_x", "acc_y", "acc_z"), "acc_matrix", "acc_offset_m_s2"),
        ("sensor_msgs/msg/Imu", ("gyr_x", "gyr_y", "gyr_z"), "gyr_matrix", "gyr_offset_rad_s"),
    ),
    "magnetometer": (
        ("sensor_msgs/msg/MagneticField", ("mag_x", "mag_y", "mag_z"), "mag_matrix", "mag_offset_t"),
    ),
}
"""Kinds that the engine applies: message type, columns, names of matrix M and offset b in ``M (x − b)``."""


def calibrations_of(metadata: Mapping[str, Mapping[str, str]]) -> list[Calibration]:
    """Return the calibrations that a recording carries."""
    return [
        _decode(record.get("json", ""), name) for name, record in metadata.items() if name.startswith(RECORD)
    ]


def metadata_of(calibrations: Iterable[Calibration]) -> dict[str, dict[str, str]]:
    """Return the metadata records that keep calibrations in a recording."""
    return {
        f"{RECORD}{c.kind}" + (f":{c.subject}" if c.subject else ""): {
            "json": msgspec.json.encode(c).decode()
        }
        for c in calibrations
    }


def load_calibration(path: Path | str) -> Calibration:
    """Read a calibration file.

    Raises
    ------
    MarchaError
        It is not there or no calibration.
    """
    path = Path(path)
    try:
        return _decode(path.read_text(encoding="utf-8"), str(path))
    except OSError as error:
        raise MarchaError(f"{path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise MarchaError(f"{path}: is no calibration (not UTF-8); `marcha calibrate` writes one") from None


def save_calibration(calibration: Calibration, path: Path | str, overwrite: bool = False) -> None:
    """Write a calibration file (JSON), whole or not at all."""
    with AtomicFile(Path(path), overwrite=overwrite) as file:
        file.write(msgspec.json.format(msgspec.json.encode(calibration), indent=2) + b"\n")


def _decode(text: str, where: str) -> Calibration:
    try:
        return msgspec.json.decode(text, type=Calibration)
    except (msgspec.DecodeError, msgspec.ValidationError) as error:
        raise MarchaError(f"{where}: is no calibration: {error}; `marcha calibrate` writes one") from None


Correction = Callable[[pl.DataFrame], pl.DataFrame]


def corrections(
    calibrations: Sequence[Calibration], channels: Mapping[str, Any]
) -> tuple[dict[str, Correction], list[Finding]]:
    """Return what is done to the tables of raw channels before estimators see them, by topic, and say so.

    A calibration of kind ``imu`` or ``magnetometer`` corrects the channel that its subject names, or, where it
    names none, every channel of its message type.
    """
    steps: dict[str, list[tuple[tuple[str, ...], FloatArray, FloatArray]]] = {}
    findings: list[Finding] = []
    for one in calibrations:
        for schema, columns, matrix, offset in CORRECTED.get(one.kind, ()):
            if offset not in one.values and matrix not in one.values:
                continue
            m = one.array(matrix) if matrix in one.values else np.eye(3)
            b = one.array(offset) if offset in one.values else np.zeros(3)
            for topic, channel in channels.items():
                if channel.schema != schema or not set(columns) <= set(channel.columns):
                    continue
                if one.subject in ("", topic):
                    steps.setdefault(topic, []).append((columns, m, b))
                    detail = f"{topic}: {columns[0][:3]} corrected by calibration {one.kind} before estimators saw it"
                    findings.append(Finding("calibrated", 1, None, detail))
    return {topic: _correction(done) for topic, done in steps.items()}, findings


def _correction(steps: Sequence[tuple[tuple[str, ...], FloatArray, FloatArray]]) -> Correction:
    def correct(table: pl.DataFrame) -> pl.DataFrame:
        for columns, matrix, offset in steps:
            values = table.select(columns).to_numpy() - offset
            # one by one: a matrix product of BLAS may round otherwise for another number of rows
            corrected = [sum(matrix[i, j] * values[:, j] for j in range(3)) for i in range(3)]
            table = table.with_columns(pl.Series(c, v) for c, v in zip(columns, corrected, strict=True))
        return table

    return correct
