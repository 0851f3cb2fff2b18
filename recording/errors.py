"""Errors and findings that every part of marcha shares."""

from __future__ import annotations

from pathlib import Path

import msgspec


class MarchaError(Exception):
    """An expected failure (bad input, existing output): one line that names file, rule, value and remedy.

    The command line prints it without a traceback and exits with ``exit_code``.
    """

    exit_code = 1


class UsageError(MarchaError):
    """The call itself is wrong: an unknown option, name or combination."""

    exit_code = 2


class OutputExists(MarchaError):
    """The output is there already and may not be overwritten without being told so."""

    def __init__(self, path: Path | str) -> None:
        super().__init__(f"{path}: exists already; give another name or --force (overwrite=True)")


class Finding(msgspec.Struct, frozen=True):
    """One kind of defect or repair, with how often and where first.

    Attributes
    ----------
    kind : str
        Stable lower-case word (``bad_row``, ``gap``, ``clipped`` …), listed in ``docs/recording-format.md``.
    count : int
        How often.
    first_line : int or None
        Line (from 1), row or packet of the source where it happened first.
    detail : str
        One line for a person: value, rule, what was done.
    """

    kind: str
    count: int
    first_line: int | None = None
    detail: str = ""
