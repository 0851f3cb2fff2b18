"""One buffer of bytes, seen as NumPy structured records: how kernels keep their state.

A kernel takes an array of one record and writes ``s = state[0]``, then ``s.P[i, j]``, ``s.vel[i]``, as the
equations have it. Copying the buffer is a snapshot, writing it back is a seek. Field names must not be those
of a NumPy scalar's methods (``mean``, ``all``, ``T`` …): interpreted, the method would win.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import config
from numpy.typing import NDArray

Fields = list[tuple[Any, ...]]
"""Fields of a record as :class:`numpy.dtype` takes them: (name, format) or (name, format, shape)."""


def record_type(*fields: tuple[Any, ...]) -> np.dtype[Any]:
    """Return the record type with these fields, laid out as a C struct would be.

    Raises
    ------
    ValueError
        Where a field is called like an attribute of a NumPy scalar.
    """
    for name, *_ in fields:
        if hasattr(np.void, name):
            raise ValueError(f"field {name!r}: NumPy scalars have an attribute of that name")
    return np.dtype(list(fields), align=True)


def attributes(records: NDArray[Any]) -> Any:
    """Return the same records with their fields as attributes, for code that is not compiled.

    Shapes: both (n,).
    """
    return records.view(np.recarray)


def kernel_view(buffer: NDArray[np.uint8], dtype: np.dtype[Any], first: int, count: int = 1) -> NDArray[Any]:
    """Return ``count`` records from byte ``first`` of ``buffer`` on, as a kernel takes them.

    Shapes: ``buffer`` (bytes,), result (count,).

    Compiled code finds fields by the type; where numba is switched off, Python needs them as attributes.
    """
    records = buffer[first : first + count * dtype.itemsize].view(dtype)
    return attributes(records) if getattr(config, "DISABLE_JIT", 0) else records
