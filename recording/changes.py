"""Changing the annotations of a recording: every change is one new file, listed in it, and can be undone."""

from __future__ import annotations

import getpass
from collections.abc import Collection, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec
import polars as pl

from .annotations import COLUMNS, check_annotations, identified
from .errors import MarchaError, UsageError
from .events import VOCABULARY, Vocabulary, vocabularies
from .reader import Recording
from .writer import Writer

HISTORY = "annotations/history.jsonl"
"""Attachment with one :class:`Change` a line."""


class Change(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One change of the annotations.

    Attributes
    ----------
    number : int
        From 1.
    time : str
        When, ISO 8601, UTC.
    by : str
        Who.
    action : str
        What was asked for: ``add``, ``remove``, ``edit``, ``import``, ``rules``, ``vocabulary``, ``undo`` …
    added : tuple of str
        Ids of annotations that came.
    removed : tuple of dict
        Annotations that went, whole.
    vocabulary : dict of str to str
        Vocabularies by tier that were replaced: what they were (empty: none).
    undoes : int
        Number of the change that this one takes back; 0 for none.
    """

    number: int
    time: str
    by: str
    action: str
    added: tuple[str, ...] = ()
    removed: tuple[dict[str, Any], ...] = ()
    vocabulary: dict[str, str] = {}
    undoes: int = 0


def history(rec: Recording) -> list[Change]:
    """Return the changes of a recording's annotations, oldest first; none in one that was never changed.

    Raises
    ------
    MarchaError
        The list in the recording is damaged.
    """
    if not any(a.name == HISTORY for a in rec.attachments):
        return []
    lines = rec.attachment(HISTORY).splitlines()
    try:
        return [msgspec.json.decode(line, type=Change) for line in lines if line.strip()]
    except msgspec.MsgspecError as error:
        raise MarchaError(f"{rec.path}: {HISTORY}: cannot be read: {error}") from None


def find(rec: Recording, ids: Collection[str]) -> list[str]:
    """Return whole ids for ids or their beginnings, in the order given.

    Raises
    ------
    UsageError
        No annotation, or several, begin so.
    """
    all_ids = rec.annotations["id"].to_list()
    whole = set(all_ids)
    rows = []
    for start in ids:
        fits = [start] if start in whole else [i for i in all_ids if i.startswith(start)]
        if len(fits) != 1 or not start:
            what = "no annotation has" if not fits else f"{len(fits)} annotations have"
            raise UsageError(f"{rec.path}: {what} an id that begins with {start!r}; marcha annotate list")
        rows.append(fits[0])
    return rows


def change(
    rec: Recording,
    out: Path | str,
    *,
    add: pl.DataFrame | None = None,
    remove: Collection[str] = (),
    vocabulary: Mapping[str, Vocabulary | None] | None = None,
    action: str = "change",
    by: str | None = None,
    when: datetime | None = None,
    overwrite: bool = False,
    undoes: int = 0,
) -> Change:
    """Write a recording with other annotations: all that ``rec`` holds, what went apart, and what came.

    Parameters
    ----------
    rec : Recording
        Never changed; where ``out`` is its own path, the finished copy takes its place at once.
    out : Path or str
        File to write.
    add : polars.DataFrame, optional
        Annotations that come; see :func:`marcha.recording.annotations.check_annotations`.
    remove : collection of str
        Ids of annotations that go.
    vocabulary : mapping, optional
        Tier to its new vocabulary; None takes it away.
    action, by, when
        What the list of changes says: the user's name and the time by default.
    overwrite : bool
        Whether ``out`` may be replaced.
    undoes : int
        Number of the change that this one takes back.

    Raises
    ------
    OutputExists
        ``out`` exists and ``overwrite`` is false.
    MarchaError
        An annotation lies outside of the recording, has an id that is taken, or a label that its tier's
        closed vocabulary does not have; nothing is written.
    """
    gone = set(find(rec, remove))
    before = rec.annotations
    kept = before.filter(~pl.col("id").is_in(gone))
    came = _new(rec, kept, add)
    words = _vocabulary(rec, vocabulary or {})
    check_labels(rec.path, came, vocabularies({VOCABULARY: words}))
    past = history(rec)
    entry = Change(
        number=len(past) + 1,
        time=(when or datetime.now(UTC)).astimezone(UTC).isoformat(timespec="seconds"),
        by=by if by is not None else user(),
        action=action,
        added=tuple(came["id"]),
        removed=tuple(before.filter(pl.col("id").is_in(gone)).to_dicts()),
        vocabulary={t: rec.metadata.get(VOCABULARY, {}).get(t, "") for t in vocabulary or {}},
        undoes=undoes,
    )
    with Writer(out, overwrite=overwrite) as copy:
        copy.attach_events()
        copy.copy_from(rec, annotations=False, leave=(HISTORY, VOCABULARY))
        if words:
            copy.add_metadata(VOCABULARY, words)
        copy.add_annotations(pl.concat([kept, came]))
        text = b"".join(msgspec.json.encode(c) + b"\n" for c in [*past, entry])
        copy.add_attachment(HISTORY, text, "application/jsonl")
    return entry


def edit(
    rec: Recording, out: Path | str, ids: Collection[str], values: Mapping[str, Any], **how: Any
) -> Change:
    """Give annotations other values; they keep their ids.

    Parameters
    ----------
    rec, out
        See :func:`change`.
    ids : collection of str
        Ids, or their beginnings.
    **how
        As :func:`change` has it: ``by``, ``when``, ``overwrite``.
    values : mapping
        Column of :data:`marcha.recording.annotations.COLUMNS` to its new value.

    Raises
    ------
    UsageError
        No such annotation or column.
    """
    whole = find(rec, ids)
    odd = [name for name in values if name not in COLUMNS or name == "id"]
    if odd or not values:
        raise UsageError(f"{rec.path}: edit: {', '.join(odd) or 'nothing'} cannot be changed; name a column")
    rows = rec.annotations.filter(pl.col("id").is_in(whole))
    rows = rows.with_columns(pl.lit(v, COLUMNS[name]).alias(name) for name, v in values.items())
    return change(rec, out, add=rows, remove=whole, action="edit", **how)


def undo(
    rec: Recording, out: Path | str, number: int | None = None, *, redo: bool = False, **how: Any
) -> Change:
    """Take a change back, or take back that it was taken back.

    Parameters
    ----------
    rec, out, how
        See :func:`change`.
    number : int, optional
        The change; by default the last one that stands (``redo``: the last one that was undone).
    redo : bool
        Whether to take back an undo.

    Raises
    ------
    UsageError
        There is nothing to take back, or later changes touch the same annotations.
    """
    past = history(rec)
    entry = _chosen(rec, past, number, redo=redo)
    first = entry.undoes or entry.number
    touched = _touched(entry)
    stands = standing(past)
    for later in past:
        if later.action == "cut":
            continue
        if later.number > first and not later.undoes and stands[later.number] and touched & _touched(later):
            raise UsageError(
                f"{rec.path}: change {entry.number} cannot be taken back alone: change {later.number} "
                "touches the same; undo that first"
            )
    if missing := set(entry.added) - set(rec.annotations["id"]):
        raise UsageError(
            f"{rec.path}: change {entry.number}: annotation {min(missing)} is no longer there; "
            "it was cut off, or another program took it out"
        )
    rows = pl.DataFrame(list(entry.removed), schema=COLUMNS) if entry.removed else None
    words = {t: msgspec.json.decode(v, type=Vocabulary) if v else None for t, v in entry.vocabulary.items()}
    action = "redo" if redo else "undo"
    return change(
        rec, out, add=rows, remove=entry.added, vocabulary=words, action=action, undoes=entry.number, **how
    )


def standing(past: Collection[Change]) -> dict[int, bool]:
    """Return for the number of each change whether it stands: whether it was not undone."""
    stands: dict[int, bool] = {}
    for entry in past:
        stands[entry.number] = True
        if entry.undoes:
            stands[entry.undoes] = False
            first = next((c for c in past if c.number == entry.undoes), None)
            if first is not None and first.undoes:
                stands[first.undoes] = True
    return stands


def _touched(entry: Change) -> set[str]:
    """Return the ids that a change touched, and the tiers whose vocabulary it replaced."""
    rows = {row["id"] for row in entry.removed}
    return {*entry.added, *rows, *(f"vocabulary of {tier}" for tier in entry.vocabulary)}


def _chosen(rec: Recording, past: list[Change], number: int | None, *, redo: bool) -> Change:
    stands = standing(past)
    numbers = {c.number: c for c in past}

    def fits(entry: Change) -> bool:
        if entry.action == "cut":  # what it took lies outside of the recording
            return False
        first = numbers.get(entry.undoes)
        is_undo = first is not None and not first.undoes
        return stands[entry.number] and (is_undo if redo else not entry.undoes)

    options = [c for c in past if fits(c) and number in (None, c.undoes if redo else c.number)]
    if not options:
        what = f"change {number}" if number is not None else "a change"
        raise UsageError(
            f"{rec.path}: there is not {what} to {'redo' if redo else 'undo'}; marcha annotate log"
        )
    return options[-1]


def _new(rec: Recording, kept: pl.DataFrame, add: pl.DataFrame | None) -> pl.DataFrame:
    """Return the annotations that come, checked, each with an id that no other has."""
    try:
        came = check_annotations(pl.DataFrame(schema=COLUMNS) if add is None else add)
    except MarchaError as error:
        raise type(error)(f"{rec.path}: {error}") from None
    check_inside(rec, came)
    both = pl.concat([kept, came])
    twice = both.filter(pl.col("id").is_not_null() & pl.col("id").is_duplicated())
    if twice.height:
        raise MarchaError(
            f"{rec.path}: annotation id {twice['id'][0]!r} is taken by {twice['label'][0]!r}; give another"
        )
    return identified(both)[kept.height :]


def check_inside(
    rec: Recording, annotations: pl.DataFrame, where: Path | None = None, *, lines: bool = False
) -> None:
    """Raise ``MarchaError`` where an annotation does not lie inside the recording's data.

    Parameters
    ----------
    rec : Recording
        What they speak of.
    annotations : polars.DataFrame
        To be checked.
    where : Path, optional
        File that they come from; named instead of the recording.
    lines : bool
        Whether that is a table with a header and a line an annotation, so that the line is named.
    """
    span = rec.data_span
    if span is None:
        return
    first, last = span
    outside = (annotations["start_ns"] < first) | (annotations["end_ns"] > last)
    if outside.any():
        row = annotations.row(outside.arg_true()[0], named=True)
        start, end = ((row[k] - rec.start_ns) / 1e9 for k in ("start_ns", "end_ns"))
        raise MarchaError(
            f"{_place(where or rec.path, outside, lines)}: {outside.sum()} of {annotations.height} annotations "
            f"lie outside of the recording (0 to {(last - rec.start_ns) / 1e9:.3f} s): {row['label']!r} from "
            f"{start:.3f} to {end:.3f} s; correct its times, or give its clock's offset"
        )


def check_labels(
    where: Path, annotations: pl.DataFrame, by_tier: Mapping[str, Vocabulary], *, lines: bool = False
) -> None:
    """Raise ``MarchaError`` where a tier has a closed vocabulary and a label is not in it.

    Parameters
    ----------
    where : Path
        File that the annotations come from.
    annotations : polars.DataFrame
        To be checked.
    by_tier : mapping
        Tier to its vocabulary.
    lines : bool
        See :func:`check_inside`.
    """
    for tier, vocabulary in by_tier.items():
        if not vocabulary.closed:
            continue
        odd = (annotations["tier"] == tier) & ~annotations["label"].is_in(list(vocabulary.labels))
        if odd.any():
            label = annotations["label"][int(odd.arg_true()[0])]
            raise MarchaError(
                f"{_place(where, odd, lines)}: tier {tier!r}: label {label!r} is not in its closed vocabulary; "
                f"it has {', '.join(vocabulary.labels) or 'none'}"
            )


def check_unique(where: Path, annotations: pl.DataFrame, *, lines: bool = False) -> None:
    """Raise ``MarchaError`` where an id is there twice; parameters as :func:`check_labels` has them."""
    twice = annotations["id"].is_not_null() & annotations["id"].is_duplicated()
    if twice.any():
        name = annotations["id"][int(twice.arg_true()[0])]
        again = twice & (annotations["id"] == name)
        again[int(again.arg_true()[0])] = False
        raise MarchaError(
            f"{_place(where, again, lines)}: id {name!r} is there twice; give each annotation its own"
        )


def _place(where: Path, odd: pl.Series, lines: bool) -> str:
    """Return the file, and where it is a table the line of the first odd row."""
    return f"{where}: line {odd.arg_true()[0] + 2}" if lines else str(where)


def find_tier(rec: Recording, tier: str) -> str:
    """Return the tier.

    Raises
    ------
    UsageError
        No annotation is of it and it has no vocabulary.
    """
    tiers = {*rec.annotations["tier"].unique(), *rec.metadata.get(VOCABULARY, {})}
    if tier not in tiers:
        raise UsageError(f"{rec.path}: no tier {tier!r}; it has {', '.join(sorted(tiers)) or 'none'}")
    return tier


def _vocabulary(rec: Recording, new: Mapping[str, Vocabulary | None]) -> dict[str, str]:
    """Return the metadata record to write; labels that are there already must fit what is closed now."""
    words = dict(rec.metadata.get(VOCABULARY, {}))
    for tier, vocabulary in new.items():
        words.pop(tier, None)
        if vocabulary is not None:
            check_labels(rec.path, rec.annotations, {tier: vocabulary})
            words[tier] = msgspec.json.encode(vocabulary).decode()
    return words


def user() -> str:
    """Return the name of the user who runs this program, as far as the system knows it."""
    try:
        return getpass.getuser()
    except (OSError, KeyError, ImportError):
        return "unknown"
