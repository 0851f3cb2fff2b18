"""A study's folder: finished cells, the tables made of them, and atomic writing."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import msgspec
import polars as pl

from .cells import StudyCell


def write_atomic(path: Path, write: Callable[[Path], object]) -> None:
    """Let ``write`` fill a temporary file in the same folder, then give it its name."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part{path.suffix}")
    try:
        write(temporary)
        with temporary.open("rb") as file:
            os.fsync(file.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


class CellStore:
    """Finished cells in one folder: a small file for each task, written whole as the task finishes.

    Parameters
    ----------
    folder : Path
        ``cells`` of the study's folder.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._encode = msgspec.msgpack.Encoder().encode
        self._decode = msgspec.msgpack.Decoder(list[StudyCell]).decode

    def load(self) -> dict[str, list[StudyCell]]:
        """Return the finished cells by their job's key. Failed ones are left out: they are tried again."""
        jobs: dict[str, list[StudyCell]] = {}
        for path in sorted(self.folder.glob("*.msgpack")):
            try:
                cells = self._decode(path.read_bytes())
            except msgspec.DecodeError:
                continue  # of another version of marcha: those cells are computed again
            for cell in cells:
                jobs.setdefault(cell.key, []).append(cell)
        return {key: cells for key, cells in jobs.items() if all(c.status == "ok" for c in cells)}

    def add(self, name: str, cells: Iterable[StudyCell]) -> None:
        """Keep the cells of one finished task under the file name ``name``."""
        data = self._encode(list(cells))
        write_atomic(self.folder / f"{name}.msgpack", lambda path: path.write_bytes(data))


def tidy(cells: Iterable[StudyCell], factors: Sequence[str] = ()) -> pl.DataFrame:
    """Return one row a cell: what ran on what, how it ended, a column a factor and a metric."""
    cells = list(cells)
    names = sorted({name for cell in cells for name in cell.metrics})
    fixed = pl.DataFrame(
        {
            "recording": [c.recording for c in cells],
            "configuration": [c.configuration for c in cells],
            "input": [c.input for c in cells],
            "filter": [c.label for c in cells],
            **{name: [c.levels.get(name, "") for c in cells] for name in factors},
            "estimator": [c.estimator for c in cells],
            "preset": [c.preset for c in cells],
            "params": [c.params for c in cells],
            "status": [c.status for c in cells],
            "error": [c.error for c in cells],
            "clipped": [c.clipped for c in cells],
            "clipped_readings": [c.clipped_readings for c in cells],
            "findings": [msgspec.json.encode(c.findings).decode() for c in cells],
            "samples": [c.samples for c in cells],
            "run_time_s": [c.run_time_s for c in cells],
            "key": [c.key for c in cells],
        },
        schema={
            **dict.fromkeys(("recording", "configuration", "input", "filter", *factors), pl.String),
            **dict.fromkeys(("estimator", "preset", "params", "status", "error"), pl.String),
            "clipped": pl.Boolean,
            "clipped_readings": pl.Int64,
            "findings": pl.String,
            "samples": pl.Int64,
            "run_time_s": pl.Float64,
            "key": pl.String,
        },
    )
    metrics = [pl.Series(n, [c.metrics.get(n) for c in cells], dtype=pl.Float64) for n in names]
    return fixed.with_columns(metrics)
