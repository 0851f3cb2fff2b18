"""Changing annotations: whole or not at all, listed, undone; what does not fit is one line."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import marcha.recording as mr
import polars as pl
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from marcha.recording import MarchaError, Recording, UsageError
from marcha.recording.changes import change, edit, find, history, standing, undo
from marcha.recording.events import SIDECAR, TABLE, Vocabulary

from .annotation_samples import START_NS, hard_annotations, recording

WHEN = datetime(2026, 1, 2, 3, 4, 5, tzinfo=UTC)


@pytest.fixture
def rec(tmp_path: Path) -> Recording:
    return mr.open(recording(tmp_path / "a.mcap"))


def mark(label: str, start_s: float, end_s: float | None = None, **more: object) -> pl.DataFrame:
    start, end = (START_NS + round(t * 1e9) for t in (start_s, start_s if end_s is None else end_s))
    return pl.DataFrame({"tier": "t", "start_ns": start, "end_ns": end, "label": label, **more})


def changed(rec: Recording, **what: object) -> Recording:
    change(rec, rec.path, by="anna", when=WHEN, overwrite=True, **what)  # pyright: ignore[reportArgumentType]
    return mr.open(rec.path)


def test_the_list_says_who_when_and_what(rec: Recording) -> None:
    rec = changed(rec, add=mark("a", 1, 2), action="add")
    rec = changed(rec, remove=rec.annotations["id"].to_list(), action="remove")
    first, second = history(rec)
    assert (first.number, first.by, first.action, first.time) == (
        1,
        "anna",
        "add",
        "2026-01-02T03:04:05+00:00",
    )
    assert second.removed[0]["label"] == "a"
    assert rec.annotations.height == 0


def test_undo_and_redo_return_to_the_same_tables(rec: Recording) -> None:
    tables = [rec.annotations]
    for k in range(4):
        rec = changed(rec, add=mark(f"m{k}", k, k + 5))
        tables.append(rec.annotations)
    edit(rec, rec.path, [rec.annotations["id"][0]], {"label": "other", "confidence": 0.5}, overwrite=True)
    rec = mr.open(rec.path)
    tables.append(rec.annotations)
    assert tables[-1]["id"].to_list() == tables[-2]["id"].to_list()
    for redo, expected in [(False, tables[:-1][::-1]), (True, tables[1:])]:
        for table in expected:
            undo(rec, rec.path, redo=redo, overwrite=True)
            rec = mr.open(rec.path)
            assert rec.annotations.equals(table)
    with pytest.raises(UsageError, match="redo"):
        undo(rec, rec.path, redo=True, overwrite=True)
    assert all(standing(history(rec))[n] for n in range(1, 6))


def test_an_earlier_change_is_undone_alone_unless_a_later_one_touches_the_same(rec: Recording) -> None:
    rec = changed(rec, add=mark("a", 1))
    rec = changed(rec, add=mark("b", 2))
    edit(rec, rec.path, find(rec, rec.annotations.filter(label="b")["id"]), {"note": "x"}, overwrite=True)
    rec = mr.open(rec.path)
    with pytest.raises(UsageError, match="change 3 touches the same"):
        undo(rec, rec.path, 2, overwrite=True)
    undo(rec, rec.path, 1, overwrite=True)
    assert mr.open(rec.path).annotations["label"].to_list() == ["b"]


@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.integers(0, 3), max_size=8))
def test_any_session_is_undone_to_nothing(tmp_path_factory: pytest.TempPathFactory, steps: list[int]) -> None:
    path = recording(tmp_path_factory.mktemp("s") / "a.mcap")
    for k, step in enumerate(steps):
        rec = mr.open(path)
        ids = rec.annotations["id"].to_list()
        if step < 2 or not ids:
            change(rec, path, add=mark(f"m{k}", k, k + step), overwrite=True)
        elif step == 2:
            change(rec, path, remove=ids[:1], overwrite=True)
        else:
            edit(rec, path, ids[-1:], {"label": f"e{k}"}, overwrite=True)
    for _ in steps:
        undo(mr.open(path), path, overwrite=True)
    assert mr.open(path).annotations.height == 0


def test_readings_stay_and_the_events_are_attached(rec: Recording) -> None:
    before = rec.table("/imu")
    rec = changed(rec, add=hard_annotations(50))
    assert rec.table("/imu").equals(before)
    assert {TABLE, SIDECAR} <= {a.name for a in rec.attachments}
    assert rec.attachment(TABLE).count(b"\t") >= 50 * 11
    rec = changed(rec, remove=rec.annotations["id"].to_list())
    assert TABLE not in {a.name for a in rec.attachments}


@pytest.mark.parametrize(
    ("table", "says"),
    [
        (mark("late", 2000), "1 of 1 annotations lie outside of the recording"),
        (mark("half", 999, 1001), "outside of the recording"),
        (mark("x", 1, id="no word"), "is no word"),
        (mark("x", 1, confidence=1.5), "confidence 1.5 is not between 0 and 1"),
        (pl.concat([mark("x", 1, id="i"), mark("y", 2, id="i")]), "'i' is there twice"),
    ],
)
def test_what_does_not_fit_is_one_line_and_changes_nothing(
    rec: Recording, table: pl.DataFrame, says: str
) -> None:
    before = rec.path.read_bytes()
    with pytest.raises(MarchaError, match=says) as error:
        change(rec, rec.path, add=table, overwrite=True)
    assert "\n" not in str(error.value)
    assert rec.path.read_bytes() == before


def test_an_id_that_is_taken_is_refused(rec: Recording) -> None:
    rec = changed(rec, add=mark("a", 1, id="mine"))
    with pytest.raises(MarchaError, match="'mine' is taken by 'a'"):
        changed(rec, add=mark("b", 2, id="mine"))


def test_a_closed_vocabulary_refuses_other_labels(rec: Recording) -> None:
    rec = changed(rec, add=mark("up", 1, 2))
    with pytest.raises(MarchaError, match="label 'up' is not in its closed vocabulary; it has down"):
        changed(rec, vocabulary={"t": Vocabulary(labels={"down": ""}, closed=True)})
    rec = changed(rec, vocabulary={"t": Vocabulary(labels={"up": "stairs up"}, closed=True)})
    with pytest.raises(MarchaError, match="label 'sideways'"):
        changed(rec, add=mark("sideways", 3))
    assert b'"up": "stairs up"' in rec.attachment(SIDECAR)
    undo(rec, rec.path, overwrite=True)
    assert changed(mr.open(rec.path), add=mark("sideways", 3)).annotations.height == 2


def test_the_beginning_of_an_id_is_enough_unless_several_have_it(rec: Recording) -> None:
    rec = changed(rec, add=pl.concat([mark("a", 1, id="abc"), mark("b", 2, id="abd")]))
    assert find(rec, ["abd", "abc"]) == ["abd", "abc"]
    with pytest.raises(UsageError, match="2 annotations have"):
        find(rec, ["ab"])
    with pytest.raises(UsageError, match="no annotation has"):
        find(rec, ["x"])
