"""``marcha annotate``: where a change goes; the list of changes, undo, rules, vocabularies, comparison."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from .console import Heading, Outcome, TextTable, complain
from .contents import say_losses
from .options import DEFAULT, Common, MaybeRecordingOutput, Shown, Strings, settings

if TYPE_CHECKING:
    from ..recording import Recording
    from ..recording.changes import Change


@Parameter(name="*")
@dataclass(frozen=True)
class Where:
    """Where a change is written, and who makes it."""

    output: MaybeRecordingOutput = None
    """New recording to write."""

    in_place: Annotated[bool, Parameter(name="--in-place", negative="")] = False
    """Put the finished copy in the place of the recording."""

    force: Annotated[bool, Parameter(name="--force", negative="")] = False
    """Replace an existing output."""

    by: Annotated[str | None, Parameter(name="--by")] = None
    """Who makes the change; the user's name without it."""

    def target(self, rec: Recording) -> Path:
        """Return the file to write.

        Raises
        ------
        UsageError
            None is named, or two.
        """
        from ..recording.errors import UsageError
        from ..recording.files import require_other

        if self.in_place == (self.output is not None):
            raise UsageError("annotate: give either -o NEW.mcap or --in-place")
        if self.output is not None:
            require_other(self.output, [rec.path])
        return rec.path if self.output is None else self.output

    @property
    def how(self) -> dict[str, Any]:
        """What :func:`marcha.recording.changes.change` wants to know."""
        return {"by": self.by, "overwrite": self.force or self.in_place}


WHERE = Where()


def write(rec: Recording, where: Where, *, more: dict[str, Any] | None = None, **what: Any) -> Outcome:
    """Make a change; ``what`` is that of :func:`marcha.recording.changes.change`."""
    from ..recording.changes import change

    out = where.target(rec)
    return change_outcome(rec, out, change(rec, out, **what, **where.how), more)


def change_outcome(rec: Recording, out: Path, entry: Change, more: dict[str, Any] | None = None) -> Outcome:
    """Say what a change did."""
    say_losses(rec)
    total = rec.annotations.height + len(entry.added) - len(entry.removed)
    document = {
        "output": str(out),
        "change": entry.number,
        "added": len(entry.added),
        "removed": len(entry.removed),
        "ids": list(entry.added),
        "annotations": total,
        **(more or {}),
    }
    parts = [f"{len(entry.added)} added"] + ([f"{len(entry.removed)} removed"] if entry.removed else [])
    return Outcome(document, [Heading(f"wrote {out}: {', '.join(parts)}, {total} annotations")])


def log(path: Path, /, *, common: Common = DEFAULT) -> Outcome:
    """List the changes of the annotations: when, who, what; (undone) where it was taken back.

    Parameters
    ----------
    path : Path
        The recording.
    """
    import msgspec

    from .. import recording
    from ..recording.changes import history, standing

    past = history(recording.open(path))
    stands = standing(past)
    table = TextTable(
        [">change", "time", "by", "what", ">added", ">removed"],
        [
            [
                c.number,
                c.time,
                c.by,
                c.action
                + (f" of {c.undoes}" if c.undoes else "")
                + ("" if stands[c.number] else " (undone)"),
                len(c.added),
                len(c.removed),
            ]
            for c in past
        ],
    )
    document = {"path": str(path), "changes": [msgspec.to_builtins(c) for c in past]}
    return Outcome(document, [table] if past else [Heading("the annotations were never changed")])


def undo(
    path: Path,
    /,
    *,
    change: Annotated[int | None, Parameter(name="--change")] = None,
    where: Where = WHERE,
    common: Common = DEFAULT,
) -> Outcome:
    """Take the last change of the annotations back.

    Parameters
    ----------
    path : Path
        The recording.
    change : int
        Number of the change (marcha annotate log); the last that stands without it.
    """
    return _back(path, change, where, redo=False)


def redo(
    path: Path,
    /,
    *,
    change: Annotated[int | None, Parameter(name="--change")] = None,
    where: Where = WHERE,
    common: Common = DEFAULT,
) -> Outcome:
    """Make a change again that was undone.

    Parameters
    ----------
    path : Path
        The recording.
    change : int
        Number of the change that was undone; the last one without it.
    """
    return _back(path, change, where, redo=True)


def _back(path: Path, number: int | None, where: Where, *, redo: bool) -> Outcome:
    from .. import recording
    from ..recording import changes

    rec = recording.open(path)
    out = where.target(rec)
    return change_outcome(rec, out, changes.undo(rec, out, number, redo=redo, **where.how))


