"""Which part of a recording is meant: topics and a range of time."""

from __future__ import annotations

from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, Annotated

import msgspec
import polars as pl

from .errors import UsageError

if TYPE_CHECKING:
    from .reader import Recording

CLOUD, TRACK, DRAWN = "sensor_msgs/msg/PointCloud2", "/track", "drawn"
"""Type and beginning of the topics of drawn trajectories; key of a channel's metadata that says it was drawn."""


class Selection(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of everything that takes a part of a recording."""

    topics: Annotated[
        tuple[str, ...], msgspec.Meta(description="topics or patterns (/foot/*); all where empty")
    ] = ()
    start_ns: Annotated[int | None, msgspec.Meta(description="first log time, in the recording's ns")] = None
    end_ns: Annotated[
        int | None,
        msgspec.Meta(description="log time at which to stop (not included), in the recording's ns"),
    ] = None

    @property
    def whole(self) -> bool:
        """Whether no limits of time were given."""
        return self.start_ns is None and self.end_ns is None


def is_drawn(rec: Recording, topic: str) -> bool:
    """Return whether a channel only shows another one to viewers: an export draws it anew, nothing else needs it."""
    channel = rec.channels[topic]
    return DRAWN in channel.metadata or (channel.schema == CLOUD and topic.startswith(f"{TRACK}/"))


def selected_topics(rec: Recording, selection: Selection) -> list[str]:
    """Return the topics that a selection means, in the order of the recording; drawn ones are never among them.

    Raises
    ------
    UsageError
        A pattern fits no topic of the recording, or the end does not come after the start.
    """
    if (
        selection.start_ns is not None
        and selection.end_ns is not None
        and selection.end_ns <= selection.start_ns
    ):
        raise UsageError(
            f"{rec.path}: nothing lies between {selection.start_ns} ns and {selection.end_ns} ns; "
            "give an end after the start"
        )
    for pattern in selection.topics:
        if not any(fnmatchcase(topic, pattern) for topic in rec.channels):
            raise UsageError(
                f"{rec.path}: no topic fits {pattern!r}; it has {', '.join(rec.channels) or 'no channels'}"
            )
    topics = [t for t in rec.channels if not is_drawn(rec, t)]
    if not selection.topics:
        return topics
    return [t for t in topics if any(fnmatchcase(t, pattern) for pattern in selection.topics)]


def within(annotations: pl.DataFrame, selection: Selection) -> pl.DataFrame:
    """Return the annotations that touch the selected time."""
    if selection.start_ns is not None:
        annotations = annotations.filter(pl.col("end_ns") >= selection.start_ns)
    if selection.end_ns is not None:
        annotations = annotations.filter(pl.col("start_ns") < selection.end_ns)
    return annotations
