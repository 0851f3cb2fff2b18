"""The annotating page: opened, waited for, ended."""

from __future__ import annotations

import webbrowser
from collections.abc import Callable
from pathlib import Path

from .server import PageServer
from .session import Session, ended_by_keyboard
from .video import video_of


def annotate_page(
    session: Session,
    *,
    video: Path | None = None,
    video_offset_s: float = 0.0,
    open_browser: bool = True,
    opened: Callable[[PageServer], object] | None = None,
) -> bool:
    """Serve the page for a session until the program is interrupted.

    Parameters
    ----------
    session : Session
        What is edited; what is not saved at the end stays in its draft.
    video : Path, optional
        Film of the walk; one in or beside the recording is found without it.
    video_offset_s : float
        Time of the recording, seconds from its start, at which the film begins.
    open_browser : bool
        Whether to open a browser window.
    opened : callable, optional
        Called with the server once it runs, for example to print its address.

    Returns
    -------
    bool
        Whether Ctrl-C ended it; SIGTERM is raised.

    Raises
    ------
    MarchaError
        There is no such film.
    """
    with PageServer(session, video_of(session.rec, video, video_offset_s)) as server:
        if opened is not None:
            opened(server)
        if open_browser:
            webbrowser.open(server.address)
        return ended_by_keyboard(server.wait)
