"""Executors: every task has one outcome, whatever happens to it or to its process."""

from __future__ import annotations

import os

import pytest
from marcha.recording import MarchaError, UsageError
from marcha.replay.study.executors import SINGLE_THREAD, Executor


def double(task: int) -> int:
    if task == 3:
        raise ValueError("three is not liked")
    return 2 * task


def die_at_two(task: int) -> int:
    if task == 2:
        os._exit(1)
    return task


def threads(task: int) -> tuple[int, str | None]:
    return os.getpid(), os.environ.get("POLARS_MAX_THREADS")


@pytest.mark.parametrize("workers", [1, 2])
def test_an_error_is_an_outcome_of_its_own_task(workers: int) -> None:
    with Executor(workers) as executor:
        outcomes = dict(executor.run(double, [1, 2, 3, 4]))
    assert str(outcomes.pop(3)) == "three is not liked"
    assert outcomes == {1: 2, 2: 4, 4: 8}


def test_a_task_that_kills_its_process_costs_only_itself() -> None:
    with Executor(2) as executor:
        outcomes = dict(executor.run(die_at_two, [1, 2, 3, 4, 5]))
    died = outcomes.pop(2)
    assert isinstance(died, MarchaError)
    assert "worker process died" in str(died)
    assert outcomes == {1: 1, 3: 3, 4: 4, 5: 5}


def test_workers_have_one_thread_and_the_parent_keeps_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("POLARS_MAX_THREADS", raising=False)
    with Executor(2) as executor:
        here, *others = (outcome for _, outcome in executor.run(threads, [0, 1, 2, 3]))
    assert here == (os.getpid(), None)
    assert {o[1] for o in others if not isinstance(o, Exception)} == {SINGLE_THREAD["POLARS_MAX_THREADS"]}
    assert os.getpid() not in {o[0] for o in others if not isinstance(o, Exception)}


def test_no_workers_are_refused() -> None:
    with pytest.raises(UsageError, match="at least 1"):
        Executor(0)
