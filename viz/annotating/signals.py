"""What the page shows of a recording: its channels in panels by unit, and their pyramids."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np

from ...recording import Recording
from ...recording.annotations import EVENT
from ...recording.reader import Channel
from ...recording.schemas import SCHEMAS
from ...recording.threads import helpers
from .. import style
from ..naming import shown_as, unit_in, unit_of
from .pyramid import BLOCK, FACTOR, TILE, Pyramid, Tile

FIRST_PANELS = 6
"""So many panels are open when the page opens."""
FIRST_GROUPS = ("acc", "gyr", "angle", "pressure_pa")
"""What is worth an open panel before all else."""


class Signals:
    """The channels of a recording, read by two threads as soon as this is made.

    Parameters
    ----------
    rec : Recording
        Kept open: tiles of rows are read when they are asked for.

    Attributes
    ----------
    pyramids : dict of str to Pyramid
        By topic, those that are open at first before the others.
    """

    def __init__(self, rec: Recording) -> None:
        self.zero_ns = rec.start_ns or 0
        groups = {
            c.topic: panels
            for c in rec.channels.values()
            if c.schema != EVENT and c.count and (panels := panels_of(c))
        }
        shown = _first(groups)
        order = [*dict.fromkeys(t for t, _ in shown), *groups]
        self.panels = [
            {**panel, "topic": topic, "open": (topic, panel["name"]) in shown}
            for topic, panels in groups.items()
            for panel in panels
        ]
        self.pyramids = {
            topic: Pyramid(
                rec, rec.channels[topic], [c["column"] for p in groups[topic] for c in p["columns"]]
            )
            for topic in dict.fromkeys(order)
        }
        self._workers = helpers("pyramid", most=2)
        self._ended = threading.Event()
        self._tasks = {t: self._workers.submit(self._build, p) for t, p in self.pyramids.items()}

    def _build(self, pyramid: Pyramid) -> None:
        if not self._ended.is_set():
            pyramid.build()

    def close(self) -> None:
        """Read no further channel."""
        self._ended.set()
        self._workers.shutdown(wait=True)

    def overview(self, topic: str) -> tuple[dict[str, Any], Tile]:
        """Return what is known of a channel and its coarsest level; raises what reading it raised."""
        pyramid = self.pyramids[topic]
        task = self._tasks[topic]
        if task.done():
            task.result()
        complete = pyramid.complete  # before the tile: a channel may be read to its end meanwhile
        tile = pyramid.overview()
        about = {
            "complete": complete,
            "sizes": pyramid.sizes,
            "origin": pyramid.origin.tolist(),
            "block": BLOCK,
            "factor": FACTOR,
            "tile": TILE,
        }
        return about, tile

    def packed(self, tile: Tile, *, rows: bool = False) -> bytes:
        """Return a tile as bytes, little-endian: times as float64 (ns since the recording's start, exact for
        100 days), then values as float32, column by column; ``rows`` leaves out what is there twice.
        """
        times = [tile.first_ns] if rows else [tile.first_ns, tile.last_ns]
        values = [tile.low] if rows else [tile.low, tile.high]
        return b"".join(
            [
                *((t - self.zero_ns).astype("<f8").tobytes() for t in times),
                *(np.ascontiguousarray(v, "<f4").tobytes() for v in values),
            ]
        )


def panels_of(channel: Channel) -> list[dict[str, Any]]:
    """Return the panels of a channel: columns of one unit and kind together.

    Returns
    -------
    list of dict
        ``name``, ``unit``, and ``columns``: each its ``column``, ``name``, ``factor`` from SI and ``color``.
    """
    panels: dict[tuple[str, str], dict[str, Any]] = {}
    schema = SCHEMAS.get(channel.schema)
    kinds = {} if schema is None else {c.name: c.kind for c in schema.columns}
    suffixes = () if schema is None or not schema.names else sorted(kinds, key=len, reverse=True)
    for column in channel.columns:
        suffix = next((s for s in suffixes if column.endswith(s)), column)
        if kinds.get(suffix, "number") not in ("number", "sigma", "flag"):
            continue
        shown = shown_as(column, unit_of(channel.schema, column))
        unit = unit_in(shown.name)
        stem = suffix if suffixes else column[:-2] if column[-2:] in ("_w", "_x", "_y", "_z") else column
        panel = panels.setdefault((stem, unit), {"name": stem or "value", "unit": unit, "columns": []})
        name = shown.name.removesuffix(f" ({unit})")
        place = len(panel["columns"])
        axis = "xyz".find(column[-1]) if column[-2:-1] == "_" else -1
        color = (
            style.AXES[axis] if axis >= 0 else style.run_color(place + (3 if column.endswith("_w") else 0))
        )
        panel["columns"].append({"column": column, "name": name, "factor": shown.factor, "color": color})
    return list(panels.values())


def _first(groups: dict[str, list[dict[str, Any]]]) -> set[tuple[str, str]]:
    """Return topic and name of the panels that are open at first: of raw channels, the usual ones first."""
    listed = [
        (topic, panel["name"])
        for name in (*FIRST_GROUPS, None)
        for topic, panels in groups.items()
        for panel in panels
        if (name is None or panel["name"] == name) and not topic.startswith("/estimate/")
    ]
    names = [f[1] for f in listed]
    usual = [f for f in dict.fromkeys(listed) if f[1] in FIRST_GROUPS]
    most = FIRST_PANELS
    if names.count("acc") > 2:  # several sensors: the same quantity of each tells more than all of one
        usual = [f for f in usual if f[1] == "acc"]
    return set(
        (usual or list(dict.fromkeys(listed)) or [(t, p[0]["name"]) for t, p in groups.items()])[:most]
    )
