"""Text from files, made fit for a screen."""

from __future__ import annotations

import unicodedata


def printable(text: object) -> str:
    """Return a text without control characters (terminal escapes, direction overrides).

    Line breaks and tabs become blanks, every other control or format character U+FFFD.
    """
    text = str(text)
    if text.isascii() and text.isprintable():
        return text
    return "".join(
        " " if c in "\n\r\t" else "\ufffd" if unicodedata.category(c) in ("Cc", "Cf", "Cs", "Zl", "Zp") else c
        for c in text
    )
