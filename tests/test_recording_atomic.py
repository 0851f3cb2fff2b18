"""Outputs appear whole or not at all."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import marcha.recording as mr
import pytest
from marcha.recording import MarchaError, atomic
from marcha.recording.atomic import AtomicFile

from .recording_samples import imu, write

IMU = "sensor_msgs/msg/Imu"


def test_nothing_is_there_before_the_block_ends(tmp_path):
    path = tmp_path / "a.mcap"
    with mr.create(path) as out:
        out.add_table("/imu", IMU, imu(5000))
        assert not path.exists()
        assert [p.name for p in tmp_path.iterdir()] == [f".a.mcap.{os.getpid()}.part"]
    assert [p.name for p in tmp_path.iterdir()] == ["a.mcap"]


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt, SystemExit])
def test_an_exception_leaves_nothing(tmp_path, error):
    def fail():
        with mr.create(tmp_path / "a.mcap") as out:
            out.add_table("/imu", IMU, imu(5000))
            raise error

    with pytest.raises(error):
        fail()
    assert list(tmp_path.iterdir()) == []


def test_an_existing_file_is_kept_without_overwrite(tmp_path):
    path = write(tmp_path / "a.mcap", {"/imu": (IMU, imu(5))})
    before = path.read_bytes()
    with pytest.raises(mr.OutputExists, match="--force"):
        mr.create(path)
    assert path.read_bytes() == before
    assert len(list(tmp_path.iterdir())) == 1


def test_overwrite_replaces_only_at_the_end(tmp_path):
    path = write(tmp_path / "a.mcap", {"/imu": (IMU, imu(5))})
    before = path.read_bytes()
    out = mr.create(path, overwrite=True)
    out.add_table("/imu", IMU, imu(9))
    assert path.read_bytes() == before
    out.abort()
    assert path.read_bytes() == before
    write(path, {"/imu": (IMU, imu(9))}, overwrite=True)
    assert mr.open(path).channels["/imu"].count == 9


def test_a_file_that_appears_meanwhile_is_kept(tmp_path):
    path = tmp_path / "a.mcap"
    out = mr.create(path)
    out.add_table("/imu", IMU, imu(5))
    path.write_text("somebody else's")
    with pytest.raises(mr.OutputExists):
        out.close()
    assert path.read_text() == "somebody else's"
    assert len(list(tmp_path.iterdir())) == 1


def test_a_recording_may_be_rewritten_from_itself(tmp_path):
    path = write(tmp_path / "a.mcap", {"/imu": (IMU, imu(5000))})
    with mr.open(path) as rec, mr.create(path, overwrite=True) as out:
        out.copy_from(rec)
        out.add_table("/more", IMU, imu(3))
    assert {t: c.count for t, c in mr.open(path).channels.items()} == {"/imu": 5000, "/more": 3}


@pytest.mark.parametrize("name", ["", "missing/a.mcap"])
def test_a_place_that_cannot_be_written_is_one_line(tmp_path, name):
    with pytest.raises(mr.MarchaError) as error:
        mr.create(tmp_path / name)
    assert str(tmp_path) in str(error.value)
    assert "\n" not in str(error.value)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("when", ["write", "flush", "fsync"])
def test_a_full_disk_is_one_line_and_leaves_nothing(tmp_path, monkeypatch, when):
    def full(*args):
        raise OSError(28, "No space left on device")

    class Full:
        def __init__(self, file):
            self._file = file

        def __getattr__(self, name):
            return full if name == when else getattr(self._file, name)

    def attempt():
        with mr.create(tmp_path / "a.mcap") as out:
            if when == "fsync":
                monkeypatch.setattr(atomic.os, "fsync", full)
            else:
                inner = out._file._file
                inner._file = Full(inner._file)  # pyright: ignore[reportAttributeAccessIssue]
            out.add_table("/imu", IMU, imu(9000))

    with pytest.raises(mr.MarchaError, match=r"a\.mcap: cannot write: No space left"):
        attempt()
    assert list(tmp_path.iterdir()) == []


SCRIPT = """
    import os, resource, signal, sys
    import numpy as np, polars as pl
    import marcha.recording as mr
    rng = np.random.default_rng(0)
    table = pl.DataFrame({"t_ns": np.arange(60000), **{f"acc_{a}": rng.normal(size=60000) for a in "xyz"}})
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    if sys.argv[2] == "limit":
        resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, 300_000))
    try:
        with mr.create(sys.argv[1], overwrite=True) as out:
            out.add_table("/imu", "sensor_msgs/msg/Imu", table)
            if sys.argv[2] == "kill":
                os.kill(os.getpid(), signal.SIGKILL)
    except mr.MarchaError as e:
        print(e)
        sys.exit(1)
"""


def run(path, how: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", textwrap.dedent(SCRIPT), str(path), how],
        capture_output=True,
        text=True,
        timeout=60,
    )


@pytest.mark.skipif(sys.platform == "win32", reason="resource limits and SIGKILL are POSIX")
def test_a_file_size_limit_is_one_line_and_keeps_the_old_file(tmp_path):
    path = write(tmp_path / "a.mcap", {"/imu": (IMU, imu(5))})
    before = path.read_bytes()
    done = run(path, "limit")
    assert done.returncode == 1, done.stderr
    assert done.stdout.startswith(f"{path}: cannot write: ")
    assert done.stdout.count("\n") == 1
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["a.mcap"]


@pytest.mark.skipif(sys.platform == "win32", reason="resource limits and SIGKILL are POSIX")
def test_killed_amid_writing_keeps_the_old_file_and_the_next_writer_tidies_up(tmp_path):
    path = write(tmp_path / "a.mcap", {"/imu": (IMU, imu(5))})
    before = path.read_bytes()
    assert run(path, "kill").returncode == -signal.SIGKILL
    assert path.read_bytes() == before
    assert len(list(tmp_path.glob(".a.mcap.*.part"))) == 1
    write(path, {"/imu": (IMU, imu(6))}, overwrite=True)
    assert [p.name for p in tmp_path.iterdir()] == ["a.mcap"]


def test_two_writers_of_one_file_do_not_disturb_each_other(tmp_path):
    path = tmp_path / "a.mcap"
    with mr.create(path, overwrite=True) as first:
        first.add_table("/imu", IMU, imu(5))
        write(path, {"/imu": (IMU, imu(6))}, overwrite=True)
        assert mr.open(path).channels["/imu"].count == 6
    assert mr.open(path).channels["/imu"].count == 5
    assert [p.name for p in tmp_path.iterdir()] == ["a.mcap"]


def test_a_large_file_goes_to_disk_while_it_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced: list[int] = []
    monkeypatch.setenv("MARCHA_THREADS", "1")  # each write is through before the next
    monkeypatch.setattr("marcha.recording.atomic.SYNC_BYTES", 100)
    monkeypatch.setattr("os.fsync", synced.append)
    file = AtomicFile(tmp_path / "a")
    for _ in range(5):
        file.write(bytes(100))
    assert synced  # before its end
    file.commit()
    assert (tmp_path / "a").read_bytes() == bytes(500)


def test_a_disk_that_fails_in_the_background_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(_: int) -> None:
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr("marcha.recording.atomic.SYNC_BYTES", 100)
    monkeypatch.setattr("os.fsync", broken)
    file = AtomicFile(tmp_path / "a")
    file.write(bytes(100))
    with pytest.raises(MarchaError, match="Input/output error"):
        file.commit()
    assert not list(tmp_path.iterdir())
