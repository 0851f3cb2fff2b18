"""Phones: Horn, UTM, the source's rules against hand-made and published values."""

from __future__ import annotations

import numpy as np
import pytest
from marcha.algorithms import AlgorithmError
from marcha.algorithms.phone import geodesy, source
from marcha.algorithms.phone.horn import horn
from marcha.algorithms.phone.lengths import fit_lengths


def test_horn_finds_rotation_scale_and_shift() -> None:
    rng = np.random.default_rng(1)
    local, turn = rng.normal(size=(20, 2)), 2.3
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    found = horn(local, 1.7 * local @ rotation.T + [300.0, -40.0])
    assert found.scale == pytest.approx(1.7, abs=1e-9)
    np.testing.assert_allclose(found.rotation, rotation, atol=1e-9)
    np.testing.assert_allclose(found.shift, [300.0, -40.0], atol=1e-9)


@pytest.mark.parametrize("dimension", [2, 3])
def test_horn_never_reflects(dimension: int) -> None:
    local = np.random.default_rng(2).normal(size=(15, dimension))
    mirrored = local * np.array([-1.0, *[1.0] * (dimension - 1)])
    found = horn(local, mirrored)
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)
    assert found.rms > 0.3


def test_horn_refuses_one_point() -> None:
    with pytest.raises(AlgorithmError, match="local points are one"):
        horn(np.ones((4, 2)), np.zeros((4, 2)))


def test_utm_of_the_sources_first_row() -> None:
    grid = geodesy.utm(np.array([-22.826485178097396]), np.array([-47.07604455472332]))
    assert (grid.zone, grid.south) == (23, True)
    assert grid.east_m[0] == pytest.approx(286_940.003, abs=2e-3)
    assert grid.north_m[0] == pytest.approx(7_474_190.169, abs=2e-3)
    assert grid.scale[0] == pytest.approx(1.000161, abs=1e-6)


def test_heading_in_androids_axes_turns_clockwise_from_north() -> None:
    # The phone points east: the field, north, comes from its left.
    assert source.source_headings(np.array([[-1.0, 0.0, 0.0]]))[0] == pytest.approx(np.pi / 2)


def test_plateau_counts_once() -> None:
    peaks, valleys = source.extremes(np.array([0.0, 2.0, 2.0, 1.0, 3.0]))
    assert (peaks.tolist(), valleys.tolist()) == ([1], [3])


def test_lengths_that_walks_do_not_determine_are_refused() -> None:
    with pytest.raises(AlgorithmError, match="do not determine"):
        fit_lengths("linear", [(np.ones((10, 9)), 7.0)])
