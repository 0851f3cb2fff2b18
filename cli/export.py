"""``marcha export``: a recording in another tool's format."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from .console import Heading, Outcome, complain
from .contents import say_losses
from .options import (
    DEFAULT,
    Common,
    Force,
    Output,
    Strings,
    instant,
    settings,
)

if TYPE_CHECKING:
    from ..recording import Recording


def export(
    path: Path,
    /,
    *,
    to: Annotated[str, Parameter(name=("--to", "-t"))],
    output: Output,
    topic: Annotated[Strings, Parameter(name="--topic")] = (),
    start: Annotated[str | None, Parameter(name="--start")] = None,
    end: Annotated[str | None, Parameter(name="--end")] = None,
    option: Annotated[Strings, Parameter(name="--set")] = (),
    force: Force = False,
    common: Common = DEFAULT,
) -> Outcome:
    """Write a recording, or part of it, in another tool's format.

    Parameters
    ----------
    path : Path
        The recording.
    to : str
        Format: mcap, csv, parquet, bids, gpx, eaf, rrd … (marcha formats lists them).
    output : Path
        File or folder to write, as the format wants it.
    topic : str
        Topic or pattern (/foot/*) to export; may be repeated. Everything without it.
    start : str
        From here on: 12.5, 12.5s, 1m, 500ms after the recording's start, or @NANOSECONDS of its clock.
    end : str
        Up to here, not included; written like --start.
    option : str
        key=value of the format; may be repeated.
    force : bool
        Replace an earlier export.
    """
    from .. import recording

    rec = recording.open(path)
    options: dict[str, Any] = dict(settings(option, "--set"))
    chosen = {
        "topics": topic,
        "start_ns": instant(start, rec, "--start"),
        "end_ns": instant(end, rec, "--end"),
    }
    options |= {key: value for key, value in chosen.items() if value not in (None, ())}
    return hand_on(rec, to, output, options, force=force)


def hand_on(rec: Recording, to: str, output: Path, options: dict[str, Any], *, force: bool) -> Outcome:
    """Export, after saying what the format cannot hold."""
    from .. import export as ex

    missing = ex.losses(rec, to, options=options)
    for line in missing:
        complain(f"{to} does not hold: {line}")
    files = [str(file) for file in ex.export(rec, to, output, options=options, overwrite=force)]
    say_losses(rec)
    document = {
        "path": str(rec.path),
        "format": to,
        "output": str(output),
        "files": files,
        "not_held": missing,
    }
    return Outcome(document, [Heading(f"wrote {file}") for file in files])
