"""The `opensim` wheel reads what is written for it as its own tables (``pip install opensim``)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import marcha.recording as mr
import numpy as np
import polars as pl
import pytest
from marcha.export import export
from marcha.recording import Recording

from .contracts.exporter import example

opensim: Any = pytest.importorskip("opensim", reason="the opensim wheel is not installed")


@pytest.fixture(scope="module")
def rec(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """The exporters' example, and a marker that is not seen in the last cell of a line."""
    folder = tmp_path_factory.mktemp("opensim")
    with mr.create(folder / "hidden.mcap") as out:
        whole = mr.open(example(folder / "walk.mcap"))
        out.copy_from(whole, [t for t in whole.channels if t != "/reference/markers"])
        markers = whole.table("/reference/markers").with_columns(
            pl.when(pl.int_range(pl.len()) == 7).then(np.nan).otherwise(pl.col(c)).alias(c)
            for c in ("heel.x", "heel.y", "heel.z")
        )
        out.add_table("/reference/markers", "marcha_msgs/msg/OpticalMarkers", markers, frame_id="lab")
    return mr.open(folder / "hidden.mcap")


def test_orientations(rec: Recording, tmp_path: Path) -> None:
    export(rec, "sto", tmp_path / "a.sto", options={"names": "/reference/pose=tibia_r_imu", "y_up": "false"})
    table = opensim.TimeSeriesTableQuaternion(str(tmp_path / "a.sto"))
    assert list(table.getColumnLabels()) == ["tibia_r_imu"]
    expected = rec.table("/reference/pose").select(f"quat_{a}" for a in "wxyz").to_numpy()
    assert table.getNumRows() == len(expected)
    for k in range(0, len(expected), 97):
        q = table.getRowAtIndex(k).getElt(0, 0)
        assert [q.get(i) for i in range(4)] == pytest.approx(expected[k], abs=1e-9)


def test_angles(rec: Recording, tmp_path: Path) -> None:
    export(rec, "mot", tmp_path / "a.mot", options={"names": "knee=knee_angle_r"})
    table = opensim.TimeSeriesTable(str(tmp_path / "a.mot"))
    assert list(table.getColumnLabels()) == ["knee_angle_r"]
    assert table.getTableMetaDataAsString("inDegrees") == "yes"
    angle = np.radians(table.getDependentColumn("knee_angle_r").to_numpy())
    assert np.abs(angle - rec.table("/leg/encoder")["knee"].to_numpy()).max() < 1e-9


def test_markers_with_one_that_is_not_seen(rec: Recording, tmp_path: Path) -> None:
    export(rec, "trc", tmp_path / "a.trc")
    table = opensim.TimeSeriesTableVec3(str(tmp_path / "a.trc"))
    assert table.getTableMetaDataAsString("Units") == "m"
    column = table.getDependentColumn("heel")
    got = np.array([[column[k].get(i) for i in range(3)] for k in range(table.getNumRows())])
    x, y, z = (rec.table("/reference/markers")[f"heel.{a}"].to_numpy() for a in "xyz")
    assert np.flatnonzero(np.isnan(got).any(axis=1)).tolist() == [7]
    assert np.nanmax(np.abs(got - np.column_stack((x, z, -y)))) < 1e-9


def test_sensors_are_placed_on_a_model(rec: Recording, tmp_path: Path) -> None:
    """OpenSense: the pelvis' orientation places a sensor, inverse kinematics follows it."""
    model = opensim.Model()
    pelvis = opensim.Body("pelvis", 1.0, opensim.Vec3(0), opensim.Inertia(1))
    model.addBody(pelvis)
    model.addJoint(opensim.BallJoint("ground_pelvis", model.getGround(), pelvis))
    model.finalizeConnections()
    model.printToXML(str(tmp_path / "model.osim"))
    export(rec, "sto", tmp_path / "a.sto", options={"names": "/reference/pose=pelvis_imu"})
    placer = opensim.IMUPlacer()
    placer.set_model_file(str(tmp_path / "model.osim"))
    placer.set_orientation_file_for_calibration(str(tmp_path / "a.sto"))
    assert placer.run(False)
    placed = placer.getCalibratedModel()
    assert placed.getComponentsList()
    placed.printToXML(str(tmp_path / "placed.osim"))
    assert "pelvis_imu" in (tmp_path / "placed.osim").read_text()
    tool = opensim.IMUInverseKinematicsTool()
    tool.set_model_file(str(tmp_path / "placed.osim"))
    tool.set_orientations_file(str(tmp_path / "a.sto"))
    tool.set_results_directory(str(tmp_path / "ik"))
    tool.set_time_range(0, 0.0)
    tool.set_time_range(1, 2.0)
    assert tool.run(False)
    (motion,) = (tmp_path / "ik").glob("*.mot")
    angles = opensim.TimeSeriesTable(str(motion))
    assert angles.getNumRows() == 201
    # 0.5 sin in the recording's pose: turned about the pelvis by as much
    turned = np.array([angles.getDependentColumn(c).to_numpy() for c in angles.getColumnLabels()])
    q = rec.table("/reference/pose").select("quat_w", "quat_x").to_numpy()[:201]
    expected = np.degrees(2 * np.arctan2(q[:, 1], q[:, 0]))
    assert np.ptp(turned, axis=1).max() == pytest.approx(np.ptp(expected), rel=0.02)
