"""The film of a walk: a file beside the recording, one that is named, or an attachment of the recording."""

from __future__ import annotations

from pathlib import Path

from ...recording import Recording
from ...recording.errors import MarchaError

SUFFIXES = (".mp4", ".webm", ".m4v", ".mov", ".ogv")


class Video:
    """A film and where it begins.

    Parameters
    ----------
    name : str
        File name.
    source : Path or bytes
        The file, or what it holds.
    offset_s : float
        Time of the recording, in seconds from its start, at which the film begins.
    """

    def __init__(self, name: str, source: Path | bytes, offset_s: float = 0.0) -> None:
        self.name, self.source, self.offset_s = name, source, offset_s
        self.size = source.stat().st_size if isinstance(source, Path) else len(source)

    def read(self, start: int, stop: int) -> bytes:
        """Return bytes from ``start`` up to, not with, ``stop``."""
        if isinstance(self.source, bytes):
            return self.source[start:stop]
        with self.source.open("rb") as file:
            file.seek(start)
            return file.read(stop - start)


def video_of(rec: Recording, path: Path | None = None, offset_s: float = 0.0) -> Video | None:
    """Return the film of a recording, None where there is none.

    Parameters
    ----------
    rec : Recording
        An attachment whose media type is ``video/…``, or a file beside it with its name and one of
        :data:`SUFFIXES`, is taken where none is named.
    path : Path, optional
        The film.
    offset_s : float
        See :class:`Video`.

    Raises
    ------
    MarchaError
        There is no such file.
    """
    if path is not None:
        if not path.is_file():
            raise MarchaError(f"{path}: there is no such film; name a file a browser plays (.mp4, .webm)")
        return Video(path.name, path, offset_s)
    for attached in rec.attachments:
        if attached.media_type.startswith("video/"):
            return Video(attached.name, rec.attachment(attached.name), offset_s)
    beside = (rec.path.with_suffix(s) for s in SUFFIXES)
    file = next((p for p in beside if p.is_file()), None)
    return None if file is None else Video(file.name, file, offset_s)
