"""What all tests share."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

ROOT = Path(__file__).resolve().parents[1]

settings.register_profile(
    "marcha",
    deadline=None,  # a first call compiles
    derandomize=True,
    max_examples=40,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)
settings.load_profile("marcha")


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Return the folder of real recordings; skip where the machine has none."""
    folder = Path(os.environ.get("MARCHA_DATA", ROOT.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no real recordings at {folder}; set MARCHA_DATA to their folder")
    return folder
