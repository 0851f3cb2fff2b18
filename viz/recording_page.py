"""The report of one recording, or of several, as one HTML page that needs no other file."""

from __future__ import annotations

import gc
import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import UTC, datetime
from html import escape
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import polars as pl

from ..recording import Recording
from ..recording.errors import MarchaError, UsageError
from ..recording.scratch import scratch_folder
from ..recording.threads import give_back_memory
from ..replay.epochs import GAIT
from ..replay.evaluate import Evaluation, RunEvaluation, evaluate
from ..replay.metrics import BETWEEN
from .figures import WALK, available_figures, figure
from .floor import floor_plan, loaders_of
from .page import Html, PagePicture, number
from .stride_figures import joint_cycles, side_of, strides_by
from .text import drawn_only, printable

MOST_ROWS = 400
"""More rows of annotations or intervals than these are counted; the recording has them all."""
MOST_LABELS = 12
"""A tier with more labels than these (names of steps) is no grouping."""
FLOOR = "floor"
OF_EVERY_STEP = ("stance", "swing", "step")
"""Tiers that a replay or a rule writes for every step: too short to measure each."""
UNIX_NS = 946_684_800 * 10**9


class Measured(NamedTuple):
    """A recording with what was measured: overall, by tier, or why not."""

    rec: Recording
    evaluation: Evaluation
    by: dict[str, list[RunEvaluation]]
    note: str


def recordings_page(
    recs: Sequence[Recording],
    *,
    by: str | None = None,
    picture: bool = True,
    progress: Callable[[float, float], None] | None = None,
) -> str:
    """Return the report of recordings: tracks, signals, angles, errors, annotations, parameters, provenance.

    Parameters
    ----------
    recs : sequence of Recording
        One or several; several begin with a table that compares them.
    by : str, optional
        The one tier whose labels are measured; all that are fit for it without.
    picture : bool
        Whether a picture of the viewer is taken where a graphics driver (software is enough) is there.
    progress : callable, optional
        Called with (done, total) recordings.

    Raises
    ------
    UsageError
        No recording has the tier ``by``.
    """
    html = Html()
    measured = []
    for k, rec in enumerate(recs):
        measured.append(_measure(rec, by))
        if progress is not None:
            progress(k + 0.5, len(recs))
    if by is not None and not any(m.by for m in measured):
        raise UsageError(f"no recording has the tier {by!r}; see `marcha annotate list`")
    single = len(measured) == 1
    if not single:
        _summary(html, measured)
    for k, one in enumerate(measured):
        if not single:
            html.section(printable(one.rec.path.stem))
        _recording(html, one, html.section if single else html.heading, picture)
        if progress is not None:
            progress(k + 1, len(measured))
    title = printable(measured[0].rec.path.stem) if single else f"{len(measured)} recordings"
    return html.page(title)


def _measure(rec: Recording, by: str | None) -> Measured:
    try:
        whole = evaluate(rec)
    except MarchaError as error:  # raw recordings have no estimates
        return Measured(rec, Evaluation([]), {}, printable(error))
    tiers = [by] if by is not None else _groupings(rec, [r.run for r in whole.runs])
    groups = {}
    for tier in tiers:
        try:
            groups[tier] = evaluate(rec, intervals=False, by=tier).runs
        except UsageError:  # of several recordings not all have it
            continue
    return Measured(rec, whole, groups, "")


def _groupings(rec: Recording, runs: Sequence[str]) -> list[str]:
    """Return the tiers whose labels are worth measuring: few, lasting, not those of every step."""
    labels_of: dict[str, set[str]] = {}
    for tier, label in (
        rec.annotations.filter(pl.col("end_ns") > pl.col("start_ns")).select("tier", "label").rows()
    ):
        run, _, rest = tier.partition("/")
        labels_of.setdefault(rest if run in runs else tier, set()).add(label)
    return [t for t, labels in labels_of.items() if len(labels) <= MOST_LABELS and t not in OF_EVERY_STEP]


