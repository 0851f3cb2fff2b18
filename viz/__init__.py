"""Recordings in the Rerun viewer, and as figures: what a channel looks like, live and saved views,
pictures.
"""

from __future__ import annotations

import os

# Rerun reads this when it is imported. A file that cannot be written is said by us, in one line.
os.environ.setdefault("RUST_LOG", "warn,re_log_encoding=off,re_sdk=off")

from .figures import available_figures, figure, save_figure
from .live import LiveSink, show
from .rrd import RrdExporter, write_rrd

__all__ = ["LiveSink", "RrdExporter", "available_figures", "figure", "save_figure", "show", "write_rrd"]
