"""Viewer processes, native and web, that listen on this machine only.

Rerun's own ``spawn`` and ``serve_web_viewer`` bind all interfaces of the machine, so the bundled program
is started here with ``--bind 127.0.0.1``.
"""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from typing import Self
from urllib.parse import quote

from ..recording.errors import MarchaError, UsageError

HOST = "127.0.0.1"
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


class Viewer:
    """A running viewer process; a context manager that ends it.

    Attributes
    ----------
    port : int
        Where it listens for data.
    address : str
        What to open in a browser; of the native viewer, where it takes data.
    """

    def __init__(self, arguments: Sequence[str], port: int, address: str = "") -> None:
        self.port, self.address = port, address or uri(port)
        self._said = tempfile.TemporaryFile()  # noqa: SIM115 - it lives as long as the process
        self._process = subprocess.Popen(
            [sys.executable, "-m", "rerun_cli", *arguments],
            stdout=self._said,
            stderr=self._said,
            stdin=subprocess.DEVNULL,
            start_new_session=True,  # one group to end, and it may outlive us
            env={**os.environ, "RERUN_APP_ONLY": "true"},
        )
        self._wait_until_it_listens()

    def _wait_until_it_listens(self) -> None:
        until = time.monotonic() + PATIENCE_S
        while time.monotonic() < until and self._process.poll() is None:
            try:
                socket.create_connection((HOST, self.port), timeout=1.0).close()
            except OSError:
                time.sleep(0.02)
            else:
                return
        self.close()
        self._said.seek(0)
        lines = [line for line in self._said.read().decode(errors="replace").splitlines() if line.strip()]
        lines = [line for line in lines if "error" in line.lower()] or lines or ["it said nothing"]
        raise MarchaError(f"the Rerun viewer did not start: {lines[0]}")

    @property
    def running(self) -> bool:
        """Whether the process lives."""
        return self._process.poll() is None

    def wait(self) -> None:
        """Wait until the user closes it."""
        self._process.wait()

    def close(self) -> None:
        """End the process and what it started."""
        if self._process.poll() is None:
            if os.name == "posix":
                os.killpg(self._process.pid, signal.SIGTERM)
            else:  # /T takes the children too
                subprocess.run(["taskkill", "/PID", str(self._process.pid), "/T", "/F"], capture_output=True)
            try:
                self._process.wait(5.0)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def native(*, headless: bool = False, size: tuple[int, int] | None = None) -> Viewer:
    """Start the native viewer, waiting for data on a port of its own.

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
    return Viewer(["--bind", HOST, "--port", str(port), "--hide-welcome-screen", *flags], port)


def web(*, open_browser: bool = True) -> Viewer:
    """Start the web viewer, waiting for data on a port of its own; it serves browsers of this machine.

    Raises
    ------
    MarchaError
        It did not start.
    """
    port, page = free_port(), free_port()
    mode = "--web-viewer" if open_browser else "--serve-web"
    arguments = [mode, "--bind", HOST, "--port", str(port), "--web-viewer-port", str(page)]
    return Viewer(arguments, port, f"http://{HOST}:{page}?url={quote(uri(port), safe='')}")
