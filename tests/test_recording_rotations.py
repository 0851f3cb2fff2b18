"""Order of quaternions, between tables and messages."""

from __future__ import annotations

import numpy as np
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from marcha.recording import rotations
from marcha.recording.rotations import wxyz_from_xyzw, xyzw_from_wxyz
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from scipy.spatial.transform import Rotation

from .recording_samples import sample_table, write


def test_each_direction_is_what_scipy_does():
    rotations = Rotation.random(20, rng=np.random.default_rng(0))
    first, last = rotations.as_quat(scalar_first=True), rotations.as_quat()
    assert np.array_equal(xyzw_from_wxyz(first), last)
    assert np.array_equal(wxyz_from_xyzw(last), first)
    assert np.array_equal(xyzw_from_wxyz(first[3]), last[3])


def test_the_codec_keeps_the_same_order(tmp_path):
    table = sample_table("geometry_msgs/msg/QuaternionStamped", 5)
    path = write(tmp_path / "a.mcap", {"/q": ("geometry_msgs/msg/QuaternionStamped", table)})
    with path.open("rb") as file:
        decoded = [
            d for *_, d in make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages()
        ]
    sent = [[d.quaternion.x, d.quaternion.y, d.quaternion.z, d.quaternion.w] for d in decoded]
    wxyz = table.select("quat_w", "quat_x", "quat_y", "quat_z").to_numpy()
    assert np.array_equal(xyzw_from_wxyz(wxyz), sent, equal_nan=True)


VECTORS = arrays(np.float64, (3,), elements=st.floats(-20, 20))


@given(VECTORS, VECTORS)
@example(np.array([np.pi, 0.0, 0.0]), np.array([0.0, 0.0, np.pi]))
@example(np.zeros(3), np.array([0.0, 0.0, 1e-12]))
def test_operations_on_quaternions_are_what_scipy_does(first, second):
    a, b = Rotation.from_rotvec(first), Rotation.from_rotvec(second)
    qa, qb = a.as_quat(scalar_first=True), b.as_quat(scalar_first=True)
    both = rotations.product(qa, np.stack([qb, rotations.inverse(qb)]))
    for quat, expected in zip(both, (a * b, a * b.inv()), strict=True):
        assert (Rotation.from_quat(quat, scalar_first=True) * expected.inv()).magnitude() < 1e-7
        vector = rotations.rotation_vector(quat)
        assert np.linalg.norm(vector) <= np.pi + 1e-12
        assert (Rotation.from_rotvec(vector) * expected.inv()).magnitude() < 1e-7
        assert np.allclose(rotations.rotation_vector(-quat), vector, atol=1e-12) or quat[0] == 0


@given(VECTORS)
@example(np.array([0.0, np.pi, 0.0]))
def test_a_matrix_becomes_its_quaternion(vector):
    rotation = Rotation.from_rotvec(vector)
    quat = rotations.from_matrix(rotation.as_matrix())
    assert (Rotation.from_quat(quat, scalar_first=True) * rotation.inv()).magnitude() < 1e-7
