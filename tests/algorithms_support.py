"""What the tests of the algorithms share: simulated rows, whole runs, results by output name."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from marcha.algorithms import make, output_columns
from marcha.ingest import simulate as sim

FOOT = ("foot.naive", "foot.9iez", "foot.9iez-mad", "foot.9iez-kf", "foot.15iez-zaru", "foot.ukf")


def rows_of(t: np.ndarray, acc: np.ndarray, gyr: np.ndarray) -> np.ndarray:
    """Return estimator rows ``[dt, acc, gyr]``."""
    return np.column_stack([np.diff(t, prepend=t[0]), acc, gyr])


@cache
def _simulated(scenario: str, seed: int, sensor: Any, options: tuple) -> tuple[np.ndarray, Any]:
    walk = sim.walk(scenario, seed=seed, sensor=sensor, **dict(options))
    return rows_of(walk.t, *walk.measured()), walk


def simulated(
    scenario: str = "rectangle", seed: int = 1, sensor: int = 2, **options: Any
) -> tuple[np.ndarray, Any]:
    """Return rows and truth of a simulated walk; the rows are the caller's own."""
    rows, walk = _simulated(scenario, seed, sensor, tuple(sorted(options.items())))
    return rows.copy(), walk


def run(name: str, rows: np.ndarray, **params: Any) -> tuple[dict[str, np.ndarray], Any]:
    """Return one array a result column, aligned with the rows (latency taken out), and the estimator."""
    estimator: Any = make(name, **params)
    columns = output_columns(estimator)
    out = np.empty((len(rows), len(columns)))
    estimator.run_block(np.ascontiguousarray(rows), out)
    out = np.vstack([out[estimator.latency :], estimator.flush()])
    assert len(out) == len(rows)
    return {c: out[:, i] for i, c in enumerate(columns)}, estimator


def columns(result: dict[str, np.ndarray], output: str, *names: str) -> np.ndarray:
    """Return columns of one output side by side; all of them where no names are given."""
    chosen = [f"{output}.{n}" for n in names] or [c for c in result if c.startswith(f"{output}.")]
    return np.column_stack([result[c] for c in chosen])
