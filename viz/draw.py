"""Recordings into one Rerun stream: which clock, which colours, in which order."""

from __future__ import annotations

from collections.abc import Sequence

import rerun as rr

from ..recording import Recording
from ..recording.atomic import AtomicFile
from ..recording.errors import MarchaError
from ..recording.selection import Selection, selected_topics, within
from .blueprint import blueprint, extent
from .plan import log_plan
from .report import report
from .scene import Clock, Scene

APPLICATION = "marcha"

EPOCH_NS = 10**17
"""Times below this (March 1973) cannot be the epoch's: they count from a device's own zero."""


def new_stream() -> rr.RecordingStream:
    """Return a stream with the one time line of the recordings and nothing of Rerun's own."""
    stream = rr.RecordingStream(APPLICATION)
    stream.set_log_time_enabled(False)
    stream.set_log_tick_enabled(False)
    return stream


def clock_of(recs: Sequence[Recording]) -> list[Clock]:
    """Return the clock of every recording.

    One recording keeps its own time. Several that overlap in time share it; several of different days are
    laid on each other, each from its own start, or their plots would be points in an empty year.
    """
    starts, ends = [rec.start_ns or 0 for rec in recs], [rec.end_ns or 0 for rec in recs]
    clocks = [
        clock_from(start, rec.metadata.get("device", {}).get("clock", ""))
        for rec, start in zip(recs, starts, strict=True)
    ]
    if len(set(clocks)) == 1 and max(starts) <= min(ends):
        return clocks
    return [Clock("duration", start) for start in starts]


def clock_from(t_ns: int, said: str = "") -> Clock:
    """Return the clock of a recording that begins at ``t_ns``; ``said`` is what its metadata calls its
    clock.
    """
    if said == "device" or (not said and t_ns < EPOCH_NS):
        return Clock("duration")
    return Clock("timestamp")


def draw(
    recs: Sequence[Recording],
    stream: rr.RecordingStream,
    selection: Selection | None = None,
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

    Returns
    -------
    list of Scene
        One a recording.
    """
    selection = selection or Selection()
    topics = [selected_topics(rec, selection) for rec in recs]
    stream.send_recording_name(", ".join(rec.path.stem for rec in recs))
    prefixes = [""] if len(recs) == 1 else prefixes_of(recs)
    scenes: list[Scene] = []
    for rec, chosen, clock, prefix in zip(recs, topics, clock_of(recs), prefixes, strict=True):
        channels = [rec.channels[t] for t in chosen]
        scene = Scene(stream, channels, clock, prefix, first_color=sum(len(s.runs) or 1 for s in scenes))
        scene.begin()
        for window in rec.windows(chosen, start_ns=selection.start_ns, end_ns=selection.end_ns):
            for topic, table in window.tables.items():
                scene.write(topic, table)
        scene.annotate(within(rec.annotations, selection))
        scene.end()
        text = rr.TextDocument(report(rec), media_type=rr.MediaType.MARKDOWN)
        scene.static(f"{scene.prefix}/report", text)
        scenes.append(scene)
    log_plan(stream, *extent(scenes))
    stream.send_blueprint(blueprint(scenes))
    return scenes


def finish(stream: rr.RecordingStream, file: AtomicFile | None) -> None:
    """Send what is pending, end the stream, and make sure that its file, if any, is whole.

    Raises
    ------
    MarchaError
        The file cannot be written, or the viewer went away; nothing is left.
    """
    try:
        stream.flush()
        stream.disconnect()
    except RuntimeError as error:  # the thread behind a sink is gone
        if file is None:
            raise MarchaError(f"the viewer went away: {error}") from None
        file.abort()
        raise MarchaError(f"{file.path}: not written whole (is the disk full?): {error}") from None
    if file is not None:
        check_whole(file)


def check_whole(file: AtomicFile) -> None:
    """Make sure that a written ``.rrd`` ends as it should: Rerun only logs what its file sink cannot write.

    Raises
    ------
    MarchaError
        It does not; nothing is left.
    """
    import warnings

    from rerun.chunk import RrdReader

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # it warns of what is raised here
            RrdReader(file.part).store()
    except Exception as error:
        file.abort()
        reason = str(error).splitlines()[0]
        raise MarchaError(f"{file.path}: not written whole (is the disk full?): {reason}") from None


def prefixes_of(recs: Sequence[Recording]) -> list[str]:
    """Return one entity prefix a recording: its file's name, numbered where two are alike."""
    names = [rec.path.stem for rec in recs]
    return [
        f"/{n}" if names.count(n) == 1 else f"/{n}-{names[: i + 1].count(n)}" for i, n in enumerate(names)
    ]
