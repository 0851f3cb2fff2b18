"""The contract of every estimator: inherit it, say how to make yours and what messages or rows it takes.

:class:`EstimatorContract` is for estimators that take messages, :class:`RowEstimatorContract` for those that
take rows.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, ClassVar

import numpy as np
import polars as pl
import pytest
from marcha.algorithms import (
    ALL_COLUMNS,
    AlgorithmError,
    ChannelInfo,
    Context,
    KernelEstimator,
    Message,
    Result,
    describe,
    input_columns,
    make,
    output_columns,
)
from marcha.algorithms.contract import TIMES

Tables = Mapping[str, Mapping[str, pl.DataFrame]]
"""``{input name: {topic: table}}``; a table has ``t_ns``, the input's columns, and ``t_log_ns`` where it differs."""


def context_of(estimator: Any, tables: Tables) -> Context:
    """Return the context of these channels; their rates are the medians of their intervals."""
    channels: dict[str, tuple[ChannelInfo, ...]] = {}
    for need in estimator.inputs:
        found = []
        for topic, table in tables.get(need.name, {}).items():
            columns = tuple(c for c in table.columns if c not in TIMES)
            steps = np.diff(table["t_ns"].to_numpy())
            rate = 1e9 / float(np.median(steps)) if steps.size and np.median(steps) > 0 else 0.0
            wanted = columns if need.columns == ALL_COLUMNS else need.columns
            found.append(ChannelInfo(topic, need.schema, "", wanted, rate))
        channels[need.name] = tuple(found)
    return Context(channels)


def messages_of(estimator: Any, tables: Tables) -> list[Message]:
    """Return the messages of all tables by log time; ties by the order of inputs and channels."""
    found: list[Message] = []
    for need in estimator.inputs:
        for topic, table in tables.get(need.name, {}).items():
            columns = [c for c in table.columns if c not in TIMES]
            wanted = columns if need.columns == ALL_COLUMNS else list(need.columns)
            logs = table["t_log_ns" if "t_log_ns" in table.columns else "t_ns"].to_list()
            rows = table.select(wanted).rows()
            for t_ns, log_ns, values in zip(table["t_ns"].to_list(), logs, rows, strict=True):
                found.append(Message(need.name, t_ns, values, log_ns, topic))
    return sorted(found, key=lambda m: m.log_ns)


def taken(estimator: Any, message: Message) -> list[Result]:
    """Return what an estimator answers to one message."""
    results: Iterable[Result] = estimator.take(message) or ()
    return list(results)


def ended_by(estimator: Any) -> list[Result]:
    """Return what an estimator still holds."""
    results: Iterable[Result] = estimator.finish() or ()
    return list(results)


class DeclarationContract:
    """What every estimator says about itself."""

    name: str = ""
    params: ClassVar[dict[str, Any]] = {}

    def make(self) -> Any:
        return make(self.name, **self.params)

    def test_names_are_there_and_unique(self) -> None:
        estimator = self.make()
        assert estimator.name
        assert estimator.inputs
        assert len({i.name for i in estimator.inputs}) == len(estimator.inputs)
        if all(i.optional for i in estimator.inputs):  # then one of them must be there all the same
            with pytest.raises(AlgorithmError):
                estimator.start(Context())

    def test_every_parameter_says_what_it_does(self) -> None:
        for parameter in describe(type(self.make()).Params):
            assert parameter.effect, parameter.name
            assert parameter.default is not None, parameter.name

    def test_every_preset_builds(self) -> None:
        cls = type(self.make())
        for preset in cls.presets:
            assert cls(cls.Params(**cls.presets[preset])).inputs

    def test_unknown_parameter_is_one_line(self) -> None:
        if not self.name:
            pytest.skip("not registered")
        with pytest.raises(AlgorithmError, match="no parameter 'no_such_thing'") as error:
            make(self.name, no_such_thing=1)
        assert "\n" not in str(error.value)


