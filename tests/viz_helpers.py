"""What the tests of views share: example rows of any message type, and which entities the panels show."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import marcha.recording as mr
import marcha.viz as viz
import numpy as np
import polars as pl
import rerun.blueprint as rrb
from marcha.recording.schemas import SCHEMAS, Column
from marcha.viz.blueprint import blueprint
from marcha.viz.canvas import Canvas
from marcha.viz.draw import draw
from marcha.viz.stream import new_stream
from rerun.chunk import RrdReader

ROWS = 40
NAMES = ("one", "two")
"""Names of joints, values and markers in example rows."""


def example_table(schema: str, columns: tuple[str, ...] = (), *, start_ns: int = 10**9) -> pl.DataFrame:
    """Return example rows of a message type, with all columns that it may have or those named."""
    rng = np.random.default_rng(len(schema))
    t_ns = start_ns + np.arange(ROWS) * 10_000_000
    known = SCHEMAS[schema]
    if known.names:
        found = [(n + c.name, c) for n in NAMES for c in known.columns]
        if columns:
            suffixes = {c.name: c for c in known.columns}
            by_suffix = sorted(suffixes, key=len, reverse=True)
            found = [(c, suffixes[next(s for s in by_suffix if c.endswith(s))]) for c in columns]
    else:
        found = [(c.name, c) for c in known.columns if not columns or c.name in columns]
    return pl.DataFrame({"t_ns": t_ns, **{name: _values(name, c, t_ns, rng) for name, c in found}})


def _values(name: str, column: Column, t_ns: np.ndarray, rng: np.random.Generator) -> Any:
    if column.kind == "time":
        return t_ns - 5_000_000
    if column.kind == "flag":
        return np.arange(ROWS) // 7 % 2 == 0
    if column.kind == "mac":
        return [f"00:00:00:00:00:0{i % 3}" for i in range(ROWS)]
    if column.kind == "technology":
        return ["ble"] * ROWS
    if column.kind == "text":
        return ["frame"] * ROWS
    if name in ("status", "service", "index"):
        return np.ones(ROWS, dtype=np.int64)
    if name.startswith("quat_"):
        return np.full(ROWS, 1.0 if name.endswith("w") else 0.0)
    return 1.0 + rng.random(ROWS)


def leaves(part: Any) -> Iterator[rrb.View]:
    """Yield every view of a blueprint's container."""
    if isinstance(part, rrb.View):
        yield part
        return
    for inner in part.contents:
        yield from leaves(inner)


def shown_by(canvases: list[Canvas]) -> list[str]:
    """Return what all panels of a blueprint show: entity paths, with ``/**`` for what lies below too."""
    root: Any = blueprint(canvases).root_container
    found: list[Any] = [view.contents for view in leaves(root)]
    return [str(c) for contents in found for c in contents]


def is_shown(entity: str, contents: list[str]) -> bool:
    """Return whether a panel with these contents shows an entity."""
    return any(
        entity == c or (c.endswith("/**") and (entity == c[:-3] or entity.startswith(c[:-2])))
        for c in contents
    )


def drawn(rec: mr.Recording, folder: Path) -> tuple[set[str], Canvas]:
    """Draw a recording; return the entities that hold data, and its canvas."""
    import rerun as rr

    path = folder / "drawn.rrd"
    stream = new_stream()
    stream.set_sinks(rr.FileSink(path))
    (scene,) = draw([rec], stream)
    stream.flush()
    stream.disconnect()
    entities = {
        chunk.entity_path for chunk in RrdReader(path).stream() if not chunk.is_static and chunk.num_rows
    }
    return entities, scene.canvas


def write(
    path: Path, channels: dict[str, tuple[str, pl.DataFrame]], **metadata: dict[str, str]
) -> mr.Recording:
    """Write channels as a recording and open it; ``metadata`` is of each channel by topic."""
    with mr.create(path) as out:
        for topic, (schema, table) in channels.items():
            out.add_table(topic, schema, table, frame_id="x", metadata=metadata.get(topic, {}))
    return mr.open(path)


__all__ = ["NAMES", "ROWS", "drawn", "example_table", "is_shown", "leaves", "shown_by", "viz", "write"]
