"""Calibrations: simulated truth, verdicts, files, and what replay does with them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import marcha.recording as mr
import marcha.replay as rp
import numpy as np
import polars as pl
import pytest
from marcha.algorithms import Calibration, Calibrator, PlainEstimator, Stretch
from marcha.algorithms.sensors.imu import still_spans
from marcha.algorithms.sensors.magnetometer import fit_sphere
from marcha.recording import MarchaError, UsageError
from scipy.spatial.transform import Rotation

from .cli_helpers import marcha

ACC, GYR, MAG = (tuple(f"{s}_{a}" for a in "xyz") for s in ("acc", "gyr", "mag"))
G = 9.80665
RATE = 100
TRUE_ACC = np.array([[1.02, 0.01, -0.015], [0.0, 0.985, 0.02], [0.0, 0.0, 1.01]])
ACC_OFFSET = np.array([0.12, -0.2, 0.08])
TRUE_GYR = np.array([[0.99, 0.012, 0.0], [-0.008, 1.015, 0.004], [0.0, 0.01, 0.98]])
GYR_OFFSET = np.array([0.012, -0.02, 0.006])


def positions(seed: int, count: int = 14) -> pl.DataFrame:
    """Still positions of 2 s with turns of 1 s between them, measured by a sensor with known faults."""
    rng = np.random.default_rng(seed)
    attitude = Rotation.identity()
    poses, rates = [], []
    for _ in range(count):
        poses += [attitude] * (2 * RATE)
        rates += [np.zeros(3)] * (2 * RATE)
        turn = rng.normal(size=3)
        turn *= rng.uniform(1.2, 2.2) / np.linalg.norm(turn)
        for _ in range(RATE):
            attitude = attitude * Rotation.from_rotvec(turn / RATE)
            poses.append(attitude)
            rates.append(turn)
    force = Rotation.concatenate(poses).inv().apply([0.0, 0.0, G])
    acc = force @ np.linalg.inv(TRUE_ACC).T + ACC_OFFSET + 0.01 * rng.standard_normal(force.shape)
    rate = np.array(rates)
    gyr = rate @ np.linalg.inv(TRUE_GYR).T + GYR_OFFSET + 0.001 * rng.standard_normal(rate.shape)
    t_ns = 10**9 + np.arange(len(acc)) * (10**9 // RATE)
    return pl.DataFrame(
        {"t_ns": t_ns, **dict(zip(ACC, acc.T, strict=True)), **dict(zip(GYR, gyr.T, strict=True))}
    )


def recorded(path: Path, **tables: tuple[str, pl.DataFrame]) -> mr.Recording:
    with mr.create(path) as out:
        for topic, (schema, table) in tables.items():
            out.add_table("/" + topic.replace("__", "/"), schema, table, frame_id="body")
    return mr.open(path)


@pytest.fixture(scope="module")
def imu(tmp_path_factory: pytest.TempPathFactory) -> mr.Recording:
    path = tmp_path_factory.mktemp("imu") / "positions.mcap"
    return recorded(path, hand__imu=("sensor_msgs/msg/Imu", positions(3, 24)))


def test_positions_and_turns_give_the_sensors_faults(imu: mr.Recording) -> None:
    (found,) = rp.calibrate("imu", [imu])
    assert found.subject == "/hand/imu"
    np.testing.assert_allclose(found.array("acc_offset_m_s2"), ACC_OFFSET, atol=0.005)
    np.testing.assert_allclose(found.array("acc_matrix"), TRUE_ACC, atol=0.002)
    np.testing.assert_allclose(found.array("gyr_offset_rad_s"), GYR_OFFSET, atol=2e-4)
    np.testing.assert_allclose(found.array("gyr_matrix"), TRUE_GYR, atol=0.004)


def test_the_stated_covariance_holds() -> None:
    errors = []
    for seed in range(12):
        table = positions(seed, 12).with_columns(pl.col("t_ns").alias("t_log_ns"))
        found = stretch_calibration(table)
        spread = np.array(found.covariance["acc_offset_m_s2"])
        error = found.array("acc_offset_m_s2") - ACC_OFFSET
        errors.append(error @ np.linalg.solve(spread, error))
    assert 0.3 < np.mean(errors) / 3 < 3.0


def stretch_calibration(table: pl.DataFrame) -> Calibration:
    from marcha.algorithms import ChannelInfo
    from marcha.algorithms.sensors.imu import ImuCalibration

    channel = ChannelInfo("/hand/imu", "sensor_msgs/msg/Imu", "body", (*ACC, *GYR), RATE)
    return ImuCalibration().calibrate([Stretch({"imu": (channel,)}, {"imu": (table,)})])


def test_few_positions_leave_the_accelerometer_alone_and_say_so() -> None:
    found = stretch_calibration(positions(1, 3))
    assert "acc_matrix" not in found.values
    assert "do not determine" in found.remarks[0]
    np.testing.assert_allclose(found.array("gyr_offset_rad_s"), GYR_OFFSET, atol=5e-4)


def test_a_sensor_that_is_never_still_is_refused(tmp_path: Path) -> None:
    n, rng = 500, np.random.default_rng(0)
    moving = pl.DataFrame({"t_ns": np.arange(n) * 10**7, **{c: rng.normal(size=n) * 3 for c in (*ACC, *GYR)}})
    rec = recorded(tmp_path / "x.mcap", hand__imu=("sensor_msgs/msg/Imu", moving))
    with pytest.raises(UsageError, match="never still"):
        rp.calibrate("imu", [rec])


def test_still_spans_are_those_that_were_made() -> None:
    table = positions(5, 4)
    t = table["t_ns"].to_numpy() / 1e9
    spans = still_spans(t, table.select(ACC).to_numpy(), table.select(GYR).to_numpy(), 1.0, 0.15, 0.02)
    assert len(spans) == 4
    for k, (a, b) in enumerate(spans):
        assert 300 * k <= a < b <= 300 * k + 200


# -- magnetometer --------------------------------------------------------------------------------------------

HARD = np.array([20e-6, -35e-6, 12e-6])
SOFT = np.array([[1.1, 0.05, 0.0], [0.05, 0.92, 0.03], [0.0, 0.03, 1.0]])


def field(directions: np.ndarray, seed: int = 0) -> pl.DataFrame:
    rng = np.random.default_rng(seed)
    true = 45e-6 * directions
    seen = true @ np.linalg.inv(SOFT).T + HARD + 0.2e-6 * rng.standard_normal(true.shape)
    return pl.DataFrame({"t_ns": 10**9 + np.arange(len(seen)) * 10**7, **dict(zip(MAG, seen.T, strict=True))})


def all_round(n: int = 600, seed: int = 1) -> np.ndarray:
    d = np.random.default_rng(seed).normal(size=(n, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def test_hard_and_soft_iron(tmp_path: Path) -> None:
    rec = recorded(tmp_path / "m.mcap", hand__mag=("sensor_msgs/msg/MagneticField", field(all_round())))
    (found,) = rp.calibrate("magnetometer", [rec], {"field_t": 45e-6})
    np.testing.assert_allclose(found.array("mag_offset_t"), HARD, atol=0.1e-6)
    norm = SOFT / np.cbrt(np.linalg.det(SOFT))
    ours = found.array("mag_matrix")
    np.testing.assert_allclose(ours / np.cbrt(np.linalg.det(ours)), norm, atol=0.005)
    assert found.usable


def test_disturbed_readings_do_not_bend_the_sphere() -> None:
    table = field(all_round()).select(MAG).to_numpy()
    bent = table.copy()
    bent[::10] += 30e-6
    centre, _, _, _ = fit_sphere(bent / 1e-6, True)
    assert np.linalg.norm(centre * 1e-6 - HARD) < 2e-6


def test_a_turn_about_one_axis_is_not_enough(tmp_path: Path) -> None:
    angle = np.linspace(0, 4 * np.pi, 500)
    flat = np.column_stack((np.cos(angle), np.sin(angle), np.full(500, 0.05)))
    rec = recorded(tmp_path / "m.mcap", hand__mag=("sensor_msgs/msg/MagneticField", field(flat)))
    (found,) = rp.calibrate("magnetometer", [rec])
    assert not found.usable
    assert "not observable" in found.remarks[0]


# -- what becomes of them ------------------------------------------------------------------------------------


class Norm(PlainEstimator):
    """The norm of the specific force, and what it was told."""

    name = "norm"

    def __init__(self, params: Any = None) -> None:
        from marcha.algorithms import Input, Output

        super().__init__(params)
        self.inputs = (Input("imu", "sensor_msgs/msg/Imu", ACC, regular=True),)
        self.outputs = (Output("norm", "marcha_msgs/msg/NamedValues", ("norm",)),)

    def start(self, context: Any) -> None:
        self.told = sorted(context.calibrations)

    def take(self, message: Any) -> list[Any]:
        from marcha.algorithms import Result

        return [Result("norm", message.t_ns, (float(np.linalg.norm(message.values)),))]


def test_replay_corrects_what_estimators_see_and_says_so(imu: mr.Recording, tmp_path: Path) -> None:
    found = rp.calibrate("imu", [imu])
    out = tmp_path / "done.mcap"
    result = rp.replay(imu, [Norm()], calibrations=found, out=out)
    still = np.arange(result.runs[0].samples) % 300 < 190
    assert np.abs(result.runs[0].tables["norm"]["norm"].to_numpy()[still] - G).mean() < 0.02
    plain = rp.replay(imu, [Norm()]).runs[0].tables["norm"]["norm"].to_numpy()
    assert np.abs(plain[still] - G).mean() > 0.1
    assert "calibrated" in {f.kind for f in result.runs[0].findings}
    done = mr.open(out)
    assert done.table("/hand/imu").equals(imu.table("/hand/imu"))  # what was measured stays as it was
    kept = json.loads(done.metadata["run/norm_hand_imu"]["calibration.imu"])
    assert kept["values"] == found[0].values


def test_a_calibration_of_the_recording_itself_is_used(imu: mr.Recording, tmp_path: Path) -> None:
    from marcha.replay.calibrations import metadata_of

    found = rp.calibrate("imu", [imu])
    path = tmp_path / "with.mcap"
    with mr.create(path) as out:
        out.copy_from(imu)
        for name, record in metadata_of(found).items():
            out.add_metadata(name, record)
    result = rp.replay(mr.open(path), [Norm()])
    assert "calibrated" in {f.kind for f in result.runs[0].findings}


def test_only_runs_that_read_the_channel_say_so(imu: mr.Recording, tmp_path: Path) -> None:
    other = imu.table("/hand/imu")
    rec = recorded(
        tmp_path / "two.mcap",
        hand__imu=("sensor_msgs/msg/Imu", other),
        foot__imu=("sensor_msgs/msg/Imu", other),
    )
    result = rp.replay(rec, [Norm()], calibrations=rp.calibrate("imu", [imu]))
    said = {r.input: "calibrated" in {f.kind for f in r.findings} for r in result.runs}
    assert said == {"/hand/imu": True, "/foot/imu": False}


def test_an_unusable_calibration_is_never_applied(imu: mr.Recording) -> None:
    (found,) = rp.calibrate("imu", [imu])
    found.usable = False
    result = rp.replay(imu, [Norm()], calibrations=[found])
    assert "calibrated" not in {f.kind for f in result.runs[0].findings}


def test_several_stretches_of_annotations_are_looked_at(imu: mr.Recording, tmp_path: Path) -> None:
    path = tmp_path / "marked.mcap"
    with mr.create(path) as out:
        out.copy_from(imu)
        spans = [(10**9, 22 * 10**9), (22 * 10**9, 43 * 10**9)]
        out.add_annotations(
            pl.DataFrame(
                [("calibration", a, b, "turn it") for a, b in spans],
                schema=["tier", "start_ns", "end_ns", "label"],
                orient="row",
            )
        )
    (found,) = rp.calibrate("imu", [mr.open(path)], interval="calibration")
    assert len(found.computed_from) == 2
    np.testing.assert_allclose(found.array("acc_offset_m_s2"), ACC_OFFSET, atol=0.01)


def test_files_come_back(imu: mr.Recording, tmp_path: Path) -> None:
    (found,) = rp.calibrate("imu", [imu])
    rp.save_calibration(found, tmp_path / "imu.json")
    assert rp.load_calibration(tmp_path / "imu.json") == found
    with pytest.raises(MarchaError, match=r"imu\.json"):
        rp.save_calibration(found, tmp_path / "imu.json")


@pytest.mark.parametrize("text", ["", "{}", "[1]", '{"kind": "imu", "nonsense": 1}', "\x00"])
def test_what_is_no_calibration_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "bad.json").write_text(text)
    with pytest.raises(MarchaError, match=r"bad\.json: is no calibration"):
        rp.load_calibration(tmp_path / "bad.json")


def test_from_the_command_line(imu: mr.Recording, tmp_path: Path) -> None:
    cal, out = tmp_path / "imu.json", tmp_path / "out.mcap"
    done = marcha("calibrate", "imu", str(imu.path), "-o", str(cal), "--json")
    assert done.code == 0
    assert done.document["calibrations"][0]["kind"] == "imu"
    replayed = marcha(
        "replay", str(imu.path), "-e", "foot.naive", "--calibration", str(cal), "-o", str(out), "--json"
    )
    kinds = {f["kind"] for f in replayed.document["runs"][0]["findings"]}
    assert "calibrated" in kinds


def test_a_calibrator_is_a_plain_class() -> None:
    class Mean(Calibrator):
        name = "mean"

        def calibrate(self, stretches: Any) -> Calibration:
            return Calibration(kind="mean", values={"n": len(stretches)})

    assert Mean().calibrate([]).values == {"n": 0}
