"""What is wrong with a recording: everything that a look at its times and values can tell."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
import polars as pl

from .annotations import TOPIC
from .errors import Finding
from .integrity import structure
from .names import ESTIMATE

if TYPE_CHECKING:
    from .model import Channel
    from .reader import Recording

SAMPLED = frozenset(
    {
        "sensor_msgs/msg/Imu",
        "sensor_msgs/msg/MagneticField",
        "sensor_msgs/msg/FluidPressure",
        "sensor_msgs/msg/Temperature",
        "sensor_msgs/msg/JointState",
        "geometry_msgs/msg/PoseStamped",
    }
)
"""Message types that come at a steady rate: a pause means that something was lost."""

GAP_S, GAP_INTERVALS = 0.2, 5
"""A gap is longer than this, and than so many median intervals; the replay engine draws the same line."""


def check(rec: Recording) -> list[Finding]:
    """Read a whole recording and return every defect that it shows.

    Parameters
    ----------
    rec : Recording
        What to look at; read in windows, so that memory stays bounded.

    Returns
    -------
    list of Finding
        First what was lost in reading it, then what the structure shows (:mod:`~.integrity`), then by
        channel ``empty_channel``, ``backwards_time``, ``duplicate_time``, ``gap``, ``missing_cell`` and
        ``all_zero``. ``first_line`` is the row of the channel, from 1. Estimates are only asked if empty:
        their missing values are the estimator's to explain.
    """
    findings = structure(rec)
    if not rec.channels:
        findings.append(Finding("empty_recording", 1, None, "there is no channel in it"))
    for channel in rec.channels.values():
        if not channel.count:
            findings.append(Finding("empty_channel", 1, None, f"{channel.topic}: has no message"))
        elif channel.columns and not channel.topic.startswith(ESTIMATE):
            findings += _Watch(channel).run(rec)
    return [*rec.findings, *findings]


class _Tally:
    """Counts places, and remembers the first and the worst of them."""

    def __init__(self) -> None:
        self.count = 0
        self.first: int | None = None
        self.worst = 0.0

    def add(self, mask: np.ndarray, row: int, size: np.ndarray) -> None:
        places = np.flatnonzero(mask)
        if places.size:
            if self.first is None:
                self.first = row + int(places[0]) + 1
            self.count += int(places.size)
            self.worst = max(self.worst, float(np.abs(size[places]).max()))


class _Watch:
    """Looks at one channel while its windows pass."""

    def __init__(self, channel: Channel) -> None:
        self.channel = channel
        self.backwards, self.same, self.gap = _Tally(), _Tally(), _Tally()
        self.missing: dict[str, _Tally] = {}
        self.nonzero: dict[str, bool] = {}
        self.limit_s = GAP_S

    def run(self, rec: Recording) -> Iterator[Finding]:
        topic, rows, last = self.channel.topic, 0, None
        for window in rec.windows([topic]):
            table = window.tables.get(topic)
            if table is None or not table.height:
                continue
            t_ns = table["t_ns"].to_numpy()
            steps = np.diff(t_ns, prepend=t_ns[:1] if last is None else last) / 1e9
            fresh = np.ones(len(steps), bool)
            fresh[0] = last is not None
            if last is None and (forward := steps[steps > 0]).size:
                self.limit_s = max(GAP_S, GAP_INTERVALS * float(np.median(forward)))
            self.backwards.add(steps < 0, rows, steps)
            self.same.add((steps == 0) & fresh, rows, steps)
            self.gap.add(steps > self.limit_s, rows, steps)
            self._values(table, rows)
            rows, last = rows + table.height, t_ns[-1]
        yield from self._findings(rows)

    def _values(self, table: pl.DataFrame, rows: int) -> None:
        for name in table.columns:
            if name in ("t_ns", "t_log_ns") or not table.schema[name].is_float():
                continue
            values = table[name].to_numpy()
            self.missing.setdefault(name, _Tally()).add(np.isnan(values), rows, np.ones(len(values)))
            self.nonzero[name] = self.nonzero.get(name, False) or bool(np.any(values != 0))

    def _findings(self, rows: int) -> Iterator[Finding]:
        topic = self.channel.topic

        def finding(kind: str, tally: _Tally, text: str) -> Iterator[Finding]:
            if tally.count:
                yield Finding(kind, tally.count, tally.first, f"{topic}: {text}")

        yield from finding(
            "backwards_time", self.backwards, f"time steps back, by up to {self.backwards.worst:.6g} s"
        )
        if self.channel.schema in SAMPLED:
            yield from finding("duplicate_time", self.same, "has the time of the row before")
            limit = f"longer than {self.limit_s:.3g} s"
            yield from finding("gap", self.gap, f"pauses {limit}, the longest lasts {self.gap.worst:.6g} s")
        for name, tally in self.missing.items():
            if self.channel.topic.startswith(TOPIC):
                continue  # an annotation need not state its confidence
            yield from finding("missing_cell", tally, f"{name} has no value")
        for sensor in dict.fromkeys(name[:-2] for name in self.nonzero if name[:-2] in ("acc", "gyr", "mag")):
            axes = [name for name in self.nonzero if name[:-2] == sensor]
            if not any(self.nonzero[name] for name in axes):
                yield Finding(
                    "all_zero", rows, 1, f"{topic}: every value of {sensor} is 0; is the sensor connected?"
                )
