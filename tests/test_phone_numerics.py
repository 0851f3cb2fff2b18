"""Phones: Horn, UTM, the source's rules against hand-made and published values."""

from __future__ import annotations

import numpy as np
import pytest
from marcha.algorithms import AlgorithmError, make
from marcha.algorithms.contract import ChannelInfo, Context, Message
from marcha.algorithms.phone import geodesy, source
from marcha.algorithms.phone.horn import horn
from marcha.algorithms.phone.lengths import fit_lengths
from pyproj import Geod


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


def test_the_transform_keeps_true_north_and_grid_north_apart() -> None:
    """A track in true east and north, seen by perfect fixes: turned by the convergence, stretched by the scale."""
    lat0, lon0 = -22.826485178097396, -47.07604455472332
    course, way = np.radians(np.linspace(0, 300, 40)), np.linspace(0, 400, 40)
    local = np.column_stack((way * np.sin(course), way * np.cos(course)))
    lon, lat, _ = Geod(ellps="WGS84").fwd(
        np.full(40, lon0),
        np.full(40, lat0),
        np.degrees(np.arctan2(local[:, 0], local[:, 1])),
        np.hypot(*local.T),
    )
    transform = make("phone.transform")
    transform.start(
        Context(
            channels={
                "gnss": (
                    ChannelInfo("/phone/gnss", "sensor_msgs/msg/NavSatFix", columns=("lat_deg", "lon_deg")),
                )
            }
        )
    )
    for k in range(40):
        t, half = 10**9 * k, (np.pi / 2 - course[k]) / 2
        pose = (*local[k].tolist(), 0.0, np.cos(half), 0.0, 0.0, np.sin(half))
        transform.take(Message("pose", t, pose, t, "/estimate/pose"))
        transform.take(Message("gnss", t, (float(lat[k]), float(lon[k])), t, "/phone/gnss"))
    results = transform.finish()
    about = dict(zip(transform.outputs[2].columns, results[0].values, strict=True))
    grid = geodesy.utm(np.array([lat0]), np.array([lon0]))
    assert np.degrees(about["convergence_rad"]) == pytest.approx(0.81, abs=0.01)
    assert about["rotation_rad"] == pytest.approx(float(grid.convergence_rad[0]), abs=1e-4)
    assert about["scale"] == pytest.approx(1.000161, abs=1e-5)
    assert abs(about["north_error_rad"]) < 1e-4
    poses = np.array([r.values for r in results if r.output == "pose"])
    np.testing.assert_allclose(poses[:, :2], local, atol=0.02)
    half = (np.pi / 2 - course) / 2
    np.testing.assert_allclose(
        poses[:, 3:], np.column_stack((np.cos(half), 0 * half, 0 * half, np.sin(half))), atol=1e-4
    )


def test_horn_against_an_independent_closed_form() -> None:
    """Umeyama's solution by the singular value decomposition, with and without scale, in the plane and in space."""
    rng = np.random.default_rng(5)
    for dimension in (2, 3):
        a = rng.normal(size=(25, dimension)) * 40
        b = (
            1.2 * a @ np.linalg.qr(rng.normal(size=(dimension, dimension)))[0].T
            + rng.normal(size=(25, dimension))
            + 5e6
        )
        p, q = a - a.mean(axis=0), b - b.mean(axis=0)
        u, sv, vt = np.linalg.svd(q.T @ p)
        keep = np.ones(dimension)
        keep[-1] = np.sign(np.linalg.det(u @ vt))
        rotation = (u * keep) @ vt
        for scale in (True, False):
            found = horn(a, b, scale=scale)
            k = float((sv * keep).sum() / (p**2).sum()) if scale else 1.0
            np.testing.assert_allclose(found.rotation, rotation, atol=1e-9)
            assert found.scale == pytest.approx(k, abs=1e-9)
            np.testing.assert_allclose(
                found.apply(a), k * p @ rotation.T + b.mean(axis=0), rtol=1e-14, atol=1e-9
            )


def test_declination_by_the_model_of_the_date() -> None:
    """Campinas, March 2017: −21.1° (IGRF); values of the World Magnetic Model's own test sheet for 2025.0."""
    at = int(np.datetime64("2017-03-09", "ns").astype(np.int64))
    assert np.degrees(geodesy.declination(-22.826, -47.076, 645.0, at)) == pytest.approx(-21.1, abs=0.15)
    new = int(np.datetime64("2025-01-01", "ns").astype(np.int64))
    assert np.degrees(geodesy.declination(80.0, 0.0, 0.0, new)) == pytest.approx(1.28, abs=0.06)
    assert np.degrees(geodesy.declination(0.0, 120.0, 0.0, new)) == pytest.approx(-0.16, abs=0.06)
