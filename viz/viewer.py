"""Viewer processes, native and web, that listen on this machine only.

Rerun's own ``spawn`` and ``serve_web_viewer`` bind all interfaces of the machine, so the bundled program
is started here with ``--bind 127.0.0.1``.

What is seen may be a patient's: unless asked for (``online``), the viewer reaches no other host. Rerun reports
its use, asks for map tiles and loads fonts; the native program is told of a proxy that does not exist, the web
page has a content security policy (:mod:`marcha.viz.webpage`).
"""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
import webbrowser
from collections.abc import Sequence
from pathlib import Path
from typing import Self
from urllib.parse import quote

from ..recording.errors import MarchaError, UsageError

HOST = "127.0.0.1"
NOWHERE = f"http://{HOST}:9"
"""A proxy that does not exist (9 is the port of the discard service)."""

PATIENCE_S = 30.0
"""How long a viewer may take until it listens."""


def free_port() -> int:
    """Return a TCP port of this machine that nobody listens on."""
    with socket.socket() as probe:
        probe.bind((HOST, 0))
        return int(probe.getsockname()[1])


def uri(port: int) -> str:
    """Return the address by which a viewer and a recording stream meet."""
    return f"rerun+http://{HOST}:{port}/proxy"


RERUN = (sys.executable, "-m", "rerun_cli")
WEBPAGE = Path(__file__).with_name("webpage.py")


class Viewer:
    """A running viewer process; a context manager that ends it.

    Attributes
    ----------
    port : int
        Where it listens for data.
    address : str
        What to open in a browser; of the native viewer, where it takes data.
    """

    def __init__(
        self,
        command: Sequence[str],
        port: int,
        *,
        address: str = "",
        listens: Sequence[int] = (),
        tied: bool = False,
        online: bool = False,
    ) -> None:
        """Start a process and wait until it listens.

        Parameters
        ----------
        command : sequence of str
            Program and arguments.
        port : int
            Where it will listen for data.
        address : str
            See above.
        listens : sequence of int
            Further ports that it will listen on.
        tied : bool
            Whether it ends when this program ends, in whatever way: its standard input closes then.
        online : bool
            Whether it may reach other hosts.
        """
        self.port, self.address = port, address or uri(port)
        self._said = tempfile.TemporaryFile()  # noqa: SIM115 - it lives as long as the process
        self._process = subprocess.Popen(
            list(command),
            stdout=self._said,
            stderr=self._said,
            stdin=subprocess.PIPE if tied else subprocess.DEVNULL,
            start_new_session=True,  # one group to end, and it may outlive us
            env={**os.environ, "RERUN_APP_ONLY": "true", **({} if online else offline())},
        )
        for one in (port, *listens):
            self._wait_until_it_listens(one)

    def _wait_until_it_listens(self, port: int) -> None:
        until = time.monotonic() + PATIENCE_S
        while time.monotonic() < until and self._process.poll() is None:
            try:
                socket.create_connection((HOST, port), timeout=1.0).close()
            except OSError:
                time.sleep(0.02)
            else:
                return
        reason = self.complaint("error")
        self.close()
        raise MarchaError(f"the Rerun viewer did not start: {reason}")

    def complaint(self, word: str) -> str:
        """Return the first line with a word that the process said, else the first line."""
        self._said.seek(0)
        lines = [line for line in self._said.read().decode(errors="replace").splitlines() if line.strip()]
        lines = [line for line in lines if word in line.lower()] or lines or ["it said nothing"]
        return lines[0]

    @property
    def running(self) -> bool:
        """Whether the process lives."""
        return self._process.poll() is None

    def wait(self) -> None:
        """Wait until the user closes it."""
        self._process.wait()

    def close(self) -> None:
        """End the process and what it started."""
        if self._process.stdin is not None:
            self._process.stdin.close()
        if self._process.poll() is None:
            if os.name == "posix":
                os.killpg(self._process.pid, signal.SIGTERM)
            else:  # /T takes the children too
                subprocess.run(["taskkill", "/PID", str(self._process.pid), "/T", "/F"], capture_output=True)
            try:
                self._process.wait(1.0)
            except subprocess.TimeoutExpired:
                if os.name == "posix":
                    os.killpg(self._process.pid, signal.SIGKILL)
                self._process.kill()
                self._process.wait()
        self._said.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def offline() -> dict[str, str]:
    """Return environment variables under which a program finds no other host."""
    names = ("HTTP_PROXY", "HTTPS_PROXY", "ALL_PROXY")
    here = f"{HOST},localhost"
    reachable = {"NO_PROXY": here, "no_proxy": here}
    return {**dict.fromkeys(names, NOWHERE), **{n.lower(): NOWHERE for n in names}, **reachable}


def native(*, headless: bool = False, size: tuple[int, int] | None = None, online: bool = False) -> Viewer:
    """Start the native viewer, waiting for data on a port of its own.

    Parameters
    ----------
    headless : bool
        Without a window.
    size : (int, int), optional
        Width and height, pixels.
    online : bool
        Whether it may reach other hosts: tiles of maps, and Rerun's own reports of use.

    Raises
    ------
    UsageError
        No display on this machine.
    MarchaError
        It did not start.
    """
    display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if not headless and sys.platform.startswith("linux") and not display:
        raise UsageError("no display for the viewer; use --web, or --rrd FILE and open that file elsewhere")
    port = free_port()
    flags = ["--headless"] if headless else ["--expect-data-soon"]
    if size is not None:
        flags += ["--window-size", f"{size[0]}x{size[1]}"]
    command = [*RERUN, "--bind", HOST, "--port", str(port), "--hide-welcome-screen", *flags]
    return Viewer(command, port, online=online)


def web(*, open_browser: bool = True, online: bool = False) -> Viewer:
    """Start the web viewer, waiting for data on a port of its own; it serves browsers of this machine, and
    ends with this program.

    Parameters
    ----------
    open_browser : bool
        Whether to open a browser window.
    online : bool
        Whether the page may reach other hosts.

    Raises
    ------
    MarchaError
        It did not start.
    """
    port, page, inner = free_port(), free_port(), free_port()
    rerun = [*RERUN, "--serve-web", "--bind", HOST, "--port", str(port), "--web-viewer-port", str(inner)]
    ours = [sys.executable, str(WEBPAGE), str(page), str(inner), "0" if online else str(port)]
    shown = f"http://{HOST}:{page}/?url={quote(uri(port), safe='')}"
    viewer = Viewer([*ours, *rerun], port, address=shown, listens=(page, inner), tied=True, online=online)
    if open_browser:
        webbrowser.open(shown)
    return viewer
