"""Parts of marcha and of other packages that are found by entry points: one loader for all kinds."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Iterable
from functools import lru_cache
from importlib.metadata import EntryPoint
from typing import Any, NamedTuple

Scan = Callable[..., Iterable[EntryPoint]]
"""What lists the entry points of a group: ``importlib.metadata.entry_points``."""


class Plugin(NamedTuple):
    """One part that is installed.

    Attributes
    ----------
    part : object
        What its entry point names, as ``use`` returned it.
    source : str
        Distribution and version.
    """

    part: Any
    source: str


def plugins(
    scan: Scan, group: str, kind: str, use: Callable[[Any], Any] = lambda part: part
) -> dict[str, Plugin]:
    """Return everything that is registered in a group, by name, sorted.

    A part that cannot be loaded or used, or whose name is taken, is left out with a warning that names it: it
    must not stop the others.

    Parameters
    ----------
    scan : callable
        ``importlib.metadata.entry_points``. A scan of what is installed takes 10 ms: one a ``sys.path``.
    group : str
        ``marcha.importers`` …
    kind : str
        What a warning calls it: ``importer`` …
    use : callable
        Gets what was loaded; returns the part, or raises what is wrong with it. One function a group.
    """
    return dict(_plugins(scan, tuple(sys.path), group, kind, use))


@lru_cache(maxsize=32)
def _plugins(
    scan: Scan, path: tuple[str, ...], group: str, kind: str, use: Callable[[Any], Any]
) -> dict[str, Plugin]:
    result: dict[str, Plugin] = {}
    for point in sorted(scan(group=group), key=lambda p: p.name):
        source = f"{point.dist.name} {point.dist.version}" if point.dist else "unknown"
        label = f"{kind} plug-in {point.name} ({point.value}, {source})"
        try:
            part = use(point.load())
        except Exception as error:
            reason = " ".join(str(error).split())
            warnings.warn(f"{label} cannot be used: {type(error).__name__}: {reason}", stacklevel=3)
            continue
        if point.name in result:
            warnings.warn(
                f"{label} is left out: {result[point.name].source} has the name already", stacklevel=3
            )
            continue
        result[point.name] = Plugin(part, source)
    return result
