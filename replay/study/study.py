"""Run a study: find the recordings, run the cells that are not there yet, write tables, figures and the report."""

from __future__ import annotations

import os
import platform
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any

import msgspec
import polars as pl

from ...recording import MarchaError, OutputExists, UsageError
from . import analysis, plan
from . import config as cfg
from .cells import Cell, Makers, cached, failed, run_task
from .executors import cores, execute
from .report import Material, render
from .store import CellStore, tidy, write_atomic

LIBRARIES = ("marcha", "numpy", "scipy", "numba", "polars", "matplotlib")


class StudyResult(msgspec.Struct, frozen=True):
    """What a study gave; the same tables are in its folder.

    Attributes
    ----------
    folder : Path
        The study's folder.
    config : StudyConfig
        The resolved configuration.
    results : polars.DataFrame
        One row a cell.
    values, groups, comparisons, outliers, published, consistency : polars.DataFrame
        See :mod:`marcha.replay.study.analysis`.
    cells_run, cells_reused, cells_failed : int
        Cells computed now; found finished; that ended in an error.
    elapsed_s : float
        Wall time.
    notes : list of str
        What a reader must know.
    files : list of Path
        Everything written.
    """

    folder: Path
    config: cfg.StudyConfig
    results: pl.DataFrame
    values: pl.DataFrame
    groups: pl.DataFrame
    comparisons: pl.DataFrame
    outliers: pl.DataFrame
    published: pl.DataFrame
    consistency: pl.DataFrame
    cells_run: int
    cells_reused: int
    cells_failed: int
    elapsed_s: float
    notes: list[str]
    files: list[Path]

    @property
    def document(self) -> dict[str, Any]:
        """The study as one JSON object."""
        rows = analysis.json_rows
        pooled = self.groups.filter((pl.col("filter") != "") & (pl.col("configuration") == ""))
        single = self.groups.filter((pl.col("filter") != "") & (pl.col("configuration") != ""))
        return {
            "output": str(self.folder),
            "title": self.config.title,
            "recordings": self.results["recording"].n_unique(),
            "cells": len(self.results),
            "cells_run": self.cells_run,
            "cells_reused": self.cells_reused,
            "cells_failed": self.cells_failed,
            "elapsed_s": self.elapsed_s,
            "notes": self.notes,
            "means": rows(single),
            "means_by_filter": rows(pooled),
            "published": rows(self.published),
            "comparisons": rows(self.comparisons),
            "outliers": rows(self.outliers),
            "consistency": rows(self.consistency),
            "files": [str(f.relative_to(self.folder)) for f in self.files],
        }

    @property
    def lines(self) -> list[str]:
        """A few lines for a terminal."""
        return [
            f"{self.folder}: {len(self.results)} cells of {self.results['recording'].n_unique()} recordings in "
            f"{self.elapsed_s:.1f} s ({self.cells_run} run, {self.cells_reused} reused, {self.cells_failed} failed)",
            *self.notes[:8],
            *([f"… {len(self.notes) - 8} more notes in the report"] if len(self.notes) > 8 else []),
            f"report: {self.folder / 'report.html'}",
        ]


def run_study(
    config: str | Path | cfg.StudyConfig,
    out_dir: str | Path,
    *,
    data: str | Path | Sequence[str | Path] | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    convert: Callable[..., Any] | None = None,
    simulate: Callable[..., Any] | None = None,
    overwrite: bool = False,
    resume: bool = False,
    progress: Callable[[float, float], None] | None = None,
) -> StudyResult:
    """Run every recording through every estimator and parameter set, and write what came out of it.

    Parameters
    ----------
    config : str, Path or StudyConfig
        TOML file, name of a preset, or the configuration itself.
    out_dir : str or Path
        Folder of the study: ``results.parquet`` and ``.csv`` (one row a cell), ``groups.csv``, ``comparisons.csv``,
        ``report.html``, ``figures/``, ``study.toml``, ``provenance.json``; ``cells/`` and ``recordings/`` hold
        what need not be computed again.
    data : path or paths, optional
        Folder (or files) of the recordings or raw logs; by default the folder of the TOML file.
    workers : int, optional
        Processes; one a core by default, 1 stays in this process. A script that uses more needs the usual
        ``if __name__ == "__main__":``.
    scheduler : str, optional
        Address of a Dask scheduler instead; its workers must see the data and ``out_dir`` under the same paths.
    convert, simulate : callable, optional
        :func:`marcha.ingest.convert` and :func:`marcha.ingest.simulate.simulate`, for studies of raw logs and of
        simulated walks. (This room imports no other that comes after it; the command line passes them.)
    overwrite : bool
        Start anew in a folder that holds a study.
    resume : bool
        Go on in a folder that holds a study with another configuration, keeping the cells that both share. With the same
        configuration finished cells are kept anyway.
    progress : callable, optional
        Called with (done, total) cells.

    Raises
    ------
    UsageError
        For a configuration, data folder or scheduler that cannot be used.
    OutputExists
        Where ``out_dir`` holds something else.
    KeyboardInterrupt
        After the running tasks have ended; finished cells stay.
    """
    begin = time.perf_counter()
    started = datetime.now(UTC)
    config, base = cfg.load(config)
    roots = [Path(p) for p in ([data] if isinstance(data, str | Path) else data or ([base] if base else []))]
    folder = Path(out_dir)
    toml = msgspec.toml.encode(_plain(config)).decode()
    methods = cfg.methods(config)
    code = plan.code_digest(m.estimator for m in methods)
    plan.check_methods(methods)
    sources, notes = plan.find_sources(config, (roots[0] if len(roots) == 1 else roots) or None, code)
    _claim(folder, toml, overwrite=overwrite, resume=resume)

    store = CellStore(folder / "cells")
    finished = store.load()
    processes = 1 if workers == 1 else (workers or cores())
    todo = plan.tasks(config, sources, finished, folder / "recordings", processes)
    wanted = [(source, job) for source in sources for job in plan.jobs(config, source)]
    total, done = len(wanted), len(wanted) - sum(len(t.jobs) for t in todo)
    reused = {job.key for _, job in wanted} & finished.keys()
    if progress:
        progress(done, total)
    if scheduler is not None:
        todo = [msgspec.structs.replace(t, folder=str(Path(t.folder).resolve())) for t in todo]
    function = partial(run_task, Makers(convert, simulate))
    for task, outcome in execute(function, todo, workers=workers, scheduler=scheduler):
        cells = failed(task, outcome) if isinstance(outcome, Exception) else outcome
        store.add(task.name, cells)
        for cell in cells:
            finished[cell.key] = [*finished.get(cell.key, []), cell]
        done += len(task.jobs)
        if progress:
            progress(done, total)

    cells = [_placed(cell, source, config) for source, job in wanted for cell in finished.get(job.key, [])]
    _forget_old_recordings(folder / "recordings", sources)
    run = sum(c.key not in reused for c in cells)
    return _write(
        folder, config, toml, cells, notes, run, started, begin, code, workers=workers, scheduler=scheduler
    )


