"""From a recording to other tools: annotated MCAP, tables, BIDS, tracks, labels, and what plug-ins add."""

from __future__ import annotations

from .contract import Exporter
from .registry import available, export, export_all, losses

__all__ = ["Exporter", "available", "export", "export_all", "losses"]
