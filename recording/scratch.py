"""Temporary folders that do not outlive the machine's patience: what a killed process left, the next one removes."""

from __future__ import annotations

import os
import re
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

_OWNER = re.compile(r"^\.?marcha-(\d+)-")
_PART = re.compile(r"^\..*\.(\d+)(-\d+)?\.part(\.\w+)?$")


@contextmanager
def scratch_folder(beside: Path | None = None) -> Iterator[Path]:
    """Give a temporary folder that is removed at the end; those of dead processes are removed first.

    Parameters
    ----------
    beside : Path, optional
        Folder to make it in (then its name is hidden); the system's place for such without it.
    """
    place = Path(tempfile.gettempdir()) if beside is None else beside
    remove_left(place)
    prefix = f"{'' if beside is None else '.'}marcha-{os.getpid()}-"
    folder = Path(tempfile.mkdtemp(prefix=prefix, dir=place))
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def remove_left(place: Path) -> None:
    """Remove temporary folders and unfinished files in ``place`` whose processes are dead."""
    with suppress(OSError):
        for path in place.iterdir():
            match = _OWNER.match(path.name) or _PART.match(path.name)
            if match is None or alive(int(match[1])):
                continue
            with suppress(OSError):
                if os.name == "posix" and path.lstat().st_uid != os.getuid():
                    continue
                if path.is_dir() and not path.is_symlink():
                    shutil.rmtree(path, ignore_errors=True)
                else:
                    path.unlink()


def alive(process: int) -> bool:
    """Whether a process runs; true also where the system cannot be asked."""
    if os.name != "posix":
        return True  # elsewhere signal 0 is not a question
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True
