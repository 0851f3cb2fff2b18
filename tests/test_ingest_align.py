"""The optical clock is found from the rates alone, and stored."""

from __future__ import annotations

from pathlib import Path

import marcha.recording as mr
import numpy as np
import pytest
from marcha.ingest import convert
from marcha.ingest.align import align
from marcha.ingest.simulate import simulate
from marcha.recording import MarchaError


@pytest.mark.parametrize(
    ("scenario", "offset", "drift"), [("walking", 3.217, 40.0), ("walking", -5.5, -25.0)]
)
def test_offset_and_drift_are_those_of_the_simulation(
    tmp_path: Path, scenario: str, offset: float, drift: float
) -> None:
    options = {
        "optical_offset_s": offset,
        "optical_drift_ppm": drift,
        "duration_s": 120,
        "dropout_share": 0.01,
    }
    made = simulate(scenario, tmp_path, seed=5, noise="source", **options)
    convert(made.paths, tmp_path / "raw.mcap")
    fit = align(tmp_path / "raw.mcap", tmp_path / "one.mcap", "shank")
    # t_imu = offset + t_optical / (1 + drift): at the middle of the capture within 3 ms, the drift within 10 ppm.
    at = np.array([10.0, 60.0, 110.0])
    error = fit.offset_s + (1 + fit.drift_ppm * 1e-6) * at - (offset + at / (1 + drift * 1e-6))
    assert np.abs(error).max() < 0.003
    assert fit.drift_ppm == pytest.approx(-drift, abs=10)
    record = mr.open(tmp_path / "one.mcap").metadata["alignment"]
    assert float(record["correlation"]) > 0.9
    assert record["moved"] == "/reference/markers"


def test_what_cannot_be_aligned_is_one_line(tmp_path: Path) -> None:
    made = simulate("walking", tmp_path, seed=5, duration_s=20, optical_offset_s=-300, optical_stop_s=2)
    convert(made.paths, tmp_path / "raw.mcap")
    with pytest.raises(MarchaError, match="alignment: ") as caught:
        align(tmp_path / "raw.mcap", tmp_path / "one.mcap", "shank")
    assert "\n" not in str(caught.value)
    with pytest.raises(MarchaError, match="no channel /leg/arm/imu"):
        align(tmp_path / "raw.mcap", tmp_path / "one.mcap", "arm")
