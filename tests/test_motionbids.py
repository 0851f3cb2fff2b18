"""What `motionbids` writes is read, and what is written for others keeps its rules (``pip install motionbids``)."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import marcha.recording as mr
import numpy as np
import polars as pl
import pytest
from marcha.export import export
from marcha.ingest import convert

from .contracts.exporter import example

motionbids: Any = pytest.importorskip("motionbids", reason="motionbids is not installed")

pytestmark = pytest.mark.filterwarnings("ignore:Missing recommended fields")


def test_what_motionbids_writes_is_read(tmp_path: Path) -> None:
    data = np.random.default_rng(0).normal(size=(500, 6))
    kinds = {"acc": ("ACCEL", "m/s^2"), "gyr": ("GYRO", "rad/s")}
    channels = [
        motionbids.Channel(
            channel_name=f"imu_{name}_{axis}",
            channel_component=axis,
            channel_type=kind,
            channel_tracked_point="foot",
            channel_units=unit,
        )
        for name, (kind, unit) in kinds.items()
        for axis in "xyz"
    ]
    motion = motionbids.MotionData(
        subject="01",
        task_name="walk",
        tracksys="imu",
        sampling_frequency=100,
        tracked_points_count=1,
        manufacturer="X",
        data=data,
        channels=channels,
    )
    motionbids.export_bids_motion(motion, out_dir=str(tmp_path / "set"))
    convert([next((tmp_path / "set").glob("*_motion.tsv"))], tmp_path / "a.mcap")
    rec = mr.open(tmp_path / "a.mcap")
    (topic,) = rec.channels
    columns = [f"{name}_{axis}" for name in kinds for axis in "xyz"]
    assert np.abs(rec.table(topic).select(columns).to_numpy() - data).max() <= 5e-7  # its six decimals
    assert np.diff(rec.table(topic)["t_ns"].to_numpy()).tolist() == [10_000_000] * 499


def test_every_tracking_system_keeps_the_rules_of_motionbids(tmp_path: Path) -> None:
    """Its required fields, its names of channels' types, components and units, rows and columns of the data."""
    export(mr.open(example(tmp_path / "walk.mcap")), "bids", tmp_path / "set")
    systems = [p for p in (tmp_path / "set").rglob("*_motion.json") if "derivatives" not in p.parts]
    assert len(systems) > 1
    for path in systems:
        facts = {
            re.sub(r"(?<!^)(?=[A-Z])", "_", k).lower(): v for k, v in json.loads(path.read_text()).items()
        }
        listing = pl.read_csv(
            path.with_name(path.name.replace("_motion.json", "_channels.tsv")),
            separator="\t",
            infer_schema=False,
        )
        rows = pl.read_csv(path.with_suffix(".tsv"), separator="\t", has_header=False, null_values=["n/a"])
        channels = [
            motionbids.Channel(
                channel_name=c["name"],
                channel_component=c["component"],
                channel_type=c["type"],
                channel_tracked_point=c["tracked_point"],
                channel_units=c["units"],
            )
            for c in listing.iter_rows(named=True)
        ]
        motion = motionbids.MotionData(
            subject="01",
            tracksys=re.findall("tracksys-([^_]+)", path.name)[0],
            data=rows.to_numpy(),
            channels=channels,
            **{
                k: v
                for k, v in facts.items()
                if k in ("task_name", "sampling_frequency", "tracked_points_count")
            },
        )
        assert motionbids.validate_motion_data(motion)
