"""What joining and cutting do to names, records and lists of changes."""

from __future__ import annotations

import heapq
import json
from collections.abc import Collection, Sequence
from datetime import UTC, datetime
from hashlib import blake2b
from typing import Any

import msgspec
import polars as pl

from .annotations import COLUMNS
from .changes import Change, history, user
from .reader import Recording

ESTIMATE, REFERENCE, DEVICE = "/estimate/", "/reference/", "/reference/device/"
RUN = "run/"


class JoinedPart:
    """One recording's place in a joined one: what its topics, runs, tiers, ids and times are there.

    A prefix ``/left`` makes ``/left/foot/imu`` of a reading, ``/estimate/left_<run>/pose`` of an estimate and
    ``/reference/left/pose`` of a reference, so that runs and references are found where they always are.

    Parameters
    ----------
    rec : Recording
        What is joined.
    prefix : str
        Put before its topics; may be empty.
    offset_ns : int
        Added to its times.
    records : str
        What stands before its metadata records and attachments.
    taken : set of str
        Ids of annotations, of those that are there and those that were, that others have; this one's are added.
    """

    def __init__(self, rec: Recording, prefix: str, offset_ns: int, records: str, taken: set[str]) -> None:
        self.rec, self.prefix, self.offset_ns, self.records = rec, prefix, offset_ns, records
        self._name = prefix.strip("/")
        self.runs = {n.removeprefix(RUN) for n in rec.metadata if n.startswith(RUN)}
        self.runs |= {t.split("/")[2] for t in rec.channels if t.startswith(ESTIMATE) and t.count("/") > 2}
        self._past = history(rec)
        own = set(rec.annotations["id"])
        own |= {i for c in self._past for i in (*c.added, *(row["id"] for row in c.removed))}
        self.ids = {
            i: blake2b(f"{records}\0{i}".encode(), digest_size=6).hexdigest() if i in taken else i
            for i in own
        }
        taken |= set(self.ids.values())

    def run(self, run: str) -> str:
        """Return the id of a run."""
        return f"{self._name.replace('/', '_')}_{run}" if self._name else run

    def topic(self, topic: str) -> str:
        """Return a topic; what no channel of the recording is called stays."""
        if not self._name or topic not in self.rec.channels:
            return topic
        if topic.startswith(ESTIMATE):
            return ESTIMATE + self.run(topic.removeprefix(ESTIMATE))
        for role in (DEVICE, REFERENCE):
            if topic.startswith(role):
                return f"{role}{self._name}/{topic.removeprefix(role)}"
        return self.prefix + topic

    def tier(self, tier: str) -> str:
        """Return a tier: below its run, or below the prefix."""
        if not self._name:
            return tier
        return self.run(tier) if tier.split("/")[0] in self.runs else f"{self._name}/{tier}"

    def marks(self) -> pl.DataFrame:
        """Return the annotations."""
        return _renamed(self.rec.annotations, self)

    def record(self, name: str, values: dict[str, str]) -> tuple[str, dict[str, str]]:
        """Return the name and values of a metadata record; that of a run says where its other records are."""
        if not name.startswith(RUN):
            return f"{self.records}/{name}", values
        run = self.run(name.removeprefix(RUN))
        moved = {k: self._value(k, v) for k, v in values.items()}
        return RUN + run, {**moved, "run": run, "records": self.records}

    def channel_metadata(self, values: dict[str, str]) -> dict[str, str]:
        """Return a channel's metadata, whose values may be topics or a run."""
        return {k: self.run(v) if k == "run" else self.topic(v) for k, v in values.items()}

    def _value(self, key: str, value: str) -> str:
        if key in ("inputs", "outputs"):  # JSON: topics, or lists of them, by name
            named = json.loads(value)
            moved = {
                k: self.topic(v) if isinstance(v, str) else [*map(self.topic, v)] for k, v in named.items()
            }
            return json.dumps(moved)
        if key in ("range.start_ns", "range.end_ns") and value:
            return str(int(value) + self.offset_ns)
        return self.topic(value)

    def history(self) -> list[Change]:
        """Return the list of changes as it reads there, still with its own numbers."""
        return [
            msgspec.structs.replace(
                c,
                added=tuple(self.ids[i] for i in c.added),
                removed=tuple(_renamed(pl.DataFrame(list(c.removed), schema=COLUMNS), self).to_dicts()),
                vocabulary={self.tier(t): words for t, words in c.vocabulary.items()},
            )
            for c in self._past
        ]


def _renamed(rows: pl.DataFrame, place: JoinedPart) -> pl.DataFrame:
    """Return annotations with the times, ids, tiers and channels that they have in the joined recording."""

    def by(column: str, new: Any) -> pl.Series:
        values = [None if v is None else new(v) for v in rows[column].to_list()]
        return pl.Series(column, values, pl.String)

    return rows.with_columns(
        pl.col("start_ns", "end_ns") + place.offset_ns,
        by("id", place.ids.__getitem__),
        by("tier", place.tier),
        by("channel", place.topic),
    )


def joined_history(places: Sequence[JoinedPart]) -> list[Change]:
    """Return the changes of all as one list: by time, each recording's in their own order, numbered anew."""
    numbers: dict[tuple[int, int], int] = {}
    out: list[Change] = []
    streams = [[(c.time, k, c) for c in place.history()] for k, place in enumerate(places)]
    for number, (_, k, entry) in enumerate(heapq.merge(*streams, key=lambda e: e[:2]), 1):
        numbers[k, entry.number] = number
        undoes = numbers[k, entry.undoes] if entry.undoes else 0
        out.append(msgspec.structs.replace(entry, number=number, undoes=undoes))
    return out


def cut_history(rec: Recording, kept: pl.DataFrame) -> list[Change]:
    """Return the changes of a recording, and the cut itself where annotations went or became shorter.

    Parameters
    ----------
    rec : Recording
        The whole recording.
    kept : polars.DataFrame
        Annotations of the part.
    """
    past = history(rec)
    before = rec.annotations
    other = before.join(kept, on=["id", "start_ns", "end_ns"], how="anti")
    if other.height:
        entry = Change(
            number=len(past) + 1,
            time=datetime.now(UTC).isoformat(timespec="seconds"),
            by=user(),
            action="cut",
            added=tuple(other.filter(pl.col("id").is_in(kept["id"].to_list()))["id"]),
            removed=tuple(other.to_dicts()),
        )
        past.append(entry)
    return past


def history_text(changes: Collection[Change]) -> bytes:
    """Return the attachment that lists changes."""
    return b"".join(msgspec.json.encode(c) + b"\n" for c in changes)
