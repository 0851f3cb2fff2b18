"""Cholesky's factor of a small positive definite matrix, and the solution with it, in place and without BLAS."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from .compiled import compiled

FloatArray = NDArray[np.float64]


@compiled
def factorize(L: FloatArray, n: int) -> bool:
    """Write the lower factor over the lower triangle of ``L`` (n, n); False where it is not positive definite.

    What stands above the diagonal is neither read nor written.
    """
    for j in range(n):
        for i in range(j, n):
            total = L[i, j]
            for k in range(j):
                total -= L[i, k] * L[j, k]
            if i == j:
                if total <= 0.0:
                    return False
                L[j, j] = math.sqrt(total)
            else:
                L[i, j] = total / L[j, j]
    return True


@compiled
def solve(L: FloatArray, n: int, x: FloatArray) -> None:
    """Write the solution of L Lᵀ x = b over b in ``x`` (n); ``L`` as :func:`factorize` leaves it."""
    for i in range(n):
        for k in range(i):
            x[i] -= L[i, k] * x[k]
        x[i] /= L[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            x[i] -= L[k, i] * x[k]
        x[i] /= L[i, i]
