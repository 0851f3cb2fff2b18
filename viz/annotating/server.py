"""The server behind the annotating page: this machine only, and only for who has the token.

Whoever can make a browser of this machine ask for an address must not read or change what may be a patient's:
requests for data need the token of the printed address, the name of the host must be this machine's (a foreign
name that resolves here is refused), and the page may load nothing from elsewhere (content security policy).
"""

from __future__ import annotations

import hmac
import mimetypes
import re
import secrets
import threading
from collections.abc import Callable, Mapping
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from typing import Any, Self
from urllib.parse import parse_qs, urlsplit

import msgspec

from ...recording.errors import MarchaError
from ...recording.events import vocabularies
from .. import style
from ..viewer import HOST
from .session import Edit, Row, Session
from .signals import Signals
from .video import Video

POLICY = "; ".join(
    [
        "default-src 'none'",
        "script-src 'self'",
        "style-src 'self'",
        "img-src 'self' data:",
        "media-src 'self'",
        "connect-src 'self'",
        "base-uri 'none'",
        "form-action 'none'",
        "frame-ancestors 'none'",
    ]
)
TYPES = {".html": "text/html; charset=utf-8", ".js": "text/javascript", ".css": "text/css"}
LONGEST = 1 << 26
"""Largest request, bytes."""


class Request(msgspec.Struct, frozen=True):
    """What the page asks for.

    Attributes
    ----------
    revision : int
        The session's revision that the page knows.
    add : tuple of dict
        Annotations to add, times since the recording's start.
    remove : tuple of str
        Ids.
    """

    revision: int = -1
    add: tuple[dict[str, Any], ...] = ()
    remove: tuple[str, ...] = ()