class EstimatorContract(DeclarationContract):
    """Subclass as ``class TestMine(EstimatorContract)``; set ``name`` or override :meth:`make`, give tables.

    What it promises: results of declared outputs only, each with all its columns and none from the future; the
    same results for the same messages whether it was interrupted (snapshot, restore) or not, and, for a kernel,
    however the messages are cut into blocks; tables that are left as they were; remarks that can be read at any
    time, also before the first message.
    """

    def tables(self) -> Tables:
        """Return typical messages by input and topic."""
        raise NotImplementedError

    def context(self, estimator: Any) -> Context:
        """Return what the estimator is told before the first message."""
        return context_of(estimator, self.tables())

    def started(self) -> Any:
        """Return a fresh estimator that has seen its context."""
        estimator = self.make()
        estimator.start(self.context(estimator))
        return estimator

    def test_outputs_are_declared_after_the_start(self) -> None:
        estimator = self.started()
        names = [o.name for o in estimator.outputs]
        assert names
        assert len(set(names)) == len(names)
        for output in estimator.outputs:
            assert len(set(output.columns)) == len(output.columns) > 0

    def test_results_are_as_declared_and_not_from_the_future(self) -> None:
        estimator = self.started()
        declared = {o.name: len(o.columns) for o in estimator.outputs}
        count = 0
        for message in messages_of(estimator, self.tables()):
            for result in estimator.take(message) or ():
                assert isinstance(result, Result)
                assert len(result.values) == declared[result.output]
                assert result.t_ns <= max(message.t_ns, message.log_ns)
                count += 1
        count += sum(1 for _ in estimator.finish() or ())
        assert count > 0

    def test_an_interrupted_run_equals_an_uninterrupted_one(self) -> None:
        whole = self.started()
        messages = messages_of(whole, self.tables())
        expected = [taken(whole, m) for m in messages]
        ended = ended_by(whole)
        for at in (0, 1, len(messages) // 3, len(messages) - 1):
            one = self.started()
            head = [taken(one, m) for m in messages[:at]]
            kept = one.snapshot()
            for m in messages[at : at + 50]:  # goes astray
                taken(one, m)
            one.restore(kept)
            assert _same(head + [taken(one, m) for m in messages[at:]], expected)
            assert _same([ended_by(one)], [ended])
            other = self.started()
            other.restore(kept)
            assert _same([taken(other, m) for m in messages[at:]], expected[at:])

    def test_blocks_of_any_size_equal_single_messages(self) -> None:
        estimator = self.started()
        if not isinstance(estimator, KernelEstimator):
            pytest.skip("takes single messages only")
        messages = messages_of(estimator, self.tables())
        expected = [taken(estimator, m) for m in messages]
        inputs = np.array([[i.name for i in estimator.inputs].index(m.input) for m in messages])
        channels = np.array(
            [estimator.channel_index(int(i), m.channel) for i, m in zip(inputs, messages, strict=True)]
        )
        t_ns = np.array([m.t_ns for m in messages], np.int64)
        values = _encoded(estimator, self.context(estimator), inputs, channels, messages)
        for size in (1, 7, len(messages)):
            block, got = self.started(), []
            for a in range(0, len(messages), size):
                b = min(a + size, len(messages))
                capacity = (b - a) * block.max_results
                whose, when = np.empty(capacity, np.int64), np.empty(capacity, np.int64)
                out = np.empty((capacity, block.width))
                n = int(
                    block.run(
                        block.state, inputs[a:b], channels[a:b], t_ns[a:b], values[a:b], whose, when, out
                    )
                )
                assert (np.diff(whose[:n]) >= 0).all()
                got += block.results(when[:n], out[:n])
            assert _same([got], [[r for results in expected for r in results]])

    def test_tables_are_not_changed(self) -> None:
        estimator, tables = self.started(), self.tables()
        before = {i: {t: v.clone() for t, v in by.items()} for i, by in tables.items()}
        for message in messages_of(estimator, tables):
            taken(estimator, message)
        assert all(v.equals(before[i][t]) for i, by in tables.items() for t, v in by.items())

    def test_remarks_can_be_read_at_any_time(self) -> None:
        estimator = self.started()
        assert isinstance(estimator.remarks(), list)
        for message in messages_of(estimator, self.tables()):
            taken(estimator, message)
        assert isinstance(estimator.remarks(), list)


def _encoded(
    estimator: KernelEstimator, context: Context, inputs: Any, channels: Any, messages: list[Message]
) -> np.ndarray:
    rows = []
    for index, channel, message in zip(inputs.tolist(), channels.tolist(), messages, strict=True):
        columns = context.channels[message.input][channel].columns
        table = pl.DataFrame(
            {"t_ns": [message.t_ns], **{c: [v] for c, v in zip(columns, message.values, strict=True)}}
        )
        rows.append(estimator.encode(index, channel, table)[0])
    values = np.full((len(rows), max(len(r) for r in rows)), np.nan)
    for i, row in enumerate(rows):
        values[i, : len(row)] = row
    return values


def _same(a: list[list[Result]], b: list[list[Result]]) -> bool:
    """Return whether results are the same to the bit (NaN equals NaN)."""
    return len(a) == len(b) and all(
        len(x) == len(y)
        and all(
            p.output == q.output
            and p.t_ns == q.t_ns
            and all(u == v or (u != u and v != v) for u, v in zip(p.values, q.values, strict=True))
            for p, q in zip(x, y, strict=True)
        )
        for x, y in zip(a, b, strict=True)
    )


def results_of(estimator: Any, rows: np.ndarray) -> list[np.ndarray | None]:
    """Return what ``step`` answers for each row, then the flushed results."""
    return [estimator.step(row) for row in rows] + list(estimator.flush())


def equal(a: list[np.ndarray | None], b: list[np.ndarray | None]) -> bool:
    """Return whether both are the same to the bit (NaN equals NaN)."""
    return len(a) == len(b) and all(
        (x is None and y is None) or (x is not None and y is not None and x.tobytes() == y.tobytes())
        for x, y in zip(a, b, strict=True)
    )


class RowEstimatorContract(DeclarationContract):
    """Subclass as ``class TestMine(RowEstimatorContract)``; set ``name`` or override :meth:`make`, give rows.

    What it promises: declared columns, latency as declared, the same bits for the same rows however they are
    handed over (one by one, in blocks of any size, after a snapshot and a restore), and rows that are left
    as they were.
    """

    def rows(self) -> np.ndarray:
        """Return typical rows, shape (n, inputs), n at least 300."""
        raise NotImplementedError

    def test_columns_are_there_and_unique(self) -> None:
        columns = output_columns(self.make())
        assert len(set(columns)) == len(columns) > 0

    def test_rows_fit_the_inputs(self) -> None:
        assert self.rows().shape[1] == len(input_columns(self.make()))

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
