"""Reference angles from markers, clusters and orientations against a simulated leg's truth and scipy's angles."""

from __future__ import annotations

from pathlib import Path

import marcha.recording as mr
import numpy as np
import polars as pl
import pytest
from marcha.ingest import convert
from marcha.ingest.anatomy import (
    anatomy,
    carried,
    cluster_attitude,
    from_markers,
    name_of,
    place_in_cluster,
)
from marcha.ingest.jointangles import AxisTurn, cardan, planar
from marcha.ingest.orientations import axis_of, resampled
from marcha.ingest.simulate.leg import leg
from marcha.recording import UsageError
from scipy.spatial.transform import Rotation


def deg(angle: np.ndarray) -> np.ndarray:
    return np.degrees((angle + np.pi) % (2 * np.pi) - np.pi)


@pytest.mark.parametrize(
    ("sides", "joints"),
    [("left", ["hip", "knee", "ankle"]), ("both", ["left_hip", "left_knee", "right_knee", "right_ankle"])],
)
@pytest.mark.parametrize("definition", ["isb", "source"])
def test_angles_of_landmarks_are_the_true_ones(sides: str, joints: list[str], definition: str) -> None:
    """Half a millimetre of noise on a base of 0.1 m is 0.2°; the planar angle also has what is out of plane."""
    capture = leg("walking", seed=3, duration_s=12.0, sides=sides, knee_varus_deg=2.0, knee_axial_deg=3.0)
    seen = capture.optical
    found = from_markers(seen.t, seen.names, seen.pos, definition, {})
    assert not found.doubts
    for joint in joints:
        error = deg(found.angle[joint] - seen.angle[joint])
        assert np.sqrt(np.nanmean(error**2)) < 0.3
        assert abs(np.nanmean(error)) < 0.05
        assert found.remarks[joint].startswith(definition)


def test_abduction_and_rotation_follow_grood_and_suntay() -> None:
    """Cardan angles about x, y', z'' of the lower frame in the upper one, as scipy has them, sign reversed."""
    turns = Rotation.random(50, np.random.default_rng(1)), Rotation.random(50, np.random.default_rng(2))
    expected = -(turns[0].inv() * turns[1]).as_euler("XYZ")
    np.testing.assert_allclose(cardan(*(t.as_matrix() for t in turns)), expected, atol=1e-9)


def test_planar_and_twist_agree_where_the_joint_is_a_hinge() -> None:
    k = np.linspace(-0.4, 1.2, 40)
    upper = Rotation.random(40, np.random.default_rng(3))
    lower = upper * Rotation.from_rotvec(np.outer(-k, [1, 0, 0]))
    up, low = upper.as_matrix(), lower.as_matrix()
    np.testing.assert_allclose(planar(up[:, :, 2], low[:, :, 2], up[:, :, 0]), k, atol=1e-9)
    about_x = AxisTurn(np.array([1.0, 0, 0])).angle(k, up, low)
    assert about_x is not None
    np.testing.assert_allclose(about_x, k, atol=1e-9)
    np.testing.assert_allclose(cardan(up, low)[:, 0], k, atol=1e-9)


def test_a_cluster_carries_its_landmark_and_nothing_is_interpolated() -> None:
    capture = leg("walking", seed=3, duration_s=12.0, dropout_share=0.0)
    pos, names = capture.optical.pos.copy(), list(capture.optical.names)
    knee = names.index("knee_lat")
    true = pos[:, knee].copy()
    pos[300:900, knee] = np.nan
    plate = [k for k, n in enumerate(names) if n.startswith("thigh_")]
    pos[600:700, plate[:2]] = np.nan  # two of four: no attitude there
    rot, place, _, misfit = cluster_attitude(pos[:, plate])
    assert misfit < 0.001
    own = place_in_cluster(pos[:, knee], rot, place)
    assert own is not None
    filled = carried(pos[:, knee], rot, place, own)
    assert np.isnan(filled[600:700]).all()
    error = np.linalg.norm(filled - true, axis=1)
    assert np.nanmax(error) < 0.01
    assert np.isnan(error).sum() == 100
    found = from_markers(capture.optical.t, names, pos, "isb", {})
    assert np.isnan(found.angle["knee"][600:700]).all()
    assert np.isfinite(found.angle["knee"][300:600]).all()


