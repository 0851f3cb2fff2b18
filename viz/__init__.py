"""Recordings in the Rerun viewer, and as figures: what a channel looks like, live and saved views,
pictures.
"""

from __future__ import annotations

from .figures import figure, save_figure
from .live import LiveSink, show
from .rrd import RrdExporter, write_rrd

__all__ = ["LiveSink", "RrdExporter", "figure", "save_figure", "show", "write_rrd"]
