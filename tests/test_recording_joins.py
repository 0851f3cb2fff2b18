"""Joined and cut recordings: runs are evaluated as before, and the list of changes goes on."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import marcha.recording as mr
import polars as pl
import pytest
from marcha.ingest import convert
from marcha.ingest.simulate import simulate
from marcha.recording import Recording, UsageError
from marcha.recording.changes import change, history, undo
from marcha.recording.parts import anonymize, cut, merge
from marcha.replay import evaluate, replay

S = 10**9


@pytest.fixture(scope="module")
def walks(tmp_path_factory: pytest.TempPathFactory) -> list[Recording]:
    """Two replayed walks with truth, of other lengths, whose annotations were changed."""
    folder = tmp_path_factory.mktemp("walks")
    found = []
    for number, length in ((1, 8.0), (2, 12.0)):
        raw = simulate("rectangle", folder / f"raw{number}", seed=number, length_m=length)
        convert(raw.paths, folder / f"{number}.mcap")
        rec = mr.open(folder / f"{number}.mcap")
        replay(rec, ["foot.9iez"], out=folder / f"done{number}.mcap")
        rec = mr.open(folder / f"done{number}.mcap")
        for k in range(2):
            table = mark(rec, 1 + 2 * k, 2 + 2 * k, f"mark {k}")
            when = datetime(2024, 1, 1 + k, number, tzinfo=UTC)
            change(rec, folder / f"marked{number}-{k}.mcap", add=table, by=f"Eva {number}", when=when)
            rec = mr.open(folder / f"marked{number}-{k}.mcap")
        found.append(rec)
    return found


def mark(rec: Recording, start_s: float, end_s: float, label: str) -> pl.DataFrame:
    start, end = (rec.start_ns + round(t * S) for t in (start_s, end_s))
    return pl.DataFrame(
        {
            "tier": ["manual"],
            "start_ns": [start],
            "end_ns": [end],
            "label": [label],
            "id": [f"id-{label[-1]}"],
        }
    )


def test_runs_of_a_joined_recording_measure_as_those_of_its_parents(
    walks: list[Recording], tmp_path: Path
) -> None:
    """Topics, runs, references, truth and stances are found below each prefix, with an offset too."""
    merge(walks, tmp_path / "both.mcap", prefixes=["/left", "/right"], offsets_ns=[0, 3 * S])
    both = mr.open(tmp_path / "both.mcap")
    alone = {
        f"{side}_{r.run}": r.metrics
        for side, rec in zip(("left", "right"), walks, strict=True)
        for r in evaluate(rec).runs
    }
    joined = {r.run: r.metrics for r in evaluate(both).runs}
    assert joined.keys() == alone.keys()
    for run, metrics in alone.items():
        assert joined[run] == pytest.approx(metrics, rel=1e-6, abs=1e-6, nan_ok=True), run
        assert {"ate_rmse_m", "length_error_percent"} & metrics.keys()
    run = next(iter(alone))
    assert both.metadata[f"run/{run}"]["input"] == "/left/foot/imu1"
    assert f"{run}/stance" in both.annotations["tier"].to_list()


def test_the_list_of_changes_goes_through_a_join_and_can_be_undone(
    walks: list[Recording], tmp_path: Path
) -> None:
    merge(walks, tmp_path / "both.mcap", prefixes=["/left", "/right"], offsets_ns=[0, 3 * S])
    both = mr.open(tmp_path / "both.mcap")
    past = history(both)
    assert [c.number for c in past] == [1, 2, 3, 4]
    assert [c.by for c in past] == ["Eva 1", "Eva 2", "Eva 1", "Eva 2"]  # by time
    marks = both.annotations.filter(pl.col("tier").str.ends_with("/manual"))
    assert marks["id"].n_unique() == 4  # both parents had the same two
    assert {i for c in past for i in c.added} == set(marks["id"])
    undo(both, tmp_path / "undone.mcap", 2)  # the first of the second walk
    left = mr.open(tmp_path / "undone.mcap").annotations.filter(pl.col("tier") == "right/manual")
    assert left.select("label", "start_ns").rows() == [("mark 1", walks[1].start_ns + 6 * S)]
    undo(mr.open(tmp_path / "undone.mcap"), tmp_path / "redone.mcap", redo=True)
    again = mr.open(tmp_path / "redone.mcap").annotations
    assert again.sort("id").equals(both.annotations.sort("id"))


def test_the_list_of_changes_goes_through_a_cut(walks: list[Recording], tmp_path: Path) -> None:
    """What the cut took is listed; a change before it is undone where what it touched is still there."""
    rec = walks[0]
    cut(rec, tmp_path / "part.mcap", rec.start_ns + round(1.5 * S), rec.start_ns + 10 * S)
    part = mr.open(tmp_path / "part.mcap")
    assert [c.action for c in history(part)] == ["change", "change", "cut"]
    assert {row["label"] for row in history(part)[-1].removed} >= {"mark 0"}  # shorter now
    undo(part, tmp_path / "undone.mcap")
    left = mr.open(tmp_path / "undone.mcap").annotations.filter(pl.col("tier") == "manual")
    assert left["label"].to_list() == ["mark 0"]
    with pytest.raises(UsageError, match="there is not change 3 to undo"):
        undo(part, tmp_path / "no.mcap", 3)
    cut(rec, tmp_path / "late.mcap", rec.start_ns + round(2.5 * S), rec.start_ns + 10 * S)
    with pytest.raises(UsageError, match=r"id-0 is no longer there; it was cut off"):
        undo(mr.open(tmp_path / "late.mcap"), tmp_path / "no.mcap", 1)


def test_an_anonymous_copy_of_a_joined_recording_names_no_file(
    walks: list[Recording], tmp_path: Path
) -> None:
    merge(walks, tmp_path / "both.mcap", prefixes=["/left", "/right"])
    found = anonymize(mr.open(tmp_path / "both.mcap"), tmp_path / "a.mcap")
    assert not [text for text in found.left if "marked" in text]
    runs = {k: v["records"] for k, v in mr.open(tmp_path / "a.mcap").metadata.items() if k.startswith("run/")}
    assert set(runs.values()) == {"part1", "part2"}
