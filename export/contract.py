"""What an exporter is."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar, Protocol

import msgspec

from ..recording import Recording


class Exporter(Protocol):
    """One way out of a recording: a module a format, registered as an entry point ``marcha.exporters``.

    ``tests/contracts/exporter.py`` is the test that every exporter inherits.

    Attributes
    ----------
    name : str
        What ``marcha export --to`` asks for.
    title : str
        One line for a list of formats: what is written and for whom.
    suffix : str
        Suffix of the file, with the dot; empty where a folder is written.
    Options : type of msgspec.Struct
        Options with their defaults, unit and effect.
    """

    name: ClassVar[str]
    title: ClassVar[str]
    suffix: ClassVar[str]
    Options: ClassVar[type[msgspec.Struct]]

    def losses(self, rec: Recording, options: Any) -> list[str]:
        """Return what of this recording the format cannot hold, a line each; it is said before writing.

        Parameters
        ----------
        rec, options
            See :meth:`export`.
        """
        ...

    def export(self, rec: Recording, path: Path, options: Any, *, overwrite: bool = False) -> list[Path]:
        """Write ``rec`` to ``path``: the whole of it, or nothing.

        Parameters
        ----------
        rec : Recording
            What to write; never changed.
        path : Path
            A file, or the folder that will hold the files.
        options : msgspec.Struct
            An instance of ``Options``.
        overwrite : bool
            Whether an earlier export at ``path`` may be replaced.

        Returns
        -------
        list of Path
            The files that were written, in the order of reading.

        Raises
        ------
        OutputExists
            ``path`` exists and ``overwrite`` is false.
        UsageError
            An option names what the recording does not have.
        """
        ...
