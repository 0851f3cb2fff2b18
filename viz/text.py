"""Text from files, made fit for a screen."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

_DRAWN_ONLY: ContextVar[bool] = ContextVar("drawn_only", default=False)
_NOT_DRAWN = re.compile(
    "[^ -~\u00a0-\u017f\u0384-\u03ce\u0400-\u045f\u1e00-\u1eff\u2010-\u2027\u2190-\u2193\u2212\u2264\u2265]"
)
"""What is not Latin, Greek, Cyrillic or a usual sign: the viewer's own font may lack it."""


@contextmanager
def drawn_only() -> Iterator[None]:
    """Have :func:`printable` write ``?`` for what the viewer's own font lacks: without a window there is no other
    font, and it ends at the first such sign.
    """
    token = _DRAWN_ONLY.set(True)
    try:
        yield
    finally:
        _DRAWN_ONLY.reset(token)


def printable(text: object) -> str:
    """Return a text without control characters (terminal escapes, direction overrides).

    Line breaks and tabs become blanks, every other control or format character U+FFFD.
    """
    text = str(text)
    if text.isascii() and text.isprintable():
        return text
    text = "".join(
        " " if c in "\n\r\t" else "\ufffd" if unicodedata.category(c) in ("Cc", "Cf", "Cs", "Zl", "Zp") else c
        for c in text
    )
    return _NOT_DRAWN.sub("?", text) if _DRAWN_ONLY.get() else text
