"""The optical clock is found from rates, events or what the user says; it is stored, and nothing is lost."""

from __future__ import annotations

from pathlib import Path

import marcha.recording as mr
import numpy as np
import polars as pl
import pytest
from marcha.ingest import convert
from marcha.ingest.align import align
from marcha.ingest.clockfit import from_events
from marcha.ingest.simulate import simulate
from marcha.recording import MarchaError, UsageError

from .cli_helpers import marcha


@pytest.mark.parametrize(
    ("scenario", "offset", "drift", "segment", "tissue"),
    [
        ("walking", 3.217, 40.0, "shank", 0.0),
        ("walking", -5.5, -25.0, None, 1.0),
        ("sit-to-stand", 3.217, 40.0, None, 0.0),
        ("squats", -5.5, -25.0, None, 1.0),
    ],
)
def test_offset_and_drift_are_those_of_the_simulation(
    tmp_path: Path, scenario: str, offset: float, drift: float, segment: str | None, tissue: float
) -> None:
    """Soft tissue that follows the bone late looks like an offset: residuals weigh by their covariance."""
    options = {
        "optical_offset_s": offset,
        "optical_drift_ppm": drift,
        "duration_s": 120,
        "dropout_share": 0.01,
        "segments": ("thigh", "shank"),
        "soft_tissue": tissue,
    }
    made = simulate(scenario, tmp_path, seed=5, noise="source", **options)
    convert(made.paths, tmp_path / "raw.mcap")
    fit = align(tmp_path / "raw.mcap", tmp_path / "one.mcap", segment)
    # t_imu = offset + t_optical / (1 + drift): within 3 ms throughout, the drift within 10 ppm.
    at = np.array([10.0, 60.0, 110.0])
    error = fit.offset_s + (1 + fit.drift_ppm * 1e-6) * at - (offset + at / (1 + drift * 1e-6))
    assert np.abs(error).max() < 0.003
    assert fit.drift_ppm == pytest.approx(-drift, abs=10)
    assert abs(fit.drift_ppm + drift) < 4 * fit.drift_sd_ppm
    record = mr.open(tmp_path / "one.mcap").metadata["alignment"]
    assert float(record["correlation"]) > 0.9
    assert "/reference/markers" in record["moved"].split(", ")
    assert "/leg/shank/imu" not in record["moved"]


def test_events_and_given_offsets(tmp_path: Path) -> None:
    """Two events state a line; a given offset moves every optical channel, nothing else, and loses nothing."""
    fit = from_events([(11.0, 10.0), (111.001, 110.0)])
    assert (fit.offset_s, fit.drift_ppm) == pytest.approx((0.9999, 10.0))
    assert from_events([(3.5, 1.0)]).offset_s == 2.5
    with pytest.raises(MarchaError, match="same optical time"):
        from_events([(1.0, 1.0), (2.0, 1.0)])
    made = simulate("walking", tmp_path, seed=5, duration_s=10)
    convert(made.paths, tmp_path / "raw.mcap")
    raw = mr.open(tmp_path / "raw.mcap")
    done = marcha("align", raw.path, "-o", tmp_path / "one.mcap", "--event", "1.5=2.75")
    assert done.code == 0
    assert "event: offset -1.250000 s" in done.out
    one = mr.open(tmp_path / "one.mcap")
    for topic in ("/reference/markers", "/leg/thigh/imu"):
        before, after = raw.table(topic), one.table(topic)
        assert before.drop("t_ns").equals(after.drop("t_ns"), null_equal=True)
        later = (after["t_ns"] - before["t_ns"]).unique().to_list()
        assert later == [0 if topic == "/reference/markers" else 1_250_000_000]
    assert one.metadata["alignment"]["all_later_s"] == "1.25"
    assert one.metadata["alignment"]["method"] == "event"
    assert marcha("align", raw.path, "-o", tmp_path / "x.mcap", "--event", "now").code == 2
    with pytest.raises(UsageError, match="three ways"):
        align(raw.path, tmp_path / "x.mcap", "shank", offset_s=1.0)


def test_a_table_of_knee_angles_is_enough(tmp_path: Path) -> None:
    """No markers: the angle's rate beside the sensors' rates about their main axes."""
    made = simulate("walking", tmp_path, seed=5, duration_s=60, segments=("thigh", "shank"))
    truth = pl.read_csv(tmp_path / "walking-005.truth.leg.csv")
    knee = pl.DataFrame(
        {"time": truth["t_ns"] * 1e-9 + 2.5, "knee_deg": np.degrees(truth["joint.knee"].to_numpy())}
    )
    for path in tmp_path.glob("*truth*"):
        path.unlink()
    knee.write_csv(tmp_path / "knee.csv")
    exo = next(p for p in made.paths if p.suffix == ".csv")
    convert([exo, tmp_path / "knee.csv"], tmp_path / "raw.mcap")
    fit = align(tmp_path / "raw.mcap", tmp_path / "one.mcap")
    assert fit.offset_s == pytest.approx(-2.5, abs=0.003)
    assert mr.open(tmp_path / "one.mcap").metadata["alignment"]["segment"] == "knee"


def test_what_cannot_be_aligned_is_one_line(tmp_path: Path) -> None:
    made = simulate("walking", tmp_path, seed=5, duration_s=20, optical_offset_s=-300, optical_stop_s=2)
    convert(made.paths, tmp_path / "raw.mcap")
    with pytest.raises(MarchaError, match="alignment: ") as caught:
        align(tmp_path / "raw.mcap", tmp_path / "one.mcap", "shank")
    assert "\n" not in str(caught.value)
    with pytest.raises(MarchaError, match="no channel /leg/arm/imu"):
        align(tmp_path / "raw.mcap", tmp_path / "one.mcap", "arm")
    align(tmp_path / "raw.mcap", tmp_path / "one.mcap", offset_s=1.0)
    with pytest.raises(MarchaError, match="nothing to align"):
        align(tmp_path / "one.mcap", tmp_path / "two.mcap")
