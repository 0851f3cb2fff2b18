"""Turns of a chain's segments."""

from __future__ import annotations

import math
from typing import Any

from ..numerics.compiled import compiled


@compiled
def turn(s: Any, i: int, a: float, b: float, c: float, right: bool) -> None:
    """Multiply ``s.rot[i]`` by exp([a b c]×) from the right (body) or left."""
    size = math.sqrt(a * a + b * b + c * c)
    f = math.sin(size) / size if size > 1e-9 else 1.0
    h = (1.0 - math.cos(size)) / (size * size) if size > 1e-9 else 0.5
    e00, e01, e02 = 1.0 - h * (b * b + c * c), h * a * b - f * c, h * a * c + f * b
    e10, e11, e12 = h * a * b + f * c, 1.0 - h * (a * a + c * c), h * b * c - f * a
    e20, e21, e22 = h * a * c - f * b, h * b * c + f * a, 1.0 - h * (a * a + b * b)
    r = s.rot
    for k in range(3):
        if right:
            x, y, z = r[i, k, 0], r[i, k, 1], r[i, k, 2]
            r[i, k, 0] = x * e00 + y * e10 + z * e20
            r[i, k, 1] = x * e01 + y * e11 + z * e21
            r[i, k, 2] = x * e02 + y * e12 + z * e22
        else:
            x, y, z = r[i, 0, k], r[i, 1, k], r[i, 2, k]
            r[i, 0, k] = e00 * x + e01 * y + e02 * z
            r[i, 1, k] = e10 * x + e11 * y + e12 * z
            r[i, 2, k] = e20 * x + e21 * y + e22 * z


@compiled
def square(s: Any, i: int) -> None:
    """Take rounding out of ``s.rot[i]``: Gram-Schmidt on its rows."""
    r = s.rot
    for k in range(2):
        size = math.sqrt(r[i, k, 0] ** 2 + r[i, k, 1] ** 2 + r[i, k, 2] ** 2)
        for m in range(3):
            r[i, k, m] /= size
        if k == 0:
            dot = r[i, 0, 0] * r[i, 1, 0] + r[i, 0, 1] * r[i, 1, 1] + r[i, 0, 2] * r[i, 1, 2]
            for m in range(3):
                r[i, 1, m] -= dot * r[i, 0, m]
    r[i, 2, 0] = r[i, 0, 1] * r[i, 1, 2] - r[i, 0, 2] * r[i, 1, 1]
    r[i, 2, 1] = r[i, 0, 2] * r[i, 1, 0] - r[i, 0, 0] * r[i, 1, 2]
    r[i, 2, 2] = r[i, 0, 0] * r[i, 1, 1] - r[i, 0, 1] * r[i, 1, 0]
