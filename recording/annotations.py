"""Annotations: labelled intervals of a recording, as ``foxglove_msgs/msg/Event`` on ``/annotation/<tier>``."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import polars as pl

if TYPE_CHECKING:
    from .reader import Recording

EVENT = "foxglove_msgs/msg/Event"
PREFIX = "/annotation/"
COLUMNS = {"tier": pl.String, "start_ns": pl.Int64, "end_ns": pl.Int64, "label": pl.String, "metadata": pl.String}


def read_annotations(rec: Recording) -> pl.DataFrame:
    """Return all annotations of a recording by start time."""
    return pl.DataFrame(schema=COLUMNS)
