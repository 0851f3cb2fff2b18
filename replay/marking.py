"""Annotations that a run makes of its own results, as its outputs declare them."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ..algorithms.contract import Annotate, IntArray, Output
from .blocks import Columns

NO_ANNOTATIONS = pl.DataFrame(
    schema={
        "tier": pl.String,
        "start_ns": pl.Int64,
        "end_ns": pl.Int64,
        "label": pl.String,
        "metadata": pl.String,
    }
)


TEXT_ROWS = 16384
"""Rows whose texts are made together: a day has a hundred thousand steps, and texts take much memory."""


@dataclass
class _Stretch:
    """The stretch of a state that is open."""

    since: int | None = None
    until: int = 0


class Marker:
    """Collects the annotations of one output.

    Parameters
    ----------
    run : str
        Id of the run, first part of the tier.
    output : Output
        One with ``annotate``.
    """

    def __init__(self, run: str, output: Output) -> None:
        assert output.annotate is not None
        self.how: Annotate = output.annotate
        self.tier = f"{run}/{self.how.tier}"
        self._open = _Stretch()
        self._stretches: list[IntArray] = []  # from, to
        self._rows: list[Columns] = []

    def snapshot(self) -> Any:
        """Return a copy of what later annotations depend on."""
        return copy.copy(self._open), len(self._stretches), len(self._rows)

    def restore(self, snapshot: Any) -> None:
        """Go back to ``snapshot``."""
        self._open = copy.copy(snapshot[0])
        del self._stretches[snapshot[1] :], self._rows[snapshot[2] :]

    def take(self, rows: Columns) -> None:
        """Note the rows of a block."""
        if self.how.kind == "state":
            self._note_state(rows["t_ns"], np.asarray(rows[self.how.column], bool))
        else:
            self._rows.append(rows)

    def close(self) -> None:
        """End the open stretch: the run starts anew or is over."""
        if self._open.since is not None:
            self._stretches.append(np.array([[self._open.since, self._open.until]]))
            self._open.since = None

    def _note_state(self, t_ns: IntArray, active: NDArray[np.bool_]) -> None:
        """Join true rows to intervals: first to last such row."""
        edges = np.flatnonzero(np.diff(active, prepend=self._open.since is not None))
        begins, after = edges[active[edges]], edges[~active[edges]]
        since, until = t_ns[begins], t_ns[after - 1]
        if self._open.since is not None:
            since = np.append(np.int64(self._open.since), since)
        if len(after) and after[0] == 0:
            until[0] = self._open.until
        self._stretches.append(np.column_stack((since[: len(until)], until)))
        self._open.since = int(since[-1]) if len(since) > len(until) else None
        self._open.until = int(t_ns[-1])

    def table(self) -> pl.DataFrame:
        """Return ``tier, start_ns, end_ns, label, metadata``."""
        if self.how.kind == "state":
            bounds = np.concatenate([np.empty((0, 2), np.int64), *self._stretches])
            return pl.DataFrame({"start_ns": bounds[:, 0], "end_ns": bounds[:, 1]}).select(
                pl.lit(self.tier).alias("tier"),
                "start_ns",
                "end_ns",
                pl.lit(self.how.label or self.how.tier).alias("label"),
                pl.lit("{}").alias("metadata"),
            )
        if not self._rows:
            return NO_ANNOTATIONS
        rows = pl.DataFrame({name: np.concatenate([r[name] for r in self._rows]) for name in self._rows[0]})
        if self.how.kind == "instant":
            rows = rows.with_columns(pl.col("t_ns").alias("start_ns"), pl.col("t_ns").alias("end_ns"))
        label = self.how.label or self.how.tier
        return pl.concat([_row_annotations(r, self.tier, label) for r in rows.iter_slices(TEXT_ROWS)])


def _row_annotations(rows: pl.DataFrame, tier: str, label: str) -> pl.DataFrame:
    """Return rows as annotations; their other values, numbers rounded to six digits, are the metadata (JSON)."""
    about = sorted(c for c in rows.columns if c not in ("t_ns", "t_log_ns", "start_ns", "end_ns"))
    texts = [pl.Series(c, [_text(v) for v in rows[c].to_list()], dtype=pl.String) for c in about]
    template = "{{" + ", ".join(f'"{c}": "{{}}"' for c in about) + "}}"
    named = [c for c in about if f"{{{c}}}" in label]
    parts = label
    for name in named:
        parts = parts.replace(f"{{{name}}}", "{}", 1)
    return rows.select(
        pl.lit(tier).alias("tier"),
        "start_ns",
        "end_ns",
        (pl.format(parts, *named) if named else pl.lit(label)).alias("label"),
        (pl.format(template, *texts) if about else pl.lit("{}")).alias("metadata"),
    )


def _text(value: Any) -> str:
    return value.replace("\\", "\\\\").replace('"', '\\"') if isinstance(value, str) else f"{value:.6g}"
