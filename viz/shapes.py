"""Shapes that several views draw: circles and ellipses, in metres and on the globe."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Times = NDArray[np.int64]

ELLIPSE95 = 2.4477468306808166
"""Half axes of the ellipse that holds 95 % of a normal distribution in the plane, in standard deviations:
the root of the 95 % quantile of chi-square with two degrees of freedom."""

CORNERS = 32
BEAT_NS = 200_000_000
"""Shapes about a moving point are drawn at most so often: a viewer shows no more."""

_ANGLES = np.linspace(0.0, 2 * np.pi, CORNERS + 1)
_UNIT = np.column_stack([np.cos(_ANGLES), np.sin(_ANGLES)])

EQUATOR_M = 6_378_137.0
ECCENTRICITY2 = 0.00669437999014
"""WGS 84."""


def circle(centre: Floats, axes: Floats) -> NDArray[np.float32]:
    """Return ellipses in the plane as closed lines.

    Parameters
    ----------
    centre : ndarray, shape (n, 3)
        Metres.
    axes : ndarray, shape (n, 2)
        Half axes along x and y, metres.

    Returns
    -------
    ndarray of float32, shape (n, CORNERS + 1, 3)
    """
    out = np.repeat(centre[:, None, :], CORNERS + 1, axis=1)
    out[:, :, :2] += axes[:, None, :] * _UNIT
    return out.astype(np.float32)


def geo_circle(lat_lon_deg: Floats, axes_m: Floats) -> Floats:
    """Return ellipses on the globe as closed lines, shape (n, CORNERS + 1, 2): latitude, longitude, degrees.

    Parameters
    ----------
    lat_lon_deg : ndarray, shape (n, 2)
        Centres.
    axes_m : ndarray, shape (n, 2)
        Half axes to the east and to the north, metres, small against the Earth.
    """
    metres = axes_m[:, None, :] * _UNIT
    return lat_lon_deg[:, None, :] + metres[:, :, ::-1] / metres_a_degree(lat_lon_deg[:, 0])[:, None, :]


def metres_a_degree(lat_deg: Floats) -> Floats:
    """Return the metres of one degree of latitude and of longitude, shape (n, 2), on the WGS 84 ellipsoid
    (radii of curvature in the meridian and in the prime vertical).
    """
    lat = np.radians(lat_deg)
    root = 1 - ECCENTRICITY2 * np.sin(lat) ** 2
    meridian = EQUATOR_M * (1 - ECCENTRICITY2) / root**1.5
    parallel = EQUATOR_M / np.sqrt(root) * np.cos(lat)
    return np.column_stack([meridian, parallel]) * np.pi / 180.0


def thinned(t_ns: Times, next_ns: int) -> tuple[NDArray[np.int64], int]:
    """Return which rows are at least :data:`BEAT_NS` apart, and when the next one is due."""
    kept = []
    index = 0
    while index < len(t_ns):
        index += int(np.searchsorted(t_ns[index:], next_ns))
        if index < len(t_ns):
            kept.append(index)
            next_ns = int(t_ns[index]) + BEAT_NS
            index += 1
    return np.array(kept, dtype=np.int64), next_ns
