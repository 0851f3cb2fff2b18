"""Stretches of a channel that a study keeps from the estimators: an artificial loss of GPS, say."""

from __future__ import annotations

from collections.abc import Sequence
from fnmatch import fnmatchcase
from typing import Annotated

import msgspec

from ..recording import Recording


class Withheld(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What is withheld; errors are then taken against it.

    Attributes
    ----------
    topic : str
        Glob of the channels (``/phone/gnss``).
    start_s, length_s : float
        From the start of each recording on, and for how long (s).
    """

    topic: str
    start_s: Annotated[float, msgspec.Meta(ge=0)]
    length_s: Annotated[float, msgspec.Meta(gt=0)]


def stretches(withhold: Sequence[Withheld], rec: Recording) -> dict[str, list[tuple[int, int]]]:
    """Return the stretches by topic, as log time (ns), half open."""
    spans: dict[str, list[tuple[int, int]]] = {}
    for one in withhold:
        start = (rec.start_ns or 0) + round(one.start_s * 1e9)
        for topic in rec.channels:
            if fnmatchcase(topic, one.topic):
                spans.setdefault(topic, []).append((start, start + round(one.length_s * 1e9)))
    return spans