def test_clusters_without_landmarks_give_the_turn_about_their_main_axis() -> None:
    capture = leg("walking", seed=3, duration_s=20.0, dropout_share=0.0)
    seen = capture.optical
    keep = [k for k, n in enumerate(seen.names) if n.startswith(("thigh_", "shank_"))]
    found = from_markers(seen.t, [seen.names[k] for k in keep], seen.pos[:, keep], "isb", {})
    error = deg(found.angle["knee"] - seen.angle["knee"])
    assert np.std(error) < 0.8  # half a millimetre on plates of 6 by 8 cm
    assert np.mean(error) == pytest.approx(
        -np.degrees(seen.angle["knee"][:100].mean()), abs=0.3
    )  # zero at rest
    assert found.remarks["knee"].startswith("functional")
    assert AxisTurn().angle(seen.t, seen.rot_ns["thigh"], seen.rot_ns["thigh"]) is None


@pytest.mark.parametrize(
    ("marker", "side", "role"),
    [
        ("LKNE", "left", "knee_lat"),
        ("R.Heel", "right", "heel"),
        ("subject:RMFC", "right", "knee_med"),
        ("knee_lat", "", "knee_lat"),
        ("left_ankle_med", "left", "ankle_med"),
        ("HJC_L", "left", "hip"),
    ],
)
def test_names_of_markers(marker: str, side: str, role: str) -> None:
    assert name_of(marker)[0] == side
    assert anatomy([marker]).landmarks == {(side, role): 0}


def test_landmarks_are_named_by_the_user() -> None:
    assert anatomy(["A", "B"], {"B": "right_knee_med"}).landmarks == {("right", "knee_med"): 1}
    with pytest.raises(ValueError, match="no marker 'C'"):
        anatomy(["A"], {"C": "knee"})
    with pytest.raises(ValueError, match="no landmark"):
        anatomy(["A"], {"A": "elbow"})


def test_orientations_are_not_resampled_across_a_gap() -> None:
    t = np.r_[np.arange(0, 1_000_000_000, 20_000_000), np.arange(1_500_000_000, 2_000_000_000, 20_000_000)]
    quat = Rotation.from_rotvec(np.outer(t * 1e-9, [1.0, 0, 0])).as_quat(scalar_first=True)
    table = pl.DataFrame({"t_ns": t, **{f"quat_{a}": quat[:, k] for k, a in enumerate("wxyz")}})
    at = np.array([505_000_000, 990_000_000, 1_200_000_000, 1_500_000_000, 1_711_000_000])
    found = resampled(table, at)
    assert np.isnan(found[[1, 2]]).all()
    good = [0, 3, 4]
    np.testing.assert_allclose(
        Rotation.from_matrix(found[good]).as_rotvec()[:, 0], at[good] * 1e-9, atol=1e-9
    )
    with pytest.raises(UsageError, match="flexion_axis"):
        axis_of("w")


@pytest.mark.data
def test_walking_of_a_c3d_and_a_chain_by_cameras(data_dir: Path, tmp_path: Path) -> None:
    """Knees of a walk bend by 70°; the chain's reference is the twist that its own test works out."""
    folder = data_dir / "leg"
    convert(folder / "optical_formats" / "walking2.c3d", tmp_path / "walk.mcap")
    angles = mr.open(tmp_path / "walk.mcap").table("/reference/optical/joint")
    for side in ("left", "right"):
        knee = np.degrees(angles[f"{side}_knee"].to_numpy())
        assert -5.0 < np.nanmin(knee) < 10.0
        assert 60.0 < np.nanmax(knee) < 80.0
    chain = folder / "chain_optical"
    options = {"segments": "seg1:a,seg2:thigh,seg3:shank,seg4:b,seg5:c", "flexion_axis": "x"}
    convert([chain / "imu_rigid.csv", chain / "omc.csv"], tmp_path / "chain.mcap", options=options)
    knee = mr.open(tmp_path / "chain.mcap").table("/reference/optical/joint")["knee"].to_numpy()
    cameras = pl.read_csv(chain / "omc.csv", comment_prefix="#")
    quats = [cameras.select(f"seg{k}_quat_{c}" for c in "xyzw").to_numpy() for k in (2, 3)]
    seen = np.isfinite(quats[0]).all(1) & np.isfinite(quats[1]).all(1)
    turned = (Rotation.from_quat(quats[1][seen]).inv() * Rotation.from_quat(quats[0][seen])).as_quat()
    expected = np.unwrap(2 * np.arctan2(turned[:, 0], turned[:, 3]))
    known = knee[np.isfinite(knee)]
    np.testing.assert_allclose(known[:100], expected[:100], atol=1e-4)
    assert len(known) >= len(expected)  # one of the two may be a neighbour within 0.1 s
