"""``marcha annotate``: labelled intervals and instants; a file is never changed in place."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from cyclopts import App, Parameter

from .changes import WHERE, Where, change_outcome, diff, log, redo, rules, undo, vocabulary, write
from .console import (
    Heading,
    Outcome,
    TextTable,
    complain,
)
from .contents import say_losses
from .errors import DONE, INTERRUPTED
from .options import (
    DEFAULT,
    QUIET,
    Common,
    Force,
    Output,
    Shown,
    Strings,
    instant,
    settings,
)

app = App(
    name="annotate",
    help="Add, change, import, export, list or compare annotations of a recording.",
    default_parameter=QUIET,
)


Tier = Annotated[str | None, Parameter(name="--tier")]


@app.default
def by_eye(
    path: Path,
    /,
    *,
    page: Annotated[bool, Parameter(name="--page", negative="")] = False,
    show: Annotated[bool, Parameter(name="--show", negative="")] = False,
    browser: Annotated[bool, Parameter(name="--browser", negative="--no-browser")] = True,
    video: Path | None = None,
    video_offset: Annotated[float, Parameter(name="--video-offset", allow_leading_hyphen=True)] = 0.0,
    where: Where = WHERE,
    common: Common = DEFAULT,
) -> Outcome:
    """Annotate by eye: in a page of this machine's browser, or in the native Rerun viewer.

    Parameters
    ----------
    path : Path
        The recording.
    page : bool
        Open the page: signals, annotations, the film of the walk; by mouse or by keyboard alone.
    show : bool
        Open the viewer: ranges are dragged on its time ruler, or the cursor is put; keys and labels are typed
        in this terminal.
    browser : bool
        Open a browser window; without it the address is only printed.
    video : Path
        Film of the walk; NAME.mp4 or NAME.webm beside the recording is found without it.
    video_offset : float
        Seconds of the recording at which the film begins.
    """
    from .. import recording
    from ..recording.errors import UsageError
    from ..viz.annotating import Session, annotate_in_viewer, annotate_page

    if page == show:
        raise UsageError(
            f"annotate {path}: give --page or --show to mark by eye, or a command: marcha annotate --help"
        )
    rec = recording.open(path)
    say_losses(rec)
    session = Session(rec, where.target(rec), action="page" if page else "viewer", **where.how)
    if session.taken_up:
        complain(f"took up {session.taken_up} edits of an earlier session from {session.draft}")
    try:
        if page:
            interrupted = annotate_page(
                session,
                video=video,
                video_offset_s=video_offset,
                open_browser=browser,
                opened=lambda server: complain(f"the page is at {server.address}; Ctrl-C ends it"),
            )
        else:
            interrupted = annotate_in_viewer(
                session,
                say=complain,
                opened=lambda window: complain(f"the viewer is at {window.address}"),
            )
    finally:
        left = session.unsaved
        if left:
            complain(f"{left} annotations are not saved; {session.draft} keeps them for the next session")
    document = {"output": str(session.out), "annotations": len(session.rows), "unsaved": left}
    summary = Heading(f"{session.out}: {len(session.rows)} annotations, {left} not saved")
    return Outcome(document, [summary], code=INTERRUPTED if interrupted else DONE)


@app.command
def add(
    path: Path,
    /,
    *,
    label: str,
    start: Annotated[str, Parameter(name="--from")],
    end: Annotated[str | None, Parameter(name="--to")] = None,
    tier: Annotated[str, Shown] = "manual",
    note: str | None = None,
    confidence: float | None = None,
    channel: str | None = None,
    source: str | None = None,
    meta: Annotated[Strings, Parameter(name="--meta")] = (),
    where: Where = WHERE,
    common: Common = DEFAULT,
) -> Outcome:
    """Add one annotation.

    Parameters
    ----------
    path : Path
        The recording.
    label : str
        What happened.
    start : str
        When it began: 12.5, 12.5s, 1m, 500ms after the recording's start, or @NANOSECONDS of its clock.
    end : str
        When it ended; written like --from. An instant without it.
    tier : str
        Kind of annotation; becomes /annotation/TIER.
    note : str
        Remark.
    confidence : float
        How sure, between 0 and 1.
    channel : str
        Topic or segment that it speaks of.
    source : str
        Who says so; human:NAME with the name of --by otherwise.
    meta : str
        key=value of the annotation; may be repeated.
    """
    import msgspec
    import polars as pl

    from .. import recording
    from ..recording.annotations import COLUMNS
    from ..recording.changes import user
    from ..recording.errors import UsageError

    rec = recording.open(path)
    start_ns = instant(start, rec, "--from")
    end_ns = start_ns if end is None else instant(end, rec, "--to")
    if start_ns is None or end_ns is None or start_ns < 0 or end_ns < start_ns:
        raise UsageError(
            f"annotate add: from {start} to {end} is not an interval; the end is not before the start"
        )
    row = {
        "tier": tier,
        "start_ns": start_ns,
        "end_ns": end_ns,
        "label": label,
        "metadata": msgspec.json.encode(settings(meta, "--meta")).decode(),
        "source": source or f"human:{where.by or user()}",
        "confidence": confidence,
        "note": note,
        "channel": channel,
    }
    return write(rec, where, add=pl.DataFrame([row], schema=COLUMNS), action="add")


@app.command
def remove(
    path: Path,
    /,
    *ids: str,
    tier: Tier = None,
    where: Where = WHERE,
    common: Common = DEFAULT,
) -> Outcome:
    """Remove annotations.

    Parameters
    ----------
    path : Path
        The recording.
    ids : str
        Ids (marcha annotate list), or their beginnings.
    tier : str
        All annotations of this tier.
    """
    from .. import recording
    from ..recording.changes import find, find_tier
    from ..recording.errors import UsageError

    rec = recording.open(path)
    gone = find(rec, ids)
    if tier is not None:
        gone += rec.annotations.filter(tier=find_tier(rec, tier))["id"].to_list()
    if not gone:
        raise UsageError(f"{path}: annotate remove: nothing is named; give ids or --tier of what is there")
    return write(rec, where, remove=tuple(dict.fromkeys(gone)), action="remove")


@app.command
def edit(
    path: Path,
    /,
    *ids: str,
    label: str | None = None,
    start: Annotated[str | None, Parameter(name="--from")] = None,
    end: Annotated[str | None, Parameter(name="--to")] = None,
    tier: Tier = None,
    note: str | None = None,
    confidence: float | None = None,
    channel: str | None = None,
    source: str | None = None,
    where: Where = WHERE,
    common: Common = DEFAULT,
) -> Outcome:
    """Change annotations; they keep their ids.

    Parameters
    ----------
    path : Path
        The recording.
    ids : str
        Ids (marcha annotate list), or their beginnings.
    label : str
        New label.
    start : str
        New start, written like that of add.
    end : str
        New end.
    tier : str
        New tier.
    note : str
        New remark.
    confidence : float
        New confidence.
    channel : str
        Topic or segment that it speaks of.
    source : str
        Who says so.
    """
    from .. import recording
    from ..recording import changes

    rec = recording.open(path)
    options = {
        "label": label,
        "start_ns": instant(start, rec, "--from"),
        "end_ns": instant(end, rec, "--to"),
        "tier": tier,
        "note": note,
        "confidence": confidence,
        "channel": channel,
        "source": source,
    }
    values = {k: v for k, v in options.items() if v is not None}
    out = where.target(rec)
    entry = changes.edit(rec, out, ids, values, **where.how)
    return change_outcome(rec, out, entry)


@app.command(name="import")
def import_(
    path: Path,
    table: Path,
    /,
    *,
    tier: Tier = None,
    format: Annotated[str | None, Parameter(name="--format")] = None,
    offset: Annotated[float, Parameter(name="--offset", allow_leading_hyphen=True)] = 0.0,
    replace: Annotated[bool, Parameter(name="--replace", negative="")] = False,
    source: str | None = None,
    where: Where = WHERE,
    common: Common = DEFAULT,
) -> Outcome:
    """Add the labels of another tool: BIDS events, CSV or TSV, Audacity, ELAN, Praat, events of C3D.

    Parameters
    ----------
    path : Path
        The recording.
    table : Path
        The file. A table has the columns onset, duration [s, from the recording's start] or start_ns, end_ns;
        trial_type or label; optionally tier, id, source, confidence, note, channel, metadata.
    tier : str
        Tier of labels that name none; the file's name without it.
    format : str
        table, audacity, eaf, textgrid or c3d; found by content without it.
    offset : float
        Seconds between the recording's start and the file's zero.
    replace : bool
        Annotations with the same ids are replaced.
    source : str
        Who says so, where the file does not.
    """
    import polars as pl

    from .. import recording
    from ..export.labels import read_labels

    rec = recording.open(path)
    labels = read_labels(table, rec, format=format, tier=tier, offset_ns=round(offset * 1e9))
    for note in labels.notes:
        complain(f"{table}: {note}")
    rows = labels.annotations
    if source is not None:
        rows = rows.with_columns(pl.col("source").fill_null(source))
    same = rec.annotations.filter(pl.col("id").is_in(rows["id"].drop_nulls().implode()))["id"].to_list()
    return write(
        rec,
        where,
        add=rows,
        remove=tuple(same) if replace else (),
        action=f"import {table.name}",
        more={"format": labels.format, "notes": labels.notes},
    )


@app.command
def export(
    path: Path,
    /,
    *,
    output: Output,
    to: Annotated[str | None, Parameter(name=("--to", "-t"))] = None,
    tier: Annotated[Strings, Parameter(name="--tier")] = (),
    force: Force = False,
    common: Common = DEFAULT,
) -> Outcome:
    """Write annotations for another tool.

    Parameters
    ----------
    path : Path
        The recording.
    output : Path
        File to write.
    to : str
        events (BIDS), eaf, textgrid or audacity; by the file's ending without it.
    tier : str
        Tier or pattern; may be repeated. All without it.
    force : bool
        Replace an earlier file.
    """
    from .. import recording
    from ..export.labels import WRITTEN
    from ..recording.annotations import TOPIC
    from ..recording.changes import find_tier
    from ..recording.errors import UsageError
    from .export import hand_on

    endings = {m.suffix.lower(): name for name, m in WRITTEN.items()} | {".tsv": "events"}
    name = to or endings.get(output.suffix.lower())
    if name is None or name not in endings.values():
        names = ", ".join(endings.values())
        raise UsageError(f"{output}: {name or output.suffix!r} is no format of labels; give --to {names}")
    options: dict[str, Any] = {"topics": tuple(TOPIC + t for t in tier)} if tier else {}
    rec = recording.open(path)
    for one in tier:
        if not any(mark in one for mark in "*?["):
            find_tier(rec, one)
    return hand_on(rec, name, output, options, force=force)


@app.command(name="list")
def list_(path: Path, /, *, tier: Tier = None, common: Common = DEFAULT) -> Outcome:
    """List annotations by time.

    Parameters
    ----------
    path : Path
        The recording.
    tier : str
        Only this tier.
    """
    from .. import recording
    from ..recording.changes import find_tier
    from ..recording.events import to_events

    rec = recording.open(path)
    events = to_events(rec.annotations, rec.start_ns)
    say_losses(rec)
    if tier is not None:
        events = events.filter(tier=find_tier(rec, tier))
    rows = events.rows(named=True)
    optional = [c for c in ("source", "confidence", "note", "channel") if events[c].null_count() < len(rows)]
    table = TextTable(
        ["id", ">onset [s]", ">duration [s]", "tier", "label", *optional, "metadata"],
        [
            [
                r["id"],
                f"{r['onset']:.3f}",
                f"{r['duration']:.3f}",
                r["tier"],
                r["trial_type"],
                *(r[c] for c in optional),
                r["metadata"],
            ]
            for r in rows
        ],
    )
    return Outcome({"path": str(path), "annotations": rows}, [table] if rows else [Heading("no annotations")])


for command in (log, undo, redo, rules, vocabulary, diff):
    app.command(command)
