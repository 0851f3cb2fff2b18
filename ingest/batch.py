"""Which logs are meant when a user names files and folders of logs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ..recording.errors import MarchaError
from . import registry


def logs(paths: Sequence[Path], *, format: str | None = None) -> tuple[list[Path], list[tuple[Path, str]]]:
    """Return every log that ``paths`` stand for, each to become one recording.

    A file stands for itself, whatever is in it: what is wrong is said when it is converted. A folder
    that is one log as a whole (a phone's export) stands for itself; any other folder stands for every file
    in it and below it whose content is recognised.

    Parameters
    ----------
    paths : sequence of Path
        Files and folders.
    format : str, optional
        Take only this format from folders.

    Returns
    -------
    list of Path
        The logs, in the order given, files of a folder by name.
    list of (Path, str)
        Files of folders that are left out, and why.

    Raises
    ------
    MarchaError
        A path is not there.
    """
    found: list[Path] = []
    skipped: list[tuple[Path, str]] = []
    for path in paths:
        if not path.exists():
            raise MarchaError(f"{path}: no such file or folder")
        if not path.is_dir() or _names(path, format):
            found.append(path)
            continue
        for file in sorted(p for p in path.rglob("*") if p.is_file()):
            if any(part.startswith(".") for part in file.relative_to(path).parts):
                continue
            if _names(file, format):
                found.append(file)
            else:
                skipped.append((file, f"not {format}" if format else "no known format"))
    sides = {(log.parent, f"{log.stem}.truth") for log in found}  # they come along with their log
    skipped = [(p, why) for p, why in skipped if (p.parent, p.name[: p.name.find(".truth") + 6]) not in sides]
    return list(dict.fromkeys(found)), skipped


def _names(path: Path, format: str | None) -> list[str]:
    return [c.name for c in registry.recognise(path) if format in (None, c.name)]
