"""Files that appear whole or not at all."""

from __future__ import annotations

import contextlib
import os
from concurrent.futures import Executor, Future
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
        self._syncer: Executor = helpers("sync", 1)
        self._syncing: Future[None] | None = None
        self._unsynced = 0
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

    def write(self, *pieces: bytes | memoryview) -> None:
        """Append bytes; what has come together goes to disk in the background.

        Parameters
        ----------
        *pieces : bytes or memoryview
            One behind the other.

        Raises
        ------
        MarchaError
            The disk is full or failed, now or with an earlier call; nothing is left.
        """
        try:
            for piece in pieces:
                self._file.write(piece)
                self._unsynced += len(piece)
            if self._unsynced >= SYNC_BYTES and (self._syncing is None or self._syncing.done()):
                self._settle()
                self._unsynced = 0
                self._syncing = self._syncer.submit(os.fsync, self._file.fileno())
        except OSError as e:
            self.abort()
            raise _failure(self.path, e) from None

    def _settle(self) -> None:
        """Wait for what goes to disk in the background; raise what went wrong there."""
        if self._syncing is not None:
            self._syncing.result()

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
            self._settle()
            self._file.flush()
            os.fsync(self._file.fileno())
            if self.overwrite:
                os.replace(self.part, self.path)
            else:
                _place(self.part, self.path)
            self._close()
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
        with contextlib.suppress(OSError):  # close() flushes, and the disk may be full
            self._close()
        self.part.unlink(missing_ok=True)

    def _close(self) -> None:
        self._syncer.shutdown()
        self._file.close()


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