def _summary(html: Html, measured: Sequence[Measured]) -> None:
    html.text(
        f"{len(measured)} recordings, {sum(m.rec.duration_s for m in measured):.0f} s in all, "
        f"{sum(len(m.evaluation.runs) for m in measured)} runs of estimators."
    )
    html.section("All recordings")
    runs = [(m, r) for m in measured for r in m.evaluation.runs or [None]]
    names = list(dict.fromkeys(n for _, r in runs if r is not None for n in r.metrics))
    rows = [
        [
            escape(printable(m.rec.path.stem)),
            escape(r.run) if r is not None else "no estimate",
            f"{m.rec.duration_s:.1f}",
            *(number(r.metrics.get(n) if r is not None else None) for n in names),
        ]
        for m, r in runs
    ]
    html.table(["recording", "run", "duration (s)", *(escape(n) for n in names)], rows, 2)


def _recording(html: Html, one: Measured, part: Callable[[str], None], picture: bool) -> None:
    rec, runs = one.rec, one.evaluation.runs
    start = ""
    if rec.start_ns > UNIX_NS:
        start = f", from {datetime.fromtimestamp(rec.start_ns / 1e9, UTC):%Y-%m-%d %H:%M:%S} UTC"
    html.text(
        f"{printable(rec.path.name)}: {rec.duration_s:.2f} s{start}; {len(rec.channels)} channels, "
        f"{len(runs)} runs, {rec.annotations.height} annotations."
    )
    html.warning(
        [*(f"{r.run}: {r.note}" for r in runs if r.note)]
        + [f"reading: {f.kind} ({f.count}): {f.detail}" for f in rec.findings]
    )
    if runs:
        part("Errors and other figures")
        _figures_table(html, [(r.run, r.metrics) for r in runs])
        lines: dict[str, list[str]] = {}
        for r in runs:
            if r.alignment:
                counts = f"{r.matched} samples compared with the reference, {r.dropped} left out"
                lines.setdefault(f"{counts}, alignment {r.alignment}", []).append(r.run)
        for text, names in lines.items():
            html.text(f"{', '.join(names)}: {text}.", "note")
        _left_and_right(html, runs)
    elif one.note:
        html.text(f"Not measured: {one.note}.", "note")
    part("Pictures")
    if picture:
        _viewer(html, rec)
    html.pictures(_pictures(rec))
    if one.by or any(r.intervals for r in runs):
        part("By annotation")
        _by_annotation(html, one)
    if rec.annotations.height:
        part("Annotations")
        _annotations(html, rec)
    _provenance(html, rec, part)


def _figures_table(
    html: Html, columns: Sequence[tuple[str, Mapping[str, Any]]], head: str = "figure"
) -> None:
    names = list(dict.fromkeys(n for _, values in columns for n in values))
    rows = [[escape(n), *(_cell(values.get(n)) for _, values in columns)] for n in names]
    html.table([head, *(escape(printable(c)) for c, _ in columns)], rows)


def _cell(value: Any) -> str:
    if value is not None and float(value).is_integer() and abs(value) < 1e9:
        return f"{value:.0f}"  # a count
    return number(value, 4)


def _left_and_right(html: Html, runs: Sequence[RunEvaluation]) -> None:
    """Set the gait of two feet side by side, where one estimator ran on both."""
    pairs: dict[tuple[str, str], dict[str, RunEvaluation]] = {}
    for run in runs:
        base, side = side_of(run.input)
        if side:
            pairs.setdefault((run.estimator, base), {})[side] = run
    for (estimator, _), sides in pairs.items():
        if len(sides) < 2:
            continue
        left, right = sides["left"].metrics, sides["right"].metrics
        names = [n for n in ("strides", *GAIT[True]) if n in left and n in right]
        rows = []
        for n in names:
            a, b = left[n], right[n]
            index = 200.0 * (a - b) / (a + b) if a + b else math.nan
            rows.append([escape(n), number(a, 4), number(b, 4), number(a - b), number(index)])
        html.heading(f"Left against right: {printable(estimator)}")
        html.table(["figure", "left", "right", "difference", "symmetry index (%)"], rows)
        html.text("Symmetry index: difference over the mean of both (Robinson et al. 1987).", "note")


