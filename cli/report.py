"""``marcha report``: one page about a recording, or about those of a folder."""

from __future__ import annotations

from pathlib import Path

from .console import Heading, Outcome, progress
from .contents import say_losses
from .options import DEFAULT, Common, Force, Output, recordings


def report(
    *paths: Path,
    output: Output,
    by: str | None = None,
    no_picture: bool = False,
    force: Force = False,
    common: Common = DEFAULT,
) -> Outcome:
    """Write one HTML page about recordings: figures, errors, annotations, origin.

    Tracks, signals, angles, errors, annotations, parameters and provenance; the page needs no other file and
    no network. Where a graphics driver is there (software is enough), with a picture of the viewer.

    Parameters
    ----------
    paths : Path
        Recordings, or folders of recordings; several are compared in one page.
    output : Path
        The page (.html).
    by : str
        Tier whose labels are measured beside each other; every tier of few labels without it.
    no_picture : bool
        Take no picture of the viewer.
    force : bool
        Replace an existing file.
    """
    from .. import recording
    from ..viz.recording_page import write_page

    recs = [recording.open(path) for path in recordings(paths, "report")]
    with progress("report", common) as advance:
        write_page(recs, output, by=by, picture=not no_picture, overwrite=force, progress=advance)
    say_losses(*recs)
    document = {"paths": [str(r.path) for r in recs], "output": str(output)}
    return Outcome(document, [Heading(f"wrote {output}")])
