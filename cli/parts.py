"""``marcha cut``, ``marcha merge``, ``marcha anonymize``: recordings from recordings."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from .console import Heading, Outcome
from .contents import say_losses
from .options import DEFAULT, Common, Force, RecordingOutput, Strings, instant, span_ns


def cut(
    path: Path,
    /,
    *,
    output: RecordingOutput,
    start: Annotated[str | None, Parameter(name="--start")] = None,
    end: Annotated[str | None, Parameter(name="--end")] = None,
    annotation: Annotated[str | None, Parameter(name="--annotation")] = None,
    force: Force = False,
    common: Common = DEFAULT,
) -> Outcome:
    """Write a part of a recording: a range of time, or what an annotation marks.

    Parameters
    ----------
    path : Path
        The recording.
    output : Path
        New recording to write.
    start : str
        From here on: 12.5, 12.5s, 1m, 500ms after the recording's start, or @NANOSECONDS of its clock.
    end : str
        Up to here, not included; written like --start.
    annotation : str
        Id of an annotation (marcha annotate list), or its beginning.
    force : bool
        Replace an existing output.
    """
    from .. import recording
    from ..recording import parts
    from ..recording.changes import find
    from ..recording.errors import UsageError

    rec = recording.open(path)
    first, last = instant(start, rec, "--start"), instant(end, rec, "--end")
    if annotation is not None:
        if start is not None or end is not None:
            raise UsageError("cut: give either --annotation or --start and --end")
        (row,) = rec.annotations.filter(id=find(rec, [annotation])[0]).rows(named=True)
        first, last = row["start_ns"], row["end_ns"] + 1
    first = rec.start_ns if first is None else first
    last = rec.end_ns + 1 if last is None else last
    parts.cut(rec, output, first, last, overwrite=force)
    say_losses(rec)
    document = {"output": str(output), "start_ns": first, "end_ns": last}
    return Outcome(document, [Heading(f"wrote {output}: {(last - first) * 1e-9:.3f} s")])


def merge(
    *paths: Path,
    output: RecordingOutput,
    offset: Annotated[Strings, Parameter(name="--offset", allow_leading_hyphen=True)] = (),
    prefix: Annotated[Strings, Parameter(name="--prefix")] = (),
    force: Force = False,
    common: Common = DEFAULT,
) -> Outcome:
    """Join recordings into one, each with its offset in time.

    Parameters
    ----------
    paths : Path
        The recordings.
    output : Path
        New recording to write.
    offset : str
        Added to the times of a recording (1.5s, -20ms); once for each, in their order.
    prefix : str
        Put before the topics of a recording (/anna); once for each, in their order.
    force : bool
        Replace an existing output.
    """
    from .. import recording
    from ..recording import parts

    recs = [recording.open(p) for p in paths]
    offsets = [span_ns(text, "--offset") for text in offset] or None
    parts.merge(recs, output, offsets_ns=offsets, prefixes=list(prefix) or None, overwrite=force)
    for rec in recs:
        say_losses(rec)
    return Outcome(
        {"output": str(output), "recordings": [str(p) for p in paths]},
        [Heading(f"wrote {output}: {len(recs)} recordings")],
    )


def anonymize(
    path: Path,
    /,
    *,
    output: RecordingOutput,
    keep_fixes: Annotated[bool, Parameter(name="--keep-fixes", negative="")] = False,
    force: Force = False,
    common: Common = DEFAULT,
) -> Outcome:
    """Take names, serials, dates and fixes out of a recording, and list what is left.

    Parameters
    ----------
    path : Path
        The recording.
    output : Path
        New recording to write.
    keep_fixes : bool
        Leave fixes in.
    force : bool
        Replace an existing output.
    """
    from .. import recording
    from ..recording import parts

    rec = recording.open(path)
    done = parts.anonymize(rec, output, keep_fixes=keep_fixes, overwrite=force)
    say_losses(rec)
    lines = [Heading(f"wrote {output}"), *(Heading(f"removed: {x}") for x in done.removed)]
    lines += [Heading(f"left: {x}") for x in done.left]
    return Outcome({"output": str(output), "removed": done.removed, "left": done.left}, lines)
