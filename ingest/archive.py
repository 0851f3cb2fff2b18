"""Zip archives from strangers: unpacked only where nothing in them can do harm."""

from __future__ import annotations

import lzma
import shutil
import stat
import struct
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath

from ..recording.errors import MarchaError, one_line
from ..recording.scratch import scratch_folder

UNPACK_LIMIT_GB = 2.0
"""Total that an archive may unpack to, unless an option raises it."""
DAMAGED = (
    *(zipfile.BadZipFile, zlib.error, lzma.LZMAError, struct.error, RuntimeError, EOFError, ValueError),
    MemoryError,  # a dictionary of LZMA may be as large as its member says
)
"""What :mod:`zipfile` raises on archives that are damaged, or packed in a way that it does not know."""
MEMBERS, NAME_BYTES = 10_000, 200
"""Most members, and bytes of one part of a name."""


def is_zip(path: Path) -> bool:
    """Whether a file is a zip archive, by its structure: the compression of its members does not matter."""
    try:
        with path.open("rb") as f:
            return f.read(4) in (b"PK\x03\x04", b"PK\x05\x06") and zipfile.is_zipfile(path)
    except OSError:
        return False


@contextmanager
def unpacked(path: Path, limit_gb: float = UNPACK_LIMIT_GB) -> Iterator[Path]:
    """Give a temporary folder with what an archive holds; an error that names it names archive and member.

    Raises
    ------
    MarchaError
        As :func:`unpack` says.
    """
    with scratch_folder() as folder:
        unpack(path, folder, limit_gb)
        try:
            yield folder
        except MarchaError as error:
            error.args = (one_line(str(error).replace(str(folder), str(path))),)
            raise


def unpack(path: Path, folder: Path, limit_gb: float = UNPACK_LIMIT_GB) -> None:
    """Unpack an archive into an empty folder.

    Raises
    ------
    MarchaError
        A name leads out of the folder, stands twice or is too long; a member is a link or encrypted; the whole is
        larger than the limit, or says another size than it has.
    """
    limit = limit_gb * 1e9
    try:
        with zipfile.ZipFile(path) as archive:
            members = trusted_members(path, archive)
            total = sum(m.file_size for m in members)
            if total > limit:
                raise MarchaError(_too_large(path, total, limit_gb))
            done = 0
            for member in members:
                target = folder.joinpath(*PurePosixPath(member.filename.replace("\\", "/")).parts)
                if member.is_dir():
                    target.mkdir(parents=True, exist_ok=True)
                    continue
                target.parent.mkdir(parents=True, exist_ok=True)
                with archive.open(member) as source, target.open("wb") as out:
                    while chunk := source.read(1 << 20):
                        done += len(chunk)
                        if done > limit:
                            raise MarchaError(_too_large(path, done, limit_gb))
                        out.write(chunk)
    except DAMAGED as error:
        shutil.rmtree(folder, ignore_errors=True)
        reason = str(error) or "it asks for more memory than there is"
        raise MarchaError(f"{path}: the zip archive cannot be unpacked: {reason}") from error
    except OSError as error:
        raise MarchaError(f"{path}: cannot be unpacked: {error.strerror or error}") from error


def trusted_members(path: Path, archive: zipfile.ZipFile) -> list[zipfile.ZipInfo]:
    """Return the members of an archive whose names can do no harm.

    Raises
    ------
    MarchaError
        There are too many; a name leads out of the archive, stands twice, is empty or too long; a member is a link
        or encrypted.
    """
    members = archive.infolist()
    if len(members) > MEMBERS:
        raise MarchaError(
            f"{path}: the archive has {len(members)} members, more than {MEMBERS}; unpack it first"
        )
    seen: set[str] = set()
    for member in members:
        _check(path, member, seen)
    return members


def _too_large(path: Path, size: float, limit_gb: float) -> str:
    return (
        f"{path}: the archive unpacks to {size / 1e9:.1f} GB, more than {limit_gb:g} GB; if you trust it, "
        "give --set unpack_limit_gb=…"
    )


def _check(path: Path, member: zipfile.ZipInfo, seen: set[str]) -> None:
    name = member.filename.replace("\\", "/")
    parts = PurePosixPath(name).parts
    shown = name if len(name) < 60 else f"{name[:57]}…"
    if not parts:
        raise MarchaError(f"{path}: a member has no name; the archive is damaged: pack it again")
    if name.startswith("/") or ".." in parts or (parts and ":" in parts[0]):
        raise MarchaError(
            f"{path}: member {shown!r} leads out of the folder; the archive is not to be trusted"
        )
    if any(len(p.encode()) > NAME_BYTES for p in parts) or len(parts) > 32:
        raise MarchaError(f"{path}: member {shown!r} has too long a name; rename it")
    if name.casefold().rstrip("/") in seen:
        raise MarchaError(f"{path}: member {shown!r} stands twice; which one is meant cannot be known")
    seen.add(name.casefold().rstrip("/"))
    if stat.S_ISLNK(member.external_attr >> 16):
        raise MarchaError(f"{path}: member {shown!r} is a link; the archive is not to be trusted")
    if member.flag_bits & 0x1:
        raise MarchaError(f"{path}: member {shown!r} is encrypted; unpack it with its password first")
