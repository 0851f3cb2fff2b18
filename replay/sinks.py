"""Where results go: into memory, into a recording, into a viewer."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import polars as pl

from ..recording import create
from .blocks import Block
from .plan import Plan, PlannedChannel

if TYPE_CHECKING:
    from ..recording import Recording, Writer
    from .results import ReplayResult


LEVEL = None
"""Estimates are not compressed: their low bits are noise. zstd −3 would save 40 % of their size and take
twice as long as all the rest of writing them. A recording that is exported to be handed on is compressed."""


class Sink:
    """What takes part in a replay as an observer: a viewer, a file, a test. Subclass it.

    Attributes
    ----------
    raw : bool
        Whether it wants the source's own channels too.
    rewinds : bool
        Whether :meth:`rewind` takes back what was given: when the engine seeks back, it comes again. A sink that
        does not is given every message once, whatever the engine does.
    """

    raw: bool = True
    rewinds: bool = False

    def open(self, plan: Plan) -> None:
        """Prepare for the channels of ``plan``. Where this or a later sink's fails, all are closed."""

    def write(self, topic: str, table: pl.DataFrame) -> None:
        """Take messages of one topic: ``t_ns``, ``t_log_ns`` and columns, in log-time order per topic."""

    def write_block(self, topic: str, block: Block) -> None:
        """Take the same as a block; a sink that wants arrays overrides this instead of :meth:`write`."""
        self.write(topic, block.table)

    def rewind(self, t_log_ns: int) -> None:
        """Forget what was logged from ``t_log_ns`` on."""

    def close(self, result: ReplayResult | None) -> None:
        """Finish; ``result`` is None where the replay failed and nothing may remain."""


class TableSink(Sink):
    """Keeps the tables of all runs in memory.

    :meth:`table` returns one.
    """

    raw = False
    rewinds = True

    def __init__(self) -> None:
        self._pieces: dict[str, list[pl.DataFrame]] = {}
        self._plan: Plan | None = None

    def open(self, plan: Plan) -> None:
        """Start anew."""
        self._plan = plan
        self._pieces = {}

    def write(self, topic: str, table: pl.DataFrame) -> None:
        """Keep it."""
        self._pieces.setdefault(topic, []).append(table)

    def rewind(self, t_log_ns: int) -> None:
        """Forget what was logged from ``t_log_ns`` on."""
        for topic, pieces in self._pieces.items():
            self._pieces[topic] = [p.filter(pl.col("t_log_ns") < t_log_ns) for p in pieces]

    def table(self, topic: str) -> pl.DataFrame | None:
        """Return all messages of a topic, None where it is not one of a run's."""
        if pieces := self._pieces.get(topic):
            whole = pl.concat(pieces)
            self._pieces[topic] = [whole]
            return whole
        channel = self._plan.channels.get(topic) if self._plan else None
        if channel is None:
            return None
        return pl.DataFrame(
            schema={"t_ns": pl.Int64, "t_log_ns": pl.Int64} | dict.fromkeys(channel.columns, pl.Float64)
        )


class RecordingSink(Sink):
    """Writes a recording; the file itself is written in the background.

    Parameters
    ----------
    path : Path
        Recording to write; appears whole or not at all.
    recording : Recording or None
        Input whose channels are copied verbatim; None for a live source, whose messages are written as they
        come.
    overwrite : bool
        Whether ``path`` may be replaced.
    """

    def __init__(self, path: Path, recording: Recording | None, overwrite: bool = False) -> None:
        self.path = Path(path)
        self.raw = recording is None
        self._recording = recording
        self._overwrite = overwrite
        self._out: Writer | None = None
        self._channels: dict[str, PlannedChannel] = {}

    def open(self, plan: Plan) -> None:
        """Copy the input's channels and declare those of the runs."""
        self._channels = plan.channels
        self._out = create(self.path, overwrite=self._overwrite, level=LEVEL)
        if self._recording is not None:
            self._out.copy_from(self._recording)
        for channel in self._channels.values():
            if channel.run or self.raw:
                self._out.add_channel(
                    channel.topic,
                    channel.schema,
                    frame_id=channel.frame_id,
                    columns=channel.columns,
                    metadata=dict(channel.metadata),
                )

    def write(self, topic: str, table: pl.DataFrame) -> None:
        """Write a table; raises what went wrong with it or earlier ones."""
        self.write_block(topic, Block(table))

    def write_block(self, topic: str, block: Block) -> None:
        """Write a block; raises what went wrong with it or earlier ones."""
        assert self._out is not None
        channel = self._channels[topic]
        self._out.add_table(topic, channel.schema, block.rows, frame_id=channel.frame_id)

    def close(self, result: ReplayResult | None) -> None:
        """Write the lineage and put the recording in place; without a result drop it."""
        if self._out is None:
            return
        out, self._out = self._out, None
        if result is None:
            out.abort()
            return
        with out:
            for run in result.runs:
                out.add_metadata(f"run/{run.run}", run.lineage)
                if run.annotations.height:
                    out.add_annotations(run.annotations)
