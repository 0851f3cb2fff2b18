"""Order of quaternions, between tables and messages."""

from __future__ import annotations

import numpy as np
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
