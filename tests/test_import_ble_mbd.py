"""Importer of BLE packets at receivers: the contract, calibration folders, defects that are said."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl
import pytest
from marcha.ingest import convert
from marcha.ingest.formats.ble_mbd import BleMbd
from marcha.recording import MarchaError
from marcha.recording import open as open_recording

from .contracts.importer import ImporterContract

DEVICES = (
    'Dongles:{"b827eb4521b4": [[7.0, 7.1, 1.2], 1, "sensor10"], "000000000101": [[7.2, 0.7, 2.3], 2, "sensor11"]}\n'
    'Beacons:{"e78f135624ce": [[], 3, "beacon1"]}\n'
)


def rows(n: int, receiver: str = "b827eb4521b4", start: int = 1_581_252_284, track: bool = True) -> str:
    out = []
    for k in range(n):
        mac = ("b827eb4521b4", "000000000101")[k % 2] if track else receiver
        pose = f",{k * 0.01},4.0,1.8,1,0,0,0,1,0,0,0,1" if track else ""
        out.append(f"{start + k // 20}.{k % 20 * 50:03d},{mac},e78f135624ce,{-60 - k % 7}{pose}")
    return "\n".join(out) + "\n"


class TestBleMbd(ImporterContract):
    importer = BleMbd()

    def sample(self, folder: Path) -> Path:
        (folder / "site.dev").write_text(DEVICES)
        path = folder / "track.mbd"
        path.write_text(rows(500))
        return path


def test_a_track_becomes_powers_pose_and_anchors(tmp_path):
    path = TestBleMbd().sample(tmp_path)
    convert(path, tmp_path / "track.mcap")
    recording = open_recording(tmp_path / "track.mcap")
    radio, pose = recording.table("/indoor/radio"), recording.table("/reference/pose")
    assert radio.height == pose.height == 500
    assert radio["mac"][0] == "b8:27:eb:45:21:b4"
    assert radio["t_ns"][1] - radio["t_ns"][0] == 50_000_000  # exact: an epoch in ns is no float
    assert pose["pos_x"].to_numpy() == pytest.approx(np.arange(500) * 0.01)
    assert b"b8:27:eb:45:21:b4,ble,7.0,7.1,1.2,,,sensor10" in recording.attachment("anchors.csv")


def test_a_calibration_folder_is_one_survey(tmp_path):
    folder = tmp_path / "calibration"
    folder.mkdir()
    (tmp_path / "site.dev").write_text(DEVICES)
    (folder / "sensor10_1.00_2.00_1.85.mbd").write_text(rows(40, track=False))
    (folder / "sensor11_3.00_2.00_1.85.mbd").write_text(
        rows(40, "000000000101", track=False)
    )  # at the same time
    done = convert(folder, tmp_path / "survey.mcap")
    assert any(f.kind == "overlapping_stretches" for f in done.report.findings)
    recording = open_recording(tmp_path / "survey.mcap")
    radio, where = recording.table("/indoor/radio"), recording.table("/reference/position")
    assert radio["t_ns"].is_sorted()
    x = np.interp(radio["t_ns"].to_numpy(), where["t_ns"].to_numpy(), where["pos_x"].to_numpy())
    for mac, place in (("b8:27:eb:45:21:b4", 1.0), ("00:00:00:00:01:01", 3.0)):
        assert x[(radio["mac"] == mac).to_numpy()] == pytest.approx(place)


def test_defects_are_said(tmp_path):
    path = TestBleMbd().sample(tmp_path)
    lines = path.read_text().splitlines()
    lines[10], lines[11] = lines[11], lines[10]
    lines[20] = lines[20][:30]
    path.write_text("\n".join(lines))
    findings = {f.kind: f for f in convert(path, tmp_path / "a.mcap").report.findings}
    assert findings["backwards_time"].count == 1
    assert findings["bad_row"].first_line == 21
    (tmp_path / "site.dev").unlink()
    with pytest.raises(MarchaError, match="devices="):
        convert(path, tmp_path / "b.mcap")


def test_a_time_beyond_any_clock_is_a_bad_row(tmp_path):
    path = TestBleMbd().sample(tmp_path)
    lines = path.read_text().splitlines()
    lines[20] = "9581252284.75" + lines[20][lines[20].index(",") :]
    path.write_text("\n".join(lines))
    (finding,) = [f for f in convert(path, tmp_path / "a.mcap").report.findings if f.kind == "bad_row"]
    assert (finding.count, finding.first_line) == (1, 21)
    assert "beyond any clock" in finding.detail


@pytest.mark.data
def test_real_tracks_against_the_optical_truth(data_dir, tmp_path):
    """Calibrated from the calibration folder only; our figures with room for another seed's luck."""
    from marcha.algorithms import Stretch, make
    from marcha.algorithms.indoor.calibrate import RadioCalibration

    from .event_loop import drive

    folder = data_dir / "indoor" / "ble_tracks"
    convert(folder / "calibration", tmp_path / "survey.mcap")
    survey = open_recording(tmp_path / "survey.mcap")
    tables = {"radio": (survey.table("/indoor/radio"),), "position": (survey.table("/reference/position"),)}
    attached = {"anchors.csv": survey.attachment("anchors.csv")}
    calibration = RadioCalibration().calibrate([Stretch({}, tables, {}, attached, "survey")])
    assert calibration.values["pooled"]["ble"]["eta"] == pytest.approx(1.38, abs=0.02)
    wrong, inside = [], []
    for log in sorted(folder.glob("*.mbd")):
        convert(log, tmp_path / "track.mcap", overwrite=True)
        track = open_recording(tmp_path / "track.mcap")
        radio = {"radio": {"/indoor/radio": track.table("/indoor/radio")}}
        found = drive(make("indoor.fused"), radio, attachments=attached, calibrations={"radio": calibration})
        truth = (
            track.table("/reference/pose")
            .join(found["position"], on="t_ns", suffix="_e")
            .join(found["sigma"], on="t_ns")
        )
        delta = truth.select(
            x=pl.col("pos_x_e") - pl.col("pos_x"), y=pl.col("pos_y_e") - pl.col("pos_y")
        ).to_numpy()
        wrong.append(np.linalg.norm(delta, axis=1))
        inside.append(
            ((delta / truth.select("sigma_pos_x", "sigma_pos_y").to_numpy()) ** 2).sum(axis=1) < 5.991
        )
    assert np.concatenate(wrong).mean() < 1.95
    assert 0.85 < np.concatenate(inside).mean() < 0.99
