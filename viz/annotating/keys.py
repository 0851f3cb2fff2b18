"""Single keys and lines from the terminal that a program runs in, or from a pipe."""

from __future__ import annotations

import os
import select
import sys
from collections.abc import Callable
from typing import Any, Self

PATIENCE_S = 0.2
"""How long to wait for a key before looking whether there is still something to wait for."""


class Keys:
    """Reads standard input key by key; a context manager that leaves the terminal as it was.

    Parameters
    ----------
    say : callable
        Is given the prompt of a line.
    """

    def __init__(self, say: Callable[[str], object]) -> None:
        self._say = say
        self._fd = sys.stdin.fileno()
        self._before: list[Any] | None = None

    def __enter__(self) -> Self:
        if os.name == "posix" and os.isatty(self._fd):
            import termios
            import tty

            self._before = termios.tcgetattr(self._fd)
            tty.setcbreak(self._fd)
        return self

    def __exit__(self, *_: object) -> None:
        self._cooked()

    def _cooked(self) -> None:
        if self._before is not None:
            import termios

            termios.tcsetattr(self._fd, termios.TCSADRAIN, self._before)

    def next(self) -> str | None:
        """Return the next key, None where none was pressed for a while; ``q`` at the end of a pipe."""
        if os.name != "posix":
            return self._windows()
        if not select.select([self._fd], [], [], PATIENCE_S)[0]:
            return None
        key = os.read(self._fd, 1)
        return key.decode("ascii", "replace") if key else "q"

    def line(self, prompt: str) -> str:
        """Return a line that the user types, without its end and blanks around it."""
        self._cooked()
        self._say(prompt)
        data = bytearray()
        while (byte := os.read(self._fd, 1)) not in (b"", b"\n", b"\r"):
            data += byte
        self.__enter__()
        return data.decode("utf-8", "replace").strip()

    def _windows(self) -> str | None:
        import time

        msvcrt: Any = __import__("msvcrt")
        until = time.monotonic() + PATIENCE_S
        while time.monotonic() < until:
            if msvcrt.kbhit():
                return msvcrt.getwch()
            time.sleep(0.02)
        return None
