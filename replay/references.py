"""Which reference belongs to a run: decided here, for evaluation, viewer and figures alike.

References lie below ``/reference/``. Of a kind (its message type), the one that is called like the run's input
counts: ``/reference/imu2/pose`` for ``/foot/imu2``, then ``/reference/pose``, then the only one of its kind. What
the device's own filter says (``/reference/device/…``) counts only where there is nothing else.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

from ..recording.errors import UsageError

PREFIX = "/reference/"
DEVICE = "/reference/device/"
KINDS: dict[str, tuple[str, ...]] = {
    "pose": ("geometry_msgs/msg/PoseStamped",),
    "position": ("geometry_msgs/msg/PointStamped",),
    "fix": ("sensor_msgs/msg/NavSatFix",),
    "joint": ("sensor_msgs/msg/JointState",),
    "orientation": ("geometry_msgs/msg/QuaternionStamped",),
    "steps": ("marcha_msgs/msg/Step",),
    "velocity": ("geometry_msgs/msg/Vector3Stamped", "geometry_msgs/msg/TwistStamped"),
    "markers": ("marcha_msgs/msg/OpticalMarkers",),
}
"""Message types of a kind of reference."""


class _Channel(Protocol):
    @property
    def schema(self) -> str: ...


def references(channels: Mapping[str, _Channel], kind: str) -> list[str]:
    """Return the topics of all references of a kind."""
    if kind not in KINDS:
        raise UsageError(f"no kind of reference {kind!r}; there are {', '.join(KINDS)}")
    return [t for t, c in channels.items() if t.startswith(PREFIX) and c.schema in KINDS[kind]]


def reference_of(
    channels: Mapping[str, _Channel], kind: str, input_topic: str, chosen: str | None = None, name: str = ""
) -> str | None:
    """Return the topic of the reference of a kind that belongs to a run, None where there is none.

    Parameters
    ----------
    channels : mapping
        Of the recording, by topic.
    kind : str
        One of :data:`KINDS`.
    input_topic : str
        Topic of the run's first input.
    chosen : str, optional
        Topic that the user named; it counts for its own kind.
    name : str
        Of the recording, for messages.

    Raises
    ------
    UsageError
        ``chosen`` is no reference, or several fit and none is called like the input.
    """
    fitting = references(channels, kind)
    if chosen is not None:
        topics = [t for t in channels if t.startswith(PREFIX)]
        if chosen not in topics:
            raise UsageError(f"{name}: no reference {chosen}; there are {', '.join(topics) or 'none'}")
        if chosen in fitting:
            return chosen
    parts = [p for p in input_topic.split("/") if p]
    for called in _names(parts):
        own = [t for t in fitting if t.rpartition("/")[0] == "/".join(("", "reference", *called))]
        own = [t for t in own if t.endswith(f"/{kind}")] or own
        if len(own) == 1:
            return own[0]
    fitting = [t for t in fitting if not t.startswith(DEVICE)] or fitting
    if len(fitting) > 1:
        raise UsageError(
            f"{name}: several references ({', '.join(fitting)}) for {input_topic}; name one (--reference)"
        )
    return fitting[0] if fitting else None


def _names(parts: list[str]) -> list[list[str]]:
    """Return what a reference may be called: the last parts of the input, or the first and the last, longest first.

    The first parts are those that a recording got when it was joined with others: ``/reference/left/imu2`` for
    ``/left/foot/imu2``.
    """
    names = [parts[:head] + parts[i:] for head in range(len(parts)) for i in range(head, len(parts) + 1)]
    return sorted([*names, []], key=len, reverse=True)


def own_record(lineage: Mapping[str, str], name: str) -> str:
    """Return what the metadata record or attachment is called that speaks of a run: in a joined recording it
    stands below the name of the run's own.
    """
    records = lineage.get("records")
    return f"{records}/{name}" if records else name


def track_reference(
    channels: Mapping[str, _Channel],
    input_topic: str,
    chosen: str | None = None,
    name: str = "",
    kinds: tuple[str, ...] = ("pose", "position"),
) -> str | None:
    """Return the topic of the positions that a run's track is compared with: poses before positions.

    See :func:`reference_of`.
    """
    topics = (reference_of(channels, kind, input_topic, chosen, name) for kind in kinds)
    return next((topic for topic in topics if topic is not None), None)


def shown_reference(
    channels: Mapping[str, _Channel], run: str, records: Mapping[str, Mapping[str, str]]
) -> str | None:
    """Return the reference that a picture shows beside a run, by the run's own record of its input.

    Where several fit and none is called like the input, the evaluation asks which; a picture shows the first.

    Parameters
    ----------
    channels : mapping
        Of the recording, by topic.
    run : str
        Id of the run; empty for a recording without runs.
    records : mapping
        Metadata records of the recording.
    """
    input_topic = records.get(f"run/{run}", {}).get("input", "")
    try:
        return track_reference(channels, input_topic)
    except UsageError:
        return next(t for kind in ("pose", "position") for t in references(channels, kind))
