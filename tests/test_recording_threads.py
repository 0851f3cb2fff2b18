"""Helper threads: how many there may be, and that their number changes no result."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path

import marcha.recording as mr
import numpy as np
import polars as pl
import pytest
from marcha.recording.threads import LIMIT, Prefetch, helpers, threads


@pytest.mark.parametrize(("given", "most"), [("1", 1), ("2", 2), ("", 4), ("none", 4), ("0", 4), ("-3", 4)])
def test_a_limit_is_kept_and_nonsense_is_none(monkeypatch: pytest.MonkeyPatch, given: str, most: int) -> None:
    monkeypatch.setenv(LIMIT, given)
    monkeypatch.setattr("os.cpu_count", lambda: 16)
    assert threads() == most


@pytest.mark.parametrize("limit", ["1", "4"])
def test_helpers_return_results_and_raise_errors(monkeypatch: pytest.MonkeyPatch, limit: str) -> None:
    monkeypatch.setenv(LIMIT, limit)
    with helpers("test") as pool:
        assert pool.submit(divmod, 7, 2).result() == (3, 1)
        failed = pool.submit(divmod, 7, 0)
        with pytest.raises(ZeroDivisionError):
            failed.result()


def test_a_limit_of_one_stays_in_the_callers_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(LIMIT, "1")
    with helpers("test") as pool:
        assert pool.submit(threading.get_ident).result() == threading.get_ident()


@pytest.mark.parametrize("limit", ["1", "4"])
@pytest.mark.parametrize("depth", [1, 3])
def test_reading_ahead_keeps_order_and_closes(
    monkeypatch: pytest.MonkeyPatch, limit: str, depth: int
) -> None:
    monkeypatch.setenv(LIMIT, limit)
    closed: list[bool] = []

    def numbers() -> Iterator[int]:
        try:
            yield from range(10)
        finally:
            closed.append(True)

    assert list(Prefetch(numbers(), "test", depth)) == list(range(10))
    early = Prefetch(numbers(), "test", depth)
    assert next(early) == 0
    early.close()
    assert closed == [True, True]


@pytest.mark.parametrize("limit", ["1", "4"])
def test_reading_ahead_closes_what_nobody_asked_for(monkeypatch: pytest.MonkeyPatch, limit: str) -> None:
    monkeypatch.setenv(LIMIT, limit)
    before, closed = threading.active_count(), []

    def numbers() -> Iterator[int]:
        try:
            yield from range(10)
        finally:
            closed.append(True)

    Prefetch(numbers(), "test").close()
    assert closed == [True]
    assert threading.active_count() == before


@pytest.mark.parametrize("limit", ["1", "4"])
def test_reading_ahead_raises_where_the_item_would_have_been(
    monkeypatch: pytest.MonkeyPatch, limit: str
) -> None:
    monkeypatch.setenv(LIMIT, limit)

    def numbers() -> Iterator[int]:
        yield 1
        raise ValueError("no second number")

    items = Prefetch(numbers(), "test")
    assert next(items) == 1
    with pytest.raises(ValueError, match="no second number"):
        next(items)


def test_the_number_of_threads_changes_no_byte(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    n = 20_000
    values = np.random.default_rng(1).normal(size=(n, 3))
    table = pl.DataFrame(
        {"t_ns": np.arange(n) * 10_000_000} | {f"vel_{a}": values[:, i] for i, a in enumerate("xyz")}
    )
    files: list[bytes] = []
    for limit in ("1", "4"):
        monkeypatch.setenv(LIMIT, limit)
        path = tmp_path / f"{limit}.mcap"
        with mr.create(path) as out:
            out.add_table("/v", "geometry_msgs/msg/Vector3Stamped", table)
        assert mr.open(path).table("/v").equals(table)
        files.append(path.read_bytes())
    assert files[0] == files[1]