class PageServer:
    """Serves the annotating page of one session; a context manager that ends it.

    Parameters
    ----------
    session : Session
        What is edited.
    video : Video, optional
        Film of the walk, shown beside the signals.

    Attributes
    ----------
    address : str
        What to open in a browser; holds the token.
    """

    def __init__(self, session: Session, video: Video | None = None) -> None:
        self.session, self.video = session, video
        self.signals = Signals(session.rec)
        self.token = secrets.token_urlsafe(24)
        self._server = ThreadingHTTPServer((HOST, 0), _Handler)
        self._server.daemon_threads = True
        self._server.page = self  # type: ignore[attr-defined]
        self.port = int(self._server.server_address[1])
        self.address = f"http://{HOST}:{self.port}/?token={self.token}"
        self._thread = threading.Thread(target=self._server.serve_forever, name="marcha-page", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def wait(self) -> None:
        """Wait until the program is interrupted."""
        while self._thread.is_alive():
            self._thread.join(0.5)  # without a limit an interrupt would wait on some systems

    def close(self) -> None:
        """End the server; what was not saved stays in the session's draft."""
        self._server.shutdown()
        self._server.server_close()
        self.signals.close()

    # ------------------------------------------------------------------------------------------------ answers

    def recording(self) -> dict[str, Any]:
        """Return what the page shows at first."""
        session = self.session
        rec = session.rec
        first, last = rec.data_span or (rec.start_ns or 0, rec.end_ns or 0)
        return {
            "name": rec.path.name,
            "out": session.out.name,
            "by": session.by,
            "start": first - self.signals.zero_ns,
            "end": last - self.signals.zero_ns,
            "panels": self.signals.panels,
            "vocabularies": msgspec.to_builtins(vocabularies(rec.metadata)),
            "colors": style.RUNS,
            "taken_up": session.taken_up,
            "video": None if self.video is None else {"offset_s": self.video.offset_s},
            **self.whole(),
        }

    def whole(self) -> dict[str, Any]:
        """Return the state with all annotations."""
        return {"annotations": [self._relative(r) for r in self.session.rows.values()], **self._state()}

    def _state(self) -> dict[str, Any]:
        session = self.session
        return {
            "revision": session.revision,
            "unsaved": session.unsaved,
            "can_undo": session.can_undo,
            "can_redo": session.can_redo,
        }

    def _relative(self, row: Row) -> dict[str, Any]:
        """Return an annotation with times since the recording's start: a browser's numbers hold those exactly."""
        zero = self.signals.zero_ns
        return {**row, "start_ns": row["start_ns"] - zero, "end_ns": row["end_ns"] - zero}

    def _absolute(self, row: Mapping[str, Any]) -> Row:
        zero = self.signals.zero_ns
        try:
            return {**row, "start_ns": zero + round(row["start_ns"]), "end_ns": zero + round(row["end_ns"])}
        except (KeyError, TypeError, ValueError, OverflowError):
            raise MarchaError("that is no annotation: its start and end must be numbers") from None

    def change(self, name: str, asked: Request) -> dict[str, Any]:
        """Do what the page asks for; the answer says what changed, or everything where its revision is old."""
        session = self.session
        revision = session.revision
        done = Edit()
        document: dict[str, Any] = {}
        if name == "edit":
            done = session.edit([self._absolute(r) for r in asked.add], asked.remove)
        elif name == "undo":
            done = session.undo()
        elif name == "redo":
            done = session.redo()
        else:
            entry = session.save()
            document = {"saved": session.out.name, "change": entry and entry.number}
        steps = 1 if done.added or done.removed else 0
        if asked.revision != revision or session.revision != revision + steps:
            return {**document, **self.whole()}
        ids = {row["id"] for row in done.added}
        return {
            **document,
            "added": [self._relative(r) for r in done.added],
            "removed": [r["id"] for r in done.removed if r["id"] not in ids],
            **self._state(),
        }


class _Handler(BaseHTTPRequestHandler):
    """One connection of the page."""

    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True
    wbufsize = 1 << 16
    server: Any

    @property
    def page(self) -> PageServer:
        return self.server.page

    def do_GET(self) -> None:
        """Answer a request for a file or for data."""
        url = urlsplit(self.path)
        query = {k: v[0] for k, v in parse_qs(url.query).items()}
        if not self._here():
            return
        if url.path in ("/", "/favicon.ico") or re.fullmatch(r"/[a-z]+\.(js|css)", url.path):
            self._file(url.path[1:] or "index.html")
        elif not self._allowed(query.get("token", "")):
            return
        elif url.path == "/api/recording":
            self._json(self.page.recording())
        elif url.path == "/api/overview":
            self._guarded(lambda: self._overview(query))
        elif url.path == "/api/tile":
            self._guarded(lambda: self._tile(query))
        elif url.path == "/video" and self.page.video is not None:
            self._video(self.page.video)
        else:
            self._json({"error": "there is nothing here"}, HTTPStatus.NOT_FOUND)

    def do_POST(self) -> None:
        """Change or save annotations."""
        name = urlsplit(self.path).path.removeprefix("/api/")
        size = self.headers.get("Content-Length", "")
        if not self._here() or not self._allowed(""):
            return
        if name not in ("edit", "undo", "redo", "save") or not size.isdigit() or int(size) > LONGEST:
            self.close_connection = True
            self._json({"error": "there is nothing here"}, HTTPStatus.NOT_FOUND)
            return
        data = self.rfile.read(int(size))
        self._guarded(lambda: self._json(self.page.change(name, msgspec.json.decode(data, type=Request))))

    # ------------------------------------------------------------------------------------------------- guards

    def _here(self) -> bool:
        """Return whether the request names this machine; else refuse it."""
        name = self.headers.get("Host", "")
        if name in (f"{HOST}:{self.page.port}", f"localhost:{self.page.port}"):
            return True
        self.close_connection = True
        self._json({"error": "this page is for its own machine"}, HTTPStatus.FORBIDDEN)
        return False

    def _allowed(self, token: str) -> bool:
        stated = self.headers.get("X-Marcha-Token") or token
        if hmac.compare_digest(stated.encode(), self.page.token.encode()):
            return True
        self.close_connection = True
        self._json({"error": "the address lacks its token; open the printed one"}, HTTPStatus.FORBIDDEN)
        return False

    def _guarded(self, answer: Callable[[], None]) -> None:
        """Let something answer; what it expects to go wrong is said in one line."""
        try:
            answer()
        except (MarchaError, msgspec.MsgspecError, KeyError, ValueError, OSError) as error:
            if isinstance(error, ConnectionError):
                self.close_connection = True
                return
            line = " ".join(str(error).split())
            self._json({"error": line}, HTTPStatus.BAD_REQUEST)

    # ------------------------------------------------------------------------------------------------ answers

    def _file(self, name: str) -> None:
        resource = resources.files(__package__ or "") / "web" / name
        if not resource.is_file():
            self._send(b"", "text/plain", status=HTTPStatus.NOT_FOUND)
            return
        kind = TYPES.get(name[name.rfind(".") :], "application/octet-stream")
        self._send(resource.read_bytes(), kind)

    def _json(self, document: Mapping[str, Any], status: HTTPStatus = HTTPStatus.OK) -> None:
        self._send(msgspec.json.encode(document), "application/json", status=status)

    def _overview(self, query: Mapping[str, str]) -> None:
        about, tile = self.page.signals.overview(query["topic"])
        head = msgspec.json.encode({**about, "count": len(tile.first_ns)}).decode()
        self._send(self.page.signals.packed(tile), "application/octet-stream", {"X-Marcha-Level": head})

    def _tile(self, query: Mapping[str, str]) -> None:
        pyramid = self.page.signals.pyramids[query["topic"]]
        level, index = int(query["level"]), int(query["index"])
        if not pyramid.complete or not 0 <= level <= len(pyramid.sizes) or index < 0:
            raise MarchaError(f"{query['topic']}: there is no tile {index} of level {level}")
        tile = pyramid.tile(level, index)
        count = {"X-Marcha-Count": str(len(tile.first_ns))}
        self._send(
            self.page.signals.packed(tile, rows=level == 0), "application/octet-stream", count, keep=level > 0
        )

    def _video(self, video: Video) -> None:
        """Send the film or the range of it that is asked for."""
        match = re.fullmatch(r"bytes=(\d*)-(\d*)", self.headers.get("Range", ""))
        first, last = 0, video.size - 1
        if match and match[1]:
            first, last = int(match[1]), min(int(match[2] or last), last)
        elif match and match[2]:
            first = max(video.size - int(match[2]), 0)
        if first > last:
            headers = {"Content-Range": f"bytes */{video.size}"}
            self._send(b"", "text/plain", headers, status=HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE)
            return
        last = min(last, first + (1 << 22) - 1) if match else last
        headers = {"Accept-Ranges": "bytes", "Content-Range": f"bytes {first}-{last}/{video.size}"}
        kind = mimetypes.guess_type(video.name)[0] or "video/mp4"
        status = HTTPStatus.PARTIAL_CONTENT if match else HTTPStatus.OK
        self._send(video.read(first, last + 1), kind, headers if match else {}, status=status)

    def _send(
        self,
        data: bytes,
        kind: str,
        headers: Mapping[str, str] | None = None,
        *,
        status: HTTPStatus = HTTPStatus.OK,
        keep: bool = False,
    ) -> None:
        try:
            self.send_response(status)
            standard = {
                "Content-Type": kind,
                "Content-Length": str(len(data)),
                "Content-Security-Policy": POLICY,
                "Referrer-Policy": "no-referrer",
                "X-Content-Type-Options": "nosniff",
                "Cache-Control": "private, max-age=3600" if keep else "no-store",
            }
            for name, value in {**standard, **(headers or {})}.items():
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(data)
            self.wfile.flush()
        except OSError:  # the page went away
            self.close_connection = True

    def log_message(self, format: str, *args: object) -> None:
        """Say nothing."""