def _plain(config: cfg.StudyConfig) -> Any:
    """Return the configuration as TOML can hold it: None is left out."""

    def clean(value: Any) -> Any:
        if isinstance(value, dict):
            return {k: clean(v) for k, v in value.items() if v is not None}
        return [clean(v) for v in value] if isinstance(value, list | tuple) else value

    return clean(msgspec.to_builtins(config))


def _claim(folder: Path, toml: str, *, overwrite: bool, resume: bool) -> None:
    """Make the folder the study's own, or refuse."""
    known = folder / "study.toml"
    if folder.exists() and not folder.is_dir():
        raise OutputExists(folder)
    if folder.is_dir() and any(folder.iterdir()):
        if not known.is_file():
            raise UsageError(f"{folder}: is not empty and holds no study; give another folder")
        if overwrite:
            for part in ("cells", "recordings", "figures"):
                shutil.rmtree(folder / part, ignore_errors=True)
        elif not resume and known.read_text(encoding="utf-8") != toml:
            raise UsageError(
                f"{folder}: holds a study with another configuration; give another folder, --resume to go on with this one "
                "(cells that both share are kept), or --force to start anew"
            )
    write_atomic(known, lambda path: path.write_text(toml, encoding="utf-8"))


def _placed(cell: Cell, source: plan.Source, config: cfg.StudyConfig) -> Cell:
    label = source.configuration or cfg.configuration(config, Path(source.path).name, cell.input)
    return msgspec.structs.replace(cell, configuration=label)


def _forget_old_recordings(folder: Path, sources: Sequence[plan.Source]) -> None:
    """Remove converted recordings that no source of this study needs any more."""
    needed = {cached(s, folder).name for s in sources}
    for path in folder.glob("*.mcap") if folder.is_dir() else ():
        if path.name not in needed:
            path.unlink()


def _write(
    folder: Path,
    config: cfg.StudyConfig,
    toml: str,
    cells: list[Cell],
    notes: list[str],
    run: int,
    started: datetime,
    begin: float,
    code: str,
    *,
    workers: int | None,
    scheduler: str | None,
) -> StudyResult:
    from .figures import draw_all

    results = tidy(cells)
    values = analysis.values(results, config)
    groups = analysis.groups(values, config)
    consistency = analysis.consistency(results, config)
    comparisons = analysis.comparisons(values, config)
    outliers = analysis.outliers(values)
    published = analysis.beside_published(groups, config)
    notes = [*notes, *analysis.remarks(cells, config)]
    pictures, drawn = draw_all(folder / "figures", values, cells, consistency, config)
    provenance = {
        "started (UTC)": started.isoformat(timespec="seconds"),
        "cells computed now": run,
        "cells reused": len(cells) - run,
        "executor": scheduler or f"{workers or cores()} processes",
        "code hash": code,
        "Python": platform.python_version(),
        "system": f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores",
        **{name: metadata.version(name) for name in LIBRARIES},
    }
    page = render(
        Material(
            config=config,
            results=results,
            values=values,
            groups=groups,
            comparisons=comparisons,
            outliers=outliers,
            published=published,
            consistency=consistency,
            pictures=pictures,
            notes=notes,
            provenance=provenance,
            toml=toml,
        )
    )
    writers: Mapping[str, Callable[[Path], object]] = {
        "results.parquet": results.write_parquet,
        "results.csv": results.write_csv,
        "groups.csv": groups.write_csv,
        "comparisons.csv": comparisons.write_csv,
        "outliers.csv": outliers.write_csv,
        "provenance.json": lambda path: path.write_bytes(
            msgspec.json.format(msgspec.json.encode(provenance))
        ),
        "report.html": lambda path: path.write_text(page, encoding="utf-8"),
    }
    for name, write in writers.items():
        try:
            write_atomic(folder / name, write)
        except OSError as error:
            raise MarchaError(f"{folder / name}: cannot be written: {error.strerror or error}") from None
    return StudyResult(
        folder=folder,
        config=config,
        results=results,
        values=values,
        groups=groups,
        comparisons=comparisons,
        outliers=outliers,
        published=published,
        consistency=consistency,
        cells_run=run,
        cells_reused=len(cells) - run,
        cells_failed=sum(c.status != "ok" for c in cells),
        elapsed_s=time.perf_counter() - begin,
        notes=notes,
        files=[*(folder / name for name in ("study.toml", *writers)), *drawn],
    )
