"""What a damaged or hostile file can make marcha do: little."""

from __future__ import annotations

import resource
import time
from pathlib import Path

import lz4.frame
import pytest
import zstandard
from marcha.ingest import Converted, convert
from marcha.recording.cdr import MAX_BYTES, CdrError, Layout
from marcha.recording.chunks import _decompress
from marcha.recording.definitions import parse_full


@pytest.mark.parametrize("reuse", [True, False])
@pytest.mark.parametrize(
    ("name", "pack"),
    [("zstd", zstandard.ZstdCompressor().compress), ("lz4", lz4.frame.compress)],
)
def test_a_chunk_that_states_less_than_it_holds_takes_no_more_memory(
    name: str, pack: object, reuse: bool
) -> None:
    body = memoryview(pack(bytes(1 << 28)))  # type: ignore[operator]
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    try:
        data = _decompress(name, body, 100, reuse)
    except ValueError:
        data = b""
    assert len(data) <= 101
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 50_000  # KiB


def layout(text: str) -> Layout:
    library = parse_full("a/msg/A", text)
    return Layout(next(iter(library.values())), library, lambda *_: 1)


def test_a_type_that_holds_itself_is_refused() -> None:
    with pytest.raises(CdrError, match="deep"):
        layout("a/A inner\n")


@pytest.mark.parametrize("length", [MAX_BYTES, 10**15])
def test_an_array_of_any_length_is_refused(length: int) -> None:
    with pytest.raises(CdrError):
        layout(f"float64[{length}] x\n")
    with pytest.raises(CdrError):
        layout(f"string[{length}] x\n")


MAP = """
[time]
column = "t"
unit = "ns"
[[topic]]
name = "/foot/imu1"
schema = "sensor_msgs/msg/Imu"
frame = "imu1"
units = { acc = "m/s²" }
full_scale = { acc = 20 }
columns = { acc_x = "x", acc_y = "y", acc_z = "z" }
"""


def converted(tmp_path: Path, rows: list[str]) -> Converted:
    log, mapping = tmp_path / "log.csv", tmp_path / "map.toml"
    log.write_text("t,x,y,z\n" + "\n".join(rows) + "\n")
    mapping.write_text(MAP)
    return convert(log, tmp_path / "out.mcap", mapping=mapping)


def test_a_first_time_far_from_the_rest_is_no_endless_work(tmp_path: Path) -> None:
    rows = ["17,0,0,9.8", *(f"{10**18 + k * 10**12},0.1,{k % 3},9.8" for k in range(300))]
    assert converted(tmp_path, rows).report.rows_read == 301


@pytest.mark.parametrize("missing", ["", "-"])
def test_a_missing_cell_has_no_full_scale(tmp_path: Path, missing: str) -> None:
    rows = [f"{k * 10**7},0.{k % 7},{missing if k == 3 else k % 3},9.8" for k in range(50)]
    findings = {f.kind for f in converted(tmp_path, rows).report.findings}
    assert "missing_cell" in findings
    assert "clipped" not in findings


def test_runs_of_blanks_take_time_by_their_length(tmp_path: Path) -> None:
    log, mapping = tmp_path / "log.txt", tmp_path / "map.toml"
    rows = [f"{k * 10**7}{' ' * 3000}0.{k % 7} 1 9.8" for k in range(300)]
    log.write_text("t x y z\n" + "\n".join(rows) + "\n")
    mapping.write_text('[layout]\nseparator = "blanks"\n' + MAP)
    began = time.process_time()
    convert(log, tmp_path / "out.mcap", mapping=mapping)
    assert time.process_time() - began < 20  # a quadratic expression takes minutes
