"""Places on the Earth: tangent planes (compiled), UTM and convergence (pyproj), declination (WMM)."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from ..contract import FloatArray
from ..numerics.compiled import compiled

A_M = 6378137.0
"""Equatorial radius of WGS 84 (m)."""
F = 1.0 / 298.257223563
E2 = F * (2.0 - F)
"""Square of the first eccentricity (the source's table 2.2 prints it as e)."""

ORIGIN: list[tuple[Any, ...]] = [
    ("origin_set", "i8"),
    ("origin_ecef", "f8", (3,)),
    ("origin_sin", "f8", (2,)),  # of latitude and longitude
    ("origin_cos", "f8", (2,)),
]


@compiled
def ecef(lat: float, lon: float, alt: float) -> tuple[float, float, float]:
    """Return Earth-centred coordinates (m) of geodetic ones (rad, rad, m)."""
    sin_lat = math.sin(lat)
    n = A_M / math.sqrt(1.0 - E2 * sin_lat * sin_lat)
    across = (n + alt) * math.cos(lat)
    return across * math.cos(lon), across * math.sin(lon), (n * (1.0 - E2) + alt) * sin_lat


@compiled
def set_origin(s: Any, lat: float, lon: float, alt: float) -> None:
    """Put the tangent plane's origin (rad, rad, m) into record ``s``."""
    s.origin_set = 1
    s.origin_ecef[0], s.origin_ecef[1], s.origin_ecef[2] = ecef(lat, lon, alt)
    s.origin_sin[0], s.origin_cos[0] = math.sin(lat), math.cos(lat)
    s.origin_sin[1], s.origin_cos[1] = math.sin(lon), math.cos(lon)


@compiled
def to_enu(s: Any, lat: float, lon: float, alt: float) -> tuple[float, float, float]:
    """Return east, north, up (m) of a place in the plane of record ``s``."""
    x, y, z = ecef(lat, lon, alt)
    x, y, z = x - s.origin_ecef[0], y - s.origin_ecef[1], z - s.origin_ecef[2]
    sl, cl, so, co = s.origin_sin[0], s.origin_cos[0], s.origin_sin[1], s.origin_cos[1]
    out = co * x + so * y
    return co * y - so * x, cl * z - sl * out, cl * out + sl * z


@compiled
def from_enu(s: Any, east: float, north: float, up: float) -> tuple[float, float, float]:
    """Return latitude, longitude (rad) and height (m) of a place in the plane (Bowring, two rounds)."""
    sl, cl, so, co = s.origin_sin[0], s.origin_cos[0], s.origin_sin[1], s.origin_cos[1]
    out = cl * up - sl * north
    x = s.origin_ecef[0] + co * out - so * east
    y = s.origin_ecef[1] + so * out + co * east
    z = s.origin_ecef[2] + cl * north + sl * up
    p = math.sqrt(x * x + y * y)
    b = A_M * (1.0 - F)
    t = math.atan2(z * A_M, p * b)
    lat = 0.0
    for _ in range(2):
        lat = math.atan2(z + E2 * A_M * A_M / b * math.sin(t) ** 3, p - E2 * A_M * math.cos(t) ** 3)
        t = math.atan((1.0 - F) * math.tan(lat))
    sin_lat = math.sin(lat)
    n = A_M / math.sqrt(1.0 - E2 * sin_lat * sin_lat)
    height = p * math.cos(lat) + z * sin_lat - A_M * A_M / n
    return lat, math.atan2(y, x), height


class Grid(NamedTuple):
    """UTM coordinates of places.

    Attributes
    ----------
    zone, south : int, bool
        Of the first place; all others are in it.
    east_m, north_m : ndarray
        With false easting and northing (m), shape (n,).
    convergence_rad : ndarray
        Grid convergence: angle from true to grid north, clockwise positive.
    scale : ndarray
        Point scale factor.
    """

    zone: int
    south: bool
    east_m: FloatArray
    north_m: FloatArray
    convergence_rad: FloatArray
    scale: FloatArray


def utm(lat_deg: FloatArray, lon_deg: FloatArray) -> Grid:
    """Return UTM coordinates on WGS 84 (eqs 3.21–3.36), by PROJ.

    Parameters
    ----------
    lat_deg, lon_deg : ndarray
        Shape (n,), n ≥ 1.
    """
    from pyproj import Proj

    lat, lon = np.atleast_1d(lat_deg).astype(float), np.atleast_1d(lon_deg).astype(float)
    zone = int((lon[0] + 180.0) // 6.0) % 60 + 1
    proj = Proj(proj="utm", zone=zone, south=bool(lat[0] < 0), ellps="WGS84")
    east, north = proj(lon, lat)
    factors = proj.get_factors(lon, lat)
    return Grid(
        zone,
        bool(lat[0] < 0),
        np.asarray(east),
        np.asarray(north),
        np.radians(np.asarray(factors.meridian_convergence)),
        np.asarray(factors.meridional_scale),
    )


def from_utm(
    zone: int, south: bool, east_m: FloatArray, north_m: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return latitude and longitude (deg) of UTM coordinates.

    Shapes: both (n,) in m, results (n,).
    """
    from pyproj import Proj

    lon, lat = Proj(proj="utm", zone=zone, south=south, ellps="WGS84")(east_m, north_m, inverse=True)
    return np.asarray(lat), np.asarray(lon)


NO_EPOCH_NS = 946_684_800_000_000_000
"""Times before 2000 are a device's own; the field is then that of 2025 (it turns by about 0.1° a year)."""


def declination(lat_deg: float, lon_deg: float, alt_m: float, t_ns: int) -> float:
    """Return the magnetic declination (rad, east positive) by the World Magnetic Model of the date."""
    year = 2025.0
    if t_ns >= NO_EPOCH_NS:
        moment = datetime.fromtimestamp(t_ns / 1e9, UTC)
        year = moment.year + (moment.timetuple().tm_yday - 1) / 365.25
    alt = round(alt_m, -2) if math.isfinite(alt_m) else 0.0
    return _declination(round(lat_deg, 1), round(lon_deg, 1), alt, round(year, 1))


@lru_cache(maxsize=256)
def _declination(lat_deg: float, lon_deg: float, alt_m: float, year: float) -> float:
    """Cells of 0.1° and 0.1 year: within 0.05° of the model away from the magnetic poles."""
    epoch = 2025 if year >= 2025 else 2020 if year >= 2020 else 2015
    name = "wmm/WMM_2015v2.COF" if epoch == 2015 else f"wmm/WMM_{epoch}.COF"
    field = _model(name).calculate(
        glat=lat_deg, glon=lon_deg, alt=alt_m / 1000, time=year, allow_date_outside_lifespan=True
    )
    return math.radians(field.d)


@lru_cache(maxsize=3)
def _model(name: str) -> Any:
    from pygeomag import GeoMag

    return GeoMag(coefficients_file=name)
