"""Sources, estimators and an oracle for the tests of the replay."""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import polars as pl
from marcha.algorithms import Input, Output, RowEstimator
from marcha.replay import Batch, Engine, PlannedChannel, ReplayResult, TableSink, plan_runs

IMU = "sensor_msgs/msg/Imu"
MAG = "sensor_msgs/msg/MagneticField"
VALUES = "marcha_msgs/msg/NamedValues"
ACC = ("acc_x", "acc_y", "acc_z")
STEP_NS = 10_000_000


def channel(topic: str, schema: str, columns: Sequence[str], **metadata: str) -> PlannedChannel:
    return PlannedChannel(topic, schema, "body", tuple(columns), metadata)


def table(
    t_ns: Sequence[int], columns: Mapping[str, Any], t_log_ns: Sequence[int] | None = None
) -> pl.DataFrame:
    times = {"t_ns": t_ns, "t_log_ns": t_ns if t_log_ns is None else t_log_ns}
    return pl.DataFrame(times | dict(columns), schema_overrides={"t_ns": pl.Int64, "t_log_ns": pl.Int64})


def imu_table(n: int, seed: int = 0, start_ns: int = 10**18) -> pl.DataFrame:
    rng = np.random.default_rng(seed)
    return table((start_ns + np.arange(n) * STEP_NS).tolist(), {c: rng.normal(size=n) for c in ACC})


class MemorySource:
    """Tables in memory, in batches of about ``max_rows`` messages that are disjoint in log time."""

    seekable = True
    name = "memory"
    metadata: Mapping[str, Mapping[str, str]] = {}
    attachments: Mapping[str, bytes] = {}
    static: Mapping[str, pl.DataFrame] = {}

    def __init__(self, pairs: Sequence[tuple[PlannedChannel, pl.DataFrame]], max_rows: int = 1000) -> None:
        self.channels = {c.topic: c for c, _ in pairs}
        self.tables = {c.topic: t for c, t in pairs}
        self.max_rows = max_rows
        logs = np.sort(np.concatenate([t["t_log_ns"].to_numpy() for t in self.tables.values()]))
        self.start_ns, self.end_ns = (int(logs[0]), int(logs[-1])) if logs.size else (0, 0)
        self.batches_read = 0

    def rate_hz(self, topic: str) -> float:
        return 1e9 / STEP_NS

    def batches(
        self, topics: Sequence[str], start_ns: int | None = None, end_ns: int | None = None
    ) -> Iterator[Batch]:
        low = self.start_ns if start_ns is None else start_ns
        high = self.end_ns + 1 if end_ns is None else end_ns
        tables = {
            t: self.tables[t].filter((pl.col("t_log_ns") >= low) & (pl.col("t_log_ns") < high))
            for t in self.channels
            if t in topics
        }
        logs = np.sort(np.concatenate([t["t_log_ns"].to_numpy() for t in tables.values()]))
        cuts = [low, *sorted({int(x) for x in logs[self.max_rows :: self.max_rows]}), high]
        for a, b in pairwise(cuts):
            part = {
                t: v.filter((pl.col("t_log_ns") >= a) & (pl.col("t_log_ns") < b)) for t, v in tables.items()
            }
            part = {t: v for t, v in part.items() if v.height}
            if part:
                self.batches_read += 1
                yield Batch(b, part)


class Echo(RowEstimator):
    """Says exactly what it was fed."""

    name = "echo"

    def __init__(self, columns: Sequence[str] = ACC, further: Sequence[Input] = ()) -> None:
        super().__init__()
        self.inputs = (Input("imu", IMU, tuple(columns)), *further)
        names = ("dt_s", *columns, *(c for i in further for c in i.columns))
        self.outputs = (Output("row", VALUES, names),)

    def step(self, row: np.ndarray) -> np.ndarray:
        return row.copy()


