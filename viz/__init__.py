"""Recordings in the Rerun viewer, and as figures: what a channel looks like, live and saved views, pictures."""

from __future__ import annotations

from .live import LiveSink, show
from .rrd import RrdExporter, write_rrd

__all__ = ["LiveSink", "RrdExporter", "show", "write_rrd"]
