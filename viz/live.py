"""Views that open: a viewer for recordings, and a replay's results as they come."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import polars as pl

from ..recording import Recording
from ..recording.atomic import AtomicFile
from ..recording.errors import UsageError
from ..replay.sinks import Sink
from . import viewer
from .text import printable
from .viewer import Viewer

if TYPE_CHECKING:
    from ..replay import Plan, ReplayResult
    from .scene import Scene


def show(
    recs: Recording | Sequence[Recording],
    web: bool = False,
    wait: bool | None = None,
    *,
    open_browser: bool = True,
    online: bool = False,
    opened: Callable[[Viewer], object] | None = None,
) -> Viewer:
    """Open recordings in the viewer.

    Parameters
    ----------
    recs : Recording or sequence of Recording
        Several are shown together, each below its own name.
    web : bool
        In the browser, served to this machine only.
    wait : bool, optional
        Return only when the viewer has been closed (the web viewer: on Ctrl-C). By default a native viewer
        stays open by itself, and the web viewer is waited for.
    open_browser : bool
        Whether to open a browser window by itself.
    online : bool
        Whether the viewer may reach other hosts (tiles of maps, Rerun's reports of its use).
    opened : callable, optional
        Called with the viewer once it runs, for example to print its ``address``.

    Returns
    -------
    Viewer
        The process; ``close`` ends it.

    Raises
    ------
    UsageError
        No display on this machine.
    MarchaError
        The viewer did not start.
    """
    import rerun as rr

    from .draw import draw
    from .stream import finish, new_stream, release

    recs = [recs] if isinstance(recs, Recording) else list(recs)
    if web:
        window = viewer.web(open_browser=open_browser, online=online)
    else:
        window = viewer.native(online=online)
    try:
        if opened is not None:
            opened(window)
        stream = new_stream()
        stream.set_sinks(rr.GrpcSink(viewer.uri(window.port)))
        draw(recs, stream)
        finish(stream)
        del stream
        release()
        if wait if wait is not None else web:
            _take_back_interrupts()
            with window:
                window.wait()
    except BaseException:
        window.close()
        raise
    return window


def _take_back_interrupts() -> None:
    """Have Ctrl-C end the wait: Rerun's library takes the signal once it has sent data."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.getsignal(signal.SIGINT))


_BEAT_NS = 100_000_000
"""Messages are sent together at least so long apart in log time: a viewer shows no more, and a call a message
and topic would not keep up with real time."""


class LiveSink(Sink):
    """A replay's sink that shows everything as it comes: in a file, a viewer, a browser, or all of them.

    Parameters
    ----------
    path : path, optional
        ``.rrd`` to write; there whole when the replay has ended well, or not at all.
    show, web : bool
        Viewers to open: native, browser. They stay open when the replay has ended.
    overwrite : bool
        Whether an earlier file may be replaced.
    open_browser : bool
        Whether the web viewer opens a browser window by itself.
    online : bool
        Whether viewers may reach other hosts.

    Attributes
    ----------
    viewers : list of Viewer
        The open viewers; ``wait`` or ``close`` them.
    """

    def __init__(
        self,
        path: Path | str | None = None,
        *,
        show: bool = False,
        web: bool = False,
        overwrite: bool = False,
        open_browser: bool = True,
        online: bool = False,
    ) -> None:
        if path is None and not show and not web:
            raise UsageError("a live view needs a file, a viewer or the web viewer")
        self._path = None if path is None else Path(path)
        self._show, self._web, self._overwrite, self._browser = show, web, overwrite, open_browser
        self._online = online
        self._file: AtomicFile | None = None
        self._scene: Scene | None = None
        self._held: dict[str, list[pl.DataFrame]] = {}
        self._sent_ns: int | None = None
        self.viewers: list[Viewer] = []

    def open(self, plan: Plan) -> None:
        """Open the file and the viewers."""
        import rerun as rr

        from .stream import new_stream

        self._plan = plan
        sinks: list[rr.FileSink | rr.GrpcSink] = []
        try:
            if self._path is not None:
                self._file = AtomicFile(self._path, overwrite=self._overwrite)
                sinks.append(rr.FileSink(self._file.part))
            if self._show:
                self.viewers.append(viewer.native(online=self._online))
            if self._web:
                self.viewers.append(viewer.web(open_browser=self._browser, online=self._online))
            sinks += [rr.GrpcSink(viewer.uri(v.port)) for v in self.viewers]
            self._stream = new_stream()
            self._stream.set_sinks(*sinks)
            self._stream.send_recording_name(printable(Path(plan.source).stem))
        except BaseException:
            self._abort()
            raise

    def write(self, topic: str, table: pl.DataFrame) -> None:
        """Show messages of one topic, with all others of the same tenth of a second."""
        if not table.height:
            return
        newest = int(table["t_log_ns"][-1])
        if self._sent_ns is None or newest < self._sent_ns:  # the first message, or a seek backwards
            self._send()
            self._sent_ns = newest
        self._held.setdefault(topic, []).append(table)
        if newest - self._sent_ns >= _BEAT_NS:
            self._send()
            self._sent_ns = newest

    def _send(self) -> None:
        held, self._held = self._held, {}
        for topic, tables in held.items():
            table = pl.concat(tables) if len(tables) > 1 else tables[0]
            self._begun(int(table["t_ns"][0])).write(topic, table)

    def close(self, result: ReplayResult | None) -> None:
        """Draw what needs the whole, and put the file in its place; ``result`` is None where the replay
        failed.
        """
        import rerun as rr

        from .blueprint import blueprint, extent
        from .report import replay_report
        from .stream import finish, release, send_blueprint
        from .top_view import log_top_view

        if result is None:
            self._abort()
            return
        try:
            self._send()
            scene = self._begun(0)
            scene.end()
            text = rr.TextDocument(replay_report(result), media_type=rr.MediaType.MARKDOWN)
            canvas = scene.canvas
            canvas.static(f"{canvas.prefix}/report", text)
            log_top_view(self._stream, *extent([canvas]))
            # the saved view opens at the whole track; open viewers keep what their user has arranged
            send_blueprint(self._stream, blueprint([canvas]), make_active=False)
            finish(self._stream, self._file)
            del scene, canvas
            self._scene = None
            del self._stream
            release()
        except BaseException:
            self._abort()
            raise
        if self._file is not None:
            self._file.commit()

    def _abort(self) -> None:
        if self._file is not None:
            self._file.abort()
        for window in self.viewers:
            window.close()

    def _begun(self, t_ns: int) -> Scene:
        """Return the scene; where time begins is known with the first message."""
        from .blueprint import blueprint, extent
        from .canvas import Canvas
        from .scene import Scene
        from .stream import send_blueprint
        from .timeaxis import axis_from
        from .top_view import log_top_view

        if self._scene is None:
            runs = {f"run/{r.run}": {"input": r.input} for r in self._plan.runs}
            canvas = Canvas(self._stream, self._plan.channels.values(), axis_from(t_ns), metadata=runs)
            self._scene = Scene(canvas)
            self._scene.begin()
            log_top_view(self._stream, *extent([canvas]))  # 10 m by 10 m until more is known
            send_blueprint(self._stream, blueprint([canvas], live=True))
        return self._scene
