"""``marcha study``: recordings × estimators × parameters, with statistics and a report."""

from __future__ import annotations

from typing import Annotated

from cyclopts import Parameter

from .console import Heading, Outcome, progress
from .errors import DEFECTS, DONE
from .options import (
    DEFAULT,
    Common,
    Force,
    Output,
    Paths,
)


def study(
    config: str,
    /,
    *,
    output: Output,
    data: Annotated[Paths, Parameter(name="--data")] = (),
    workers: Annotated[int | None, Parameter(name="--workers")] = None,
    scheduler: str | None = None,
    resume: bool = False,
    force: Force = False,
    common: Common = DEFAULT,
) -> Outcome:
    """Compare estimators over many recordings, with statistics.

    Runs every recording through every estimator and parameter set. Finished
    cells are kept: the same study given again goes on where it was. Exit code
    3 says that some cells failed; the report names them.

    Parameters
    ----------
    config : str
        TOML file of the study, or the name of a preset (foot-tables).
    output : Path
        Folder for results.parquet, results.csv, report.html and figures/.
    data : Path
        Folder or file of recordings or raw logs; may be repeated. The folder of the TOML file without it.
    workers : int
        Processes on this machine; one a core without it.
    scheduler : str
        Address of a Dask scheduler that runs the study instead.
    resume : bool
        Go on in a folder that holds a study with another configuration, keeping the cells that both share.
    force : bool
        Start anew in a folder that holds a study.
    """
    from ..study import run_study

    with progress("study", common) as report:
        done = run_study(
            config,
            output,
            data=list(data) or None,
            workers=workers,
            scheduler=scheduler,
            overwrite=force,
            resume=resume,
            progress=report,
        )
    return Outcome(
        done.document, [Heading(line) for line in done.lines], DEFECTS if done.cells_failed else DONE
    )
