"""A simulated phone as the files of a logger app, and the truth beside them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import polars as pl

from ...recording.errors import UsageError
from .phone import PhoneWalk, phone_walk
from .phone_world import RADIAL_68, geodetic
from .together import written_together

PHONE_FORMATS = ("android-text", "phyphox", "sensor-logger")


def write_phone(
    scenario: str,
    folder: Path,
    *,
    seed: int,
    name: str | None,
    format: str,
    overwrite: bool,
    options: dict[str, Any],
) -> tuple[list[Path], list[Path], PhoneWalk]:
    """Write the log of a simulated phone and its truth; return both and the walk.

    Files: ``phone-<name>.txt``, or a folder ``phone-<name>`` as the app exports it; ``….truth.csv`` (the walker's
    place on the ground in east, true north, up; the phone's attitude; ``still`` while nobody walks),
    ``….truth.steps.csv`` (a row a step), ``….truth.fix.csv`` (the same place on the Earth), ``….truth.marks.csv``
    (tier ``placement``: where the phone is carried; tier ``activity``: walking or standing) and ``….truth.toml``.

    Raises
    ------
    UsageError
        Unknown format or option.
    OutputExists
        A file is there already.
    """
    if format not in PHONE_FORMATS:
        raise UsageError(
            f"simulate {scenario}: format {format!r} is unknown: choose {', '.join(PHONE_FORMATS)}"
        )
    walk = phone_walk(scenario, seed=seed, **options)
    stem = name or f"{scenario}-{seed:03d}"
    log = folder / (f"{stem}.txt" if format == "android-text" else stem)
    kinds = (".csv", ".steps.csv", ".fix.csv", ".marks.csv", ".toml")
    truths = [folder / f"{stem}.truth{part}" for part in kinds]
    with written_together(folder, (log, *truths), overwrite=overwrite) as part:
        _WRITERS[format](part / log.name, walk)
        origin = 0 if format != "phyphox" else int(walk.t_ns[0])
        _truth(walk, origin).write_csv(part / truths[0].name)
        steps = walk.steps.with_columns(pl.col("start_ns") - origin, pl.col("end_ns") - origin)
        steps.write_csv(part / truths[1].name)
        _truth_places(walk, origin).write_csv(part / truths[2].name)
        _truth_marks(walk, origin).write_csv(part / truths[3].name)
        (part / truths[4].name).write_bytes(msgspec.toml.encode(_facts(walk, format)))
    return [log], truths, walk


def _held(walk: PhoneWalk) -> np.ndarray:
    """Return latitude, longitude, height of the last fix at every sample; NaN before the first."""
    values = walk.fixes.select("lat_deg", "lon_deg", "alt_m").to_numpy()
    newest = np.searchsorted(walk.fixes["t_ns"].to_numpy(), walk.t_ns, side="right") - 1
    if not len(values):
        return np.full((len(newest), 3), np.nan)
    return np.where((newest < 0)[:, None], np.nan, values[np.maximum(newest, 0)])


def _android_text(path: Path, walk: PhoneWalk) -> None:
    """Write the rows from the first fix on, as the app does: it waits for one; without GNSS there are none."""
    place = _held(walk)
    there = ~np.isnan(place[:, 0])
    columns = [walk.t_ns // 1_000_000, *walk.acc_b.T, *np.round(walk.mag_b * 1e6, 3).T, *place.T]
    table = pl.DataFrame({f"c{k}": v for k, v in enumerate(columns)}).filter(pl.Series(there))
    period = round(1000 / walk.options.rate_hz)
    head = f"@Date: {np.datetime64(int(walk.t_ns[0]), 'ns')} UTC\n@ Sensors: simulated\n@ SamplingTime: {period}ms\n\n"
    path.write_text(head + table.write_csv(include_header=False, line_terminator="#\n"), encoding="utf-8")


def _csv(path: Path, header: list[str], columns: list[np.ndarray]) -> None:
    table = pl.DataFrame({f"c{k}": v for k, v in enumerate(columns)})
    path.write_text(",".join(header) + "\n" + table.write_csv(include_header=False), encoding="utf-8")


def _phyphox(path: Path, walk: PhoneWalk) -> None:
    path.mkdir()
    start = walk.t_ns[0]
    t = (walk.t_ns - start) / 1e9
    for name, unit, values in (
        ("Accelerometer", "m/s^2", walk.acc_b),
        ("Gyroscope", "rad/s", walk.gyr_b),
        ("Magnetometer", "µT", walk.mag_b * 1e6),
    ):
        header = ['"Time (s)"', *(f'"{a} ({unit})"' for a in "XYZ")]
        _csv(path / f"{name}.csv", header, [t, *values.T])
    f = walk.fixes
    names = ["Time (s)", "Latitude (°)", "Longitude (°)", "Height (m)", "Velocity (m/s)", "Direction (°)"]
    names += ["Horizontal Accuracy (m)", "Vertical Accuracy (m)"]
    columns = [
        (f["t_ns"].to_numpy() - start) / 1e9,
        *(f[c].to_numpy() for c in ("lat_deg", "lon_deg", "alt_m")),
    ]
    columns += [*_speed_and_course(walk), f["sd_east_m"].to_numpy() * RADIAL_68, f["sd_up_m"].to_numpy()]
    _csv(path / "Location.csv", [f'"{n}"' for n in names], columns)
    p = walk.pressure
    if p.height:
        seconds = (p["t_ns"].to_numpy() - start) / 1e9
        _csv(path / "Pressure.csv", ['"Time (s)"', '"X (hPa)"'], [seconds, p["pressure_pa"].to_numpy() / 100])


def _speed_and_course(walk: PhoneWalk) -> tuple[np.ndarray, np.ndarray]:
    """Return size (m/s) and course (degrees clockwise from north) of the receiver's velocity at the fixes."""
    east, north = (walk.fixes[c].to_numpy() for c in ("vel_east", "vel_north"))
    return np.hypot(east, north), np.degrees(np.arctan2(east, north)) % 360


def _sensor_logger(path: Path, walk: PhoneWalk) -> None:
    path.mkdir()
    start = walk.t_ns[0]

    def write(name: str, names: list[str], t: np.ndarray, columns: list[np.ndarray]) -> None:
        _csv(path / f"{name}.csv", ["time", "seconds_elapsed", *names], [t, (t - start) / 1e9, *columns])

    for name, values in (
        ("TotalAcceleration", walk.acc_b),
        ("Gyroscope", walk.gyr_b),
        ("Magnetometer", walk.mag_b * 1e6),
    ):
        write(name, ["z", "y", "x"], walk.t_ns, list(values[:, ::-1].T))
    f = walk.fixes
    names = [
        "speed",
        "bearing",
        "verticalAccuracy",
        "horizontalAccuracy",
        "altitude",
        "longitude",
        "latitude",
    ]
    columns = [*_speed_and_course(walk), f["sd_up_m"].to_numpy(), f["sd_east_m"].to_numpy() * RADIAL_68]
    columns += [f[c].to_numpy() for c in ("alt_m", "lon_deg", "lat_deg")]
    write("Location", names, f["t_ns"].to_numpy(), columns)
    if walk.pressure.height:
        hecto = walk.pressure["pressure_pa"].to_numpy() / 100
        write("Barometer", ["pressure"], walk.pressure["t_ns"].to_numpy(), [hecto])
    about = "version,device name,platform,standardisation\n3,simulated,android,false\n"
    (path / "Metadata.csv").write_text(about, encoding="utf-8")


_WRITERS = {"android-text": _android_text, "phyphox": _phyphox, "sensor-logger": _sensor_logger}


def _truth(walk: PhoneWalk, origin: int) -> pl.DataFrame:
    columns: dict[str, Any] = {"t_ns": walk.t_ns - origin}
    columns |= dict(zip(("pos_x", "pos_y", "pos_z"), walk.pos.T, strict=True))
    columns |= dict(zip(("quat_w", "quat_x", "quat_y", "quat_z"), walk.quat_wxyz.T, strict=True))
    columns |= dict(zip(("vel_x", "vel_y", "vel_z"), walk.vel.T, strict=True))
    return pl.DataFrame(columns | {"still": (~walk.walking).astype(np.int8)})


def _truth_places(walk: PhoneWalk, origin: int) -> pl.DataFrame:
    """Return the walker's place on the Earth, five times a second."""
    every = max(1, round(walk.options.rate_hz / 5))
    place = walk.pos[::every]
    lat, lon = geodetic(walk.options, place)
    alt = walk.options.alt_m + place[:, 2]
    return pl.DataFrame({"t_ns": walk.t_ns[::every] - origin, "lat_deg": lat, "lon_deg": lon, "alt_m": alt})


def _truth_marks(walk: PhoneWalk, origin: int) -> pl.DataFrame:
    """Return annotations: the placement, and stretches of walking and standing."""
    t = walk.t_ns - origin
    change = np.flatnonzero(np.diff(walk.walking)) + 1
    starts, ends = np.concatenate(([0], change)), np.concatenate((change - 1, [len(t) - 1]))
    return pl.DataFrame(
        {
            "tier": ["placement", *["activity"] * len(starts)],
            "start_ns": [t[0], *t[starts]],
            "end_ns": [t[-1], *t[ends]],
            "label": [
                walk.options.placement,
                *("walking" if walk.walking[k] else "standing" for k in starts),
            ],
        },
        schema_overrides={"start_ns": pl.Int64, "end_ns": pl.Int64},
    )


def _facts(walk: PhoneWalk, format: str) -> dict[str, Any]:
    chosen = msgspec.to_builtins(walk.options)
    return {
        "closed": walk.closed,
        **({"length_m": round(walk.length_m, 6)} if walk.length_m else {}),
        "steps": walk.steps.height,
        "scenario": walk.scenario,
        "seed": walk.seed,
        "format": format,
        "frame": "x east, y true north, z up, origin on the ground at the start; quat = rot_nb of the phone",
        "declination_deg": round(float(np.degrees(walk.declination_rad)), 4),
        "hard_iron_t": walk.hard_iron_t.tolist(),
        "options": {k: v for k, v in chosen.items() if v is not None},
    }
