"""Contracts of the importers of captures: Vicon CSV, C3D, RepoIMU CSV, MATLAB files of two sensors and an encoder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
import scipy.io
from marcha.ingest.formats.c3d import C3d
from marcha.ingest.formats.inertial_csv import InertialCsv
from marcha.ingest.formats.mpu_encoder_mat import MpuEncoderMat
from marcha.ingest.formats.repoimu_csv import FIRST, SECOND, RepoImuCsv
from marcha.ingest.formats.vicon_csv import ViconCsv
from marcha.ingest.registry import make_options
from marcha.ingest.simulate import leg
from marcha.ingest.simulate.leg import LegCapture
from scipy.spatial.transform import Rotation

from .contracts.importer import ImporterContract

MARKS = ("hip", "knee_lat", "knee_med", "ankle_lat", "ankle_med", "heel", "toe")


def squats(**options: Any) -> LegCapture:
    known: dict[str, Any] = {"seed": 1, "duration_s": 10, "noise": "mems", "dropout_share": 0.0}
    return leg("squats", **(known | options))


def markers(capture: LegCapture) -> np.ndarray:
    """Return the leg's landmarks (n, 7, 3), m."""
    names = list(capture.optical.names)
    return capture.optical.pos[:, [names.index(m) for m in MARKS]]


def sensor_csv(path: Path, capture: LegCapture, segment: str, header: str) -> Path:
    """Write a sensor as a logger does: ms, g and °/s; between semicolons with decimal commas."""
    one = capture.segments[segment]
    cells = np.column_stack([capture.t * 1e3, one.acc_b / 9.80665, np.degrees(one.gyr_b)])
    rows = "\n".join(
        (";" if ";" in header else ",").join(
            f"{v:.5f}".replace(".", "," if ";" in header else ".") for v in row
        )
        for row in cells
    )
    path.write_text(f"{header}\n{rows}\n", encoding="utf-8")
    return path


class TestInertialCsv(ImporterContract):
    importer = InertialCsv()

    def sample(self, folder: Path) -> Path:
        return sensor_csv(
            folder / "thigh.csv", squats(), "thigh", "time_ms,ax_g,ay_g,az_g,gx_dps,gy_dps,gz_dps"
        )


class TestViconCsv(ImporterContract):
    importer = ViconCsv()

    def sample(self, folder: Path) -> Path:
        pos = markers(squats(optical_rate_hz=50.0)) * 1000
        frames = [f"{k + 1},0," + ",".join(f"{v:.4f}" for v in p.ravel()) for k, p in enumerate(pos)]
        head = [
            "Trajectories",
            "50",
            ",," + ",,,".join(f"subject:{m}" for m in MARKS) + ",,",
            "Frame,Sub Frame" + ",X,Y,Z" * len(MARKS),
            "," + ",mm,mm,mm" * len(MARKS),
        ]
        path = folder / "trial.csv"
        path.write_text("\r\n".join([*head, *frames, ""]))
        return path


class TestC3d(ImporterContract):
    importer = C3d()

    def sample(self, folder: Path) -> Path:
        import ezc3d

        file = ezc3d.c3d()
        pos = markers(squats(optical_rate_hz=50.0)) * 1000
        file["parameters"]["POINT"]["RATE"]["value"] = [50]
        file["parameters"]["POINT"]["LABELS"]["value"] = MARKS
        file["parameters"]["POINT"]["UNITS"]["value"] = ("mm",)
        file["data"]["points"] = np.concatenate([pos.transpose(2, 1, 0), np.ones((1, *pos.shape[1::-1]))])
        path = folder / "trial.c3d"
        file.write(str(path))
        return path


class TestRepoImuCsv(ImporterContract):
    importer = RepoImuCsv()

    def sample(self, folder: Path) -> Path:
        capture = squats()
        s = capture.segments["thigh"]
        quat = Rotation.from_matrix(s.rot_nb).as_quat(scalar_first=True)
        field = np.tile([0.3, 0.1, -0.9], (len(quat), 1))
        rows = np.column_stack([capture.t, quat, s.acc_b, s.gyr_b, field])
        path = folder / "Test_Trial1_Segment_1.csv"
        body = pl.DataFrame(rows).write_csv(separator=";", include_header=False, float_precision=6)
        path.write_text(f"{FIRST}\n{SECOND}\n{body}")
        return path


class TestMpuEncoderMat(ImporterContract):
    importer = MpuEncoderMat()

    def sample(self, folder: Path) -> Path:
        capture = squats()
        found = {"all_time": capture.t, "all_encoder": np.degrees(capture.joints["knee"].encoder)}
        for k, name in (("1", "thigh"), ("2", "shank")):
            s = capture.segments[name]
            for j, a in enumerate("xyz"):
                found[f"all_accel_{k}_{a}"] = s.acc_b[:, j] / 9.80665
                found[f"all_gyro_{k}_{a}"] = np.degrees(s.gyr_b[:, j])
        path = folder / "trial.mat"
        scipy.io.savemat(path, found)
        return path


@pytest.mark.parametrize("kind", [TestViconCsv, TestC3d], ids=["vicon-csv", "c3d"])
def test_reference_angles_of_a_capture_are_the_true_ones(
    kind: type[ImporterContract], tmp_path: Path
) -> None:
    path = kind().sample(tmp_path)
    imported = kind.importer.read([path], make_options(kind.importer, {}))
    tables = dict(imported.blocks())
    knee = tables["/reference/optical/joint"]["knee"].to_numpy()
    true = squats(optical_rate_hz=50.0).optical.angle["knee"]
    np.testing.assert_allclose(np.degrees(knee), np.degrees(true[: len(knee)]), atol=1.5)
    assert np.std(np.degrees(knee - true[: len(knee)])) < 0.4
