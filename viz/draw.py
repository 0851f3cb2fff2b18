"""Recordings into one Rerun stream: which times, which colours, in which order."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

import rerun as rr

from ..recording import Recording
from ..recording.errors import UsageError
from ..recording.selection import Selection, selected_topics, within
from ..replay import Evaluation
from .blueprint import blueprint, extent
from .canvas import FIGURES, Canvas, entity
from .figures import figure
from .floor import loaders_of
from .report import measured, report
from .scene import Scene
from .stream import send_blueprint
from .text import printable
from .timeaxis import axes_of
from .top_view import log_top_view


def draw(
    recs: Sequence[Recording],
    stream: rr.RecordingStream,
    selection: Selection | None = None,
    *,
    annotating: bool = False,
) -> list[Scene]:
    """Log recordings, their reports and the blueprint into a stream that has its sinks.

    Parameters
    ----------
    recs : sequence of Recording
        One, or several to be shown together.
    stream : rerun.RecordingStream
        Where to log.
    selection : Selection, optional
        Topics and range of log times; everything by default.
    annotating : bool
        Whether annotations are to come: panels for them are there, and the time panel is open.

    Returns
    -------
    list of Scene
        One a recording.
    """
    selection = selection or Selection()
    topics = [selected_topics(rec, selection) for rec in recs]
    stream.send_recording_name(printable(", ".join(rec.path.stem for rec in recs)))
    prefixes = [""] if len(recs) == 1 else prefixes_of(recs)
    scenes: list[Scene] = []
    for rec, chosen, axis, prefix in zip(recs, topics, axes_of(recs), prefixes, strict=True):
        canvas = Canvas(
            stream,
            [rec.channels[t] for t in chosen],
            axis,
            prefix,
            first_color=sum(len(s.canvas.runs) or 1 for s in scenes),
            metadata=rec.metadata,
            attachments=loaders_of(rec),
        )
        scene = Scene(canvas)
        scene.begin()
        for window in rec.windows(chosen, start_ns=selection.start_ns, end_ns=selection.end_ns):
            for topic, table in window.tables.items():
                scene.write(topic, table)
        scene.annotate(within(rec.annotations, selection))
        if annotating:
            scene.lanes.show()
        scene.end()
        if canvas.plan.anchors:
            draw_figures(canvas, rec)
        metrics = measured(rec)
        send_facts(stream, rec, metrics, prefix)
        text = rr.TextDocument(report(rec, metrics), media_type=rr.MediaType.MARKDOWN)
        canvas.static(f"{canvas.prefix}/report", text)
        scenes.append(scene)
    canvases = [scene.canvas for scene in scenes]
    log_top_view(stream, *extent(canvases))
    send_blueprint(stream, blueprint(canvases, ruler=annotating))
    return scenes


ON_A_PLAN = ("radio", "error", "powers", "radiomap", "geometry")
"""Figures of a floor that are no curves over time and no lines in space: histograms, powers over distance,
distributions, maps. The viewer shows them as pictures; live, they come with the saved view."""


def draw_figures(canvas: Canvas, rec: Recording) -> None:
    """Log the figures of a floor as pictures, those for which the recording has something."""
    for kind in ON_A_PLAN:
        try:
            drawn = figure(rec, kind=kind)
        except UsageError:
            continue
        data = io.BytesIO()
        drawn.savefig(data, format="png", metadata={"Software": None})
        path = f"{canvas.prefix}/figure/{kind}"
        canvas.static(path, rr.EncodedImage(contents=data.getvalue(), media_type="image/png"))
        canvas.show("picture", path, tab=FIGURES, panel=f"{canvas.prefix[1:]} {kind}".strip())


OF_THE_WALK = ("truth", "subject")
"""Metadata records that become properties of the viewer's recording."""


def send_facts(
    stream: rr.RecordingStream, rec: Recording, metrics: Evaluation | str, prefix: str = ""
) -> None:
    """Send metrics, subject and truth as properties, so that recordings can be sorted and chosen by them.

    Parameters
    ----------
    stream : rerun.RecordingStream
        Where to.
    rec : Recording
        The recording.
    metrics : Evaluation or str
        Of its runs; a text says why there are none.
    prefix : str
        Entity path of the recording among several.
    """
    begin = f"{prefix[1:]} " if prefix else ""
    for name in OF_THE_WALK:
        texts = {
            printable(k): v for k, v in rec.metadata.get(name, {}).items() if k
        }  # Rerun knows no empty name
        facts: dict[str, Any] = {k: _of_one_type(k, _fact(v)) for k, v in texts.items()}
        if facts:
            stream.send_property(f"{begin}{name}", rr.AnyValues(**facts))
    for run in metrics.runs if not isinstance(metrics, str) else ():
        values: dict[str, Any] = {k: _of_one_type(k, v) for k, v in run.metrics.items()}
        if values:
            stream.send_property(f"{begin}metrics {run.run}", rr.AnyValues(**values))


def _fact(text: str) -> float | str:
    """Return a number as one: recordings are sorted by it."""
    try:
        return float(text)
    except ValueError:
        return printable(text)


_TYPES: dict[str, type] = {}
"""The first type that was sent under a name: Rerun keeps it for the whole process."""


def _of_one_type(name: str, value: float | str) -> float | str:
    """Return a fact in the type of its name: a text where numbers are is missing."""
    kind = _TYPES.setdefault(name, type(value))
    if isinstance(value, kind):
        return value
    return str(value) if kind is str else float("nan")


def prefixes_of(recs: Sequence[Recording]) -> list[str]:
    """Return one entity prefix a recording: its file's name, numbered where two are alike."""
    names = [rec.path.stem for rec in recs]
    return [
        entity(f"/{n}" if names.count(n) == 1 else f"/{n}-{names[: i + 1].count(n)}")
        for i, n in enumerate(names)
    ]
