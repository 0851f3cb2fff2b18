"""The Rerun stream behind a view: made, given its blueprint, ended, and its threads given back."""

from __future__ import annotations

import rerun as rr
import rerun.blueprint as rrb

from ..recording.atomic import AtomicFile
from ..recording.errors import MarchaError

APPLICATION = "marcha"


def new_stream(recording_id: str | None = None) -> rr.RecordingStream:
    """Return a stream with the time lines of the recordings and nothing of Rerun's own.

    Parameters
    ----------
    recording_id : str, optional
        Streams of one id are one recording in a viewer or a catalogue; each is its own without it.
    """
    stream = rr.RecordingStream(APPLICATION, recording_id=recording_id)
    stream.set_log_time_enabled(False)
    stream.set_log_tick_enabled(False)
    return stream


def send_blueprint(stream: rr.RecordingStream, blueprint: rrb.Blueprint, *, make_active: bool = True) -> None:
    """Send a blueprint to the stream's sinks.

    Rerun's own ``send_blueprint`` keeps a stream of two threads for each blueprint for good: the memory
    behind it and the stream hold each other. Here it is disconnected, which ends that.
    """
    import rerun_bindings as bindings

    native = bindings.new_blueprint(
        application_id=APPLICATION, make_default=False, make_thread_default=False, default_enabled=True
    )
    drawn = rr.RecordingStream._from_native(native)
    drawn.set_time("blueprint", sequence=0)
    blueprint._log_to_stream(drawn)
    memory = drawn.memory_recording()  # type: ignore[attr-defined]
    bindings.send_blueprint(memory.storage, make_active, True, recording=stream.to_native())
    drawn.disconnect()


def finish(stream: rr.RecordingStream, file: AtomicFile | None = None) -> None:
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


def release() -> None:
    """Give back the threads and memory of streams that nobody refers to any more.

    Rerun keeps every stream in a list of its own until this is asked for. To be called where the caller has
    let go of its stream.
    """
    import rerun_bindings as bindings

    bindings.flush_and_cleanup_orphaned_recordings()


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
