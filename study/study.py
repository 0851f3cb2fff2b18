"""Run a study: find the recordings, run the missing cells, write tables, figures and the report."""

from __future__ import annotations

import hashlib
import os
import platform
import shutil
import time
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any

import msgspec
import polars as pl

from ..recording import MarchaError, OutputExists, UsageError
from ..recording.scratch import remove_left
from ..viz.page import PagePicture
from . import analysis, labels, pairs, plan
from . import config as cfg
from .cells import (
    StudyCell,
    cached,
    failed,
    run_task,
)
from .executors import Executor
from .gallery import draw
from .report import ReportContents, StudyTables, render
from .store import CellStore, tidy, write_atomic

LIBRARIES = ("marcha", "numpy", "scipy", "numba", "polars", "matplotlib")


class StudyResult(StudyTables, frozen=True, kw_only=True):
    """What a study gave; the same tables are in its folder.

    Attributes
    ----------
    folder : Path
        The study's folder.
    cells_run, cells_reused, cells_failed : int
        Cells computed now; found finished; that ended in an error.
    elapsed_s : float
        Wall time.
    files : list of Path
        Everything written.
    """

    folder: Path
    cells_run: int
    cells_reused: int
    cells_failed: int
    elapsed_s: float
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
            "label_comparisons": rows(self.label_comparisons),
            "failures": rows(self.failures),
            "paired": rows(self.paired),
            "verdicts": rows(self.verdicts),
            "relations": rows(self.relations),
            "files": [str(f.relative_to(self.folder)) for f in self.files],
        }

    @property
    def lines(self) -> list[str]:
        """A few lines for a terminal."""
        return [
            f"{self.folder}: {len(self.results)} cells of {self.results['recording'].n_unique()} recordings "
            "in "
            f"{self.elapsed_s:.1f} s ({self.cells_run} run, {self.cells_reused} reused, {self.cells_failed} "
            "failed)",
            *self.notes[:8],
            *([f"… {len(self.notes) - 8} more notes in the report"] if len(self.notes) > 8 else []),
            f"report: {self.folder / 'report.html'}",
        ]


RENDERED = "cells/rendered"
"""File that says of what the report was made, so that a finished study run again has nothing to do."""
LOADED = ("marcha.ingest", "marcha.ingest.simulate")
"""Modules that every process needs beside the estimators."""


