"""Walks with known truth: simulated ones (consistency) and real ones (closure, Vicon, footprints, stairs)."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

from .algorithms_support import FOOT, columns, rows_of, run, simulated

CORRECTED = FOOT[1:]
UNCLIPPED = ("1111", "2222", "2323", "3333")
DETECTORS = ({"detector": "c1c2c3"}, {"detector": "pitch"}, {"preset": "shoe-tuned"}, {"preset": "are-tuned"})
TUNED = (*DETECTORS, {"preset": "mv-tuned"}, {"preset": "mag-tuned"}, {"preset": "live"})

MATCHED_SENSOR = {
    "acc_bias_sigma": 0.0,
    "gyr_bias_sigma": 0.0,
    "acc_bias_walk": 0.0,
    "gyr_bias_walk": 0.0,
    "acc_scale": (0.0, 0.0, 0.0),
    "gyr_bias": (0.01, -0.02, 0.005),
    "acc_noise": 0.01,  # 0.1 m/s² a sample: the filter's sigma_acc
    "gyr_noise": 3e-4,  # 0.003 rad/s a sample
    "quantize": False,
    "clip": False,
    "rest_s": 11.0,
}
MATCHED_FILTER: dict[str, Any] = {"preset": "published", "sigma_gyr": 0.003, "init_s": 10.0}


def positions(result: dict[str, np.ndarray]) -> np.ndarray:
    return columns(result, "pose", "pos_x", "pos_y", "pos_z")


def closure(result: dict[str, np.ndarray]) -> float:
    """Horizontal distance from the first to the last position."""
    p = positions(result)
    p = p[np.isfinite(p[:, 0])]
    return float(np.hypot(*(p[-1] - p[0])[:2]))


def path(result: dict[str, np.ndarray]) -> float:
    p = positions(result)[:, :2]
    return float(np.hypot(*np.diff(p[np.isfinite(p[:, 0])], axis=0).T).sum())


# --- simulated
# ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["foot.9iez", "foot.15iez-zaru"])
def test_errors_agree_with_the_filters_own_sigma(name: str) -> None:
    """Sensor noise as the filter believes it: the normalized errors are chi-squared."""
    extra = {"sigma_gyr_bias0": 1e-4} if name == "foot.15iez-zaru" else {}
    pos, vel = [], []
    for seed in range(12):
        rows, walk = simulated(seed=seed, **MATCHED_SENSOR)
        result, _ = run(name, rows, **MATCHED_FILTER, **extra)
        sigma = columns(result, "sigma")
        error = positions(result) - (walk.pos - walk.pos[0])
        pos.append(((error[-1] / sigma[-1, :3]) ** 2).sum())
        moving = ~walk.still & (np.arange(len(rows)) > 1200)
        vel.append((((columns(result, "velocity") - walk.vel)[moving] / sigma[moving, 3:6]) ** 2).mean())
    low, high = chi2.ppf([0.001, 0.999], 3 * 12)
    assert low < sum(pos) < high
    assert 0.4 < np.mean(vel) < 1.6


@pytest.mark.parametrize("name", ["foot.9iez", "foot.9iez-kf", "foot.15iez-zaru"])
def test_horizontal_sigma_covers_the_devices_own_errors(name: str) -> None:
    normalized = []
    for seed in range(12):
        rows, walk = simulated(seed=seed)
        result, _ = run(name, rows)
        error = positions(result)[-1] - (walk.pos - walk.pos[0])[-1]
        normalized.append((error / columns(result, "sigma")[-1, :3])[:2])
    assert np.sqrt(np.mean(np.square(normalized))) < 1.5


def test_naive_runs_away_and_the_others_do_not() -> None:
    rows, walk = simulated()
    truth = walk.pos - walk.pos[0]
    assert np.linalg.norm(positions(run("foot.naive", rows)[0])[-1] - truth[-1]) > 10
    for name in CORRECTED:
        assert np.linalg.norm(positions(run(name, rows)[0])[-1] - truth[-1]) < 0.3, name


@pytest.mark.parametrize("name", CORRECTED)
@pytest.mark.parametrize("scenario", ["rectangle", "straight", "figure-eight", "stairs"])
def test_every_walk_is_followed(name: str, scenario: str) -> None:
    rows, walk = simulated(scenario)
    result, _ = run(name, rows)
    error = positions(result) - (walk.pos - walk.pos[0])
    late = np.isfinite(error[:, 0])
    assert np.sqrt((error[late] ** 2).sum(axis=1).mean()) < 0.15 + 0.005 * walk.length_m


@pytest.mark.parametrize("name", CORRECTED)
def test_steps_are_those_that_were_walked(name: str) -> None:
    rows, walk = simulated("stairs")
    result, _ = run(name, rows)
    step = columns(result, "step")
    at = np.flatnonzero(np.isfinite(step[:, 0]))
    step = step[at]
    truth = walk.steps
    assert len(step) == truth.height
    np.testing.assert_array_equal(step[:, 1], np.arange(truth.height))
    end = (truth["end_ns"].to_numpy() - walk.t_ns[0]) * 1e-9
    begin = (truth["start_ns"].to_numpy() - walk.t_ns[0]) * 1e-9
    assert np.abs(walk.t[at] - end).max() < 0.12
    assert np.abs(walk.t[at] - step[:, 0] - begin).max() < 0.12
    np.testing.assert_allclose(step[:, 2], truth["length_m"], atol=0.06)
    np.testing.assert_allclose(step[:, 3], truth["height_m"], atol=0.04)
    turn = np.angle(np.exp(1j * (step[:, 4] - truth["heading_rad"].to_numpy())))
    assert np.abs(turn[truth["length_m"].to_numpy() > 0.3]).max() < 0.1


@pytest.mark.parametrize("rate", [50.0, 200.0, 400.0])
def test_other_rates_need_no_other_parameters(rate: float) -> None:
    rows, walk = simulated(rate_hz=rate)
    result, estimator = run("foot.9iez", rows, rate_hz=rate)
    assert not estimator.remarks()
    assert np.linalg.norm(positions(result)[-1] - (walk.pos - walk.pos[0])[-1]) < 0.25
    assert np.isfinite(result["step.index"]).sum() == walk.steps.height


# --- real
# -----------------------------------------------------------------------------------------------------

ACC = {"0": 16384, "1": 8192, "2": 4096, "3": 2048}
GYR = {"0": 131, "1": 65.5, "2": 32.8, "3": 16.4}


@cache
def device(folder: Path, code: str, sensor: int) -> np.ndarray:
    (file,) = (folder / "foot/mpu6050").glob(f"conf-{code}-*.csv")
    lines = file.read_text().splitlines()
    cells = np.array(
        [line.split(",") for line in lines if re.fullmatch(r"\d+(,-?\d+){12}", line)], dtype=float
    )
    a, g = (code[0], code[1]) if sensor == 1 else (code[2], code[3])
    first = 1 + 6 * (sensor - 1)
    acc = cells[:, first : first + 3] / ACC[a] * 9.81
    gyr = np.radians(cells[:, first + 3 : first + 6] / GYR[g])
    return rows_of(cells[:, 0] * 1e-3, acc, gyr)


def rigid(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return ``p`` turned and shifted onto ``q`` (Kabsch, no reflection, no scale)."""
    a, b = p - p.mean(axis=0), q - q.mean(axis=0)
    u, _, vt = np.linalg.svd(a.T @ b)
    d = np.ones(p.shape[1])
    d[-1] = np.sign(np.linalg.det(u @ vt))
    return a @ u @ np.diag(d) @ vt + q.mean(axis=0)


