"""Views that are installed: built-in ones and those of plug-ins, by the entry point group ``marcha.views``."""

from __future__ import annotations

import warnings
from importlib.metadata import entry_points
from typing import Any

from ..recording.plugins import plugins
from .canvas import Canvas, ChannelLike
from .views.base import View
from .views.common import General

GROUP = "marcha.views"


def available_views() -> dict[str, type[View]]:
    """Return every registered view by name; a plug-in that cannot be used is a warning with its name."""
    return {name: plugin.part for name, plugin in plugins(entry_points, GROUP, "view", _checked).items()}


def _checked(view: Any) -> type[View]:
    if not (isinstance(view, type) and issubclass(view, View)):
        raise TypeError("it is no subclass of marcha.viz.views.View")
    return view


def views_of(canvas: Canvas, channel: ChannelLike) -> list[View]:
    """Return the views that draw a channel: the one that fits best, and those that draw beside it.

    A view that fails in ``fits`` or when it is made is left out with a warning that names it; the general
    view stands in.
    """
    own: list[tuple[int, int, str, type[View]]] = []
    beside: list[tuple[str, type[View]]] = []
    for name, kind in available_views().items():
        try:
            if not kind.fits(channel):
                continue
        except Exception as error:
            warn(kind, channel, error)
            continue
        if kind.beside:
            beside.append((name, kind))
        else:
            own.append((-kind.priority, -len(kind.needs), name, kind))
    drawn: list[View] = []
    for kind in [*(k for *_, k in sorted(own, key=lambda o: o[:3])), General]:
        try:
            drawn.append(kind(canvas, channel))
            break
        except Exception as error:
            if kind is General:
                raise
            warn(kind, channel, error)
    for _, kind in beside:
        try:
            drawn.append(kind(canvas, channel))
        except Exception as error:
            warn(kind, channel, error)
    return drawn


def warn(kind: type[View], channel: ChannelLike, error: Exception) -> None:
    """Say that a view failed on a channel."""
    name = next((n for n, k in available_views().items() if k is kind), kind.__name__)
    reason = f"{type(error).__name__}: {error}".splitlines()[0]
    warnings.warn(
        f"view plug-in {name} ({kind.__module__}) failed on {channel.topic}: {reason}", stacklevel=3
    )
