"""What a recording shows of itself: channels, attachments, windows, messages."""

from __future__ import annotations

from typing import Any, NamedTuple

import msgspec
import polars as pl


class Channel(msgspec.Struct, frozen=True):
    """One channel of a recording.

    Attributes
    ----------
    topic, schema, frame_id : str
        Topic, message type (``package/msg/Name``) and constant frame id.
    columns : tuple of str
        Columns of its table, without ``t_ns``; empty where marcha cannot read the messages.
    count : int
        Number of messages.
    start_ns, end_ns : int or None
        Log time of the first and last message; None where there is none.
    metadata : dict of str to str
        What the writer said about the channel.
    """

    topic: str
    schema: str
    frame_id: str
    columns: tuple[str, ...]
    count: int
    start_ns: int | None
    end_ns: int | None
    metadata: dict[str, str] = {}


class Attachment(msgspec.Struct, frozen=True):
    """A file inside a recording: name, media type and size in bytes."""

    name: str
    media_type: str
    size: int


class Window(NamedTuple):
    """A stretch of log time, half open, with the rows of every channel in it.

    Attributes
    ----------
    start_ns, end_ns : int
        ``start_ns <= t_log_ns < end_ns`` for every row.
    tables : dict of str to polars.DataFrame
        Topic to table with ``t_ns``, ``t_log_ns`` and the channel's columns; empty ones are not there.
    """

    start_ns: int
    end_ns: int
    tables: dict[str, pl.DataFrame]


class RecordedMessage(NamedTuple):
    """One message: topic, the time it speaks of, the time it was known, and column name to value."""

    topic: str
    t_ns: int
    t_log_ns: int
    values: dict[str, Any]
