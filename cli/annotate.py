"""``marcha annotate add|import|list``: labelled intervals; a file is never changed in place."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import App, Parameter

from .console import (
    Heading,
    Outcome,
    Table,
    complain,
)
from .contents import say_losses
from .options import (
    DEFAULT,
    QUIET,
    Common,
    Force,
    MaybeOutput,
    Shown,
    Strings,
    instant,
    settings,
)

if TYPE_CHECKING:
    import polars as pl

    from ..recording import Recording

app = App(
    name="annotate",
    help="Add, import or list labelled intervals of a recording.",
    default_parameter=QUIET,
)

InPlace = Annotated[bool, Parameter(name="--in-place", negative="")]


@app.command
def add(
    path: Path,
    /,
    *,
    label: str,
    start: Annotated[str, Parameter(name="--from")],
    end: Annotated[str | None, Parameter(name="--to")] = None,
    tier: Annotated[str, Shown] = "manual",
    meta: Annotated[Strings, Parameter(name="--meta")] = (),
    output: MaybeOutput = None,
    in_place: InPlace = False,
    force: Force = False,
    common: Common = DEFAULT,
) -> Outcome:
    """Add one annotation.

    Parameters
    ----------
    path : Path
        The recording.
    label : str
        What happened.
    start : str
        When it began: 12.5, 12.5s, 1m, 500ms after the recording's start, or @NANOSECONDS of its clock.
    end : str
        When it ended; written like --from. The same moment without it.
    tier : str
        Kind of annotation; becomes /annotation/TIER.
    meta : str
        key=value of the annotation; may be repeated.
    output : Path
        New recording to write.
    in_place : bool
        Put the finished copy in the place of the recording.
    force : bool
        Replace an existing output.
    """
    import msgspec
    import polars as pl

    from .. import recording
    from ..export.events import ANNOTATIONS
    from ..recording.errors import UsageError

    rec = recording.open(path)
    start_ns = instant(start, rec, "--from")
    end_ns = start_ns if end is None else instant(end, rec, "--to")
    if start_ns is None or end_ns is None or start_ns < 0 or end_ns < start_ns:
        raise UsageError(
            f"annotate add: from {start} to {end} is not an interval; the end is not before the start"
        )
    metadata = msgspec.json.encode(settings(meta, "--meta")).decode()
    table = pl.DataFrame([[tier], [start_ns], [end_ns], [label], [metadata]], schema=ANNOTATIONS)
    return _write(rec, table, output, in_place=in_place, force=force)


@app.command(name="import")
def import_(
    path: Path,
    table: Path,
    /,
    *,
    tier: str | None = None,
    output: MaybeOutput = None,
    in_place: InPlace = False,
    force: Force = False,
    common: Common = DEFAULT,
) -> Outcome:
    """Add the annotations of a table: BIDS events.tsv, or any CSV or TSV with the same columns.

    Parameters
    ----------
    path : Path
        The recording.
    table : Path
        Columns onset, duration [s, from the recording's start] or start_ns, end_ns; trial_type or label;
        optionally tier and metadata.
    tier : str
        Tier of rows that name none; the table's file name without it.
    output : Path
        New recording to write.
    in_place : bool
        Put the finished copy in the place of the recording.
    force : bool
        Replace an existing output.
    """
    from .. import recording
    from ..export.events import read_events

    rec = recording.open(path)
    return _write(
        rec, read_events(table, rec.start_ns or 0, tier=tier), output, in_place=in_place, force=force
    )


@app.command(name="list")
def list_(
    path: Path, /, *, tier: Annotated[str | None, Parameter(name="--tier")] = None, common: Common = DEFAULT
) -> Outcome:
    """List annotations by time.

    Parameters
    ----------
    path : Path
        The recording.
    tier : str
        Only this tier.
    """
    from .. import recording
    from ..export.events import to_events

    rec = recording.open(path)
    events = to_events(rec.annotations, rec.start_ns or 0)
    say_losses(rec)
    if tier is not None:
        events = events.filter(tier=tier)
    rows = events.rows(named=True)
    table = Table(
        [">onset [s]", ">duration [s]", "tier", "label", "metadata"],
        [
            [f"{r['onset']:.3f}", f"{r['duration']:.3f}", r["tier"], r["trial_type"], r["metadata"]]
            for r in rows
        ],
    )
    return Outcome({"path": str(path), "annotations": rows}, [table] if rows else [Heading("no annotations")])


def _write(
    rec: Recording, table: pl.DataFrame, output: Path | None, *, in_place: bool, force: bool
) -> Outcome:
    import polars as pl

    from ..export.annotate import annotate
    from ..recording.errors import UsageError

    if in_place == (output is not None):
        raise UsageError("annotate: give either -o NEW.mcap or --in-place")
    target = rec.path if output is None else output
    total = annotate(rec, table, target, overwrite=force or in_place)
    say_losses(rec)
    first, last = rec.start_ns or 0, rec.end_ns or 0
    if outside := table.filter((pl.col("end_ns") < first) | (pl.col("start_ns") > last)).height:
        complain(
            f"warning: {outside} of {table.height} lie outside of the recording's {rec.duration_s:.1f} s"
        )
    document = {"output": str(target), "added": table.height, "annotations": total}
    return Outcome(document, [Heading(f"wrote {target}: {table.height} added, {total} annotations")])
