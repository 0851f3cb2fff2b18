"""Which logs are meant when a user names files, folders and archives of logs."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from ..recording.errors import MarchaError
from ..recording.files import files_below
from . import registry
from .archive import UNPACK_LIMIT_GB, is_zip, unpacked
from .workbook import is_workbook


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
        own = folder == path
        seen = _scan(
            folder, stack, format, unpack_limit_gb if own else unpack_limit_gb - _size_gb(folder), own
        )
        skipped += seen.skipped
        archives |= seen.archives
        packed = any(p.is_file() and is_zip(p) for p in seen.logs)
        logs_here += seen.logs if own or packed or len(seen.logs) > 1 else [path]
    sides = {(log.parent, f"{log.stem}.truth") for log in logs_here}  # they come along with their log
    skipped = [(p, why) for p, why in skipped if not any(log in p.parents for log in logs_here)]
    skipped = [(p, why) for p, why in skipped if (p.parent, p.name[: p.name.find(".truth") + 6]) not in sides]
    return LogsFound(list(dict.fromkeys(logs_here)), skipped, archives)


def _scan(
    folder: Path,
    stack: contextlib.ExitStack,
    format: str | None,
    limit_gb: float,
    own: bool,
    deep: bool = True,
) -> LogsFound:
    """Return the logs in and below a folder, which is the user's ``own`` or an archive's, archives in it included.

    Archives of an archive share its limit, and what lies packed in them once more is left out.
    """
    inside: list[Path] = []
    skipped: list[tuple[Path, str]] = []
    archives: dict[Path, Path] = {}
    for file in _files(folder):
        if names := _names(file, format):
            inside.append(registry.chief_of(file, names[0]))
            continue
        if not deep or not is_zip(file) or is_workbook(file):
            skipped.append((file, f"not {format}" if format else "no known format"))
            continue
        try:
            unpacked_to = stack.enter_context(unpacked(file, max(limit_gb, 0.0)))
        except MarchaError as error:
            skipped.append((file, str(error).removeprefix(f"{file}: ")))
            continue
        archives[unpacked_to] = file
        limit_gb -= 0.0 if own else _size_gb(unpacked_to)
        if _names(unpacked_to, format):
            inside.append(file)
            continue
        more = _scan(unpacked_to, stack, format, limit_gb, False, deep=own)
        archives |= more.archives
        if not more.logs:
            skipped.append((file, "an archive without a known format"))
        elif len(more.logs) == 1 and not is_zip(more.logs[0]):
            inside.append(file)
        else:
            inside += more.logs
            skipped += more.skipped
    return LogsFound(list(dict.fromkeys(inside)), skipped, archives)


def _files(folder: Path) -> list[Path]:
    """Return the files of a folder and below it, without hidden ones and those of macOS."""
    files = files_below(folder)
    hidden = (
        any(part.startswith(".") or part == "__MACOSX" for part in f.relative_to(folder).parts) for f in files
    )
    return [f for f, hide in zip(files, hidden, strict=True) if not hide]


def _size_gb(folder: Path) -> float:
    return sum(p.stat().st_size for p in folder.rglob("*") if p.is_file()) / 1e9


def _names(path: Path, format: str | None) -> list[str]:
    return [c.name for c in registry.recognise(path) if format in (None, c.name)]
