"""Threshold tuning: what is searched, what is measured, what is refused, and what a user is warned of."""

from __future__ import annotations

import itertools
import math
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from marcha import ingest, recording
from marcha import replay as rp
from marcha.ingest.simulate import simulate
from marcha.recording.errors import UsageError
from marcha.replay.tuning import parse_values

from .cli_helpers import marcha

TOPIC = ["/foot/imu2"]
WALKS = 2


@pytest.fixture(scope="module")
def walks(tmp_path_factory: pytest.TempPathFactory) -> list[Any]:
    """Two simulated rectangles of 22.1 m, converted with what their truth says."""
    folder = tmp_path_factory.mktemp("tuning")
    found = []
    for seed in range(WALKS):
        made = simulate("rectangle", folder / f"raw{seed}", seed=seed)
        out = ingest.convert(made.paths, folder / f"walk{seed}.mcap").output
        found.append(recording.open(out))
    return found


@pytest.fixture(scope="module")
def grid(walks: list[Any]) -> rp.Tuned:
    return rp.tune(
        walks[0],
        "foot.9iez[preset=published,detector=mag]",
        {"mag_max": "0.03:300:5", "cleaning_s": (0.04, 0.06, 0.08, 0.1)},
        inputs=TOPIC,
    )


def test_every_combination_is_tried_once(grid: rp.Tuned) -> None:
    tried = list(zip(grid.table["mag_max"], grid.table["cleaning_s"], strict=True))
    assert tried == list(itertools.product((0.03, 0.3, 3.0, 30.0, 300.0), (0.04, 0.06, 0.08, 0.1)))


def test_a_bad_default_is_left_behind(grid: rp.Tuned) -> None:
    """The literature's 3 m²/s⁴ takes parts of the swing for stance."""
    assert grid.params["mag_max"] == 0.3
    assert grid.objective < 0.5 * grid.default_objective
    assert grid.objective == grid.table["objective"].min()
    best = grid.table.sort("objective").row(0, named=True)
    assert best["steps"] == 16
    standing = grid.table.filter(mag_max=300.0)  # all of the walk is one stance: the run says that it failed
    assert (standing["failed"] == standing["runs"]).all()


def test_the_objective_is_closure_plus_distance_as_replay_measures_them(
    walks: list[Any], grid: rp.Tuned
) -> None:
    for row in grid.table.rows(named=True)[::3]:
        params = {
            "preset": "published",
            "detector": "mag",
            "mag_max": row["mag_max"],
            "cleaning_s": row["cleaning_s"],
        }
        (run,) = rp.replay(walks[0], ["foot.9iez"], params, inputs=TOPIC).runs
        if row["failed"]:
            assert run.fatal
            assert row["objective"] == math.inf
            continue
        wanted = run.metrics["closure_percent"] + run.metrics["distance_error_percent"]
        assert row["objective"] == pytest.approx(wanted, rel=1e-12)


def test_the_parameters_go_straight_into_a_replay(walks: list[Any], grid: rp.Tuned) -> None:
    (run,) = rp.replay(walks[0], [grid.estimator], grid.params, inputs=TOPIC).runs
    got = run.metrics["closure_percent"] + run.metrics["distance_error_percent"]
    assert got == pytest.approx(grid.objective, rel=1e-12)


def test_one_coordinate_after_the_other_comes_to_the_same_with_fewer_points(
    walks: list[Any], grid: rp.Tuned
) -> None:
    found = rp.tune(
        walks[0],
        "foot.9iez[preset=published,detector=mag]",
        {"mag_max": "0.03:300:5", "cleaning_s": (0.04, 0.06, 0.08, 0.1)},
        inputs=TOPIC,
        method="coordinate",
    )
    assert found.params["mag_max"] == grid.params["mag_max"]
    assert found.objective == pytest.approx(grid.objective, rel=1e-3)
    assert found.table.height < grid.table.height


