"""Where a recording comes from: names, sizes and hashes of its sources, and the tool that made it."""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Iterable, Mapping
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import msgspec

from .errors import MarchaError
from .files import as_unicode
from .mcapfile import library_name

RECORD = "provenance"
"""Name of the metadata record."""


class SourceFile(msgspec.Struct, frozen=True):
    """A file that went into a recording: name without folders, size in bytes, BLAKE2b in hexadecimal."""

    name: str
    size: int
    blake2b: str


@cache
def environment() -> str:
    """Return the versions that numbers depend on, in one line: Python, NumPy, Numba, Polars, machine."""
    names = []
    for name in ("numpy", "numba", "polars"):
        try:
            names.append(f"{name} {version(name)}")
        except PackageNotFoundError:  # a bundled program without metadata
            continue
    return ", ".join([f"Python {platform.python_version()}", *names, platform.machine()])


def hash_file(path: Path | str) -> str:
    """Return the BLAKE2b hash (512 bits, hexadecimal) of a file, read in blocks.

    Raises
    ------
    MarchaError
        The file cannot be read.
    """
    try:
        with Path(path).open("rb") as file:
            return hashlib.file_digest(file, "blake2b").hexdigest()
    except OSError as e:
        raise MarchaError(f"{path}: cannot read: {e.strerror or e}") from None


def source_file(path: Path | str) -> SourceFile:
    """Return name, size and hash of a file."""
    return SourceFile(as_unicode(Path(path).name), Path(path).stat().st_size, hash_file(path))


def provenance(sources: Iterable[Path | str], **facts: Any) -> dict[str, str]:
    """Return the values of a ``provenance`` metadata record.

    Parameters
    ----------
    sources : iterable of path
        Files that the recording was made from.
    **facts
        Anything else (importer, version, options …); what is no text becomes JSON.

    Returns
    -------
    dict of str to str
        ``tool``, ``sources`` (JSON list of name, size, blake2b) and the facts.
    """
    files = [msgspec.to_builtins(source_file(p)) for p in sources]
    texts = {k: v if isinstance(v, str) else json.dumps(v, ensure_ascii=False) for k, v in facts.items()}
    return {"tool": library_name(), "sources": json.dumps(files, ensure_ascii=False), **texts}


def sources_of(metadata: Mapping[str, Mapping[str, str]]) -> list[SourceFile]:
    """Return the sources that a recording's ``provenance`` record names; none where it has no such record."""
    text = metadata.get(RECORD, {}).get("sources", "[]")
    try:
        return msgspec.json.decode(text, type=list[SourceFile])
    except msgspec.MsgspecError:
        return []
