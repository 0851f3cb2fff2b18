"""``marcha view``: recordings in the Rerun viewer, or as a Rerun file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from .console import Heading, Outcome, complain
from .contents import say_losses
from .options import DEFAULT, Common, Force


def view(
    *paths: Path,
    web: bool = False,
    rrd: Annotated[Path | None, Parameter(name="--rrd")] = None,
    online: bool = False,
    force: Force = False,
    common: Common = DEFAULT,
) -> Outcome:
    """Show recordings on one time line in the Rerun viewer.

    Parameters
    ----------
    paths : Path
        One or more recordings; several are compared side by side.
    web : bool
        Serve the viewer for a web browser instead of opening a window.
    rrd : Path
        Write a Rerun file instead of opening a viewer.
    online : bool
        Let the viewer reach other hosts: tiles of maps, and Rerun's own reports of its use.
    force : bool
        Replace an existing Rerun file.
    """
    from .. import recording, viz
    from ..recording.errors import UsageError

    if not paths:
        raise UsageError("view: name at least one recording")
    if web and rrd is not None:
        raise UsageError("view: --web opens a viewer and --rrd writes a file; give one of them")
    recs = [recording.open(path) for path in paths]
    if rrd is not None:
        viz.write_rrd(recs, rrd, overwrite=force)
    else:
        viz.show(
            recs,
            web=web,
            online=online,
            opened=lambda window: complain(f"the viewer is at {window.address}"),
        )
    say_losses(*recs)
    document = {"paths": [str(p) for p in paths], "rrd": str(rrd) if rrd else None, "web": web}
    return Outcome(document, [Heading(f"wrote {rrd}")] if rrd else [])
