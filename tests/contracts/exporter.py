"""The contract of every exporter: inherit it and say which one is yours."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, ClassVar

import marcha.recording as mr
import msgspec
import numpy as np
import polars as pl
import pytest
from marcha.export import available, export, losses
from marcha.recording import OutputExists, Recording, UsageError

START_NS = 1_700_000_000_000_000_000
ROWS = 3000


def example(path: Path, rows: int = ROWS) -> Path:
    """Write a small recording with all that an exporter must cope with; return its path.

    Sensors at different rates, fixes, markers, a joint, a reference, an estimate that was known later than it
    speaks of, a channel without a message, annotations, metadata and an attachment.
    """
    t_ns = START_NS + 10_000_000 * np.arange(rows, dtype=np.int64)
    wave = np.sin(np.arange(rows) / 7.0)
    imu = pl.DataFrame(
        {"t_ns": t_ns, **{f"{s}_{a}": wave * k for s in ("acc", "gyr") for k, a in enumerate("xyz", 1)}}
    )
    mag = pl.DataFrame({"t_ns": t_ns[::5], **{f"mag_{a}": wave[::5] * 1e-5 for a in "xyz"}})
    fix = pl.DataFrame(
        {"t_ns": t_ns[::100], "lat_deg": 38.7 + 1e-6 * wave[::100], "lon_deg": -9.1 + 2e-6 * wave[::100]}
    )
    markers = pl.DataFrame({"t_ns": t_ns[::2], **{f"heel.{a}": wave[::2] for a in "xyz"}})
    joint = pl.DataFrame({"t_ns": t_ns[::2], "knee": 0.5 * wave[::2]})
    half = np.arcsin(0.5 * wave)
    pose = pl.DataFrame(
        {
            "t_ns": t_ns,
            **{f"pos_{a}": wave for a in "xyz"},
            "quat_w": np.cos(half),
            "quat_x": np.sin(half),
            "quat_y": 0.0 * half,
            "quat_z": 0.0 * half,
        }
    )
    stance = pl.DataFrame({"t_ns": t_ns[:-10], "t_log_ns": t_ns[10:], "still": wave[:-10] > 0})
    notes = pl.DataFrame(
        {
            "tier": ["manual", "manual"],
            "start_ns": [START_NS + 10**9, START_NS + 5 * 10**9],
            "end_ns": [START_NS + 2 * 10**9, START_NS + 5 * 10**9],
            "label": ["turn", "a tab\tand a comma, in it"],
            "metadata": ['{"who": "me"}', "{}"],
        }
    )
    with mr.create(path) as out:
        out.add_table("/foot/imu1", "sensor_msgs/msg/Imu", imu, frame_id="imu1")
        out.add_table("/foot/mag", "sensor_msgs/msg/MagneticField", mag, frame_id="imu1")
        out.add_table("/estimate/mine/stance", "marcha_msgs/msg/Stance", stance, frame_id="imu1")
        out.add_table("/phone/gnss", "sensor_msgs/msg/NavSatFix", fix)
        out.add_table("/reference/markers", "marcha_msgs/msg/OpticalMarkers", markers, frame_id="lab")
        out.add_table("/leg/encoder", "sensor_msgs/msg/JointState", joint)
        out.add_table("/reference/pose", "geometry_msgs/msg/PoseStamped", pose, frame_id="nav")
        out.add_channel("/empty", "sensor_msgs/msg/Temperature", columns=("temperature_c",))
        out.add_annotations(notes)
        out.add_metadata("device", {"clock": "unix", "name": "example"})
        out.add_attachment("plan/floor.txt", b"a floor plan", "text/plain")
    return path


class ExporterContract:
    """Subclass as ``class TestMine(ExporterContract)`` and set ``name``.

    What it promises: it is registered and describes itself; the output appears whole or not at all; nothing
    is overwritten unless asked; the recording is left as it was; options are checked.
    """

    name: ClassVar[str] = ""

    @pytest.fixture
    def rec(self, tmp_path: Path) -> Recording:
        return mr.open(example(tmp_path / "example.mcap"))

    def target(self, folder: Path) -> Path:
        return folder / f"out{available()[self.name].suffix}"

    def run(self, rec: Recording, path: Path, **options: Any) -> list[Path]:
        overwrite = options.pop("overwrite", False)
        return export(rec, self.name, path, options=options, overwrite=overwrite)

    def test_is_registered_under_its_name(self) -> None:
        assert available()[self.name].name == self.name

    def test_describes_itself(self) -> None:
        exporter = available()[self.name]
        assert exporter.title
        assert issubclass(exporter.Options, msgspec.Struct)

    def test_says_which_files_it_wrote(self, rec: Recording, tmp_path: Path) -> None:
        files = self.run(rec, self.target(tmp_path))
        assert files
        assert all(f.is_file() and f.stat().st_size for f in files)

    def test_leaves_nothing_else_behind(self, rec: Recording, tmp_path: Path) -> None:
        before = set(tmp_path.iterdir())
        files = self.run(rec, self.target(tmp_path))
        left = set(tmp_path.iterdir()) - before
        assert self.target(tmp_path) in left
        assert left - {self.target(tmp_path)} <= set(files)

    def test_leaves_the_recording_as_it_was(self, rec: Recording, tmp_path: Path) -> None:
        before = rec.path.read_bytes()
        self.run(rec, self.target(tmp_path))
        assert rec.path.read_bytes() == before

    def test_does_not_overwrite(self, rec: Recording, tmp_path: Path) -> None:
        files = self.run(rec, self.target(tmp_path))
        before = [f.read_bytes() for f in files]
        with pytest.raises(OutputExists):
            self.run(rec, self.target(tmp_path))
        assert [f.read_bytes() for f in files] == before

    def test_overwrites_when_told(self, rec: Recording, tmp_path: Path) -> None:
        self.run(rec, self.target(tmp_path))
        assert all(f.is_file() for f in self.run(rec, self.target(tmp_path), overwrite=True))

    def test_says_what_the_format_does_not_hold(self, rec: Recording, tmp_path: Path) -> None:
        before = set(tmp_path.iterdir())
        said = losses(rec, self.name)
        assert all(line and "\n" not in line for line in said)
        assert set(tmp_path.iterdir()) == before

    def test_one_of_two_at_once_is_refused(
        self, rec: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        target = self.target(tmp_path)
        first: list[Path] = []
        real = Path.rename if not available()[self.name].suffix else os.link

        def beaten(part: Any, path: Any, *rest: Any, **more: Any) -> Any:
            if not first and Path(path) == target:
                first.append(target)  # the other one is done while this one puts its result in place
                self.run(rec, target)
            return real(part, path, *rest, **more)

        monkeypatch.setattr(*((Path, "rename") if real is not os.link else (os, "link")), beaten)
        with pytest.raises(OutputExists):
            self.run(rec, target)

    def test_unknown_option_is_refused(self, rec: Recording, tmp_path: Path) -> None:
        with pytest.raises(UsageError, match="no_such_option"):
            self.run(rec, self.target(tmp_path), no_such_option="1")
        assert not self.target(tmp_path).exists()

    def test_unknown_topic_is_refused(self, rec: Recording, tmp_path: Path) -> None:
        with pytest.raises(UsageError, match="/nothing"):
            self.run(rec, self.target(tmp_path), topics="/nothing/*")
        assert not self.target(tmp_path).exists()

    def test_failure_leaves_nothing(
        self, rec: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        before = set(tmp_path.iterdir())

        def broken(*_: Any, **__: Any) -> Any:
            raise RuntimeError("the disk broke")

        monkeypatch.setattr(type(rec), "windows", broken)
        monkeypatch.setattr(type(rec), "table", broken)
        monkeypatch.setattr(mr.Writer, "copy_from", broken)
        with pytest.raises(RuntimeError, match="the disk broke"):
            self.run(rec, self.target(tmp_path))
        assert set(tmp_path.iterdir()) == before