def rmse(p: np.ndarray, q: np.ndarray) -> float:
    return float(np.sqrt(((rigid(p, q) - q) ** 2).sum(axis=1).mean()))


@pytest.mark.data
@pytest.mark.parametrize("code", UNCLIPPED)
def test_nine_states_close_the_real_rectangle(data_dir: Path, code: str) -> None:
    result, estimator = run("foot.9iez", device(data_dir, code, 2))
    steps = columns(result, "step")
    steps = steps[np.isfinite(steps[:, 0])]
    assert 0.2 < 100 * closure(result) / 22.1 < 1.2
    assert 21 < steps[:, 2].sum() < 25
    assert np.isfinite(result["step.index"]).sum() == 19
    assert not estimator.remarks()


@pytest.mark.data
def test_fifteen_states_are_about_as_good_as_nine(data_dir: Path) -> None:
    ends = {
        name: [
            [100 * closure(run(name, device(data_dir, code, sensor))[0]) / 22.1 for code in UNCLIPPED]
            for sensor in (1, 2)
        ]
        for name in ("foot.9iez", "foot.15iez-zaru")
    }
    nine, fifteen = np.array(ends["foot.9iez"]), np.array(ends["foot.15iez-zaru"])
    assert fifteen[1].mean() < 0.9
    assert (fifteen.mean(axis=1) <= nine.mean(axis=1) + 0.1).all()