def test_several_walks_and_sensors_count_alike(walks: list[Any]) -> None:
    search = {"c3_max": (0.6, 0.9)}
    both = rp.tune(walks, "foot.9iez", search)
    assert both.table["runs"].to_list() == [2 * WALKS] * 2
    single = [
        rp.tune(w, "foot.9iez", search, inputs=[t]) for w in walks for t in ("/foot/imu1", "/foot/imu2")
    ]
    for i in range(2):
        mean = sum(s.table["objective"][i] for s in single) / len(single)
        assert both.table["objective"][i] == pytest.approx(mean, rel=1e-12)
    assert both.warnings[0].startswith("tuned on 2 walks only")


def test_one_walk_an_end_and_a_plateau_are_warned_of(walks: list[Any]) -> None:
    found = rp.tune(walks[0], "foot.9iez", {"c2_max": (3.0, 3.1), "c3_max": (0.1, 0.12)}, inputs=TOPIC)
    said = " | ".join(found.warnings)
    assert "tuned on one walk" in said
    assert "c2_max: every value is within" in said
    assert "hardly better" in said or found.default_objective > 1.1 * found.objective
    assert set(found.plateau["c2_max"]) == {3.0, 3.1}


def test_the_end_of_a_range_is_warned_of(walks: list[Any]) -> None:
    found = rp.tune(
        walks[0], "foot.9iez[preset=published,detector=mag]", {"mag_max": (0.3, 3.0)}, inputs=TOPIC
    )
    assert any(w.startswith("mag_max=0.3 is the end") for w in found.warnings)


def test_combinations_that_make_no_sense_are_passed_over(walks: list[Any]) -> None:
    found = rp.tune(walks[0], "foot.9iez", {"c1_min": (9.0, 10.5), "c1_max": (10.2, 11.0)}, inputs=TOPIC)
    crossed = found.table.filter(c1_min=10.5, c1_max=10.2).row(0, named=True)
    assert crossed["objective"] == math.inf
    assert found.params == {"c1_min": 9.0, "c1_max": found.params["c1_max"]}


def test_a_run_that_must_not_be_used_is_never_the_best(walks: list[Any]) -> None:
    found = rp.tune(walks[0], "foot.9iez[init=fixed]", {"init_s": (2.0, 500.0)}, inputs=TOPIC)
    lost = found.table.filter(init_s=500.0).row(0, named=True)
    assert lost["objective"] == math.inf
    assert lost["failed"] == lost["runs"] == 1
    assert found.params["init_s"] == 2.0


def test_an_open_walk_is_measured_by_its_length_alone(walks: list[Any]) -> None:
    found = rp.tune(walks[0], "foot.9iez", {"c3_max": (0.6,)}, inputs=TOPIC, closed=False, length_m=20.0)
    row = found.table.row(0, named=True)
    assert row["objective"] == row["distance_error_percent"]
    assert any("not every walk is known to be closed" in w for w in found.warnings)


@pytest.mark.parametrize(
    ("estimator", "search", "said"),
    [
        ("foot.9iez", {}, "no parameter to search"),
        ("foot.9iez", {"c9_max": (1.0, 2.0)}, "no parameter 'c9_max'"),
        ("foot.nein", {"c3_max": (1.0, 2.0)}, "no estimator"),
        ("foot.9iez[c3_max=1]", {"c3_max": (1.0, 2.0)}, "both held"),
        ("foot.9iez", {"c3_max": ()}, "needs values"),
        ("foot.9iez", {"c3_max": (1.0, 1.0)}, "each once"),
        ("foot.9iez", {"c3_max": "0:1:80", "c2_max": "1:3:80"}, "6400 points are too many"),
        ("foot.9iez", {"c3_max": (-1.0, -2.0)}, "none of 2 points gives a usable run"),
    ],
)
def test_a_search_that_cannot_work_is_refused(
    walks: list[Any], estimator: str, search: dict[str, Any], said: str
) -> None:
    with pytest.raises(UsageError, match=said):
        rp.tune(walks[0], estimator, search, inputs=TOPIC)