def run_study(
    config: str | Path | cfg.StudyConfig,
    out_dir: str | Path,
    *,
    data: str | Path | Sequence[str | Path] | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
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
        Folder of the study: ``results.parquet`` and ``.csv`` (one row a cell), ``groups.csv``,
        ``comparisons.csv``, ``report.html``, ``figures/``, ``study.toml``, ``provenance.json``; ``cells/``
        and ``recordings/`` hold what need not be computed again.
    data : path or paths, optional
        Folder (or files) of the recordings or raw logs; by default the folder of the TOML file.
    workers : int, optional
        Processes; one a core by default, 1 stays in this process. A script that uses more needs the usual
        ``if __name__ == "__main__":``.
    scheduler : str, optional
        Address of a Dask scheduler instead; its workers must see the data and ``out_dir`` under the same
        paths.
    overwrite : bool
        Start anew in a folder that holds a study.
    resume : bool
        Go on in a folder that holds a study with another configuration, keeping the cells that both share.
        With the same configuration finished cells are kept anyway.
    progress : callable, optional
        Called with (done, total) cells.

    Raises
    ------
    UsageError
        For a configuration, data folder or scheduler that cannot be used.
    OutputExists
        Where ``out_dir`` holds something else.
    KeyboardInterrupt
        At once: running tasks are given up, finished cells stay.
    """
    begin = time.perf_counter()
    started = datetime.now(UTC)
    config, base = cfg.load(config)
    roots = [Path(p) for p in ([data] if isinstance(data, str | Path) else data or ([base] if base else []))]
    folder = Path(out_dir)
    toml = msgspec.toml.encode(_plain(config)).decode()
    with Executor(workers, scheduler) as executor:
        # First of all: the processes load what they need while this one looks for mistakes and recordings.
        if overwrite or not (folder / RENDERED).is_file():  # a finished study may need none
            executor.warm_up(LOADED, [e.name for e in config.estimators])
        methods = cfg.methods(config)
        code = plan.code_digest(m.estimator for m in methods)
        plan.check_methods(methods)
        sources, notes = plan.find_sources(config, (roots[0] if len(roots) == 1 else roots) or None, code)
        _take_folder(folder, toml, overwrite=overwrite, resume=resume)

        store = CellStore(folder / "cells")
        finished = store.load()
        wanted = [(source, job) for source in sources for job in plan.jobs(config, source)]
        reused = {job.key for _, job in wanted} & finished.keys()
        todo = plan.tasks(config, sources, reused, (folder / "recordings").resolve(), executor.processes)
        total, done = len(wanted), len(wanted) - sum(len(t.jobs) for t in todo)
        if progress:
            progress(done, total)
        from scipy import stats  # noqa: F401  # a second that passes here while the processes start

        for _ in executor.run(run_task, plan.preparations(todo)):
            pass  # what cannot be prepared fails again, and is recorded, in its own tasks
        for task, outcome in executor.run(run_task, todo):
            cells = failed(task, outcome) if isinstance(outcome, Exception) else outcome
            store.add(task.name, cells)
            for job in task.jobs:
                finished[job.key] = [cell for cell in cells if cell.key == job.key]
            done += len(task.jobs)
            if progress:
                progress(done, total)
        cells = [
            _with_configuration(cell, source, config) for source, job in wanted for cell in finished[job.key]
        ]
        _forget_old_recordings(folder / "recordings", sources)
        results = tidy(cells, cfg.factor_names(config))
        values = analysis.values(results, config)
        consistency = analysis.consistency(results, config)
        tables: list[pl.DataFrame] = []

        def compare() -> None:
            tables.extend([analysis.groups(values, config), analysis.comparisons(values, config)])

        mark = _mark(toml, code, cells, notes)
        pictures: list[PagePicture] | None = None
        if _is_rendered(folder, mark):
            compare()
        else:
            (folder / RENDERED).unlink(missing_ok=True)
            pictures = draw(executor, values, consistency, cells, config, meanwhile=compare)
    groups, comparisons = tables
    by_label = labels.label_values(cells, config)
    every_pair = pairs.all_pairs(values, config)
    contents = ReportContents(
        config=config,
        results=results,
        values=values,
        groups=groups,
        comparisons=comparisons,
        outliers=analysis.outliers(values, config),
        published=analysis.beside_published(groups, config),
        consistency=consistency,
        labels=by_label,
        label_comparisons=labels.label_comparisons(by_label, config),
        paired=pairs.paired_comparisons(values, config),
        pairs=every_pair,
        verdicts=pairs.verdicts(values, every_pair, config),
        relations=pairs.relations(values, config),
        failures=analysis.failures(results, config),
        notes=[*notes, *analysis.remarks(cells, config)],
        provenance=_provenance(code, started, scheduler or f"{executor.processes} processes"),
        toml=toml,
    )
    if pictures is None:  # report and tables stand there, of the same cells
        files = [
            p for p in sorted(folder.rglob("*")) if p.is_file() and p.parent.name in (folder.name, "figures")
        ]
    else:
        files = _write(folder, contents, pictures)
        write_atomic(folder / RENDERED, lambda path: path.write_text(mark, encoding="utf-8"))
    return StudyResult(
        **{name: getattr(contents, name) for name in StudyTables.__struct_fields__},
        folder=folder,
        cells_run=sum(c.key not in reused for c in cells),
        cells_reused=sum(c.key in reused for c in cells),
        cells_failed=sum(c.status != "ok" for c in cells),
        elapsed_s=time.perf_counter() - begin,
        files=files,
    )


def _mark(toml: str, code: str, cells: Sequence[StudyCell], notes: Sequence[str]) -> str:
    """Return a digest of everything that the report depends on."""
    about = (toml, code, list(notes), [msgspec.to_builtins(c) for c in cells], metadata.version("marcha"))
    return hashlib.blake2b(msgspec.msgpack.encode(about), digest_size=16).hexdigest()


def _is_rendered(folder: Path, mark: str) -> bool:
    """Whether the folder's report and tables were made of just this."""
    marker = folder / RENDERED
    there = all((folder / name).is_file() for name in ("report.html", "results.parquet", "results.csv"))
    return there and marker.is_file() and marker.read_text(encoding="utf-8") == mark


def _plain(config: cfg.StudyConfig) -> Any:
    """Return the configuration as TOML can hold it: None is left out."""

    def clean(value: Any) -> Any:
        if isinstance(value, dict):
            return {k: clean(v) for k, v in value.items() if v is not None}
        return [clean(v) for v in value] if isinstance(value, list | tuple) else value

    return clean(msgspec.to_builtins(config))


def _take_folder(folder: Path, toml: str, *, overwrite: bool, resume: bool) -> None:
    """Make the folder the study's own, or refuse."""
    copy = folder / "study.toml"
    if folder.exists() and not folder.is_dir():
        raise OutputExists(folder)
    if folder.is_dir() and any(folder.iterdir()):
        if not copy.is_file():
            raise UsageError(f"{folder}: is not empty and holds no study; give another folder")
        if overwrite:
            for part in ("cells", "recordings", "figures"):
                shutil.rmtree(folder / part, ignore_errors=True)
        elif not resume and copy.read_text(encoding="utf-8") != toml:
            raise UsageError(
                f"{folder}: holds a study with another configuration; give another folder, --resume to go on "
                "with this one "
                "(cells that both share are kept), or --force to start anew"
            )
    for part in (folder, folder / "cells", folder / "recordings", folder / "figures"):
        remove_left(part)
    write_atomic(copy, lambda path: path.write_text(toml, encoding="utf-8"))


def _with_configuration(cell: StudyCell, source: plan.StudyRecording, config: cfg.StudyConfig) -> StudyCell:
    label = source.configuration
    if config.configurations or not label:
        label = cfg.configuration(config, label or Path(source.path).name, cell.input)
    return msgspec.structs.replace(cell, configuration=label)


def _forget_old_recordings(folder: Path, sources: Sequence[plan.StudyRecording]) -> None:
    """Remove converted recordings that no source of this study needs any more."""
    needed = {cached(s, folder).name for s in sources}
    for path in folder.glob("*.mcap") if folder.is_dir() else ():
        if path.name not in needed:
            path.unlink()


def _provenance(code: str, started: datetime, executor: str) -> dict[str, str]:
    """Return what a reader needs to run the study again."""
    return {
        "started (UTC)": started.isoformat(timespec="seconds"),
        "executor": executor,
        "code hash": code,
        "Python": platform.python_version(),
        "system": f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores",
        **{name: metadata.version(name) for name in LIBRARIES},
    }


def write_csv(table: pl.DataFrame, path: Path) -> None:
    """Write a table for spreadsheets: a text that one would take for a formula gets an apostrophe before it.

    The Parquet table has every text as it is.
    """
    formula = {
        c: pl.col(c).str.contains(r"^[=+\-@\t\r]") & pl.col(c).cast(pl.Float64, strict=False).is_null()
        for c, kind in table.schema.items()
        if kind == pl.String
    }
    table.with_columns(
        pl.when(f).then(pl.format("'{}", pl.col(c))).otherwise(pl.col(c)).alias(c) for c, f in formula.items()
    ).write_csv(path)


def _write(folder: Path, contents: ReportContents, pictures: list[PagePicture]) -> list[Path]:
    """Write tables, figures and report; return the files. Older figures are removed."""
    page = render(contents, pictures)
    provenance = msgspec.json.format(msgspec.json.encode(contents.provenance))
    writers: dict[str, Callable[[Path], object]] = {
        "results.parquet": contents.results.write_parquet,
        "results.csv": partial(write_csv, contents.results),
        "groups.csv": partial(write_csv, contents.groups),
        "comparisons.csv": partial(write_csv, contents.comparisons),
        "paired.csv": partial(write_csv, contents.paired),
        **({"failures.csv": partial(write_csv, contents.failures)} if len(contents.failures) else {}),
        "outliers.csv": partial(write_csv, contents.outliers),
        **(
            {
                "pairs.csv": partial(write_csv, contents.pairs),
                "verdicts.csv": partial(write_csv, contents.verdicts),
                "relations.csv": partial(write_csv, contents.relations),
            }
            if contents.config.published or contents.config.verdicts
            else {}
        ),
        **(
            {
                "labels.csv": partial(write_csv, contents.labels),
                "label_comparisons.csv": partial(write_csv, contents.label_comparisons),
            }
            if contents.config.by
            else {}
        ),
        "provenance.json": lambda path: path.write_bytes(provenance),
        "report.html": lambda path: path.write_text(page, encoding="utf-8"),
    }
    for picture in pictures:
        writers[f"figures/{picture.name}.png"] = lambda path, data=picture.png: path.write_bytes(data)
        writers[f"figures/{picture.name}.svg"] = lambda path, data=picture.svg: path.write_bytes(data)
    for name, write in writers.items():
        try:
            write_atomic(folder / name, write)
        except OSError as error:
            raise MarchaError(f"{folder / name}: cannot be written: {error.strerror or error}") from None
    files = [folder / name for name in ("study.toml", *writers)]
    for old in {*folder.glob("figures/*.png"), *folder.glob("figures/*.svg")} - set(files):
        old.unlink()
    return files
