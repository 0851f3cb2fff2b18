"""Saved views: a ``.rrd`` file with its blueprint."""

from __future__ import annotations

from collections.abc import Sequence
from hashlib import blake2b
from pathlib import Path
from typing import ClassVar

import msgspec

from ..recording import Recording
from ..recording.atomic import AtomicFile
from ..recording.provenance import hash_file
from ..recording.selection import Selection


def write_rrd(
    recs: Recording | Sequence[Recording],
    path: Path | str,
    overwrite: bool = False,
    *,
    selection: Selection | None = None,
) -> Path:
    """Write what the viewer shows of one or several recordings, with its blueprint, into one file.

    Parameters
    ----------
    recs : Recording or sequence of Recording
        Several are shown together, each below its own name.
    path : path
        The ``.rrd``; there whole or not at all.
    overwrite : bool
        Whether an earlier file may be replaced.
    selection : Selection, optional
        Topics and range of time; everything by default.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    OutputExists
        It exists and ``overwrite`` is false.
    UsageError
        A topic that a recording does not have.
    MarchaError
        A recording cannot be read, or the file not written.
    """
    recs = [recs] if isinstance(recs, Recording) else list(recs)
    file = AtomicFile(Path(path), overwrite=overwrite)
    try:
        import rerun as rr

        from .draw import draw
        from .stream import finish, new_stream, release

        stream = new_stream(_identity(recs, selection))
        stream.set_sinks(rr.FileSink(file.part))
        draw(recs, stream, selection)
        finish(stream, file)
        del stream
        release()
    except BaseException:
        file.abort()
        raise
    file.commit()
    return Path(path)


def _identity(recs: Sequence[Recording], selection: Selection | None) -> str:
    """Return an id that is the same whenever the same of the same files is written: a hash of their content."""
    parts = [hash_file(rec.path) for rec in recs]
    chosen = "" if selection is None else msgspec.json.encode(selection).decode()
    if len(parts) == 1 and (selection is None or (selection.whole and not selection.topics)):
        return parts[0]
    return blake2b("\n".join([*parts, chosen]).encode(), digest_size=16).hexdigest()


class RrdExporter:
    """Rerun recording with its blueprint, for ``marcha export --to rrd``."""

    name: ClassVar[str] = "rrd"
    title: ClassVar[str] = "Rerun recording with its blueprint: opens in the Rerun viewer as marcha shows it"
    suffix: ClassVar[str] = ".rrd"
    Options: ClassVar[type[msgspec.Struct]] = Selection

    def export(
        self, rec: Recording, path: Path, options: Selection, *, overwrite: bool = False
    ) -> list[Path]:
        """Write the file; see :class:`marcha.export.Exporter`."""
        return [write_rrd(rec, path, overwrite, selection=options)]
