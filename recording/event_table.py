"""Annotations from tables of text: BIDS ``events.tsv`` and any other with the same columns."""

from __future__ import annotations

import io
from pathlib import Path

import msgspec
import polars as pl

from .annotations import COLUMNS as ANNOTATIONS
from .annotations import FIELDS
from .errors import MarchaError
from .files import read_small

_MOST_NS = 2**62


def read_events(path: Path, origin_ns: int, *, tier: str | None = None, offset_ns: int = 0) -> pl.DataFrame:
    """Read annotations from a table.

    Parameters
    ----------
    path : Path
        Tab- or comma-separated text with a header. Times are ``onset`` and ``duration`` in seconds since the
        start of the recording, or ``start_ns`` and ``end_ns``, which win where both are there. The label is
        ``trial_type`` or ``label``; ``tier``, ``metadata`` (JSON text), ``id``, ``source``, ``confidence``,
        ``note`` and ``channel`` are optional; other columns become metadata. ``n/a`` is an empty cell, and a
        duration that is not known is that of an instant.
    origin_ns : int
        Time that onsets count from.
    offset_ns : int
        Added to ``start_ns`` and ``end_ns``.
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
        start, end = (_numbers(path, cells, name, pl.Int64) + offset_ns for name in ("start_ns", "end_ns"))
    elif {"onset", "duration"} <= names:
        complete = cells.with_columns(pl.col("duration").fill_null("0"))
        onset, duration = (_numbers(path, complete, name, pl.Float64) for name in ("onset", "duration"))
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
            # this table as marcha writes it has a label in every row, so that n/a is one of them
            "label": cells[label].fill_null("n/a" if {"id", "start_ns"} <= names else ""),
            "metadata": _metadata(path, cells, label),
            **{
                name: cells[name] if name in names else pl.Series([None] * cells.height, dtype=pl.String)
                for name in FIELDS
                if name != "confidence"
            },
            "confidence": _confidence(path, cells),
        },
        schema_overrides=ANNOTATIONS,
    ).select(*ANNOTATIONS)
    _check(path, table)
    return table


def _metadata(path: Path, cells: pl.DataFrame, label: str) -> pl.Series:
    """Return the metadata of each row: the column of that name, and columns that have no other place."""
    places = {"onset", "duration", "tier", "start_ns", "end_ns", "metadata", label, *FIELDS}
    others = [name for name in cells.columns if name not in places]
    texts = (
        cells["metadata"].fill_null("{}").to_list() if "metadata" in cells.columns else ["{}"] * cells.height
    )
    if not others:
        return pl.Series(texts, dtype=pl.String)
    out = []
    for row, (text, values) in enumerate(zip(texts, cells.select(others).iter_rows(), strict=True)):
        try:
            facts = msgspec.json.decode(text, type=dict)
        except msgspec.MsgspecError:
            raise MarchaError(
                f"{path}: line {row + 2}: metadata {text[:60]!r} is not a JSON object; correct the cell"
            ) from None
        facts |= {k: v for k, v in zip(others, values, strict=True) if v is not None}
        out.append(msgspec.json.encode(facts).decode())
    return pl.Series(out, dtype=pl.String)


def _confidence(path: Path, cells: pl.DataFrame) -> pl.Series:
    if "confidence" not in cells.columns:
        return pl.Series([None] * cells.height, dtype=pl.Float64)
    texts = cells["confidence"]
    values = texts.str.strip_chars().cast(pl.Float64, strict=False)
    bad = (texts.is_not_null() & ~values.is_between(0.0, 1.0).fill_null(False)).arg_true()
    if bad.len():
        row = int(bad[0])
        raise MarchaError(
            f"{path}: line {row + 2}: confidence is {texts[row]!r}, not a number between 0 and 1; correct it"
        )
    return values


def _cells(path: Path) -> pl.DataFrame:
    data = read_small(path)
    if not data.strip():
        raise MarchaError(f"{path}: is empty; needs a header line and one row an annotation")
    try:
        data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        raise MarchaError(
            f"{path}: line {line}: byte 0x{data[error.start]:02x} is not UTF-8; save the table as UTF-8"
        ) from None
    separator = "\t" if b"\t" in data[:65536].splitlines()[0] else ","
    try:
        cells = pl.read_csv(
            io.BytesIO(data),
            separator=separator,
            infer_schema=False,
            null_values=["n/a"],
            encoding="utf8",
        ).rename(lambda name: name.strip().strip("\ufeff"))
        empty = [name for name in cells.columns if name not in ("trial_type", "label")]
        return cells.with_columns(pl.when(pl.col(name) != "").then(name) for name in empty)
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
