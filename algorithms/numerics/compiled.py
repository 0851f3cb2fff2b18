"""How the kernels of this package are compiled.

Both decorators switch numba's reference counting off (``_nrt=False``). Counting is atomic, and numba counts
every array that is handed to a function which is not inlined and every view like ``rows[i]``: more than half
of a sample's time. The price is that such a function cannot create an array, which no kernel needs; the
caller keeps the arrays alive.
"""

from __future__ import annotations

from typing import Any

from numba import njit

_OPTIONS: dict[str, Any] = {"cache": True, "nogil": True, "_nrt": False}

compiled = njit(**_OPTIONS)
"""Decorator of a kernel, and of a function called by kernels, that creates no array."""

inlined = njit(**_OPTIONS, forceinline=True)
"""The same for a function that is inlined by force: a call hands over seven words an array and asks for an
exception afterwards, and inlined arguments become constants. For small functions, and for what runs with
every sample."""
