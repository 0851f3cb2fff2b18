"""Executors: every task has one outcome, whatever happens to it or to its process."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from marcha.recording import MarchaError, UsageError
from marcha.study import executors
from marcha.study.executors import SINGLE_THREAD, Executor


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
        outcomes = [outcome for _, outcome in executor.run(threads, [0, 1, 2, 3])]
    assert {o[1] for o in outcomes if not isinstance(o, Exception)} == {SINGLE_THREAD["POLARS_MAX_THREADS"]}
    assert "POLARS_MAX_THREADS" not in os.environ


def test_no_task_of_a_pool_runs_in_the_parent() -> None:
    with Executor(2) as executor:
        outcomes = [outcome for _, outcome in executor.run(threads, [0, 1, 2, 3])]
    assert os.getpid() not in {o[0] for o in outcomes if not isinstance(o, Exception)}


@pytest.mark.parametrize("workers", [1, 2])
@pytest.mark.parametrize("tasks", [[], [1, 2, 4]])
def test_what_is_to_be_done_meanwhile_is_done_once(workers: int, tasks: list[int]) -> None:
    calls: list[int] = []
    with Executor(workers) as executor:
        assert len(list(executor.run(double, tasks, meanwhile=lambda: calls.append(os.getpid())))) == len(
            tasks
        )
    assert calls == [os.getpid()]


def test_a_pool_that_was_warmed_up_and_not_used_closes() -> None:
    with Executor(2) as executor:
        executor.warm_up(["marcha.recording"], ["foot.naive", "no.such.estimator"])


def test_a_pool_that_is_still_loading_is_not_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "endless.py").write_text("import signal\nsignal.pause()\n", encoding="utf-8")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    executors._stop_server()  # one that an earlier test left is loaded already
    with Executor(2) as executor:
        executor.warm_up(["endless"], [])
    with Executor(2) as executor:
        assert dict(executor.run(double, [1, 2])) == {1: 2, 2: 4}


def test_no_workers_are_refused() -> None:
    with pytest.raises(UsageError, match="at least 1"):
        Executor(0)
