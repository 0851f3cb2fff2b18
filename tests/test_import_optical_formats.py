"""Importers of optical systems and MATLAB captures: the contract of each, on samples written here."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from marcha.ingest.formats.c3d import C3d
from marcha.ingest.formats.mpu_encoder_mat import MpuEncoderMat
from marcha.ingest.formats.repoimu_csv import FIRST, SECOND, RepoImuCsv
from marcha.ingest.formats.vicon_csv import ViconCsv
from marcha.ingest.simulate import leg

from .contracts.importer import ImporterContract

G = 9.80665


def squats() -> Any:
    return leg("squats", seed=1, duration_s=10, noise="mems")


class TestRepoImuCsv(ImporterContract):
    importer = RepoImuCsv()

    def sample(self, folder: Path) -> Path:
        capture = squats()
        s = capture.segments["thigh"]
        turned = np.tile([1.0, 0.0, 0.0, 0.0], (len(capture.t), 1))
        field = np.tile([0.4, 0.0, -0.8], (len(capture.t), 1))
        rows = np.column_stack((capture.t, turned, s.acc_b, s.gyr_b, field))
        path = folder / "trial_segment_1.csv"
        path.write_text("\n".join([FIRST, SECOND, *(";".join(f"{v:.6g}" for v in r) for r in rows), ""]))
        return path


class TestMpuEncoderMat(ImporterContract):
    importer = MpuEncoderMat()

    def sample(self, folder: Path) -> Path:
        from scipy.io import savemat

        capture = squats()
        table = {"all_time": capture.t * 1e3, "all_encoder": np.degrees(capture.joints["knee"].angle)}
        for k, name in ((1, "thigh"), (2, "shank")):
            s = capture.segments[name]
            for j, a in enumerate("xyz"):
                table[f"all_accel_{k}_{a}"] = s.acc_b[:, j] / G
                table[f"all_gyro_{k}_{a}"] = np.degrees(s.gyr_b[:, j])
        path = folder / "roll.mat"
        savemat(path, table)
        return path


class TestViconCsv(ImporterContract):
    importer = ViconCsv()

    def sample(self, folder: Path) -> Path:
        n = 450
        names, wave = ["heel", "toe"], np.sin(np.arange(n) / 9.0)
        values = np.column_stack([1000 * wave + 10 * k for k in range(6)])
        head = ["Trajectories", "100", ",," + ",,,".join(f"walker:{x}" for x in names)]
        head += ["Frame,Sub Frame" + ",X,Y,Z" * 2, ",," + ",".join(["mm"] * 6)]
        rows = [f"{k + 1},0," + ",".join(f"{v:.4f}" for v in row) for k, row in enumerate(values)]
        path = folder / "walk.csv"
        path.write_text("\n".join([*head, *rows, ""]))
        return path


class TestC3d(ImporterContract):
    importer = C3d()

    def sample(self, folder: Path) -> Path:
        import ezc3d

        wave = np.sin(np.arange(450) / 9.0)
        file = ezc3d.c3d()
        file["parameters"]["POINT"]["RATE"]["value"] = [100.0]
        file["parameters"]["POINT"]["LABELS"]["value"] = ["heel", "toe"]
        file["parameters"]["POINT"]["UNITS"]["value"] = ["mm"]
        points = np.ones((4, 2, len(wave)))
        points[:3] = np.stack([[1000 * wave + 10 * k for _ in range(2)] for k in range(3)])
        file["data"]["points"] = points
        path = folder / "walk.c3d"
        file.write(str(path))
        return path
