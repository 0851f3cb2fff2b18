"""Which logs are meant when a user names files, folders and archives of logs."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from ..recording.errors import MarchaError
from . import registry
from .archive import UNPACK_LIMIT_GB, is_zip, unpacked


class LogsFound(NamedTuple):
    """Logs that each become one recording.

    Attributes
    ----------
    logs : list of Path
        In the order given, files of a folder by name.
    skipped : list of (Path, str)
        Files of folders and archives that are left out, and why.
    archives : dict of Path to Path
        Folder into which an archive was unpacked, to the archive.
    """

    logs: list[Path]
    skipped: list[tuple[Path, str]]
    archives: dict[Path, Path]

    def shown(self, text: object) -> str:
        """Return a path, or a message that names one, as the user knows it: inside its archive."""
        line = str(text)
        for folder, archive in self.archives.items():
            line = line.replace(str(folder), str(archive))
        return line


def logs(
    paths: Sequence[Path],
    stack: contextlib.ExitStack,
    *,
    format: str | None = None,
    unpack_limit_gb: float = UNPACK_LIMIT_GB,
) -> LogsFound:
    """Return every log that ``paths`` stand for, each to become one recording.

    A file stands for itself, whatever is in it: what is wrong is said when it is converted. A folder
    that is one log as a whole (a phone's export) stands for itself; any other folder stands for every file
    in it and below it whose content is recognised. A zip archive is a folder.

    Parameters
    ----------
    paths : sequence of Path
        Files, folders and archives.
    stack : contextlib.ExitStack
        Keeps what archives were unpacked to until it is closed.
    format : str, optional
        Take only this format from folders.
    unpack_limit_gb : float
        Most that an archive may unpack to (GB).

    Raises
    ------
    MarchaError
        A path is not there, or an archive is not to be trusted.
    """
    logs_here: list[Path] = []
    skipped: list[tuple[Path, str]] = []
    archives: dict[Path, Path] = {}
    for path in paths:
        if not path.exists():
            raise MarchaError(f"{path}: no such file or folder")
        folder = path
        if path.is_file() and is_zip(path):
            folder = stack.enter_context(unpacked(path, unpack_limit_gb))
            archives[folder] = path
        if not folder.is_dir() or _names(folder, format):
            logs_here.append(path)
            continue
        inside = []
        for file in sorted(p for p in folder.rglob("*") if p.is_file()):
            if any(part.startswith(".") or part == "__MACOSX" for part in file.relative_to(folder).parts):
                continue
            if names := _names(file, format):
                inside.append(registry.chief_of(file, names[0]))
            else:
                skipped.append((file, f"not {format}" if format else "no known format"))
        inside = list(dict.fromkeys(inside))
        logs_here += inside if len(inside) > 1 or folder == path else [path]
    sides = {(log.parent, f"{log.stem}.truth") for log in logs_here}  # they come along with their log
    skipped = [(p, why) for p, why in skipped if not any(log in p.parents for log in logs_here)]
    skipped = [(p, why) for p, why in skipped if (p.parent, p.name[: p.name.find(".truth") + 6]) not in sides]
    return LogsFound(list(dict.fromkeys(logs_here)), skipped, archives)


def _names(path: Path, format: str | None) -> list[str]:
    return [c.name for c in registry.recognise(path) if format in (None, c.name)]
