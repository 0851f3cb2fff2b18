"""What surrounds a simulated phone: the Earth's field and what disturbs it, satellites, air."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import TYPE_CHECKING

import numpy as np
import polars as pl
from numpy.typing import NDArray

from .gait import FloatArray
from .phone_motion import Phone, Schedule, Walker

if TYPE_CHECKING:
    from .phone import PhoneOptions

RADIAL_68 = float(np.sqrt(-2 * np.log(0.32)))
"""Radius that holds 68 % of a plane's Gaussian of unit standard deviation an axis: what phones state."""
SEA_LEVEL_PA = 101_325.0


def earth_field(lat_deg: float, lon_deg: float, alt_m: float, t_ns: int) -> FloatArray:
    """Return the Earth's magnetic field (T): east, true north, up; World Magnetic Model of the date."""
    from pygeomag import GeoMag

    moment = datetime.fromtimestamp(t_ns / 1e9, UTC)
    year = moment.year + (moment.timetuple().tm_yday - 1) / 366
    model = next((y for y in (2025, 2020, 2015) if year >= y), 2015)
    name = {2015: "wmm/WMM_2015v2.COF"}.get(model, f"wmm/WMM_{model}.COF")
    field = GeoMag(coefficients_file=name).calculate(
        glat=lat_deg, glon=lon_deg, alt=alt_m / 1000, time=year, allow_date_outside_lifespan=True
    )
    return np.array([field.y, field.x, -field.z]) * 1e-9


def magnetic_disturbance(
    ground: FloatArray,
    total_m: float,
    plan: Schedule,
    t: FloatArray,
    strength_t: float,
    count: int,
    rng: np.random.Generator,
) -> FloatArray:
    """Return the field (T, in n) of iron near the way: bumps of 8 m at ``count`` places; zero where none.

    Shapes: ``ground`` (n, 3) in m, ``t`` (n,) in s, result (n, 3).
    """
    out = np.zeros((len(t), 3))
    if not strength_t or not len(plan.contact_s):
        return out
    way = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(ground, axis=0), axis=1))))
    for k in range(count):
        middle = (k + rng.uniform(0.3, 0.7)) / count * total_m
        direction = rng.standard_normal(3)
        direction /= np.linalg.norm(direction)
        turn = rng.standard_normal(3)
        u = (way - middle) / 4.0
        near = np.where(np.abs(u) < 1, (1 - np.minimum(u * u, 1)) ** 2, 0.0)
        out += strength_t * near[:, None] * (direction + 0.5 * u[:, None] * turn)
    return out


def fixes_of(
    walker: Walker,
    o: PhoneOptions,
    start_ns: int,
    end_s: float,
    rng: np.random.Generator,
    velocity_rng: np.random.Generator,
) -> pl.DataFrame:
    """Return the fixes: truth, a slow first-order Gauss-Markov error and a white one, losses, outliers."""
    from scipy.signal import lfilter

    rate = o.gnss_hz
    t = np.arange(0.3, end_s, 1 / rate) if rate else np.zeros(0)
    truth = walker.ground(t) if len(t) else np.zeros((0, 3))
    axes = np.array([1.0, 1.0, o.gnss_alt_factor])
    keep = np.exp(-1 / (max(rate, 1e-9) * o.gnss_tau_s))
    draws = rng.standard_normal((len(t), 3))
    draws[1:] *= np.sqrt(1 - keep**2)
    slow = np.asarray(lfilter([1.0], [1.0, -keep], draws, axis=0)) if len(t) else draws
    error = (o.gnss_sigma_m * slow + o.gnss_noise_m * rng.standard_normal((len(t), 3))) * axes
    for outlier_s, size in o.gnss_outliers:
        if len(t):
            angle = rng.uniform(0, 2 * np.pi)
            error[np.argmin(np.abs(t - outlier_s)), :2] += size * np.array([np.cos(angle), np.sin(angle)])
    lost = np.zeros(len(t), dtype=bool)
    for begin, length in o.gnss_loss:
        lost |= (t >= begin) & (t < begin + length)
    reported = (truth + error)[~lost]
    sigma = float(np.hypot(o.gnss_sigma_m, o.gnss_noise_m))
    lat, lon = geodetic(o, reported)
    one = np.full(len(reported), sigma)
    return pl.DataFrame(
        {
            "t_ns": start_ns + np.round(t[~lost] * 1e9).astype(np.int64),
            "lat_deg": lat,
            "lon_deg": lon,
            "alt_m": o.alt_m + reported[:, 2],
            "sd_east_m": one,
            "sd_north_m": one,
            "sd_up_m": one * o.gnss_alt_factor,
            "east_m": truth[~lost, 0],
            "north_m": truth[~lost, 1],
            "up_m": truth[~lost, 2],
        }
        | _velocities(walker, o, t, velocity_rng, ~lost)
    )


def _velocities(
    walker: Walker, o: PhoneOptions, t: FloatArray, rng: np.random.Generator, kept: NDArray[np.bool_]
) -> dict[str, FloatArray]:
    """Return the receiver's velocity (m/s): the mean over the second before, with a white error."""
    if not len(t):
        return {"vel_east": t, "vel_north": t}
    mean = walker.ground(t)[:, :2] - walker.ground(np.maximum(t - 1.0, 0.0))[:, :2]
    error = o.gnss_velocity_sigma * rng.standard_normal((len(t), 2))
    return dict(zip(("vel_east", "vel_north"), (mean + error)[kept].T, strict=True))


def geodetic(o: PhoneOptions, place: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return latitude and longitude (deg) of places east and north of the start (m), shape (n, ≥ 2)."""
    from pyproj import Geod

    lon, lat, _ = Geod(ellps="WGS84").fwd(
        np.full(len(place), o.lon_deg),
        np.full(len(place), o.lat_deg),
        np.degrees(np.arctan2(place[:, 0], place[:, 1])),
        np.hypot(place[:, 0], place[:, 1]),
    )
    return np.asarray(lat, dtype=np.float64), np.asarray(lon, dtype=np.float64)


def pressure_of(
    phone: Phone, o: PhoneOptions, start_ns: int, end_s: float, rng: np.random.Generator
) -> pl.DataFrame:
    """Return the barometer: standard atmosphere at the phone's height, slow weather, noise."""
    t = np.arange(0.05, end_s, 1 / o.pressure_hz) if o.pressure_hz else np.zeros(0)
    height = o.alt_m + (phone.position(t)[:, 2] if len(t) else t)
    pressure = SEA_LEVEL_PA * (1 - 2.25577e-5 * height) ** 5.25588
    weather = 12.0 * np.sin(2 * np.pi * (t / 1800 + rng.random()))
    noise = o.pressure_noise_pa * rng.standard_normal(len(t))
    return pl.DataFrame(
        {
            "t_ns": start_ns + np.round(t * 1e9).astype(np.int64),
            "pressure_pa": np.round(pressure + weather + noise, 2),
        }
    )
