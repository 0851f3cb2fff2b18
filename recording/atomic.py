"""Files that appear whole or not at all."""

from __future__ import annotations

import contextlib
import os
from concurrent.futures import Future
from pathlib import Path

from .errors import MarchaError, OutputExists, UsageError
from .threads import helpers

SYNC_BYTES = 1 << 26
"""So many bytes go to disk together, while more are being written."""


class AtomicFile:
    """A file that is written beside its final name and put there in one step.

    Parameters
    ----------
    path : pathlib.Path
        Where it is to appear.
    overwrite : bool
        Whether an existing file may be replaced.

    Raises
    ------
    OutputExists
        The file is there, and ``overwrite`` is false.
    MarchaError
        The folder is missing or cannot be written.
    """

    def __init__(self, path: Path, *, overwrite: bool = False) -> None:
        self.path = path
        self.overwrite = overwrite
        self._done = False
        self._waiting = 0
        self._syncing: Future[None] | None = None
        if path.is_dir():
            raise UsageError(f"{path}: is a folder; name a file")
        if path.exists() and not overwrite:
            raise OutputExists(path)
        _remove_stale(path)
        self.part = path.with_name(f".{path.name}.{os.getpid()}.part")
        number = 0
        while True:
            try:
                self._file = self.part.open("xb", buffering=1 << 16)
                break
            except FileExistsError:  # a second writer of the same process
                number += 1
                self.part = path.with_name(f".{path.name}.{os.getpid()}-{number}.part")
            except OSError as e:
                raise _failure(path, e) from None
        _lock(self._file.fileno())

    def write(self, data: bytes | memoryview) -> None:
        """Append bytes; what has come together goes to disk in the background.

        Raises
        ------
        MarchaError
            The disk is full or failed; nothing is left.
        """
        try:
            self._file.write(data)
            self._waiting += len(data)
            if self._waiting >= SYNC_BYTES:
                self._sync_behind()
        except OSError as e:
            self.abort()
            raise _failure(self.path, e) from None

    def _sync_behind(self) -> None:
        """Send to disk what was written, in a thread: nobody should wait for all of it at the end."""
        if self._syncing is None:
            self._pool = helpers("sync", 1)
        elif not self._syncing.done():
            return
        else:
            self._syncing.result()
        self._waiting = 0
        self._syncing = self._pool.submit(os.fsync, self._file.fileno())

    def commit(self) -> None:
        """Flush to disk and put the file in its place.

        Raises
        ------
        OutputExists
            A file appeared there meanwhile, and ``overwrite`` is false.
        MarchaError
            The disk is full or failed; nothing is left.
        """
        try:
            if self._syncing is not None:
                self._syncing.result()
                self._pool.shutdown()
            self._file.flush()
            os.fsync(self._file.fileno())
            if self.overwrite:
                os.replace(self.part, self.path)
            else:
                _place(self.part, self.path)
            self._file.close()
            _sync_folder(self.path.parent)
        except FileExistsError:
            self.abort()
            raise OutputExists(self.path) from None
        except OSError as e:
            self.abort()
            raise _failure(self.path, e) from None
        self._done = True

    def abort(self) -> None:
        """Remove what was written."""
        if self._done:
            return
        self._done = True
        if self._syncing is not None:
            self._pool.shutdown()
        with contextlib.suppress(OSError):  # close() flushes, and the disk may be full
            self._file.close()
        self.part.unlink(missing_ok=True)


def _place(part: Path, path: Path) -> None:
    """Rename without ever replacing: a hard link fails where the name is taken."""
    try:
        os.link(part, path)
    except FileExistsError:
        raise
    except (OSError, NotImplementedError):  # a file system without hard links
        if path.exists():
            raise FileExistsError(path) from None
        os.replace(part, path)
    else:
        part.unlink()


def _sync_folder(folder: Path) -> None:
    with contextlib.suppress(OSError):  # some systems cannot open a folder; the rename itself has succeeded
        fd = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(fd)
        finally:
            os.close(fd)


def _lock(fd: int) -> bool:
    """Lock an open part file; false where another process still writes it (or locks do not exist)."""
    try:
        import fcntl

        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (ImportError, OSError):
        return False
    return True


def _remove_stale(path: Path) -> None:
    """Remove parts that killed writers of the same file left: those that nobody holds locked."""
    for part in path.parent.glob(f".{_escape(path.name)}.*.part"):
        with contextlib.suppress(OSError), part.open("rb") as file:
            if _lock(file.fileno()):
                part.unlink()


def _escape(name: str) -> str:
    import glob

    return glob.escape(name)


def _failure(path: Path, error: OSError) -> MarchaError:
    if isinstance(error, FileNotFoundError) and not path.parent.exists():
        return MarchaError(f"{path}: cannot write: there is no folder {path.parent}; make it first")
    return MarchaError(f"{path}: cannot write: {error.strerror or error}; nothing was left there")
