"""Trajectories as point clouds: what viewers draw that know ROS 2 messages but not marcha."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import polars as pl
from numpy.typing import NDArray

from ..recording import Recording, Writer
from ..recording.selection import CLOUD, DRAWN, TRACK, Selection

ROOT = "tf#/"
"""Rerun's name of the frame that every 3D view shows; a cloud in another one needs a path of transforms."""
FRAMES = "/tf_static"

TRAJECTORIES = ("geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PointStamped")

_POINT = np.dtype([(axis, "<f4") for axis in "xyz"])
_FLOAT32 = 7
_POSITION = [f"pos_{axis}" for axis in "xyz"]


def add_tracks(rec: Recording, topics: Sequence[str], options: Selection, out: Writer) -> None:
    """Add the positions of every trajectory, one message a trajectory.

    The message stands at the trajectory's first time, so that the whole track is there from then on. Points
    have no orientation, so that a reference without one claims none. Static transforms put the frames that
    trajectories are in (``nav``, ``vicon``) below the viewer's root, each with its own origin there, as the
    points are drawn; frames of sensors move and are not among them.

    Parameters
    ----------
    rec : Recording
        The source.
    topics : sequence of str
        Channels that are exported.
    options : Selection
        Range of time.
    out : Writer
        Recording that is written; has no channel ``/track…`` yet.
    """
    frames: dict[str, int] = {}
    for topic in topics:
        channel = rec.channels[topic]
        if channel.schema not in TRAJECTORIES:
            continue
        table = rec.table(topic, start_ns=options.start_ns, end_ns=options.end_ns)
        points = table.select(_POSITION).to_numpy()
        seen = np.isfinite(points).all(axis=1)
        if not seen.any():
            continue
        first = int(table["t_ns"][0])
        cloud = np.zeros(int(seen.sum()), _POINT)
        for axis, values in zip("xyz", points[seen].T, strict=True):
            cloud[axis] = values
        out.add_message(f"{TRACK}{topic}", CLOUD, first, _message(cloud, first))
        frames[channel.frame_id] = min(first, frames.get(channel.frame_id, first))
    if FRAMES not in topics:
        _add_frames({name: first for name, first in frames.items() if name and name != ROOT}, out)


def _add_frames(frames: dict[str, int], out: Writer) -> None:
    """Write static transforms, the identity, from the viewer's root to frames given with their first times."""
    if not frames:
        return
    first = min(frames.values())
    values = dict.fromkeys(("pos_x", "pos_y", "pos_z", "quat_x", "quat_y", "quat_z"), 0.0) | {"quat_w": 1.0}
    table = pl.DataFrame({"child_frame_id": sorted(frames)}).with_columns(
        t_ns=pl.lit(first, pl.Int64),
        parent_frame_id=pl.lit(ROOT),
        **{k: pl.lit(v) for k, v in values.items()},
    )
    out.add_table(FRAMES, "tf2_msgs/msg/TFMessage", table, metadata={DRAWN: "true"})


def _message(cloud: NDArray[Any], t_ns: int) -> dict[str, Any]:
    """Return the fields of a ``sensor_msgs/msg/PointCloud2``."""
    seconds, nanoseconds = divmod(t_ns, 1_000_000_000)
    size = cloud.dtype.itemsize
    fields = [
        {"name": axis, "offset": 4 * i, "datatype": _FLOAT32, "count": 1} for i, axis in enumerate("xyz")
    ]
    return {
        "header": {"stamp": {"sec": seconds, "nanosec": nanoseconds}, "frame_id": ROOT},
        "height": 1,
        "width": len(cloud),
        "fields": fields,
        "is_bigendian": False,
        "point_step": size,
        "row_step": size * len(cloud),
        "data": cloud.view(np.uint8),
        "is_dense": True,
    }
