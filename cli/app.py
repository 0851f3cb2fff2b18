"""The command line application: the list of commands, and what becomes of their results and failures.

Nothing heavy is imported here or at the top of a command's module: ``marcha --help`` must answer at once.
"""

from __future__ import annotations

import io
import os
import signal
import sys
import threading
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from cyclopts import App, CycloptsError, Group

from .console import (
    Outcome,
    complain,
    emit,
    emit_json,
    warn,
)
from .errors import (
    DONE,
    FAILED,
    USAGE,
    Terminated,
    expected,
)
from .options import QUIET

EPILOGUE = (
    "Exit codes: 0 done; 1 failed; 2 wrong usage; 3 done, but data was lost or\n"
    "repaired in a way you should know; 4 a threshold was missed; 130 interrupted (Ctrl-C);\n"
    "143 ended (SIGTERM)."
)

RAW = Group("From raw logs", sort_key=1)
WORK = Group("Recordings", sort_key=2)
HAND = Group("Look and hand on", sort_key=3)
MORE = Group("More", sort_key=4)

COMMANDS: tuple[tuple[Group, str, str, str], ...] = (
    (RAW, "formats", "available:formats", "List the formats that can be read and written."),
    (RAW, "simulate", "simulate:simulate", "Write raw logs of a simulated walk with known truth."),
    (RAW, "convert", "convert:convert", "Turn raw logs into recordings and report every defect."),
    (RAW, "align", "align:align", "Move the optical clock of a recording to the inertial one."),
    (WORK, "info", "contents:info", "Show what a recording holds."),
    (WORK, "check", "contents:check", "Look for what is wrong with a recording."),
    (
        WORK,
        "estimators",
        "available:estimators",
        "List estimators and calibrations, with parameters of those named.",
    ),
    (WORK, "replay", "replay:replay", "Feed a recording to estimators as if it were live."),
    (WORK, "evaluate", "replay:evaluate", "Measure the estimates of a replayed recording."),
    (WORK, "calibrate", "calibrate:calibrate", "Let a calibration look at recordings and write its result."),
    (WORK, "tune", "tune:tune", "Search the thresholds that fit walks of known length best."),
    (WORK, "study", "study:study", "Compare estimators over many recordings, with statistics."),
    (HAND, "view", "view:view", "Show recordings on one time line in the Rerun viewer."),
    (
        HAND,
        "report",
        "report:report",
        "Write one HTML page about recordings: figures, errors, annotations, origin.",
    ),
    (
        HAND,
        "annotate",
        "annotate:app",
        "Add, change, import, export, list or compare annotations of a recording.",
    ),
    (HAND, "export", "export:export", "Write a recording, or part of it, in another tool's format."),
    (HAND, "cut", "parts:cut", "Write a part of a recording: a range of time, or what an annotation marks."),
    (HAND, "merge", "parts:merge", "Join recordings into one, each with its offset in time."),
    (
        HAND,
        "anonymize",
        "parts:anonymize",
        "Take names, serials, dates and fixes out of a recording, and list what is left.",
    ),
    (HAND, "demo", "demo:demo", "Simulate, convert, replay, evaluate and export three walks."),
    (
        MORE,
        "completion",
        "completion:completion",
        "Print the script that completes commands in your shell, or install it.",
    ),
)
"""Group, name, where it is, and the first line of its docstring: known without importing the command."""


def _version() -> str:
    from importlib.metadata import version

    return version("marcha")


def build(*, overview: bool = False) -> App:
    """Return the application with every command registered.

    ``overview`` takes the commands' summaries from :data:`COMMANDS`, so that listing them imports none.
    """
    app = App(
        name="marcha",
        help="From raw logs of walking to one recording, replayed and looked at.",
        help_epilogue=EPILOGUE,
        version=_version,
        default_parameter=QUIET,
        help_format="plaintext",
        help_formatter="plain" if overview else "default",  # plain is there in half the time
        result_action="return_value",
        suppress_keyboard_interrupt=False,
    )
    app["--help"].group = app["--version"].group = MORE
    for group, name, target, summary in COMMANDS:
        app.command(f"{__package__}.{target}", name=name, help=summary if overview else None, group=group)
    return app


@contextmanager
def _ending_well() -> Iterator[None]:
    """Let SIGTERM and SIGHUP unwind the command as Ctrl-C does: nothing half written stays, nothing runs on."""

    def end(number: int, frame: object) -> None:
        signal.signal(number, signal.SIG_DFL)  # a second one ends it at once
        raise Terminated(number)

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    names = [n for n in ("SIGTERM", "SIGHUP") if hasattr(signal, n)]
    before = {n: signal.signal(getattr(signal, n), end) for n in names}
    try:
        yield
    finally:
        for name, handler in before.items():
            signal.signal(getattr(signal, name), handler)


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``marcha`` and return the exit code.

    Parameters
    ----------
    argv : sequence of str, optional
        Arguments without the program's name; those of the process by default.
    """
    for stream in (sys.stdout, sys.stderr):  # a terminal of another encoding: what it lacks becomes escapes
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    with _ending_well():
        return _run(argv)


def _run(argv: Sequence[str] | None) -> int:
    tokens = list(sys.argv[1:] if argv is None else argv)
    as_json = "--json" in tokens[: tokens.index("--")] if "--" in tokens else "--json" in tokens
    try:
        overview = not tokens or tokens[0].startswith("-")
        with warnings.catch_warnings():
            warnings.showwarning = warn
            # As `overflow_unsaid` in the library, which would load NumPy: `marcha … --help` must answer at once.
            warnings.filterwarnings("ignore", r"(overflow|invalid value) encountered", RuntimeWarning)
            result = build(overview=overview)(tokens, exit_on_error=False, print_error=False)
        code = _finish(result, as_json=as_json)
        sys.stdout.flush()
        return code
    except CycloptsError as error:
        return _usage(error, as_json=as_json)
    except BrokenPipeError:
        # the reader of a pipe went away (`marcha info … | head`): nobody is left to tell
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED
    except (Exception, KeyboardInterrupt) as error:
        outcome = expected(error)
        if outcome is None:
            raise
        line, code = outcome
        if as_json and not isinstance(error, KeyboardInterrupt):
            emit_json({"error": line, "exit_code": code})
        complain(line)
        return code


def _finish(result: Any, *, as_json: bool) -> int:
    if isinstance(result, Outcome):
        emit(result, as_json=as_json)
        return result.code
    return result if isinstance(result, int) else DONE


def _usage(error: CycloptsError, *, as_json: bool) -> int:
    words = " ".join(str(error).split())
    command = " ".join(("marcha", *(error.command_chain or ())))
    line = f"{words} See {command} --help."
    if as_json:
        emit_json({"error": line, "exit_code": USAGE})
    complain(line)
    return USAGE
