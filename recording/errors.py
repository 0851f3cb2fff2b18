"""Errors and findings that every part of marcha shares."""

from __future__ import annotations

from contextlib import AbstractContextManager
from pathlib import Path

import msgspec

MOST_CHARACTERS = 1000
"""Of a message; the middle of a longer one is left out."""


def one_line(text: str, most: int = MOST_CHARACTERS) -> str:
    """Return text as one printable line of bounded length, whatever it quotes from a file.

    White space becomes single blanks; other characters that a terminal would act on become escapes.
    """
    text = " ".join(text.split()) if len(text) <= 4 * most else text
    if len(text) > most:
        text = f"{text[: most * 2 // 3]} … {text[-most // 4 :]}"
    text = " ".join(text.split())
    if not text.isprintable():
        text = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
    return text if len(text) <= 1.2 * most else f"{text[:most]} …"


class MarchaError(Exception):
    """An expected failure (bad input, existing output): one line that names file, rule, value and remedy.

    The command line prints it without a traceback and exits with ``exit_code``.
    """

    exit_code = 1

    def __init__(self, message: object = "") -> None:
        super().__init__(one_line(str(message)))


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

    def __post_init__(self) -> None:
        if len(self.detail) > MOST_CHARACTERS or not self.detail.isprintable():
            msgspec.structs.force_setattr(self, "detail", one_line(self.detail))


def overflow_unsaid() -> AbstractContextManager[object]:
    """Let NumPy say nothing of numbers that overflow, here and in helper threads.

    A damaged number of 1e308 overflows where it is squared: what compares it then says no, as it should.
    """
    import numpy as np

    return np.errstate(over="ignore", invalid="ignore")
