"""Compression of chunks: chosen when writing, caught up on when copying, and the same messages either way."""

from __future__ import annotations

from pathlib import Path

import marcha.recording as mr
import numpy as np
import polars as pl
import pytest
from marcha.recording.errors import MarchaError
from marcha.recording.integrity import structure
from mcap.reader import make_reader

VECTOR = "geometry_msgs/msg/Vector3Stamped"
ROWS = 30_000


def table() -> dict[str, np.ndarray]:
    values = np.random.default_rng(7).normal(size=(3, ROWS)).cumsum(axis=1)
    return {"t_ns": np.arange(ROWS) * 10_000_000} | {f"vel_{a}": values[i] for i, a in enumerate("xyz")}


def written(path: Path, level: int | None) -> Path:
    with mr.create(path, level=level) as out:
        out.add_table("/v", VECTOR, table(), frame_id="nav")
        out.add_annotations(pl.DataFrame({"tier": ["a"], "start_ns": [1], "end_ns": [2], "label": ["x"]}))
    return path


def compressions(path: Path) -> set[str]:
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    return {c.compression for c in summary.chunk_indexes}


def messages(path: Path) -> list[tuple[str, int, bytes]]:
    """Everything as mcap's own reader sees it, checksums verified."""
    with path.open("rb") as file:
        return [
            (c.topic, m.log_time, m.data) for _, c, m in make_reader(file, validate_crcs=True).iter_messages()
        ]


@pytest.mark.parametrize("level", [None, -3, 2])
def test_others_read_the_same_messages_at_any_level(tmp_path: Path, level: int | None) -> None:
    path = written(tmp_path / "a.mcap", level)
    assert compressions(path) == {"" if level is None else "zstd"}
    assert messages(path) == messages(written(tmp_path / "b.mcap", 2))
    assert structure(mr.open(path)) == []


def test_our_reader_gives_back_arrays_that_were_not_compressed(tmp_path: Path) -> None:
    rec = mr.open(written(tmp_path / "a.mcap", None))
    assert rec.table("/v").equals(pl.DataFrame(table()))


def test_a_copy_compresses_what_is_not(tmp_path: Path) -> None:
    plain = written(tmp_path / "a.mcap", None)
    with mr.create(tmp_path / "b.mcap") as out:
        out.copy_from(mr.open(plain))
    assert compressions(tmp_path / "b.mcap") == {"zstd"}
    assert messages(tmp_path / "b.mcap") == messages(plain)
    assert structure(mr.open(tmp_path / "b.mcap")) == []


def test_a_copy_without_compression_leaves_compressed_chunks_as_they_are(tmp_path: Path) -> None:
    small = written(tmp_path / "a.mcap", 2)
    with mr.create(tmp_path / "b.mcap", level=None) as out:
        out.copy_from(mr.open(small), ["/v"])
    assert compressions(tmp_path / "b.mcap") == {"zstd"}


def test_arrays_of_different_lengths_are_refused(tmp_path: Path) -> None:
    with pytest.raises(MarchaError, match="different lengths"), mr.create(tmp_path / "a.mcap") as out:
        out.add_table("/v", VECTOR, table() | {"vel_x": np.zeros(3)})
    assert not list(tmp_path.iterdir())
