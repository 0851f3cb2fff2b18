"""Foot navigation: is the end of a walk as far off as the filter says? One measurement, real walks and simulated ones.

Real: every Vicon trial of the data folder but the creeping one (its run says that track and steps disagree), the
defaults only. The estimate begins where the reference stands then; its heading, which no IMU knows, is laid on the
reference by the first three metres; the error of the last sample is divided by the three standard deviations of the
position. Median and share within the 95 % ellipsoid (7.81). Simulated: walks of an unkind device, forty seeds a
scenario, errors of position, velocity and attitude at the last sample, mean over the walks.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from marcha.algorithms.contract import FloatArray
from marcha.ingest import simulate as sim
from marcha.replay import nees_bounds
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from tests.algorithms_support import columns, rows_of, run

from . import Row
from .foot_walks import estimate, walks

FILTERS = ("foot.9iez", "foot.15iez-zaru", "foot.ukf", "foot.9iez-kf", "foot.9iez-mad")
REAL = ("foot.9iez", "foot.15iez-zaru", "foot.rts")
SCENARIOS = ("rectangle", "figure-eight", "stairs", "straight")
SEEDS = range(4001, 4041)
INSIDE = float(chi2.ppf(0.95, 3))


def squared_errors(name: str, scenario: str, seeds: Sequence[int] = SEEDS) -> FloatArray:
    """Return the normalized squared errors of position, velocity and attitude at the end, shape (seeds, 3).

    Sensors 1 and 2 of the source's device in turn. The heading at the start, which no IMU knows, is taken off.
    """
    result = np.empty((len(seeds), 3))
    for k, seed in enumerate(seeds):
        rng = np.random.default_rng([seed, 1])
        gait: dict[str, Any] = {"stride_m": rng.uniform(1.15, 1.45), "stride_s": rng.uniform(1.05, 1.35)}
        walk = sim.walk(scenario, seed=seed, sensor=2 if seed % 2 else 1, errors="unkind", **gait)
        out, _ = run(name, rows_of(walk.t, *walk.measured()))
        position = columns(out, "pose", *(f"pos_{a}" for a in "xyz"))
        turned = _attitude(columns(out, "pose", *(f"quat_{a}" for a in "wxyz")))
        true = _attitude(walk.quat_wxyz)
        first = int(np.flatnonzero(np.isfinite(position[:, 0]))[0])
        heading = Rotation.from_euler("z", _yaw(turned[first]) - _yaw(true[first]))
        errors = (
            position[-1] - position[first] - heading.apply(walk.pos[-1] - walk.pos[first]),
            columns(out, "velocity")[-1] - heading.apply(walk.vel[-1]),
            (turned[-1] * (heading * true[-1]).inv()).as_rotvec(),
        )
        sigma = columns(out, "sigma")[-1].reshape(3, 3)
        result[k] = [((e / s) ** 2).sum() for e, s in zip(errors, sigma, strict=True)]
    return result


def _attitude(quat_wxyz: FloatArray) -> Rotation:
    return Rotation.from_quat(np.nan_to_num(quat_wxyz, nan=0.5), scalar_first=True)


def _yaw(rotation: Rotation) -> float:
    m = rotation.as_matrix()
    return float(np.arctan2(m[1, 0], m[0, 0]))


def real(folder: Path, scratch: Path) -> dict[str, FloatArray]:
    """Return for each filter the normalized squared errors of the Vicon trials' ends."""
    result: dict[str, list[float]] = {name: [] for name in REAL}
    for walk in walks(folder / "foot" / "vicon", scratch):
        scores = {name: estimate(walk, name) for name in REAL}
        if any(r.kind == "path_against_steps" for r in scores[REAL[0]].remarks):
            continue
        for name, score in scores.items():
            result[name].append(score.squared)
    return {name: np.array(values) for name, values in result.items()}


def rows(scale: float) -> list[Row]:
    """Measure; ``scale`` 1 takes forty seeds a scenario."""
    return [*_real_rows(), *_simulated_rows(max(4, round(len(SEEDS) * scale)))]


def _real_rows() -> Iterator[Row]:
    folder = Path(os.environ.get("MARCHA_DATA", "../shared/data"))
    if not (folder / "foot" / "vicon").is_dir():
        return
    with tempfile.TemporaryDirectory() as scratch:
        for name, values in real(folder, Path(scratch)).items():
            median, inside = float(np.median(values)), float(np.mean(values <= INSIDE))
            what = f"{name}: {len(values)} Vicon trials, end"
            yield Row(f"{what}, median NEES", median, "", "", None, None, "< 6", median < 6)
            yield Row(f"{what} within the 95 % ellipsoid", inside, "", "", None, None, "≥ 0.9", inside >= 0.9)


def _simulated_rows(seeds: int) -> Iterator[Row]:
    low, high = nees_bounds(seeds)
    for name in FILTERS:
        for scenario in SCENARIOS:
            means = squared_errors(name, scenario, SEEDS[:seeds]).mean(axis=0)
            for what, value in zip(("position", "velocity", "attitude"), means, strict=True):
                target = f"{low:.2f} … {high:.2f} (95 % of χ²)"
                yield Row(
                    f"{name} {scenario}: NEES of {what}",
                    float(value),
                    "",
                    "",
                    None,
                    None,
                    target,
                    value < high,
                )
