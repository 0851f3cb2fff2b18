"""Figures of channels of any length: read in windows, peaks kept, and nothing held but what is drawn."""

from __future__ import annotations

from pathlib import Path

import marcha.recording as mr
import numpy as np
import polars as pl
import pytest
from marcha.recording import Recording
from marcha.replay import replay
from marcha.viz.figures import figure
from marcha.viz.thinned import acc_norm, every, first_rows, pieces, thinned
from numpy.typing import NDArray

from .test_viz_rrd import write_walk

IMU = "/foot/imu1"
ROWS = 30_000
OF_A_WALK = ("walk", "signals", "steps", "detector", "floor", "threshold", "conditions")


@pytest.fixture(scope="module")
def noise(tmp_path_factory: pytest.TempPathFactory) -> tuple[Recording, pl.DataFrame]:
    """A channel of several windows, with single peaks and missing values."""
    rng = np.random.default_rng(3)
    values = rng.normal(size=(ROWS, 6))
    values[rng.integers(0, ROWS, 5), rng.integers(0, 3, 5)] = (50.0, -60.0, 70.0, -80.0, 90.0)
    values[100:130, 0] = np.nan
    names = [f"{s}_{a}" for s in ("acc", "gyr") for a in "xyz"]
    table = pl.DataFrame(
        {
            "t_ns": (np.arange(ROWS, dtype=np.int64) + 1) * 10**7,
            **{n: values[:, k] for k, n in enumerate(names)},
        }
    )
    path = tmp_path_factory.mktemp("thinned") / "noise.mcap"
    with mr.create(path) as out:
        for start in range(0, ROWS, 7000):
            out.add_table(IMU, "sensor_msgs/msg/Imu", table[start : start + 7000], frame_id="imu1")
    return mr.open(path), table


def xyz(table: pl.DataFrame) -> NDArray[np.float64]:
    return table.select("acc_x", "acc_y", "acc_z").to_numpy()


@pytest.mark.parametrize("rows", [600, 6_000])
def test_a_long_channel_is_drawn_by_few_rows_that_hold_every_extreme(
    noise: tuple[Recording, pl.DataFrame], rows: int
) -> None:
    rec, table = noise
    t_ns, values = thinned(rec, IMU, xyz, rows)
    assert rows / 4 < len(t_ns) <= rows + 6 * 5
    assert (np.diff(t_ns) > 0).all()
    at = np.searchsorted(table["t_ns"].to_numpy(), t_ns)
    assert np.array_equal(xyz(table)[at], values, equal_nan=True)
    assert np.array_equal(np.nanmin(values, axis=0), np.nanmin(xyz(table), axis=0))
    assert np.array_equal(np.nanmax(values, axis=0), np.nanmax(xyz(table), axis=0))


def test_a_short_channel_is_drawn_as_it_is(noise: tuple[Recording, pl.DataFrame]) -> None:
    rec, table = noise
    t_ns, values = thinned(rec, IMU, acc_norm)
    assert np.array_equal(t_ns, table["t_ns"].to_numpy())
    assert np.array_equal(values[:, 0], np.linalg.norm(xyz(table), axis=1), equal_nan=True)
    assert pl.concat(pieces(rec, IMU)).equals(rec.table(IMU))


def test_rows_are_chosen_evenly_and_a_beginning_says_that_it_is_none_of_all(
    noise: tuple[Recording, pl.DataFrame],
) -> None:
    rec, table = noise
    assert every(rec, IMU, 100)["t_ns"].equals(table["t_ns"][::300])
    for rows, whole in ((8_000, False), (ROWS, True)):
        head, complete = first_rows(rec, IMU, rows)
        assert head.equals(rec.table(IMU)[:rows])
        assert complete is whole


def test_no_figure_of_a_walk_holds_a_channel_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    raw = write_walk(tmp_path / "walk.mcap")
    replay(raw, ["foot.9iez"], out=tmp_path / "done.mcap")
    rec = mr.open(tmp_path / "done.mcap")
    dense = {t for t, c in rec.channels.items() if c.count > 500}
    assert len(dense) >= 5
    table = Recording.table

    def sparse_only(
        self: Recording,
        topic: str,
        start_ns: int | None = None,
        end_ns: int | None = None,
        log_time: bool = False,
    ) -> pl.DataFrame:
        assert topic not in dense, f"{topic} is read whole"
        return table(self, topic, start_ns, end_ns, log_time)

    monkeypatch.setattr(Recording, "table", sparse_only)
    for kind in OF_A_WALK:
        assert figure(rec, kind=kind).axes
