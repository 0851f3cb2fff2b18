"""Tables by annotation: the parts make up the whole, strides lie on 0 to 100 %, parameters by hand."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest
from marcha.recording import UsageError
from marcha.recording.annotations import check_annotations, identified
from marcha.replay.epochs import epochs, gait_parameters, normalized

S = 10**9


def marks(*rows: tuple[int, int, str]) -> pl.DataFrame:
    table = pl.DataFrame(
        [("t", a, b, label) for a, b, label in rows],
        schema={"tier": pl.String, "start_ns": pl.Int64, "end_ns": pl.Int64, "label": pl.String},
        orient="row",
    )
    return identified(check_annotations(table))


def steps(ends_s: list[float], lengths_m: list[float]) -> pl.DataFrame:
    ends = (np.array(ends_s) * S).astype(np.int64)
    return pl.DataFrame({"t_ns": ends, "start_ns": ends - 400_000_000, "end_ns": ends, "length_m": lengths_m})


def test_parts_make_up_the_whole_and_overlaps_are_there_twice() -> None:
    table = pl.DataFrame({"t_ns": np.arange(100), "x": np.arange(100.0)})
    parts = epochs(table, marks((0, 39, "a"), (40, 99, "b")))
    assert parts["x"].sum() == table["x"].sum()
    assert parts.filter(label="a")["t_ns"].to_list() == list(range(40))
    assert epochs(table, marks((10, 20, "a"), (15, 15, "b"))).filter(t_ns=15)["label"].to_list() == ["a", "b"]
    assert epochs(table, marks()).height == 0


def test_strides_of_different_length_lie_on_each_other() -> None:
    starts = np.array([0, 10, 22, 30]) * S // 10
    t = np.arange(0, 3 * S + 1, 10_000_000)
    k = np.clip(np.searchsorted(starts, t, side="right") - 1, 0, 2)
    phase = (t - starts[k]) / (starts[k + 1] - starts[k])
    table = pl.DataFrame({"t_ns": t, "knee": np.sin(2 * np.pi * phase)})
    band = normalized(table, "knee", starts)
    assert band.strides.shape == (3, 101)
    assert np.abs(band.mean - np.sin(2 * np.pi * band.percent / 100)).max() < 3e-3
    assert band.sd.max() < 3e-3
    assert normalized(table, "knee", [-S, 0, S]).strides.shape == (1, 101)
    with pytest.raises(UsageError, match="must increase"):
        normalized(table, "knee", [S, S])


def test_gait_parameters_by_hand() -> None:
    table = steps([1.0, 2.0, 3.2, 4.0], [1.0, 1.2, 1.4, 1.3])
    (row,) = gait_parameters(table, marks((0, 10 * S, "walk"))).rows(named=True)
    assert row["strides"] == 4
    assert row["distance_m"] == pytest.approx(4.9)
    assert row["stride_time_s"] == pytest.approx(1.0)
    assert row["cadence_per_min"] == pytest.approx(120.0)
    assert row["speed_m_s"] == pytest.approx(3.9 / 3)
    assert row["stance_share"] == pytest.approx(1 - 1.2 / 3)
    assert row["stride_time_cv"] == pytest.approx(0.2)


def test_too_few_strides_give_nothing_and_distances_add_up() -> None:
    table = steps([1.0, 2.0, 3.2, 4.0], [1.0, 1.2, 1.4, 1.3])
    found = gait_parameters(table, marks((0, 2 * S, "a"), (2 * S + 1, 10 * S, "b"), (20 * S, 21 * S, "c")))
    assert found["distance_m"].sum() == pytest.approx(4.9)
    assert found["stride_time_s"].to_list() == [pytest.approx(1.0), pytest.approx(0.8), None]
    assert found["strides"].to_list() == [2, 2, 0]