def rules(
    path: Path,
    /,
    *names: str,
    where: Where = WHERE,
    common: Common = DEFAULT,
) -> Outcome:
    """Annotate by rule, from estimates and sensors; run again, nothing is there twice.

    Parameters
    ----------
    path : Path
        The recording.
    names : str
        stance, swing, step, turn, stair, jump, gap, clip, fix-lost; all without a name.
    """
    from .. import recording
    from ..export.rules import apply_rules

    rec = recording.open(path)
    new, stale = apply_rules(rec, names)
    if not new.height and not stale and where.in_place:
        total = rec.annotations.height
        document = {"output": str(path), "added": 0, "removed": 0, "annotations": total}
        return Outcome(document, [Heading(f"{path}: nothing new, {total} annotations")])
    counts = dict(new.group_by("label", maintain_order=True).len().rows()) if new.height else {}
    more = {"labels": {k: v for k, v in counts.items() if not k.startswith("step ")}}
    return write(rec, where, add=new, remove=tuple(stale), action="rules", more=more)


def vocabulary(
    path: Path,
    tier: str,
    /,
    *labels: str,
    closed: Annotated[bool, Parameter(name="--closed", negative="")] = False,
    hed: Annotated[Strings, Parameter(name="--hed")] = (),
    where: Where = WHERE,
    common: Common = DEFAULT,
) -> Outcome:
    """Say which labels a tier has; without labels the vocabulary is taken away.

    Parameters
    ----------
    path : Path
        The recording.
    tier : str
        The tier.
    labels : str
        LABEL or LABEL=MEANING.
    closed : bool
        No other label is allowed.
    hed : str
        LABEL=HED tags; may be repeated.
    """
    from .. import recording
    from ..recording.events import Vocabulary

    words = {word.partition("=")[0].strip(): word.partition("=")[2].strip() for word in labels}
    new = Vocabulary(labels=words, closed=closed, hed=settings(hed, "--hed")) if words else None
    return write(recording.open(path), where, vocabulary={tier: new}, action="vocabulary")


def diff(
    first: Path,
    second: Path | None = None,
    /,
    *,
    tier: Annotated[Strings, Parameter(name="--tier")] = (),
    tolerance: Annotated[str, Shown] = "250ms",
    any_label: Annotated[bool, Parameter(name="--any-label", negative="")] = False,
    common: Common = DEFAULT,
) -> Outcome:
    """Compare two annotators, or an annotator with an algorithm: matches, boundary errors, overlap, κ.

    Parameters
    ----------
    first : Path
        Recording whose annotations are taken for true.
    second : Path
        Recording to compare with, or a file of labels (events, ELAN, Praat, Audacity); without it
        two tiers of the first are compared.
    tier : str
        Tier to compare; given twice, that of the first and that of the second. All without it.
    tolerance : str
        How far apart instants may lie.
    any_label : bool
        Labels of partners may differ.
    """
    import msgspec

    from .. import recording
    from ..export.agreement import compare
    from ..export.labels import read_labels
    from ..recording.changes import find_tier
    from ..recording.errors import UsageError
    from .options import span_ns

    rec = recording.open(first)
    tiers = [*tier, *tier][:2] if len(tier) == 1 else list(tier)
    if len(tiers) > 2 or (second is None and len(set(tiers)) < 2):
        raise UsageError(
            "annotate diff: give a second recording or file of labels, or two --tier of the first"
        )
    is_recording = second is not None and second.suffix.lower() == ".mcap"
    other = rec if second is None else recording.open(second) if is_recording else rec
    table = rec.annotations if second is None or is_recording else read_labels(second, rec).annotations
    table = other.annotations if is_recording else table
    one, two = rec.annotations, table
    if tiers:
        if not two.filter(tier=tiers[1]).height:  # an annotator may have found nothing in a tier of the first
            find_tier(rec, tiers[0])
        one, two = one.filter(tier=tiers[0]), two.filter(tier=tiers[1])
    for name, rows in zip(tiers or ["annotations"] * 2, (one, two), strict=True):
        if not rows.height:
            complain(f"warning: {name}: there are none on one side")
    span = rec.data_span or (rec.start_ns, rec.end_ns)
    figures, listing = compare(
        one, two, span, tolerance_s=span_ns(tolerance, "--tolerance") * 1e-9, labels=not any_label
    )
    document = {"first": str(first), "second": str(second or first), "tiers": tiers}
    document |= {"figures": msgspec.to_builtins(figures), "annotations": listing.rows(named=True)}
    rows = [[k, v] for k, v in msgspec.to_builtins(figures).items()]
    return Outcome(document, [TextTable(["figure", ">value"], rows)])
