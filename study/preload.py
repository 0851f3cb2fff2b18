"""What the processes of a study need, loaded once by the server that they are forked from.

Importing this module does it: that is how :mod:`multiprocessing` has a server prepare itself.
"""

from __future__ import annotations

import contextlib
import os

from .executors import ESTIMATORS


def _load() -> None:
    from . import cells, figures  # noqa: F401

    for name in os.environ.get(ESTIMATORS, "").split():
        with contextlib.suppress(Exception):  # its first cell says what is wrong with it
            cells.warm(name)


_load()
