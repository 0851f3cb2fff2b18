"""Which failures are expected, the one line that says them, and the exit code."""

from __future__ import annotations

import errno

DONE, FAILED, USAGE, DEFECTS, THRESHOLD, INTERRUPTED = 0, 1, 2, 3, 4, 130


class Terminated(KeyboardInterrupt):
    """The process was asked to end by a signal."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self.exit_code = 128 + number


def expected(error: BaseException) -> tuple[str, int] | None:
    """Return the one line and the exit code of an expected failure, None where it is a bug.

    Expected are :class:`MarchaError` (its own exit code), :class:`AlgorithmError` (the call is wrong: 2), an
    ``OSError`` that names a path or says that the disk is full, a text that is no Unicode, and the keyboard.
    """
    if isinstance(error, Terminated):
        return "ended by a signal; nothing was left half written", error.exit_code
    if isinstance(error, KeyboardInterrupt):
        return "interrupted; nothing was left half written", INTERRUPTED
    if isinstance(error, OSError):
        return _operating_system(error)
    if isinstance(error, UnicodeEncodeError):  # an argument in another encoding than the terminal's
        return f"{error.object[:60]!r}: holds bytes that are no UTF-8; write it in UTF-8", USAGE
    if isinstance(error, MemoryError):
        return "out of memory; nothing was left half written", FAILED
    from ..algorithms.contract import AlgorithmError
    from ..recording.errors import MarchaError

    if isinstance(error, MarchaError):
        return _one_line(error), error.exit_code
    if isinstance(error, AlgorithmError):
        return _one_line(error), USAGE
    return None


def _operating_system(error: OSError) -> tuple[str, int] | None:
    reason = error.strerror or str(error)
    if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        where = f"{error.filename}: " if error.filename else ""
        return f"{where}{reason}; free some space or write elsewhere; the output was not created", FAILED
    if error.filename is None:
        return None
    return f"{error.filename}: {reason}", FAILED


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split())