class Smoother(RowEstimator):
    """Recursive: its bits depend on every row and their order. Late by ``latency`` rows; takes blocks too."""

    name = "smoother"

    def __init__(self, latency: int = 0) -> None:
        super().__init__()
        self.latency = latency
        self.inputs = (Input("imu", IMU, ACC),)
        self.outputs = (
            Output("state", VALUES, ("x", "y", "z")),
            Output("peak", VALUES, ("value", "dt"), event=True),
        )
        self.x = np.zeros(3)
        self.waiting: list[np.ndarray] = []
        self.blocks = 0

    def _update(self, row: np.ndarray) -> np.ndarray:
        self.x = self.x * 0.9 + np.sin(row[1:]) * (row[0] + 0.1) / 3.0
        peak = (self.x[0], row[0]) if row[1] > 1.5 else (np.nan, np.nan)
        return np.concatenate((self.x, peak))

    def step(self, row: np.ndarray) -> np.ndarray | None:
        self.waiting.append(self._update(row))
        return self.waiting.pop(0) if len(self.waiting) > self.latency else None

    def run_block(self, rows: np.ndarray, out: np.ndarray) -> int:
        self.blocks += 1
        results = [self.step(row) for row in rows]
        for i, result in enumerate(results):
            out[i] = np.nan if result is None else result
        return sum(r is not None for r in results)

    def flush(self) -> np.ndarray:
        last, self.waiting = self.waiting, []
        return np.array(last).reshape(-1, 5)


def engine_of(
    source: Any, estimators: Sequence[Any], sinks: Sequence[Any] = (), **options: Any
) -> tuple[Engine, TableSink]:
    tables = TableSink()
    return Engine(source, plan_runs(source, estimators), sinks=(tables, *sinks), **options), tables


def run_all(
    source: Any, estimators: Sequence[Any], **options: Any
) -> tuple[ReplayResult, dict[str, pl.DataFrame]]:
    engine, tables = engine_of(source, estimators, **options)
    engine.play()
    result = engine.finish()
    return result, results_of(result, tables)


def results_of(result: ReplayResult, tables: TableSink) -> dict[str, pl.DataFrame]:
    found = {topic: tables.table(topic) for run in result.runs for topic in run.outputs.values()}
    return {topic: t for topic, t in found.items() if t is not None}


def same_bits(a: Mapping[str, pl.DataFrame], b: Mapping[str, pl.DataFrame]) -> bool:
    """Equal to the last bit, NaN for NaN."""
    if a.keys() != b.keys():
        return False
    return all(
        a[k].columns == b[k].columns
        and all(a[k][c].to_numpy().tobytes() == b[k][c].to_numpy().tobytes() for c in a[k].columns)
        for k in a
    )


def oracle_rows(
    tables: Mapping[str, pl.DataFrame], columns: Mapping[str, Sequence[str]], primary: str
) -> tuple[list[tuple[int, int, list[float]]], dict[str, int]]:
    """Build the rows as the contract says, message by message in plain Python.

    Returns (t_ns, t_log_ns, row) of every row, and how often each thing happened.
    """
    order = {topic: i for i, topic in enumerate(tables)}
    streams = [
        [
            (log, order[topic], i, t, topic, values)
            for i, (t, log, *values) in enumerate(
                tables[topic].select("t_ns", "t_log_ns", *columns[topic]).iter_rows()
            )
        ]
        for topic in tables
    ]
    further = [t for t in tables if t != primary]
    news: dict[str, list[float] | None] = dict.fromkeys(further)
    counts = {"missing_value": 0, "duplicate_time": 0, "backwards_time": 0, "superseded": 0}
    rows: list[tuple[int, int, list[float]]] = []
    last: int | None = None
    for log, _, _, t_ns, topic, values in heapq.merge(*streams):
        if topic != primary:
            if all(np.isnan(values)):
                continue
            counts["superseded"] += news[topic] is not None
            news[topic] = values
            continue
        if not np.isfinite(values).all():
            counts["missing_value"] += 1
        elif last is not None and t_ns == last:
            counts["duplicate_time"] += 1
        elif last is not None and t_ns < last:
            counts["backwards_time"] += 1
        else:
            row = [0.0 if last is None else (t_ns - last) / 1e9, *values]
            for other in further:
                row += news[other] or [np.nan] * len(columns[other])
                news[other] = None
            rows.append((t_ns, log, row))
            last = t_ns
    return rows, counts