def test_a_walk_of_unknown_length_is_refused(walks: list[Any], tmp_path: Path) -> None:
    with recording.create(tmp_path / "bare.mcap") as out:
        out.add_table(TOPIC[0], "sensor_msgs/msg/Imu", walks[0].table(TOPIC[0]))
    with pytest.raises(UsageError, match=r"bare\.mcap: the walk's length is not known"):
        rp.tune(recording.open(tmp_path / "bare.mcap"), "foot.9iez", {"c3_max": (0.5, 0.6)})


def test_progress_counts_the_points(walks: list[Any]) -> None:
    said: list[tuple[int, int]] = []
    rp.tune(
        walks[0],
        "foot.9iez",
        {"c3_max": "0.4:0.8:17"},
        inputs=TOPIC,
        progress=lambda done, total: said.append((done, total)),
    )
    assert said == [(16, 18), (18, 18)]


def test_the_middle_of_equals_is_taken(walks: list[Any]) -> None:
    """Above 0.2 rad/s the simulated foot's rate decides nothing: all these points are one."""
    found = rp.tune(walks[0], "foot.9iez", {"c3_max": (0.3, 0.5, 1.0, 2.0, 4.0)}, inputs=TOPIC)
    assert found.table["objective"].n_unique() == 1
    assert found.params == {"c3_max": 1.0}


@given(low=st.floats(-1e3, 1e3), width=st.floats(1e-2, 1e3), count=st.integers(2, 40))
def test_a_range_begins_and_ends_where_it_says(low: float, width: float, count: int) -> None:
    values = parse_values(f"{low!r}:{low + width!r}:{count}")
    assert len(values) == count
    assert values[0] == pytest.approx(low, rel=1e-5)
    assert values[-1] == pytest.approx(low + width, rel=1e-5)
    assert list(values) == sorted(values)


def test_a_wide_range_is_divided_by_factors_a_list_is_taken_as_it_is() -> None:
    assert parse_values("0.01:100:5") == (0.01, 0.1, 1.0, 10.0, 100.0)
    assert parse_values("1:4", points=4) == (1.0, 2.0, 3.0, 4.0)
    assert parse_values("shoe, are") == ("shoe", "are")
    assert parse_values("1,2.5,true") == (1, 2.5, True)


@pytest.mark.parametrize("text", ["1:", "2:1", "1:2:1", "1:2:x", "1:2:3:4", "a:b", "1:inf"])
def test_what_is_no_range_is_refused(text: str) -> None:
    with pytest.raises(UsageError, match="is no range"):
        parse_values(text)


def test_the_command_says_what_the_library_found(walks: list[Any]) -> None:
    ran = marcha(
        "tune", walks[0].path, "-e", "foot.9iez[preset=published,detector=mag]", "-p", "mag_max=0.03:300:5",
        "--input", TOPIC[0], "--json",
    )  # fmt: skip
    assert ran.code == 0
    found = rp.tune(
        walks[0], "foot.9iez[preset=published,detector=mag]", {"mag_max": "0.03:300:5"}, inputs=TOPIC
    )
    assert ran.document["params"] == found.params
    assert ran.document["objective_percent"] == pytest.approx(found.objective)
    assert ran.document["warnings"] == list(found.warnings)
    assert len(ran.document["points"]) == 5


def test_the_command_prints_a_line_to_go_on_with(walks: list[Any]) -> None:
    ran = marcha("tune", walks[0].path, "-e", "foot.9iez", "-p", "detector=c1c2c3,are", "--input", TOPIC[0])
    assert ran.code == 0
    assert "beware: tuned on one walk" in ran.out
    assert "marcha replay … -e 'foot.9iez[detector=" in ran.out


def test_the_command_refuses_in_one_line(walks: list[Any]) -> None:
    ran = marcha("tune", walks[0].path, "-e", "foot.9iez", "-p", "c3_max=2:1")
    assert ran.code == 2
    assert "is no range" in ran.complaint