def _by_annotation(html: Html, one: Measured) -> None:
    for tier, runs in one.by.items():
        for run in runs:
            if not run.groups or not any(g.label is not None for g in run.groups):
                continue
            html.heading(f"{printable(tier)}: {run.run}")
            columns: list[tuple[str, dict[str, Any]]] = []
            for g in run.groups:
                counts = {"intervals": g.intervals, "duration_s": g.duration_s}
                if run.alignment:
                    counts |= {"samples compared": g.matched}
                columns.append((BETWEEN if g.label is None else g.label or "(no label)", counts | g.metrics))
            _figures_table(html, columns)
        _strides_by(html, one.rec, tier)
    gait = [
        (run, i)
        for run in one.evaluation.runs
        for i in run.intervals
        if any(n in i.metrics for n in ("strides", "step_time_s"))
    ]
    if not gait:
        return
    html.heading("Gait by interval")
    names = [
        n
        for n in dict.fromkeys((*("strides",), *GAIT[True], *GAIT[False]))
        if any(n in i.metrics for _, i in gait)
    ]
    rows = [
        [
            escape(printable(i.tier)),
            escape(printable(i.label)),
            escape(run.run),
            f"{(i.start_ns - one.rec.start_ns) / 1e9:.2f}",
            f"{(i.end_ns - i.start_ns) / 1e9:.2f}",
            *(number(i.metrics.get(n), 4) for n in names),
        ]
        for run, i in gait[:MOST_ROWS]
    ]
    html.table(["tier", "label", "run", "from (s)", "for (s)", *names], rows, 3)
    _more(html, len(gait))


def _strides_by(html: Html, rec: Recording, tier: str) -> None:
    """Show joint angles over the gait cycle by label, with the range of motion of each."""
    marks = rec.annotations.filter(
        (pl.col("tier") == tier) | pl.col("tier").str.ends_with(f"/{tier}"),
        pl.col("end_ns") > pl.col("start_ns"),
    )
    curves = joint_cycles(rec, marks)
    if not curves:
        return
    picture = _draw(lambda fig: strides_by(rec, fig, marks))
    caption = f"Joint angles over the gait cycle by {printable(tier)}: mean, and ±1 sd as area."
    html.pictures([PagePicture(f"strides-{tier}", "", caption, picture, b"")])
    rows = []
    for c in curves:
        motion = np.ptp(c.curves, axis=1)
        rows.append(
            [
                escape(printable(c.joint)),
                escape(printable(c.owner)),
                escape(printable(c.label)),
                str(len(c.curves)),
                f"{motion.mean():.2f} ± {motion.std(ddof=1):.2f}",
                number(float(c.curves.std(axis=0, ddof=1).mean())),
            ]
        )
    head = ["joint", "of", "label", "cycles", "range of motion (°)", "mean sd over the cycle (°)"]
    html.table(head, rows, 3)


def _draw(draw: Callable[[Any], None]) -> bytes:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    fig = Figure(dpi=110, layout="constrained", facecolor="white")
    FigureCanvasAgg(fig)
    draw(fig)
    return _png(fig)


def _png(fig: Any) -> bytes:
    data = BytesIO()
    fig.savefig(data, format="png", metadata={"Software": None})
    return data.getvalue()


def _pictures(rec: Recording) -> Iterable[PagePicture]:
    plan = floor_plan(loaders_of(rec))
    tracks = any({"pos_x", "pos_y"} <= set(c.columns) for c in rec.channels.values())
    for kind, caption in available_figures().items():
        if (kind == FLOOR and not plan) or (kind == WALK and not tracks):
            continue  # another figure shows the same
        try:
            png = _png(figure(rec, kind=kind))
        except UsageError:  # the recording has nothing for it
            continue
        yield PagePicture(kind, "", caption, png, b"")
        gc.collect()  # a drawn figure holds itself, and its lines
        give_back_memory()


def _viewer(html: Html, rec: Recording) -> None:
    """Add a picture of the viewer, or say why there is none."""
    from .rrd import write_rrd
    from .screenshot import screenshots

    with scratch_folder() as folder:
        try:
            with drawn_only():
                write_rrd(rec, folder / "view.rrd")
            (shot,) = screenshots(folder / "view.rrd", at=1.0)
        except MarchaError as error:
            reason = printable(error).replace(str(folder / "view.rrd"), rec.path.name)
            html.text(f"No picture of the viewer: {reason}.", "note")
            return
    html.pictures(
        [PagePicture("viewer", "", "The viewer as `marcha view` opens it, cursor at the end.", shot.png, b"")]
    )