@pytest.mark.data
@pytest.mark.parametrize("choice", TUNED, ids=lambda c: next(iter(c.values())))
def test_every_detector_closes_the_real_rectangle(data_dir: Path, choice: dict) -> None:
    ends = [100 * closure(run("foot.9iez", device(data_dir, c, 2), **choice)[0]) / 22.1 for c in UNCLIPPED]
    assert np.mean(ends) < 0.9


@pytest.mark.data
def test_a_loose_bias_prior_ruins_the_walk(data_dir: Path) -> None:
    """What the documentation warns of is still so."""
    loose = {"sigma_gyr_bias0": 1e-2, "zaru_after_s": 1e6}
    ends = [
        100 * closure(run("foot.15iez-zaru", device(data_dir, c, 1), **loose)[0]) / 22.1 for c in UNCLIPPED
    ]
    assert np.mean(ends) > 2


@pytest.mark.data
@pytest.mark.parametrize("name", ["foot.9iez", "foot.15iez-zaru"])
@pytest.mark.parametrize("file", ["2017-11-22-11-25-20", "2018-02-22-10-10-56"])
def test_vicon_agrees(data_dir: Path, name: str, file: str) -> None:
    """The reference is mirrored (y flipped here); both begin within half a second (short-rest)."""
    from scipy.io import loadmat

    mat = loadmat(data_dir / f"foot/vicon/{file}.mat")
    truth = mat["gt"][:, :3] * [1, -1, 1]
    rows = rows_of(mat["ts"].ravel(), mat["imu"][:, :3], mat["imu"][:, 3:6])
    result, _ = run(name, rows, preset="short-rest", rate_hz=200.0)
    known = np.isfinite(result["pose.pos_x"])
    assert known.mean() > 0.95
    assert rmse(positions(result)[known], truth[known]) < 0.12


@pytest.mark.data
def test_a_restless_vicon_start_is_stated(data_dir: Path) -> None:
    from scipy.io import loadmat

    mat = loadmat(data_dir / "foot/vicon/2018-02-22-10-10-56.mat")
    rows = rows_of(mat["ts"].ravel(), mat["imu"][:, :3], mat["imu"][:, 3:6])
    _, estimator = run("foot.9iez", rows, preset="published", rate_hz=200.0)
    assert [r.kind for r in estimator.remarks() if r.fatal] == ["no_rest"]


@pytest.mark.data
@pytest.mark.parametrize("name", ["foot.9iez", "foot.15iez-zaru"])
def test_footprints_agree(data_dir: Path, name: str) -> None:
    """33 strides measured with a ruler (their y is mirrored, too)."""
    table = np.genfromtxt(data_dir / "foot/footprints/SensorConnectData_31.csv", delimiter=",", skip_header=1)
    (file,) = (data_dir / "foot/footprints").glob("SensorConnectData_31_stride*.csv")
    prints = np.genfromtxt(file, delimiter=",", skip_header=1)
    result, _ = run(name, rows_of(table[:, 0], table[:, 1:4] * 9.80665, table[:, 4:7]), rate_hz=200.0)
    at = prints[:, 0].astype(int)
    assert rmse(positions(result)[at, :2], prints[:, 2:4] * [1, -1]) < 0.4


@pytest.mark.data
@pytest.mark.parametrize("name", ["foot.9iez", "foot.15iez-zaru"])
def test_short_walk_comes_back(data_dir: Path, name: str) -> None:
    table = np.genfromtxt(data_dir / "foot/xio/short_walk.csv", delimiter=",", skip_header=1)
    table = table[np.diff(table[:, 0], prepend=-1) > 0]
    rows = rows_of(table[:, 0], table[:, 4:7] * 9.80665, np.radians(table[:, 1:4]))
    result, _ = run(name, rows, rate_hz=400.0)
    assert closure(result) < 0.3


@pytest.mark.data
@pytest.mark.parametrize("name", CORRECTED)
def test_spiral_stairs_climb(data_dir: Path, name: str) -> None:
    (file,) = (data_dir / "foot/stairs").glob("*.csv")
    table = np.genfromtxt(file, delimiter=",", skip_header=1)
    rows = rows_of(np.arange(len(table)) / 256, table[:, 4:7] * 9.80665, np.radians(table[:, 1:4]))
    result, _ = run(name, rows, rate_hz=256.0)
    assert abs(positions(result)[-1, 2] - 5.4) < 0.5
