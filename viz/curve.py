"""One number over time, kept small enough for any length."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Times = NDArray[np.int64]

LIMIT = 200_000
"""Samples kept; beyond it every second one goes."""


class Curve:
    """Values over time, thinned evenly once they exceed :data:`LIMIT`."""

    def __init__(self) -> None:
        self._t: list[Times] = []
        self._v: list[Floats] = []
        self._stride, self._seen, self.count = 1, 0, 0

    def add(self, t_ns: Times, values: Floats) -> None:
        """Append values (n,)."""
        first = -self._seen % self._stride
        self._seen += len(t_ns)
        self._t.append(t_ns[first :: self._stride])
        self._v.append(values[first :: self._stride])
        self.count += len(self._t[-1])
        while self.count > LIMIT:
            self._t, self._v = [np.concatenate(self._t)[::2]], [np.concatenate(self._v)[::2]]
            self._stride *= 2
            self.count = len(self._t[0])

    def finite(self) -> tuple[Times, Floats]:
        """Return times (n,), strictly ascending, and values (n,) that are finite."""
        if not self._t:
            return np.empty(0, np.int64), np.empty(0)
        t, v = np.concatenate(self._t), np.concatenate(self._v)
        keep = np.isfinite(v)
        t, once = np.unique(t[keep], return_index=True)
        return t, v[keep][once]
