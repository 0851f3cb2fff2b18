"""Every indoor estimator keeps the contract of estimators."""

from __future__ import annotations

import json
from typing import Any, ClassVar

import numpy as np
import polars as pl
from marcha.algorithms import Context, Stretch
from marcha.algorithms.indoor.calibrate import RadioCalibration

from .contracts.estimator import EstimatorContract, Tables
from .event_loop import context_of
from .test_indoor_estimators import MACS, heard, table, walk

PLAN = {
    "type": "FeatureCollection",
    "x_axis_azimuth_deg": 90.0,
    "features": [
        {
            "type": "Feature",
            "properties": {"kind": kind, "name": name},
            "geometry": {"type": "Polygon", "coordinates": [[[a, 0], [b, 0], [b, 8], [a, 8], [a, 0]]]},
        }
        for kind, name, a, b in (
            ("passable", "all", 0, 25),
            ("zone", "west", 0, 10),
            ("zone", "east", 10, 25),
        )
    ],
}


def survey() -> Any:
    """Return a calibration from thirty places of the floor."""
    rng = np.random.default_rng(5)
    parts, where = [], []
    for k in range(30):
        place = rng.uniform([0, 0], [24, 8])
        parts.append(
            heard(np.tile(place, (60, 1)), 1.0, seed=k).with_columns(pl.col("t_ns") + k * 10_000_000_000)
        )
        where += [(parts[-1]["t_ns"][0], *place, 1.2), (parts[-1]["t_ns"][-1], *place, 1.2)]
    position = pl.DataFrame(where, schema=["t_ns", "pos_x", "pos_y", "pos_z"], orient="row")
    tables = {"radio": (pl.concat(parts),), "position": (position,)}
    return RadioCalibration().calibrate([Stretch({}, tables, {}, table(model=False), "survey")])


def phone(seconds: float = 12.0) -> dict[str, Any]:
    """Return a phone held level that walks to the east: accelerations and attitude at 50 Hz."""
    t = np.arange(0, seconds, 0.02)
    t_ns = (t * 1e9).astype(np.int64)
    up = 9.8 + 2 * np.sin(2 * np.pi * t / 0.5)
    imu = pl.DataFrame({"t_ns": t_ns, "acc_x": 0 * t, "acc_y": 0 * t, "acc_z": up})
    half = -np.pi / 4 + 0 * t
    turn = pl.DataFrame(
        {"t_ns": t_ns, "quat_w": np.cos(half), "quat_x": 0 * t, "quat_y": 0 * t, "quat_z": np.sin(half)}
    )
    return {"imu": {"/phone/acc": imu}, "orientation": {"/phone/orientation": turn}}


class IndoorContract(EstimatorContract):
    """What the indoor estimators are told: anchors, plan, survey."""

    radio: ClassVar[bool] = True
    walks: ClassVar[bool] = False

    def tables(self) -> Tables:
        found: dict[str, Any] = {"radio": {"/phone/radio": heard(walk(240), 3.0)}} if self.radio else {}
        return found | (phone(24.0) if self.walks else {})

    def context(self, estimator: Any) -> Context:
        about = {**table(), "plan.geojson": json.dumps(PLAN).encode()}
        calibrations = {"radio": survey()} if estimator.name in ("indoor.fingerprint", "indoor.fused") else {}
        return context_of(estimator, self.tables(), attachments=about, calibrations=calibrations)


class TestTrilateration(IndoorContract):
    name = "indoor.trilateration"


class TestPdr(IndoorContract):
    name, radio, walks = "indoor.pdr", False, True


class TestHybrid(IndoorContract):
    name, walks = "indoor.hybrid", True


class TestFused(IndoorContract):
    name = "indoor.fused"
    params: ClassVar = {"particles": 60}


class TestFusedWithSteps(IndoorContract):
    name, walks = "indoor.fused", True
    params: ClassVar = {"particles": 60}


class TestSmooth(IndoorContract):
    name = "indoor.smooth"
    params: ClassVar = {"particles": 60}


class TestFingerprintMap(IndoorContract):
    name = "indoor.fingerprint"


class TestFingerprintNeighbours(IndoorContract):
    name = "indoor.fingerprint"
    params: ClassVar = {"method": "knn"}


class TestZones(IndoorContract):
    name = "indoor.zones"

    def tables(self) -> Tables:
        t = np.arange(100) * 100_000_000
        position = pl.DataFrame({"t_ns": t, "pos_x": np.linspace(2, 20, 100), "pos_y": np.full(100, 4.0)})
        sigma = pl.DataFrame({"t_ns": t, "sigma_pos_x": np.full(100, 1.0), "sigma_pos_y": np.full(100, 1.0)})
        return {"position": {"/p": position}, "sigma": {"/s": sigma}}


class TestFloors(IndoorContract):
    name = "indoor.floors"

    def tables(self) -> Tables:
        t = np.arange(400) * 200_000_000
        height = np.interp(t / 1e9, [0, 30, 45, 80], [0, 0, 6.8, 6.8])
        pressure = 101_325 * np.exp(-height / 8434.5) + np.random.default_rng(1).standard_normal(400)
        return {"pressure": {"/phone/pressure": pl.DataFrame({"t_ns": t, "pressure_pa": pressure})}}


def test_the_samples_are_of_known_anchors():
    assert set(heard(walk(12), 1.0)["mac"]) == set(MACS)
