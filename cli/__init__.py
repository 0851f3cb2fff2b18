"""The command ``marcha``: parses, calls, prints; the work is done in the other packages."""

from __future__ import annotations

from .app import main

__all__ = ["main"]
