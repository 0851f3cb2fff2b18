"""What fixes of phones share: places that are none, packed and rounded ones, accuracy, the receiver's velocity."""

from __future__ import annotations

import numpy as np
import polars as pl

from .contract import ChannelSpec, ReportBuilder, SourceAttachment

VECTOR = "geometry_msgs/msg/Vector3Stamped"
RADIAL_68 = float(np.sqrt(-2 * np.log(0.32)))
"""Radius of 68 % of a plane's Gaussian, in standard deviations of an axis: phones state that radius."""
PACKED_S, PACKED_MPS, PACKED_RUN = 0.2, 10.0, 3
"""So many fixes in a row, faster than 5 Hz and further apart than a pedestrian goes, have no times."""


def finished_fixes(
    topic: str, fixes: pl.DataFrame, report: ReportBuilder, attachments: list[SourceAttachment]
) -> pl.DataFrame:
    """Return fixes in the columns of NavSatFix, with what is wrong about them reported.

    Parameters
    ----------
    topic : str
        Of the channel.
    fixes : polars.DataFrame
        ``t_ns, line, lat, lon`` and where given ``alt, accuracy, vertical`` (m, 68 %).
    report : ReportBuilder
        Takes what is found.
    attachments : list of SourceAttachment
        Takes positions without times.
    """
    lat, lon = fixes["lat"].to_numpy(), fixes["lon"].to_numpy()
    bad = (np.abs(lat) > 90) | (np.abs(lon) > 180) | ((lat == 0) & (lon == 0))
    if bad.any():
        report.loss(
            "no_fix",
            f"{topic}: latitude {lat[bad][0]:g}, longitude {lon[bad][0]:g} is no place: no message",
            count=int(bad.sum()),
            line=int(fixes["line"][int(np.argmax(bad))]),
            subject=topic,
        )
        fixes = fixes.filter(pl.Series(~bad))
    fixes = _without_packed(topic, fixes, report, attachments)
    _coarse(topic, fixes, report)
    nothing = np.full(fixes.height, np.nan)
    stated = {}
    for name in ("accuracy", "vertical"):
        if name not in fixes.columns:
            stated[name] = nothing
            continue
        value = fixes[name].to_numpy()
        none = value <= 0
        if none.any():
            report.note(
                "missing_cell",
                f"{topic} {name}: {value[none][0]:g} says that there is none: missing",
                count=int(none.sum()),
                line=int(fixes["line"][int(np.argmax(none))]),
                subject=f"{topic} {name}",
            )
        stated[name] = np.where(none, np.nan, value)
    out = {"lat_deg": fixes["lat"], "lon_deg": fixes["lon"]}
    if "alt" in fixes.columns:
        out["alt_m"] = fixes["alt"]
    table = fixes.select("t_ns", "line").with_columns(**out)
    if not np.isnan(stated["accuracy"]).all():
        side = pl.Series(stated["accuracy"] / RADIAL_68)
        table = table.with_columns(sd_east_m=side, sd_north_m=side, sd_up_m=pl.Series(stated["vertical"]))
    return table


def velocity_spec(topic: str) -> ChannelSpec:
    """Return the channel of the receiver's velocity beside the fixes of ``topic``."""
    about = {"source": "speed and course of the fixes", "axes": "x east, y true north; z is not measured"}
    return ChannelSpec(f"{topic}_velocity", VECTOR, "enu", ("vel_x", "vel_y", "vel_z"), metadata=about)


def velocities(fixes: pl.DataFrame) -> pl.DataFrame:
    """Return the velocities (m/s, east and north) of fixes that have one.

    Apps write -1, nothing, or 0 and 0 where there is none; a course of exactly 0 is none, too.
    """
    speed, course = fixes["speed"].to_numpy(), np.radians(fixes["course"].to_numpy())
    there = np.isfinite(speed) & (speed >= 0) & (course > 0) & (course <= 2 * np.pi)
    nothing = np.full(fixes.height, np.nan)
    table = {"vel_x": speed * np.sin(course), "vel_y": speed * np.cos(course), "vel_z": nothing}
    return fixes.select("t_ns").with_columns(**{k: pl.Series(v) for k, v in table.items()}).filter(there)


def _without_packed(
    topic: str, fixes: pl.DataFrame, report: ReportBuilder, attachments: list[SourceAttachment]
) -> pl.DataFrame:
    """Return the fixes without those that stand on rows too fast to be their times."""
    if fixes.height < PACKED_RUN:
        return fixes
    lat, lon = np.radians(fixes["lat"].to_numpy()), np.radians(fixes["lon"].to_numpy())
    dt = np.diff(fixes["t_ns"].to_numpy()) / 1e9
    metres = 6.371e6 * np.hypot(np.diff(lat), np.diff(lon) * np.cos(lat[:-1]))
    fast = (dt < PACKED_S) & (metres > PACKED_MPS * np.maximum(dt, 1e-3))
    packed = np.zeros(fixes.height, dtype=bool)
    edges = np.flatnonzero(np.diff(np.concatenate(([False], fast, [False])).astype(np.int8)))
    for a, b in zip(edges[::2], edges[1::2], strict=True):
        if b - a + 1 >= PACKED_RUN:
            packed[a : b + 1] = True
    if packed.any():
        places = fixes.filter(pl.Series(packed))
        report.loss(
            "packed_fixes",
            f"{topic}: {places.height} fixes stand {1e3 * float(np.median(dt[fast])):.0f} ms apart with jumps of "
            f"{metres[fast].min():.1f} … {metres[fast].max():.1f} m: a list of positions without their times; "
            "kept as an attachment, not as fixes",
            count=places.height,
            line=int(places["line"][0]),
            subject=topic,
        )
        table = places.select(lat_deg="lat", lon_deg="lon").write_csv().encode()
        attachments.append(SourceAttachment("packed_fixes.csv", table, "text/csv"))
    return fixes.filter(pl.Series(~packed))


def _coarse(topic: str, fixes: pl.DataFrame, report: ReportBuilder) -> None:
    """Report positions that were rounded to three decimals or fewer."""
    lat = fixes["lat"].to_numpy()
    if lat.size < 3:
        return
    for decimals in range(4):
        if np.abs(lat * 10**decimals - np.round(lat * 10**decimals)).max() < 1e-7 * 10**decimals:
            report.loss(
                "rounded",
                f"{topic}: latitudes are kept to {decimals} decimals, {1.1e5 / 10**decimals:.0f} m apart: rounded "
                "by another program",
                count=lat.size,
                line=int(fixes["line"][0]),
                subject=topic,
            )
            return
