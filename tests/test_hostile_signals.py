"""Every command that is registered ends at Ctrl-C and SIGTERM, and leaves nothing: neither files nor processes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from marcha.cli.app import COMMANDS as REGISTERED

from .kills import COMMANDS, PATIENCE_S, PRINTING, gone, living

pytestmark = pytest.mark.skipif(os.name != "posix", reason="needs signals")

PROGRAM = """
import os, sys, threading, time
folder, waited = sys.argv[1], []
def hook(event, arguments):
    if event in ("open", "os.mkdir", "os.scandir") and isinstance(arguments[0], (str, os.PathLike)) and not waited:
        if str(arguments[0]).startswith(folder) and threading.current_thread() is threading.main_thread():
            waited.append(1)
            sys.stdout.write("there\\n")
            sys.stdout.flush()
            time.sleep(60)
sys.addaudithook(hook)
from marcha.cli import main
sys.exit(main(sys.argv[2:]))
"""
"""A command that waits where it first touches the folder."""


def test_every_registered_command_is_among_those_that_are_ended() -> None:
    """A new command fails here until :mod:`tests.kills` ends it as well."""
    assert {c.arguments[0] for c in COMMANDS} == {name for _, name, _, _ in REGISTERED} - PRINTING


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Files of the names that the commands are given; none gets so far as to read them."""
    place = tmp_path_factory.mktemp("ended").resolve()
    (place / "logs").mkdir()
    for name in (
        "in.mcap",
        "done.mcap",
        "leg.mcap",
        "study.toml",
        "logs/conf-3333-walk.csv",
        "logs/walk.zip",
    ):
        (place / name).write_bytes(b"")
    return place


@pytest.mark.parametrize("k", range(len(COMMANDS)), ids=[c.name for c in COMMANDS])
def test_a_signal_ends_every_command(folder: Path, k: int) -> None:
    number = (signal.SIGINT, signal.SIGTERM)[k % 2]
    before = sorted(folder.rglob("*"))
    said = [str(folder / a) if a in GIVEN else a for a in COMMANDS[k].arguments]
    process = subprocess.Popen(
        [sys.executable, "-c", PROGRAM, str(folder), *said],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == b"there\n"
    os.kill(process.pid, number)
    _, err = process.communicate(timeout=20)
    assert process.returncode == 128 + number, err.decode()
    assert err.decode().count("\n") == 1, err.decode()
    assert gone(process.pid, PATIENCE_S), living(process.pid)
    assert sorted(folder.rglob("*")) == before


GIVEN = {
    a
    for c in COMMANDS
    for a in c.arguments
    if a.startswith(("in.", "done.", "leg.", "study.", "logs", "out"))
}
"""Arguments that are paths."""
