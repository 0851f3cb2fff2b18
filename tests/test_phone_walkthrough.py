"""A stranger's way: the zip of an app, two commands, a map with steps, distance and accuracy. And a real loop."""

from __future__ import annotations

import json
import os
import zipfile
from pathlib import Path

import marcha.recording as mr
import marcha.replay as rp
import numpy as np
import pytest
from marcha.algorithms.phone.lengths import fit_lengths, regressors
from marcha.ingest import convert
from marcha.ingest.simulate import simulate

from .cli_helpers import marcha

DATA = Path(os.environ.get("MARCHA_DATA", Path(__file__).parents[2] / "shared" / "data")) / "phone"
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason=f"real recordings are not at {DATA}")


def test_from_a_zip_to_the_map_in_two_commands(tmp_path: Path) -> None:
    made = simulate("phone-turns", tmp_path / "raw", seed=7, format="sensor-logger", rate_hz=50)
    with zipfile.ZipFile(tmp_path / "walk.zip", "w") as z:
        for file in sorted(made.paths[0].iterdir()):
            z.write(file, file.name)
    rec, rrd = str(tmp_path / "walk.mcap"), tmp_path / "walk.rrd"
    assert marcha("convert", str(tmp_path / "walk.zip"), "-o", rec).code in (0, 3)
    done = marcha(
        "replay", rec, "-e", "phone.fused", "-o", str(tmp_path / "done.mcap"), "--rrd", str(rrd), "--json"
    )
    assert done.code == 0
    found = json.loads(done.out)["runs"][0]["metrics"]
    assert abs(found["steps"] - 71) <= 2
    assert found["distance_m"] == pytest.approx(50.0, rel=0.12)
    assert 1.0 < found["accuracy95_end_m"] < 15.0
    assert rrd.stat().st_size > 10_000
    figure = tmp_path / "map.png"
    assert marcha("view", str(tmp_path / "done.mcap"), "--figure", str(figure), "--kind", "map").code == 0
    assert figure.stat().st_size > 10_000


@needs_data
def test_the_real_loop_by_every_length_model(tmp_path: Path) -> None:
    """168 steps and 116 m: Scarlett with the source's K; the others after fitting on the first half."""
    convert([DATA / "phyphox"], tmp_path / "loop.mcap", options={})
    rec = mr.open(tmp_path / "loop.mcap")
    steps, track = rp.replay(rec, ["phone.steps", "phone.pdr[length=scarlett]"]).runs
    assert abs(steps.metrics["steps"] - 168) <= 0.02 * 168
    assert track.metrics["distance_m"] == pytest.approx(116.0, rel=0.03)
    assert track.metrics["closure_m"] < 3.5
    features = steps.tables["detector"].select(pl_columns(steps.tables["detector"].columns)).to_numpy()
    half = len(features) // 2
    for model in ("cadence", "static", "weinberg", "kim", "scarlett", "equal"):
        k = fit_lengths(model, [(features[:half], 116.0 * half / len(features))])["length_k"]
        assert k * float(np.sum(regressors(model, features))) == pytest.approx(116.0, rel=0.035), model
        # That half of the steps is half of the way is only nearly so: the person slows down. Every other step is.
        k = fit_lengths(model, [(features[::2], 116.0 * len(features[::2]) / len(features))])["length_k"]
        assert k * float(np.sum(regressors(model, features))) == pytest.approx(116.0, rel=0.03), model


def pl_columns(columns: list[str]) -> list[str]:
    return [c for c in columns if c not in ("t_ns", "t_log_ns")]
