"""What a recording is: typed channels in one MCAP file, read and written as tables.

>>> import marcha.recording as mr
>>> rec = mr.open("walk.mcap")
>>> imu = rec.table("/foot/imu1")
>>> with mr.create("copy.mcap") as out:
...     out.add_table("/foot/imu1", "sensor_msgs/msg/Imu", imu, frame_id="imu1")
"""

from __future__ import annotations

from pathlib import Path

from .errors import (
    Finding,
    MarchaError,
    OutputExists,
    UsageError,
)
from .mcapfile import ZSTD_LEVEL
from .model import Attachment, Channel, RecordedMessage, Window
from .reader import Recording
from .schemas import SCHEMAS, Column, Schema
from .writer import Writer

__all__ = [
    "SCHEMAS",
    "Attachment",
    "Channel",
    "Column",
    "Finding",
    "MarchaError",
    "OutputExists",
    "RecordedMessage",
    "Recording",
    "Schema",
    "UsageError",
    "Window",
    "Writer",
    "create",
    "open",
]


def open(path: Path | str) -> Recording:
    """Open a recording for reading.

    A recording without a footer, or with damaged chunks, is read as far as it is sound; what was lost is in
    ``findings``.

    Raises
    ------
    MarchaError
        No such file, or nothing in it can be read: one line that names the file.
    """
    return Recording(path)


def create(path: Path | str, *, overwrite: bool = False, level: int | None = ZSTD_LEVEL) -> Writer:
    """Open a recording for writing; nothing is at ``path`` until the ``with`` block ends well.

    Parameters
    ----------
    path : path
        The recording.
    overwrite : bool
        Whether it may be replaced.
    level : int or None
        Compression level of zstd; None does not compress. The default suits raw readings; the low bits of
        computed numbers are noise that no level shortens.

    Raises
    ------
    OutputExists
        ``path`` is there, and ``overwrite`` is false.
    MarchaError
        The folder is missing or cannot be written.
    """
    return Writer(path, overwrite=overwrite, level=level)
