"""Time in the viewer: seconds since the start everywhere, and the date beside it where it is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from ..recording import Recording

Times = NDArray[np.int64]

SINCE_START = "since_start"
"""The time line of every view: time since the start of the recording, as in figures and after ``--from``."""

UTC = "utc"
"""A second time line of recordings whose clock is the epoch's: dates and times of day."""

EPOCH_NS = 10**17
"""Times below this (March 1973) cannot be the epoch's: they count from a device's own zero."""


@dataclass(frozen=True)
class TimeAxis:
    """How recorded nanoseconds become Rerun's time lines.

    Attributes
    ----------
    zero_ns : int
        Recorded time at which :data:`SINCE_START` is zero.
    utc : bool
        Whether recorded times count from the epoch, so that there is a time line of dates too.
    """

    zero_ns: int = 0
    utc: bool = False

    def columns(self, t_ns: Times) -> list[rr.TimeColumn]:
        """Return recorded times as columns of the time lines."""
        since = (t_ns - self.zero_ns).astype("timedelta64[ns]")
        result = [rr.TimeColumn(SINCE_START, duration=since)]
        if self.utc:
            result.append(rr.TimeColumn(UTC, timestamp=t_ns.astype("datetime64[ns]")))
        return result


def axis_from(t_ns: int, clock: str = "") -> TimeAxis:
    """Return the axis of a recording that begins at ``t_ns``.

    Parameters
    ----------
    t_ns : int
        First recorded time.
    clock : str
        What the recording's metadata calls its clock (``device``: it has no epoch); empty where it says
        nothing, and then the time itself decides.
    """
    return TimeAxis(t_ns, clock != "device" and t_ns >= EPOCH_NS)


def axes_of(recs: Sequence[Recording]) -> list[TimeAxis]:
    """Return the axis of every recording.

    Recordings that share a clock and overlap in time are laid beside each other as they were; others upon
    each other, each from its own start.
    """
    starts, ends = [rec.start_ns or 0 for rec in recs], [rec.end_ns or 0 for rec in recs]
    axes = [
        axis_from(start, rec.metadata.get("device", {}).get("clock", ""))
        for rec, start in zip(recs, starts, strict=True)
    ]
    together = len({axis.utc for axis in axes}) == 1 and max(starts) <= min(ends)
    return [TimeAxis(min(starts), axis.utc) if together else axis for axis in axes]
