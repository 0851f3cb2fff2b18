"""Reading small files that others wrote: regular ones only, of bounded size, every failure one line."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

import msgspec

from .errors import MarchaError, UsageError

MOST_TEXT_BYTES = 1 << 24
"""A configuration, mapping or table of labels that is larger is none."""


def require_regular(path: Path) -> None:
    """Refuse a pipe, socket or device: reading it may never end. What is not there passes.

    Raises
    ------
    MarchaError
        It is none of file, folder and missing.
    """
    try:
        mode = path.stat().st_mode
    except (OSError, ValueError):  # whoever opens it says why it cannot be read
        return
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise MarchaError(f"{path}: is a pipe, socket or device; write its content to a file and give that")


def files_below(folder: Path) -> list[Path]:
    """Return all files of a folder and of those in it, in order.

    Raises
    ------
    MarchaError
        One of the folders cannot be listed: what is in it would be left out without a word.
    """

    def refuse(error: OSError) -> None:
        raise MarchaError(f"{error.filename}: cannot be read: {error.strerror}") from None

    names = (Path(base) / n for base, _, files in os.walk(folder, onerror=refuse) for n in files)
    return sorted(p for p in names if p.is_file())


def require_other(out: Path | str, inputs: Iterable[Path]) -> None:
    """Refuse an output that is one of the inputs, by whatever name: an input is never changed in place.

    Raises
    ------
    UsageError
        It is one.
    """
    for path in inputs:
        try:
            same = Path(out).samefile(path)
        except OSError:  # one of them is not there
            continue
        if same:
            raise UsageError(
                f"{out}: is the input itself; an input is never changed in place, give another name"
            )


def as_unicode(name: Path | str) -> str:
    """Return a file's name as text that can be stored: bytes of it that are no UTF-8 become escapes."""
    return str(name).encode("utf-8", "backslashreplace").decode()


def read_small(path: Path) -> bytes:
    """Return the content of a file of at most :data:`MOST_TEXT_BYTES`.

    Raises
    ------
    MarchaError
        It cannot be read, is no regular file or is larger.
    """
    require_regular(path)
    try:
        with path.open("rb") as file:
            data = file.read(MOST_TEXT_BYTES + 1)
    except (OSError, ValueError) as error:
        raise MarchaError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from error
    if len(data) > MOST_TEXT_BYTES:
        raise MarchaError(
            f"{path}: has more than {MOST_TEXT_BYTES >> 20} MiB; this is not the file that is meant"
        )
    return data


def read_toml(path: Path, type: Any = Any) -> Any:
    """Return a TOML file as ``type``.

    Raises
    ------
    MarchaError
        One line that names the file, and the key where a value does not fit.
    """
    return parse_toml(read_small(path), str(path), type)


def parse_toml(data: bytes, name: str, type: Any = Any) -> Any:
    """Return TOML text as ``type``; ``name`` stands in front of what is wrong with it.

    Raises
    ------
    MarchaError
        As :func:`read_toml`.
    """
    try:
        return msgspec.toml.decode(data, type=type)
    except msgspec.ValidationError as error:
        complaint, _, where = str(error).partition(" - at `$")
        key = where.rstrip("`").lstrip(".") or "top level"
        if (choices := _choices(type, key)) and complaint.startswith("Invalid enum"):
            complaint += f"; one of {', '.join(choices)}"
        raise MarchaError(f"{name}: {key}: {complaint}") from error
    except (ValueError, RecursionError) as error:  # also bytes that are no UTF-8, and numbers without end
        raise MarchaError(f"{name}: not TOML: {error}") from error


def _choices(kind: Any, key: str) -> tuple[str, ...]:
    """Return the words that a key may have; nothing where it is no choice."""
    for part in key.split("."):
        if not (isinstance(kind, type) and issubclass(kind, msgspec.Struct)):
            return ()
        kind = {f.encode_name: f.type for f in msgspec.structs.fields(kind)}.get(part)
    return get_args(kind) if get_origin(kind) is Literal else ()
