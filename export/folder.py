"""A folder of results that appears whole or not at all."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from glob import escape
from pathlib import Path

from ..recording.errors import MarchaError, OutputExists
from ..recording.scratch import alive

MARKER = "channels.json"
"""File that makes a folder an export of tables, which may be replaced when the user says so."""


@contextmanager
def whole_folder(path: Path, *, overwrite: bool = False, marker: str = MARKER) -> Iterator[Path]:
    """Give a temporary folder beside ``path`` that takes its name when the block ends well.

    The temporary folder is called ``.<name>.<process>.part`` (a second one
    at once has a number of its own). An exception removes it; after a kill it stays,
    is never mistaken for an export, and the next export to the same name removes it.

    Parameters
    ----------
    path : Path
        The folder to create.
    overwrite : bool
        Whether an earlier result may be replaced.
    marker : str
        File that an earlier result holds: a folder without it, unless it is empty, is never removed.

    Raises
    ------
    OutputExists
        ``path`` exists and ``overwrite`` is false.
    MarchaError
        ``path`` is a file, or a folder of something else, or its parent does not exist, or the disk is full.
    """
    path = Path(os.path.abspath(path))
    _remove_leftovers(path)
    _may_be_created(path, overwrite, marker)
    part = path
    try:
        part = _new_part(path)
        yield part
        for file in sorted(p for p in part.rglob("*") if p.is_file()):
            _flush(file)
        _put(part, path, overwrite)
    except BaseException as error:
        if part != path:
            shutil.rmtree(part, ignore_errors=True)
        # A failed write does not know its file, and a hidden name says nothing.
        hidden = path.with_name(f".{path.name}.")
        if isinstance(error, OSError) and str(error.filename or hidden).startswith(str(hidden)):
            reason = error.strerror or " ".join(str(error).split())
            raise MarchaError(f"{path}: cannot write: {reason}; nothing was left there") from None
        raise
    if os.name == "posix":
        _flush(path.parent)


def _new_part(path: Path) -> Path:
    """Create the temporary folder; a second export of the same process has a number of its own."""
    number = 0
    while True:
        part = path.with_name(f".{path.name}.{os.getpid()}{f'-{number}' if number else ''}.part")
        try:
            part.mkdir()
        except FileExistsError:
            number += 1
        else:
            return part


def _may_be_created(path: Path, overwrite: bool, marker: str) -> None:
    if not path.parent.is_dir():
        raise MarchaError(f"{path.parent}: is not a folder; create it first")
    if not path.exists():
        return
    if not path.is_dir():
        raise MarchaError(f"{path}: is a file, and a folder is to be written; give another name")
    if any(path.iterdir()):
        if not overwrite:
            raise OutputExists(path)
        if not (path / marker).is_file():
            raise MarchaError(
                f"{path}: is a folder that marcha did not make (no {marker} in it); give another name"
            )


def _put(part: Path, path: Path, overwrite: bool) -> None:
    """Rename ``part`` to ``path``; an earlier export steps aside first and comes back if that fails.

    Without ``overwrite`` the system's own rename decides between two exports at once: it replaces a folder
    only where that is empty.
    """
    if not overwrite:
        try:
            part.rename(path)
        except OSError as error:
            if path.exists():
                raise OutputExists(path) from None
            raise error
        return
    if not path.exists():
        part.rename(path)
        return
    old = part.with_suffix(".old")
    path.rename(old)
    try:
        part.rename(path)
    except OSError:
        old.rename(path)
        raise
    shutil.rmtree(old, ignore_errors=True)


def _remove_leftovers(path: Path) -> None:
    """Remove what killed processes left: parts, and an old export that was already replaced."""
    for kind in ("part", "old"):
        for left in path.parent.glob(f".{escape(path.name)}.*.{kind}"):
            number = left.name.removesuffix(f".{kind}").rpartition(".")[2].partition("-")[0]
            if not number.isdigit() or alive(int(number)):
                continue
            if kind == "old" and not path.exists():
                left.rename(path)  # killed between the two renames: the earlier export is the only one
            else:
                shutil.rmtree(left, ignore_errors=True)


def _flush(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
