"""Figures of steps against values worked out by hand."""

from __future__ import annotations

from typing import Any

import numpy as np
import polars as pl
import pytest
from marcha.replay import RunView, Truth
from marcha.replay import metrics_phone as mp

STEP = 550_000_000
REFERENCE = 10**18 + STEP * np.arange(40)


class StepsView(RunView):
    """A view whose reference of steps is given."""

    def reference_table(self, kind: str) -> pl.DataFrame | None:
        assert kind == "steps"
        return pl.DataFrame({"t_ns": REFERENCE, "end_ns": REFERENCE})


def figures(ends: Any, **options: Any) -> dict[str, float]:
    table = pl.DataFrame({"t_ns": np.asarray(ends, np.int64)})
    return mp.phone(StepsView("run", "e", {}, lambda name, _: {"step": table}.get(name), **options))


def test_a_constant_offset_is_told_and_is_no_error() -> None:
    found = figures(REFERENCE - 210_000_000)
    assert found == {
        "steps_error_percent": 0.0,
        "steps_recall": 1.0,
        "steps_precision": 1.0,
        "steps_offset_s": pytest.approx(-0.21),
    }


def test_missing_and_doubled_steps_are_counted_once() -> None:
    ends = np.sort(
        np.concatenate((REFERENCE[8:], REFERENCE[10:14] + 100_000_000, REFERENCE[20:21] + STEP // 2))
    )
    found = figures(ends)
    assert found["steps_recall"] == 32 / 40
    assert found["steps_precision"] == 32 / 37
    assert found["steps_error_percent"] == pytest.approx(7.5)


def test_steps_that_are_late_by_more_than_the_tolerance_are_wrong() -> None:
    ends = REFERENCE.copy()
    ends[5] += 149_000_000
    ends[9] += 151_000_000
    assert figures(ends)["steps_precision"] == 39 / 40


def test_a_stated_number_of_steps_is_left_to_its_own_metric() -> None:
    assert "steps_error_percent" not in figures(REFERENCE, truth=Truth(steps=40))


def test_no_step_found_is_a_recall_of_zero() -> None:
    assert figures([]) == {"steps_error_percent": 100.0, "steps_recall": 0.0}
    assert mp.phone(StepsView("run", "e", {}, lambda *_: None)) == {}
