"""Recordings in the Rerun viewer, and as figures: what a channel looks like, live and saved views, pictures."""

from __future__ import annotations

from .figure import write_figure
from .live import LiveSink, show
from .rrd import RrdExporter, write_rrd

__all__ = ["LiveSink", "RrdExporter", "show", "write_figure", "write_rrd"]
