"""Names that are no other's: of metadata records, runs, columns."""

from __future__ import annotations


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
