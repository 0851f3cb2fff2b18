"""Files of one simulated recording, written together."""

from __future__ import annotations

import contextlib
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from ...recording.errors import MarchaError, OutputExists


@contextmanager
def written_together(folder: Path, paths: Sequence[Path], *, overwrite: bool) -> Iterator[Path]:
    """Give a scratch folder to write into; at the end what it holds takes the places of ``paths``.

    Parameters
    ----------
    folder : Path
        Where the paths are; made where it is not there.
    paths : sequence of Path
        Files and folders, each written under its own name in the scratch folder.
    overwrite : bool
        Whether they may replace what is there.

    Raises
    ------
    OutputExists
        One of them is there already.
    MarchaError
        They cannot be written; nothing is left of them if that shows before the last step.
    """
    for path in paths:
        if path.exists() and not overwrite:
            raise OutputExists(path)
    new = not folder.exists()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder, prefix=".marcha-") as made:
            yield Path(made)
            for path in paths:
                if path.is_dir():
                    shutil.rmtree(path)
                (Path(made) / path.name).replace(path)
    except OSError as error:
        if new:
            with contextlib.suppress(OSError):
                folder.rmdir()
        reason = error.strerror or " ".join(str(error).split())
        raise MarchaError(f"{folder}: cannot write: {reason}; nothing was written") from error
