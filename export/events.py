"""Annotations as a BIDS events table (``events.tsv``), and back."""

from __future__ import annotations

from pathlib import Path

import polars as pl

from ..recording.errors import MarchaError

ANNOTATIONS = {
    "tier": pl.String,
    "start_ns": pl.Int64,
    "end_ns": pl.Int64,
    "label": pl.String,
    "metadata": pl.String,
}
"""Columns of an annotation table; ``metadata`` is JSON text."""

COLUMNS = {
    "onset": "s since the start of the recording",
    "duration": "s",
    "trial_type": "label of the annotation",
    "tier": "kind of annotation: who or what says so",
    "start_ns": "ns, clock of the recording",
    "end_ns": "ns, clock of the recording",
    "metadata": "JSON object of further facts",
}
"""Columns of ``events.tsv`` with their units."""

_MOST_NS = 2**62


def to_events(annotations: pl.DataFrame, origin_ns: int) -> pl.DataFrame:
    """Return annotations as BIDS events.

    Parameters
    ----------
    annotations : polars.DataFrame
        Columns of :data:`ANNOTATIONS`.
    origin_ns : int
        Time that onsets count from: the start of the recording.

    Returns
    -------
    polars.DataFrame
        Columns of :data:`COLUMNS`, by onset. Nanoseconds stay beside the seconds: nothing is rounded away.
    """
    return annotations.select(
        onset=((pl.col("start_ns") - origin_ns) / 1e9).round(9),
        duration=((pl.col("end_ns") - pl.col("start_ns")) / 1e9).round(9),
        trial_type=pl.col("label"),
        tier="tier",
        start_ns="start_ns",
        end_ns="end_ns",
        metadata="metadata",
    ).sort("start_ns", maintain_order=True)


def read_events(path: Path, origin_ns: int, *, tier: str | None = None) -> pl.DataFrame:
    """Read annotations from a table.

    Parameters
    ----------
    path : Path
        Tab- or comma-separated text with a header. Times are ``onset`` and ``duration`` in seconds since the
        start of the recording, or ``start_ns`` and ``end_ns``, which win where both are there. The label is
        ``trial_type`` or ``label``; ``tier`` and ``metadata`` (JSON text) are optional. ``n/a`` is an empty
        cell.
    origin_ns : int
        Time that onsets count from.
    tier : str, optional
        Tier of rows that name none; the file's name without suffix by default.

    Returns
    -------
    polars.DataFrame
        Columns of :data:`ANNOTATIONS`.

    Raises
    ------
    MarchaError
        A missing column, a cell that is no number, an end before its start: file, line, value, remedy.
    """
    cells = _cells(path)
    names = set(cells.columns)
    if {"start_ns", "end_ns"} <= names:
        start, end = (_numbers(path, cells, name, pl.Int64) for name in ("start_ns", "end_ns"))
    elif {"onset", "duration"} <= names:
        onset, duration = (_numbers(path, cells, name, pl.Float64) for name in ("onset", "duration"))
        start = origin_ns + _nanoseconds(path, onset)
        end = start + _nanoseconds(path, duration)
    else:
        raise MarchaError(
            f"{path}: line 1: has columns {', '.join(cells.columns)}; "
            "needs onset and duration in seconds, or start_ns and end_ns"
        )
    label = next((name for name in ("trial_type", "label") if name in names), None)
    if label is None:
        raise MarchaError(f"{path}: line 1: has no column trial_type or label; name what each row is")
    default = tier or path.name.split(".")[0]
    table = pl.DataFrame(
        {
            "tier": cells["tier"].fill_null(default)
            if "tier" in names
            else pl.Series([default] * cells.height),
            "start_ns": start,
            "end_ns": end,
            "label": cells[label].fill_null(""),
            "metadata": cells["metadata"].fill_null("{}")
            if "metadata" in names
            else pl.Series(["{}"] * cells.height),
        },
        schema=ANNOTATIONS,
    )
    _check(path, table)
    return table


def _cells(path: Path) -> pl.DataFrame:
    head = path.read_bytes()[:65536]
    if not head.strip():
        raise MarchaError(f"{path}: is empty; needs a header line and one row an annotation")
    separator = "\t" if b"\t" in head.splitlines()[0] else ","
    try:
        return pl.read_csv(
            path, separator=separator, infer_schema=False, null_values=["n/a", ""], encoding="utf8"
        ).rename(lambda name: name.strip().strip("\ufeff"))
    except pl.exceptions.PolarsError as error:
        reason = " ".join(str(error).split())[:200]
        raise MarchaError(f"{path}: is not a table of text: {reason}") from None


def _numbers(path: Path, cells: pl.DataFrame, name: str, dtype: type[pl.DataType]) -> pl.Series:
    column = cells[name].str.strip_chars()
    values = column.cast(dtype, strict=False)
    bad = (values.is_null() | ~values.cast(pl.Float64).is_finite()).arg_true()
    if bad.len():
        row = int(bad[0])
        kind = "a whole number" if dtype == pl.Int64 else "a number"
        raise MarchaError(f"{path}: line {row + 2}: {name} is {column[row]!r}, not {kind}; correct the cell")
    return values


def _nanoseconds(path: Path, seconds: pl.Series) -> pl.Series:
    scaled = seconds * 1e9
    far = (scaled.abs() > _MOST_NS).arg_true()
    if far.len():
        row = int(far[0])
        raise MarchaError(
            f"{path}: line {row + 2}: {seconds.name} {seconds[row]} s is beyond any clock; give seconds"
        )
    return scaled.round().cast(pl.Int64)


def _check(path: Path, table: pl.DataFrame) -> None:
    backwards = (table["end_ns"] < table["start_ns"]).arg_true()
    if backwards.len():
        row = int(backwards[0])
        raise MarchaError(
            f"{path}: line {row + 2}: ends at {table['end_ns'][row]} ns, before it starts at "
            f"{table['start_ns'][row]} ns; durations are not negative"
        )
    negative = (table["start_ns"] < 0).arg_true()
    if negative.len():
        row = int(negative[0])
        raise MarchaError(
            f"{path}: line {row + 2}: starts at {table['start_ns'][row]} ns; a recording has no time before 0"
        )
