"""C3D of every processor and number format, from files written byte by byte."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import marcha.recording as mr
import numpy as np
import pytest
from marcha.ingest import convert
from marcha.ingest.formats.c3d import C3d
from marcha.recording import MarchaError
from numpy.typing import NDArray

from .c3d_files import BLOCK, Encoder, write_c3d

FRAMES, MARKERS, EACH, CHANNELS = 6, 2, 2, 3
Signals = tuple[NDArray[np.floating[Any]], NDArray[np.floating[Any]]]


@pytest.fixture
def signals() -> Signals:
    """Positions (mm) with one not seen, and analog values (V); exact in 16-bit integers and in 32-bit floats."""
    rng = np.random.default_rng(1)
    points = rng.integers(-8000, 8000, (FRAMES, MARKERS, 3)) * 0.125
    points[2, 1] = np.nan
    return points, rng.integers(-4000, 4000, (FRAMES * EACH, CHANNELS)) * 0.25


@pytest.mark.parametrize("integers", [True, False], ids=["integers", "floats"])
@pytest.mark.parametrize("processor", ["intel", "dec"])
def test_numbers_are_those_of_the_processor(
    processor: str, integers: bool, signals: Signals, tmp_path: Path
) -> None:
    points, analogs = signals
    write_c3d(tmp_path / "a.c3d", points, analogs, processor=processor, integers=integers)
    convert([tmp_path / "a.c3d"], tmp_path / "a.mcap")
    rec = mr.open(tmp_path / "a.mcap")
    markers = rec.table("/reference/markers")
    assert markers.columns[1:] == [f"m{m}.{a}" for m in (1, 2) for a in "xyz"]
    found = 1000 * markers.drop("t_ns").to_numpy().reshape(points.shape)
    assert np.allclose(found, points, rtol=1e-15, atol=0, equal_nan=True)
    assert np.array_equal(markers["t_ns"].diff().drop_nulls().unique().to_numpy(), [10_000_000])
    values = rec.table("/analog/values")
    assert np.array_equal(values.select("a1", "a2", "a3").to_numpy(), analogs)
    assert np.array_equal(values["t_ns"].diff().drop_nulls().unique().to_numpy(), [5_000_000])


@pytest.mark.parametrize("integers", [True, False], ids=["integers", "floats"])
def test_a_processor_that_is_not_read_is_named(integers: bool, signals: Signals, tmp_path: Path) -> None:
    write_c3d(tmp_path / "a.c3d", *signals, processor="sgi", integers=integers)
    with pytest.raises(
        MarchaError, match=r"a\.c3d: numbers of a MIPS or SGI processor.*; save it in"
    ) as refused:
        convert([tmp_path / "a.c3d"], tmp_path / "a.mcap")
    assert "\n" not in str(refused.value)
    assert not (tmp_path / "a.mcap").exists()


def test_a_processor_nobody_knows_is_refused(signals: Signals, tmp_path: Path) -> None:
    write_c3d(tmp_path / "a.c3d", *signals, processor="intel", integers=True, changed={BLOCK + 3: 99})
    with pytest.raises(MarchaError, match=r"a\.c3d: a damaged C3D file \(.*\); export it again") as refused:
        C3d().read([tmp_path / "a.c3d"], C3d.Options())
    assert "\n" not in str(refused.value)


def test_vax_floats_are_those_of_the_manual() -> None:
    """VAX Architecture Reference Manual, F_floating: 1.0 is 4080 hex, the high word first; -2.5 is C120."""
    assert Encoder("dec").floats([1.0, -2.5]) == bytes.fromhex("80400000 20c10000")
