"""What changes nothing of a walk changes nothing of its estimate: mounting, side, start, longer rests.

The real recordings go through the same and more by ``python -m benchmarks.foot_walks --changed``.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from .algorithms_support import columns, run, simulated

POSITION = ("pos_x", "pos_y", "pos_z")
RATE = 200.0


def track(rows: np.ndarray, name: str = "foot.9iez", **params: Any) -> tuple[np.ndarray, Any]:
    result, estimator = run(name, rows, rate_hz=RATE, **params)
    return columns(result, "pose", *POSITION), estimator


def kinds(estimator: Any, fatal: bool | None = None) -> set[str]:
    return {r.kind for r in estimator.remarks() if fatal is None or r.fatal == fatal}


def turned(rows: np.ndarray, turn: Rotation) -> np.ndarray:
    return np.column_stack([rows[:, 0], turn.apply(rows[:, 1:4]), turn.apply(rows[:, 4:7])])


def shape_error(p: np.ndarray, q: np.ndarray) -> float:
    """Root mean square distance after a turn about the vertical: a mounting's heading is its own."""
    a, b = p - p[0], q - q[0]
    m = a[:, :2].T @ b[:, :2]
    turn = Rotation.from_euler("z", np.arctan2(m[0, 1] - m[1, 0], m[0, 0] + m[1, 1]))
    return float(np.sqrt(((turn.apply(a) - b) ** 2).sum(axis=1).mean()))


def walked(gait: str = "walk", **options: Any) -> tuple[np.ndarray, Any]:
    return simulated(gait=gait, rate_hz=RATE, errors="unkind", config="3333", **options)


@settings(max_examples=12, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from(["walk", "fast", "run"]))
def test_any_mounting_gives_the_same_walk(seed: int, gait: str) -> None:
    rows, _ = walked(gait)
    p, usual = track(rows)
    q, other = track(turned(rows, Rotation.random(rng=np.random.default_rng(seed))))
    is_navigated = np.isfinite(p[:, 0])
    assert (is_navigated == np.isfinite(q[:, 0])).all()
    assert shape_error(q[is_navigated], p[is_navigated]) < 1e-6
    assert kinds(other) - {"upside_down"} == kinds(usual) - {"upside_down"}


def test_a_left_foot_walks_the_mirrored_way() -> None:
    rows, _ = walked()
    p, _ = track(rows)
    q, _ = track(rows * [1, 1, -1, 1, -1, 1, -1])
    is_navigated = np.isfinite(p[:, 0])
    assert shape_error(q[is_navigated] * [1, -1, 1], p[is_navigated]) < 1e-6


@pytest.mark.parametrize("gait", ["walk", "fast", "run"])
@pytest.mark.parametrize("late_s", [0.0, 0.4, 0.8])
def test_a_walk_that_begins_in_any_phase_of_any_gait_starts_in_its_first_stances(
    gait: str, late_s: float
) -> None:
    rows, walk = walked(gait, length_m=60.0)
    first = int((walk.steps["start_ns"][3] - walk.t_ns[0]) * 1e-9 * RATE + late_s * RATE)
    p, estimator = track(rows[first:])
    is_navigated = np.isfinite(p[:, 0])
    assert np.flatnonzero(is_navigated)[0] < 3.0 * RATE
    assert not kinds(estimator, fatal=True)
    assert kinds(estimator) & {"moving_start", "no_rest", "short_rest"}  # said, however good it turned out
    assert shape_error(p[is_navigated], walk.pos[first:][is_navigated]) < 0.8


def test_a_long_rest_is_heard_out() -> None:
    """The bias is that of the whole rest: 10 s of it say more than the 2 s that the start waits for."""
    off = {}
    for rest_s in (2.5, 12.0):
        errors = []
        for seed in range(6):
            rows, walk = walked(seed=seed, rest_s=rest_s)
            _, estimator = track(rows)
            standing = walk.t < rest_s - 0.5
            true = (
                rows[standing, 4:7].mean(axis=0)
                if rest_s > 5
                else walked(seed=seed, rest_s=12.0)[0][: int(11.5 * RATE), 4:7].mean(axis=0)
            )
            errors.append(np.abs(estimator.record.bias_gyr - true).max())
        off[rest_s] = float(np.mean(errors))
    assert off[12.0] < off[2.5]


def test_a_rest_at_the_end_changes_nothing_of_the_walk() -> None:
    rows, _ = walked()
    stood = np.vstack([rows, rows[np.arange(1000) % 200]])
    p, _ = track(rows)
    q, estimator = track(stood)
    np.testing.assert_allclose(q[: len(p) - 200], p[:-200], atol=1e-12)  # the last ones see the windows' end
    assert not kinds(estimator, fatal=True)


def test_a_floor_that_moves_is_remarked_and_a_standing_foot_is_not() -> None:
    rows, _ = simulated("lift", errors="unkind")
    assert "carried" in kinds(run("foot.9iez", rows)[1])
    for scenario in ("rectangle", "stairs", "still", "ramp"):
        rows, _ = simulated(scenario, errors="unkind", rest_s=20.0)
        assert "carried" not in kinds(run("foot.9iez", rows)[1]), scenario
