"""Annotations by rule: every stance and step once, turns and stairs where they are, twice gives the same."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import marcha.recording as mr
import numpy as np
import polars as pl
import pytest
from marcha.export.agreement import compare
from marcha.export.rules import apply_rules
from marcha.recording import Recording, UsageError
from marcha.recording.annotations import check_annotations, identified
from marcha.recording.changes import change

S = 10**9
RATE_NS = 10**7


def walk(
    path: Path, headings_deg: Sequence[float], heights_m: Sequence[float], jump: bool = False
) -> Recording:
    """Write a walk of one stride a second: 0.6 s of stance, 0.4 s of swing."""
    count = len(headings_deg)
    t = np.arange(0, (count + 1) * S, RATE_NS)
    still = t % S < 600_000_000
    first = S * np.arange(count) + 600_000_000
    steps = pl.DataFrame(
        {
            "t_ns": first + 400_000_000,
            "start_ns": first,
            "end_ns": first + 400_000_000,
            "index": pl.Series(range(count), dtype=pl.UInt32),
            "length_m": 1.4,
            "height_m": np.array(heights_m, float),
            "heading_rad": np.deg2rad(headings_deg),
        }
    )
    acc = np.full(len(t), 9.81)
    if jump:
        acc[100:140] = 0.5  # 0.39 s of flight
        acc[200:210] = 0.5  # a swing
    rest = np.zeros(len(t))
    kept = np.ones(len(t), bool)
    kept[300:310] = False
    imu = pl.DataFrame({"t_ns": t, "acc_x": rest, "acc_y": rest, "acc_z": acc}).filter(pl.Series(kept))
    gyr = np.clip(40 * np.sin(2 * np.pi * t * 1e-9), -34.9, 34.9)
    fixes = pl.DataFrame({"t_ns": S * np.array([0, 1, 2, 3, 14, 15]), "lat_deg": 38.7, "lon_deg": -9.1})
    with mr.create(path) as out:
        out.add_table("/foot/imu", "sensor_msgs/msg/Imu", imu)
        table = pl.DataFrame({"t_ns": t, "gyr_x": gyr, "gyr_y": rest, "gyr_z": rest})
        out.add_table("/foot/gyr", "sensor_msgs/msg/Imu", table)
        out.add_table("/phone/gnss", "sensor_msgs/msg/NavSatFix", fixes)
        out.add_table(
            "/estimate/r/stance", "marcha_msgs/msg/Stance", pl.DataFrame({"t_ns": t, "still": still})
        )
        out.add_table("/estimate/r/step", "marcha_msgs/msg/Step", steps)
    return mr.open(path)


def rows(rec: Recording, name: str) -> list[tuple[int, int, str]]:
    found, _ = apply_rules(rec, [name])
    return [
        (a // 10**7, b // 10**7, label) for a, b, label in found.select("start_ns", "end_ns", "label").rows()
    ]


@pytest.fixture
def rec(tmp_path: Path) -> Recording:
    headings = [0, 0, 5, 40, 88, 90, 90, 0, 0, -3, 3, 170, -170, -175, 180, 180]
    heights = [0, 0, 0, 0, 0.17, 0.16, 0.18, 0.02, -0.01, -0.3, 0, -0.17, -0.18, 0, 0, 0]
    return walk(tmp_path / "a.mcap", headings, heights, jump=True)


def test_stances_swings_and_steps_are_there_once(rec: Recording) -> None:
    assert rows(rec, "stance") == [(100 * k, 100 * k + 59, "stance") for k in range(17)]
    assert rows(rec, "swing") == [(100 * k + 59, 100 * k + 100, "swing") for k in range(16)]
    assert rows(rec, "step") == [(100 * k + 60, 100 * k + 100, f"step {k}") for k in range(16)]


def test_turns_are_between_straights(rec: Recording) -> None:
    assert rows(rec, "turn") == [
        (300, 460, "turn left"),
        (700, 760, "turn right"),
        (1100, 1260, "turn left"),
    ]


def test_stairs_have_several_steps_of_one_direction(rec: Recording) -> None:
    assert rows(rec, "stair") == [(460, 700, "stairs up"), (1160, 1300, "stairs down")]


def test_jumps_gaps_clipping_and_lost_fixes(rec: Recording) -> None:
    assert rows(rec, "jump") == [(100, 139, "jump")]
    assert rows(rec, "gap") == [(299, 310, "gap")]
    assert rows(rec, "fix-lost") == [(300, 1400, "fix lost")]
    clips = rows(rec, "clip")
    assert len(clips) == 34
    assert {label for *_, label in clips} == {"clip gyr"}


def test_twice_gives_the_same_table_and_a_new_estimate_replaces_the_old(
    rec: Recording, tmp_path: Path
) -> None:
    new, stale = apply_rules(rec)
    assert not stale
    change(rec, tmp_path / "b.mcap", add=new)
    again = mr.open(tmp_path / "b.mcap")
    more, stale = apply_rules(again)
    assert (more.height, stale) == (0, [])
    moved = again.annotations.filter(label="turn right").with_columns(pl.col("start_ns") - 5)
    change(again, tmp_path / "c.mcap", add=moved, remove=moved["id"].to_list())
    third = mr.open(tmp_path / "c.mcap")
    back, stale = apply_rules(third, ["turn"])
    change(third, tmp_path / "d.mcap", add=back, remove=stale)
    key = ["start_ns", "id"]
    assert mr.open(tmp_path / "d.mcap").annotations.sort(key).equals(again.annotations.sort(key))


def test_what_people_marked_stays(rec: Recording, tmp_path: Path) -> None:
    mine = pl.DataFrame({"tier": "r/turn", "start_ns": 0, "end_ns": 5, "label": "mine", "source": "human:a"})
    change(rec, tmp_path / "b.mcap", add=mine)
    _, stale = apply_rules(mr.open(tmp_path / "b.mcap"))
    assert stale == []


def test_an_unknown_rule_is_named(rec: Recording) -> None:
    with pytest.raises(UsageError, match="rule 'fly': not known; there are stance, swing"):
        apply_rules(rec, ["fly"])


def table(*intervals: tuple[float, float, str]) -> pl.DataFrame:
    columns = list(zip(*intervals, strict=True)) or [(), (), ()]
    return identified(
        check_annotations(
            pl.DataFrame(
                {
                    "tier": ["t"] * len(intervals),
                    "start_ns": [round(s * S) for s in columns[0]],
                    "end_ns": [round(s * S) for s in columns[1]],
                    "label": list(columns[2]),
                },
                schema={"tier": pl.String, "start_ns": pl.Int64, "end_ns": pl.Int64, "label": pl.String},
            )
        )
    )


def test_agreement_by_hand() -> None:
    first = table((0, 4, "walk"), (4, 6, "turn"), (6, 10, "walk"))
    second = table((0, 3, "walk"), (3, 6, "turn"), (6, 10, "walk"))
    found, listing = compare(first, second, (0, 10 * S))
    # 9 of 10 s agree; chance: walk 0.8 · 0.7, turn 0.2 · 0.3
    assert found.agreement == pytest.approx(0.9)
    assert found.kappa == pytest.approx((0.9 - 0.62) / (1 - 0.62))
    assert (found.matched, found.missed, found.added) == (3, 0, 0)
    assert found.overlap == pytest.approx((3 / 4 + 2 / 3 + 1) / 3)
    assert found.start_mean_s == pytest.approx(-1 / 3)
    assert found.end_max_s == pytest.approx(1)
    assert listing["status"].to_list() == ["matched"] * 3


def test_what_is_missed_and_what_is_added() -> None:
    first = table((1, 1, "hit"), (5, 5, "hit"), (7, 8, "turn"))
    second = table((1.2, 1.2, "hit"), (5.3, 5.3, "hit"), (7, 8, "stair"))
    found, listing = compare(first, second, (0, 10 * S), tolerance_s=0.25)
    assert (found.matched, found.missed, found.added) == (1, 2, 2)
    assert (found.precision, found.recall) == (pytest.approx(1 / 3), pytest.approx(1 / 3))
    assert listing["status"].to_list() == ["matched", "missed", "added", "missed", "added"]
    loose, _ = compare(first, second, (0, 10 * S), tolerance_s=0.5, labels=False)
    assert (loose.matched, loose.overlap) == (3, 1.0)


def test_a_table_agrees_with_itself_and_an_empty_one_with_nothing() -> None:
    some = table((0, 4, "a"), (2, 6, "b"), (3, 3, "c"))
    found, _ = compare(some, some, (0, 10 * S))
    assert (found.matched, found.f1, found.kappa, found.agreement) == (3, 1.0, pytest.approx(1.0), 1.0)
    none, _ = compare(some, table(), (0, 10 * S))
    assert (none.missed, none.recall, none.kappa) == (3, 0.0, pytest.approx(0.0))
    with pytest.raises(UsageError, match="tolerance -1"):
        compare(some, some, (0, 1), tolerance_s=-1)
