"""The wall clock that paces a replay. It is injected, so tests never sleep."""

from __future__ import annotations

import time
from typing import Protocol


class Clock(Protocol):
    """What the engine asks of a clock."""

    def now_ns(self) -> int:
        """Return a monotonic time in nanoseconds; the zero does not matter."""
        ...

    def sleep(self, seconds: float) -> None:
        """Return after about ``seconds``."""
        ...


class SystemClock:
    """The computer's monotonic clock."""

    def now_ns(self) -> int:
        """Return ``time.monotonic_ns()``."""
        return time.monotonic_ns()

    def sleep(self, seconds: float) -> None:
        """Sleep."""
        time.sleep(seconds)


class ManualClock:
    """A clock that only moves when told or slept on: replay at any speed without waiting.

    Attributes
    ----------
    time_ns : int
        Present time.
    slept : list of float
        Every sleep asked for, in seconds.
    """

    def __init__(self, time_ns: int = 0) -> None:
        self.time_ns = time_ns
        self.slept: list[float] = []

    def now_ns(self) -> int:
        """Return the present time."""
        return self.time_ns

    def sleep(self, seconds: float) -> None:
        """Move the time on by ``seconds`` at once."""
        self.slept.append(seconds)
        self.time_ns += max(1, round(seconds * 1e9))
