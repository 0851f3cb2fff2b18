"""Steps with one set of constants: any placement and rate, silence where nobody walks, real recordings."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import marcha.recording as mr
import marcha.replay as rp
import pytest
from marcha.ingest import convert
from marcha.ingest.simulate import phone_walk

from .phone_runs import run_phone, sensor_tables

DATA = Path(os.environ.get("MARCHA_DATA", Path(__file__).parents[2] / "shared" / "data")) / "phone"
PLACEMENTS = ("hand", "pocket", "bag", "armband", "neck", "swinging")
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason=f"real recordings are not at {DATA}")


def steps_of(scenario: str, **options: Any) -> tuple[int, int]:
    """Return how many steps are found, and how many there are."""
    walk = phone_walk(scenario, gnss_hz=0, pressure_hz=0, **options)
    return run_phone("phone.steps", sensor_tables(walk))["step"].height, walk.steps.height


@pytest.mark.parametrize("rate_hz", [10, 20, 50, 100])
@pytest.mark.parametrize("placement", PLACEMENTS)
def test_within_two_percent(placement: str, rate_hz: int) -> None:
    found, true = steps_of("phone-100m", seed=rate_hz, placement=placement, rate_hz=rate_hz)
    assert abs(found - true) <= 0.02 * true


@pytest.mark.parametrize("rate_hz", [20, 100])
def test_silence_at_rest_and_while_the_phone_is_handled(rate_hz: int) -> None:
    assert steps_of("phone-rest", seed=3, rate_hz=rate_hz, duration_s=120)[0] <= 2
    assert steps_of("phone-handled", seed=4, rate_hz=rate_hz, duration_s=120)[0] <= 6


@pytest.mark.parametrize("metres", [2.8, 3.5])
def test_a_few_steps_between_two_stops_are_found(metres: float) -> None:
    """From one surveyed point to the next they are often four."""
    found = [steps_of("phone-10m", seed=seed, route=str(metres)) for seed in range(4)]
    assert [a for a, _ in found] == [b for _, b in found]


@needs_data
@pytest.mark.parametrize(
    ("folder", "true"), [("Nexus_Jamie_Hard_InHand_2", 306), ("Samsung_Dario_Hard_InHand_1", 277)]
)
def test_real_steps_beside_foot_contacts(folder: str, true: int, tmp_path: Path) -> None:
    """Matched one to one within 0.15 s, sample by sample: the source's own count is 316 and 272."""
    convert([DATA / "steps" / folder], tmp_path / "steps.mcap")
    rec = mr.open(tmp_path / "steps.mcap")
    assert rec.channels["/reference/steps"].count == true
    run = rp.replay(rec, ["phone.steps"], mode="sample").runs[0]
    assert abs(run.metrics["steps"] - true) <= 0.02 * true
    assert run.metrics["steps_precision"] >= 0.98
    assert run.metrics["steps_recall"] >= 0.98
