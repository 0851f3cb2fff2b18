"""The page of the web viewer, served to this machine only, and kept from every other host.

A program of its own, started by :func:`marcha.viz.viewer.web`: it needs nothing but the standard library. It
starts Rerun's server, hands its files on with a content security policy under which a browser talks to no
other host (Rerun's page asks for fonts, counts visits and reports use), and ends both when its standard input
closes: when the program that started it has ended, in whatever way.

``python webpage.py PAGE_PORT INNER_PORT DATA_PORT COMMAND…``; with a DATA_PORT of 0 there is no policy.
"""

from __future__ import annotations

import http.client
import os
import signal
import subprocess
import sys
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from types import FrameType

HOST = "127.0.0.1"
BLOCK = 1 << 16


def policy(data_port: int) -> str:
    """Return the content security policy: this page's own files, and the data from ``data_port``."""
    data = f"http://{HOST}:{data_port} http://localhost:{data_port}"
    return "; ".join(
        [
            "default-src 'none'",
            "script-src 'self' 'unsafe-inline' 'wasm-unsafe-eval' blob:",
            "style-src 'self' 'unsafe-inline'",
            "img-src 'self' data: blob:",
            "font-src 'self' data:",
            "worker-src 'self' blob:",
            f"connect-src 'self' data: blob: {data}",
            "base-uri 'none'",
            "form-action 'none'",
            "frame-ancestors 'self'",
        ]
    )


class Page(BaseHTTPRequestHandler):
    """Hands on what Rerun's own server of the page says, under the policy."""

    inner_port = 0
    policy = ""
    protocol_version = "HTTP/1.1"

    def do_GET(self) -> None:
        """Answer a request for a file."""
        inner = http.client.HTTPConnection(HOST, self.inner_port, timeout=10.0)
        try:
            # the address of the data is for the page, not for the server of files
            inner.request("GET", self.path.partition("?")[0])
            answer = inner.getresponse()
            self.send_response(answer.status)
            for name in ("Content-Type", "Content-Length", "rerun-final-length"):
                if value := answer.getheader(name):
                    self.send_header(name, value)
            if self.policy:
                self.send_header("Content-Security-Policy", self.policy)
            self.send_header("Referrer-Policy", "no-referrer")
            if answer.getheader("Content-Length") is None:  # its end is the end of the connection
                self.send_header("Connection", "close")
                self.close_connection = True
            self.end_headers()
            while part := answer.read(BLOCK):
                self.wfile.write(part)
        except (OSError, http.client.HTTPException):
            self.close_connection = True
        finally:
            inner.close()

    def log_message(self, format: str, *args: object) -> None:
        """Say nothing."""


def main(page_port: int, inner_port: int, data_port: int, command: list[str]) -> int:
    """Serve until standard input closes, a signal comes, or Rerun's server ends; return its exit code."""
    Page.inner_port, Page.policy = inner_port, policy(data_port) if data_port else ""
    server = ThreadingHTTPServer((HOST, page_port), Page)
    server.daemon_threads = True
    rerun = subprocess.Popen(command, stdin=subprocess.DEVNULL, start_new_session=True)

    def end(*_: int | FrameType | None) -> None:
        if rerun.poll() is None:
            _kill(rerun, force=False)

    def watch() -> None:
        while sys.stdin.buffer.read(1):
            pass
        end()

    for name in ("SIGTERM", "SIGINT", "SIGHUP"):
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), end)
    threading.Thread(target=watch, daemon=True).start()
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        return rerun.wait()
    finally:
        _kill(rerun, force=True)


def _kill(process: subprocess.Popen[bytes], *, force: bool) -> None:
    """End Rerun's server and its child; by force it is made sure of."""
    if os.name == "posix":
        try:
            os.killpg(process.pid, signal.SIGKILL if force else signal.SIGTERM)
        except ProcessLookupError:
            return
    elif process.poll() is None:  # /T takes the children too
        subprocess.run(["taskkill", "/PID", str(process.pid), "/T", "/F"], capture_output=True, check=False)


if __name__ == "__main__":
    ports = [int(a) for a in sys.argv[1:4]]
    sys.exit(main(ports[0], ports[1], ports[2], sys.argv[4:]))
