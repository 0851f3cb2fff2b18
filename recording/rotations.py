"""Quaternion order: real part first in tables and NumPy, last in ROS messages and Rerun."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray


def xyzw_from_wxyz(quat: ArrayLike) -> NDArray[Any]:
    """Return quaternions ``(…, 4)`` with the real part last, given it first."""
    return np.roll(np.asarray(quat), -1, axis=-1)


def wxyz_from_xyzw(quat: ArrayLike) -> NDArray[Any]:
    """Return quaternions ``(…, 4)`` with the real part first, given it last."""
    return np.roll(np.asarray(quat), 1, axis=-1)
