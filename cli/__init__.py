"""The command ``marcha``: parses, calls, prints; the work is done in the other packages."""

from __future__ import annotations

from collections.abc import Sequence

__all__ = ["main"]


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``marcha`` and return the exit code; Ctrl-C while it loads ends it without a word of Python's.

    Parameters
    ----------
    argv : sequence of str, optional
        Arguments without the program's name; those of the process by default.
    """
    try:
        from .app import main as run
    except KeyboardInterrupt:
        return 130
    return run(argv)
