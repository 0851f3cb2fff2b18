"""``marcha study``: recordings × estimators × parameters, with statistics and a report."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from .console import Heading, Outcome, progress
from .options import DEFAULT, Common, Force, Output


def study(
    config: str,
    /,
    *,
    output: Output,
    data: Path | None = None,
    scheduler: str | None = None,
    processes: Annotated[int | None, Parameter(name="--processes")] = None,
    force: Force = False,
    common: Common = DEFAULT,
) -> Outcome:
    """Compare estimators over many recordings, with statistics.

    Parameters
    ----------
    config : str
        TOML file of the study, or the name of a preset (foot-tables).
    output : Path
        Folder for results.parquet, results.csv, report.html and figures. Finished cells are not run again.
    data : Path
        Folder of the recordings or raw logs, where the configuration leaves it open.
    scheduler : str
        Address of a Dask scheduler; a process pool on this machine without it.
    processes : int
        Number of processes of the pool; one a core without it.
    force : bool
        Run finished cells again.
    """
    from ..replay.study import run_study

    with progress("study", common) as report:
        done = run_study(
            config,
            output,
            data=data,
            scheduler=scheduler,
            processes=processes,
            force=force,
            progress=report,
        )
    return Outcome(done.document, [Heading(line) for line in done.lines])
