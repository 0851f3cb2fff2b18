"""A recording and hard annotations for the tests of labels and changes."""

from __future__ import annotations

import random
from pathlib import Path

import marcha.recording as mr
import numpy as np
import polars as pl
from marcha.recording.annotations import COLUMNS

START_NS = 1_700_000_000_123_456_789
SPAN_NS = 1_000 * 10**9 - 10**7
WORDS = (
    "turn",
    "Treppe hoch",
    "走る",
    "مشي",
    "ходьба",
    "🚶‍♀️",
    "a\tb",
    "line\nbreak",
    "\r\n",
    "n/a",
    "",
    '"quoted"',
    "=1+1",
    "<b>&amp;",
    "\u2028x",
    "\\n",
    " sp ",
    "[x] y",
    "\x01ctl",
)


def recording(path: Path) -> Path:
    """Write a thousand seconds of readings at 10 Hz; the clock begins at an odd nanosecond."""
    t = START_NS + np.append(np.arange(0, SPAN_NS, 10**8), SPAN_NS)
    table = pl.DataFrame({"t_ns": t, **{f"acc_{a}": np.zeros(len(t)) for a in "xyz"}})
    with mr.create(path) as out:
        out.add_table("/imu", "sensor_msgs/msg/Imu", table)
    return path


def hard_annotations(count: int, seed: int = 1) -> pl.DataFrame:
    """Return annotations of five tiers: instants, intervals from 1 ns to 5 s, overlaps, every script."""
    rng = random.Random(seed)
    rows = []
    for k in range(count):
        start = rng.randrange(0, SPAN_NS)
        length = rng.choice([0, rng.randrange(1, 10**6), rng.randrange(10**7, 5 * 10**9)])
        rows.append(
            (
                rng.choice(["gait", "terrain", "left foot", "räume/2", "gait [2]"]),
                START_NS + start,
                START_NS + min(SPAN_NS, start + length),
                rng.choice(WORDS) + ("" if rng.random() < 0.5 else f" {k}"),
                rng.choice(["{}", '{"floor":"2"}']),
                None,
                rng.choice([None, "human:anna", "algorithm:foot.9iez@0.1"]),
                rng.choice([None, rng.random()]),
                rng.choice([None, "a note\nof two lines"]),
                rng.choice([None, "/imu"]),
            )
        )
    return pl.DataFrame(rows, schema=COLUMNS, orient="row")
