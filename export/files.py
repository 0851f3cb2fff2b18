"""One or several files that appear whole or not at all."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path

from ..recording.atomic import AtomicFile
from ..recording.errors import OutputExists


def write_files(files: Mapping[Path, bytes], *, overwrite: bool = False) -> list[Path]:
    """Write files; none appears unless all could be written.

    Parameters
    ----------
    files : mapping of Path to bytes
        The first is put in its place last: where it is there, the others are.
    overwrite : bool
        Whether earlier ones may be replaced.

    Raises
    ------
    OutputExists
        One is there, and ``overwrite`` is false.
    MarchaError
        The folder is missing or the disk is full; nothing is left.
    """
    if not overwrite:
        for path in files:
            if path.exists():
                raise OutputExists(path)
    with ExitStack() as stack:
        parts = []
        for path, data in files.items():
            part = AtomicFile(path, overwrite=overwrite)
            stack.callback(part.abort)
            part.write(data)
            parts.append(part)
        for part in reversed(parts):
            part.commit()
    return list(files)
