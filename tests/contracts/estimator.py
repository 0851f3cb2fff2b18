"""The contract of every estimator: inherit it, say how to make yours and what rows it takes."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import pytest
from marcha.algorithms import AlgorithmError, describe, input_columns, make, output_columns


def results_of(estimator: Any, rows: np.ndarray) -> list[np.ndarray | None]:
    """Return what ``step`` answers for each row, then the flushed results."""
    return [estimator.step(row) for row in rows] + list(estimator.flush())


def equal(a: list[np.ndarray | None], b: list[np.ndarray | None]) -> bool:
    """Return whether both are the same to the bit (NaN equals NaN)."""
    return len(a) == len(b) and all(
        (x is None and y is None) or (x is not None and y is not None and x.tobytes() == y.tobytes())
        for x, y in zip(a, b, strict=True)
    )


class EstimatorContract:
    """Subclass as ``class TestMine(EstimatorContract)``; set ``name`` or override :meth:`make`, give rows.

    What it promises: declared columns, latency as declared, the same bits for the same rows however they are
    handed over (one by one, in blocks of any size, after a snapshot and a restore), and rows that are left
    as they were.
    """

    name: str = ""
    params: ClassVar[dict[str, Any]] = {}

    def make(self) -> Any:
        return make(self.name, **self.params)

    def rows(self) -> np.ndarray:
        """Return typical rows, shape (n, inputs), n at least 300."""
        raise NotImplementedError

    def test_names_are_there_and_unique(self) -> None:
        estimator = self.make()
        assert estimator.name
        assert estimator.inputs
        assert not estimator.inputs[0].optional
        columns = output_columns(estimator)
        assert len(set(columns)) == len(columns) > 0

    def test_rows_fit_the_inputs(self) -> None:
        assert self.rows().shape[1] == len(input_columns(self.make()))

    def test_every_parameter_says_what_it_does(self) -> None:
        for parameter in describe(type(self.make()).Params):
            assert parameter.effect, parameter.name
            assert parameter.default is not None, parameter.name

    def test_every_preset_builds(self) -> None:
        cls = type(self.make())
        for preset in cls.presets:
            assert cls(cls.Params(**cls.presets[preset])).outputs

    def test_unknown_parameter_is_one_line(self) -> None:
        if not self.name:
            pytest.skip("not registered")
        with pytest.raises(AlgorithmError, match="no parameter 'no_such_thing'") as error:
            make(self.name, no_such_thing=1)
        assert "\n" not in str(error.value)

    def test_results_lag_by_the_latency(self) -> None:
        estimator, rows = self.make(), self.rows()
        width = len(output_columns(estimator))
        results = [estimator.step(row) for row in rows]
        assert all(r is None for r in results[: estimator.latency])
        given = [r for r in results if r is not None]
        assert all(r.shape == (width,) and r.dtype == np.float64 for r in given)
        assert np.isfinite(np.concatenate(given)).any()
        rest = estimator.flush()
        assert rest.shape == (estimator.latency, width)
        assert len(estimator.flush()) == 0

    def test_flush_after_fewer_rows_than_the_latency(self) -> None:
        estimator = self.make()
        few = self.rows()[: max(0, estimator.latency - 1)]
        assert all(estimator.step(row) is None for row in few)
        assert len(estimator.flush()) == len(few)

    def test_rows_are_not_changed(self) -> None:
        rows = self.rows()
        before = rows.copy()
        results_of(self.make(), rows)
        assert rows.tobytes() == before.tobytes()

    def test_results_do_not_share_memory(self) -> None:
        estimator = self.make()
        results = [r for r in (estimator.step(row) for row in self.rows()) if r is not None]
        assert not any(np.shares_memory(results[-1], r) for r in results[-20:-1])

    def test_two_of_a_kind_give_the_same_bits(self) -> None:
        rows = self.rows()
        first, second = self.make(), self.make()
        a = [first.step(row) for row in rows]
        b = [second.step(row) for row in rows]
        assert equal(a, b)

    def test_interrupted_run_equals_uninterrupted(self) -> None:
        rows = self.rows()
        whole = results_of(self.make(), rows)
        for at in (1, len(rows) // 3, len(rows) - 1):
            one = self.make()
            head = [one.step(row) for row in rows[:at]]
            kept = one.snapshot()
            results_of(one, rows[at : at + 50])  # goes astray
            one.restore(kept)
            assert equal(head + results_of(one, rows[at:]), whole)
            other = self.make()  # another process: only the snapshot came along
            other.restore(kept)
            assert equal(results_of(other, rows[at:]), whole[at:])

    def test_blocks_of_any_size_equal_single_rows(self) -> None:
        estimator, rows = self.make(), self.rows()
        if not hasattr(estimator, "run_block"):
            pytest.skip("takes single rows only")
        width = len(output_columns(estimator))
        single = results_of(self.make(), rows)
        for size in (len(rows), 1, 7, 64):
            block, got = self.make(), np.full((len(rows), width), 7.0)
            count = sum(
                block.run_block(rows[i : i + size], got[i : i + size]) for i in range(0, len(rows), size)
            )
            assert count == sum(r is not None for r in single[: len(rows)])
            wanted = np.array([np.full(width, np.nan) if r is None else r for r in single[: len(rows)]])
            assert got.tobytes() == wanted.tobytes()
            assert block.flush().tobytes() == np.array(single[len(rows) :]).reshape(-1, width).tobytes()
