"""The offline smoother, and how honest the stated uncertainties of joint angles are."""

from __future__ import annotations

from pathlib import Path

import marcha.recording as mr
import numpy as np
import polars as pl
import pytest
from marcha.algorithms import make
from marcha.algorithms.joint.smooth import smooth
from marcha.ingest import convert
from marcha.ingest.simulate import simulate
from marcha.replay import Run, replay
from marcha.study.config import load


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[dict[str, Run], pl.DataFrame]]:
    """Three simulated walks through ``joint.hinge`` and ``joint.smooth``, with the true knee."""
    found = []
    for seed, cycle in ((2, 1.1), (3, 1.6), (5, 1.1)):
        folder = tmp_path_factory.mktemp("smooth")
        options = {"duration_s": 40, "segments": ("thigh", "shank"), "mount_deg": 0.0, "cycle_s": cycle}
        convert(simulate("walking", folder, seed=seed, **options).paths, folder / "leg.mcap")
        rec = mr.open(folder / "leg.mcap")
        result = replay(rec, ["joint.hinge", "joint.smooth"])
        found.append(({r.estimator: r for r in result.runs}, rec.table("/reference/joint")))
    return found


def errors(run: Run, truth: pl.DataFrame) -> tuple[np.ndarray, np.ndarray]:
    """Return error and stated standard deviation (rad) after the first 2 s."""
    table, sigma = run.tables["joint"], run.tables["sigma"]
    t = table["t_ns"].to_numpy()
    true = np.interp(t, truth["t_ns"].to_numpy(), truth["knee"].to_numpy())
    late = t > t[0] + 2_000_000_000
    return (table["knee"].to_numpy() - true)[late], sigma["knee"].to_numpy()[late]


def test_knowing_the_future_makes_it_better(runs: list[tuple[dict[str, Run], pl.DataFrame]]) -> None:
    assert make("joint.smooth").offline
    for pair, _ in runs:
        causal, smoothed = (pair[n].metrics for n in ("joint.hinge", "joint.smooth"))
        assert smoothed["rmse_unbiased_deg.knee"] < 0.5 * causal["rmse_unbiased_deg.knee"]
        assert smoothed["rmse_deg.knee"] < 0.9


@pytest.mark.parametrize("name", ["joint.hinge", "joint.smooth"])
def test_stated_uncertainty_is_honest(name: str, runs: list[tuple[dict[str, Run], pl.DataFrame]]) -> None:
    """Mean NEES over walks: errors last for seconds, so each walk counts as few independent samples."""
    nees = []
    for pair, truth in runs:
        error, sd = errors(pair[name], truth)
        nees.append(float(np.mean((error / sd) ** 2)))
        assert np.mean(np.abs(error) < 1.96 * sd) > 0.9
    assert 0.2 < np.mean(nees) < 2.0


def test_two_that_move_as_one_are_refused(tmp_path: Path) -> None:
    options = {"duration_s": 20, "segments": ("thigh", "shank")}
    convert(simulate("walking", tmp_path, seed=3, **options).paths, tmp_path / "leg.mcap")
    rec = mr.open(tmp_path / "leg.mcap")
    with mr.create(tmp_path / "one.mcap") as out:
        for segment in ("thigh", "shank"):
            out.add_table(f"/leg/{segment}/imu", "sensor_msgs/msg/Imu", rec.table("/leg/thigh/imu"))
    (run,) = replay(mr.open(tmp_path / "one.mcap"), ["joint.smooth"]).runs
    (finding,) = [f for f in run.findings if f.kind == "not_observable"]
    assert "as one body" in finding.detail
    assert run.tables["joint"].is_empty()


def test_smoother_is_the_least_squares_solution() -> None:
    """Against the normal equations of the same model: states Δ and bias, white measurements and growth."""
    rng = np.random.default_rng(1)
    n, q, r, t = 40, (1e-4, 1e-5), 0.01, 0.1
    z = np.cumsum(rng.normal(0, 0.05, n)) + rng.normal(0, 0.1, n)
    out, work = np.empty((n, 2)), np.zeros((n, 8))
    smooth(np.full(n, t), z, np.full(n, r), np.array(q), work, out)
    rows: list[tuple[np.ndarray, float]] = []

    def add(entries: dict[int, float], value: float, variance: float) -> None:
        row = np.zeros(2 * n)
        for at, v in entries.items():
            row[at] = v
        rows.append((row / np.sqrt(variance), value / np.sqrt(variance)))

    add({0: 1.0}, z[0], r)
    add({1: 1.0}, 0.0, 1e-4)
    for k in range(n):
        add({2 * k: 1.0}, z[k], r)
        if k:
            add({2 * k: 1.0, 2 * k - 2: -1.0, 2 * k - 1: -t}, 0.0, q[0] * t)
            add({2 * k + 1: 1.0, 2 * k - 1: -1.0}, 0.0, q[1] * t)
    design, values = np.array([a for a, _ in rows]), np.array([b for _, b in rows])
    expected = np.linalg.lstsq(design, values, rcond=None)[0]
    np.testing.assert_allclose(out[:, 0], expected[::2], atol=1e-9)
    variance = np.diag(np.linalg.inv(design.T @ design))[::2]
    np.testing.assert_allclose(out[:, 1], variance, rtol=1e-6)


def test_study_of_the_source_states_its_tables() -> None:
    """Means of tables 6 and 7 as printed: 2.1156 and 1.6164 of RMSE, .9941 and .9951 of r."""
    config, _ = load("joint-tables")
    for kind, means in (
        ("RMSE", {"SMe": 2.1156, "SMeA": 1.6164}),
        ("Pearson r", {"SMe": 0.9941, "SMeA": 0.9951}),
    ):
        tables = [t for t in config.published if t.metric.startswith(f"{kind}, roll")]
        assert len(tables) == 2
        for name, mean in means.items():
            assert np.mean([t.rows[name]["exoskeleton"] for t in tables]) == pytest.approx(mean, abs=6e-5)
