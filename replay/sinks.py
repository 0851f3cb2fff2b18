"""Where results go: into memory, into a recording, into a viewer."""

from __future__ import annotations

import queue
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import polars as pl

from ..recording import create
from .blocks import Block
from .plan import Plan

if TYPE_CHECKING:
    from ..recording import Recording
    from .engine import ReplayResult


LEVEL = None
"""Estimates are not compressed: their low bits are noise. zstd −3 would save 40 % of their size and take as
long as all the rest of writing them. A recording that is exported to be handed on is compressed."""


class Sink(Protocol):
    """What takes part in a replay as an observer: a viewer, a file, a test.

    A sink may set ``raw = False`` if it does not want the source's own channels, and may have a method
    ``rewind(t_log_ns)``: it is called when the engine seeks back, and what was logged from that time on comes
    again. A sink without it sees every message once, whatever the engine does. One with a method
    ``write_block(topic, block)`` is given a :class:`.blocks.Block` instead of a table.
    """

    def open(self, plan: Plan) -> None:
        """Prepare for the channels of ``plan``."""
        ...

    def write(self, topic: str, table: pl.DataFrame) -> None:
        """Take messages of one topic: ``t_ns``, ``t_log_ns`` and columns, in log-time order per topic."""
        ...

    def close(self, result: ReplayResult | None) -> None:
        """Finish; ``result`` is None where the replay failed and nothing may remain."""
        ...


class TableSink:
    """Keeps the tables of all runs in memory.

    :meth:`table` returns one.
    """

    raw = False

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

    def close(self, result: ReplayResult | None) -> None:
        """Nothing to do."""

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


class RecordingSink:
    """Writes a recording, in a thread of its own.

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
        self._queue: queue.Queue[tuple[str, Block] | ReplayResult | None] = queue.Queue(8)
        self._error: BaseException | None = None
        self._thread: threading.Thread | None = None
        self._plan: Plan | None = None
        self._ended = False

    def open(self, plan: Plan) -> None:
        """Start the writing thread."""
        self._plan = plan
        self._thread = threading.Thread(target=self._run, daemon=True, name="replay writer")
        self._thread.start()

    def write(self, topic: str, table: pl.DataFrame) -> None:
        """Queue a table; raises what went wrong in writing earlier ones."""
        self.write_block(topic, Block(table))

    def write_block(self, topic: str, block: Block) -> None:
        """Queue a block; raises what went wrong in writing earlier ones."""
        self._check()
        self._queue.put((topic, block))

    def close(self, result: ReplayResult | None) -> None:
        """Write what is left and the lineage, and put the recording in place; without a result drop it."""
        if self._thread is None:
            return
        self._queue.put(result)
        self._thread.join()
        self._thread = None
        self._check()

    def _check(self) -> None:
        if self._error is not None:
            error, self._error = self._error, None
            raise error

    def _run(self) -> None:
        try:
            self._write_all()
        except _Dropped:
            pass
        except BaseException as error:  # handed to the engine's thread
            self._error = error
            while (
                not self._ended
            ):  # the engine must not wait for room in the queue until it learns of the error
                self._ended = not isinstance(self._queue.get(), tuple)

    def _write_all(self) -> None:
        assert self._plan is not None
        channels = self._plan.channels
        with create(self.path, overwrite=self._overwrite, level=LEVEL) as out:
            if self._recording is not None:
                out.copy_from(self._recording)
            for channel in channels.values():
                if channel.run or self.raw:
                    out.add_channel(
                        channel.topic,
                        channel.schema,
                        frame_id=channel.frame_id,
                        columns=channel.columns,
                        metadata=dict(channel.metadata),
                    )
            while isinstance(item := self._queue.get(), tuple):
                topic, block = item
                channel = channels[topic]
                out.add_table(topic, channel.schema, block.rows, frame_id=channel.frame_id)
            self._ended = True
            if item is None:
                raise _Dropped
            for run in item.runs:
                out.add_metadata(f"run/{run.run}", run.lineage)
                if run.annotations.height:
                    out.add_annotations(run.annotations)


class _Dropped(Exception):
    """The replay failed: the writer's block ends by an exception, so that nothing remains."""
