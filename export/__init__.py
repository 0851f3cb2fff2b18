"""From a recording to other tools: annotated MCAP, CSV and Parquet folders, and what plug-ins add."""

from __future__ import annotations

from .contract import Exporter
from .registry import available, export

__all__ = ["Exporter", "available", "export"]
