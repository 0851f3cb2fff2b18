"""A copy of a recording with more annotations in it."""

from __future__ import annotations

from pathlib import Path

import polars as pl

from ..recording import Recording, create


def annotate(rec: Recording, annotations: pl.DataFrame, out: Path, *, overwrite: bool = False) -> int:
    """Write everything that ``rec`` holds, and further annotations, to a new file.

    Parameters
    ----------
    rec : Recording
        Never changed; where ``out`` is its own path, the finished copy takes its place at once.
    annotations : polars.DataFrame
        Columns of :data:`marcha.export.events.ANNOTATIONS`.
    out : Path
        File to write.
    overwrite : bool
        Whether ``out`` may be replaced.

    Returns
    -------
    int
        Number of annotations that the new file holds.

    Raises
    ------
    OutputExists
        ``out`` exists and ``overwrite`` is false.
    """
    with create(out, overwrite=overwrite) as copy:
        copy.copy_from(rec)
        copy.add_annotations(annotations)
    return rec.annotations.height + annotations.height
