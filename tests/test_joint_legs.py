"""Both legs in one recording: a run a leg, joints with their side, each judged by its own reference."""

from __future__ import annotations

from pathlib import Path

import marcha.recording as mr
import numpy as np
import pytest
from marcha.algorithms import make
from marcha.algorithms.joint.chain import measure_angles
from marcha.ingest import convert
from marcha.ingest.jointangles import cardan
from marcha.ingest.simulate import simulate
from marcha.replay import Run, evaluate, replay
from scipy.spatial.transform import Rotation


@pytest.fixture(scope="module")
def legs(tmp_path_factory: pytest.TempPathFactory) -> mr.Recording:
    folder = tmp_path_factory.mktemp("legs")
    made = simulate("walking", folder, seed=2, sides="both", duration_s=20, mount_deg=0.0)
    for path in folder.glob("*truth*"):
        path.unlink()
    convert(made.paths, folder / "legs.mcap")
    return mr.open(folder / "legs.mcap")


def angles(run: Run) -> list[str]:
    return [c for c in run.tables["joint"].columns if not c.startswith("t_")]


def test_every_leg_is_a_run_of_its_own(legs: mr.Recording, tmp_path: Path) -> None:
    result = replay(legs, ["joint.hinge", "joint.sme"], out=tmp_path / "done.mcap")
    inputs = {r.run: {name: topics[0] for name, topics in r.inputs.items() if topics} for r in result.runs}
    assert len(inputs) == 4
    for run in result.runs:
        side = "left" if "left" in inputs[run.run]["thigh"] else "right"
        assert inputs[run.run]["thigh"] == f"/leg/{side}_thigh/imu"
        assert inputs[run.run]["shank"] == f"/leg/{side}_shank/imu"
        assert inputs[run.run]["encoder"] == "/leg/encoder"
        if run.estimator == "joint.sme":
            assert inputs[run.run]["trunk"] == "/leg/trunk/imu"
            assert inputs[run.run]["foot"] == f"/leg/{side}_foot/imu"
            assert angles(run) == [f"{side}_{j}" for j in ("hip", "knee", "ankle")]
    for run in evaluate(mr.open(tmp_path / "done.mcap")).runs:
        side = "left" if "pearson_r.left_knee" in run.metrics else "right"
        other = "right" if side == "left" else "left"
        assert run.metrics[f"pearson_r.{side}_knee"] > (0.98 if run.estimator == "joint.hinge" else 0.8)
        assert not [name for name in run.metrics if other in name]


def test_a_chain_of_three_joints_by_rotations(legs: mr.Recording) -> None:
    """Trunk, thigh, shank, foot of one leg, kinds by joint without the side's name."""
    params = {"joint": "hip=hinge knee=hinge ankle=hinge"}
    result = replay(legs, ["joint.relative"], params=params)
    assert len(result.runs) == 2
    columns = [angles(r) for r in result.runs]
    assert columns == [[f"{s}_{j}" for j in ("hip", "knee", "ankle")] for s in ("left", "right")]
    assert all(
        r.metrics[f"rmse_unbiased_deg.{s}_knee"] < 3.0
        for r, s in zip(result.runs, ("left", "right"), strict=True)
    )


def test_all_three_angles_have_the_references_signs() -> None:
    """The chain's angles of known attitudes are those of the reference's definition, and of scipy's sequence XYZ."""
    estimator = make("joint.relative", joint="free", position="0,0,0.2,0,0,-0.2")
    state = estimator.state[0]
    turns = Rotation.random(20, np.random.default_rng(1)), Rotation.random(20, np.random.default_rng(2))
    expected = cardan(*(t.as_matrix() for t in turns))
    for k in range(20):
        state["n"], state["mount"][:2] = 2, np.eye(3)
        state["rot"][0], state["rot"][1] = turns[0][k].as_matrix(), turns[1][k].as_matrix()
        measure_angles(estimator.state[0])
        difference = (state["angle"][0] - expected[k] + np.pi) % (2 * np.pi) - np.pi
        np.testing.assert_allclose(difference, 0.0, atol=1e-9)
