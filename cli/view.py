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
    figure: Path | None = None,
    kind: str = "walk",
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
    figure : Path
        Write a figure (.png or .svg) instead of opening a viewer.
    kind : str
        Which figure: walk, signals, steps, detector, heading, fixes, transform, map, floor, radio, radiomap,
        ranges, powers, geometry, threshold, error, joints, cycles, jumps, transitions, attitude, cross, rmse,
        strides.
    force : bool
        Replace an existing file.
    """
    from .. import recording, viz
    from ..recording.errors import UsageError

    if not paths:
        raise UsageError("view: name at least one recording")
    if web and rrd is not None:
        raise UsageError("view: --web opens a viewer and --rrd writes a file; give one of them")
    if figure is not None and (web or rrd is not None):
        raise UsageError("view: --figure writes a figure; give it without --web and --rrd")
    recs = [recording.open(path) for path in paths]
    if figure is not None:
        viz.save_figure(recs, figure, kind=kind, overwrite=force)
    elif rrd is not None:
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
    document["figure"] = str(figure) if figure else None
    wrote = figure or rrd
    return Outcome(document, [Heading(f"wrote {wrote}")] if wrote else [])
