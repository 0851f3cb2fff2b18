"""Pictures of the viewer without a display: software Vulkan is enough."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..recording.errors import MarchaError
from . import viewer

PATIENCE_S = 60.0
"""How long a recording may take to load."""

SETTLE_S = 1.5
"""Plots find their bounds some frames after the cursor has moved."""


@dataclass(frozen=True)
class Screenshot:
    """A picture of the viewer, and what its views complained of.

    Attributes
    ----------
    tab : str
        Name of the tab that was shown.
    png : bytes
        The picture.
    reports : tuple of str
        Warnings and errors of the views; empty where all is well.
    """

    tab: str
    png: bytes
    reports: tuple[str, ...]


def screenshots(
    rrd: Path | str,
    tabs: Sequence[str] = ("Overview",),
    *,
    at: float = 1.0,
    size: tuple[int, int] = (1600, 900),
    patience_s: float = PATIENCE_S,
) -> list[Screenshot]:
    """Open a ``.rrd`` in a viewer without a window and take a picture of each tab.

    Parameters
    ----------
    rrd : path
        Recording with its blueprint.
    tabs : sequence of str
        Names of the tabs to show, one after another.
    at : float
        Where the cursor stands, from 0 (start) to 1 (end).
    size : (int, int)
        Width and height, pixels.
    patience_s : float
        How long the recording may take to load.

    Raises
    ------
    MarchaError
        No graphics (Debian: mesa-vulkan-drivers and libvulkan1), the recording did not load, it has no such
        tab, or the viewer did not answer.
    """
    import numpy as np
    from rerun.experimental import ViewerClient

    from .timeaxis import SINCE_START

    path = Path(rrd).resolve()
    with viewer.native(headless=True, size=size) as process, _answering(process, path):
        client = ViewerClient.connect(viewer.uri(process.port))
        client.open(str(path))
        state = loaded(client, path, patience_s)
        line = next(t for t in state.recordings[0].timelines if t.name == SINCE_START)
        start, end = line.start or 0, line.end or 0
        cursor = start + round((end - start) * at)
        client.set_time(SINCE_START, duration=np.timedelta64(cursor, "ns"), play_state="paused")
        layout = client.get_blueprint(of="recording").blueprint
        pictures = []
        for tab in tabs:
            _show_tab(client, layout, tab, path, patience_s)
            time.sleep(SETTLE_S)
            png = client.take_screenshot()
            reports = tuple(
                f"{v.name}: {r.severity}: {r.summary}" for v in client.get_state().views for r in v.reports
            )
            pictures.append(Screenshot(tab, png, reports))
        return pictures


@contextmanager
def _answering(process: viewer.Viewer, path: Path) -> Iterator[None]:
    """Raise ``MarchaError`` where the viewer ends, or is too slow to answer."""
    try:
        yield
    except (ConnectionError, RuntimeError) as error:
        last = process.complaint("panicked")
        reason = last if "panicked" in last else error
        raise MarchaError(f"{path}: the viewer did not answer: {reason}") from None


def loaded(client: Any, path: Path, patience_s: float) -> Any:
    """Return the viewer's state once everything has been read."""
    until = time.monotonic() + patience_s
    while time.monotonic() < until:
        state = client.get_state()
        if state.recordings and state.recordings[0].timelines and not state.loading:
            return state
        time.sleep(0.05)
    raise MarchaError(f"{path}: the viewer had not loaded it after {patience_s:g} s")


def _show_tab(client: Any, layout: dict[str, Any], name: str, path: Path, patience_s: float) -> None:
    """Bring a tab of the outermost container to the front, and hide the viewer's own menu."""
    containers = {
        k.lstrip("/"): v["ContainerBlueprint"] for k, v in layout.items() if "ContainerBlueprint" in v
    }
    tab_id = next((k for k, c in containers.items() if c.get("display_name") == name), None)
    if tab_id is None:
        names = sorted({c["display_name"] for c in containers.values() if "display_name" in c})
        raise MarchaError(f"{path}: no tab {name!r}; it has {', '.join(names)}")
    outer = next(k for k, c in containers.items() if c["container_kind"] == "Tabs" and tab_id in _contents(c))
    containers[outer]["active_tab"] = tab_id
    layout["/top_panel"] = {"PanelBlueprint": {"state": "Hidden"}}
    client.set_blueprint(layout, of="recording")
    # the viewer shows it some frames later: views of hidden tabs have no picture
    part = tab_id
    while part in containers:
        part = _contents(containers[part])[0]
    until = time.monotonic() + patience_s
    while True:
        try:
            client.take_screenshot(part.removeprefix("view/"))
            return
        except (RuntimeError, ConnectionError):  # the latter while the viewer does not know the view yet
            if time.monotonic() > until:
                raise MarchaError(f"{path}: the viewer did not show the tab {name!r}") from None


def _contents(container: dict[str, Any]) -> list[str]:
    contents = container.get("contents", [])
    return [contents] if isinstance(contents, str) else contents
