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
    recordings,
    settings,
)

if TYPE_CHECKING:
    from ..recording import Recording


def export(
    *paths: Path,
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

    Several recordings, or a folder of them, become one BIDS dataset (their
    names state the subjects: sub-01_task-walk.mcap), or a file each in a folder.

    Parameters
    ----------
    paths : Path
        Recordings, or folders of them.
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
    from ..recording.errors import UsageError

    recs = [recording.open(path) for path in recordings(paths, "export")]
    if len(recs) > 1 and (start or end):
        raise UsageError("export: --start and --end are times of one recording; give one")
    rec = recs[0]
    options: dict[str, Any] = dict(settings(option, "--set"))
    chosen = {
        "topics": topic,
        "start_ns": instant(start, rec, "--start"),
        "end_ns": instant(end, rec, "--end"),
    }
    options |= {key: value for key, value in chosen.items() if value not in (None, ())}
    if len(recs) > 1 or any(path.is_dir() for path in paths):
        return _hand_on_all(recs, to, output, options, force=force)
    return hand_on(rec, to, output, options, force=force)


def _hand_on_all(
    recs: list[Recording], to: str, output: Path, options: dict[str, Any], *, force: bool
) -> Outcome:
    """Export several, after saying what the format cannot hold of each."""
    from .. import export as ex

    missing = {str(rec.path): ex.losses(rec, to, options=options) for rec in recs}
    for name, losses in missing.items():
        for line in losses:
            complain(f"{name}: {to} does not hold: {line}")
    files = [str(file) for file in ex.export_all(recs, to, output, options=options, overwrite=force)]
    say_losses(*recs)
    document = {
        "paths": [str(rec.path) for rec in recs],
        "format": to,
        "output": str(output),
        "files": files,
        "not_held": missing,
    }
    return Outcome(document, [Heading(f"wrote {output} ({len(files)} files)")])


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
