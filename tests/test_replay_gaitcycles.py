"""Error over the gait cycle: from events and from the signal, by values worked out by hand."""

from __future__ import annotations

from pathlib import Path

import marcha.recording as mr
import numpy as np
import polars as pl
import pytest
from marcha.replay import evaluate
from marcha.replay import metrics_joint as mj

from .cli_helpers import marcha

T = np.arange(0, 20_000_000_000, 10_000_000)
PHASE = 2 * np.pi * T * 1e-9 / 1.25
ANGLE = np.radians(30.0 + 30.0 * np.cos(PHASE))
JOINT = "sensor_msgs/msg/JointState"


def recorded(path: Path, *, column: str = "knee", sign: float = 1.0, events: bool = False) -> Path:
    """Write an estimate that is 2° too large and 1° · sin(phase) off beside its reference."""
    error = np.radians(2.0 + np.sin(PHASE))
    with mr.create(path) as out:
        out.add_table("/reference/joint", JOINT, pl.DataFrame({"t_ns": T, column: ANGLE}))
        out.add_table("/estimate/one/joint", JOINT, pl.DataFrame({"t_ns": T, "knee": sign * (ANGLE + error)}))
        if events:
            starts = np.arange(2.5, 19, 1.25) + 0.25
            ns = (starts * 1e9).astype(np.int64)
            labels = {"tier": "gait", "start_ns": ns, "end_ns": ns, "label": "heel strike"}
            out.add_annotations(pl.DataFrame(labels))
    return path


def test_mean_and_band_of_the_error_over_the_cycle(tmp_path: Path) -> None:
    (run,) = evaluate(mr.open(recorded(tmp_path / "a.mcap"))).runs
    (knee,) = run.cycles
    assert (knee.joint, knee.starts) == ("knee", "signal")
    assert knee.count == run.metrics["cycles.knee"] == 14
    share = np.linspace(0, 2 * np.pi, 101)
    np.testing.assert_allclose(knee.error_mean, 2.0 + np.sin(share), atol=0.02)
    np.testing.assert_allclose(knee.reference_mean, 30 + 30 * np.cos(share), atol=0.05)
    assert max(knee.error_sd) < 0.05
    assert np.mean(knee.rmse) == pytest.approx(np.sqrt(4.5), abs=0.02)


def test_events_go_before_the_signal(tmp_path: Path) -> None:
    (run,) = evaluate(mr.open(recorded(tmp_path / "a.mcap", events=True))).runs
    (knee,) = run.cycles
    assert knee.starts == "events"
    assert knee.count == run.metrics["cycles.knee"]
    assert knee.reference_mean[0] == pytest.approx(30 + 30 * np.cos(2 * np.pi * 0.2), abs=0.1)


def test_events_of_the_other_leg_are_not_taken() -> None:
    marks = pl.DataFrame(
        {"start_ns": [1, 2, 3, 4], "label": ["left HS", "right_heel_strike", "Left heel strike", "turn"]}
    )
    assert mj.events_of(marks, "left_knee").tolist() == [1, 3]
    assert mj.events_of(marks, "right_knee").tolist() == [2]
    assert mj.events_of(marks, "knee").tolist() == []
    assert mj.events_of(marks[[0, 2]], "knee").tolist() == [1, 3]


@pytest.mark.parametrize(
    ("column", "found"),
    [
        ("knee", ("knee", 1.0)),
        ("LKneeAngles", ("LKneeAngles", 1.0)),
        ("knee_angle_r", ("knee_angle_r", 1.0)),
        ("left_knee", ("left_knee", 1.0)),
        ("elbow", None),
    ],
)
def test_references_of_other_names(column: str, found: tuple[str, float] | None) -> None:
    assert mj.reference_column("knee", [column, "time"]) == found
    assert mj.reference_column("knee", ["left_knee", "right_knee"]) is None
    assert mj.reference_column("right_hip", ["hip_flexion_l", "hip_flexion_r"]) == ("hip_flexion_r", -1.0)


def test_what_is_odd_about_the_reference_is_one_line(tmp_path: Path) -> None:
    done = marcha("evaluate", recorded(tmp_path / "a.mcap", sign=-1.0))
    assert "knee: turns against its reference (r -1.00)" in done.out
    path = tmp_path / "b.mcap"
    with mr.create(path) as out:
        both = pl.DataFrame({"t_ns": T, "left_knee": ANGLE, "right_knee": ANGLE})
        out.add_table("/reference/joint", JOINT, both)
        out.add_table("/estimate/one/joint", JOINT, pl.DataFrame({"t_ns": T, "knee": ANGLE}))
    assert "the reference has left_knee, right_knee" in marcha("evaluate", path).out


def test_the_table_has_every_tenth_of_the_cycle(tmp_path: Path) -> None:
    out = marcha("evaluate", recorded(tmp_path / "a.mcap")).out
    assert "knee over 14 gait cycles (from signal)" in out
    rows = [line.split() for line in out.splitlines() if line[:3].strip().isdigit()]
    assert [int(r[0]) for r in rows] == list(range(0, 101, 10))


@pytest.mark.parametrize(
    ("later", "message"),
    [
        (60, "no overlap: the estimate covers 0.0 to 20.0 s, the reference 60.0"),
        (12, "the reference covers 8.0 s"),
    ],
)
def test_a_reference_of_another_time_or_a_part_is_said(tmp_path: Path, later: int, message: str) -> None:
    path = tmp_path / "c.mcap"
    with mr.create(path) as out:
        moved = pl.DataFrame({"t_ns": T + later * 1_000_000_000, "knee": ANGLE})
        out.add_table("/reference/joint", JOINT, moved)
        out.add_table("/estimate/one/joint", JOINT, pl.DataFrame({"t_ns": T, "knee": ANGLE}))
    done = marcha("evaluate", path)
    assert done.code == 0
    assert [line for line in done.out.splitlines() if message in line]
