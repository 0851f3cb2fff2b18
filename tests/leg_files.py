"""Simulated legs as files of other makers: Xsens text of two sensors beside a TRC of their own clock."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from marcha.ingest.simulate.leg import LegCapture, leg
from marcha.ingest.simulate.legfiles import trc


def xsens_text(capture: LegCapture, segment: str) -> bytes:
    """Return a sensor as MT Manager writes it: a packet counter, m/s² and rad/s between tabs."""
    one = capture.segments[segment]
    columns: dict[str, Any] = {"PacketCounter": (np.arange(len(capture.t)) + 60000) % 65536}
    for word, values in (("Acc", one.acc_b), ("Gyr", one.gyr_b)):
        columns |= {f"{word}_{a}": values[:, k] for k, a in enumerate("XYZ")}
    head = f"// Start Time: Unknown\r\n// Update Rate: {capture.options.rate_hz:.1f}Hz\r\n"
    return (
        head.encode()
        + pl.DataFrame(columns).write_csv(separator="\t", float_precision=6, line_terminator="\r\n").encode()
    )


def xsens_and_markers(folder: Path, **options: Any) -> LegCapture:
    """Write ``thigh.txt``, ``shank.txt`` and ``walk.trc``; the cameras start 1.3 s later, 30 ppm fast."""
    known: dict[str, Any] = {
        "seed": 3,
        "segments": ("thigh", "shank"),
        "rate_hz": 100.0,
        "duration_s": 40.0,
        "optical_offset_s": 1.3,
        "optical_drift_ppm": 30.0,
    }
    capture = leg("walking", **(known | options))
    for segment in ("thigh", "shank"):
        (folder / f"{segment}.txt").write_bytes(xsens_text(capture, segment))
    (folder / "walk.trc").write_bytes(trc(capture, "walk.trc"))
    return capture
