"""Names in a recording: topics of what runs write, and names that are no other's."""

from __future__ import annotations

ESTIMATE = "/estimate/"
"""Beginning of the topics that runs write."""


def is_estimate(topic: str) -> bool:
    """Return whether a topic is a run's output, ``/estimate/<run>/<what>``."""
    return topic.startswith(ESTIMATE) and topic.count("/") >= 3


def free_name(name: str, taken: set[str]) -> str:
    """Return the name, numbered (``name_2``) where it is taken, and reserve it.

    Parameters
    ----------
    name : str
        What it should be called.
    taken : set of str
        Names that are others' already; the returned one is added.
    """
    free, number = name, 1
    while free in taken:
        number += 1
        free = f"{name}_{number}"
    taken.add(free)
    return free