def _annotations(html: Html, rec: Recording) -> None:
    marks = rec.annotations
    seconds = (pl.col("end_ns") - pl.col("start_ns")).sum() / 1e9
    counts = marks.group_by("tier", "label", maintain_order=True).agg(n=pl.len(), seconds=seconds)
    if counts.height > MOST_ROWS or marks["tier"].n_unique() * 3 < counts.height:
        counts = (
            marks.group_by("tier", maintain_order=True)
            .agg(n=pl.len(), seconds=seconds)
            .with_columns(label=pl.lit(""))
        )
    rows = [
        [escape(printable(r["tier"])), escape(printable(r["label"])), str(r["n"]), f"{r['seconds']:.2f}"]
        for r in counts.iter_rows(named=True)
    ]
    html.table(["tier", "label", "number", "in all (s)"], rows, 2)
    shown = marks.filter(~pl.col("tier").str.split("/").list.last().is_in(OF_EVERY_STEP))
    body = [
        [
            escape(printable(r["tier"])),
            escape(printable(r["label"])),
            f"{(r['start_ns'] - rec.start_ns) / 1e9:.3f}",
            f"{(r['end_ns'] - r['start_ns']) / 1e9:.3f}",
            escape(printable(r["source"] or "")),
            number(r["confidence"]),
            escape(printable(r["note"] or "")),
        ]
        for r in shown.sort("start_ns").head(MOST_ROWS).iter_rows(named=True)
    ]
    if body:
        html.parts.append(
            f"<details{' open' if len(body) <= 30 else ''}><summary>{len(body)} annotations</summary>"
        )
        html.table(["tier", "label", "from (s)", "for (s)", "source", "confidence", "note"], body, 2)
        html.parts.append("</details>")
        _more(html, shown.height)


def _more(html: Html, count: int) -> None:
    if count > MOST_ROWS:
        html.text(f"{count - MOST_ROWS} more are in the recording.", "note")


def _provenance(html: Html, rec: Recording, part: Callable[[str], None]) -> None:
    runs = {n.removeprefix("run/"): m for n, m in rec.metadata.items() if n.startswith("run/")}
    if runs:
        part("Runs and their parameters")
        rows: dict[str, dict[str, str]] = {}
        for run, lineage in runs.items():
            for key, value in lineage.items():
                if key not in ("params", "findings", "environment"):
                    rows.setdefault(key.removeprefix("param."), {})[run] = value
        body = [
            [escape(k), *(escape(printable(v.get(run, ""))[:80]) for run in runs)] for k, v in rows.items()
        ]
        html.table(["", *(escape(r) for r in runs)], body, 1 + len(runs))
        findings = [
            [escape(run), escape(kind), str(count), escape(printable(detail))]
            for run, lineage in runs.items()
            for kind, count, detail in json.loads(lineage.get("findings", "[]"))
        ]
        if findings:
            html.table(["run", "finding", "count", "detail"], findings, 2)
    part("Channels")
    html.table(
        ["topic", "message", "count", "from (s)", "to (s)"],
        [
            [
                escape(printable(t)),
                escape(c.schema),
                str(c.count),
                *(
                    "–" if ns is None else number((ns - rec.start_ns) / 1e9, 4)
                    for ns in (c.start_ns, c.end_ns)
                ),
            ]
            for t, c in rec.channels.items()
        ],
        2,
    )
    part("Provenance")
    for name, record in rec.metadata.items():
        if not name.startswith("run/"):
            html.parts.append(f"<details><summary>{escape(printable(name))}</summary>")
            html.table(["", ""], [[escape(printable(k)), escape(printable(v))] for k, v in record.items()], 2)
            html.parts.append("</details>")
    if rec.attachments:
        rows_ = [
            [escape(printable(a.name)), escape(printable(a.media_type)), str(a.size)] for a in rec.attachments
        ]
        html.table(["attachment", "kind", "bytes"], rows_, 2)


def write_page(
    recs: Sequence[Recording],
    path: Path,
    *,
    by: str | None = None,
    picture: bool = True,
    overwrite: bool = False,
    progress: Callable[[float, float], None] | None = None,
) -> Path:
    """Write the page of :func:`recordings_page`: whole or not at all.

    Raises
    ------
    OutputExists
        The file exists and ``overwrite`` is false.
    """
    from ..recording.atomic import AtomicFile

    file = AtomicFile(Path(path), overwrite=overwrite)
    try:
        page = recordings_page(recs, by=by, picture=picture, progress=progress)
        file.write(page.encode())
    except BaseException:
        file.abort()
        raise
    file.commit()
    return Path(path)
