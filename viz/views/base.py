"""The contract of a view: which channels it draws, and how.

A view is a class, registered as entry point ``marcha.views``. It says which channels it draws (message type,
role of the topic, columns, metadata), draws their rows on a :class:`~marcha.viz.canvas.Canvas`, and says in
which panel of which tab they are shown::

    class Breath(View):
        title = "breathing rate of a chest strap"
        schemas = ("marcha_msgs/msg/NamedValues",)
        roles = ("raw",)
        needs = ("breath_hz",)

        def begin(self):
            self.canvas.lines(self.path, ["breathing (1/s)"], [self.color])
            self.canvas.show("plot", self.path, tab="Breath", panel="breathing (1/s)", owner=self.owner)

        def draw(self, t_ns, block):
            self.canvas.scalars(self.path, t_ns, block["breath_hz"].to_numpy())

Each channel is drawn by the one view that fits it and has the highest ``priority``; among equals the one that
asks for more columns, then the first by name. Views with ``beside`` draw in addition to it.
"""

from __future__ import annotations

from typing import ClassVar, Literal

import polars as pl

from ...recording.names import is_estimate
from ..canvas import Canvas, ChannelLike, Times

Role = Literal["raw", "estimate", "reference", "annotation"]


def role_of(topic: str) -> Role:
    """Return the role that a topic's first part gives it."""
    if is_estimate(topic):
        return "estimate"
    if topic.startswith("/reference/"):
        return "reference"
    return "annotation" if topic.startswith("/annotation/") else "raw"


class View:
    """Draws one channel; subclasses say which and how.

    Parameters
    ----------
    canvas : Canvas
        Where to draw.
    channel : ChannelLike
        Topic, message type, columns and metadata.

    Attributes
    ----------
    title : str
        One line for lists.
    schemas : tuple of str
        Message types that it draws; empty for any.
    roles : tuple of str
        Roles of topics that it draws; empty for any.
    needs : tuple of str
        Columns that a channel must have.
    priority : int
        Built-in views have 0, the general ones less.
    beside : bool
        Draws in addition to the channel's own view.
    path, color, owner, what : str
        The channel's entity path, the colour and name of its owner, and the last part of its topic.
    """

    title: ClassVar[str] = ""
    schemas: ClassVar[tuple[str, ...]] = ()
    roles: ClassVar[tuple[Role, ...]] = ()
    needs: ClassVar[tuple[str, ...]] = ()
    priority: ClassVar[int] = 0
    beside: ClassVar[bool] = False

    def __init__(self, canvas: Canvas, channel: ChannelLike) -> None:
        self.canvas, self.channel = canvas, channel
        self.path = canvas.group(channel.topic)
        self.color = canvas.color(channel.topic)
        self.owner = canvas.owner(channel.topic)
        self.role = role_of(channel.topic)
        self.what = channel.topic.rsplit("/", 1)[-1]

    @classmethod
    def fits(cls, channel: ChannelLike) -> bool:
        """Return whether it draws this channel. Override it to look at metadata."""
        return (
            (not cls.schemas or channel.schema in cls.schemas)
            and (not cls.roles or role_of(channel.topic) in cls.roles)
            and set(cls.needs) <= set(channel.columns)
        )

    @property
    def parent(self) -> str:
        """Entity of the channel's owner: ``/run/<run>``, ``/reference``."""
        return self.path.rsplit("/", 1)[0]

    @property
    def tab(self) -> str:
        """Tab of a channel without a better place: *Raw*, or *Estimates*."""
        return "Estimates" if self.role == "estimate" else "Raw"

    def begin(self) -> None:
        """Log what holds at all times (styles), and say which panels show what."""

    def draw(self, t_ns: Times, block: pl.DataFrame) -> None:
        """Log one block of rows.

        Parameters
        ----------
        t_ns : ndarray of int64, shape (n,)
            Times that the rows speak of.
        block : polars.DataFrame
            The same rows, with the channel's columns in SI units.
        """

    def end(self) -> None:
        """Log what needs the whole."""
